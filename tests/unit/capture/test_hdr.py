import numpy as np
import pytest

from capture.hdr import BracketError, merge

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


def test_radiance_over_five_decades_is_unbiased_and_its_variance_honest(scene):
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
        ([np.zeros((2, 2))], (1.0,), {}, "whole numbers"),
        ([np.zeros((2, 2), int)], (0.0,), {}, "seconds > 0"),
        ([np.zeros((2, 2), int)], (1.0,), {"gain": 0.0}, "gain"),
        ([np.zeros((2, 2), int)], (1.0,), {"white": 100}, "white"),
    ],
)
def test_brackets_that_do_not_fit_are_named(frames, times, change, says):
    with pytest.raises(BracketError, match=says):
        merge(frames, times, **{**SENSOR, **change})
