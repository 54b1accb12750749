"""Calibration of polarizers: Malus fit, extinction ratio and polarized reflection."""

from capture.calibration.polarization.malus import (
    MalusFit,
    PolarizationCalibration,
    PolarizationError,
    fit_malus,
    modulated_pixels,
)

__all__ = [
    "MalusFit",
    "PolarizationCalibration",
    "PolarizationError",
    "fit_malus",
    "modulated_pixels",
]
