"""Parts of the standard errors of kernels: blocks, valleys, and counts kept by a search."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction import kernel_fit, normal_histogram
from reconstruction.kernel_fit import errors as kernel_errors
from reconstruction.kernel_fit import neutral_relief
from reconstruction.kernel_fit import search as kernel_search
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.normal_histogram import kernels, relief_slopes

ALPHAS, SIGMAS_UM = np.linspace(-1.0, 1.0, 21), np.linspace(2.0, 40.0, 20)


def case(rng, side=128):
    height = 8.0 * gaussian_filter(rng.standard_normal((side, side)), 2.0)
    height += gaussian_filter(rng.standard_normal((side, side)), 1.0)
    target = normal_histogram.histogram(
        1.1 * height + 0.2 * gaussian_filter(rng.standard_normal((side, side)), 1.0), pixel=6.0
    )
    relief = neutral_relief.prepare_relief(height, stretch=1.0, axis="x", pixel_um=6.0)
    buckets = kernel_search.TargetBuckets(np.append(target.reshape(-1), 0.0), 64, 1.0)
    return kernel_search.KernelGrid(relief, buckets, ALPHAS, SIGMAS_UM)


def test_counts_kept_by_search_cover_all_pixels(rng):
    grid = case(rng)
    found = kernel_search.search_hierarchically(grid, first_sample=1024, rng=rng)
    assert set(found.counts) == set(map(tuple, np.argwhere(found.exact).tolist()))
    assert 0 < len(found.counts) < found.distance.size
    wanted = np.array([[0, 0], found.best, [19, 20], [0, 3]])
    shares = found.histograms(grid, wanted)
    for row, (i, j) in zip(shares, wanted, strict=True):
        counts = grid.count(SIGMAS_UM[i], ALPHAS[[j]]).sum(axis=(0, 1))
        np.testing.assert_array_equal(row, counts / grid.relief.places.size)
        if found.exact[i, j]:
            apart = np.abs(row - grid.buckets.target).sum()
            assert apart == pytest.approx(found.distance[i, j], abs=1e-12)


def test_errors_are_equal_from_kept_and_new_counts(rng):
    grid = case(rng)
    found = kernel_search.search_hierarchically(grid, first_sample=1024, rng=rng)
    i, j = found.best
    blocks = kernel_errors.count_blocks(grid, float(ALPHAS[j]), float(SIGMAS_UM[i]))
    noise, scatter = (
        blocks.distance_stderr(grid.buckets.target, 1e4),
        blocks.block_contributions(1e4),
    )
    drawn = [
        kernel_errors.HistogramResampling(grid, found, noise, np.random.default_rng(5))
        for _ in range(2)
    ]
    with_counts = drawn[0].best_kernel_widths(scatter)
    found.counts.clear()
    without = drawn[1].best_kernel_widths(scatter)
    assert with_counts == without
    assert with_counts.alpha[0] > 0.0


def test_kept_counts_stay_within_granted_memory(rng, monkeypatch):
    grid = case(rng)
    monkeypatch.setattr(kernel_search, "MAX_CACHED_COUNT_BYTES", 3 * 4 * (64 * 64 + 1))
    found = kernel_search.search_hierarchically(grid, first_sample=1024, rng=rng)
    assert len(found.counts) == 3


def test_the_valley_begins_with_the_best_and_rises(rng):
    grid = case(rng, side=48)
    found = kernel_search.search_exhaustively(grid)
    near = kernel_errors.near_best_kernels(grid, found, 0.05)
    assert tuple(near[0]) == found.best
    distance = found.distance[tuple(near.T)]
    assert (np.diff(distance[1:]) >= 0.0).all()
    assert len(near) == np.count_nonzero(found.distance <= found.distance.min() + 0.05)


def test_bounds_are_the_sums_of_plain_numpy(rng):
    """Numbers of buckets that fill lanes and that do not, two parts, and patterns of signs."""
    for cells in (9, 64, 257):
        first, second = rng.poisson(3.0, (2, 2, 5, cells)).astype(np.int32)
        target = rng.dirichlet(np.ones(cells))
        signs = np.sign(rng.standard_normal((2, cells)))
        before, fresh, pixels = 5000, 9000, 100_000
        found = kernels.distance_bounds(first, second, target, before, fresh, pixels, signs)
        x, y = first.sum(axis=0), second.sum(axis=0)
        gap = target - (x + y * (pixels - before) / fresh) / pixels
        lows = [np.sum(np.sign(target - x / before) * gap, axis=1), *(gap @ signs.T).T]
        sampled = np.abs(target - (x + y) / (before + fresh)).sum(axis=1)
        np.testing.assert_allclose(found, np.stack([sampled, np.max(lows, axis=0)], 1), rtol=1e-12)


def paired(height, strained, blocks=normal_blocks.BLOCKS_PER_SIDE):
    """Return counts of a strained map in the blocks of the neutral one, pixel by pixel."""
    rows, columns = normal_blocks.block_grid_shape(height.shape, blocks)
    group, groups = normal_blocks.assign_blocks(np.arange(height.size), height.shape, blocks)
    counts = normal_blocks.count_block_normals(
        strained, group.reshape(height.shape), groups, pixel=6.0, bins=64
    )
    return counts.reshape(rows, columns, 64, 64)


def strained_pair(rng, side=96):
    """Return a relief and what a kernel and a little of something else make of it."""
    height = 8.0 * gaussian_filter(rng.standard_normal((side, side)), 2.0)
    deeper = neutral_relief.convolve_relief(height, -0.4, 15.0, axis="x", pixel_um=6.0)
    return height, deeper + 0.3 * gaussian_filter(rng.standard_normal((side, side)), 1.0)


TOLD = {
    "stretch": 1.0,
    "pixel_um": 6.0,
    "grid": (ALPHAS, SIGMAS_UM),
    "search": kernel_fit.KernelSearch("exhaustive"),
}


def test_single_skin_piece_determines_kernel_better_than_two(rng):
    height, strained = strained_pair(rng)
    target = normal_histogram.histogram(strained, pixel=6.0)
    alone = kernel_fit.fit_kernel(height, target, axis="x", **TOLD)
    same = kernel_fit.fit_kernel(
        height, target, axis="x", target_blocks=paired(height, strained), **TOLD
    )
    assert (same.alpha, same.sigma_um, same.distance) == (
        alone.alpha,
        alone.sigma_um,
        alone.distance,
    )
    assert same.alpha_stderr < alone.alpha_stderr
    # blocks of the map turned about are those of other skin: then nothing is in common
    other = kernel_fit.fit_kernel(
        height, target, axis="x", target_blocks=paired(height, strained)[::-1, ::-1], **TOLD
    )
    assert other.alpha_stderr > same.alpha_stderr
    for fit in (alone, same, other):
        assert fit.alpha_95 >= 1.959 * fit.alpha_stderr
        assert fit.sigma_95_um >= 1.959 * fit.sigma_stderr_um


def test_errors_of_transposed_map_are_equal(rng):
    """Rows for columns, in the map, its target and its blocks: y up turns into x to the right."""
    height, strained = strained_pair(rng, side=64)
    fits = []
    for axis, a, b in (
        ("x", height, strained),
        ("y", height.T[::-1, ::-1], strained.T[::-1, ::-1]),
    ):
        target = normal_histogram.histogram(b, pixel=6.0)
        fits.append(kernel_fit.fit_kernel(a, target, axis=axis, target_blocks=paired(a, b), **TOLD))
    first, second = fits
    assert (first.alpha, first.sigma_um) == (second.alpha, second.sigma_um)
    assert second.alpha_stderr == pytest.approx(first.alpha_stderr, rel=0.3)


def test_pairs_without_resamples_are_refused_or_fall_back(rng):
    height, strained = strained_pair(rng, side=48)
    target, blocks = normal_histogram.histogram(strained, pixel=6.0), paired(height, strained)
    alone = kernel_fit.fit_kernel(height, target, axis="x", **TOLD)
    few = np.where(np.arange(64).reshape(8, 8, 1, 1) < 4, blocks, 0)
    fit = kernel_fit.fit_kernel(height, target, axis="x", target_blocks=few, **TOLD)
    assert fit.alpha_stderr == alone.alpha_stderr  # of four blocks no scatter: as of other skin
    for wrong in (blocks[:7], blocks[..., :32], -blocks):
        with pytest.raises(neutral_relief.KernelFitError, match="target_blocks"):
            kernel_fit.fit_kernel(height, target, axis="x", target_blocks=wrong, **TOLD)


def test_normals_are_counted_in_blocks_of_any_shape(rng):
    height = 5.0 * gaussian_filter(rng.standard_normal((40, 50)), 2.0)
    block = rng.integers(-1, 3, height.shape)
    counts = normal_blocks.count_block_normals(height, block, 3, pixel=6.0, angle_rad=0.3)
    for k in range(3):
        a, b, _ = relief_slopes.slopes(height, pixel=6.0)
        x, y = relief_slopes.rotate_components(a[block == k], b[block == k], 0.3)
        np.testing.assert_allclose(
            counts[k] / counts[k].sum(), normal_histogram.from_slopes(x, y), atol=1e-12
        )
    assert counts.sum() == np.count_nonzero(block >= 0)
