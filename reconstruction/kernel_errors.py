"""Errors of fitted kernels: what another patch of the same skin and size would change.

Blocks of the map tell how its histogram scatters, neighboring buckets and neighboring blocks
together; histograms drawn with that scatter tell how far the best kernel moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction import kernel_fit_kernels as kernels
from reconstruction import normal_histogram
from reconstruction.kernel_search import Buckets, Found, Relief

Floats = NDArray[np.float64]

DRAWS = 200
"""Histograms drawn for the standard errors."""
MOST_DRAWN = 64
"""Nearly-as-good kernels among which each draw finds its best."""
DRAWN_WITHIN = 3.0
"""They are taken from within so many standard errors of the distance."""
WITHIN = 0.6827
"""Share of draws within a standard error of the best."""


@dataclass(frozen=True, slots=True)
class BlockCounts:
    """Counts of a convolved relief's normals by blocks of its map.

    Attributes
    ----------
    counts : ndarray of float64, shape (blocks, buckets)
    growth : float
        By how much larger the variance of the mean squared slope is than that of independent
        blocks, because neighbors are alike.
    """

    counts: Floats
    growth: float

    @property
    def samples(self) -> int:
        """Normals counted."""
        return int(self.counts.sum())

    @property
    def occupied(self) -> int:
        """Buckets that hold anything; at least 1."""
        return max(1, int(np.count_nonzero(self.counts.sum(axis=0))))

    @property
    def effective_samples(self) -> float:
        """Independent samples that would be as noisy."""
        return max(1.0, normal_histogram.effective_number(self.counts, self.samples) / self.growth)

    def residuals(self) -> Floats:
        """Return each block's part in the error of the shares, (blocks, buckets).

        With independent unit normal factors on the blocks, the sum scatters as the shares do over
        other patches of the same skin, neighboring buckets together.
        """
        sizes = self.counts.sum(axis=1)
        counts, sizes = self.counts[sizes > 0], sizes[sizes > 0]
        n = len(sizes)
        p = counts.sum(axis=0) / sizes.sum()
        apart = (counts - sizes[:, None] * p) / sizes.sum()
        return np.asarray(apart * math.sqrt(n / max(n - 1, 1) * self.growth))

    def noise(self, target: Floats, target_samples: float) -> float:
        """Return the standard error of the distance to a target of so many effective samples."""
        effective, residuals = self.effective_samples, self.residuals()
        signs = np.sign(self.counts.sum(axis=0) / self.samples - target)
        # a sum of signs has a variance of at most 1 an independent sample; or what blocks show
        own = max(1.0 / effective, float(np.sum((residuals @ signs) ** 2)))
        return math.sqrt(own * (1.0 + effective / target_samples))

    def scatter(self, target_samples: float) -> Floats:
        """Return the parts of blocks in the error of both histograms, as of `residuals`."""
        return self.residuals() * math.sqrt(1.0 + self.effective_samples / target_samples)


def of_kernel(relief: Relief, buckets: Buckets, alpha: float, sigma_um: float) -> BlockCounts:
    """Count the normals of a relief that a kernel has changed, in blocks of its map.

    Parameters
    ----------
    relief, buckets
        Of the search.
    alpha, sigma_um
        The kernel; sigma in um.
    """
    shape = (relief.code.shape[0], relief.code.shape[1])
    blocks = normal_histogram.BLOCKS
    group, groups = normal_histogram.block_of(relief.places, shape, blocks)
    da, db = relief.change(sigma_um)
    a, b = relief.along + np.float32(alpha) * da, relief.across + np.float32(alpha) * db
    counts = kernels.count_in_groups(-a, -b, group, groups, buckets.bins, buckets.limit)
    steep = 1.0 + a * a + b * b
    growth = [
        normal_histogram.block_error(m * m / steep, group, groups, shape, blocks)[1] for m in (a, b)
    ]
    return BlockCounts(np.asarray(counts, np.float64), 0.5 * (growth[0] + growth[1]))


def nearly_as_good(
    found: Found, alphas: Floats, sigmas_um: Floats, noise: float
) -> NDArray[np.int64]:
    """Return the kernels that are no further than `noise` from the best, (K, 2).

    Parameters
    ----------
    found, alphas, sigmas_um
        Of the search.
    noise : float
        In units of the distance.

    Returns
    -------
    ndarray of int64
        Indices (sigma, alpha), the best first, then by distance, the gentler of equals first.
    """
    distance = found.distance
    i, j = np.nonzero(distance <= distance[found.best] + noise)
    first = (i == found.best[0]) & (j == found.best[1])
    order = np.lexsort((sigmas_um[i], np.abs(alphas[j]), distance[i, j], ~first))
    return np.stack([i, j], axis=1)[order]


def stderr_of_best(
    relief: Relief,
    buckets: Buckets,
    found: Found,
    alphas: Floats,
    sigmas_um: Floats,
    *,
    noise: float,
    scatter: Floats,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return ways of the best kernel that 68 % of drawn histograms stay within.

    Not their root mean square: a long valley leads few of them far away.

    Parameters
    ----------
    relief, buckets, found, alphas, sigmas_um
        Of the search.
    noise : float
        Standard error of the distance.
    scatter : ndarray, shape (blocks, buckets)
        Of `BlockCounts.scatter`.
    rng
        Draws the histograms.

    Returns
    -------
    tuple of float
        Of alpha, and of sigma in um.
    """
    near = nearly_as_good(found, alphas, sigmas_um, DRAWN_WITHIN * noise)
    some = near[np.unique(np.linspace(0, len(near) - 1, MOST_DRAWN).round().astype(int))]
    gap = found.shares(relief, buckets, sigmas_um, alphas, some) - buckets.target
    used = np.flatnonzero(gap.any(axis=0) | scatter.any(axis=0))
    gap, scatter = gap[:, used], scatter[:, used]
    best = np.empty(DRAWS, int)
    for draw in range(DRAWS):
        moved = rng.standard_normal(len(scatter)) @ scatter
        best[draw] = int(np.argmin(np.abs(gap + moved).sum(axis=1)))
    i, j = some[best].T
    ways = np.abs([alphas[j] - alphas[some[0, 1]], sigmas_um[i] - sigmas_um[some[0, 0]]])
    alpha, sigma = np.quantile(ways, WITHIN, axis=1)
    return float(alpha), float(sigma)
