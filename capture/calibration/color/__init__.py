"""Color calibration: chart, camera matrix and white reference."""

from capture.calibration.color.chart import ChartError, Patches, find_chart, measure_patches
from capture.calibration.color.colorimetry import chart_reference
from capture.calibration.color.matrix import ColorMatrix, Method, fit_matrix, neutral_white

__all__ = [
    "ChartError",
    "ColorMatrix",
    "Method",
    "Patches",
    "chart_reference",
    "find_chart",
    "fit_matrix",
    "measure_patches",
    "neutral_white",
]
