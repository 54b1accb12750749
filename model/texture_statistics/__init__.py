"""Texture statistics: steerable-pyramid histograms and their matching."""

from model.texture_statistics.description import (
    MatchedTexture,
    TextureStatistics,
    describe,
    match,
    statistics,
)

__all__ = ["MatchedTexture", "TextureStatistics", "describe", "match", "statistics"]
