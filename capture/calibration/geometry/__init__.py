"""Geometric calibration: intrinsics, poses and bundle adjustment of cameras."""

from capture.calibration.geometry.board import Intrinsics, calibrate_intrinsics
from capture.calibration.geometry.intrinsics import (
    CameraPose,
    cameras_from_calibration,
    distort,
    nominal_cameras,
    to_calibration,
)

__all__ = [
    "CameraPose",
    "Intrinsics",
    "calibrate_intrinsics",
    "cameras_from_calibration",
    "distort",
    "nominal_cameras",
    "to_calibration",
]
