"""The sensor chain against its own physics: means, variances, levels, pattern."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from capture.rig import load_rig
from rigsim.sensor import (
    Sensor,
    SensorError,
    apply_cfa,
    color_filters,
    expose_sensor,
    fixed_pattern,
    make_sensor,
)

FALSE_ALARM = 1e-4  # two-sided, per statistical test below


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(12345)


@pytest.fixture
def ideal() -> Sensor:
    """Shot noise, read noise and rounding only."""
    return Sensor(
        full_well_e=40_000.0,
        gain_e_per_dn=2.5,
        read_noise_e=5.0,
        dark_e_per_s=0.0,
        prnu=0.0,
        dsnu_e=0.0,
        black=383,
        white=16_383,
        bits=14,
        cfa="MONO",
        vignetting=0.0,
        serial="T-1",
    )


def gray(value: float, shape: tuple[int, int] = (128, 128)) -> np.ndarray:
    return np.full(shape, value, np.float32)


@pytest.mark.parametrize("level", [0.0, 0.003, 0.05, 0.3, 0.9])
def test_the_mean_is_linear_in_the_light(ideal, rng, level):
    dn = expose_sensor(gray(level), sensor=ideal, rng=rng).astype(np.float64)
    scale, offset = ideal.noise_profile()
    sigma = math.sqrt((scale * level + offset) / dn.size)
    z = ((dn.mean() - 383.0) / 16_000.0 - level) / sigma
    assert abs(z) < stats.norm.isf(FALSE_ALARM / 2)


@pytest.mark.parametrize("level", [0.0, 0.003, 0.05, 0.3, 0.9])
def test_variance_follows_photon_transfer_line(ideal, rng, level):
    dn = expose_sensor(gray(level), sensor=ideal, rng=rng).astype(np.float64)
    scale, offset = ideal.noise_profile()
    expected = (scale * level + offset) * 16_000.0**2
    # The sum of squares is chi-square distributed to a good approximation at these counts.
    chi2 = dn.var(ddof=1) * (dn.size - 1) / expected
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], dn.size - 1)
    assert low < chi2 < high


def test_gain_error_of_a_tenth_misses_transfer_line(ideal, rng):
    dn = expose_sensor(gray(0.3), sensor=ideal, rng=rng).astype(np.float64)
    wrong = dataclasses.replace(ideal, gain_e_per_dn=2.75)
    scale, offset = wrong.noise_profile()
    chi2 = dn.var(ddof=1) * (dn.size - 1) / ((scale * 0.3 + offset) * 16_000.0**2)
    assert chi2 > stats.chi2.ppf(1 - FALSE_ALARM / 2, dn.size - 1)


def test_dark_current_adds_its_mean_and_its_variance(ideal, rng):
    warm = dataclasses.replace(ideal, dark_e_per_s=200.0)
    dn = expose_sensor(gray(0.0, (256, 256)), sensor=warm, rng=rng, exposure_s=2.0).astype(
        np.float64
    )
    expected_e = 400.0
    z = ((dn.mean() - 383.0) * 2.5 - expected_e) / math.sqrt((400.0 + 25.0) / dn.size)
    assert abs(z) < stats.norm.isf(FALSE_ALARM / 2)
    assert dn.var() * 2.5**2 == pytest.approx(400.0 + 25.0 + 2.5**2 / 12.0, rel=0.03)


def test_saturated_pixels_all_read_the_white_level(ideal, rng):
    dn = expose_sensor(gray(1.2), sensor=ideal, rng=rng)
    assert (dn == 16_383).all()
    assert (expose_sensor(gray(1e6), sensor=ideal, rng=rng) == 16_383).all()


def test_black_level_keeps_lower_half_of_read_noise(ideal, rng):
    dn = expose_sensor(gray(0.0), sensor=ideal, rng=rng)
    assert dn.min() < 383 < dn.max()
    # A clipped or rectified sensor has no symmetric noise about its black level.
    below, above = int((dn < 383).sum()), int((dn > 383).sum())
    assert stats.binomtest(below, below + above).pvalue > FALSE_ALARM


def test_the_converter_never_leaves_its_range(ideal, rng):
    noisy = dataclasses.replace(ideal, read_noise_e=5000.0, black=10)
    dn = expose_sensor(gray(0.01), sensor=noisy, rng=rng)
    assert dn.min() == 0
    assert dn.max() <= 16_383


def test_pixel_responses_differ_by_prnu_equally_every_frame(ideal, rng):
    uneven = dataclasses.replace(ideal, prnu=0.02, read_noise_e=0.0)
    frames = [
        expose_sensor(gray(0.9, (64, 64)), sensor=uneven, rng=rng).astype(np.float64)
        for _ in range(64)
    ]
    mean = np.mean(frames, axis=0) - 383.0
    assert mean.std() / mean.mean() == pytest.approx(0.02, rel=0.05)
    other = dataclasses.replace(uneven, serial="T-2")
    same = np.corrcoef(mean.ravel(), fixed_pattern(uneven, (64, 64)).response.ravel())[0, 1]
    unlike = np.corrcoef(mean.ravel(), fixed_pattern(other, (64, 64)).response.ravel())[0, 1]
    assert same > 0.95
    assert abs(unlike) < stats.norm.isf(FALSE_ALARM / 2) / 64.0


def test_vignetting_dims_corner_as_stated_and_not_center(ideal, rng):
    dark_corners = dataclasses.replace(ideal, vignetting=0.3)
    dn = (
        expose_sensor(gray(0.8, (201, 301)), sensor=dark_corners, rng=rng).astype(np.float64)
        - 383.0
    )
    corner = np.mean([dn[:4, :4], dn[-4:, :4], dn[:4, -4:], dn[-4:, -4:]])
    middle = dn[98:103, 148:153].mean()
    assert corner / middle == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize(
    ("cfa", "cell"),
    [
        ("RGGB", [[1, 2], [2, 3]]),
        ("BGGR", [[3, 2], [2, 1]]),
        ("GRBG", [[2, 1], [3, 2]]),
        ("GBRG", [[2, 3], [1, 2]]),
    ],
)
def test_mosaic_repeats_cell_from_top_left(cfa, cell):
    flat = np.broadcast_to(np.array([1.0, 2.0, 3.0], np.float32), (4, 6, 3))
    np.testing.assert_array_equal(apply_cfa(flat, cfa), np.tile(cell, (2, 3)))


def test_same_seed_gives_same_frame_another_seed_another(ideal):
    light = gray(0.4)
    before = light.copy()
    frames = [
        expose_sensor(light, sensor=ideal, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2]).any()
    np.testing.assert_array_equal(light, before)


def test_view_sensor_saturates_at_full_well():
    view = load_rig("flash").view("cam")
    sensor = make_sensor(view)
    electrons = sensor.gain_e_per_dn * (sensor.white - sensor.black)
    assert electrons == pytest.approx(view.full_well_e)
    scale, offset = sensor.noise_profile()
    assert scale == pytest.approx(1.0 / view.full_well_e)
    assert offset >= (view.read_noise_e / view.full_well_e) ** 2


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"full_well_e": 0.0}, "full_well_e: got 0.0"),
        ({"black": 20_000}, "black, white"),
        ({"cfa": "RGBG"}, "cfa: got 'RGBG'"),
        ({"prnu": math.nan}, "prnu: got nan"),
    ],
)
def test_a_wrong_sensor_is_named(ideal, change, word):
    with pytest.raises(SensorError, match=word):
        dataclasses.replace(ideal, **change)


@pytest.mark.parametrize("light", [gray(-0.1), gray(math.nan), np.zeros((4, 4, 2), np.float32)])
def test_impossible_light_is_refused(ideal, rng, light):
    sensor = dataclasses.replace(ideal, cfa="RGGB")
    with pytest.raises(SensorError, match="irradiance_rgb"):
        expose_sensor(light, sensor=sensor, rng=rng)


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "MONO"])
def test_light_behind_filters_gives_frame_of_colors(ideal, cfa):
    sensor = dataclasses.replace(ideal, cfa=cfa)
    color = np.array([0.25, 0.5, 0.125], np.float32)
    light = gray(0.5, (5, 7))[..., None] * color
    behind = color_filters(gray(0.5, (5, 7)), color, cfa)
    assert behind == pytest.approx(apply_cfa(light, cfa))
    frames = [
        expose_sensor(one, sensor=sensor, rng=np.random.default_rng(3)) for one in (light, behind)
    ]
    assert np.array_equal(*frames)
