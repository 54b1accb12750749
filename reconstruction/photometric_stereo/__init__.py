"""Photometric stereo: normals and albedo from a stack of lights."""

from reconstruction.normal_maps import NormalMaps, PhotometricStereoError
from reconstruction.photometric_stereo.estimation import (
    Robustness,
    estimate_normals,
    require_spread,
)
from reconstruction.photometric_stereo.refinement import refine

__all__ = [
    "NormalMaps",
    "PhotometricStereoError",
    "Robustness",
    "estimate_normals",
    "refine",
    "require_spread",
]
