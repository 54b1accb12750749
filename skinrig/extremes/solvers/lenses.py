"""Extremes of the inverse of a lens, and of mirror points on a ball."""

from dataclasses import replace

import numpy as np

from capture.calibration.geometry.intrinsics import CameraPose
from capture.calibration.lights.reflection import reflection_points
from capture.rig import load_rig
from skinrig.extremes.expectations import (
    expect_error,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision

FAR_MM = 1e9


def _camera(real: InputPrecision, k1: float) -> CameraPose:
    camera = CameraPose.nominal(load_rig("dome").views[0])
    return replace(camera, distortion=np.asarray(real([k1, 0.0, 0.0, 0.0, 0.0]), np.float64))


def _round_trip(real: InputPrecision, k1: float) -> str:
    camera = _camera(real, k1)
    width, height = camera.image_size
    pixels = real([[0.0, 0.0], [width - 1.0, 0.0], [0.3 * width, height - 1.0]])
    back = camera.project(camera.center_mm + 500.0 * camera.rays(pixels))
    return expect_within(np.abs(back - pixels).max(), 0.0, 1e-6, label="distance, px")


def _no_distortion(real: InputPrecision) -> str:
    return _round_trip(real, 0.0)


def _strong_barrel(real: InputPrecision) -> str:
    return _round_trip(real, -0.5)


def _principal_point(real: InputPrecision) -> str:
    camera = _camera(real, -0.5)
    return "ray " + expect_near(
        camera.rays(camera.matrix[:2, 2]), camera.rotation[2], absolute=1e-12
    )


def _no_inverse(real: InputPrecision) -> str:
    return expect_error(
        lambda: _camera(real, -30.0).rays(real([[0.0, 0.0]])), ValueError, "no inverse"
    )


def _mirrored(
    real: InputPrecision, light_mm: tuple[float, ...], *, radius_mm: float = 20.0
) -> tuple[float, bool]:
    """Return the difference of the cosines to eye and light at the mirror point, and visibility."""
    eye, light = (np.asarray(real([place]), np.float64) for place in ((0.0, 0.0, 600.0), light_mm))
    point, seen = reflection_points(eye, np.zeros((1, 3)), radius_mm, light)
    to_eye, to_light = (
        (place - point)[0] / np.linalg.norm(place - point) for place in (eye, light)
    )
    return abs(float(point[0] @ (to_eye - to_light))) / radius_mm, bool(seen[0])


def _expect_reflection(found: tuple[float, bool]) -> str:
    expect_valid_fraction(found[1], fraction_range=(1.0, 1.0))
    return expect_within(found[0], 0.0, 1e-9, label="difference of cosines")


def _light_at_eye(real: InputPrecision) -> str:
    return _expect_reflection(_mirrored(real, (0.0, 0.0, 600.0)))


def _light_far_away(real: InputPrecision) -> str:
    return _expect_reflection(_mirrored(real, (FAR_MM, 0.0, 0.5 * FAR_MM)))


def _tiny_ball(real: InputPrecision) -> str:
    return _expect_reflection(_mirrored(real, (300.0, 200.0, 500.0), radius_mm=1e-3))


def _light_behind_ball(real: InputPrecision) -> str:
    return expect_valid_fraction(_mirrored(real, (0.0, 0.0, -600.0))[1])
