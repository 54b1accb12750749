"""Distributions of normals of a relief: 64 x 64 histograms, variances, distances, their noise.

A normal is ``n = (-dh/dx, -dh/dy, 1) / length`` with x to the right and y up; a histogram has the
axes (n_y, n_x), both increasing, and sums to 1 (Nagano2015 section 4, figs. 8 and 9).

Slopes are central differences; where only one neighbour is there, at a border or beside a hole,
they are one-sided, and a pixel without a neighbour along an axis has none (`slopes`).

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ive

from reconstruction import kernel_fit_kernels as kernels
from reconstruction.block_errors import stderr_of_mean

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SAMPLES_PER_BUCKET = 16.0
"""Mean number of samples in an occupied bucket below which a histogram is called aliased: its
distance from another one of the same surface is then above 0.8 * sqrt(2 / 16) = 28 %."""
BLOCKS = 8
"""A map is cut into so many blocks a side, whose differences tell the noise of its statistics."""


class HistogramError(ValueError):
    """A relief, normals or settings that no histogram can be made of."""


def stencil(height: NDArray[np.floating], valid: ArrayLike | None = None) -> NDArray[np.uint8]:
    """Return which neighbours each pixel's slopes are taken from.

    Parameters
    ----------
    height : ndarray, shape (H, W)
    valid : array_like of bool, shape (H, W), optional
        Heights to use; heights that are not finite are never used.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        Bits 1, 2, 4, 8: the neighbour to the left, right, above (row - 1), below is usable; 0
        where the pixel has no slope: it is not valid, or lacks both neighbours along an axis.
    """
    if height.ndim != 2:
        raise HistogramError(f"height: got shape {height.shape}, expected (H, W)")
    good = np.isfinite(height)
    if valid is not None:
        mask = np.asarray(valid)
        if mask.dtype != np.bool_ or mask.shape != height.shape:
            raise HistogramError(f"valid: got {mask.dtype} {mask.shape}, expected {height.shape}")
        good &= mask
    code = np.zeros(height.shape, np.uint8)
    code[:, 1:] |= good[:, :-1].astype(np.uint8)
    code[:, :-1] |= good[:, 1:].astype(np.uint8) << 1
    code[1:] |= good[:-1].astype(np.uint8) << 2
    code[:-1] |= good[1:].astype(np.uint8) << 3
    code[~(good & ((code & 3) > 0) & ((code & 12) > 0))] = 0
    return code


def pixel_sides(pixel: float | tuple[float, float]) -> tuple[float, float]:
    """Return height and width of a pixel from one number or the pair (height, width)."""
    sides = np.broadcast_to(np.asarray(pixel, np.float64), 2) if np.size(pixel) < 3 else np.zeros(2)
    if not (np.isfinite(sides).all() and (sides > 0).all()):
        raise HistogramError(f"pixel: got {pixel}, expected one or two finite numbers above 0")
    return float(sides[0]), float(sides[1])


def slopes(
    height: NDArray[np.floating],
    *,
    pixel: float | tuple[float, float],
    y_up: bool = True,
    valid: ArrayLike | None = None,
) -> tuple[Floats, Floats, Bools]:
    """Return the slopes of a relief, by differences over two pixels or, at edges, one.

    Parameters
    ----------
    height : ndarray, shape (H, W)
        Row 0 is the top when ``y_up``.
    pixel : float or (float, float)
        Side of a pixel, or its height and width, in the unit of the height.
    y_up : bool
        True: y points to row 0. False: y grows with the row.
    valid : array_like of bool, shape (H, W), optional

    Returns
    -------
    dh_dx, dh_dy : ndarray of float64, shape (H, W)
        0 where there is none.
    known : ndarray of bool, shape (H, W)
    """
    code = stencil(height, valid)
    down, right = pixel_sides(pixel)
    with kernels.threads_for(100 * code.size):
        a, b = kernels.slopes(np.asarray(height, np.float64), code, right, -down if y_up else down)
    return a, b, code > 0


def bucket_counts(
    slope_x: ArrayLike, slope_y: ArrayLike, *, bins: int = 64, limit: float = 1.0
) -> tuple[NDArray[np.int64], int]:
    """Count the normals of slopes in buckets.

    Parameters
    ----------
    slope_x, slope_y : array_like
        dh/dx and dh/dy, dimensionless, finite.
    bins : int
        Buckets a side, 1...4096.
    limit : float
        The buckets span [-limit, limit] of n_x and n_y; 0 < limit <= 1. The last bucket holds its
        upper edge too.

    Returns
    -------
    counts : ndarray of int64, shape (bins, bins)
        Axes (n_y, n_x).
    outside : int
        Normals beyond the limit.
    """
    check_buckets(bins, limit)
    p = np.ascontiguousarray(slope_x, np.float64).reshape(-1)
    q = np.ascontiguousarray(slope_y, np.float64).reshape(-1)
    if p.shape != q.shape:
        raise HistogramError(f"slope_y: got {q.size} slopes, expected {p.size}")
    with kernels.threads_for(100 * p.size):
        counts = kernels.count_slopes(p, q, bins, float(limit), kernels.threads()).sum(axis=0)
    return counts[:-1].reshape(bins, bins), int(counts[-1])


def check_buckets(bins: int, limit: float) -> None:
    """Refuse numbers of buckets and limits that make no histogram."""
    if not 1 <= bins <= 4096:
        raise HistogramError(f"bins: got {bins}, expected 1...4096")
    if not 0 < limit <= 1:
        raise HistogramError(f"limit: got {limit}, expected above 0 and at most 1")


def histogram(
    height: NDArray[np.floating],
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    y_up: bool = True,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Floats:
    """Return the share of a relief's normals in each bucket of (n_y, n_x).

    Parameters
    ----------
    height : ndarray, shape (H, W)
        Any unit, that of ``pixel``. Heights that are not finite count as not valid.
    pixel : float or (float, float)
        Side of a pixel, or its height and width (a relief stretched along x by r has a width of
        r times its height).
    bins : int
        Buckets a side.
    limit : float
        Buckets span [-limit, limit]; normals beyond are in no bucket (`measure` counts them).
    y_up : bool
        True: row 0 is the top, and n_y > 0 leans to it.
    valid : array_like of bool, shape (H, W), optional
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
        Without a single slope or sample within the limit.

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
) -> Floats:
    """Return the histogram of normals given as slopes dh/dx, dh/dy; see :func:`histogram`."""
    given = np.asarray(slope_x, np.float64), np.asarray(slope_y, np.float64)
    if not (np.isfinite(given[0]).all() and np.isfinite(given[1]).all()):
        raise HistogramError("slope_x, slope_y: got NaN or infinity, expected finite slopes")
    p, q = turned(*given, angle_rad)
    counts, _ = bucket_counts(p, q, bins=bins, limit=limit)
    return _shares(counts)


