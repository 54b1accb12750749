"""Noise in space: variance, spectrum, isotropy, and places alone decide."""

import time

import numpy as np
import pytest
from scipy.stats import kstest

from model.displacement_synthesis.volume_noise import VolumeNoise, VolumeNoiseError, _sum_of_waves


def noise(seed=0, **changes):
    about = {"rms_um": 5.0, "band_per_mm": (1.0, 8.0), "slope": -1.0, "waves": 256, **changes}
    return VolumeNoise.draw(rng=np.random.default_rng(seed), **about)


def test_cosines_are_those_of_numpy(rng):
    one = noise()
    points = rng.uniform(-100.0, 100.0, (700, 3))
    phase = points @ one.waves_per_mm.T + one.phases
    plain = 5.0 * np.sqrt(2 / 256) * np.cos(2 * np.pi * phase).sum(axis=1)
    np.testing.assert_allclose(one.at(points), plain, atol=2e-7)


def test_wave_is_cosine_of_its_cycles():
    turns = np.linspace(-3.0, 3.0, 1001)
    points = np.stack([turns, 0 * turns, 0 * turns], axis=1)
    out = np.empty(turns.size)
    _sum_of_waves(points, np.array([[1.0, 0.0, 0.0]]), np.zeros(1), 1.0, out)
    np.testing.assert_allclose(out, np.cos(2 * np.pi * turns), atol=1e-9)


def test_spatial_variance_matches_requested_variance(rng):
    """Of one draw, over a cube far larger than its waves; 20,000 independent places: 1 % error of
    the variance for normal values, limit 4 standard errors."""
    values = noise().at(rng.uniform(0.0, 1000.0, (20_000, 3)))
    assert abs(values.var() / 25.0 - 1.0) < 4 * np.sqrt(2 / 20_000)
    assert abs(values.mean()) < 4 * 5.0 / np.sqrt(20_000)


@pytest.mark.parametrize("slope", [-1.0, 0.0, -3.0])
def test_covariance_over_draws_matches_stated_spectrum(slope):
    """400 draws at places of fixed distance; limit 4 standard errors at 6 distances: fails by
    chance once in 2,600."""
    distances = np.array([0.0, 0.03, 0.06, 0.12, 0.25, 0.6])
    places = np.zeros((6, 3))
    places[:, 0] = distances * 0.6
    places[:, 2] = distances * 0.8
    draws = np.stack([noise(seed, slope=slope).at(places + 3.0) for seed in range(400)])
    products = draws * draws[:, :1]
    stderr = products.std(axis=0, ddof=1) / 20.0
    expected = noise(slope=slope).covariance(distances)
    assert (np.abs(products.mean(axis=0) - expected) < 4 * stderr).all()
    other = noise(slope=slope, band_per_mm=(2.0, 16.0)).covariance(distances)
    assert (np.abs(products.mean(axis=0) - other) > 4 * stderr).any()


def test_no_power_is_outside_the_band():
    """A line through space shows wave numbers up to the largest one, and none beyond."""
    x = np.arange(8192) * 0.02
    line = noise().at(np.stack([x, 0 * x, 0 * x], axis=1)) * np.hanning(x.size)
    power = np.abs(np.fft.rfft(line)) ** 2
    k = np.fft.rfftfreq(x.size, 0.02)
    assert power[k > 8.1].sum() < 1e-6 * power.sum()
    assert power[(k > 4.0) & (k < 8.0)].sum() > 1e-3 * power.sum()


def test_unit_negative_slope_gives_equal_power_per_octave():
    k = np.linalg.norm(noise(waves=3000).waves_per_mm, axis=1)
    octaves = np.histogram(k, [1, 2, 4, 8])[0] / 3000
    np.testing.assert_allclose(octaves, 1 / 3, atol=2e-3)


def test_values_are_nearly_normal(rng):
    """Kolmogorov-Smirnov on 2,000 places of one draw; false alarms: one in 10,000."""
    values = noise(waves=1024).at(rng.uniform(0.0, 1000.0, (2000, 3)))
    assert kstest(values / 5.0, "norm").pvalue > 1e-4


def test_no_direction_is_preferred():
    waves = noise(waves=4096).waves_per_mm
    tensor = waves.T @ waves / (waves**2).sum()
    np.testing.assert_allclose(tensor, np.eye(3) / 3, atol=0.02)


def test_slope_variance_matches_spectrum(rng):
    one, step = noise(), 1e-4
    at = rng.uniform(0.0, 1000.0, (20_000, 3))
    slope = (one.at(at + np.array([step, 0.0, 0.0])) - one.at(at)) / (step * 1e3)
    assert abs(slope.var() / one.slope_variance - 1.0) < 0.1


def test_position_value_is_independent_of_other_queries(rng):
    one, points = noise(), rng.uniform(-50.0, 50.0, (3, 400, 3))
    whole = one.at(points)
    np.testing.assert_array_equal(one.at(points[1, 7:9]), whole[1, 7:9])
    np.testing.assert_array_equal(noise().at(points), whole)
    assert not np.array_equal(noise(1).at(points), whole)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"band_per_mm": (0.0, 2.0)}, "band_per_mm"),
        ({"band_per_mm": (3.0, 2.0)}, "band_per_mm"),
        ({"rms_um": -1.0}, "rms_um"),
        ({"rms_um": np.nan}, "rms_um"),
        ({"slope": np.inf}, "slope"),
        ({"waves": 1}, "waves"),
    ],
)
def test_invalid_spectrum_is_refused(changes, message):
    with pytest.raises(VolumeNoiseError, match=message):
        noise(**changes)


@pytest.mark.parametrize("points", [np.zeros(2), np.full((2, 3), np.nan)])
def test_invalid_positions_are_refused(points):
    with pytest.raises(VolumeNoiseError, match="points_mm"):
        noise().at(points)


@pytest.mark.long
def test_a_megapixel_takes_less_than_three_seconds(rng):
    one, points = noise(), rng.uniform(0.0, 10.0, (1_000_000, 3))
    one.at(points[:10])
    begin = time.process_time()
    one.at(points)
    assert time.process_time() - begin < 3.0
