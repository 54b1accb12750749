"""Caliper controller: time and skin, beyond the rows of its manual."""

import dataclasses
import json

import numpy as np
import pytest
from fixtures.box_manuals import CALIPER, CALIPER_READY

from capture.devices import wire
from capture.devices.wire import Code, Request
from rigsim.boxes.caliper import CALIPER_CONTROL_PERIOD_S, CaliperUnit
from rigsim.boxes.device import Wiring
from rigsim.world.taped_skin import TapedSkin

RIG = CALIPER.rig


@pytest.fixture
def bench():
    return CALIPER.bench()


def test_letting_go_needs_no_frame(bench):
    bench.hold()
    said = bench.raw(b"CAL:REL\n").splitlines()
    assert [wire.decode(line).name for line in said] == ["CAL:FREE"]
    assert not bench.unit.attached


def test_the_data_dictionary_holds_the_rigs_limits(bench):
    limits = json.loads(wire.unseal(bench.ask("SYST:CAP?")))
    caliper = RIG.caliper
    assert limits["kind"] == "caliper"
    assert (limits["step_min"], limits["step_max"]) == (caliper.first_step, caliper.last_step)
    assert (limits["step_mm"], limits["aperture_mm"]) == (0.8, 8.0)
    assert limits["angles_deg"] == [0.0, 45.0, 90.0, 135.0]
    assert limits["control_period_ms"] == 1e3 * CALIPER_CONTROL_PERIOD_S
    assert not any("default" in name for name in limits)


def test_no_caliper_goes_further_than_fifteen_steps():
    long = dataclasses.replace(RIG.caliper, step_mm=0.1, first_step=-40, last_step=60)
    rig, rng = dataclasses.replace(RIG, caliper=long), np.random.default_rng(0)
    unit = CaliperUnit(Wiring(rig=rig, rng=rng, skin=TapedSkin(long)))
    assert (unit.step_min, unit.step_max) == (-15, 15)


# what must come before a move ------------------------------------------------------------------


def test_nothing_moves_before_operator_sets_force_limit(bench):
    bench.ask("SYST:ARM")
    assert bench.code("CAL:HOME") == Code.IGNORED
    assert bench.code("CAL:STEP:ABS 1") == Code.IGNORED
    assert "no default" in bench.ask("SYST:ERR?")
    assert bench.unit.moves == []


def test_steps_and_skin_wait_for_the_home_mark(bench):
    bench.say(CALIPER_READY[:2])
    assert bench.code("CAL:STEP:ABS 1") == Code.IGNORED
    assert bench.code("CAL:ATT") == Code.IGNORED
    bench.home()
    assert bench.code("CAL:ATT") == Code.OK


def test_skin_is_taped_at_step_zero_only(bench):
    bench.say(CALIPER_READY)
    bench.move(2)
    assert bench.code("CAL:ATT") == Code.IGNORED
    bench.move(0)
    assert bench.code("CAL:ATT") == Code.OK


def test_jaws_holding_skin_neither_rotate_nor_seek_home(bench):
    bench.hold()
    assert bench.code("CAL:ANG 45") == Code.IGNORED
    assert bench.code("CAL:HOME") == Code.IGNORED
    bench.ask("CAL:REL")
    assert bench.code("CAL:ANG 45") == Code.OK


@pytest.mark.parametrize("forget", ["*RST", "power"])
def test_limit_and_home_do_not_outlive_a_reset(bench, forget):
    bench.hold()
    if forget == "power":
        bench.box.power_cycle(bench.now, boot_s=0.0, announce=False)
    else:
        bench.ask("*RST")
    assert bench.ask("CAL:FORC:LIM?") == "NONE"
    assert bench.ask("CAL:POS?") == "NONE"
    assert not bench.world.skin.state.attached


# moves -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_home_is_found_from_any_jaw_position(seed):
    bench = CALIPER.bench(seed=seed)
    start_mm = bench.unit.aperture_mm
    assert abs(start_mm - 8.0) > 1e-3
    bench.say(CALIPER_READY)
    assert bench.unit.aperture_mm == 8.0
    assert bench.ask("CAL:POS?") == "8.000"


