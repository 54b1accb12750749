"""Measure a map's normals: their histogram with its noise, and variances with errors.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Float64Array
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.blocks import (
    BLOCKS_PER_SIDE,
    assign_blocks,
    block_mean_stderr,
    effective_sample_count,
)
from reconstruction.normal_histogram.counting import check_buckets, normalize_counts
from reconstruction.normal_histogram.relief_slopes import rotate_components, slopes

SAMPLES_PER_BUCKET = 16.0
"""Mean number of samples per occupied bucket below which a histogram is aliased: its
distance from another one of the same surface is then above 0.8 * sqrt(2 / 16) = 28 %."""


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
        Number of independent samples with the same noise: neighboring normals are correlated. From
        the differences between blocks of the map and their correlation; at most `samples`.
    occupied : int
        Buckets with at least one sample.
    samples_per_bucket : float
        Samples per bucket, averaged over occupied buckets with equal weight.
    aliased : bool
        `samples_per_bucket` is below `SAMPLES_PER_BUCKET`: distances are then mostly noise.
    variance_x, variance_y : float
        Of n_x and n_y (n_s, n_t on turned axes) about their means, over all samples.
    stderr_x, stderr_y : float
        Standard errors of the variances, with the scatter over other patches of the same skin and
        size (`reconstruction.normal_histogram.blocks.mean_stderr`); infinite below five blocks.
    """

    histogram: Float64Array
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


def measure_normals(
    height: ArrayLike,
    *,
    pixel: float | tuple[float, float],
    bins: int = 64,
    limit: float = 1.0,
    valid: ArrayLike | None = None,
    angle_rad: float = 0.0,
    blocks: int = BLOCKS_PER_SIDE,
) -> NormalStatistics:
    """Measure the histogram of a relief's normals, its noise and the normals' variances.

    Parameters
    ----------
    height, pixel, bins, limit, valid, angle_rad
        As of `normal_histogram.histogram`.
    blocks : int
        The map has ``blocks ** 2`` blocks, whose scatter gives the standard errors; blocks
        must be longer than the correlation length of the relief.

    Returns
    -------
    NormalStatistics

    Raises
    ------
    HistogramError
        Without a single sample within the limit, and for bins or limits out of range.
    HistogramError
        For heights that are not a map of real numbers, and invalid masks or pixels.

    Examples
    --------
    >>> ridges = np.tile([0.0, 3.0, 0.0, 0.0], (40, 10))  # um: ridges 20 um apart
    >>> found = measure_normals(ridges, pixel=5.0)
    >>> found.samples, found.occupied, round(found.variance_x, 4), found.variance_y
    (1600, 4, 0.0458, 0.0)
    """
    check_buckets(bins, limit)
    a, b, known = slopes(height, pixel=pixel, valid=valid)
    a, b = rotate_components(a, b, angle_rad)
    group, groups = assign_blocks(np.flatnonzero(known), known.shape, blocks)
    p, q = a[known], b[known]
    counts = kernels.count_in_groups(p, q, group, groups, bins, float(limit))
    outside = int(counts[:, -1].sum())
    counts = counts[:, :-1]
    shares = normalize_counts(counts.sum(axis=0)).reshape(bins, bins)
    w = 1.0 / np.sqrt(1.0 + p * p + q * q)
    x, y = -p * w, -q * w
    errors = [
        block_mean_stderr((m - m.mean()) ** 2, group, groups, known.shape, blocks) for m in (x, y)
    ]
    growth = 0.5 * (errors[0][1] + errors[1][1])
    samples = int(counts.sum())
    occupied = int(np.count_nonzero(shares))
    return NormalStatistics(
        histogram=shares,
        samples=samples,
        outside=outside,
        effective_samples=max(
            1.0, effective_sample_count(counts.astype(np.float64), samples) / growth
        ),
        occupied=occupied,
        samples_per_bucket=samples / occupied,
        aliased=samples / occupied < SAMPLES_PER_BUCKET,
        variance_x=float(np.var(x)),
        variance_y=float(np.var(y)),
        stderr_x=errors[0][0],
        stderr_y=errors[1][0],
    )
