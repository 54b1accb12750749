"""Chromophores: melanin and hemoglobin maps from linear camera RGB."""

from reconstruction.chromophores.inversion import (
    ChromophoreMaps,
    Identifiability,
    compute_identifiability,
    invert,
)
from reconstruction.chromophores.model_error import add_brightness_variance, model_covariance
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
