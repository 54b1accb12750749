"""Bootstrap intervals of errors: medians over independent items, root mean squares over tiles."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from model import metrics
from skinrig.arrays import BoolArray, FloatArray
from skinrig.benchmarks.results import ErrorEstimate

N_BOOTSTRAP_DRAWS = 200
TILE_PX = 16


def median_error(
    values: ArrayLike, bound: float | None = None, *, rng: np.random.Generator | None = None
) -> ErrorEstimate:
    """Return the median of independent errors with its 68 % bootstrap interval.

    Parameters
    ----------
    values
        Absolute errors, any shape; NaN are omitted.
    bound
        Least median error of an unbiased estimator.
    rng
        Generator of the bootstrap; None: one of seed 0.

    Examples
    --------
    >>> median_error([1.0, 2.0, 3.0]).error
    2.0
    """
    rng = rng or np.random.default_rng(0)
    return ErrorEstimate(*metrics.median_with_interval(values, rng=rng), bound)


def mean_error(values: ArrayLike) -> ErrorEstimate:
    """Return the mean of independent errors plus and minus its standard error.

    Examples
    --------
    >>> mean_error([1.0, 3.0]).error_interval
    (1.0, 3.0)
    """
    sizes = np.asarray(values, np.float64).ravel()
    mean = float(sizes.mean())
    half = float(sizes.std(ddof=1) / np.sqrt(sizes.size)) if sizes.size > 1 else float("nan")
    return ErrorEstimate(mean, (mean - half, mean + half))


def bootstrap_interval(
    values: ArrayLike,
    statistic: Callable[..., Any] = np.median,
    *,
    draws: int = N_BOOTSTRAP_DRAWS,
    rng: np.random.Generator | None = None,
) -> tuple[float, float]:
    """Return the 68 % bootstrap interval of a statistic of independent values, (n,).

    Parameters
    ----------
    values
        At least one.
    statistic
        Called with draws (draws, n) and ``axis=1``.
    draws
        Number of bootstrap samples of n values each.
    rng
        Generator of the bootstrap; None: one of seed 0.

    Examples
    --------
    >>> bootstrap_interval([2.0, 2.0, 2.0])
    (2.0, 2.0)
    """
    one = np.asarray(values)
    rng = rng or np.random.default_rng(0)
    again = statistic(one[rng.integers(0, len(one), (draws, len(one)))], axis=1)
    low, high = np.quantile(again, [0.16, 0.84])
    return float(low), float(high)


def bootstrap_median(values: ArrayLike, bound: float | None = None, **draws: Any) -> ErrorEstimate:
    """Return the median of independent errors with the interval of `bootstrap_interval`.

    Examples
    --------
    >>> bootstrap_median([2.0, 2.0]).error_interval
    (2.0, 2.0)
    """
    middle = float(np.median(np.asarray(values)))
    return ErrorEstimate(middle, bootstrap_interval(values, **draws), bound)


def bootstrap_columns_median(
    values: ArrayLike, bound: float | None = None, *, draws: int = N_BOOTSTRAP_DRAWS
) -> ErrorEstimate:
    """Return the median of errors (draws, n) whose n columns are independent.

    Examples
    --------
    >>> bootstrap_columns_median([[2.0, 2.0], [2.0, 2.0]]).error_interval
    (2.0, 2.0)
    """
    errors = np.asarray(values)
    interval = bootstrap_interval(
        errors.T, lambda again, axis: np.median(again, axis=(axis, 2)), draws=draws
    )
    return ErrorEstimate(float(np.median(errors)), interval, bound)


def bootstrap_rms(squared: ArrayLike, bound: float | None = None, **draws: Any) -> ErrorEstimate:
    """Return the root of the mean of independent squares with its 68 % bootstrap interval.

    Examples
    --------
    >>> bootstrap_rms([4.0, 4.0]).error_interval
    (2.0, 2.0)
    """
    low, high = np.sqrt(bootstrap_interval(squared, np.mean, **draws)).tolist()
    return ErrorEstimate(float(np.sqrt(np.mean(np.asarray(squared)))), (low, high), bound)


def split_squares(side: int) -> list[tuple[slice, slice]]:
    """Return the slices of 8 x 8 squares of an image (more, where 8 does not divide its side).

    Examples
    --------
    >>> len(split_squares(64)), split_squares(64)[1]
    (64, (slice(0, 8, None), slice(8, 16, None)))
    """
    step = max(side // 8, 1)
    parts = [slice(at, at + step) for at in range(0, side, step)]
    return list(itertools.product(parts, parts))


def gaussian_rms(
    errors: ArrayLike, *, bound: float | None = None, freedom: int | None = None
) -> ErrorEstimate:
    """Return the root mean square of Gaussian errors; its relative standard error is 1/sqrt(2 n).

    Parameters
    ----------
    errors
        Errors, any shape.
    bound
        Least root mean square of an unbiased estimator.
    freedom
        Number of independent errors, n; None: all.

    Examples
    --------
    >>> gaussian_rms([2.0, -2.0]).error_interval
    (1.0, 3.0)
    """
    sizes = np.asarray(errors, np.float64)
    error = float(np.sqrt(np.mean(sizes**2)))
    return ErrorEstimate.symmetric(
        error, error / float(np.sqrt(2 * (freedom or sizes.size))), bound
    )


def bootstrap_tiled_rms(
    difference: FloatArray, mask: BoolArray, *, tile_px: int = TILE_PX
) -> ErrorEstimate:
    """Return the root mean square of an image's errors with a bootstrap interval over its tiles.

    Errors of neighboring pixels are correlated, so that tiles are resampled, not pixels.

    Parameters
    ----------
    difference
        (H, W) or (H, W, C).
    mask
        (H, W), pixels to include; at least one.
    tile_px
        Side of the tiles, pixels.

    Returns
    -------
    ErrorEstimate
        In the unit of the difference.

    Examples
    --------
    >>> import numpy as np
    >>> bootstrap_tiled_rms(np.full((32, 32), 2.0), np.ones((32, 32), bool)).error_interval
    (2.0, 2.0)
    """
    squared = np.square(np.asarray(difference, np.float64))
    squared = squared if squared.ndim == 2 else squared.mean(axis=-1)
    # a root of means over drawn tiles: tiles with fewer masked-in pixels have less weight
    rows, columns = np.nonzero(mask)
    _, which = np.unique(np.stack([rows, columns]) // tile_px, axis=1, return_inverse=True)
    sums, counts = np.bincount(which, squared[mask]), np.bincount(which)
    drawn = np.random.default_rng(0).integers(len(sums), size=(N_BOOTSTRAP_DRAWS, len(sums)))
    roots = np.sqrt(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
    low, high = np.percentile(roots, [16, 84])
    return ErrorEstimate(float(np.sqrt(squared[mask].mean())), (float(low), float(high)))
