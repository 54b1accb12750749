"""Texture statistics: steerable-pyramid histograms and their matching."""

from model.texture_statistics.description import MatchedTexture as MatchedTexture
from model.texture_statistics.description import TextureStatistics as TextureStatistics
from model.texture_statistics.description import describe as describe
from model.texture_statistics.description import match as match
from model.texture_statistics.description import statistics as statistics
