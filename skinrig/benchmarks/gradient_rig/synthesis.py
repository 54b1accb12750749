"""Benchmark of maps grown from patches against histogram-preserving blending."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy import fft
from scipy.special import ndtri

from model.displacement_synthesis import growth as displacement_synthesis
from model.displacement_synthesis.sources import level_patch
from reconstruction import normal_histogram
from reconstruction.normal_histogram import relief_slopes
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.arrays import Float32Array, Float64Array
from skinrig.benchmarks.measurement import (
    measure,
    measure_processor_seconds,
    measure_processor_time,
)
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

PIXEL_UM = 10.0
MAX_SIDE_PX = 16_384
N_THREADS = 2


def blend_hexagonal_tiles(
    patches: Sequence[Float32Array], size_px: int, *, edge_px: int, rng: np.random.Generator
) -> Float32Array:
    """Grow patches by blending hexagonal tiles with a preserved histogram of heights.

    Heights are mapped to a normal distribution by rank. Three tiles are blended at each pixel with
    weights divided by the root of their sum of squares, which preserves the variance. The ranks are
    then mapped back (Heitz and Neyret 2018, doi:10.1145/3233304). This is the peer of our method.

    Parameters
    ----------
    patches : sequence of (H, W) float32
        Heights, with a side of at least ``2 * edge_px + 2`` pixels.
    size_px
        Side of the map.
    edge_px
        Edge of the triangles between tile centers.
    rng
        Generator of the patch and the offset of each tile.
    """
    stack = np.stack(patches)
    ordered = np.sort(stack, axis=None)
    ranks = np.empty(stack.size)
    ranks[np.argsort(stack, axis=None, kind="stable")] = (np.arange(stack.size) + 0.5) / stack.size
    normal = ndtri(ranks).reshape(stack.shape)
    high = np.sqrt(0.75) * edge_px
    y, x = np.meshgrid(np.arange(size_px), np.arange(size_px), indexing="ij")
    b = y / high
    a = x / edge_px - 0.5 * b
    corner_a, corner_b = np.floor(a).astype(int), np.floor(b).astype(int)
    fa, fb = a - corner_a, b - corner_b
    upper = fa + fb > 1.0
    lowest = int(corner_a.min())
    shape = (int(corner_b.max()) + 2, int(corner_a.max()) - lowest + 2)
    which = rng.integers(len(patches), size=shape)
    reach = stack.shape[1] - 2 * edge_px - 2
    from_y, from_x = rng.integers(reach + 1, size=(2, *shape))
    total, square = np.zeros((size_px, size_px)), np.zeros((size_px, size_px))
    # barycentric weights of the three tile centers around each pixel
    for da, db, weight in (
        (np.where(upper, 1, 0), np.where(upper, 1, 0), np.where(upper, fa + fb - 1, 1 - fa - fb)),
        (np.where(upper, 0, 1), np.where(upper, 1, 0), np.where(upper, 1 - fa, fa)),
        (np.where(upper, 1, 0), np.where(upper, 0, 1), np.where(upper, 1 - fb, fb)),
    ):
        ca, cb = corner_a + da, corner_b + db
        local_y = np.rint(y - cb * high).astype(int) + edge_px
        local_x = np.rint(x - (ca + 0.5 * cb) * edge_px).astype(int) + edge_px
        index = (cb, ca - lowest)
        value = normal[which[index], from_y[index] + local_y, from_x[index] + local_x]
        total += weight * value
        square += weight**2
    levels = (np.arange(4096) + 0.5) / 4096
    quantile = np.interp(total / np.sqrt(square), ndtri(levels), np.quantile(ordered, levels))
    return quantile.astype(np.float32)


def slope_histogram(heights: Sequence[Float32Array]) -> Float64Array:
    """Return the mean 64 x 64 histogram of normals of several maps."""
    return np.asarray(
        np.mean([normal_histogram.histogram(h, pixel=PIXEL_UM) for h in heights], axis=0)
    )


def autocorrelation(height: Float32Array, *, reach_px: int = 64) -> Float64Array:
    """Return the autocorrelation of a map's slopes along y at offsets up to a reach."""
    slope = np.gradient(height.astype(np.float64), axis=0)
    rows, columns = (fft.next_fast_len(n + reach_px) for n in slope.shape)
    # Wiener-Khinchin with zero padding; the transform of ones counts the pairs at each offset
    power = np.abs(fft.rfft2(slope - slope.mean(), s=(rows, columns))) ** 2
    ones = np.abs(fft.rfft2(np.ones(slope.shape), s=(rows, columns))) ** 2
    whole = fft.irfft2(power, s=(rows, columns)) / fft.irfft2(ones, s=(rows, columns))
    near = np.roll(whole, (reach_px, reach_px), (0, 1))[: 2 * reach_px + 1, : 2 * reach_px + 1]
    return np.asarray(near / near[reach_px, reach_px])


def skewness_of_curvature(height: Float32Array) -> float:
    """Return the skewness of the negative Laplacian, nonzero for sharp grooves and round ridges."""
    bend = -sum(np.roll(height, s, a) for s in (-1, 1) for a in (0, 1)) + 4.0 * height
    inner = bend[1:-1, 1:-1].astype(np.float64)
    return float(((inner - inner.mean()) ** 3).mean() / inner.std() ** 3)


