"""Brackets of a probe give each fiber's light over five decades, with variances that hold."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from capture import hdr
from capture.calibration.fiber.darks import DarkError, measure_darks
from capture.calibration.fiber.merge import merge_series
from capture.calibration.fiber.readings import read_fibers, sum_spots
from capture.calibration.fiber.spots import FiberSpots
from capture.hdr import BracketError

FALSE_ALARM = 1e-5


def spots_of(camera, aperture_px=17.0):
    row = np.full(28, 13.0)
    return FiberSpots(
        camera.names,
        camera.places,
        np.full((28, 2), 0.02),
        row,
        0.01 * row,
        0.1 * row,
        np.ones(28, bool),
        aperture_px,
    )


def read(camera, frames, times, darks, **about):
    return read_fibers(
        frames, times, spots=spots_of(camera), darks=darks, noise=camera.noise, **about
    )


def assert_consistent(away):
    """Normal deviations: their sum of squares is chi^2, one run in 1e5 fails by chance."""
    total = float((away**2).sum())
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], away.size)
    assert low < total < high, f"{total:.0f}, expected {low:.0f} to {high:.0f}"


@pytest.fixture(scope="module")
def bench(fiber_camera, all_brackets_s, five_decades):
    camera = fiber_camera(np.random.default_rng(7))
    return camera, camera.darks(), camera.series(five_decades, all_brackets_s)


def test_five_decades_are_read_within_their_errors(bench, all_brackets_s, five_decades):
    camera, darks, frames = bench
    readings = read(camera, frames, all_brackets_s, darks)
    assert readings.valid.all()
    truth = camera.own_light(five_decades, spots_of(camera))
    assert truth.max() / truth.min() > 1e5
    assert_consistent((readings.signal - truth) / readings.stderr)
    assert (readings.stderr / truth).max() < 0.01
    # the same frames without the dark signal taken off do not fit: the test can fail
    blind = measure_darks(
        [np.full(camera.shape, 64, np.uint16)] * 2, [1e-3, 30], noise=camera.noise
    )
    raw = read(camera, frames, all_brackets_s, blind)
    assert abs((raw.signal - truth) / raw.stderr).max() > 6


def test_light_below_dark_signal_is_read_without_bias(fiber_camera, brackets_s):
    away, level = [], []
    for seed in range(2):
        camera = fiber_camera(np.random.default_rng(seed))
        light = np.full((28, 3), 0.06)  # electrons per second: 1.8 in the longest exposure
        readings = read(camera, camera.series(light, brackets_s), brackets_s, camera.darks())
        truth = camera.own_light(light, spots_of(camera))
        away.append((readings.signal - truth) / readings.stderr)
        level.append(truth / readings.stderr)
    away = np.array(away)
    assert np.median(level) > 2  # enough to notice a bias
    assert_consistent(away)
    assert abs(away.mean()) * np.sqrt(away.size) < 4.4  # one run in 1e5


def test_no_light_gives_both_signs_with_a_variance(fiber_camera, brackets_s):
    camera = fiber_camera(np.random.default_rng(3))
    readings = read(
        camera, camera.series(np.zeros((28, 3)), brackets_s), brackets_s, camera.darks()
    )
    assert readings.valid.all()
    assert not readings.detected.any()
    negative = int((readings.signal < 0).sum())
    assert 20 < negative < 64  # of 84 fair coins: 5 sigma
    assert_consistent(readings.signal / readings.stderr)


def test_series_saturated_in_shortest_exposure_is_flagged(fiber_camera, brackets_s, five_decades):
    camera = fiber_camera(np.random.default_rng(5))
    light = five_decades.copy()
    light[:3] *= 100.0
    frames = camera.series(light, brackets_s)
    readings = read(camera, frames, brackets_s, camera.darks())
    assert readings.saturated[:3].all()
    assert not readings.valid[:3].any()
    assert not readings.saturated[4:].any()
    truth = camera.own_light(light, spots_of(camera))[4:]
    assert_consistent((readings.signal[4:] - truth) / readings.stderr[4:])


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_brackets_read_valid_subset(bench, all_brackets_s, five_decades, count):
    camera, darks, frames = bench
    chosen = [14, 18, 22][:count]
    readings = read(camera, [frames[k] for k in chosen], all_brackets_s[chosen], darks)
    truth = camera.own_light(five_decades, spots_of(camera))
    assert 0 < readings.valid.sum() < readings.valid.size
    assert (readings.saturated == ~readings.valid).all()
    good = readings.valid
    assert_consistent(((readings.signal - truth) / np.where(good, readings.stderr, 1))[good])


def test_the_order_of_the_frames_does_not_matter(bench, all_brackets_s, rng):
    camera, darks, frames = bench
    order = rng.permutation(23)
    one = read(camera, frames, all_brackets_s, darks)
    two = read(camera, [frames[k] for k in order], all_brackets_s[order], darks)
    np.testing.assert_allclose(one.signal, two.signal, rtol=1e-12)


def test_warmed_camera_is_read_without_bias(fiber_camera, brackets_s):
    camera = fiber_camera(np.random.default_rng(9))
    light = np.full((28, 3), 1.0)
    warm = camera.series(light, brackets_s, dark=2 ** (3 / 7))
    truth = camera.own_light(light, spots_of(camera))
    darks = camera.darks(temperature_c=5.0)
    # told of the temperature, or not: the light around a spot shows the rest
    for about in ({"temperature_c": 8.0}, {}):
        readings = read(camera, warm, brackets_s, darks, **about)
        assert_consistent((readings.signal - truth) / readings.stderr)
    assert darks.at(8.0).mean_rate_dn_per_s > 1.2 * darks.mean_rate_dn_per_s
    assert darks.at(8.0).mean_rate_stderr > darks.mean_rate_stderr
    with pytest.raises(DarkError, match=r"5\.0 C.*20\.0 C.*10 K apart"):
        darks.at(20.0)


def test_dark_current_and_offsets_are_found(fiber_camera):
    camera = fiber_camera(np.random.default_rng(11))
    darks = camera.darks(repeats=4)
    rate_e = darks.mean_rate_dn_per_s * camera.noise.gain_e_per_dn
    assert rate_e == pytest.approx(0.2, abs=0.005)
    hot = camera.dark > 1
    assert (darks.hot & hot).sum() >= 0.9 * hot.sum()
    assert (darks.hot & ~hot).sum() < 5
    off = (darks.bias_dn * camera.noise.gain_e_per_dn - camera.bias_e)[~darks.hot]
    predicted = np.sqrt(darks.covariance[0, 0]) * camera.noise.gain_e_per_dn
    assert off.std() == pytest.approx(predicted, rel=0.03)
    assert predicted < camera.bias_e.std()  # better than one number for all


def test_single_exposure_darks_apply_to_that_exposure_only(fiber_camera, five_decades):
    camera = fiber_camera(np.random.default_rng(13))
    darks = camera.darks((30.0,))
    frames = camera.series(five_decades, (30.0,))
    assert read(camera, frames, (30.0,), darks).valid.any()
    with pytest.raises(DarkError, match=r"30 s only.*two times or more"):
        read(camera, frames, (1.0,), darks)


def test_missing_darks_and_mismatched_frames_are_reported(fiber_camera):
    camera = fiber_camera(np.random.default_rng(13))
    with pytest.raises(DarkError, match="at least one; capture darks first"):
        measure_darks([], [], noise=camera.noise)
    darks = camera.darks((1.0, 30.0), 1)
    with pytest.raises(BracketError, match="at least one frame"):
        read(camera, [], [], darks)
    with pytest.raises(BracketError, match="shape"):
        read(camera, [np.zeros((64, 64), np.uint16)], [1.0], darks)


def test_hot_pixels_in_a_spot_do_not_show(fiber_camera, brackets_s):
    quiet = fiber_camera(np.random.default_rng(17), hot=0)
    x, y = quiet.places[20].round().astype(int)
    quiet.dark[y - 2, x + 3] = 300.0
    quiet.dark[y + 5, x - 4] = 90.0
    light = np.full((28, 3), 3.0)
    readings = read(quiet, quiet.series(light, brackets_s), brackets_s, quiet.darks())
    truth = quiet.own_light(light, spots_of(quiet))
    assert_consistent(((readings.signal - truth) / readings.stderr)[20])


def test_many_hot_pixels_make_a_spot_invalid(fiber_camera, brackets_s):
    camera = fiber_camera(np.random.default_rng(17), hot=0)
    x, y = camera.places[20].round().astype(int)
    camera.dark[y - 8 : y + 9, x - 8 : x + 9] = 300.0
    light = np.full((28, 3), 3.0)
    readings = read(camera, camera.series(light, brackets_s), brackets_s, camera.darks())
    assert not readings.valid[20].any()
    assert readings.valid[[19, 21]].all()


def test_bright_light_merges_like_bracket_merge(bench, all_brackets_s):
    camera, darks, frames = bench
    merged = merge_series(frames, all_brackets_s, darks=darks, noise=camera.noise)
    noise = camera.noise
    radiance, variance, _ = hdr.merge(
        frames,
        all_brackets_s,
        gain=noise.gain_e_per_dn,
        read_noise=noise.read_noise_e,
        black=noise.black_dn,
        white=noise.white_dn,
    )
    bright = merged.valid & (radiance > 1e4)
    assert bright.sum() > 5000
    gap = (merged.rate * noise.span_dn - radiance)[bright] / np.sqrt(variance[bright])
    # both hold the same noise: they differ by what saturates by chance, not by a standard error
    assert np.abs(gap).mean() < 0.2
    ratio = (merged.variance * noise.span_dn**2)[bright] / variance[bright]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)


def test_error_falls_with_exposure_as_electron_counts_predict(fiber_camera):
    camera = fiber_camera(np.random.default_rng(19))
    light = np.full((28, 3), 100.0)
    darks = camera.darks()
    short, long = (
        read(camera, camera.series(light, (t,)), (t,), darks).stderr for t in (4.0, 16.0)
    )
    # shot noise beside 7 e of read noise and 1 e of offsets, per pixel
    predicted = np.sqrt((400 + 51) / 4**2) / np.sqrt((1600 + 54) / 16**2)
    assert np.median(short / long) == pytest.approx(predicted, rel=0.05)


def test_monochrome_camera_is_read_as_single_channel(fiber_camera, brackets_s):
    camera = fiber_camera(np.random.default_rng(31))
    gray = dataclasses.replace(camera.noise, pattern="MONO")
    light = np.full((28, 3), 50.0)
    frames = camera.series(light, brackets_s)
    readings = read_fibers(
        frames, brackets_s, spots=spots_of(camera), darks=camera.darks(), noise=gray
    )
    truth = camera.own_light(light, spots_of(camera)).sum(axis=1, keepdims=True)
    assert readings.signal.shape == (28, 1)
    assert_consistent((readings.signal - truth) / readings.stderr)


def test_sums_scale_with_aperture_not_surrounding_light(fiber_camera):
    camera = fiber_camera(np.random.default_rng(23), veil=1e-4)
    light = np.full((28, 3), 100.0)
    times = (1.0, 10.0)
    merged = merge_series(
        camera.series(light, times), times, darks=camera.darks(), noise=camera.noise
    )
    for aperture in (17.0, 19.0):
        spots = spots_of(camera, aperture)
        readings = sum_spots(merged, spots, noise=camera.noise)
        assert_consistent((readings.signal - camera.own_light(light, spots)) / readings.stderr)
        expected = 1e-4 * 28 * 100 / (camera.noise.gain_e_per_dn * camera.noise.span_dn)
        assert np.median(readings.around) == pytest.approx(expected, rel=0.05)


def test_light_durations_differing_from_exposures_give_same_rates(fiber_camera, rng):
    camera = fiber_camera(rng)
    light = np.full((28, 3), 100.0)
    darks = camera.darks()
    exposures = np.array([1.0, 5.0, 20.0])
    lit = exposures * [0.98, 1.01, 1.005]
    rate = camera.rate(light)
    frames = [camera.expose(rate * on / t, t) for t, on in zip(exposures, lit, strict=True)]
    truth = camera.own_light(light, spots_of(camera))
    told = read(camera, frames, exposures, darks, light_s=lit)
    assert_consistent((told.signal - truth) / told.stderr)
    # one frame by itself cannot tell; of several the others do
    alone = read(camera, frames[:1], exposures[:1], darks).signal
    assert np.median(alone / truth) == pytest.approx(0.98, abs=0.002)
    with pytest.raises(BracketError, match="light_s"):
        read(camera, frames, exposures, darks, light_s=[1.0, 5.0, 0.0])


def test_unsteady_source_is_detected_in_frames(fiber_camera, brackets_s, five_decades):
    camera = fiber_camera(np.random.default_rng(29))
    ripple = np.random.default_rng(1).normal(1, 0.01, 12)
    rate = camera.rate(five_decades)
    frames = [camera.expose(rate * f, t) for f, t in zip(ripple, brackets_s, strict=True)]
    merged = merge_series(frames, brackets_s, darks=camera.darks(), noise=camera.noise)
    away = np.array(merged.scale) / np.mean(merged.scale) - ripple / ripple.mean()
    assert away.std() < 0.002
    readings = sum_spots(merged, spots_of(camera), noise=camera.noise)
    share = readings.signal / camera.own_light(five_decades, spots_of(camera))
    bright = slice(0, 16)
    assert share[bright].std() < 0.002
    # a steady source's frames are left as they are
    frames = camera.series(five_decades, brackets_s)
    steady = merge_series(frames, brackets_s, darks=camera.darks(), noise=camera.noise)
    assert np.abs(np.array(steady.scale) - 1).max() < 0.002

    # nor are few frames far apart taken for a source that flickers
    few = [0, 5, 11]
    steady = merge_series(
        [frames[k] for k in few], brackets_s[few], darks=camera.darks(), noise=camera.noise
    )
    assert np.abs(np.array(steady.scale) - 1).max() < 0.005
