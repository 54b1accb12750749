"""Diffuse albedo R_d from lumitexels."""

from reconstruction.diffuse_albedo.estimation import DiffuseAlbedo as DiffuseAlbedo
from reconstruction.diffuse_albedo.estimation import estimate as estimate