def measure_growth(stage: BenchmarkStage) -> None:
    """Measure growth over cells, overlaps and candidates; compare with blending; extrapolate."""
    site = "forehead"
    count, size_mm, side = (2, 1.6, 200) if stage.toy else (4, 8.0, 2048)
    patches = [
        level_patch(
            make_micro_skin(site, seed=seed, size_mm=size_mm, texel_um=PIXEL_UM).height_um,
            pixel_um=PIXEL_UM,
        )
        for seed in range(count)
    ]
    truth = slope_histogram(patches)
    halves = [slope_histogram(patches[part::2]) for part in (0, 1)]
    efforts = [(24, 8, 4), (32, 12, 4), (40, 16, 4)]
    if not stage.toy:
        efforts = [(64, 32, 16), (96, 32, 16), (128, 64, 16), *((192, 64, n) for n in (1, 16, 64))]
        efforts += [(256, 64, 16), (256, 128, 16)]
    for cell, overlap, tried in efforts:
        grow = partial(displacement_synthesis.grow, cells_px=(cell, overlap), candidates=tried)
        timing, grown = stage.time(
            lambda: grow(patches, side, rng=np.random.default_rng(1)),
            repeats=1,
            memory=(cell, tried) == (efforts[-1][0], efforts[-1][2]),
        )
        knobs: Knobs = {"method": "cut", "cell": cell, "overlap": overlap, "candidates": tried}
        stage.add(knobs, timing, _error(grown, truth))
    edge = 40 if stage.toy else 128
    blend = partial(blend_hexagonal_tiles, patches, side, edge_px=edge)
    timing, theirs = stage.time(
        lambda: blend(rng=np.random.default_rng(1)), repeats=1, memory=False
    )
    stage.add({"method": "blend", "cell": edge}, timing, _error(theirs, truth))
    stage.reference_error = normal_histogram.halved_distance(*halves)
    stage.description_values = {"count": count, "size_mm": size_mm, "side": side}
    if not stage.toy:
        stage.limits = _evaluate_growth(patches, truth, theirs)


def _error(height: Float32Array, truth: Float64Array) -> ErrorEstimate:
    """Return the error of a map with a jackknife interval over its quarters."""
    error = normal_histogram.halved_distance(slope_histogram([height]), truth)
    half = height.shape[0] // 2
    halves = (slice(None, half), slice(half, None))
    quarters = [
        normal_histogram.histogram(height[rows, columns], pixel=PIXEL_UM)
        for rows in halves
        for columns in halves
    ]
    # jackknife of four quarters: variance = 3/4 of the sum of squared deviations
    omitted = [
        normal_histogram.halved_distance((sum(quarters) - each) / 3.0, truth) for each in quarters
    ]
    stderr = float(np.sqrt(0.75 * np.sum((np.array(omitted) - np.mean(omitted)) ** 2)))
    return ErrorEstimate.nonnegative(error, stderr)


def _evaluate_growth(
    patches: Sequence[Float32Array], truth: Float64Array, reference_map: Float32Array
) -> LimitValues:
    """Build the layout of the largest map, draw some of its tiles and evaluate them."""
    rng = np.random.default_rng(0)
    layout_s, layout = measure_processor_time(
        lambda: displacement_synthesis.build_layout(
            patches, MAX_SIDE_PX, rng=rng, threads=N_THREADS
        )
    )
    tile = layout.tile(0, 0)
    rows, columns = tile.shape
    timing = measure(lambda: layout.tile(rows, columns), repeats=1)
    tile_s = measure_processor_seconds(lambda: layout.tile(rows, columns))
    tiles = sum(1 for _ in layout.tiles())
    site = layout.sites[0]
    held = site.sources.heights.nbytes * 2 + site.sources.filled.nbytes
    held += site.cells.nbytes + site.across.nbytes + site.down.nbytes
    memory_gb = (
        held + 1e6 * N_THREADS * (timing.peak_memory_mb or 0.0) + 4.0 * MAX_SIDE_PX**2
    ) / 1e9
    part = layout.draw((0, 2 * rows), (0, 2 * columns))
    cuts = layout.cut_mask((0, 2 * rows), (0, 2 * columns))
    slope_x, slope_y, _ = relief_slopes.slopes(part, pixel=PIXEL_UM)
    square = slope_x**2 + slope_y**2
    ours = normal_histogram.halved_distance(slope_histogram([part]), truth)
    skew = [skewness_of_curvature(h) for h in (part, reference_map)]
    expected_skew = float(np.mean([skewness_of_curvature(patch) for patch in patches]))
    expected = np.mean([autocorrelation(patch) for patch in patches], axis=0)
    mismatch = [
        float(np.sqrt(np.mean((autocorrelation(h) - expected) ** 2))) for h in (part, reference_map)
    ]
    blend = normal_histogram.halved_distance(slope_histogram([reference_map]), truth)
    return {
        "histogram": ours,
        "cuts": float(np.sqrt(square[cuts].mean() / square[~cuts].mean())),
        "memory": memory_gb,
        "minutes": (layout_s + tiles * tile_s) / 60.0,
        "slopes": blend / ours,
        "furrows": abs(skew[1] - expected_skew) / max(abs(skew[0] - expected_skew), 1e-9),
        "autocorrelation": mismatch[0] / mismatch[1],
    }