def test_move_is_accepted_at_once_ends_on_time(bench):
    bench.say(CALIPER_READY)
    begin = bench.now
    assert bench.ask("CAL:STEP:ABS 3") == "2"
    assert bench.ask("*OPC?") == "0"
    assert int(bench.ask("STAT?")) & 16
    bench.wait(1.0)
    assert bench.unit.aperture_mm == pytest.approx(8.0 + 2.0 * 1.0)
    number, end, step, mm, newton, t_us = bench.finish()
    assert (number, end, step, mm, float(newton)) == (
        "2",
        "REACHED",
        "3",
        "10.400",
        pytest.approx(0.0, abs=0.05),
    )
    assert int(t_us) == pytest.approx(1e6 * (begin + 1.2), abs=1.0)
    assert bench.events("CAL:END")[-1] == ",".join((number, end, step, mm, newton, t_us))


def test_steps_are_absolute(bench):
    bench.say(CALIPER_READY)
    for step, mm in ((2, "9.600"), (2, "9.600"), (-1, "7.200"), (0, "8.000")):
        assert bench.move(step)[2:4] == [str(step), mm]


def test_a_move_under_way_is_not_meddled_with(bench):
    bench.say(CALIPER_READY)
    bench.ask("CAL:STEP:ABS 4")
    for text in ("CAL:STEP:ABS 0", "CAL:HOME", "CAL:ANG 45", "CAL:ATT"):
        assert bench.code(text) == Code.IGNORED
    assert bench.finish()[2] == "4"


def test_rotation_takes_time_and_sets_taping_angle(bench):
    bench.say(CALIPER_READY)
    bench.ask("CAL:ANG 135")
    assert bench.ask("CAL:ANG?") == "135"
    bench.wait(1.4)
    assert bench.ask("*OPC?") == "0"
    bench.wait(0.2)
    assert bench.ask("*OPC?") == "1"
    bench.ask("CAL:ATT")
    state = bench.world.skin.state
    assert (state.angle_deg, state.attached) == (135.0, True)


def test_the_force_is_tared_when_skin_is_taped():
    offsets = []
    for seed in range(8):
        bench = CALIPER.bench(seed=seed)
        offsets.append(float(bench.ask("CAL:FORC?")))
        bench.hold()
        assert abs(float(bench.ask("CAL:FORC?"))) == 0.0
        bench.move(1)
        assert float(bench.ask("CAL:FORC?")) == pytest.approx(bench.world.skin.force_n, abs=6e-4)
    assert np.std(offsets) > 0.003


def test_a_retry_of_a_move_moves_once(bench):
    bench.say((*CALIPER_READY, "SYST:WDOG 5000"))
    bench.seq += 1
    frame = wire.encode(Request(bench.seq, bench.box.boot, "CAL:STEP:ABS 2"))
    first, again = bench.raw(frame), bench.raw(frame)
    assert first == again
    bench.silence(1.0)
    assert bench.ask("*OPC?") == "1"
    assert bench.raw(frame) == first
    assert bench.ask("*OPC?") == "1"
    assert len(bench.unit.moves) == 2


def test_large_time_step_equals_many_small_steps():
    def play(step_s):
        bench = CALIPER.bench()
        bench.ask("SYST:WDOG 5000")
        bench.hold(0.3)
        bench.ask("CAL:STEP:ABS 6")
        until = bench.now + 4.5
        while bench.now < until - 1e-9:
            bench.silence(min(step_s, until - bench.now))
        return bench.said, [state for _, state in bench.world.grips]

    (said, grips), (said_finely, grips_finely) = play(4.5), play(0.0031)
    assert said == said_finely
    assert grips == grips_finely
    assert len(grips) > 100


