"""Standard error of a map's mean by its blocks, whose values are alike in neighbors.

Furrows and plateaus of skin are as long as blocks of a small patch: one block says what the next
will, and the scatter of blocks as if they were independent is too sure of the mean. So blocks are
taken for a random field of unknown strength and reach plus what each has of its own, and the error
is that of the mean of such a field (parameters integrated out; Handcock and Stein 1993,
doi:10.1080/00401706.1993.10485354).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_triangular

from reconstruction.arrays import Float64Array

CORRELATION_LENGTHS = (0.5, 1.0, 1.5, 2.0)
"""Lengths over which blocks are alike, in sides of a block; of eight blocks across a map. Fields
longer than a quarter of the map are little scatter in it: their share cannot be told from it."""
CORRELATED_FRACTIONS = (0.0, 0.3, 0.6, 0.8, 0.95)
"""Of the blocks' variance, what neighbors have in common."""
MIN_BLOCKS = 5
"""Fewer tell neither how they scatter nor how they are alike."""


def stderr_of_mean(
    values: Float64Array, sizes: Float64Array, places: Float64Array
) -> tuple[float, float]:
    """Return the standard error of the mean of all samples, and what it is of that of independents.

    Parameters
    ----------
    values : ndarray, shape (B,)
        Means of the blocks.
    sizes : ndarray, shape (B,)
        Samples of each, > 0.
    places : ndarray, shape (B, 2)
        Middles, in sides of a block.

    Returns
    -------
    stderr : float
        In the values' unit; infinite below `MIN_BLOCKS`.
    growth : float
        Variance over that of blocks that have nothing in common, at least 1; 1 below
        `MIN_BLOCKS`.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> y, x = np.mgrid[:8, :8].reshape(2, -1)
    >>> alone, growth = stderr_of_mean(rng.normal(size=64), np.ones(64), np.stack([x, y], 1))
    >>> bool(0.1 < alone < 0.17), bool(growth < 1.5)
    (True, True)
    """
    count = len(values)
    if count < MIN_BLOCKS:
        return math.inf, 1.0
    if np.ptp(values) == 0.0:
        return 0.0, 1.0
    weights = sizes / sizes.sum()
    own = np.diag(sizes.mean() / sizes)
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    logs, variances = [], []
    for reach in CORRELATION_LENGTHS:
        alike = np.exp(-((apart / reach) ** 2))
        for share in CORRELATED_FRACTIONS:
            if share == 0.0 and reach != CORRELATION_LENGTHS[0]:
                continue  # without a field its reach does not matter
            correlation = share * alike + (1.0 - share) * own
            lower = np.linalg.cholesky(correlation + 1e-9 * np.eye(count))
            both = np.column_stack([np.ones(count), values])
            one, seen = solve_triangular(lower, both, lower=True, check_finite=False).T
            information = float(one @ one)
            rest = seen - one * (one @ seen) / information
            scatter = float(rest @ rest)
            # the case without a field stands for all reaches
            log = np.log(len(CORRELATION_LENGTHS)) if share == 0.0 else 0.0
            log -= float(np.log(np.diag(lower)).sum()) + 0.5 * np.log(information)
            logs.append(log - 0.5 * (count - 1) * np.log(scatter))
            variances.append(scatter / (count - 3) * float(weights @ correlation @ weights))
    chance = np.exp(np.array(logs) - max(logs))
    variance = float(chance @ np.array(variances) / chance.sum())
    return float(np.sqrt(variance)), max(1.0, variance / variances[0])
