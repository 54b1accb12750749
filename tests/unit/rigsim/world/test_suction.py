"""A cup on the skin: what pump, leaks, vent and skin make of the suction, against closed forms."""

import dataclasses
import math

import numpy as np
import pytest

from rigsim.world.suction import (
    OPEN_RIM_LEAK_ML_PER_S_MBAR,
    CameraCooler,
    HeadState,
    ProbeHead,
    SuctionError,
    SuctionMechanics,
)

LAW = SuctionMechanics()
COOLER = CameraCooler(5.0)


def head(mechanics=LAW, site="cheek", **more):
    found = ProbeHead(COOLER, mechanics=mechanics, **more)
    found.place(site, 0.0, 0.0)
    return found


def integrated(law, wanted_mbar, leak, times_s, dt_s=2e-5):
    """Return the suction by small steps of the pump's and the leak's flows, apart from the code."""
    found, p, t = [], 0.0, 0.0
    volume = law.cup_ml / 1013.25 + law.skin_ml_per_mbar
    for until in times_s:
        while t < until - 0.5 * dt_s:
            most = law.free_flow_ml_per_s * (1.0 - p / law.dead_head_mbar)
            pump = min(law.regulator_ml_per_s_mbar * (wanted_mbar - p), most)
            p += dt_s * (pump - leak * p) / volume
            t += dt_s
        found.append(p)
    return np.array(found)


def test_regulated_pump_approaches_target_as_one_exponential():
    sucked = head()
    sucked.start_suction(60.0, 1.0)
    volume = 2.0 / 1013.25 + 6e-4
    tau_s, ends_mbar = volume / 8.1e-3, 60.0 * 8.0 / 8.1
    for t_s in (0.0, 0.05, 0.3, 1.0, 3.0):
        expected = ends_mbar * -math.expm1(-t_s / tau_s)
        assert sucked.suction_mbar(1.0 + t_s) == pytest.approx(expected, abs=1e-9)
    assert LAW.time_constant_s == pytest.approx(tau_s)
    assert 0.25 < tau_s < 0.4


def test_pump_asked_beyond_capacity_first_gives_free_flow():
    sucked = head()
    sucked.start_suction(150.0, 0.0)
    times_s = np.array([0.02, 0.1, 0.2, 0.4, 1.0, 2.0])
    found = [sucked.suction_mbar(t) for t in times_s]
    np.testing.assert_allclose(found, integrated(LAW, 150.0, 1e-4, times_s), atol=0.02)
    # at first the free flow, not what the regulator asks for
    first = head()
    first.start_suction(150.0, 0.0)
    slope = first.suction_mbar(1e-6) / 1e-6
    volume = LAW.compliance_ml_per_mbar
    assert slope == pytest.approx(0.8 / volume, rel=1e-4)
    assert slope < 0.7 * 150.0 * 8e-3 / volume


@pytest.mark.parametrize("leak", [0.0, 0.05, 0.3, 2.0, 8.0])
def test_a_leak_makes_the_suction_settle_lower(leak):
    law = dataclasses.replace(LAW, leak_ml_per_s_mbar=8e-3 * leak)
    sucked = head(law)
    sucked.start_suction(60.0, 0.0)
    assert sucked.suction_mbar(20.0) == pytest.approx(60.0 / (1.0 + leak), rel=1e-6)


def test_large_leak_keeps_full_speed_pump_below_target():
    law = dataclasses.replace(LAW, leak_ml_per_s_mbar=0.02)
    sucked = head(law)
    sucked.start_suction(150.0, 0.0)
    # free flow = leak + what the dead head takes off: 0.8 = (0.02 + 0.8 / 300) p
    assert sucked.suction_mbar(20.0) == pytest.approx(0.8 / (0.02 + 0.8 / 300.0), rel=1e-6)


def test_vented_cup_fills_as_one_exponential():
    sucked = head()
    sucked.start_suction(60.0, 0.0)
    from_mbar = sucked.suction_mbar(5.0)
    sucked.vent(5.0)
    tau_s = LAW.compliance_ml_per_mbar / (0.05 + 1e-4)
    for t_s in (0.01, 0.05, 0.2):
        expected = from_mbar * math.exp(-t_s / tau_s)
        assert sucked.suction_mbar(5.0 + t_s) == pytest.approx(expected)
    assert sucked.suction_mbar(6.0) < 0.01


def test_dead_pump_gives_no_suction():
    sucked = head(pump_dead=True)
    sucked.start_suction(60.0, 0.0)
    assert sucked.suction_mbar(10.0) == 0.0


def test_detached_head_loses_suction_at_once():
    sucked = head(lifts_after_s=3.0)
    sucked.start_suction(60.0, 1.0)
    held_mbar = sucked.suction_mbar(4.0 - 1e-9)
    assert held_mbar > 58.0
    tau_s = LAW.compliance_ml_per_mbar / (OPEN_RIM_LEAK_ML_PER_S_MBAR + 8e-3)
    left_mbar = 8e-3 * 60.0 / (OPEN_RIM_LEAK_ML_PER_S_MBAR + 8e-3)
    expected = left_mbar + (held_mbar - left_mbar) * math.exp(-0.003 / tau_s)
    assert sucked.suction_mbar(4.003) == pytest.approx(expected, rel=1e-6)
    assert sucked.state_at(3.9).placed
    state = sucked.state_at(4.5)
    assert (state.site, state.placed) == ("", False)
    assert state.suction_mbar < 0.5
    # put on again, it stays
    sucked.vent(5.0)
    sucked.place("cheek", 0.0, 6.0)
    sucked.start_suction(60.0, 7.0)
    assert sucked.suction_mbar(60.0) > 58.0


