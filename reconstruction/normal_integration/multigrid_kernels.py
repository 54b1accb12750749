"""Multigrid on masked grids with weighted edges: the inner loops of `weighted_poisson`.

A level is a grid of unknowns with an empty border of one node all around, so that node (i, j) of
the grid is at [i + 1, j + 1]. The finest level couples each node to four neighbors by the
weights of its edges (nodes outside the mask have no edges), coarser ones to eight, see
`multigrid_coarsening`.

Smoothing is Gauss-Seidel in colors, whose result does not depend on threads; after the last
color of a sweep its residuals are zero, which restriction uses. Sums are kept by rows in
float64 and added in order. Kernels with ``parallel=True`` are called from one thread.
"""

import numpy as np
from numba import njit, prange

from reconstruction.normal_integration.multigrid_coarsening import (
    BELOW_0,
    BELOW_1,
    EAST,
    INVERSE,
    MID_00,
    MID_01,
    MID_10,
    MID_11,
    RIGHT_0,
    RIGHT_1,
    SOUTH,
    SOUTHEAST,
    SOUTHWEST,
)

_FAST_MATH = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def smooth_from_zero(ax, ay, inverse, b, x):  # type: ignore[no-untyped-def]
    """Write one sweep from x = 0 on the finest level: even nodes (i + j even), then odd ones."""
    rows, columns = b.shape
    for i in prange(1, rows - 1):
        for j in range(1, columns - 1):
            x[i, j] = b[i, j] * inverse[i, j]
        for j in range(2 - (i + 1) % 2, columns - 1, 2):
            x[i, j] = inverse[i, j] * (
                b[i, j]
                + ax[i, j] * (b[i, j + 1] * inverse[i, j + 1])
                + ax[i, j - 1] * (b[i, j - 1] * inverse[i, j - 1])
                + ay[i, j] * (b[i + 1, j] * inverse[i + 1, j])
                + ay[i - 1, j] * (b[i - 1, j] * inverse[i - 1, j])
            )


