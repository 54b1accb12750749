"""Blocks that a map of normals is cut into, whose differences tell the noise of its statistics."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Float64Array, FloatArray, Int64Array
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.block_errors import stderr_of_mean
from reconstruction.normal_histogram.counting import HistogramError, check_buckets
from reconstruction.normal_histogram.relief_slopes import slopes, turned

BLOCKS_PER_SIDE = 8
"""A map is cut into so many blocks a side."""


def grid_of(shape: tuple[int, int], blocks: int) -> tuple[int, int]:
    """Return into how many rows and columns of blocks `block_of` cuts a map of (H, W) pixels.

    Examples
    --------
    >>> grid_of((1000, 20), 8)
    (8, 5)
    """
    return max(1, min(blocks, shape[0] // 4)), max(1, min(blocks, shape[1] // 4))


def block_of(places: Int64Array, shape: tuple[int, int], blocks: int) -> tuple[Int64Array, int]:
    """Return the block of pixels ``y * W + x``, and how many blocks there are.

    A map is cut into ``blocks`` along each axis, fewer where they would be below 4 pixels.
    """
    down, across = grid_of(shape, blocks)
    y, x = np.divmod(places, shape[1])
    return y * down // shape[0] * across + x * across // shape[1], down * across


def block_counts(
    height: ArrayLike,
    block: Int64Array,
    blocks: int,
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    y_up: bool = True,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Int64Array:
    """Count a relief's normals by blocks of any shape, as of another map of the same skin.

    Parameters
    ----------
    height, pixel, bins, limit, y_up, valid, angle_rad
        As of `normal_histogram.histogram`.
    block : ndarray of int, shape (H, W)
        Of each pixel, 0 to `blocks` - 1; pixels with another number are left out.
    blocks : int
        At least 1.

    Returns
    -------
    ndarray of int64, shape (blocks, bins, bins)
        Axes (n_y, n_x) of each; normals beyond the limit are left out.

    Raises
    ------
    HistogramError
        For a map of blocks of another shape, and as of `normal_histogram.histogram`.
    """
    check_buckets(bins, limit)
    if block.shape != np.shape(height) or blocks < 1:
        raise HistogramError(
            f"block: got shape {block.shape} and {blocks} blocks, expected {np.shape(height)} and "
            "at least 1"
        )
    a, b, known = slopes(height, pixel=pixel, y_up=y_up, valid=valid)
    known = known & (block >= 0) & (block < blocks)
    a, b = turned(a[known], b[known], angle_rad)
    group = np.asarray(block[known], np.int64)
    counts = kernels.count_in_groups(a, b, group, blocks, bins, float(limit))
    return np.asarray(counts[:, :-1], np.int64).reshape(blocks, bins, bins)


def residuals_of(counts: Float64Array) -> Float64Array:
    """Return what each block adds to the error of the shares that all have in common.

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
    >>> residuals_of(np.array([[3.0, 1.0], [1.0, 3.0]]))
    array([[ 0.125, -0.125],
           [-0.125,  0.125]])
    """
    sizes = counts.sum(axis=1)
    common = counts.sum(axis=0) / sizes.sum()
    return np.asarray((counts - sizes[:, None] * common) / sizes.sum())


def effective_number(counts: Float64Array, samples: int) -> float:
    """Return how many independent samples would make blocks differ as much as they do.

    Parameters
    ----------
    counts : ndarray, shape (blocks, buckets)
        Of each block.
    samples : int
        Of all, which is also the most that is returned.

    Returns
    -------
    float
        ``sum p (1 - p) / sum var(p)`` with the variance of each bucket's share by a jackknife over
        blocks; `samples` where there are fewer than two blocks with samples.
    """
    sizes = counts.sum(axis=1)
    counts, sizes = counts[sizes > 0], sizes[sizes > 0]
    n = len(sizes)
    if n < 2:
        return float(samples)
    p = counts.sum(axis=0) / sizes.sum()
    residual = residuals_of(counts)
    variance = n / (n - 1) * float(np.sum(residual * residual))
    spread = float(np.sum(p * (1.0 - p)))
    if variance <= 0 or spread <= 0:
        return float(samples)
    return float(np.clip(spread / variance, 1.0, samples))


def block_error(
    values: FloatArray, group: Int64Array, groups: int, shape: tuple[int, int], blocks: int
) -> tuple[float, float]:
    """Return the standard error of a mean of samples of a map, by its blocks.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Of the samples, any unit.
    group, groups, shape, blocks
        Of `block_of`.

    Returns
    -------
    stderr : float
        In the unit of the values.
    growth : float
        As of `reconstruction.normal_histogram.block_errors.stderr_of_mean`.
    """
    sizes = np.bincount(group, minlength=groups).astype(np.float64)
    some = np.flatnonzero(sizes > 0)
    means = np.bincount(group, values, groups)[some] / sizes[some]
    _, across = grid_of(shape, blocks)
    places = np.stack(np.divmod(some, across), axis=1).astype(np.float64)
    return stderr_of_mean(means, sizes[some], places)
