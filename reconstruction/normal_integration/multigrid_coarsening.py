"""Coarsen masked grids with weighted edges for a multigrid; see `multigrid_kernels`.

Coarse nodes are the fine ones of even row and column. A fine node between them takes the mean of
its coarse neighbors weighted by its own couplings, so that nothing passes over an edge
without weight (Alcouffe, Brandt, Dendy and Painter 1981, doi 10.1137/0902035; Dendy 1982,
doi 10.1016/0021-9991(82)90057-2); the coarse couplings are those of Galerkin.
"""

import numpy as np
from numba import njit, prange

_FAST_MATH = {"reassoc", "contract", "nsz", "arcp"}
EAST, SOUTH, SOUTHEAST, SOUTHWEST, INVERSE = range(5)
"""Planes of a coarse level: couplings to four of the eight neighbors, one over the diagonal."""
RIGHT_0, RIGHT_1, BELOW_0, BELOW_1, MID_00, MID_01, MID_10, MID_11 = range(8)
"""Planes of interpolation by coarse node: to the fine node right of it, below it, and between."""


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def invert_diagonal(ax, ay, inverse):  # type: ignore[no-untyped-def]
    """Write one over the sum of each node's edges, 0 for nodes without any."""
    rows, columns = ax.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    for i in prange(1, rows - 1):
        for j in range(1, columns - 1):
            total = ax[i, j] + ax[i, j - 1] + ay[i, j] + ay[i - 1, j]
            inverse[i, j] = one / total if total > zero else zero


@njit(cache=True, inline="always")
def _share(a, b):  # type: ignore[no-untyped-def]
    """Return a and b over their sum, both 0 where there is none."""
    total = max(a, np.float32(0.0)) + max(b, np.float32(0.0))
    if not total > np.float32(0.0):
        return np.float32(0.0), np.float32(0.0)
    return max(a, np.float32(0.0)) / total, max(b, np.float32(0.0)) / total


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def interpolate_edges(e, s, se, sw, inverse, diagonals, P):  # type: ignore[no-untyped-def]
    """Write the interpolation weights of fine nodes between two coarse ones.

    A node that is coupled to neither, as in a passage one pixel wide, takes the first of them
    if that is not a fine node itself: passages remain open on coarse levels.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    rows, columns = P.shape[1:]
    for row in prange(1, rows - 1):
        i = 2 * row - 1
        for column in range(1, columns - 1):
            j = 2 * column - 1
            if j + 1 < inverse.shape[1] - 1 and inverse[i, j + 1] > zero:
                k = j + 1
                west, east = e[i, k - 1], e[i, k]
                if diagonals:
                    west += se[i - 1, k - 1] + sw[i, k]
                    east += sw[i - 1, k + 1] + se[i, k]
                first, second = _share(west, east)
                if first + second == zero:
                    if inverse[i, j] == zero:
                        first = one
                    elif j + 2 < inverse.shape[1] - 1 and inverse[i, j + 2] == zero:
                        second = one
                P[RIGHT_0, row, column], P[RIGHT_1, row, column] = first, second
            if i + 1 < inverse.shape[0] - 1 and inverse[i + 1, j] > zero:
                k = i + 1
                north, south = s[k - 1, j], s[k, j]
                if diagonals:
                    north += se[k - 1, j - 1] + sw[k - 1, j + 1]
                    south += sw[k, j] + se[k, j]
                first, second = _share(north, south)
                if first + second == zero:
                    if inverse[i, j] == zero:
                        first = one
                    elif i + 2 < inverse.shape[0] - 1 and inverse[i + 2, j] == zero:
                        second = one
                P[BELOW_0, row, column], P[BELOW_1, row, column] = first, second


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def interpolate_middles(e, s, se, sw, inverse, diagonals, P):  # type: ignore[no-untyped-def]
    """Write the weights of fine nodes between four coarse ones, through their neighbors'."""
    zero, one = np.float32(0.0), np.float32(1.0)
    rows, columns = P.shape[1:]
    for row in prange(1, rows - 1):
        i = 2 * row
        if i >= inverse.shape[0] - 1:
            continue
        for column in range(1, columns - 1):
            j = 2 * column
            if j >= inverse.shape[1] - 1 or not inverse[i, j] > zero:
                continue
            west, east = max(e[i, j - 1], zero), max(e[i, j], zero)
            north, south = max(s[i - 1, j], zero), max(s[i, j], zero)
            # neighbors without weight from a coarse node cannot pass its value on
            if P[BELOW_0, row, column] + P[BELOW_1, row, column] == zero:
                west = zero
            if P[BELOW_0, row, column + 1] + P[BELOW_1, row, column + 1] == zero:
                east = zero
            if P[RIGHT_0, row, column] + P[RIGHT_1, row, column] == zero:
                north = zero
            if P[RIGHT_0, row + 1, column] + P[RIGHT_1, row + 1, column] == zero:
                south = zero
            # solve the middle node's equation for it, with its four neighbors interpolated already
            w00 = west * P[BELOW_0, row, column] + north * P[RIGHT_0, row, column]
            w10 = west * P[BELOW_1, row, column] + south * P[RIGHT_0, row + 1, column]
            w01 = east * P[BELOW_0, row, column + 1] + north * P[RIGHT_1, row, column]
            w11 = east * P[BELOW_1, row, column + 1] + south * P[RIGHT_1, row + 1, column]
            if diagonals:
                w00 += max(se[i - 1, j - 1], zero)
                w01 += max(sw[i - 1, j + 1], zero)
                w10 += max(sw[i, j], zero)
                w11 += max(se[i, j], zero)
            total = w00 + w01 + w10 + w11
            if total > zero:
                per = one / total
                P[MID_00, row, column] = w00 * per
                P[MID_01, row, column] = w01 * per
                P[MID_10, row, column] = w10 * per
                P[MID_11, row, column] = w11 * per


