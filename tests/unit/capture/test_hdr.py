import os
from pathlib import Path

import numpy as np
import pytest

from capture.calibration.sensor.bracket_times import check_times
from capture.hdr import BracketError, merge, merge_reference, recover_response

SENSOR = {"gain": 2.0, "read_noise": 8.0, "black": 512, "white": 16383}
TIMES = (0.01, 0.08, 0.64)


def expose(radiance, time, rng):
    electrons = rng.poisson(radiance * time * SENSOR["gain"]).astype(float)
    electrons += SENSOR["read_noise"] * rng.normal(size=radiance.shape)
    dn = np.rint(electrons / SENSOR["gain"]) + SENSOR["black"]
    return np.clip(dn, 0, SENSOR["white"]).astype(np.uint16)


@pytest.fixture
def scene():
    """Five decades of radiance, DN per second."""
    return np.broadcast_to(np.geomspace(10.0, 1.2e6, 40)[:, None], (40, 500)).copy()


def test_radiance_over_five_decades_is_unbiased_variance_correct(scene):
    """Z-scores of 20,000 pixels: mean 0 to 0.03 (4 sigma) and spread 1 to 0.03.

    Rows within 5 % of a frame's saturation are left out: there noise decides which frame counts.
    """
    rng = np.random.default_rng(1)
    radiance, variance, valid = merge([expose(scene, t, rng) for t in TIMES], TIMES, **SENSOR)
    assert valid.all()
    span = SENSOR["white"] - SENSOR["black"]
    near = np.any([np.abs(scene * t / span - 1) < 0.05 for t in TIMES], axis=0)
    z = ((radiance - scene) / np.sqrt(variance))[~near]
    assert abs(z.mean()) < 0.03
    assert z.std() == pytest.approx(1.0, abs=0.03)


def test_the_merge_beats_every_single_exposure(scene):
    rng = np.random.default_rng(2)
    frames = [expose(scene, t, rng) for t in TIMES]
    _, variance, _ = merge(frames, TIMES, **SENSOR)
    for frame, time in zip(frames, TIMES, strict=True):
        _, alone, usable = merge([frame], [time], **SENSOR)
        assert (variance[usable] <= alone[usable] * 1.05).mean() > 0.99


def test_a_pixel_saturated_in_all_frames_is_masked():
    frames = [np.full((2, 2), 16383, np.uint16), np.full((2, 2), 16383, np.uint16)]
    frames[0][0, 0] = 900
    radiance, variance, valid = merge(frames, (0.1, 1.0), **SENSOR)
    assert valid.tolist() == [[True, False], [False, False]]
    np.testing.assert_array_equal(np.isnan(radiance), ~valid)
    np.testing.assert_array_equal(np.isnan(variance), ~valid)
    assert radiance[0, 0] == pytest.approx(3880.0)


def test_values_below_black_stay_negative_and_inputs_unchanged():
    frames = np.full((2, 3, 3), 505, np.uint16)
    before = frames.copy()
    radiance, _, _ = merge(frames, (0.1, 0.1), **SENSOR)
    np.testing.assert_allclose(radiance, -70.0, rtol=1e-6)
    np.testing.assert_array_equal(frames, before)


@pytest.mark.parametrize(
    ("frames", "times", "change", "says"),
    [
        ([], (), {}, "at least one"),
        ([np.zeros((2, 2), int)], (1.0, 2.0), {}, "1 times"),
        ([np.zeros((2, 2), int), np.zeros((2, 3), int)], (1.0, 2.0), {}, "one shape"),
        ([np.zeros((2, 2), bool)], (1.0,), {}, "whole numbers"),
        ([np.full((2, 2), 800.5)], (1.0,), {}, r"frames\[0\]: got 800.5.*the single ones"),
        ([np.zeros((2, 2)), np.full((2, 2), np.nan)], (1.0, 2.0), {}, r"frames\[1\]: got nan"),
        ([np.full((2, 2), np.inf, np.float32)], (1.0,), {}, r"frames\[0\]: got inf"),
        ([np.zeros((2, 2), int)], (0.0,), {}, "seconds > 0"),
        ([np.zeros((2, 2), int)], (1.0,), {"gain": 0.0}, "gain"),
        ([np.zeros((2, 2), int)], (1.0,), {"white": 100}, "white"),
    ],
)
def test_brackets_that_do_not_fit_are_named(frames, times, change, says):
    with pytest.raises(BracketError, match=says):
        merge(frames, times, **{**SENSOR, **change})


