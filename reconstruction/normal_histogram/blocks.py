"""Divide a map of normals into blocks, whose differences give the noise of its statistics.

Grooves and plateaus of skin are as long as blocks of a small patch: adjacent blocks correlate, and
the scatter of blocks taken as independent underestimates the error of the mean. So blocks are
modeled as a random field of unknown strength and reach plus independent errors, and the error
is that of the mean of such a field (parameters integrated out; Handcock and Stein 1993,
doi:10.1080/00401706.1993.10485354).
"""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular

from model.checks import Checks
from reconstruction.arrays import Float64Array, FloatArray, Int64Array
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.counting import check_buckets
from reconstruction.normal_histogram.relief_slopes import HistogramError, rotate_components, slopes

BLOCKS_PER_SIDE = 8
"""Number of blocks per side of a map."""
CORRELATION_LENGTHS = (0.5, 1.0, 1.5, 2.0)
"""Candidate correlation lengths, in sides of a block; of eight blocks across a map. Fields longer
than a quarter of the map hardly scatter in it, so that their fraction is not identifiable."""
CORRELATED_FRACTIONS = (0.0, 0.3, 0.6, 0.8, 0.95)
"""Candidate fractions of the blocks' variance that neighbors share."""
MIN_BLOCKS = 5
"""Fewest blocks from which scatter and correlation can be estimated."""