@njit(cache=True, inline="always")
def _even_residual(ax, ay, inverse, b, x, i, r):  # type: ignore[no-untyped-def]
    """Write b - A x of the even nodes of row i; the diagonal is summed as in A."""
    for j in range(1 + (i + 1) % 2, b.shape[1] - 1, 2):
        r[j] = (
            b[i, j]
            + ax[i, j] * (x[i, j + 1] - x[i, j])
            + ax[i, j - 1] * (x[i, j - 1] - x[i, j])
            + ay[i, j] * (x[i + 1, j] - x[i, j])
            + ay[i - 1, j] * (x[i - 1, j] - x[i, j])
        )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def restrict_even(ax, ay, inverse, b, x, P, out):  # type: ignore[no-untyped-def]
    """Write P^T (b - A x) of the finest level, whose odd nodes have no residual."""
    rows, columns = out.shape
    for row in prange(1, rows - 1):
        above = np.zeros(b.shape[1], np.float32)
        here = np.zeros(b.shape[1], np.float32)
        below = np.zeros(b.shape[1], np.float32)
        i = 2 * row - 1
        if i > 1:
            _even_residual(ax, ay, inverse, b, x, i - 1, above)
        _even_residual(ax, ay, inverse, b, x, i, here)
        if i + 1 < b.shape[0] - 1:
            _even_residual(ax, ay, inverse, b, x, i + 1, below)
        for column in range(1, columns - 1):
            j = 2 * column - 1
            out[row, column] = (
                here[j]
                + P[MID_00, row, column] * below[j + 1]
                + P[MID_01, row, column - 1] * below[j - 1]
                + P[MID_10, row - 1, column] * above[j + 1]
                + P[MID_11, row - 1, column - 1] * above[j - 1]
            )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def prolong_even(P, coarse, inverse, x):  # type: ignore[no-untyped-def]
    """Add the coarse correction to the even nodes of the finest level."""
    rows, columns = coarse.shape
    for row in prange(1, rows - 1):
        i = 2 * row - 1
        for column in range(1, columns - 1):
            if inverse[i, 2 * column - 1] > np.float32(0.0):
                x[i, 2 * column - 1] += coarse[row, column]
        if i + 1 < x.shape[0] - 1:
            for column in range(1, columns - 1):
                if 2 * column < x.shape[1] - 1:
                    x[i + 1, 2 * column] += (
                        P[MID_00, row, column] * coarse[row, column]
                        + P[MID_01, row, column] * coarse[row, column + 1]
                        + P[MID_10, row, column] * coarse[row + 1, column]
                        + P[MID_11, row, column] * coarse[row + 1, column + 1]
                    )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def smooth(ax, ay, inverse, b, x, odd):  # type: ignore[no-untyped-def]
    """Solve the equation of each node of one color of the finest level: odd 1 or 0."""
    rows, columns = b.shape
    for i in prange(1, rows - 1):
        for j in range(1 + (i + 1 + odd) % 2, columns - 1, 2):
            x[i, j] = inverse[i, j] * (
                b[i, j]
                + ax[i, j] * x[i, j + 1]
                + ax[i, j - 1] * x[i, j - 1]
                + ay[i, j] * x[i + 1, j]
                + ay[i - 1, j] * x[i - 1, j]
            )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def smooth_coarse(A, b, x, first_row, first_column):  # type: ignore[no-untyped-def]
    """Solve the equations of two colors of a coarse level: every second row, both its colors.

    ``first_row``: 1 or 2; the color of columns ``first_column``: 1 or 2 comes first.
    """
    rows, columns = b.shape
    e, s, se, sw, inverse = A[EAST], A[SOUTH], A[SOUTHEAST], A[SOUTHWEST], A[INVERSE]
    for half in prange((rows - 1 - first_row + 1) // 2):
        i = first_row + 2 * half
        for colour in range(2):
            start = first_column if colour == 0 else 3 - first_column
            for j in range(start, columns - 1, 2):
                x[i, j] = inverse[i, j] * (
                    b[i, j]
                    + e[i, j] * x[i, j + 1]
                    + e[i, j - 1] * x[i, j - 1]
                    + s[i, j] * x[i + 1, j]
                    + s[i - 1, j] * x[i - 1, j]
                    + se[i, j] * x[i + 1, j + 1]
                    + se[i - 1, j - 1] * x[i - 1, j - 1]
                    + sw[i, j] * x[i + 1, j - 1]
                    + sw[i - 1, j + 1] * x[i - 1, j + 1]
                )


@njit(cache=True, inline="always")
def _coarse_residual(A, b, x, i, r):  # type: ignore[no-untyped-def]
    """Write b - A x of row i of a coarse level."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for j in range(1, b.shape[1] - 1):
        inverse = A[INVERSE, i, j]
        held = b[i, j] - x[i, j] / inverse if inverse > zero else zero
        r[j] = (
            held
            + A[EAST, i, j] * x[i, j + 1]
            + A[EAST, i, j - 1] * x[i, j - 1]
            + A[SOUTH, i, j] * x[i + 1, j]
            + A[SOUTH, i - 1, j] * x[i - 1, j]
            + A[SOUTHEAST, i, j] * x[i + 1, j + 1]
            + A[SOUTHEAST, i - 1, j - 1] * x[i - 1, j - 1]
            + A[SOUTHWEST, i, j] * x[i + 1, j - 1]
            + A[SOUTHWEST, i - 1, j + 1] * x[i - 1, j + 1]
        ) * (one if inverse > zero else zero)


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def restrict(A, b, x, P, out):  # type: ignore[no-untyped-def]
    """Write P^T (b - A x) of a coarse level, whose middle nodes have no residual."""
    rows, columns = out.shape
    for row in prange(1, rows - 1):
        above = np.zeros(b.shape[1], np.float32)
        here = np.zeros(b.shape[1] + 1, np.float32)
        below = np.zeros(b.shape[1], np.float32)
        i = 2 * row - 1
        if i > 1:
            _coarse_residual(A, b, x, i - 1, above)
        _coarse_residual(A, b, x, i, here)
        if i + 1 < b.shape[0] - 1:
            _coarse_residual(A, b, x, i + 1, below)
        for column in range(1, columns - 1):
            j = 2 * column - 1
            out[row, column] = (
                here[j]
                + P[RIGHT_0, row, column] * here[j + 1]
                + P[RIGHT_1, row, column - 1] * here[j - 1]
                + P[BELOW_0, row, column] * below[j]
                + P[BELOW_1, row - 1, column] * above[j]
            )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def prolong(P, coarse, A, x):  # type: ignore[no-untyped-def]
    """Add the correction to a level's coarse nodes and to those between two of them."""
    rows, columns = coarse.shape
    for row in prange(1, rows - 1):
        i = 2 * row - 1
        for column in range(1, columns - 1):
            j = 2 * column - 1
            if A[INVERSE, i, j] > np.float32(0.0):
                x[i, j] += coarse[row, column]
            if j + 1 < x.shape[1] - 1:
                x[i, j + 1] += (
                    P[RIGHT_0, row, column] * coarse[row, column]
                    + P[RIGHT_1, row, column] * coarse[row, column + 1]
                )
            if i + 1 < x.shape[0] - 1:
                x[i + 1, j] += (
                    P[BELOW_0, row, column] * coarse[row, column]
                    + P[BELOW_1, row, column] * coarse[row + 1, column]
                )


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def direction(z, p, beta, ax, ay, out, sums):  # type: ignore[no-untyped-def]
    """Write out = z + beta p and, by rows, out . A out; return nothing."""
    rows, columns = z.shape
    for i in prange(1, rows - 1):
        total = 0.0
        for j in range(1, columns - 1):
            here = z[i, j] + beta * p[i, j]
            out[i, j] = here
            east = here - (z[i, j + 1] + beta * p[i, j + 1])
            south = here - (z[i + 1, j] + beta * p[i + 1, j])
            total += np.float64(ax[i, j] * east * east + ay[i, j] * south * south)
        sums[i] = total


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def advance(p, alpha, ax, ay, x, r, sums):  # type: ignore[no-untyped-def]
    """Add alpha p to x (float64), take alpha A p from r; write r . r by rows."""
    rows, columns = p.shape
    for i in prange(1, rows - 1):
        total = 0.0
        for j in range(1, columns - 1):
            here = np.float64(p[i, j])
            Ap = (
                ax[i, j] * (here - p[i, j + 1])
                + ax[i, j - 1] * (here - p[i, j - 1])
                + ay[i, j] * (here - p[i + 1, j])
                + ay[i - 1, j] * (here - p[i - 1, j])
            )
            x[i, j] += alpha * here
            left = r[i, j] - alpha * Ap
            r[i, j] = left
            total += left * left
        sums[i] = total


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def inner(a, b, sums):  # type: ignore[no-untyped-def]
    """Write a . b by rows."""
    rows, columns = a.shape
    for i in prange(1, rows - 1):
        total = 0.0
        for j in range(1, columns - 1):
            total += np.float64(a[i, j]) * np.float64(b[i, j])
        sums[i] = total


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def residual(ax, ay, dx, dy, x, r, sums):  # type: ignore[no-untyped-def]
    """Write r = D^T a (d - D x) in float64 arithmetic; sums: its squares, and those of D^T a d."""
    rows, columns = x.shape
    for i in prange(1, rows - 1):
        total, given = 0.0, 0.0
        for j in range(1, columns - 1):
            east, west = np.float64(ax[i, j]), np.float64(ax[i, j - 1])
            south, north = np.float64(ay[i, j]), np.float64(ay[i - 1, j])
            b = west * dx[i, j - 1] - east * dx[i, j] + north * dy[i - 1, j] - south * dy[i, j]
            here = x[i, j]
            left = b - (
                east * (here - x[i, j + 1])
                + west * (here - x[i, j - 1])
                + south * (here - x[i + 1, j])
                + north * (here - x[i - 1, j])
            )
            r[i, j] = left
            total += left * left
            given += b * b
        sums[0, i] = total
        sums[1, i] = given
