"""Search a grid of kernels for the one of least distance in eq. (7), exhaustively or by samples.

Slopes are linear in alpha, so one convolution and one pass serve all alphas of one sigma. The
exhaustive search passes over all of the grid. The hierarchical one evaluates the grid on growing
random samples of pixels, excludes kernels proven worse than one already evaluated on all pixels,
and evaluates the remaining kernels on all pixels.

Proof of an exclusion: for numbers ``s_b`` within [-1, 1] the distance ``sum |H_b - h_b|`` is at
least ``sum s_b (H_b - h_b)``, and ``sum s_b h_b`` is the mean over pixels of ``s`` at the pixel's
bucket. With s chosen before they are drawn, a mean over m pixels drawn without replacement out of M
is above the mean of all by more than ``sqrt(2 ln(1/p) (1 - (m - 1) / M) / m)`` with a probability
of at most p (Serfling 1974). s is the sign of H - h, of the kernel itself on the pixels drawn
before, or of a nearby kernel on all pixels. p is so small that over all tests of a search the
probability of excluding the best kernel is at most `MAX_MISS_PROBABILITY`.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
Serfling 1974, Probability Inequalities for the Sum in Sampling without Replacement, Ann. Statist.
2(1), 39. doi:10.1214/aos/1176342611
"""

import math
from dataclasses import dataclass, field

import numpy as np

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from reconstruction.kernel_fit.neutral_relief import KernelFitError, NeutralRelief
from reconstruction.normal_histogram import kernels

MAX_MISS_PROBABILITY = 1e-6
"""Bound of the probability that a hierarchical search excludes the exhaustive search's result."""
DISTANCE_ROUNDING = 2e-4
"""Allowance for rounding: on samples, sums of single precision are taken in another order."""
TIE_TOL = 1e-12
"""Distances that differ by less are tied."""
FIRST_SAMPLE_PIXELS = 16_384
SAMPLE_GROWTH = 5.6
"""Factor from one sample to the next. On 2000 x 2000 pixels the two need the fewest evaluations of
the values tested, with samples whose neighborhoods stay below `MAX_WINDOW_BYTES`."""
MAX_SAMPLE_FRACTION = 0.35
"""Fraction of all pixels from which a sample is replaced by all pixels."""
MAX_WINDOW_BYTES = 300_000_000
"""Memory limit of the neighborhoods of sampled pixels; beyond, whole maps are convolved."""
N_ANCHORS = 6
"""Kernels evaluated on all pixels between two samples."""
MAX_CACHED_COUNT_BYTES = 100_000_000
"""Memory limit of the counts kept for standard errors, of kernels evaluated on all pixels."""


Slopes = tuple[Float32Array, Float32Array]
"""Slopes along and across the axis of the kernel."""


@dataclass(frozen=True, slots=True)
class TargetBuckets:
    """The target of a search.

    Attributes
    ----------
    target : ndarray of float64, shape (bins ** 2 + 1,)
        Fractions, axes (across, along) flattened, then the fraction beyond the limit.
    bins, limit
        See `normal_histogram.histogram`.
    """

    target: Float64Array
    bins: int
    limit: float

    def count(self, start: Slopes, change: Slopes, alphas: Float64Array) -> Int32Array:
        """Count the samples of each alpha, in parts: (parts, A, bins ** 2 + 1)."""
        given = alphas.astype(np.float32)
        parts = kernels.thread_count()
        return kernels.count_kernels(*start, *change, given, self.bins, self.limit, parts)


