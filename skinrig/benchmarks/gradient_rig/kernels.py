"""Benchmarks of normal histograms and of the kernel search against plain NumPy."""

from collections.abc import Callable
from functools import partial
from typing import Literal

import numba
import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from reconstruction import kernel_fit, normal_histogram
from reconstruction.kernel_fit import neutral_relief
from reconstruction.kernel_fit import outcome as kernel_outcome
from reconstruction.kernel_fit import search as kernel_search
from reconstruction.kernel_fit.fit import ALPHA_GRID, SIGMAS_UM
from reconstruction.normal_histogram import relief_slopes
from reconstruction.normal_histogram import statistics as normal_statistics
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_processor_seconds
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

PIXEL_UM = 6.0
STRETCH_RATIO = 0.88
FULL_SIDE_PX = 2000
N_PEER_CANDIDATES = 3
"""Candidates of the NumPy search that are timed, for an extrapolation to the grid."""


def synthesize_relief(side: int, *, rng: np.random.Generator) -> Float64Array:
    """Synthesize heights of a skin-like relief, um: grain, ridges and a network of grooves.

    Parameters
    ----------
    side
        Side in pixels of 6 um.
    rng
        Generator of the relief.
    """

    def field(correlation_px: float) -> Float64Array:
        white = rng.standard_normal((side, side), np.float32)
        smooth = gaussian_filter(white, correlation_px, mode="wrap").astype(np.float64)
        return np.asarray(smooth / smooth.std())

    grooves = np.exp(-((field(12.0) / 0.25) ** 2))
    return np.asarray(field(2.0) + 5.0 * field(6.0) - 12.0 * grooves + 8.0 * field(25.0))


def strain_relief(height: Float64Array, *, rng: np.random.Generator) -> Float64Array:
    """Return a strained relief outside the model: grooves deepen more than ridges rise; noise."""
    about = height - height.mean()
    deeper = 1.12 * height - 0.02 * about**2 * (about < 0)
    grain = gaussian_filter(rng.standard_normal(height.shape, np.float32), 1.0)
    return np.asarray(deeper + 0.5 * grain)


def distance_with_numpy(
    height: Float64Array, target: Float64Array, alpha: float, sigma_um: float
) -> float:
    """Return the distance of eq. (7) for one kernel with vectorized NumPy and SciPy."""
    blurred = gaussian_filter1d(height, sigma_um / PIXEL_UM, axis=1)
    dy, dx = np.gradient((1.0 - alpha) * height + alpha * blurred, PIXEL_UM)
    dx /= STRETCH_RATIO
    return float(np.abs(histogram_with_numpy(dx, -dy) - target).sum())


def histogram_with_numpy(dx: Float64Array, dy: Float64Array) -> Float64Array:
    """Return the fractions of normals in 64 x 64 bins with vectorized NumPy."""
    w = 1.0 / np.sqrt(1.0 + dx * dx + dy * dy)
    edges = np.linspace(-1.0, 1.0, 65)
    counts = np.histogram2d((-dy * w).ravel(), (-dx * w).ravel(), bins=(edges, edges))[0]
    return np.asarray(counts / counts.sum())


def _histogram(height: Float64Array) -> Float64Array:
    """Return the normal histogram of a stretched relief."""
    return normal_histogram.histogram(height, pixel=(PIXEL_UM, PIXEL_UM * STRETCH_RATIO))


_fitted = partial(kernel_fit.fit_kernel, stretch=STRETCH_RATIO, axis="x", pixel_um=PIXEL_UM)


def _minimum_processor_s(call: Callable[[], object], repeats: int = 1) -> float:
    """Return the least processor time of repeated calls on one thread, s.

    Of two threads the first to finish spins until the other does, and the spinning counts as
    processor time. With other programs on the cores it can equal the work.
    """
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        return measure_processor_seconds(call, repeats)
    finally:
        numba.set_num_threads(threads)


