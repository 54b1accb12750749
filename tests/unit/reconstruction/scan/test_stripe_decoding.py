"""Stripes of known columns: the decoder against closed forms, and what it masks."""

import numpy as np
import pytest
from fixtures.striped_scenes import CODE, shine

from reconstruction.scan.stripe_decoding import StripeCode, StripeError, decode_stripes

COLUMN = np.tile(np.linspace(0.0, 1023.0, 600), (20, 1))


@pytest.mark.parametrize("steps", [3, 4, 6, 9])
def test_decode_without_noise_is_exact(steps):
    code = StripeCode(length_px=1024, period_px=32.0, steps=steps)
    found = shine(COLUMN, code=code).decode(code)
    assert found.valid.mean() > 0.99
    np.testing.assert_allclose(found.position_px[found.valid], COLUMN[found.valid], atol=1e-8)


def test_blurred_bits_are_repaired_by_phase():
    found = shine(COLUMN, blur_px=3.0).decode()
    assert found.valid.mean() > 0.97
    np.testing.assert_allclose(found.position_px[found.valid], COLUMN[found.valid], atol=0.05)


def test_flipped_bit_away_from_edges_is_masked():
    frames = shine(COLUMN)
    middle = np.abs((COLUMN + 0.5) % 16.0 - 8.0) < 3.0
    frames.gray[-1] = 240.0 - frames.gray[-1]
    found = frames.decode()
    wrong = np.abs(found.position_px - COLUMN) > 1.0
    assert not (wrong & middle).any()
    assert found.valid[middle].mean() < 0.01


@pytest.mark.parametrize(("steps", "amplitude"), [(3, 100.0), (6, 100.0), (12, 100.0), (6, 400.0)])
def test_noise_falls_at_predicted_rate(rng, steps, amplitude):
    code = StripeCode(length_px=1024, period_px=32.0, steps=steps)
    found = shine(COLUMN, code=code, amplitude=amplitude, noise=5.0, rng=rng).decode(code)
    error = (found.position_px - COLUMN)[found.valid]
    # closed form of N steps: sigma = period / (2 pi) sqrt(2 / N) noise / amplitude
    wanted = 32.0 / (2 * np.pi) * np.sqrt(2.0 / steps) * 5.0 / amplitude
    assert found.valid.mean() > 0.95
    assert np.std(error) == pytest.approx(wanted, rel=0.05)  # 12,000 samples: 0.7 %, tails
    assert np.median(found.stderr_px[found.valid]) == pytest.approx(wanted, rel=0.05)


def test_black_saturated_and_flat_pixels_are_masked(rng):
    strength = np.full(COLUMN.shape, 100.0)
    strength[:6] = 0.5
    frames = shine(COLUMN, amplitude=strength, noise=5.0, rng=rng)
    frames.usable[6:12] = False
    found = frames.decode()
    assert found.valid[:6].mean() < 0.01
    assert not found.valid[6:12].any()
    assert found.valid[12:].mean() > 0.9
    assert np.isnan(found.position_px[~found.valid]).all()


def test_coarsely_sampled_stripes_are_masked():
    column = np.tile(np.arange(60) * 13.0, (10, 1))  # 0.41 periods per pixel
    assert not shine(column).decode().valid.any()


def test_sinusoid_that_moves_is_masked():
    frames = shine(COLUMN)
    frames.phase[2:] = shine(COLUMN + 9.0).phase[2:]
    assert frames.decode().valid.mean() < 0.05


def test_frames_of_other_code_are_refused():
    frames = shine(COLUMN)
    with pytest.raises(StripeError, match=r"gray: got shape \(5, 20, 600\), expected \(6, 20, 6"):
        decode_stripes(frames.gray[1:], frames.phase, CODE, variance=0.0)
    with pytest.raises(StripeError, match="steps: got 2"):
        StripeCode(length_px=1024, period_px=32.0, steps=2)
    with pytest.raises(StripeError, match="period_px: got 64"):
        StripeCode(length_px=32, period_px=64.0, steps=4)