@dataclass(frozen=True, slots=True)
class KernelGrid:
    """Relief, kernels to convolve it with, and the target of its normals.

    Attributes
    ----------
    relief : NeutralRelief
    buckets : TargetBuckets
    alphas, sigmas_um : ndarray of float64, shapes (A,), (S,)
        Increasing.
    """

    relief: NeutralRelief
    buckets: TargetBuckets
    alphas: Float64Array
    sigmas_um: Float64Array

    def count(self, sigma_um: float, alphas: Float64Array) -> Int32Array:
        """Count all pixels of the relief convolved with kernels of one sigma, in parts."""
        relief = self.relief
        change = relief.slope_change(float(sigma_um))
        return self.buckets.count((relief.along, relief.across), change, alphas)

    def distances(self, sigma_um: float, alphas: Float64Array) -> Float64Array:
        """Return eq. (7)'s sum for each alpha."""
        return kernels.distances(self.count(sigma_um, alphas), self.buckets.target)


@dataclass(frozen=True, slots=True)
class KernelSearchResult:
    """Distances of a search over its grid; arrays have the shape (sigmas, alphas).

    Attributes
    ----------
    distance : ndarray
        Eq. (7)'s sum: exact over all pixels where `exact`; elsewhere from the kernel's largest
        sample, less the best kernel's excess on the same sample.
    exact : ndarray of bool
    best : tuple of int
        Indices (sigma, alpha) of the least exact distance. Ties go to the gentlest kernel: least
        |alpha|, then least sigma, then the blurring one.
    passes : float
        Kernels evaluated, in units of all pixels.
    counts : dict of (int, int) to ndarray of int32, shape (bins ** 2 + 1,)
        Counts of some of the exact kernels, by their indices (sigma, alpha).
    """

    distance: Float64Array
    exact: BoolArray
    best: tuple[int, int]
    passes: float
    counts: dict[tuple[int, int], Int32Array] = field(default_factory=dict)

    def histograms(self, grid: KernelGrid, indices: Int64Array) -> Float64Array:
        """Return histograms of kernels, (K, buckets); count those that the search has not kept.

        Parameters
        ----------
        grid
            The search's grid.
        indices : ndarray, shape (K, 2)
            Indices (sigma, alpha).
        """
        out = np.empty((len(indices), grid.buckets.target.size))
        kept = np.array([(i, j) in self.counts for i, j in indices.tolist()], bool)
        for row in np.flatnonzero(kept):
            out[row] = self.counts[indices[row, 0], indices[row, 1]]
        rows = np.flatnonzero(~kept)
        for i in np.unique(indices[rows, 0]):
            some = rows[indices[rows, 0] == i]
            out[some] = grid.count(grid.sigmas_um[i], grid.alphas[indices[some, 1]]).sum(axis=0)
        return out / grid.relief.places.size


def find_best(
    distance: Float64Array, alphas: Float64Array, sigmas_um: Float64Array
) -> tuple[int, int]:
    """Return the indices (S, A) of the minimum distance; ties as in `KernelSearchResult`.

    Raises
    ------
    KernelFitError
        Where the grid is empty, or there is not one distance per kernel.
    """
    shape = sigmas_um.size, alphas.size
    good = distance.size and distance.shape == shape
    expected = f"{shape} for sigmas and alphas, at least one of each"
    Checks(KernelFitError).require(good, "distance", f"shape {distance.shape}", expected)
    i, j = np.nonzero(distance <= distance.min() + TIE_TOL)
    order = np.lexsort((-alphas[j], sigmas_um[i], np.abs(alphas[j])))
    return int(i[order[0]]), int(j[order[0]])


def search_exhaustively(grid: KernelGrid) -> KernelSearchResult:
    """Evaluate all kernels of the grid on all pixels."""
    distance = np.empty((grid.sigmas_um.size, grid.alphas.size))
    with kernels.limit_threads(grid.relief.places.size * distance.size):
        for i, sigma in enumerate(grid.sigmas_um):
            distance[i] = grid.distances(sigma, grid.alphas)
    best = find_best(distance, grid.alphas, grid.sigmas_um)
    return KernelSearchResult(distance, np.ones(distance.shape, bool), best, float(distance.size))


