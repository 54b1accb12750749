import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from reconstruction import normal_histogram as nh
from reconstruction.normal_histogram.statistics import measure_normals


def rough(side, rng, *, correlation_px=2.0, slope=0.3):
    height = gaussian_filter(rng.standard_normal((side, side)), correlation_px, mode="wrap")
    return height * slope / np.gradient(height)[1].std()


def test_flat_patch_fills_single_bucket_without_aliasing():
    flat = measure_normals(np.zeros((20, 20)), pixel=1.0)
    assert flat.occupied == 1
    assert flat.variance_x == flat.variance_y == flat.stderr_x == 0.0
    assert not flat.aliased
    assert flat.histogram.sum() == 1.0


def test_few_samples_for_many_buckets_are_called_aliased(rng):
    height = rough(32, rng)
    assert measure_normals(height, pixel=1.0).aliased
    assert not measure_normals(height, pixel=1.0, bins=4).aliased


def test_normals_beyond_the_limit_are_counted_apart():
    height = np.tile(np.arange(8.0), (8, 1))
    height[:, 4:] = height[:, 4:5]  # steep on the left, flat on the right
    found = measure_normals(height, pixel=1.0, limit=0.6)
    assert found.outside == 4 * 8  # columns 0...3 rise by 1 a pixel: n_x = -0.71
    assert found.samples == height.size - found.outside
    assert found.histogram.sum() == pytest.approx(1.0)


def test_standard_error_of_variances_is_their_scatter(rng):
    """Rationale: blocks are far larger than the correlation length of 3 px.

    The ratio of a standard deviation of 60 values to its mean estimate lies within 0.72...1.28
    in 99.7 %; blocks cut neighbours apart, which adds a little.
    """
    found = []
    for _ in range(60):
        white = rng.standard_normal((160, 160))
        found.append(measure_normals(13.0 * gaussian_filter(white, 3.0, mode="wrap"), pixel=1.0))
    scatter = np.std([m.variance_y for m in found], ddof=1)
    assert 0.7 < scatter / np.mean([m.stderr_y for m in found]) < 1.35
    plain = np.mean([np.sqrt(2 / m.samples) * m.variance_y for m in found])
    assert scatter > 2.0 * plain  # as if pixels were independent: too small


def test_effective_normal_count_predicts_distance_of_two_patches(rng):
    pairs = [
        [measure_normals(rough(192, rng, correlation_px=5.0), pixel=1.0, bins=16) for _ in range(2)]
        for _ in range(12)
    ]
    real = np.mean([nh.distance(a.histogram, b.histogram) for a, b in pairs])
    effective = [m.effective_samples for pair in pairs for m in pair]
    told = nh.noise_floor(pairs[0][0].histogram, float(np.mean(effective)))
    naive = nh.noise_floor(pairs[0][0].histogram, pairs[0][0].samples)
    assert 0.7 < real / told < 1.4
    assert real / naive > 2.0
