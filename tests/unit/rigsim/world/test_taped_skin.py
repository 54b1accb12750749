"""Skin and tape between the jaws: what stretches, slips, buckles and comes off."""

import dataclasses
import math

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.world.taped_skin import TapedSkin, TapedSkinError, TapeMechanics, draw_mechanics

CALIPER = load_rig("gradient").caliper
PLAIN = TapeMechanics(
    stiffness_n=0.7,
    stiffening=5.0,
    buckles_at=0.73,
    detaches_at=1.30,
    tape_n_per_mm=6.0,
    slips_at_n=0.09,
    hardening_n_per_mm=2.0,
)
RIGID = dataclasses.replace(PLAIN, tape_n_per_mm=math.inf, slips_at_n=math.inf)


def held(mechanics=PLAIN, angle_deg=0.0, **more):
    skin = TapedSkin(CALIPER, mechanics=mechanics, **more)
    skin.attach(angle_deg)
    return skin


def steps(skin, numbers):
    """Return the states and forces after each of some steps."""
    found = []
    for number in numbers:
        skin.move(CALIPER.reading_mm(number))
        found.append((skin.state, skin.force_n))
    return found


def test_force_curve_is_j_shaped_with_fung_exponent():
    r = np.array([1.0, 1.05, 1.1, 1.15, 1.2])
    slope = np.array([(PLAIN.force_n(x + 1e-6) - PLAIN.force_n(x)) / 1e-6 for x in r])
    np.testing.assert_allclose(slope[0], PLAIN.stiffness_n, rtol=1e-4)
    np.testing.assert_allclose(np.diff(np.log(slope)) / 0.05, PLAIN.stiffening, rtol=1e-4)
    assert PLAIN.force_n(0.9) == pytest.approx(-0.07)
    linear = dataclasses.replace(PLAIN, stiffening=0.0)
    assert linear.force_n(1.2) == pytest.approx(0.14)


def test_skin_under_rigid_tape_follows_jaws():
    for state, force_n in steps(held(RIGID), (1, 2, 0, -1, -2)):
        assert state.stretch == pytest.approx(state.aperture_mm / 8.0, abs=1e-12)
        assert force_n == pytest.approx(RIGID.force_n(state.aperture_mm / 8.0), abs=1e-12)


@pytest.mark.parametrize("path", [(1, 2, 3), (-1, -2), (2, -2, 2, 0, 1)])
def test_skin_tape_and_slip_fill_jaws_sharing_force(path):
    skin = held()
    for step in path:
        ((state, force_n),) = steps(skin, (step,))
        filled_mm = 8.0 * state.stretch + force_n / PLAIN.tape_n_per_mm + skin.slip_mm
        assert filled_mm == pytest.approx(state.aperture_mm, abs=1e-9)
        assert force_n == pytest.approx(PLAIN.force_n(state.stretch), abs=1e-12)
        beyond_n = abs(force_n - PLAIN.hardening_n_per_mm * skin.slip_mm)
        assert beyond_n <= PLAIN.slips_at_n + 1e-9


@pytest.mark.parametrize("step", [3, 2, -2, -4])
def test_stepwise_move_ends_like_single_move(step):
    whole, pieces = held(), held()
    whole.move(CALIPER.reading_mm(step))
    for aperture_mm in np.linspace(8.0, CALIPER.reading_mm(step), 357)[1:]:
        pieces.move(float(aperture_mm))
    assert pieces.state.stretch == pytest.approx(whole.state.stretch, abs=1e-9)
    assert pieces.force_n == pytest.approx(whole.force_n, abs=1e-9)
    assert pieces.slip_mm == pytest.approx(whole.slip_mm, abs=1e-9)


def test_slipped_tape_does_not_return_skin_to_start():
    stretched, pressed = held(), held()
    assert steps(stretched, (3, 0))[-1][0].stretch < 1.0 - 2e-3
    assert steps(pressed, (-2, 0))[-1][0].stretch > 1.0 + 5e-4
    elastic = held(dataclasses.replace(PLAIN, slips_at_n=math.inf))
    assert steps(elastic, (3, 0))[-1][0].stretch == pytest.approx(1.0, abs=1e-12)


