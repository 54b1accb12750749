"""Means of repeats: what they err by is told of their colors, not of flashes that repeat less."""

import numpy as np
import pytest

from reconstruction.facial_color import repeat_average

NOISE = 0.004


def repeats(rng, *, count=2, size=60, color=1.0, brightness=0.0):
    """Pictures of one skin whose repeats differ by `color` times their noise, and in brightness."""
    skin = np.array([0.5, 0.3, 0.2]) * np.exp(0.2 * rng.standard_normal((size, size, 1)))
    shape = (count, size, size, 3)
    relative = 1.0 + color * NOISE * rng.standard_normal(shape)
    relative *= 1.0 + brightness * rng.standard_normal((count, 1, 1, 1))
    rgb = (skin * relative).astype(np.float32)
    variance = np.broadcast_to(np.square(NOISE * skin), shape).astype(np.float32)
    return rgb, variance, np.ones(shape[:-1], bool), skin


@pytest.mark.parametrize("count", [2, 3, 5])
def test_mean_variance_is_that_of_its_errors(rng, count):
    """Tolerance: 5 standard errors of a variance of 10,800 numbers."""
    rgb, variance, valid, skin = repeats(rng, count=count)
    mean, told, known = repeat_average.average_repeats(rgb, variance, valid)
    error = (mean - skin) / np.sqrt(told)
    assert known.all()
    assert np.mean(np.square(error)) == pytest.approx(1.0, abs=5 * np.sqrt(2 / error.size) + 0.02)


@pytest.mark.parametrize("count", [2, 4])
def test_colors_repeating_worse_than_noise_widen_error(rng, count):
    """Tolerance: the median of 3,600 chi-squared numbers is off by 3 % at most."""
    rgb, variance, valid, _ = repeats(rng, count=count, color=3.0)
    assert repeat_average.overdispersion(rgb, variance, valid) == pytest.approx(9.0, rel=0.09)
    told = repeat_average.average_repeats(rgb, variance, valid)[1]
    assert np.median(told / variance[0]) == pytest.approx(9.0 / count, rel=0.1)


@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("ratio", [4.0, 16.0, 100.0])
def test_repeats_of_unequal_noise_do_not_raise_overdispersion(rng, count, ratio):
    """Rationale: one repeat of a shorter exposure has more noise, which its variance tells.

    Tolerance: 4 standard errors of the median of 10,000 chi-squared numbers.
    """
    rgb, variance, valid, skin = repeats(rng, count=count, size=100)
    rgb[1] = skin * (1.0 + np.sqrt(ratio) * (rgb[1] / skin - 1.0))
    assert repeat_average.overdispersion(rgb, variance, valid) > 1.3
    variance[1] *= ratio
    assert repeat_average.overdispersion(rgb, variance, valid) == pytest.approx(1.0, abs=0.06)


def test_less_repeatable_flashes_are_not_color_errors(rng):
    """Rationale: two percent from flash to flash are five times the noise of each pixel; all
    channels alike have them."""
    rgb, variance, valid, _ = repeats(rng, count=3, brightness=0.02)
    scatter = np.mean(rgb.var(axis=0, ddof=1) / variance[0])
    assert scatter > 5.0
    assert repeat_average.overdispersion(rgb, variance, valid) == pytest.approx(1.0, abs=0.05)


def test_few_misregistered_pixels_do_not_dominate(rng):
    rgb, variance, valid, _ = repeats(rng)
    rgb[1, :6] = rgb[1, :6, ::-1] * [1.0, 1.3, 0.8]
    assert np.mean(np.square(rgb[1] - rgb[0]) / variance[0]) > 20.0
    assert repeat_average.overdispersion(rgb, variance, valid) < 1.3


def test_pixel_is_mean_of_repeats_that_show_pixel(rng):
    rgb, variance, valid, _ = repeats(rng)
    one = variance[0].copy()
    valid[0, :10], valid[1, 5:20] = False, False
    rgb[~valid], variance[~valid] = np.nan, np.nan
    mean, told, known = repeat_average.average_repeats(rgb, variance, valid)
    np.testing.assert_array_equal(known, valid.any(axis=0))
    np.testing.assert_array_equal(mean[:5], rgb[1, :5])
    np.testing.assert_array_equal(mean[10:20], rgb[0, 10:20])
    assert not mean[5:10].any()
    assert not told[5:10].any()
    single, double = np.median(told[:5] / one[:5]), np.median(told[30:] / one[30:])
    assert single / double == pytest.approx(2.0, rel=1e-5)


def test_single_image_is_its_own_average(rng):
    rgb, variance, valid, _ = repeats(rng, count=1, color=5.0)
    mean, told, _ = repeat_average.average_repeats(rgb, variance, valid)
    np.testing.assert_array_equal(mean, rgb[0])
    np.testing.assert_array_equal(told, variance[0])


@pytest.mark.parametrize(
    ("rgb", "variance", "valid", "match"),
    [
        (np.ones((2, 4, 4)), np.ones((2, 4, 4)), np.ones((2, 4), bool), "rgb"),
        (np.ones((2, 4, 4, 3)), np.ones((4, 4, 3)), np.ones((2, 4, 4), bool), "variance"),
        (np.ones((2, 4, 4, 3)), np.ones((2, 4, 4, 3)), np.ones((4, 4), bool), "valid"),
        (np.ones((2, 4, 4, 3)), np.ones((2, 4, 4, 3)), np.ones((2, 4, 4)), "valid"),
    ],
)
def test_mismatched_repeat_input_is_refused(rgb, variance, valid, match):
    with pytest.raises(ValueError, match=match):
        repeat_average.average_repeats(rgb, variance, valid)