def test_one_big_time_step_equals_many_small_ones():
    def play(step_s):
        sucked = head(lifts_after_s=6.0)
        now = 0.0
        for act, until in (("draw", 1.0), ("vent", 4.0), ("draw", 5.0), ("end", 9.0)):
            while now < until - 1e-9:
                now = min(now + step_s, until)
                sucked.advance(now)
            if act == "draw":
                sucked.start_suction(150.0, until)
            elif act == "vent":
                sucked.vent(until)
        return [sucked.state_at(t) for t in np.linspace(0.0, 9.0, 301)], sucked.change_times_s

    (states, changes), (states_finely, changes_finely) = play(10.0), play(0.0137)
    assert changes == pytest.approx(changes_finely)
    for coarse, fine in zip(states, states_finely, strict=True):
        assert (coarse.site, coarse.placed) == (fine.site, fine.placed)
        assert coarse.suction_mbar == pytest.approx(fine.suction_mbar, abs=1e-9)


def test_suction_has_no_jumps_and_is_remembered():
    sucked = ProbeHead(COOLER, seed=3)
    sucked.place("forehead", 22.5, 0.5)
    sucked.start_suction(120.0, 1.0)
    sucked.vent(3.0)
    sucked.advance(5.0)
    for t_s in sucked.change_times_s[1:]:
        before, after = sucked.state_at(t_s - 1e-9), sucked.state_at(t_s)
        assert before.suction_mbar == pytest.approx(after.suction_mbar, abs=1e-5)
    assert sucked.state_at(0.2) == HeadState("", 0.0, False, 0.0, 5.0)
    assert sucked.state_at(0.7) == HeadState("forehead", 22.5, True, 0.0, 5.0)
    kept = sucked.state_at(2.0)
    sucked.remove(6.0)
    sucked.advance(9.0)
    assert sucked.state_at(2.0) == kept
    assert sucked.state_at(7.0).site == ""


def test_loose_skin_takes_longest_and_block_least():
    def reached_s(site, seed):
        sucked = ProbeHead(COOLER, seed=seed)
        sucked.place(site, 0.0, 0.0)
        return sucked.mechanics.time_constant_s, sucked.mechanics.leak_ml_per_s_mbar / 8e-3

    for seed in range(20):
        rigid, forehead, abdomen = (reached_s(s, seed) for s in ("phantom", "forehead", "abdomen"))
        assert rigid[0] < forehead[0] < abdomen[0]
        assert rigid[1] < 0.002
        assert 0.005 <= forehead[1] <= 0.02
        assert 0.2 < forehead[0] < 0.45
    assert reached_s("cheek", 1) == reached_s("cheek", 1) != reached_s("cheek", 2)
    assert reached_s("elbow", 1)[0] > rigid[0]


@pytest.mark.parametrize("leak", [0.1, 1.0, 5.0])
def test_the_leak_switch_bounds_the_suction_from_above(leak):
    for site in ("forehead", "phantom", "abdomen"):
        sucked = ProbeHead(COOLER, seed=1, leak=leak)
        sucked.place(site, 0.0, 0.0)
        sucked.start_suction(60.0, 0.0)
        ends_mbar = sucked.suction_mbar(30.0)
        assert 60.0 / (1.03 + leak) < ends_mbar < 60.0 / (1.0 + leak)


def test_camera_warms_to_room_after_cooling_fails():
    cooler = CameraCooler(5.0, fails_after_s=100.0)
    assert cooler.camera_c(0.0) == cooler.camera_c(100.0) == 5.0
    assert cooler.camera_c(220.0) == pytest.approx(24.0 - 19.0 / math.e)
    assert cooler.camera_c(1e5) == pytest.approx(24.0)


def test_invalid_parameter_is_named():
    for field, value in (
        ("cup_ml", 0.0),
        ("leak_ml_per_s_mbar", -1e-6),
        ("free_flow_ml_per_s", math.inf),
        ("regulator_ml_per_s_mbar", 1e-3),
        ("skin_ml_per_mbar", math.nan),
    ):
        with pytest.raises(SuctionError, match=field):
            dataclasses.replace(LAW, **{field: value})
    with pytest.raises(SuctionError, match="leak"):
        ProbeHead(COOLER, leak=-1.0)
    sucked = head()
    with pytest.raises(SuctionError, match="angle_deg"):
        sucked.place("cheek", 360.0, 1.0)
    with pytest.raises(SuctionError, match="target_mbar"):
        sucked.start_suction(0.0, 1.0)
    sucked.start_suction(60.0, 1.0)
    with pytest.raises(SuctionError, match="vent it first"):
        sucked.place("cheek", 0.0, 2.0)


def test_zero_leak_and_zero_skin_compliance_work():
    law = dataclasses.replace(LAW, leak_ml_per_s_mbar=0.0, skin_ml_per_mbar=0.0)
    sucked = head(law, pump_dead=True)
    sucked.start_suction(60.0, 0.0)
    assert sucked.suction_mbar(1e3) == 0.0
    sucked = head(law)
    sucked.start_suction(60.0, 0.0)
    assert sucked.suction_mbar(1e3) == pytest.approx(60.0, abs=1e-9)