def test_slip_at_large_steps_is_few_percent_growing():
    shares = []
    for seed in range(60):
        skin = TapedSkin(CALIPER, seed=seed)
        skin.attach(45.0)
        lost = [state.aperture_mm / 8.0 - state.stretch for state, _ in steps(skin, (1, 2))]
        assert 0.0 < lost[0] < lost[1]
        shares.append(lost[1])
    assert 0.005 < np.median(shares) < 0.03
    assert max(shares) < 0.06


def test_buckled_skin_force_stays_constant():
    (first, force_n), (deep, deep_n) = steps(held(), (-3, -4))
    assert (first.buckled, deep.buckled) == (True, True)
    assert first.stretch <= PLAIN.buckles_at
    assert deep.stretch < first.stretch - 0.09
    assert deep_n == pytest.approx(force_n, abs=1e-12)
    assert force_n == pytest.approx(PLAIN.force_n(PLAIN.buckles_at), abs=1e-12)
    state, back_n = steps(held(), (-3, -2))[-1]
    assert not state.buckled
    assert abs(back_n) < abs(force_n)


def test_released_tape_leaves_skin_at_rest_until_retaped():
    skin = held()
    near, _ = steps(skin, (3,))[-1]
    assert near.attached
    for state, force_n in steps(skin, (4, 5, 0)):
        assert (state.attached, state.stretch, state.buckled, force_n) == (False, 1.0, False, 0.0)
    skin.attach(90.0)
    state, force_n = steps(skin, (1,))[-1]
    assert (state.attached, state.angle_deg, state.step) == (True, 90.0, 1)
    assert force_n > 0.0


def test_stretch_limits_are_drawn_over_stated_ranges():
    drawn = [draw_mechanics(seed, angle_deg=0.0) for seed in range(300)]
    for field, low, high in (("buckles_at", 0.70, 0.76), ("detaches_at", 1.25, 1.35)):
        values = np.array([getattr(one, field) for one in drawn])
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    # the middle of an even distribution: 300 values miss it by 4.5 deviations once in 150 000
    middle = np.mean([one.buckles_at for one in drawn])
    assert abs(middle - 0.73) < 4.5 * 0.06 / math.sqrt(12 * 300)


def test_skin_depends_on_subject_and_direction_only():
    assert draw_mechanics(3, angle_deg=45.0) == draw_mechanics(3, angle_deg=45.0)
    assert draw_mechanics(3, angle_deg=45.0) != draw_mechanics(3, angle_deg=90.0)
    assert draw_mechanics(3, angle_deg=45.0) != draw_mechanics(4, angle_deg=45.0)
    usual, stiff = (draw_mechanics(3, angle_deg=0.0, stiffness=k) for k in (1.0, 5.0))
    assert stiff.stiffness_n == pytest.approx(5.0 * usual.stiffness_n)


def test_skin_anisotropy_has_half_rotation_period():
    stiff = [draw_mechanics(7, angle_deg=a).stiffness_n for a in (0.0, 45.0, 90.0, 135.0)]
    assert stiff[0] + stiff[2] == pytest.approx(stiff[1] + stiff[3])
    assert max(stiff) / min(stiff) > 1.1


def test_step_is_nearest_to_jaws():
    skin = TapedSkin(CALIPER)
    for aperture_mm, step in ((8.0, 0), (8.39, 0), (8.41, 1), (4.8, -4), (7.61, 0)):
        skin.move(aperture_mm)
        assert skin.state.step == step
    assert not skin.state.attached


def test_invalid_requests_are_refused():
    skin = held()
    with pytest.raises(TapedSkinError, match="release the skin first"):
        skin.turn(45.0)
    with pytest.raises(TapedSkinError, match="aperture_mm"):
        skin.move(0.0)
    with pytest.raises(TapedSkinError, match="angle_deg"):
        skin.attach(180.0)
    with pytest.raises(TapedSkinError, match="stiffness"):
        draw_mechanics(0, angle_deg=0.0, stiffness=0.0)
    for change in (
        {"buckles_at": 1.1},
        {"detaches_at": 0.9},
        {"stiffness_n": -1.0},
        {"hardening_n_per_mm": 0.0},
        {"stiffening": math.nan},
    ):
        with pytest.raises(TapedSkinError, match=next(iter(change))):
            dataclasses.replace(PLAIN, **change)
