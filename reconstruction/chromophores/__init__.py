"""Chromophores: melanin and hemoglobin maps from linear camera RGB."""

from reconstruction.chromophores.inversion import (
    ChromophoreError,
    ChromophoreMaps,
    Identifiability,
    identifiability,
    invert,
    model_covariance,
    without_brightness,
)

__all__ = [
    "ChromophoreError",
    "ChromophoreMaps",
    "Identifiability",
    "identifiability",
    "invert",
    "model_covariance",
    "without_brightness",
]
