"""Integrate normals of surfaces with jumps to heights, by bilaterally weighted least squares.

A pixel's slope constrains the steps to its neighbors on both sides, on each side with a weight that
falls where the height steps more on that side than on the other (Cao, Santo, Shi, Okura and
Matsushita 2022, Bilateral normal integration, ECCV, doi 10.1007/978-3-031-19769-7_32). Both weights
of a pixel and direction sum to one, so that a jump removes at most one of its two neighbors.

A jump all around a closed contour leaves no trace in normals, so its height cannot be recovered.
"""

import logging
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from model.checks import Checks
from model.solver_outcome import SolverOutcome
from reconstruction.arrays import BoolArray, Float32Array, FloatArray, Int32Array
from reconstruction.normal_integration import slope_fields
from reconstruction.normal_integration.integration import label_parts, to_height
from reconstruction.normal_integration.slope_fields import Perspective, SlopeField
from reconstruction.normal_integration.weighted_poisson import (
    IntegrationError,
    MultigridHierarchy,
    solve_poisson,
)
from reconstruction.normal_maps import NormalMaps

_log = logging.getLogger(__name__)


@njit(cache=True, parallel=True, error_model="numpy")
def _side_weights(x, ex, ey, facing, k, wx, wy):  # type: ignore[no-untyped-def]
    """Write each pixel's weight of its right and of its lower neighbor; x has a border of one.

    ``ex``, ``ey``: whether there is an edge to the right and below. Half where one side is missing.
    The weight is a logistic function of the difference of both sides' squared steps (the paper's
    eq. (12) with sharpness k); m n . w turns height steps into distances along the normal.
    """
    rows, columns = facing.shape
    for i in prange(1, rows + 1):
        for j in range(1, columns + 1):
            m = float(facing[i - 1, j - 1])
            wx[i, j], wy[i, j] = 0.5, 0.5
            if ex[i, j] > 0 and ex[i, j - 1] > 0:
                after, before = m * (x[i, j + 1] - x[i, j]), m * (x[i, j] - x[i, j - 1])
                t = min(max(k * (before * before - after * after), -40.0), 40.0)
                wx[i, j] = 1.0 / (1.0 + np.exp(-t))
            if ey[i, j] > 0 and ey[i - 1, j] > 0:
                after, before = m * (x[i + 1, j] - x[i, j]), m * (x[i, j] - x[i - 1, j])
                t = min(max(k * (before * before - after * after), -40.0), 40.0)
                wy[i, j] = 1.0 / (1.0 + np.exp(-t))


@njit(cache=True, parallel=True, error_model="numpy")
def _one_sided(gx, gy, ux, uy, wx, wy, ex, ey, x, ax, ay, dx, dy, energy):  # type: ignore[no-untyped-def]
    """Write the edges' weights and differences from both pixels' own slopes; energy of x by rows.

    ``ux``, ``uy``: confidence of a pixel's slope, (H, W). The least weight is 1e-7.
    """
    rows, columns = gx.shape
    for i in prange(1, rows + 1):
        total = 0.0
        for j in range(1, columns + 1):
            if ex[i, j] > 0:
                p = float(wx[i, j]) * ux[i - 1, j - 1]
                q = (1.0 - wx[i, j + 1]) * ux[i - 1, j]
                a, b = gx[i - 1, j - 1], gx[i - 1, j]
                step = x[i, j + 1] - x[i, j]
                total += p * (step - a) ** 2 + q * (step - b) ** 2
                p, q = max(p, 1e-7), max(q, 1e-7)
                ax[i, j] = p + q
                dx[i, j] = (p * a + q * b) / (p + q)
            if ey[i, j] > 0:
                p = float(wy[i, j]) * uy[i - 1, j - 1]
                q = (1.0 - wy[i + 1, j]) * uy[i, j - 1]
                a, b = gy[i - 1, j - 1], gy[i, j - 1]
                step = x[i + 1, j] - x[i, j]
                total += p * (step - a) ** 2 + q * (step - b) ** 2
                p, q = max(p, 1e-7), max(q, 1e-7)
                ay[i, j] = p + q
                dy[i, j] = (p * a + q * b) / (p + q)
        energy[i] = total


@dataclass(frozen=True, slots=True)
class BilateralSettings:
    """Settings of the bilaterally weighted integration.

    Attributes
    ----------
    sharpness : float
        The paper's k, per square of a pixel's height, > 0; 2 as in the paper. Larger ones find
        more jumps, also wrong ones: 20 with ``stop=0`` was worse on most of nine scanned objects.
    rounds : int
        Largest number of rounds of new weights, >= 1.
    stop : float
        Relative change of the energy at which the rounds end, >= 0.
    inner : int
        Largest number of conjugate gradient iterations per round, >= 1.
    min_ray_cosine : float
        See `IntegrationSettings`.
    """

    sharpness: float = 2.0
    rounds: int = 150
    stop: float = 1e-4
    inner: int = 2
    min_ray_cosine: float = slope_fields.MIN_RAY_COSINE

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        check = Checks(IntegrationError)
        check.settings(
            self, sharpness="(0, inf)", rounds="[1, inf)", stop="[0, 1)", inner="[1, inf)"
        )
        check.settings(self, min_ray_cosine="(0, 1)")


