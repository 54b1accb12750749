"""Moments of the lights to normals, by a table of responses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals import kernels
from reconstruction.gradient_normals.lobe_response import Response
from reconstruction.gradient_normals.moments import Reflection
from reconstruction.gradient_normals.patterns import GradientError
from reconstruction.gradient_normals.sphere_lights import SphereLights, frame_of

MIN_MOMENT_SIGMAS = 3.0
"""Length of the moment vector over its standard error, below which a pixel has no normal."""


def views_of(view: ArrayLike, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the mean view (3,), and every pixel's (P, 3) or none (0, 3)."""
    v = np.asarray(view, np.float64)
    if v.shape not in ((3,), (*shape, 3)):
        raise GradientError(f"view: got shape {v.shape}, expected (3,) or {(*shape, 3)}")
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    if not (np.abs(length - 1.0) < 0.01).all():
        raise GradientError("view: expected unit vectors, got lengths other than 1")
    v = v / length
    if v.ndim == 1:
        return v, np.zeros((0, 3))
    middle = v.reshape(-1, 3).mean(axis=0)
    return middle / np.linalg.norm(middle), v.reshape(-1, 3)


def places_of(
    points_mm: ArrayLike | None,
    shape: tuple[int, int],
    middle: FloatArray,
    lights: SphereLights | None,
) -> FloatArray | None:
    """Return the pixels' places (P, 2) along the frame's first two axes, mm."""
    if points_mm is None:
        return None
    if lights is None or not np.isfinite(lights.distance_mm):
        raise GradientError("points_mm: got them without lights of finite distance_mm")
    points = np.asarray(points_mm, np.float64)
    if points.shape not in ((*shape, 2), (*shape, 3)) or not np.isfinite(points).all():
        raise GradientError(
            f"points_mm: got shape {points.shape}, expected finite {(*shape, 2)} or {(*shape, 3)}"
        )
    flat = points.reshape(-1, points.shape[-1])
    if points.shape[-1] == 2:
        flat = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    if np.linalg.norm(flat, axis=1).max() > 0.2 * lights.distance_mm:
        raise GradientError(
            "points_mm: got points farther from the middle than a fifth of the lights' distance;"
            " directions to the lights are followed to first order only"
        )
    return np.asarray(flat @ frame_of(middle)[:2].T)


def analyzer_of(lights: SphereLights | None, table: Response) -> FloatArray:
    """Return the analyser's axis in the frame of the view, (2,)."""
    if lights is None:
        return np.zeros(2)
    return np.asarray(table.frame[:2] @ np.asarray(lights.analyser))


def grid_of(table: Response) -> Float64Array:
    """Return places for the search to begin at, see :func:`gradient_kernels.starts`."""
    if table.coefficients.size == 0:
        return np.zeros((2, 2, 2))
    lines = int(np.clip(3.0 / table.step, 65, 257))
    grid = np.empty((lines, lines, 2))
    kernels.starts(table.coefficients, table.least, table.step, grid)
    return grid


def invert_moments(
    reflection: Reflection,
    moments: tuple[FloatArray, FloatArray],
    table: Response,
    grid: FloatArray,
    analyser: FloatArray,
    eta: float,
    view: FloatArray,
    place: FloatArray,
) -> Float64Array:
    """Return the normals' columns (P, 9) of moments, by the table of responses."""
    out = np.empty((moments[0].shape[1], kernels.NORMAL_COLUMNS))
    kernels.invert(
        *moments,
        table.frame,
        reflection.component == "specular",
        table.coefficients,
        table.least,
        table.step,
        grid,
        analyser,
        eta,
        view,
        place,
        reflection.told > 0,
        MIN_MOMENT_SIGMAS,
        1e-5 if reflection.kind == np.float32 else 1e-9,
        out,
    )
    return out