def block_grid_shape(shape: tuple[int, ...], blocks: int = BLOCKS_PER_SIDE) -> tuple[int, int]:
    """Return the rows and columns of blocks into which `assign_blocks` divides (H, W) pixels.

    Examples
    --------
    >>> block_grid_shape((1000, 20), 8)
    (8, 5)
    """
    return max(1, min(blocks, shape[0] // 4)), max(1, min(blocks, shape[1] // 4))


def assign_blocks(
    pixel_indices: Int64Array, shape: tuple[int, ...], blocks: int = BLOCKS_PER_SIDE
) -> tuple[Int64Array, int]:
    """Return the block of each pixel ``y * W + x``, and the number of blocks.

    A map has ``blocks`` along each axis, fewer where they would be below 4 pixels.
    """
    down, across = block_grid_shape(shape, blocks)
    y, x = np.divmod(pixel_indices, shape[1])
    return y * down // shape[0] * across + x * across // shape[1], down * across


def count_block_normals(
    height: ArrayLike,
    block: Int64Array,
    blocks: int,
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Int64Array:
    """Count a relief's normals by blocks of any shape, e.g. of another map of the same skin.

    Parameters
    ----------
    height, pixel, bins, limit, valid, angle_rad
        As of `normal_histogram.histogram`.
    block : ndarray of int, shape (H, W)
        Of each pixel, 0 to `blocks` - 1; pixels with another number are omitted.
    blocks : int
        At least 1.

    Returns
    -------
    ndarray of int64, shape (blocks, bins, bins)
        Axes (n_y, n_x) of each; normals beyond the limit are omitted.

    Raises
    ------
    HistogramError
        For a map of blocks of another shape, and as in `normal_histogram.histogram`.
    """
    check_buckets(bins, limit)
    Checks(HistogramError).shape("block", block, np.shape(height))
    Checks(HistogramError).within("blocks", blocks, "[1, inf)")
    a, b, known = slopes(height, pixel=pixel, valid=valid)
    known = known & (block >= 0) & (block < blocks)
    a, b = rotate_components(a[known], b[known], angle_rad)
    group = np.asarray(block[known], np.int64)
    counts = kernels.count_in_groups(a, b, group, blocks, bins, float(limit))
    return np.asarray(counts[:, :-1], np.int64).reshape(blocks, bins, bins)


def block_residuals(counts: Float64Array) -> Float64Array:
    """Return each block's contribution to the error of the common bucket fractions.

    Parameters
    ----------
    counts : ndarray, shape (blocks, buckets)
        Of each block; no count in a block adds nothing.

    Returns
    -------
    ndarray of float64, shape (blocks, buckets)
        To first order of a ratio of sums; they sum to 0 over blocks.

    Examples
    --------
    >>> block_residuals(np.array([[3.0, 1.0], [1.0, 3.0]]))
    array([[ 0.125, -0.125],
           [-0.125,  0.125]])
    """
    sizes = counts.sum(axis=1)
    common = counts.sum(axis=0) / sizes.sum()
    return np.asarray((counts - sizes[:, None] * common) / sizes.sum())


def effective_sample_count(counts: Float64Array, samples: int) -> float:
    """Return the number of independent samples with the same differences between blocks.

    Parameters
    ----------
    counts : ndarray, shape (blocks, buckets)
        Of each block.
    samples : int
        Number of all samples, the upper bound of the result.

    Returns
    -------
    float
        ``sum p (1 - p) / sum var(p)`` with the variance of each bucket's fraction by a jackknife
        over blocks; `samples` with fewer than two blocks with samples.
    """
    sizes = counts.sum(axis=1)
    counts, sizes = counts[sizes > 0], sizes[sizes > 0]
    n = len(sizes)
    if n < 2:
        return float(samples)
    p = counts.sum(axis=0) / sizes.sum()
    residual = block_residuals(counts)
    variance = n / (n - 1) * float(np.sum(residual * residual))
    spread = float(np.sum(p * (1.0 - p)))
    if variance <= 0 or spread <= 0:
        return float(samples)
    return float(np.clip(spread / variance, 1.0, samples))


def mean_stderr(
    values: Float64Array, sizes: Float64Array, positions: Float64Array
) -> tuple[float, float]:
    """Return the standard error of the mean of all samples, and its inflation by correlation.

    Parameters
    ----------
    values : ndarray, shape (B,)
        Means of the blocks.
    sizes : ndarray, shape (B,)
        Samples of each, > 0.
    positions : ndarray, shape (B, 2)
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
    >>> alone, growth = mean_stderr(rng.normal(size=64), np.ones(64), np.stack([x, y], 1))
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
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    logs, variances = [], []
    for reach in CORRELATION_LENGTHS:
        alike = np.exp(-((apart / reach) ** 2))
        for share in CORRELATED_FRACTIONS:
            if share == 0.0 and reach != CORRELATION_LENGTHS[0]:
                continue  # a field of strength 0 has no length
            correlation = share * alike + (1.0 - share) * own
            lower = np.linalg.cholesky(correlation + 1e-9 * np.eye(count))
            both = np.column_stack([np.ones(count), values])
            one, seen = solve_triangular(lower, both, lower=True, check_finite=False).T
            information = float(one @ one)
            rest = seen - one * (one @ seen) / information
            scatter = float(rest @ rest)
            # strength 0 occurs once but represents all lengths: equal prior weight
            log = np.log(len(CORRELATION_LENGTHS)) if share == 0.0 else 0.0
            log -= float(np.log(np.diag(lower)).sum()) + 0.5 * np.log(information)
            logs.append(log - 0.5 * (count - 1) * np.log(scatter))
            variances.append(scatter / (count - 3) * float(weights @ correlation @ weights))
    chance = np.exp(np.array(logs) - max(logs))
    variance = float(chance @ np.array(variances) / chance.sum())
    return float(np.sqrt(variance)), max(1.0, variance / variances[0])


def block_mean_stderr(
    values: FloatArray,
    group: Int64Array,
    groups: int,
    shape: tuple[int, ...],
    blocks: int = BLOCKS_PER_SIDE,
) -> tuple[float, float]:
    """Return the standard error of a mean of samples of a map, by its blocks.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Of the samples, any unit.
    group, groups, shape, blocks
        Of `assign_blocks`.

    Returns
    -------
    stderr : float
        In the unit of the values.
    growth : float
        As of :func:`mean_stderr`.
    """
    sizes = np.bincount(group, minlength=groups).astype(np.float64)
    some = np.flatnonzero(sizes > 0)
    means = np.bincount(group, values, groups)[some] / sizes[some]
    _, across = block_grid_shape(shape, blocks)
    places = np.stack(np.divmod(some, across), axis=1).astype(np.float64)
    return mean_stderr(means, sizes[some], places)