def measure_kernel_search(stage: BenchmarkStage) -> None:
    """Measure kernel fits over pixels, search and first sample, then 2000 x 2000 against NumPy."""
    rng = np.random.default_rng(0)
    side = 64 if stage.toy else 256
    height = synthesize_relief(side, rng=rng)
    target = _histogram(strain_relief(height, rng=rng))
    alphas, sigmas = (ALPHA_GRID[::50], SIGMAS_UM[::20]) if stage.toy else (ALPHA_GRID, SIGMAS_UM)

    def fit(
        method: Literal["hierarchical", "exhaustive"], part: int, first: int, thin: int = 1
    ) -> kernel_outcome.KernelFit:
        search = kernel_fit.KernelSearch(method, first)
        grid = alphas[::thin], sigmas[::thin]
        return _fitted(height[:part, :part], target, search=search, grid=grid)

    best = fit("exhaustive", side, 2)
    whole = _grid_of(height, target)
    ways: list[tuple[Literal["hierarchical", "exhaustive"], int, int, int]] = [
        ("exhaustive", side, 2, 1),
        ("exhaustive", side, 2, 2 if stage.toy else 5),
        ("exhaustive", side // 2, 2, 1),
        ("hierarchical", side, 512 if stage.toy else 4096, 1),
    ]
    if not stage.toy:
        ways += [("hierarchical", side, 16_384, 1), ("exhaustive", side, 2, 10)]

    def error(found: kernel_outcome.KernelFit) -> ErrorEstimate:
        there = whole.distances(found.sigma_um, np.array([found.alpha]))
        return ErrorEstimate.symmetric(float(there[0]) - best.distance, 0.0)

    for way, part, first, thin in ways:
        only: Knobs = {"first sample": first} if way == "hierarchical" else {}
        knobs = {"search": way, "side": part, "every": thin, **only}
        fitted = partial(fit, way, part, first, thin)
        stage.measure(knobs, fitted, error, repeats=1, memory=False)
    if not stage.toy:
        stage.limits = _full_size(rng)


def _grid_of(
    height: Float64Array, target: Float64Array, sigmas_um: Float64Array = SIGMAS_UM
) -> kernel_search.KernelGrid:
    whole = neutral_relief.prepare_relief(
        height, stretch=STRETCH_RATIO, axis="x", pixel_um=PIXEL_UM
    )
    buckets = kernel_search.TargetBuckets(np.append(target.reshape(-1), 0.0), 64, 1.0)
    return kernel_search.KernelGrid(whole, buckets, ALPHA_GRID, sigmas_um)


def _full_size(rng: np.random.Generator) -> LimitValues:
    """Measure 2000 x 2000 with the default search, and exhaustive ones by some candidates."""
    height = synthesize_relief(FULL_SIDE_PX, rng=rng)
    target = _histogram(strain_relief(height, rng=rng))
    few = SIGMAS_UM[[10, 60, 150]]
    whole = _grid_of(height, target, few)
    ours_s = _minimum_processor_s(lambda: kernel_search.search_exhaustively(whole))
    ours_s *= SIGMAS_UM.size / few.size
    tried = [(-1.5, 6.0), (-0.2, 31.0), (0.7, 76.0)][:N_PEER_CANDIDATES]
    peer_s = _minimum_processor_s(lambda: [distance_with_numpy(height, target, *k) for k in tried])
    peer_s *= ALPHA_GRID.size * SIGMAS_UM.size / len(tried)
    mismatch = max(
        abs(
            distance_with_numpy(height, target, alpha, sigma)
            - float(whole.distances(sigma, np.array([alpha]))[0])
        )
        for alpha, sigma in tried
    )
    default_s = []
    for made in ("no kernel", "a kernel"):
        if made == "a kernel":
            moved = neutral_relief.convolve_relief(height, -0.63, 17.5, axis="x", pixel_um=PIXEL_UM)
            target = _histogram(np.asarray(moved, np.float64))

        run = partial(_fitted, height, target)
        default_s.append(
            _minimum_processor_s(run, repeats=2 if made == "no kernel" else 1) / LIMIT_CORES
        )
    found = run()
    return {
        "seconds": default_s[0],
        "seconds_kernel": default_s[1],
        "alpha": abs(found.alpha + 0.63) / 0.01,
        "sigma": abs(found.sigma_um - 17.5),
        "speed_up": peer_s / (ours_s / LIMIT_CORES),
        "difference": mismatch,
    }


def measure_histograms(stage: BenchmarkStage) -> None:
    """Measure normal histograms over pixels and bins, against numpy.histogram2d."""
    rng = np.random.default_rng(0)
    side = 96 if stage.toy else 1024
    truth_side = 256 if stage.toy else 2048
    truth_map = synthesize_relief(truth_side, rng=rng)
    for bins in (32, 64) if stage.toy else (16, 32, 64, 128):
        truth = normal_statistics.measure_normals(truth_map, pixel=PIXEL_UM, bins=bins)
        for part in (side // 2, side) if stage.toy else (128, 256, 512, 1024):
            patches = [
                np.ascontiguousarray(truth_map[rows, columns])
                for rows in (slice(part), slice(-part, None))
                for columns in (slice(part), slice(-part, None))
            ]
            measure_patch = partial(normal_statistics.measure_normals, pixel=PIXEL_UM, bins=bins)
            timing, _ = stage.time(lambda: measure_patch(patches[0]), memory=part == side)
            off = [
                normal_histogram.distance(measure_patch(patch).histogram, truth.histogram)
                for patch in patches
            ]
            stage.add({"side": part, "bins": bins}, timing, mean_error(off))
    height = truth_map[:side, :side]
    dx, dy, _ = relief_slopes.slopes(height, pixel=PIXEL_UM)
    theirs = partial(histogram_with_numpy, dx, dy)
    ours = partial(normal_histogram.from_slopes, dx, dy)
    repeats = 1 if stage.toy else 3
    times = _minimum_processor_s(theirs, repeats) / max(_minimum_processor_s(ours, repeats), 1e-9)
    stage.limits = {"speed_up": times, "distance": normal_histogram.distance(ours(), theirs())}
    stage.reference_error = float(
        normal_histogram.noise_floor(truth.histogram, truth.effective_samples, 1e12)
    )
    stage.description_values["truth_side"] = truth_side
