"""Invert moments of the lights to normals, by a table of responses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals import kernels
from reconstruction.gradient_normals.lobe_response import LobeResponseTable
from reconstruction.gradient_normals.moments import ReflectionMoments
from reconstruction.gradient_normals.patterns import GradientError
from reconstruction.gradient_normals.sphere_lights import SphereLights, view_frame

MIN_MOMENT_SIGMAS = 3.0
"""Length of the moment vector over its standard error, below which a pixel has no signal."""


def normalize_views(
    view: ArrayLike, shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray | None]:
    """Return the mean view (3,), and every pixel's (P, 3) or none (0, 3)."""
    v = np.asarray(view, np.float64)
    Checks(GradientError).shape("view", v, (3,), (*shape, 3))
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    Checks(GradientError).within("length of view", length, "(0.99, 1.01)")
    v = v / length
    if v.ndim == 1:
        return v, None
    middle = v.reshape(-1, 3).mean(axis=0)
    return middle / np.linalg.norm(middle), v.reshape(-1, 3)


def frame_positions(
    points_mm: ArrayLike | None,
    shape: tuple[int, int],
    middle: FloatArray,
    lights: SphereLights | None,
) -> FloatArray | None:
    """Return the pixels' positions (P, 2) along the frame's first two axes, mm."""
    if points_mm is None:
        return None
    if lights is None or not np.isfinite(lights.distance_mm):
        raise GradientError(
            "points_mm: got points, but lights without a finite distance_mm; "
            "give the lights' distance or omit points_mm"
        )
    points = np.asarray(points_mm, np.float64)
    points = Checks(GradientError).numbers("points_mm", points, (*shape, 2), (*shape, 3))
    flat = points.reshape(-1, points.shape[-1])
    if points.shape[-1] == 2:
        flat = np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)
    if np.linalg.norm(flat, axis=1).max() > 0.2 * lights.distance_mm:
        raise GradientError(
            "points_mm: got points farther from the middle than a fifth of the lights' distance,"
            " expected nearer ones, as directions follow to first order only; crop the images"
        )
    return np.asarray(flat @ view_frame(middle)[:2].T)


@dataclass(frozen=True, slots=True)
class MomentInversion:
    """Constants of the inversion of a reflection's moments to normals.

    Attributes
    ----------
    reflection : Reflection
    table : Response
        Of size 0: vectors are used uncorrected.
    eta : float
        Refractive index.
    analyzer : ndarray, shape (2,)
        Passing axis in the frame of the table; zeros without lights.
    starts : ndarray of float64, shape (G, G, 2)
        Starts of the search for a position, by the observed one.
    """

    reflection: ReflectionMoments
    table: LobeResponseTable
    eta: float
    analyzer: Float64Array
    starts: Float64Array

    @staticmethod
    def prepare(
        reflection: ReflectionMoments,
        table: LobeResponseTable,
        lights: SphereLights | None,
        eta: float,
    ) -> MomentInversion:
        """Prepare the inversion with a table made for these lights."""
        analyzer, starts = np.zeros(2), np.zeros((2, 2, 2))
        if lights is not None:
            analyzer = np.asarray(table.frame[:2] @ np.asarray(lights.analyzer))
        if table.coefficients.size:
            lines = int(np.clip(3.0 / table.step, 65, 257))
            starts = np.empty((lines, lines, 2))
            kernels.fill_start_grid(table.coefficients, table.min_coordinate, table.step, starts)
        return MomentInversion(reflection, table, eta, analyzer, starts)

    def normals(
        self,
        moments: tuple[FloatArray, FloatArray],
        view: FloatArray | None = None,
        position: FloatArray | None = None,
    ) -> Float64Array:
        """Return normals with albedo and errors (P, NORMAL_COLUMNS), see :mod:`kernels`.

        Parameters
        ----------
        moments : pair of ndarray, shape (MOMENT_ROWS, P)
            As of `Reflection.moments`.
        view : ndarray, shape (P, 3), optional
            Each pixel's view, if it differs from the table's.
        position : ndarray, shape (P, 2), optional
            Each pixel's position in the field, mm.
        """
        table, reflection = self.table, self.reflection
        out = np.empty((moments[0].shape[1], kernels.NORMAL_COLUMNS))
        kernels.invert(
            *moments,
            table.frame,
            reflection.component == "specular",
            table.coefficients,
            table.min_coordinate,
            table.step,
            self.starts,
            self.analyzer,
            self.eta,
            np.zeros((0, 3)) if view is None else view,
            np.zeros((0, 2)) if position is None else position,
            reflection.noise_source > 0,
            MIN_MOMENT_SIGMAS,
            1e-5 if reflection.kind == np.float32 else 1e-9,
            out,
        )
        return out
