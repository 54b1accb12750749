"""Estimate errors of fitted kernels: their scatter over other patches of the same skin and size.

Counts in blocks of the map give the scatter of its histogram, with the correlation of neighboring
buckets and blocks. Histograms are drawn with that scatter, and the best kernel is found for each.

Where both histograms are of one piece of skin, as neutral and strained maps of a session are, they
scatter together: a patch with more grooves than usual has them in both, and the kernel moves by
little. Then both are drawn with the same factor on each piece of skin, matched by position on the
skin, and each kernel with the scatter of its own histogram: a kernel that deepens grooves scatters
more than one that does not. Otherwise the target is drawn as of other skin.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Float64Array, Int64Array
from reconstruction.kernel_fit.search import KernelGrid, KernelSearchResult
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.normal_histogram import kernels
from reconstruction.normal_histogram.blocks import MIN_BLOCKS

N_DRAWS = 200
"""Histograms drawn for the standard errors."""
MAX_CANDIDATE_KERNELS = 64
"""Almost equally good kernels among which each draw finds its best."""
CANDIDATE_SIGMAS = 3.0
"""Excess distance up to which they are taken, in standard errors of the distance."""
MAX_PAIRED_KERNELS = 140
"""Like `MAX_CANDIDATE_KERNELS`, for histograms of one piece of skin."""
PAIRED_PX = 1_000_000
"""Normals up to which that number is used. With more the valley is shorter, and fewer are taken,
down to `MAX_CANDIDATE_KERNELS`: on 1000 x 1000 pixels each takes 0.02 s."""
PAIRED_SIGMAS = 4.0
"""Like `CANDIDATE_SIGMAS`, for histograms of one piece of skin; the valley is wider than these."""
INTERVAL_COVERAGES = 0.6827, 0.95
"""Coverages of the two intervals: fractions of draws within their half widths."""
GAUSSIAN_95 = 1.959964
"""Half width of a Gaussian's second interval over that of its first."""


@dataclass(frozen=True, slots=True)
class BlockCounts:
    """Counts of a convolved relief's normals by blocks of its map.

    Attributes
    ----------
    counts : ndarray of float64, shape (blocks, buckets)
    variance_inflation : float
        Factor by which the variance of the mean squared slope exceeds that of independent blocks,
        as neighboring blocks are correlated.
    """

    counts: Float64Array
    variance_inflation: float

    @property
    def samples(self) -> int:
        """Normals counted."""
        return int(self.counts.sum())

    @property
    def occupied(self) -> int:
        """Buckets with at least one normal; at least 1."""
        return max(1, int(np.count_nonzero(self.counts.sum(axis=0))))

    @property
    def effective_samples(self) -> float:
        """Number of independent samples with the same noise."""
        return max(
            1.0,
            normal_blocks.effective_sample_count(self.counts, self.samples)
            / self.variance_inflation,
        )

    def residuals(self) -> Float64Array:
        """Return each block's contribution to the error of the bucket fractions, (blocks, buckets).

        Weighted by independent unit normal factors, their sum scatters as the fractions do over
        other patches of the same skin, with the correlation of buckets.
        """
        sizes = self.counts.sum(axis=1)
        counts = self.counts[sizes > 0]
        scale = math.sqrt(len(counts) / max(len(counts) - 1, 1) * self.variance_inflation)
        return np.asarray(normal_blocks.block_residuals(counts) * scale)

    def distance_stderr(self, target: Float64Array, target_samples: float) -> float:
        """Return the standard error of the distance to a target of given effective samples."""
        effective, residuals = self.effective_samples, self.residuals()
        signs = np.sign(self.counts.sum(axis=0) / self.samples - target)
        # A sum of signs has at most variance 1 per independent sample; blocks may show more
        own = max(1.0 / effective, float(np.sum((residuals @ signs) ** 2)))
        return math.sqrt(own * (1.0 + effective / target_samples))

    def block_contributions(self, target_samples: float) -> Float64Array:
        """Return blocks' contributions to the error of both histograms, see `residuals`."""
        return self.residuals() * math.sqrt(1.0 + self.effective_samples / target_samples)