def search_hierarchically(
    grid: KernelGrid, *, first_sample: int = FIRST_SAMPLE_PIXELS, rng: np.random.Generator
) -> KernelSearchResult:
    """Find the result of :func:`search_exhaustively`, except with `MAX_MISS_PROBABILITY`.

    Parameters
    ----------
    grid
        Relief, kernels and target.
    first_sample : int
        Pixels that all kernels are evaluated on; grows by `SAMPLE_GROWTH` from one round to the
        next.
    rng
        Draws the pixels. The result does not depend on it, except with the probability
        `MAX_MISS_PROBABILITY`.
    """
    pixels = grid.relief.places.size
    if first_sample >= MAX_SAMPLE_FRACTION * pixels:
        return search_exhaustively(grid)
    sizes = [first_sample]
    while sizes[-1] * SAMPLE_GROWTH < MAX_SAMPLE_FRACTION * pixels:
        sizes.append(int(sizes[-1] * SAMPLE_GROWTH))
    with kernels.limit_threads(first_sample * grid.alphas.size * grid.sigmas_um.size):
        return _Race(grid).run(sizes, rng)


class _Race:
    """State of a hierarchical search."""

    def __init__(self, grid: KernelGrid) -> None:
        shape = (grid.sigmas_um.size, grid.alphas.size)
        self.grid, self.alphas, self.sigmas = grid, grid.alphas, grid.sigmas_um
        self.low = np.zeros(shape)  # proven lower bounds of the distances
        self.guess = np.full(shape, np.inf)  # distances on the largest sample so far
        self.level = np.zeros(shape, int)  # number of that sample
        self.exact = np.zeros(shape, bool)
        self.distance = np.full(shape, np.inf)  # exact ones
        self.counts: dict[tuple[int, int], Int32Array] = {}
        # signs of target - histogram, of kernels evaluated on all pixels
        self.signs: list[Float64Array] = []
        self.passes = 0.0

    def run(self, sizes: list[int], rng: np.random.Generator) -> KernelSearchResult:
        pixels = self.grid.relief.places.size
        order = rng.permutation(pixels)[: sizes[-1]]
        tests = self.low.size * len(sizes) * (1 + N_ANCHORS)
        log = math.log(tests / MAX_MISS_PROBABILITY)
        before = sizes[0] // 2
        for number, size in enumerate(sizes):
            if not self._open.any():
                break
            self._sample(order[:size], before, log, number)
            before = size
            self._anchor()
        self._finish()
        best = find_best(self.distance, self.alphas, self.sigmas)
        # a sample's distance exceeds that of all pixels, by a similar excess for similar kernels
        excess = np.zeros(len(sizes))
        for number in range(len(sizes)):
            both = self.exact & (self.level == number)
            if both.any():
                excess[number] = np.median((self.guess - self.distance)[both])
            elif number:
                excess[number] = excess[number - 1] / math.sqrt(SAMPLE_GROWTH)
        distance = np.where(self.exact, self.distance, self.guess - excess[self.level])
        distance[~self.exact] = np.maximum(distance[~self.exact], self.distance[best])
        return KernelSearchResult(distance, self.exact, best, self.passes, self.counts)

    @property
    def _open(self) -> BoolArray:
        """Kernels that may be the best and are not yet evaluated on all pixels."""
        return ~self.exact & (self.low <= self.distance.min())

    def _sample(self, chosen: Int64Array, before: int, log: float, number: int) -> None:
        relief, buckets = self.grid.relief, self.grid.buckets
        pixels, m = relief.places.size, chosen.size
        rest, fresh = pixels - before, m - before
        # Serfling's bound on the mean over the pixels not drawn before, scaled to all pixels; the
        # counts of the pixels drawn before are known exactly
        slack = (
            math.sqrt(2.0 * log * (1.0 - (fresh - 1) / rest) / fresh) * rest / pixels
            + DISTANCE_ROUNDING
        )
        signs = np.array(self.signs).reshape(-1, buckets.target.size)
        start = relief.along[chosen], relief.across[chosen]
        old = start[0][:before], start[1][:before]
        new = start[0][before:], start[1][before:]
        change = _SampledChange(relief, chosen, self.sigmas[self._open.any(axis=1)].max())
        for i in np.flatnonzero(self._open.any(axis=1)):
            j = np.flatnonzero(self._open[i])
            da, db = change.at(float(self.sigmas[i]))
            first = buckets.count(old, (da[:before], db[:before]), self.alphas[j])
            second = buckets.count(new, (da[before:], db[before:]), self.alphas[j])
            found = kernels.distance_bounds(
                first, second, buckets.target, before, fresh, pixels, signs
            )
            self.guess[i, j], low = found.T
            self.level[i, j] = number
            self.low[i, j] = np.maximum(self.low[i, j], low - slack)
            self.passes += j.size * m / pixels

    def _anchor(self) -> None:
        """Evaluate the best guess with its neighbors, and the best at sigmas over the range."""
        self.signs = []
        best = int(np.argmin(np.where(self.exact, np.inf, self.guess)))
        i, j = divmod(best, self.alphas.size)
        self._evaluate(i, np.arange(max(j - 4, 0), min(j + 5, self.alphas.size)), j)
        rows = np.flatnonzero(self._open.any(axis=1))
        if rows.size == 0:
            return
        spread = np.linspace(0, rows.size - 1, N_ANCHORS - 1).round().astype(int)
        for i in np.unique(rows[spread]).tolist():
            if self._open[i].any():
                j = int(np.argmin(np.where(self._open[i], self.guess[i], np.inf)))
                self._evaluate(i, np.array([j]), j)

    def _evaluate(self, i: int, j: Int64Array, keep: int | None = None) -> None:
        target = self.grid.buckets.target
        counts = self.grid.count(self.sigmas[i], self.alphas[j])
        self.distance[i, j] = kernels.distances(counts, target)
        self.exact[i, j] = True
        self.passes += j.size
        whole = counts.sum(axis=0, dtype=np.int32)
        for row, column in enumerate(j.tolist()):
            if (len(self.counts) + 1) * whole[row].nbytes <= MAX_CACHED_COUNT_BYTES:
                self.counts[i, column] = whole[row]
        if keep is not None:
            shares = whole[list(j).index(keep)] / self.grid.relief.places.size
            self.signs.append(np.sign(target - shares))

    def _finish(self) -> None:
        """Evaluate the remaining kernels, most promising sigma first."""
        while self._open.any():
            hope = np.where(self._open, self.guess, np.inf).min(axis=1)
            i = int(np.argmin(hope))
            self._evaluate(i, np.flatnonzero(self._open[i]))