# --- the compiled loop against its plain twin -----------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1), (3, 5, 3), (40, 61), (1025,)])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_compiled_loop_matches_plain_implementation(rng, shape, count):
    """float32 against float64: within 1e-3 of a standard error and 1e-5 of the variance."""
    times = np.geomspace(1e-4, 2.0, count)
    frames = [rng.integers(400, 18_000, shape).astype(np.uint16) for _ in times]
    frames[-1].flat[0] = frames[0].flat[0] = 16_383
    before = [frame.copy() for frame in frames]
    radiance, variance, valid = merge(frames, times, **SENSOR)
    plain = merge_reference(frames, times, **SENSOR)
    np.testing.assert_array_equal(valid, plain[2])
    sigma = np.sqrt(plain[1][valid])
    assert np.abs((radiance[valid] - plain[0][valid]) / sigma).max(initial=0) < 1e-2
    np.testing.assert_allclose(variance[valid], plain[1][valid], rtol=1e-3)
    assert np.isnan(radiance[~valid]).all()
    np.testing.assert_array_equal(frames, before)


def test_frame_views_and_other_integers_give_same_result(rng):
    wide = [rng.integers(500, 9000, (20, 30)).astype(np.uint16) for _ in TIMES]
    cut = [frame[::2, 1::3] for frame in wide]
    whole = [np.ascontiguousarray(frame) for frame in cut]
    longer = [frame.astype(np.int64) for frame in cut]
    first, second, third = (merge(f, TIMES, **SENSOR) for f in (cut, whole, longer))
    np.testing.assert_array_equal(first[0], second[0])
    np.testing.assert_allclose(first[0], third[0], rtol=1e-3)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
def test_integer_valued_float_frames_are_raw_frames(rng, kind):
    frames = rng.integers(400, 2000, (2, 5, 6)).astype(np.uint16)
    frames[:, 0, 0] = 2048  # exact in half precision, saturated below
    sensor = {**SENSOR, "white": 2048}
    wanted = merge(frames, (0.1, 1.0), **sensor)
    for found in (
        merge(frames.astype(kind), (0.1, 1.0), **sensor),
        merge([frames[0], frames[1].astype(kind)], (0.1, 1.0), **sensor),
    ):
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
    assert not wanted[2][0, 0]
    below = merge(np.full((1, 2, 2), -3.0), (1.0,), **sensor)[0]
    np.testing.assert_allclose(below, -3.0 - SENSOR["black"])


def test_equal_time_frames_merge_like_their_average(rng):
    frames = rng.integers(900, 1100, (4, 50, 50)).astype(np.uint16)
    radiance, variance, _ = merge(frames, [0.5] * 4, **SENSOR)
    mean = frames.mean(axis=0) - SENSOR["black"]
    np.testing.assert_allclose(radiance, mean / 0.5, rtol=1e-5)
    _, alone, _ = merge(frames[:1], [0.5], **SENSOR)
    assert np.median(variance / alone) == pytest.approx(0.25, rel=0.01)


def test_variance_is_that_of_best_unbiased_estimate(scene):
    """Cramer-Rao: one over the sum of t^2 / (radiance t / gain + floor) over unsaturated frames.

    Rows within 5 % of a frame's saturation are left out. 5 % for the estimate inside the weights.
    """
    rng = np.random.default_rng(4)
    _, variance, _ = merge([expose(scene, t, rng) for t in TIMES], TIMES, **SENSOR)
    gain, floor = SENSOR["gain"], (SENSOR["read_noise"] / SENSOR["gain"]) ** 2 + 1 / 12
    span = SENSOR["white"] - SENSOR["black"]
    information = sum(
        np.where(scene * t < span, t**2 / (scene * t / gain + floor), 0.0) for t in TIMES
    )
    near = np.any([np.abs(scene * t / span - 1) < 0.05 for t in TIMES], axis=0)
    ratio = (variance * information)[~near]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
    assert np.percentile(np.abs(ratio - 1), 99) < 0.2


@pytest.mark.parametrize("level", [0, 512, 16_382, 16_383, 65_535])
@pytest.mark.parametrize("time", [1e-9, 1.0, 1e6])
def test_extreme_values_and_times_give_numbers_or_mask(level, time):
    radiance, variance, valid = merge(
        np.full((2, 3, 3), level, np.uint16), (time, 2 * time), **SENSOR
    )
    assert valid.all() == (level < 16_383)
    assert np.isfinite(radiance[valid]).all()
    assert (variance[valid] > 0).all()


# --- JPEG brackets --------------------------------------------------------------------------------


def encode(exposure):
    """Encode exposure as this test's camera does: a power of 1 / 2.2, 8 bits."""
    return np.rint(255 * np.clip(exposure, 0, 1) ** (1 / 2.2)).astype(np.uint8)


