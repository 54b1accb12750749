"""Project signed mixtures to the nearest non-negative ones (active sets), compiled.

Active sets through the materials' matrix of products (Lawson and Hanson 1974, Solving Least Squares
Problems, chapter 23), started from the positive weights.
"""

# mypy: allow-untyped-defs

import logging
import math

import numpy as np
from numba import njit, prange

from model.arrays import Float64Array

_log = logging.getLogger(__name__)

INDEPENDENCE_TOL = 1e-12
"""A material is dependent, and not used, if its residual on those in use is below this fraction of
its square."""
JOIN_TOL = 1e-10
"""A material is added while it reduces the misfit by more than this fraction of the mixture."""
BLOCK_ROWS = 512  # rows per block of working memory


def nearest_mixtures(gram: Float64Array, wanted: Float64Array) -> Float64Array:
    """Return the nearest non-negative mixtures x, which minimize (x - t)' G (x - t).

    Parameters
    ----------
    gram : ndarray, shape (K, K)
        Products of the materials, symmetric and positive semidefinite.
    wanted : ndarray, shape (T, K)
        The mixtures t. Rows without a negative weight are returned unchanged.

    Returns
    -------
    ndarray of float64, shape (T, K)
        A warning counts the rows whose active sets ended at their largest number of steps.

    Examples
    --------
    >>> nearest_mixtures(np.array([[1.0, 0.8], [0.8, 1.0]]), np.array([[1.0,
    ...     -0.5]])).round(6).tolist()
    [[0.6, 0.0]]
    """
    out = np.array(wanted, np.float64, order="C")
    beyond = np.flatnonzero((out < 0.0).any(axis=1))
    if len(beyond):
        rows = np.ascontiguousarray(out[beyond])
        unfinished = _solve_rows(np.ascontiguousarray(gram, np.float64), rows)
        if unfinished:
            _log.warning(
                "nearest mixtures: %d of %d reached the largest number of steps; the result is the "
                "last step",
                unfinished,
                len(rows),
            )
        out[beyond] = rows
    return out


@njit(cache=True, nogil=True)
def _factor(gram, active, used, low):
    """Fill the Cholesky factor of the active rows; return the first dependent one, or -1."""
    for i in range(used):
        for j in range(i + 1):
            s = gram[active[i], active[j]]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            if i == j:
                if s <= INDEPENDENCE_TOL * gram[active[i], active[i]]:
                    return i
                low[i, i] = math.sqrt(s)
            else:
                low[i, j] = s / low[j, j]
    return -1


@njit(cache=True, nogil=True)
def _back(low, used, y):
    """Solve low low' y = y in place."""
    for i in range(used):
        for k in range(i):
            y[i] -= low[i, k] * y[k]
        y[i] /= low[i, i]
    for i in range(used - 1, -1, -1):
        for k in range(i + 1, used):
            y[i] -= low[k, i] * y[k]
        y[i] /= low[i, i]


@njit(cache=True, nogil=True)
def _solve_row(gram, t, x, rhs, active, low, y, refused):
    """Fill x; return whether its misfit cannot be reduced by another material."""
    size = len(t)
    norm = 0.0
    for p in range(size):
        s = 0.0
        for q in range(size):
            s += gram[p, q] * t[q]
        rhs[p] = s
        norm += s * t[p]
    norm = math.sqrt(max(norm, 0.0))
    used = 0
    for p in range(size):
        x[p] = max(t[p], 0.0)
        refused[p] = gram[p, p] <= 0.0
        if x[p] > 0.0 and not refused[p]:
            active[used] = p
            used += 1
    entering = -1
    for _ in range(6 * size + 6):
        while used > 0:
            gone = _factor(gram, active, used, low)
            if gone >= 0:
                refused[active[gone]] = True
            else:
                for i in range(used):
                    y[i] = rhs[active[i]]
                _back(low, used, y)
                reach = 1.0
                for i in range(used):
                    if y[i] <= 0.0:
                        now = x[active[i]]
                        part = now / (now - y[i]) if now > 0.0 else 0.0
                        if gone < 0 or part < reach:
                            gone, reach = i, part
                for i in range(used):
                    p = active[i]
                    x[p] = max(x[p] + reach * (y[i] - x[p]), 0.0)
                if gone < 0:
                    break
                if active[gone] == entering:
                    refused[entering] = (
                        True  # added and removed at once: exclude it, which prevents cycling
                    )
            x[active[gone]] = 0.0
            used -= 1
            for i in range(gone, used):
                active[i] = active[i + 1]
        best, entering = JOIN_TOL * norm, -1
        for p in range(size):
            if x[p] == 0.0 and not refused[p]:
                gain = rhs[p]
                for i in range(used):
                    gain -= gram[p, active[i]] * x[active[i]]
                gain /= math.sqrt(gram[p, p])
                if gain > best:
                    best, entering = gain, p
        if entering < 0:
            return True
        active[used] = entering
        used += 1
    return False


@njit(parallel=True, cache=True)
def _solve_rows(gram, rows):
    count, size = rows.shape
    unfinished = 0
    for block in prange((count + BLOCK_ROWS - 1) // BLOCK_ROWS):
        x, rhs, y = np.empty(size), np.empty(size), np.empty(size)
        active = np.empty(size, np.int64)
        low = np.empty((size, size))
        refused = np.empty(size, np.bool_)
        for row in range(block * BLOCK_ROWS, min((block + 1) * BLOCK_ROWS, count)):
            if not _solve_row(gram, rows[row], x, rhs, active, low, y, refused):
                unfinished += 1
            for p in range(size):
                rows[row, p] = x[p]
    return unfinished
