"""Calibration of polarizers: Malus fit, extinction ratio and polarized reflection."""

from capture.calibration.polarization.malus import (
    MalusFit,
    PolarizationCalibration,
    PolarizationError,
    find_modulated_pixels,
    fit_malus,
)

__all__ = [
    "MalusFit",
    "PolarizationCalibration",
    "PolarizationError",
    "find_modulated_pixels",
    "fit_malus",
]
