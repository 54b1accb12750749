"""Solve for heights whose differences along a grid's edges fit given ones by least squares.

Minimizes sum a_e (x_q - x_p - d_e)^2 over the edges e = (p, q) of a grid of pixels. Its normal
equations are solved by conjugate gradients with a multigrid cycle as preconditioner, without a
matrix. See `multigrid_kernels` for the multigrid.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads, set_num_threads
from scipy.linalg import eigvalsh_tridiagonal

from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome, StopReason
from reconstruction.arrays import Float32Array, Float64Array
from reconstruction.normal_integration import multigrid_coarsening as coarsening
from reconstruction.normal_integration import multigrid_kernels as kernels

COARSEST_SIDE = 6
"""Nodes per side at which coarsening ends."""
_COARSEST_SWEEPS = 12
_MIN_PARALLEL_NODES = 1 << 16
"""Nodes of a level below which it is solved by one thread."""
_RESIDUAL_REDUCTION = 1e-4
"""Reduction of the residual by float32 steps before it is recomputed in float64."""


class IntegrationError(ValueError):
    """Normals, masks or settings that no height can be computed from."""


@dataclass(frozen=True, slots=True)
class _Level:
    A: Float32Array
    """Planes of `multigrid_kernels`; of the finest level (3, ...): edges, one over diagonal."""
    P: Float32Array
    b: Float32Array
    x: Float32Array


class MultigridHierarchy:
    """Grids of a multigrid, from the weights of the finest grid's edges.

    Parameters
    ----------
    ax, ay : ndarray, shape (H + 2, W + 2), float32
        Weight of the edge from node [i, j] to [i, j + 1] and to [i + 1, j], >= 0; pixel (0, 0)
        is at [1, 1]. Edges that would leave the image have weight 0.
    """

    def __init__(self, ax: Float32Array, ay: Float32Array) -> None:
        inverse = np.zeros_like(ax)
        coarsening.invert_diagonal(ax, ay, inverse)
        self.ax, self.ay, self.inverse = ax, ay, inverse
        self.levels: list[_Level] = []
        none = np.zeros((1, 1), np.float32)
        e, s, se, sw, inv, diagonals = ax, ay, none, none, inverse, False
        rows, columns = ax.shape[0] - 2, ax.shape[1] - 2
        while max(rows, columns) > COARSEST_SIDE:
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
            shape = (rows + 2, columns + 2)
            P = np.zeros((8, *shape), np.float32)
            coarsening.interpolate_edges(e, s, se, sw, inv, diagonals, P)
            coarsening.interpolate_middles(e, s, se, sw, inv, diagonals, P)
            A = np.zeros((5, *shape), np.float32)
            coarsening.coarsen(e, s, se, sw, inv, diagonals, P, A)
            self.levels.append(
                _Level(A, P, np.zeros(shape, np.float32), np.zeros(shape, np.float32))
            )
            e, s, se, sw, inv = A
            diagonals = True

    def cycle(self, b: Float32Array, x: Float32Array) -> None:
        """Write x, about A^-1 b, by one V cycle, symmetric as conjugate gradients require."""
        ax, ay, inverse = self.ax, self.ay, self.inverse
        kernels.smooth_from_zero(ax, ay, inverse, b, x)
        if self.levels:
            top = self.levels[0]
            kernels.restrict_even(ax, ay, inverse, b, x, top.P, top.b)
            self._coarse_cycle(0)
            kernels.prolong_even(top.P, top.x, inverse, x)
        else:
            for _ in range(_COARSEST_SWEEPS):
                kernels.smooth(ax, ay, inverse, b, x, 0)
                kernels.smooth(ax, ay, inverse, b, x, 1)
            for _ in range(_COARSEST_SWEEPS):
                kernels.smooth(ax, ay, inverse, b, x, 1)
                kernels.smooth(ax, ay, inverse, b, x, 0)
        kernels.smooth(ax, ay, inverse, b, x, 1)
        kernels.smooth(ax, ay, inverse, b, x, 0)

    def _coarse_cycle(self, depth: int) -> None:
        level = self.levels[depth]
        threads = get_num_threads()
        if threads > 1 and level.b.size < _MIN_PARALLEL_NODES:
            set_num_threads(1)  # synchronization would take longer than the work
            try:
                self._coarse_cycle(depth)
            finally:
                set_num_threads(threads)
            return
        A, b, x = level.A, level.b, level.x
        x.fill(0.0)
        last = depth + 1 == len(self.levels)
        for _ in range(_COARSEST_SWEEPS if last else 1):
            kernels.smooth_coarse(A, b, x, 1, 1)
            kernels.smooth_coarse(A, b, x, 2, 1)
        if not last:
            below = self.levels[depth + 1]
            kernels.restrict(A, b, x, below.P, below.b)
            self._coarse_cycle(depth + 1)
            kernels.prolong(below.P, below.x, A, x)
        for _ in range(_COARSEST_SWEEPS if last else 1):
            kernels.smooth_coarse(A, b, x, 2, 2)
            kernels.smooth_coarse(A, b, x, 1, 2)


def solve_poisson(
    hierarchy: MultigridHierarchy,
    dx: Float64Array,
    dy: Float64Array,
    x: Float64Array,
    *,
    tolerance: float = 1e-5,
    iterations: int = 200,
) -> SolverOutcome:
    """Solve for x in place, starting from its values.

    Parameters
    ----------
    hierarchy : MultigridHierarchy
        Of the edges' weights; it gives the preconditioner and the equations.
    dx, dy : ndarray, shape (H + 2, W + 2), float64
        Target differences along the edges of `MultigridHierarchy.ax` and `MultigridHierarchy.ay`,
        finite.
    x : ndarray, shape (H + 2, W + 2), float64
        Start and solution. Its constant in each connected part is arbitrary.
    tolerance : float
        Of the residual's norm over that of the right side, and of the error's energy in the
        preconditioner's norm.
    iterations : int
        Largest number of iterations in all.

    Returns
    -------
    SolverOutcome
        Its residual is the norm of the normal equations' residual over that of their right side, in
        float64; its condition that of the preconditioned equations, by the Lanczos coefficients of
        the last conjugate gradients.
    """
    ax, ay = hierarchy.ax, hierarchy.ay
    r, z, p, q = (np.zeros(ax.shape, np.float32) for _ in range(4))
    pair, sums = np.zeros((2, ax.shape[0])), np.zeros(ax.shape[0])
    done, energy, found = 0, 0.0, np.inf
    condition = UNKNOWN_CONDITION
    while True:
        kernels.residual(ax, ay, dx, dy, x, r, pair)
        norm, given = (float(np.sqrt(total)) for total in pair.sum(axis=1))
        before, found = found, norm / given if given > 0.0 else 0.0
        if found <= tolerance or done >= iterations or not found < 0.5 * before:
            stop: StopReason = "limit" if done >= iterations else "stalled"
            return SolverOutcome(
                done, found, condition, "tolerance" if found <= tolerance else stop
            )
        # r is rounded to float32: constants in it from rounding must stay small against r
        goal = max(0.9 * tolerance * given, _RESIDUAL_REDUCTION * norm)
        left, rz = norm, 0.0
        lengths: list[float] = []
        ratios: list[float] = []
        while done < iterations:
            hierarchy.cycle(r, z)
            kernels.inner(r, z, sums)
            old, rz = rz, float(sums.sum())
            energy = energy or rz
            enough = rz <= max(
                tolerance**2 * energy, (_RESIDUAL_REDUCTION * norm / given) ** 2 * energy
            )
            if not rz > 0.0 or (left <= goal and enough):
                break
            ratio = rz / old if old > 0.0 else 0.0
            kernels.direction(z, p, np.float32(ratio), ax, ay, q, sums)
            p, q = q, p
            curvature = float(sums.sum())
            if not curvature > 0.0:
                break
            kernels.advance(p, rz / curvature, ax, ay, x, r, sums)
            left = float(np.sqrt(sums.sum()))
            done += 1
            lengths.append(rz / curvature)
            ratios.append(ratio)
        if lengths:
            condition = _lanczos_condition(np.array(lengths), np.array(ratios))


def _lanczos_condition(lengths: Float64Array, ratios: Float64Array) -> float:
    """Return the condition number from the steps of conjugate gradients (Saad 2003, section 6.7).

    Parameters
    ----------
    lengths, ratios : ndarray, shape (K,)
        Length of each step, and its part of the direction before it; the first ratio is 0.
    """
    diagonal = 1.0 / lengths
    diagonal[1:] += ratios[1:] / lengths[:-1]
    values = eigvalsh_tridiagonal(diagonal, np.sqrt(ratios[1:]) / lengths[:-1])
    return float(values[-1] / values[0]) if values[0] > 0.0 else math.inf
