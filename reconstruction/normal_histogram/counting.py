"""Count a relief's normals in 64 x 64 histograms, compare these, and compute their noise floor.

A normal is ``n = (-dh/dx, -dh/dy, 1) / length`` with x to the right and y up; a histogram has the
axes (n_y, n_x), both increasing, and sums to 1 (Nagano2015 section 4, figs. 8 and 9). Slopes are
those of `relief_slopes`.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ive

from model.checks import Checks
from reconstruction.arrays import Float64Array, Int64Array
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.relief_slopes import (
    HistogramError,
    rotate_components,
    slopes,
    slopes_from_normals,
)


def count_normals(
    slope_x: ArrayLike, slope_y: ArrayLike, *, bins: int = 64, limit: float = 1.0
) -> tuple[Int64Array, int]:
    """Count the normals of slopes in buckets.

    Parameters
    ----------
    slope_x, slope_y : array_like
        dh/dx and dh/dy, dimensionless, finite.
    bins : int
        Buckets per side, 1...4096.
    limit : float
        The buckets span [-limit, limit] of n_x and n_y; 0 < limit <= 1. The last bucket holds its
        upper edge too.

    Returns
    -------
    counts : ndarray of int64, shape (bins, bins)
        Axes (n_y, n_x).
    outside : int
        Normals beyond the limit.

    Raises
    ------
    HistogramError
        For different numbers of slopes, and bins or limits out of range.
    """
    check_buckets(bins, limit)
    p = np.ascontiguousarray(slope_x, np.float64).reshape(-1)
    q = np.ascontiguousarray(slope_y, np.float64).reshape(-1)
    Checks(HistogramError).require(p.shape == q.shape, "slope_y", f"{q.size} slopes", f"{p.size}")
    with kernels.limit_threads(100 * p.size):
        counts = kernels.count_slopes(p, q, bins, float(limit), kernels.thread_count()).sum(axis=0)
    return counts[:-1].reshape(bins, bins), int(counts[-1])


def check_buckets(bins: int, limit: float) -> None:
    """Refuse numbers of buckets and limits out of range."""
    Checks(HistogramError).within("bins", bins, "[1, 4096]")
    Checks(HistogramError).within("limit", limit, "(0, 1]")


def histogram(
    height: ArrayLike,
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    y_up: bool = True,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Float64Array:
    """Return the fraction of a relief's normals in each bucket of (n_y, n_x).

    Parameters
    ----------
    height : array_like, shape (H, W)
        Any unit, that of ``pixel``. Heights that are not finite count as not valid.
    pixel : float or (float, float)
        Side of a pixel, or its height and width (a relief stretched along x by r has a width of
        r times its height).
    bins : int
        Buckets per side.
    limit : float
        Buckets span [-limit, limit]; normals beyond are in no bucket
        (`normal_statistics.measure` counts them).
    y_up : bool
        True: row 0 is the top, and n_y > 0 leans to it.
    valid : array_like of bool, shape (H, W), optional
        Heights to use.
    angle_rad : float
        The histogram's axes are turned counterclockwise (y up) by it: the first is that of a
        caliper whose jaws move at this angle, and the axes are then (n_t, n_s).

    Returns
    -------
    ndarray of float64, shape (bins, bins)
        Sums to 1 over the samples within the limit.

    Raises
    ------
    HistogramError
        Without a single slope or sample within the limit, and for bins or limits out of range.
    HistogramError
        Its base class: for heights that are not a map of real numbers, or a mask of another
        shape or type.

    Examples
    --------
    >>> plane = np.tile(np.arange(8.0), (8, 1))  # rises to the right: normals lean to the left
    >>> np.argwhere(histogram(plane, pixel=1.0, bins=4))
    array([[2, 0]])
    """
    a, b, known = slopes(height, pixel=pixel, y_up=y_up, valid=valid)
    return from_slopes(a[known], b[known], bins=bins, limit=limit, angle_rad=angle_rad)


def from_slopes(
    slope_x: ArrayLike,
    slope_y: ArrayLike,
    *,
    bins: int = 64,
    limit: float = 1.0,
    angle_rad: float = 0.0,
) -> Float64Array:
    """Return the histogram of normals given as slopes dh/dx, dh/dy; see :func:`histogram`."""
    p, q = rotate_components(
        np.asarray(slope_x, np.float64), np.asarray(slope_y, np.float64), angle_rad
    )
    return normalize_counts(count_normals(p, q, bins=bins, limit=limit)[0])


def from_normals(
    normals: ArrayLike,
    *,
    bins: int = 64,
    limit: float = 1.0,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Float64Array:
    """Return the histogram of normals, shape (..., 3), z > 0, unit or not; see :func:`histogram`.

    Normals that are not finite or do not face z count as not valid.
    """
    a, b, known = slopes_from_normals(normals, valid=valid)
    return from_slopes(a[known], b[known], bins=bins, limit=limit, angle_rad=angle_rad)


def normalize_counts(counts: Int64Array) -> Float64Array:
    """Return counts over their sum, of at least one sample."""
    total = int(counts.sum())
    Checks(HistogramError).require(total, "height", "no sample within the limit", "at least one")
    return counts / total


def distance(a: ArrayLike, b: ArrayLike) -> float:
    """Return ``sum |a - b|`` over buckets, 0...2: the total variation of eq. (7).

    Half of it, 0...1, is the total variation distance elsewhere
    (`model.metrics` and others): the fraction of samples that would have to change their bucket.

    Parameters
    ----------
    a, b : array_like, same shape
        Fractions of samples.

    Raises
    ------
    HistogramError
        For histograms of different shapes, or fractions that are not finite.

    Examples
    --------
    >>> distance([1.0, 0.0], [0.0, 1.0])
    2.0
    """
    ours, theirs = np.asarray(a, np.float64), np.asarray(b, np.float64)
    Checks(HistogramError).shape("b", theirs, ours.shape)
    apart = float(np.abs(ours - theirs).sum())
    Checks(HistogramError).within("sum of differences of a and b", apart)
    return apart


def halved_distance(a: ArrayLike, b: ArrayLike) -> float:
    """Return half of :func:`distance`, 0...1: the fraction of samples in other buckets."""
    return 0.5 * distance(a, b)


def noise_floor(histogram: ArrayLike, samples: float, other_samples: float | None = None) -> float:
    """Return the mean distance between two histograms of samples of one distribution.

    Parameters
    ----------
    histogram : array_like
        Fractions that sum to 1.
    samples, other_samples : float
        Independent samples of each (the effective number); the second equals the first by default.

    Returns
    -------
    float
        ``sum E|X - Y|`` of two Poisson counts in each bucket, exact for equal numbers of samples;
        otherwise for the number whose variance is the mean of both. 0 for infinitely many.

    Raises
    ------
    HistogramError
        For fractions that are not finite or below 0, and numbers that are not above 0.

    Examples
    --------
    >>> flat = np.full(100, 0.01)
    >>> round(noise_floor(flat, 10_000.0), 4), round((4 / np.pi / 100) ** 0.5, 4)
    (0.1128, 0.1128)
    """
    other = samples if other_samples is None else other_samples
    Checks(HistogramError).within("samples", (samples, other), "(0, inf]")
    shares = np.asarray(histogram, np.float64)
    Checks(HistogramError).within("histogram", shares, "[0, inf)")
    both = 1.0 / samples + 1.0 / other
    if both < np.finfo(np.float64).tiny:
        return 0.0
    n = 2.0 / both
    x = 2.0 * n * shares
    # E|X - Y| of two Poisson variables of mean x / 2: x exp(-x) (I_0(x) + I_1(x))
    return float(np.sum(x * (ive(0, x) + ive(1, x)))) / n