@njit(cache=True, inline="always")
def _column(P, inverse, row, column, p):  # type: ignore[no-untyped-def]
    """Write the interpolation weights of a coarse node to the nine fine nodes around it."""
    p[1, 1] = 1.0 if inverse[2 * row - 1, 2 * column - 1] > 0.0 else 0.0
    p[1, 2] = P[RIGHT_0, row, column]
    p[1, 0] = P[RIGHT_1, row, column - 1]
    p[2, 1] = P[BELOW_0, row, column]
    p[0, 1] = P[BELOW_1, row - 1, column]
    p[2, 2] = P[MID_00, row, column]
    p[2, 0] = P[MID_01, row, column - 1]
    p[0, 2] = P[MID_10, row - 1, column]
    p[0, 0] = P[MID_11, row - 1, column - 1]


@njit(cache=True, parallel=True, fastmath=_FAST_MATH)
def coarsen(e, s, se, sw, inverse, diagonals, P, coarse):  # type: ignore[no-untyped-def]
    """Write the coarse couplings P^T A P: its planes `EAST` ... `INVERSE`."""
    rows, columns = P.shape[1:]
    for row in prange(1, rows - 1):
        p = np.zeros((3, 3))
        q = np.zeros((3, 3))
        y = np.zeros((5, 5))
        for column in range(1, columns - 1):
            _column(P, inverse, row, column, p)
            if p[1, 1] == 0.0 and p.sum() == 0.0:
                continue
            y[:] = 0.0
            for a in range(3):
                for b in range(3):
                    value = p[a, b]
                    if value == 0.0:
                        continue
                    i, j = 2 * row - 2 + a, 2 * column - 2 + b
                    y[a + 1, b + 1] += value / inverse[i, j]
                    y[a + 1, b + 2] -= value * e[i, j]
                    y[a + 1, b] -= value * e[i, j - 1]
                    y[a + 2, b + 1] -= value * s[i, j]
                    y[a, b + 1] -= value * s[i - 1, j]
                    if diagonals:
                        y[a + 2, b + 2] -= value * se[i, j]
                        y[a, b] -= value * se[i - 1, j - 1]
                        y[a + 2, b] -= value * sw[i, j]
                        y[a, b + 2] -= value * sw[i - 1, j + 1]
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += p[a, b] * y[a + 1, b + 1]
            coarse[INVERSE, row, column] = 1.0 / total if total > 0.0 else 0.0
            if column + 1 < columns - 1:
                _column(P, inverse, row, column + 1, q)
                total = 0.0
                for a in range(3):
                    total += q[a, 0] * y[a + 1, 3] + q[a, 1] * y[a + 1, 4]
                coarse[EAST, row, column] = -total
            if row + 1 < rows - 1:
                _column(P, inverse, row + 1, column, q)
                total = 0.0
                for b in range(3):
                    total += q[0, b] * y[3, b + 1] + q[1, b] * y[4, b + 1]
                coarse[SOUTH, row, column] = -total
                if column + 1 < columns - 1:
                    _column(P, inverse, row + 1, column + 1, q)
                    coarse[SOUTHEAST, row, column] = -(
                        q[0, 0] * y[3, 3]
                        + q[0, 1] * y[3, 4]
                        + q[1, 0] * y[4, 3]
                        + q[1, 1] * y[4, 4]
                    )
                if column > 1:
                    _column(P, inverse, row + 1, column - 1, q)
                    coarse[SOUTHWEST, row, column] = -(
                        q[0, 2] * y[3, 1]
                        + q[0, 1] * y[3, 0]
                        + q[1, 2] * y[4, 1]
                        + q[1, 1] * y[4, 0]
                    )
