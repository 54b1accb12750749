"""Calibration targets: charts, plates and balls."""

from rigsim.targets.flat import (
    Target,
    TargetError,
    chart_reflectances,
    make_target,
    patch_centers_mm,
)

__all__ = ["Target", "TargetError", "chart_reflectances", "make_target", "patch_centers_mm"]