class _SampledChange:
    """Changes of the slopes of sampled pixels by Gaussians."""

    SIZE = 1024

    def __init__(self, relief: NeutralRelief, chosen: Int64Array, most_um: float) -> None:
        self.relief, self.chosen = relief, chosen
        reach = relief.weights(float(most_um)).size - 1
        blocks = -(-chosen.size // self.SIZE)
        self.small = 8 * blocks * reach * self.SIZE <= MAX_WINDOW_BYTES
        if self.small:
            self.along = np.zeros((blocks, reach, self.SIZE), np.float32)
            self.across = np.zeros_like(self.along)
            right, down = np.float32(relief.right_um), np.float32(relief.down_um)
            given = relief.height_um, relief.code, relief.places[chosen], right, down
            kernels.fill_windows(*given, self.along, self.across)

    def at(self, sigma_um: float) -> tuple[Float32Array, Float32Array]:
        """Return both changes, in the order of the chosen pixels."""
        if not self.small:
            a, b = self.relief.slope_change(sigma_um)
            return a[self.chosen], b[self.chosen]
        da, db = np.empty(self.chosen.size, np.float32), np.empty(self.chosen.size, np.float32)
        kernels.sum_weighted_windows(self.along, self.across, self.relief.weights(sigma_um), da, db)
        return da, db
