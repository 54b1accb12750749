"""What a mirroring ball shows a camera of the lights around it."""

from dataclasses import dataclass

import numpy as np

from capture.arrays import Float64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.lights.reflection import reflection_pixels, reflection_points

DERIVATIVE_STEP_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Mirrored:
    """How a ball shows lights to a camera.

    Attributes
    ----------
    pixels : ndarray of float64, shape (L, 2)
        Column and row, px; NaN where the ball does not show the light.
    to_light, to_camera, normal : ndarray of float64, shape (L, 3)
        Unit vectors at the mirroring point of the ball.
    px_per_mm : ndarray of float64, shape (L, 2, 2)
        How the spot moves with the light, along two directions across the line to it.
    across : ndarray of float64, shape (L, 2, 3)
        These directions, unit vectors.
    """

    pixels: Float64Array
    to_light: Float64Array
    to_camera: Float64Array
    normal: Float64Array
    px_per_mm: Float64Array
    across: Float64Array

    @property
    def magnification_px2(self) -> Float64Array:
        """Area of the image of 1 mm^2 of a light that faces the ball, px^2, shape (L,)."""
        return np.abs(np.linalg.det(self.px_per_mm))


def mirror_lights(
    camera: CameraPose, center_mm: Float64Array, radius_mm: float, lights_mm: Float64Array
) -> Mirrored:
    """Return where and how a ball mirrors lights into a camera.

    Parameters
    ----------
    camera : CameraPose
    center_mm, radius_mm
        The ball.
    lights_mm : ndarray of float64, shape (L, 3)
        Places of the lights, outside the ball.
    """
    lights = np.asarray(lights_mm, np.float64)
    eyes = np.broadcast_to(camera.center_mm, lights.shape)
    centers = np.broadcast_to(np.asarray(center_mm, np.float64), lights.shape)
    point, seen = reflection_points(eyes, centers, radius_mm, lights)
    to_light, to_camera = _unit(lights - point), _unit(eyes - point)
    first = np.cross(to_light, _least_axis(to_light))
    first = _unit(first)
    across = np.stack([first, np.cross(to_light, first)], axis=1)
    columns = []
    for j in range(2):
        step = DERIVATIVE_STEP_MM * across[:, j]
        ends = [reflection_pixels(camera, center_mm, radius_mm, lights + s * step) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * DERIVATIVE_STEP_MM))
    return Mirrored(
        np.where(seen[:, None], camera.project(point), np.nan),
        to_light,
        to_camera,
        (point - centers) / radius_mm,
        np.stack(columns, axis=-1),
        across,
    )


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _least_axis(vectors: Float64Array) -> Float64Array:
    """Return the coordinate axis that each vector is least along."""
    return np.eye(3)[np.argmin(np.abs(vectors), axis=-1)]