def count_blocks(grid: KernelGrid, alpha: float, sigma_um: float) -> BlockCounts:
    """Count the normals of a relief convolved with a kernel, in blocks of its map.

    Parameters
    ----------
    grid
        The search's grid.
    alpha, sigma_um
        The kernel; sigma in um.
    """
    relief, buckets = grid.relief, grid.buckets
    group, groups = normal_blocks.assign_blocks(relief.places, relief.code.shape)
    da, db = relief.slope_change(sigma_um)
    a, b = relief.along + np.float32(alpha) * da, relief.across + np.float32(alpha) * db
    counts = kernels.count_in_groups(-a, -b, group, groups, buckets.bins, buckets.limit)
    steep = 1.0 + a * a + b * b
    growth = [
        normal_blocks.block_mean_stderr(m * m / steep, group, groups, relief.code.shape)[1]
        for m in (a, b)
    ]
    return BlockCounts(np.asarray(counts, np.float64), 0.5 * (growth[0] + growth[1]))


def near_best_kernels(
    grid: KernelGrid, search_result: KernelSearchResult, noise: float
) -> Int64Array:
    """Return the kernels whose distance exceeds the best's by at most `noise`, (K, 2).

    Parameters
    ----------
    grid, search_result
        The search's grid and result.
    noise : float
        In units of the distance.

    Returns
    -------
    ndarray of int64
        Indices (sigma, alpha), the best first, then by distance, the gentler of equals first.
    """
    distance = search_result.distance
    i, j = np.nonzero(distance <= distance[search_result.best] + noise)
    first = (i == search_result.best[0]) & (j == search_result.best[1])
    order = np.lexsort((grid.sigmas_um[i], np.abs(grid.alphas[j]), distance[i, j], ~first))
    return np.stack([i, j], axis=1)[order]


@dataclass(frozen=True, slots=True)
class HalfWidths:
    """Half widths of intervals about the best kernel.

    Attributes
    ----------
    alpha, sigma_um : tuple of float
        At coverages of 68.27 and 95 %; the second is at least a Gaussian's.
    """

    alpha: tuple[float, float]
    sigma_um: tuple[float, float]