@dataclass(frozen=True, slots=True)
class DiscontinuousHeight:
    """Height of a surface with jumps, and the weights that it was found with.

    Attributes
    ----------
    height : ndarray, shape (H, W)
        See `normal_integration.HeightMap`.
    valid : ndarray of bool, shape (H, W)
    part : ndarray of int32, shape (H, W)
        Connected parts of the mask; jumps do not divide parts.
    right, below : ndarray, shape (H, W), float32
        Weight of the pixel's neighbor to the right and below, in [0, 1]; that of the opposite
        neighbor is one less it. Far from 1/2 at a jump.
    energy : float
        The paper's objective at the last round's weights, px^2.
    outcome : SolverOutcome
        Of the rounds; its residual is the last relative change of `energy`.
    """

    height: FloatArray
    valid: BoolArray
    part: Int32Array
    right: Float32Array
    below: Float32Array
    energy: float
    outcome: SolverOutcome


def integrate_with_discontinuities(
    normals: FloatArray | NormalMaps,
    *,
    pixel: float = 1.0,
    valid: BoolArray | None = None,
    stderr_rad: ArrayLike | None = None,
    y_up: bool = True,
    camera: Perspective | None = None,
    settings: BilateralSettings | None = None,
) -> DiscontinuousHeight:
    """Integrate normals to a height that may jump where slopes of both sides contradict.

    Parameters
    ----------
    normals, pixel, valid, stderr_rad, y_up, camera
        See `normal_integration.integrate`.
    settings : BilateralSettings, optional

    Returns
    -------
    DiscontinuousHeight

    Raises
    ------
    IntegrationError
        See `integrate`.

    Notes
    -----
    Starts with the joined surface and repeats: weights from the present heights, then a few
    conjugate gradient steps with a multigrid made for these weights. The objective has many
    minima; the start decides which one is reached. On smooth relief the plain
    `integrate` is better: differences here are of first order (a pixel's own slope), not fourth.

    Examples
    --------
    >>> import numpy as np
    >>> flat = np.broadcast_to([0.0, 0.0, 1.0], (8, 8, 3))
    >>> found = integrate_with_discontinuities(flat)
    >>> float(np.ptp(found.height)), found.outcome.converged
    (0.0, True)
    """
    Checks(IntegrationError).within("pixel", pixel, "(0, inf)")
    chosen = settings or BilateralSettings()
    slopes = slope_fields.from_normals(
        normals,
        valid=valid,
        stderr_rad=stderr_rad,
        y_up=y_up,
        camera=camera,
        min_ray_cosine=chosen.min_ray_cosine,
    )
    ux, uy = _confidence(slopes)
    ax, ay, dx, dy = slope_fields.edges(slopes, order=2)
    ex, ey = (ax > 0).astype(np.float32), (ay > 0).astype(np.float32)
    x = np.zeros(dx.shape)
    condition = solve_poisson(MultigridHierarchy(ax, ay), dx, dy, x, tolerance=1e-2).condition
    wx, wy = np.zeros_like(ax), np.zeros_like(ax)
    by_row = np.zeros(ax.shape[0])
    before, change, done = np.inf, np.inf, 0
    while True:
        _side_weights(x, ex, ey, slopes.facing, float(chosen.sharpness), wx, wy)
        _one_sided(slopes.gx, slopes.gy, ux, uy, wx, wy, ex, ey, x, ax, ay, dx, dy, by_row)
        energy = float(by_row.sum())
        first = 0.0 if energy == 0.0 else np.inf
        change = abs(before - energy) / before if 0.0 < before < np.inf else first
        if change <= chosen.stop or done >= chosen.rounds:
            break
        solved = solve_poisson(
            MultigridHierarchy(ax, ay), dx, dy, x, tolerance=1e-6, iterations=chosen.inner
        )
        before, done = energy, done + 1
        condition = solved.condition
    part = label_parts(slopes.valid)
    kind = np.asarray(normals.normals if isinstance(normals, NormalMaps) else normals).dtype
    height = to_height(x[1:-1, 1:-1], part, pixel=pixel, camera=camera)
    return DiscontinuousHeight(
        height.astype(np.float32) if kind == np.float32 else height,
        slopes.valid,
        part,
        wx[1:-1, 1:-1].copy(),
        wy[1:-1, 1:-1].copy(),
        energy,
        SolverOutcome(
            done, change, condition, "tolerance" if change <= chosen.stop else "limit"
        ).warn_unless_converged("bilateral integration", _log),
    )


def _confidence(slopes: SlopeField) -> tuple[Float32Array, Float32Array]:
    """Return the confidence of each slope: n_z^2 as in the paper, or its inverse variance."""
    if slopes.variance_x.shape == slopes.gx.shape and slopes.scale > 0.0:
        return 1.0 / slopes.variance_x, 1.0 / slopes.variance_y
    squared = slopes.facing * slopes.facing
    return squared, squared
