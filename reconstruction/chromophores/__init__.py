"""Chromophores: melanin and hemoglobin maps from linear camera RGB."""

from reconstruction.chromophores.inversion import (
    ChromophoreMaps,
    Identifiability,
    add_brightness_variance,
    compute_identifiability,
    invert,
    model_covariance,
)
from reconstruction.chromophores.pixel_checks import ChromophoreError

__all__ = [
    "ChromophoreError",
    "ChromophoreMaps",
    "Identifiability",
    "add_brightness_variance",
    "compute_identifiability",
    "invert",
    "model_covariance",
]
