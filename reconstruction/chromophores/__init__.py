"""Chromophores: melanin and hemoglobin maps from linear camera RGB."""

from reconstruction.chromophores.inversion import (
    ChromophoreMaps,
    Identifiability,
    identifiability,
    invert,
    model_covariance,
    without_brightness,
)
from reconstruction.chromophores.pixel_checks import ChromophoreError

__all__ = [
    "ChromophoreError",
    "ChromophoreMaps",
    "Identifiability",
    "identifiability",
    "invert",
    "model_covariance",
    "without_brightness",
]