# ends ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "limit_n"), [(4, 0.3), (-3, 0.12)])
def test_force_at_limit_reverses_jaws(bench, step, limit_n):
    bench.hold(limit_n)
    before = [t for t, _ in bench.world.grips]
    _, end, stands, mm, newton, _ = bench.move(step)
    assert (end, stands) == ("FORCE", "0")
    over_n = abs(float(newton)) - limit_n
    slope_n_per_mm = 0.7 * np.exp(5.0 * 0.25) / 8.0
    assert (
        -5e-4
        <= over_n
        <= slope_n_per_mm * RIG.caliper.speed_mm_per_s * CALIPER_CONTROL_PERIOD_S + 5e-4
    )
    assert np.sign(float(newton)) == np.sign(step)
    trip_mm, trip_n, _ = bench.events("CAL:FORC:TRIP")[0].split(",")
    assert (trip_mm, trip_n) == (mm, newton)
    assert bench.unit.aperture_mm == 8.0
    assert int(bench.ask("STAT?")) & 1024
    apertures = [s.aperture_mm for t, s in bench.world.grips if t > before[-1]]
    furthest = max(apertures) if step > 0 else min(apertures)
    assert furthest == pytest.approx(float(mm), abs=1e-3)


def test_direction_that_met_limit_stays_barred(bench):
    bench.hold(0.3)
    bench.move(4)
    assert bench.code("CAL:STEP:ABS 4") == Code.FORCE
    assert bench.code("CAL:STEP:ABS 3") == Code.FORCE
    assert bench.move(1)[1] == "REACHED"
    assert bench.move(-1)[1] == "REACHED"
    bench.ask("CAL:FORC:LIM 5")
    assert bench.move(3)[1] == "REACHED"


def test_a_limit_below_the_present_force_is_refused(bench):
    bench.hold()
    bench.move(3)
    assert bench.code("CAL:FORC:LIM 0.1") == Code.FORCE
    assert bench.ask("CAL:FORC:LIM?") == "5"


def test_detached_skin_ends_move_at_that_point(bench):
    bench.hold()
    assert bench.move(3)[1] == "REACHED"
    _, end, step, mm, newton, _ = bench.move(8)
    assert (end, float(newton)) == ("DETACHED", 0.0)
    assert 10.4 < float(mm) < 11.2
    assert step in ("3", "4")
    assert bench.ask("CAL:ATT?") == "0"
    assert not bench.world.skin.state.attached
    assert bench.move(0)[1] == "REACHED"
    bench.ask("CAL:ATT")
    assert bench.world.skin.state.attached


def test_buckling_continues_move_but_force_stops_growing(bench):
    bench.hold()
    forces = [float(bench.move(step)[4]) for step in (-1, -2, -3, -4)]
    assert forces[1] < 1.8 * forces[0] < 0.0
    assert forces[3] == forces[2]


def test_stalled_motor_is_detected_and_requires_homing():
    bench = CALIPER.bench(jaw_stall=1.0)
    bench.unit._stall = 0.0
    bench.hold()
    bench.unit._stall = 1.0
    _, end, _, mm, _, _ = bench.move(3)
    assert end == "STALL"
    assert 8.0 <= float(mm) < 10.4
    assert bench.ask("CAL:POS?") == "NONE"
    assert bench.unit.attached  # held where it is, until somebody decides
    assert bench.code("CAL:STEP:ABS 0") == Code.IGNORED
    bench.unit._stall = 0.0
    bench.ask("CAL:REL")
    bench.home()


def test_a_stall_is_noticed_within_its_lag():
    bench = CALIPER.bench()
    bench.say(CALIPER_READY)
    bench.unit._stall = 1.0
    begin = bench.now
    _, end, _, mm, _, t_us = bench.move(4)
    assert end == "STALL"
    seen_s = 1e-6 * int(t_us) - begin
    assert (
        seen_s
        <= (float(mm) - 8.0 + 0.05) / RIG.caliper.speed_mm_per_s + CALIPER_CONTROL_PERIOD_S + 1e-6
    )