@pytest.fixture
def gradient():
    """Radiance over two decades in 128 x 128 pixels of three colors."""
    ramp = np.geomspace(0.01, 1.0, 128 * 128).reshape(128, 128)
    return np.random.default_rng(0).permutation(ramp.ravel()).reshape(128, 128)[..., None] * (
        np.array([1.0, 0.8, 0.6])
    )


def test_known_response_is_recovered_from_bracket(gradient, rng):
    times = (0.25, 1.0, 4.0)
    images = [encode(gradient * t) for t in times]
    found = recover_response(images, times, rng=rng)
    level = np.arange(256)
    true = (level / 128) ** 2.2
    inner = found.valid & ((level > 40) & (level < 230))[:, None]
    assert inner.mean() > 0.6
    off = np.abs(found.exposure / np.where(level > 0, true, 1.0)[:, None] - 1)[inner]
    assert np.median(off) < 0.03
    assert np.percentile(off, 95) < 0.08
    # a straight line, which a user would assume without it, is far off
    assert np.median(np.abs(level / 128 / true.clip(1e-9) - 1)[inner.any(axis=1)]) > 0.2


def test_linearized_bracket_images_agree_on_radiance(gradient, rng):
    times = (0.25, 1.0, 4.0)
    images = [encode(gradient * t) for t in times]
    found = recover_response(images, times, rng=rng)
    linear = [found.linearize(image) for image in images]
    for (a, _, good_a), (b, spread, good_b), t in zip(
        linear, linear[1:], (0.25, 1.0), strict=False
    ):
        both = good_a & good_b
        assert np.median((b / (4 * t))[both] / (a / t)[both]) == pytest.approx(1.0, abs=0.03)
        assert (spread[both] > 0).all()


def test_a_real_bracket_becomes_consistent():
    root = os.environ.get("SKINRIG_TEST_DATA")
    folder = (Path(root) if root else Path(__file__).parents[4] / "shared/data") / "hdr"
    if not folder.is_dir():
        pytest.skip("no test data: set SKINRIG_TEST_DATA")
    import cv2

    images = [cv2.imread(str(folder / f"IMG_260{k}.jpg"))[..., ::-1] for k in range(3)]
    times = (1 / 8, 1.0, 8.0)
    found = recover_response(images, times, rng=np.random.default_rng(0))
    assert found.valid.mean() > 0.9
    linear = [found.linearize(image) for image in images]
    for k in range(2):
        both = linear[k][2] & linear[k + 1][2]
        ratio = (linear[k + 1][0] / times[k + 1])[both] / (linear[k][0] / times[k])[both]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
        raw = images[k + 1][both] / times[k + 1] / np.maximum(images[k][both] / times[k], 1e-9)
        assert abs(np.median(raw) - 1) > 0.15  # values taken for linear are not


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"images": [np.zeros((9, 9, 3), np.uint8)], "exposures_s": (1.0,)}, "at least two"),
        ({"images": [np.zeros((9, 9, 3), np.uint16)] * 2}, "uint8"),
        ({"images": [np.zeros((9, 9), np.uint8)] * 2}, "uint8"),
        ({"exposures_s": (1.0, 1.0)}, "two that differ"),
        ({"exposures_s": (1.0, -1.0)}, "seconds > 0"),
        ({"pixels": 3}, "pixels"),
        ({"smoothness": 0.0}, "smoothness"),
    ],
)
def test_inconsistent_bracket_images_are_refused(change, says, rng):
    words = {"images": [np.zeros((9, 9, 3), np.uint8)] * 2, "exposures_s": (1.0, 2.0)} | change
    with pytest.raises(BracketError, match=says):
        recover_response(words.pop("images"), words.pop("exposures_s"), rng=rng, **words)


def test_wrong_ratio_of_exposure_times_is_stated(scene):
    rng = np.random.default_rng(5)
    frames = [expose(scene, t, rng) for t in TIMES]
    check_times(frames, TIMES, **SENSOR)
    with pytest.raises(BracketError, match=r"s\[0\] over \w+\[1\]: got 0\.16.*, expected 0\.12"):
        check_times(frames, (0.013, 0.08, 0.64), **SENSOR)
    # the longest is wrong: the pair that has it is named, none of the two is blamed
    with pytest.raises(
        BracketError, match=r"s\[1\] over \w+\[2\]: got 0\.1 .*, expected 0\.12"
    ) as e:
        check_times(frames, (0.01, 0.08, 0.8), **SENSOR)
    assert "s[0]" not in str(e.value)
    dark = [np.full((40, 40), SENSOR["black"], np.uint16)] * 2
    check_times(dark, (0.1, 0.4), **SENSOR)  # nothing contradicts
