"""Geometric calibration: intrinsics, poses and bundle adjustment of cameras."""

from capture.calibration.geometry.board import Intrinsics, calibrate_intrinsics
from capture.calibration.geometry.intrinsics import (
    CameraPose,
    distort,
    nominal_cameras,
    poses_from,
    to_calibration,
)

__all__ = [
    "CameraPose",
    "Intrinsics",
    "calibrate_intrinsics",
    "distort",
    "nominal_cameras",
    "poses_from",
    "to_calibration",
]