def test_undetected_home_mark_ends_at_travel_limit():
    bench = CALIPER.bench(home_missed=True)
    bench.say(CALIPER_READY[:2])
    bench.ask("CAL:HOME")
    assert bench.finish()[1] == "NOHOME"
    assert bench.ask("CAL:POS?") == "NONE"
    assert bench.code("CAL:STEP:ABS 0") == Code.IGNORED


def test_nothing_moves_with_a_dead_force_sensor():
    bench = CALIPER.bench(force_dead=True)
    bench.say(CALIPER_READY[:2])
    for text in ("CAL:HOME", "CAL:STEP:ABS 0", "CAL:ATT", "CAL:FORC?"):
        assert bench.code(text) == Code.HARDWARE
    assert bench.unit.moves == []


# letting go ------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["CAL:REL", "SAFE", "ABOR", "*RST"])
def test_skin_release_is_immediate_even_during_move(bench, text):
    bench.hold()
    bench.ask("CAL:STEP:ABS 3")
    bench.wait(0.5)
    assert bench.world.skin.state.stretch > 1.05
    bench.ask(text)
    state = bench.world.skin.state
    assert (state.attached, state.stretch) == (False, 1.0)
    assert bench.events("CAL:END")[-1].split(",")[1] == "STOPPED"
    assert bench.events("CAL:FREE")
    stands_mm = bench.unit.aperture_mm
    bench.wait(1.0)
    assert bench.unit.aperture_mm == stands_mm


def test_silent_host_releases_skin_within_lease(bench):
    bench.ask("SYST:WDOG 300")
    bench.hold()
    bench.move(2)
    silent_s = bench.now
    bench.silence(2.0)
    assert "WDOG:TRIP" in [name for name, _ in bench.said]
    freed_s, state = bench.world.grips[-1]
    assert (state.attached, state.stretch) == (False, 1.0)
    assert freed_s == pytest.approx(silent_s + 0.3)
    assert bench.code("CAL:STEP:ABS 0") == Code.WATCHDOG_TRIPPED
    bench.ask("SYST:ARM")
    assert bench.move(0)[1] == "REACHED"
    assert not bench.world.skin.state.attached


def test_reset_mid_move_releases_and_forgets_move(bench):
    bench.hold()
    bench.ask("CAL:STEP:ABS 3")
    bench.wait(0.5)
    bench.box.power_cycle(bench.now, boot_s=0.5, announce=False)
    assert not bench.world.skin.state.attached
    stands_mm = bench.unit.aperture_mm
    bench.silence(2.0)
    assert bench.unit.aperture_mm == stands_mm
    assert bench.ask("CAL:LAST?") == "NONE"
    assert bench.ask("CAL:FORC:LIM?") == "NONE"


def test_emergency_stop_releases_and_bars_all_moves():
    bench = CALIPER.bench(interlock_after=12.0)
    bench.hold()
    bench.move(2)
    assert bench.now < 12.0
    bench.wait(12.0 - bench.now + 0.1)
    freed_s, state = bench.world.grips[-1]
    assert (freed_s, state.attached) == (12.0, False)
    assert int(bench.ask("STAT?")) & 256
    for text in ("CAL:HOME", "CAL:STEP:ABS 0", "CAL:ATT", "CAL:ANG 45"):
        assert bench.code(text) == Code.INTERLOCK
    closed = CALIPER.bench(interlock=True)
    closed.say(CALIPER_READY[:2])
    assert closed.code("CAL:HOME") == Code.INTERLOCK


def test_force_persistently_beyond_limit_releases_skin(monkeypatch):
    bench = CALIPER.bench()
    bench.hold(0.3)

    def pull(aperture_mm, move=bench.world.skin.move):
        move(max(aperture_mm, bench.world.skin.state.aperture_mm))  # the subject follows the jaws

    monkeypatch.setattr(bench.world.skin, "move", pull)
    assert bench.move(4)[1] == "FORCE"
    assert bench.events("CAL:FREE")[-1].startswith("FORCE,")
    assert not bench.world.skin.state.attached
