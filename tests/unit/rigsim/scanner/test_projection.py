"""Displayed stripes and their blur, against closed forms."""

import dataclasses

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.scanner.projection import (
    DEFOCUS_PX,
    BlurredStripes,
    DisplayPlaces,
    defocus_blur_px,
    emitted_light,
    stripe_levels,
)

PERIOD, STEPS = 32, 6
PLACE = np.linspace(300.0, 500.0, 4001)


def shown(light, *, defocus, scattering, scattered=True):
    places = DisplayPlaces.of(
        PLACE, len(light), np.full(PLACE.shape, defocus), np.full(PLACE.shape, scattering)
    )
    return BlurredStripes.of(light).at(places, scattered=scattered)


def modulation(values):
    turn = np.exp(2j * np.pi * PLACE[:-1] / PERIOD)
    whole = slice(0, len(turn) // 640 * 640)  # whole periods
    return 2 * abs(np.mean(values[:-1][whole] * turn[whole]))


def test_gray_levels_differ_in_one_bit():
    bits = [stripe_levels(800, PERIOD, STEPS, k) for k in range(6)]
    change = np.sum(np.diff(bits, axis=1) != 0, axis=0)
    edges = np.flatnonzero(change) + 1
    assert change.max() == 1
    assert (edges % (PERIOD // 2) == 0).all()
    assert len(edges) == 800 // (PERIOD // 2) - 1


def test_phase_steps_sum_to_constant():
    steps = [stripe_levels(800, PERIOD, STEPS, 6 + n) for n in range(STEPS)]
    assert np.ptp(np.sum(steps, axis=0)) <= STEPS  # quantization: half a level each
    with pytest.raises(ValueError, match="pattern: got 12, expected 0 to 11"):
        stripe_levels(800, PERIOD, STEPS, 12)


@pytest.mark.parametrize(("defocus", "scattering"), [(2.0, 0.0), (4.0, 4.0), (1.0, 16.0)])
def test_blur_attenuates_by_transfer_function(defocus, scattering):
    light = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(800) / PERIOD)
    tabulated = min(DEFOCUS_PX, key=lambda sigma: abs(np.log(sigma / defocus)))
    wave = 2 * np.pi / PERIOD
    wanted = 0.5 * np.exp(-0.5 * (wave * tabulated) ** 2) / np.hypot(1.0, wave * scattering)
    found = shown(light, defocus=defocus, scattering=scattering)
    assert modulation(found) == pytest.approx(wanted * np.sinc(1 / PERIOD), rel=5e-3)
    sharp = shown(light, defocus=defocus, scattering=scattering, scattered=False)
    assert modulation(sharp) >= modulation(found) - 1e-6


def test_gamma_bends_levels_and_black_leaks():
    light = emitted_light([0, 127.5, 255], 2.0)
    np.testing.assert_allclose(light, [1 / 800, 1 / 800 + 0.25 * 799 / 800, 1.0])


def test_defocus_vanishes_at_focus():
    projector = load_rig("dome").scanner.projectors[0].pinhole
    focus = projector.focus_distance_mm
    blur = defocus_blur_px(projector, np.array([focus, focus - 100.0]))
    assert blur[0] == pytest.approx(0.6)
    wide = dataclasses.replace(projector, f_number=projector.f_number / 2)
    more = defocus_blur_px(wide, np.array([focus - 100.0]))[0]
    disc = np.sqrt(np.array([blur[1], more]) ** 2 - 0.6**2)
    assert disc[1] / disc[0] == pytest.approx(2.0)
