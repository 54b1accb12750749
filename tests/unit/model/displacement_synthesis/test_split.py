"""Split of mesoscale and relief: gains of closed form, and matched power of long waves."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from model.displacement_synthesis import split
from model.displacement_synthesis.sources import SynthesisError, level_patch

PIXEL_UM = 40.0


@given(st.floats(0.0, 1e3), st.floats(10.0, 1e5))
def test_squares_of_both_gains_sum_to_one(waves_per_mm, cutoff_um):
    low = split.mesoscale_gain(waves_per_mm, cutoff_um=cutoff_um)
    high = split.relief_gain(waves_per_mm, cutoff_um=cutoff_um)
    assert float(low**2 + high**2) == pytest.approx(1.0, abs=1e-12)
    assert 0.0 <= float(high) <= 1.0


def cosine(side, period_px):
    wave = np.cos(2.0 * np.pi * (np.arange(side) + 0.5) / period_px)
    return np.broadcast_to(wave, (side, side)).astype(np.float64)


@pytest.mark.parametrize("period_um", [4000.0, 2000.0, 1000.0, 500.0])
def test_relief_gain_is_that_of_leveled_patch(period_um):
    wave = cosine(500, period_um / PIXEL_UM)
    leveled = level_patch(wave, pixel_um=PIXEL_UM)[200:300, 200:300]
    expected = split.relief_gain(1e3 / period_um) * wave[200:300, 200:300]
    np.testing.assert_allclose(leveled, expected, atol=0.01)


@pytest.mark.parametrize("period_um", [8000.0, 2000.0, 1000.0, 800.0])
def test_mesoscale_waves_have_closed_gain(period_um):
    relief = np.zeros((600, 600), np.float32)
    valid = np.ones((300, 300), bool)
    split.add_mesoscale(relief, cosine(300, period_um / 80.0), valid, 80.0)
    gain = split.mesoscale_gain(1e3 / period_um)
    expected = gain * cosine(600, period_um / PIXEL_UM)
    np.testing.assert_allclose(relief, expected, atol=0.02)


def test_mesoscale_is_filtered_by_local_texel_size():
    wave = cosine(400, 20.0)
    sizes = np.repeat([[50.0, 100.0]], 2, axis=0)  # periods of 1 and 2 mm
    relief = np.zeros((400, 400), np.float32)
    split.add_mesoscale(relief, wave, np.ones(wave.shape, bool), sizes)
    for columns, per_mm in ((slice(20, 80), 1.0), (slice(320, 380), 0.5)):
        expected = split.mesoscale_gain(per_mm) * wave[:, columns]
        np.testing.assert_allclose(relief[:, columns], expected, atol=0.02)


def test_texels_outside_surface_do_not_count():
    wave = 3.0 + np.zeros((60, 60))
    valid = np.ones(wave.shape, bool)
    valid[:, 40:] = False
    relief = np.zeros((120, 120), np.float32)
    split.add_mesoscale(relief, np.where(valid, wave, np.nan), valid, 100.0)
    np.testing.assert_allclose(relief, 3.0, atol=1e-5)


def rough_map(rng, side):
    """Relief without waves above 1 mm but for a part of them."""
    white = rng.standard_normal((side, side))
    fine = ndimage.gaussian_filter(white, 1.5, mode="wrap")
    return (5.0 * (fine - ndimage.gaussian_filter(fine, 8.0, mode="wrap")) / fine.std()).astype(
        np.float32
    )


def octave_rms(height, pixel_um, longest_um, shortest_um):
    """RMS of an octave of a whole map, by its periodogram."""
    spectrum = np.abs(np.fft.fft2(height)) ** 2 / height.size**2
    per_um = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(len(height), pixel_um)]))
    return np.sqrt(spectrum[(per_um >= 1 / longest_um) & (per_um < 1 / shortest_um)].sum())


def test_excess_of_long_waves_is_removed(rng):
    patch, plain = rough_map(rng, 700), rough_map(rng, 700)
    slow = ndimage.gaussian_filter(rng.standard_normal((700, 700)), 9.0, mode="wrap")
    slow -= ndimage.gaussian_filter(slow, 18.0, mode="wrap")
    octave = (PIXEL_UM, 2000.0, 1000.0)
    slow *= 1.5 * octave_rms(plain, *octave) / octave_rms(slow, *octave)
    grown = (plain + slow).astype(np.float32)
    assert octave_rms(grown, *octave) > 1.5 * octave_rms(patch, *octave)
    match = split.match_spectrum(grown, [(patch, PIXEL_UM)], [1.0], PIXEL_UM)
    assert octave_rms(grown, *octave) == pytest.approx(octave_rms(patch, *octave), rel=0.05)
    fine = (PIXEL_UM, 500.0, 250.0)
    assert octave_rms(grown, *fine) == pytest.approx(octave_rms(patch, *fine), rel=0.03)
    assert match.before.max() > 1.5
    np.testing.assert_allclose(match.after, 1.0, atol=0.1)


def test_low_relief_regains_its_height(rng):
    patch, plain = rough_map(rng, 400), rough_map(rng, 700)
    grown = 0.9 * plain
    match = split.match_spectrum(grown, [(patch, PIXEL_UM)], [1.0], PIXEL_UM)
    assert match.fine_gain == pytest.approx(1 / 0.9, rel=0.03)
    assert grown.std() == pytest.approx(plain.std(), rel=0.03)


@pytest.mark.parametrize("hole_px", [12, 40])
def test_holes_do_not_weaken_relief(hole_px):
    """Holes of about 0.6 and 2 mm, as of masked grooves and jaws, over 15 % and 30 %."""
    rng = np.random.default_rng(5)
    patch, grown = rough_map(rng, 400), rough_map(rng, 500)
    cover = ndimage.gaussian_filter(rng.standard_normal(patch.shape), hole_px / 2.0, mode="wrap")
    gains, heights = [], []
    for part in (0.0, 0.15, 0.3):
        holed, matched = patch.copy(), grown.copy()
        holed[cover < np.quantile(cover, part)] = np.nan
        match = split.match_spectrum(matched, [(holed, PIXEL_UM)], [1.0], PIXEL_UM)
        gains.append(match.fine_gain)
        heights.append(matched.std())
    np.testing.assert_allclose(gains, gains[0], rtol=0.03)
    np.testing.assert_allclose(heights, heights[0], rtol=0.04)


def test_patch_below_one_wave_changes_nothing(rng):
    grown = rough_map(rng, 200)
    before = grown.copy()
    match = split.match_spectrum(grown, [(rough_map(rng, 20), PIXEL_UM)], [1.0], PIXEL_UM)
    np.testing.assert_array_equal(grown, before)
    assert match.to_json()["gains"] == []


def test_invalid_mesoscale_is_refused(rng):
    relief, valid = np.zeros((60, 60), np.float32), np.ones((30, 30), bool)
    for given_map, mask, pixel_um, match in (
        (np.zeros((30, 20)), valid, 100.0, "mesoscale_um"),
        (np.zeros((30, 30)), valid[:20], 100.0, "valid"),
        (np.zeros((30, 30)), ~valid, 100.0, "no valid texel"),
        (np.zeros((30, 30)), valid, 400.0, "pixel_um"),
        (np.zeros((90, 90)), np.ones((90, 90), bool), 100.0, "side of mesoscale_um"),
    ):
        with pytest.raises(SynthesisError, match=match):
            split.add_mesoscale(relief, given_map, mask, pixel_um)
    with pytest.raises(SynthesisError, match="shares"):
        split.match_spectrum(relief, [(np.zeros((9, 9)), 1.0)], [1.0, 2.0], 100.0)


@pytest.mark.parametrize("step", [1, 3, 7])
def test_coarse_ramp_is_interpolated_exactly(step):
    ramp = np.add.outer(np.arange(40.0), 2.0 * np.arange(40.0))
    fine = np.zeros((40 * step, 40 * step), np.float32)
    split.add_coarse(fine, ramp, step)
    at = (np.arange(40 * step) + 0.5) / step - 0.5
    inner = slice(step, -step)
    np.testing.assert_allclose(
        fine[inner, inner], np.add.outer(at, 2.0 * at)[inner, inner], atol=1e-3
    )