@dataclass(frozen=True, slots=True)
class HistogramResampling:
    """Redraw histograms, and measure how far the best kernel of a search moves.

    Attributes
    ----------
    grid, search_result
        The search's grid and result.
    noise : float
        Standard error of the distance.
    rng
        Draws the histograms.
    """

    grid: KernelGrid
    search_result: KernelSearchResult
    noise: float
    rng: np.random.Generator

    def best_kernel_widths(self, scatter: Float64Array) -> HalfWidths:
        """Return half widths for a target of other skin: quantiles of the best kernel's moves.

        Quantiles rather than the root mean square, as a long valley leads few draws far away.

        Parameters
        ----------
        scatter : ndarray, shape (blocks, buckets)
            See `BlockCounts.block_contributions`.
        """
        near = near_best_kernels(self.grid, self.search_result, CANDIDATE_SIGMAS * self.noise)
        some = near[
            np.unique(np.linspace(0, len(near) - 1, MAX_CANDIDATE_KERNELS).round().astype(int))
        ]
        gap = self.search_result.histograms(self.grid, some) - self.grid.buckets.target
        used = np.flatnonzero(gap.any(axis=0) | scatter.any(axis=0))
        gap, scatter = gap[:, used], scatter[:, used]
        best = np.empty(N_DRAWS, int)
        for draw in range(N_DRAWS):
            moved = self.rng.standard_normal(len(scatter)) @ scatter
            best[draw] = int(np.argmin(np.abs(gap + moved).sum(axis=1)))
        return _widths(self.grid, some, best)

    def paired_widths(self, target_blocks: Float64Array, growth: float) -> HalfWidths | None:
        """Return half widths for a target of the same skin, both histograms drawn together.

        Parameters
        ----------
        target_blocks : ndarray, shape (blocks, buckets)
            Counts of the target in the skin of each block of the relief, see `count_blocks`.
        growth : float
            `BlockCounts.variance_inflation` of the relief's roughness, not of its difference from
            the target's: patches differ by their number of grooves.

        Returns
        -------
        HalfWidths or None
            None where fewer than `MIN_BLOCKS` blocks are in both maps.
        """
        grid, relief, buckets = self.grid, self.grid.relief, self.grid.buckets
        group, groups = normal_blocks.assign_blocks(relief.places, relief.code.shape)
        ours = np.bincount(group, minlength=groups)
        both = np.flatnonzero((ours > 0) & (target_blocks.sum(axis=1) > 0))
        if len(both) < MIN_BLOCKS:
            return None
        theirs = normal_blocks.block_residuals(target_blocks[both])
        factors = self.rng.standard_normal((N_DRAWS, len(both)))
        factors = np.float32(math.sqrt(len(both) / (len(both) - 1) * growth)) * factors
        factors = factors.astype(np.float32)
        near = near_best_kernels(grid, self.search_result, PAIRED_SIGMAS * self.noise)
        # dense near the best, sparse where few draws end
        most = max(
            MAX_CANDIDATE_KERNELS,
            min(MAX_PAIRED_KERNELS, MAX_PAIRED_KERNELS * PAIRED_PX // relief.places.size),
        )
        steps = np.linspace(0.0, 1.0, most) ** 1.5 * (len(near) - 1)
        some = near[np.unique(steps.round().astype(int))]
        distance = np.empty((N_DRAWS, len(some)), np.float32)
        for i in np.unique(some[:, 0]).tolist():
            da, db = relief.slope_change(float(grid.sigmas_um[i]))
            for column in np.flatnonzero(some[:, 0] == i).tolist():
                alpha = np.float32(grid.alphas[some[column, 1]])
                a, b = -(relief.along + alpha * da), -(relief.across + alpha * db)
                counts = kernels.count_in_groups(a, b, group, groups, buckets.bins, buckets.limit)
                gap = counts.sum(axis=0) / relief.places.size - buckets.target
                apart = normal_blocks.block_residuals(np.asarray(counts[both], np.float64)) - theirs
                used = np.flatnonzero((gap != 0.0) | apart.any(axis=0))
                moved = factors @ apart[:, used].astype(np.float32)
                distance[:, column] = np.abs(gap[used].astype(np.float32) + moved).sum(axis=1)
        return _widths(grid, some, distance.argmin(axis=1))


def add_grid_error(widths: HalfWidths, grid: KernelGrid) -> HalfWidths:
    """Add the grid's own error, a step over sqrt(12) as of a uniform error, to half widths."""
    step = [float(np.diff(g).min()) if g.size > 1 else 0.0 for g in (grid.alphas, grid.sigmas_um)]

    def widened(width: tuple[float, float], even: float) -> tuple[float, float]:
        own = even / math.sqrt(12.0)
        return math.hypot(width[0], own), math.hypot(width[1], GAUSSIAN_95 * even / math.sqrt(12.0))

    return HalfWidths(widened(widths.alpha, step[0]), widened(widths.sigma_um, step[1]))


def _widths(grid: KernelGrid, some: Int64Array, best: NDArray[np.intp]) -> HalfWidths:
    """Return quantiles of the distances of the draws' best kernels from the first, the best."""
    sigmas_um, alphas = grid.sigmas_um, grid.alphas
    i, j = some[best].T
    ways = np.abs([alphas[j] - alphas[some[0, 1]], sigmas_um[i] - sigmas_um[some[0, 0]]])
    (alpha, sigma), (alpha_95, sigma_95) = np.quantile(ways, INTERVAL_COVERAGES, axis=1).tolist()
    return HalfWidths(
        (alpha, max(alpha_95, GAUSSIAN_95 * alpha)), (sigma, max(sigma_95, GAUSSIAN_95 * sigma))
    )
