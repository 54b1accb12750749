"""What standard errors of kernels are made of: blocks, valleys, and counts that a search kept."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction import kernel_errors, kernel_fit, kernel_search, normal_histogram
from reconstruction import kernel_fit_kernels as kernels

ALPHAS, SIGMAS_UM = np.linspace(-1.0, 1.0, 21), np.linspace(2.0, 40.0, 20)


def case(rng, side=128):
    height = 8.0 * gaussian_filter(rng.standard_normal((side, side)), 2.0)
    height += gaussian_filter(rng.standard_normal((side, side)), 1.0)
    target = normal_histogram.histogram(
        1.1 * height + 0.2 * gaussian_filter(rng.standard_normal((side, side)), 1.0), pixel=6.0
    )
    relief = kernel_fit.relief_of(height, stretch=1.0, axis="x", pixel_um=6.0)
    return relief, kernel_search.Buckets(np.append(target.reshape(-1), 0.0), 64, 1.0)


def test_counts_that_a_search_kept_are_those_of_all_pixels(rng):
    relief, buckets = case(rng)
    found = kernel_search.hierarchical(
        relief, buckets, ALPHAS, SIGMAS_UM, first_sample=1024, rng=rng
    )
    assert set(found.counts) == set(map(tuple, np.argwhere(found.exact).tolist()))
    assert 0 < len(found.counts) < found.distance.size
    wanted = np.array([[0, 0], found.best, [19, 20], [0, 3]])
    shares = found.shares(relief, buckets, SIGMAS_UM, ALPHAS, wanted)
    for row, (i, j) in zip(shares, wanted, strict=True):
        change = relief.change(float(SIGMAS_UM[i]))
        counts = buckets.count((relief.along, relief.across), change, ALPHAS[[j]]).sum(axis=(0, 1))
        np.testing.assert_array_equal(row, counts / relief.places.size)
        if found.exact[i, j]:
            apart = np.abs(row - buckets.target).sum()
            assert apart == pytest.approx(found.distance[i, j], abs=1e-12)


def test_errors_are_the_same_from_kept_counts_and_from_new_ones(rng):
    relief, buckets = case(rng)
    found = kernel_search.hierarchical(
        relief, buckets, ALPHAS, SIGMAS_UM, first_sample=1024, rng=rng
    )
    i, j = found.best
    blocks = kernel_errors.of_kernel(relief, buckets, float(ALPHAS[j]), float(SIGMAS_UM[i]))
    noise, scatter = blocks.noise(buckets.target, 1e4), blocks.scatter(1e4)
    told = {"noise": noise, "scatter": scatter}
    with_counts = kernel_errors.stderr_of_best(
        relief, buckets, found, ALPHAS, SIGMAS_UM, **told, rng=np.random.default_rng(5)
    )
    found.counts.clear()
    without = kernel_errors.stderr_of_best(
        relief, buckets, found, ALPHAS, SIGMAS_UM, **told, rng=np.random.default_rng(5)
    )
    assert with_counts == without
    assert with_counts[0] > 0.0


def test_no_more_counts_are_kept_than_memory_is_granted(rng, monkeypatch):
    relief, buckets = case(rng)
    monkeypatch.setattr(kernel_search, "KEPT_BYTES", 3 * 4 * (64 * 64 + 1))
    found = kernel_search.hierarchical(
        relief, buckets, ALPHAS, SIGMAS_UM, first_sample=1024, rng=rng
    )
    assert len(found.counts) == 3


def test_the_valley_begins_with_the_best_and_rises(rng):
    relief, buckets = case(rng, side=48)
    found = kernel_search.exhaustive(relief, buckets, ALPHAS, SIGMAS_UM)
    near = kernel_errors.nearly_as_good(found, ALPHAS, SIGMAS_UM, 0.05)
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
        found = kernels.bounds(first, second, target, before, fresh, pixels, signs)
        x, y = first.sum(axis=0), second.sum(axis=0)
        gap = target - (x + y * (pixels - before) / fresh) / pixels
        lows = [np.sum(np.sign(target - x / before) * gap, axis=1), *(gap @ signs.T).T]
        sampled = np.abs(target - (x + y) / (before + fresh)).sum(axis=1)
        np.testing.assert_allclose(found, np.stack([sampled, np.max(lows, axis=0)], 1), rtol=1e-12)