def from_normals(
    normals: NDArray[np.floating],
    *,
    bins: int = 64,
    limit: float = 1.0,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> Floats:
    """Return the histogram of normals, shape (..., 3), z > 0, unit or not; see :func:`histogram`.

    Normals that are not finite or do not face z count as not valid.
    """
    p, q = _slopes_of(normals, valid)
    return from_slopes(p, q, bins=bins, limit=limit, angle_rad=angle_rad)


def _slopes_of(normals: NDArray[np.floating], valid: ArrayLike | None) -> tuple[Floats, Floats]:
    if normals.ndim < 1 or normals.shape[-1] != 3:
        raise HistogramError(f"normals: got shape {normals.shape}, expected (..., 3)")
    n = np.asarray(normals, np.float64)
    good = np.isfinite(n).all(axis=-1) & (n[..., 2] > 0)
    if valid is not None:
        good &= np.asarray(valid, bool)
    n = n[good]
    return -n[:, 0] / n[:, 2], -n[:, 1] / n[:, 2]


def _shares(counts: NDArray[np.int64]) -> Floats:
    total = int(counts.sum())
    if total == 0:
        raise HistogramError("height: got no sample within the limit, expected at least one")
    return counts / total


def turned(
    a: NDArray[np.floating], b: NDArray[np.floating], angle_rad: float
) -> tuple[Floats, Floats]:
    """Return the components of plane vectors (a, b) along axes turned by an angle, rad.

    Raises
    ------
    HistogramError
        For vectors or an angle that are not finite.

    Examples
    --------
    >>> x, y = turned(np.array([1.0]), np.array([0.0]), math.pi / 2)
    >>> x.round(6).tolist(), y.round(6).tolist()
    ([0.0], [-1.0])
    """
    if not math.isfinite(angle_rad):
        raise HistogramError(f"angle_rad: got {angle_rad}, expected a finite angle")
    for name, part in (("a", a), ("b", b)):
        wrong = int(np.size(part) - np.count_nonzero(np.isfinite(part)))
        if wrong:
            raise HistogramError(
                f"{name}: got {wrong} of {np.size(part)} values that are NaN or infinite, expected "
                "finite ones: leave out what is masked"
            )
    if angle_rad == 0.0:
        return np.asarray(a, np.float64), np.asarray(b, np.float64)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.asarray(c * a + s * b), np.asarray(c * b - s * a)


@dataclass(frozen=True, slots=True)
class NormalStatistics:
    """A histogram with its noise, and the variances of the normals (Nagano2015, fig. 9).

    Attributes
    ----------
    histogram : ndarray, shape (bins, bins)
        Axes (n_y, n_x), or (n_t, n_s) of turned axes; sums to 1.
    samples, outside : int
        Normals counted, and those beyond the limit.
    effective_samples : float
        Independent samples that would be as noisy: neighbouring normals are alike. From the
        differences between blocks of the map, and how alike neighboring blocks are; at most
        `samples`.
    occupied : int
        Buckets that hold anything.
    samples_per_bucket : float
        Samples a bucket, averaged over occupied buckets with equal weight.
    aliased : bool
        `samples_per_bucket` is below `SAMPLES_PER_BUCKET`: distances then show chance.
    variance_x, variance_y : float
        Of n_x and n_y (n_s, n_t on turned axes) about their means, over all samples.
    stderr_x, stderr_y : float
        Standard errors of the variances, of what another patch of the same skin and size would
        show (`reconstruction.block_errors`); infinite below five blocks.
    """

    histogram: Floats
    samples: int
    outside: int
    effective_samples: float
    occupied: int
    samples_per_bucket: float
    aliased: bool
    variance_x: float
    variance_y: float
    stderr_x: float
    stderr_y: float


def grid_of(shape: tuple[int, int], blocks: int) -> tuple[int, int]:
    """Return into how many rows and columns of blocks `block_of` cuts a map."""
    return max(1, min(blocks, shape[0] // 4)), max(1, min(blocks, shape[1] // 4))


def block_counts(
    height: NDArray[np.floating],
    block: NDArray[np.int64],
    blocks: int,
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    y_up: bool = True,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
) -> NDArray[np.int64]:
    """Count a relief's normals by blocks of any shape, as of another map of the same skin.

    Parameters
    ----------
    height, pixel, bins, limit, y_up, valid, angle_rad
        As of :func:`histogram`.
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
        For a map of blocks of another shape, and as of :func:`histogram`.
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


def block_of(
    places: NDArray[np.int64], shape: tuple[int, int], blocks: int
) -> tuple[NDArray[np.int64], int]:
    """Return the block of pixels ``y * W + x``, and how many blocks there are.

    A map is cut into ``blocks`` along each axis, fewer where they would be below 4 pixels.
    """
    across = grid_of(shape, blocks)
    y, x = np.divmod(places, shape[1])
    return y * across[0] // shape[0] * across[1] + x * across[1] // shape[1], across[0] * across[1]


def effective_number(counts: Floats, samples: int) -> float:
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
    # the ratio of sums, to first order: residual of each block from the common shares
    residual = (counts - sizes[:, None] * p) / sizes.sum()
    variance = n / (n - 1) * float(np.sum(residual * residual))
    spread = float(np.sum(p * (1.0 - p)))
    if variance <= 0 or spread <= 0:
        return float(samples)
    return float(np.clip(spread / variance, 1.0, samples))


def block_error(
    values: NDArray[np.floating],
    group: NDArray[np.int64],
    groups: int,
    shape: tuple[int, int],
    blocks: int,
) -> tuple[float, float]:
    """Return the standard error of a mean of samples of a map, by its blocks.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Of the samples.
    group, groups, shape, blocks
        Of `block_of`.

    Returns
    -------
    tuple of float
        As of `reconstruction.block_errors.stderr_of_mean`.
    """
    sizes = np.bincount(group, minlength=groups).astype(np.float64)
    some = np.flatnonzero(sizes > 0)
    means = np.bincount(group, values, groups)[some] / sizes[some]
    across = max(1, min(blocks, shape[1] // 4))
    places = np.stack(np.divmod(some, across), axis=1).astype(np.float64)
    return stderr_of_mean(means, sizes[some], places)


def measure(
    height: NDArray[np.floating],
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    y_up: bool = True,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
    blocks: int = BLOCKS,
) -> NormalStatistics:
    """Return the histogram of a relief's normals, its noise and the normals' variances.

    Parameters
    ----------
    height, pixel, bins, limit, y_up, valid, angle_rad
        As of :func:`histogram`.
    blocks : int
        The map is cut into ``blocks ** 2`` parts, whose scatter gives the standard errors; they
        must be longer than the relief is correlated with itself.

    Raises
    ------
    HistogramError
        Without a single sample within the limit.
    """
    a, b, known = slopes(height, pixel=pixel, y_up=y_up, valid=valid)
    return _measured(*turned(a, b, angle_rad), known, bins, limit, blocks)


def measure_normals(
    normals: NDArray[np.floating],
    *,
    bins: int = 64,
    limit: float = 1.0,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
    blocks: int = BLOCKS,
) -> NormalStatistics:
    """Return what :func:`measure` does, of a map of normals, shape (H, W, 3), y up."""
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise HistogramError(f"normals: got shape {normals.shape}, expected (H, W, 3)")
    n = np.asarray(normals, np.float64)
    known = np.isfinite(n).all(axis=-1) & (n[..., 2] > 0)
    if valid is not None:
        known &= np.asarray(valid, bool)
    z = np.where(known, n[..., 2], 1.0)
    a, b = (np.where(known, -n[..., i] / z, 0.0) for i in (0, 1))
    return _measured(*turned(a, b, angle_rad), known, bins, limit, blocks)


def _measured(
    a: Floats, b: Floats, known: Bools, bins: int, limit: float, blocks: int
) -> NormalStatistics:
    group, groups = block_of(np.flatnonzero(known), (known.shape[0], known.shape[1]), blocks)
    p, q = a[known], b[known]
    check_buckets(bins, limit)
    counts = kernels.count_in_groups(p, q, group, groups, bins, float(limit))
    outside = int(counts[:, -1].sum())
    counts = counts[:, :-1]
    shares = _shares(counts.sum(axis=0)).reshape(bins, bins)
    w = 1.0 / np.sqrt(1.0 + p * p + q * q)
    x, y = -p * w, -q * w
    shape = (known.shape[0], known.shape[1])
    errors = [block_error((m - m.mean()) ** 2, group, groups, shape, blocks) for m in (x, y)]
    growth = 0.5 * (errors[0][1] + errors[1][1])
    samples = int(counts.sum())
    occupied = int(np.count_nonzero(shares))
    return NormalStatistics(
        histogram=shares,
        samples=samples,
        outside=outside,
        effective_samples=max(1.0, effective_number(counts.astype(np.float64), samples) / growth),
        occupied=occupied,
        samples_per_bucket=samples / occupied,
        aliased=samples / occupied < SAMPLES_PER_BUCKET,
        variance_x=float(np.var(x)),
        variance_y=float(np.var(y)),
        stderr_x=errors[0][0],
        stderr_y=errors[1][0],
    )


def distance(a: Floats, b: Floats) -> float:
    """Return ``sum |a - b|`` over buckets, 0...2: the total variation as eq. (7) has it.

    Half of it, 0...1, is what is elsewhere called the total variation distance
    (`model.metrics` and others): the share of samples that would have to change their bucket.

    Raises
    ------
    HistogramError
        For histograms of different shapes, or shares that are not finite.

    Examples
    --------
    >>> distance(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    2.0
    """
    if a.shape != b.shape:
        raise HistogramError(f"b: got shape {b.shape}, expected {a.shape}")
    apart = float(np.abs(a - b).sum())
    if not math.isfinite(apart):
        raise HistogramError(f"a, b: got a sum of differences of {apart}, expected finite shares")
    return apart


def halved_distance(a: Floats, b: Floats) -> float:
    """Return half of :func:`distance`, 0...1: the share of samples in other buckets."""
    return 0.5 * distance(a, b)


def noise_floor(histogram: Floats, samples: float, other_samples: float | None = None) -> float:
    """Return the mean distance between two histograms of samples of one distribution.

    Parameters
    ----------
    histogram : ndarray
        Shares that sum to 1.
    samples, other_samples : float
        Independent samples of each (the effective number); the second is as the first by default.

    Returns
    -------
    float
        ``sum E|X - Y|`` of two Poisson counts in each bucket, exact for equal numbers of samples;
        for others the number whose variance is the mean of both is taken. 0 for infinitely many.

    Raises
    ------
    HistogramError
        For shares that are not finite or below 0, and numbers that are not above 0.

    Examples
    --------
    >>> flat = np.full(100, 0.01)
    >>> round(noise_floor(flat, 10_000.0), 4), round(math.sqrt(4 / math.pi / 100), 4)
    (0.1128, 0.1128)
    """
    other = samples if other_samples is None else other_samples
    if not (samples > 0 and other > 0):
        raise HistogramError(f"samples: got {samples}, {other}, expected above 0")
    shares = np.asarray(histogram, np.float64)
    if not (np.isfinite(shares).all() and (shares >= 0).all()):
        raise HistogramError("histogram: got NaN, infinite or negative shares, expected 0...1")
    both = 1.0 / samples + 1.0 / other
    if both < np.finfo(np.float64).tiny:
        return 0.0
    n = 2.0 / both
    x = 2.0 * n * shares
    # E|X - Y| of two Poisson variables of mean x / 2: x exp(-x) (I_0(x) + I_1(x))
    return float(np.sum(x * (ive(0, x) + ive(1, x)))) / n
