"""Errors of what is alike in neighbors: maps through windows, means of blocks, misplaced colors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.correspondence.expression_alignment import Alignment
from reconstruction.facial_color import light_change, perfusion_fit, repeat_average
from reconstruction.facial_color import registration_error as misplacement
from reconstruction.normal_histogram import blocks
from reconstruction.normal_histogram import blocks as normal_blocks
from reconstruction.registration import affine_fit, dense_flow

CHEAP = settings(derandomize=True, deadline=None, max_examples=25, database=None)

SEEDS = st.integers(0, 2**32 - 1)
UNIT = st.floats(1e-6, 1e6)


def grid(side):
    return np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2).astype(float)


@CHEAP
# the fit takes 1e-9 px for the least that windows scatter
@given(seed=SEEDS, side=st.integers(3, 7), unit=st.floats(0.1, 1e3), noise=st.floats(1e-4, 0.1))
def test_affine_map_returns_with_error_in_position_units(seed, side, unit, noise):
    rng = np.random.default_rng(seed)
    places = grid(side) - (side - 1) / 2
    linear, shift = np.eye(2) + 0.2 * rng.normal(size=(2, 2)), rng.normal(size=2)
    found = places @ linear + shift + noise * rng.normal(size=places.shape)
    told, covariance = affine_fit.fit_affine(places, found, window_px=1.0)
    again, scaled = affine_fit.fit_affine(unit * places, unit * found, window_px=unit)
    spread = np.sqrt(np.diag(covariance))
    assert np.all(spread > 0.0)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9 * spread.max() ** 2
    assert np.all(np.abs(told - np.vstack([linear, shift])).ravel() < 10.0 * spread)
    np.testing.assert_allclose(again[:2], told[:2], rtol=1e-6, atol=1e-9)
    by = np.repeat([1.0, unit], [4, 2])
    np.testing.assert_allclose(np.sqrt(np.diag(scaled)), by * spread, rtol=1e-5)


@CHEAP
@given(count=st.integers(0, 12), seed=SEEDS)
def test_points_on_a_line_make_no_map(count, seed):
    along = np.random.default_rng(seed).normal(size=count)
    places = np.stack([along, 2.0 * along], axis=1)
    with pytest.raises(ValueError, match="points_px"):
        affine_fit.fit_affine(places, places, window_px=1.0)


@CHEAP
@given(seed=SEEDS, side=st.integers(3, 8), unit=UNIT, shift=st.floats(-10.0, 10.0))
def test_mean_error_has_value_units_and_ignores_origin(seed, side, unit, shift):
    rng = np.random.default_rng(seed)
    values, sizes = rng.normal(size=side**2), rng.integers(1, 50, side**2).astype(float)
    error, growth = blocks.mean_stderr(values, sizes, grid(side))
    assert growth >= 1.0
    assert 0.3 / side < error < 6.0  # between independent blocks and one that stands for all
    scaled, again = blocks.mean_stderr(unit * (values + shift), sizes, grid(side))
    assert scaled == pytest.approx(unit * error, rel=1e-4)
    assert again == pytest.approx(growth, rel=1e-4)


@CHEAP
@given(count=st.integers(0, blocks.MIN_BLOCKS - 1))
def test_too_few_blocks_have_an_endless_error(count):
    told = blocks.mean_stderr(np.zeros(count), np.ones(count), np.zeros((count, 2)))
    assert told == (np.inf, 1.0)


@CHEAP
@given(x=st.floats(0.0, 1e4), y=st.floats(0.0, 1e4))
def test_interpolation_leaves_half_to_all_of_noise(x, y):
    left = dense_flow.interpolated_noise_variance(
        np.array([[[x, y], [np.floor(x), np.floor(y)]]], np.float32)
    )
    assert 0.3 < left[0, 0] <= 1.0 + 1e-5
    assert left[0, 1] == pytest.approx(1.0, abs=1e-6)


@CHEAP
@given(start=st.floats(0.1, 0.5), end=st.floats(0.1, 0.5), tau=st.floats(5.0, 40.0), seed=SEEDS)
def test_vessel_blood_is_square_of_root_with_error(start, end, tau, seed):
    time = np.linspace(0.0, 90.0, 20)
    course = end + (start - end) * np.exp(-time / tau)
    noisy = course + 1e-3 * np.random.default_rng(seed).normal(size=20)
    roots = perfusion_fit.fit_course(time, noisy)
    blood = perfusion_fit.square_levels(roots)
    np.testing.assert_allclose(blood.start, np.maximum(roots.start, 0.0) ** 2)
    step = 1e-6
    slope = ((roots.end + step) ** 2 - (roots.end - step) ** 2) / (2.0 * step)
    np.testing.assert_allclose(blood.stderr_end, np.abs(slope) * roots.stderr_end, rtol=1e-5)


@CHEAP
@given(seed=SEEDS, side=st.integers(24, 64), blocks=st.integers(3, 8))
def test_map_blocks_have_error_of_their_means(seed, side, blocks):
    values = np.random.default_rng(seed).normal(size=side * side)
    group, groups = normal_blocks.assign_blocks(np.arange(side * side), (side, side), blocks)
    error, growth = normal_blocks.block_mean_stderr(values, group, groups, (side, side), blocks)
    # of samples that have nothing in common blocks tell about the error of independent ones
    assert 0.3 / side < error < 6.0 / side
    assert growth >= 1.0


@CHEAP
@given(seed=SEEDS, off=st.floats(0.0, 3.0), light=st.floats(1e-3, 1e3))
def test_misplaced_image_error_is_quadratic_under_any_light(seed, off, light):
    skin = 0.3 + 0.1 * np.random.default_rng(seed).random((24, 24, 3))
    valid = np.ones((24, 24), bool)
    valid[:4] = False
    skin[:4] = 0.0

    def error(off_px, times):
        columns = np.stack(np.indices((24, 24))[::-1], axis=-1).astype(np.float32)
        laid = Alignment(
            columns,
            valid,
            np.full((24, 24), off_px, np.float32),
            np.zeros((24, 24), np.float32),
            np.ones((24, 24), bool),
            0.0,
            {},
            0.0,
            "landmarks",
            (24, 24),
        )
        return misplacement.registration_covariance(times * skin, np.zeros_like(skin), valid, laid)

    one, told = error(1.0, 1.0), error(off, light)
    assert np.isfinite(told).all()
    np.testing.assert_allclose(told[valid], off**2 * one[valid], rtol=1e-3, atol=1e-12)
    assert np.linalg.eigvalsh(one).min() > -1e-9


@CHEAP
@given(
    seed=SEEDS,
    step=st.floats(-0.5, 0.5),
    noise=st.floats(1e-3, 0.3),
    bad=st.sampled_from([np.nan, np.inf, 0.0, -1.0]),
)
def test_uniform_light_change_is_detected_despite_missing_pixels(seed, step, noise, bad):
    rng = np.random.default_rng(seed)
    side = 32
    light = np.array([[0.0], [step]]) + noise * rng.normal(size=(2, side * side))
    variance = np.full_like(light, noise**2)
    gone = rng.random(side * side) < 0.1
    variance[1, gone], light[0, gone] = bad, np.nan
    good = np.ones(light.shape, bool)
    good[0, gone] = False
    change, stiffness = light_change.smooth_light_changes(
        light.astype(np.float32), variance.astype(np.float32), good, (side, side), 6.0
    )
    assert np.isfinite(change).all()
    assert np.all(stiffness >= 1.0 / light_change.MAX_LIGHT_CHANGE**2 * (1.0 - 1e-6))
    assert np.all(stiffness <= 1.0 / light_change.MIN_LIGHT_CHANGE**2 * (1.0 + 1e-6))
    middle = (change[1] - change[0]).reshape(side, side)[8:-8, 8:-8]
    # about 200 pixels within a window, less those that lack a state
    assert np.abs(middle - step).max() < 1.0 * noise + 1e-5


@CHEAP
@given(
    seed=SEEDS,
    count=st.integers(1, 5),
    unit=st.floats(1e-9, 1e9),
    noise=st.floats(1e-6, 0.2),
    bad=st.sampled_from([np.nan, np.inf, -np.inf, 0.0]),
)
def test_repeat_means_scale_with_unit_under_any_mask(seed, count, unit, noise, bad):
    rng = np.random.default_rng(seed)
    rgb = 0.4 * np.exp(noise * rng.normal(size=(count, 8, 9, 3)))
    variance = np.square(noise * rgb)
    valid = rng.random((count, 8, 9)) < 0.8
    rgb[~valid], variance[~valid] = bad, bad
    mean, told, known = repeat_average.average_repeats(rgb, variance, valid)
    scaled, told_scaled, _ = repeat_average.average_repeats(unit * rgb, unit**2 * variance, valid)
    assert np.isfinite(mean).all()
    np.testing.assert_array_equal(known, valid.any(axis=0))
    np.testing.assert_allclose(scaled, unit * mean, rtol=1e-5)
    np.testing.assert_allclose(told_scaled, unit**2 * told, rtol=1e-4)
    assert not mean[~known].any()
    assert (told[known] > 0.0).all()
    assert repeat_average.overdispersion(rgb, variance, valid) >= 1.0
