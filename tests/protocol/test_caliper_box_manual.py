"""Every row of the caliper box's manual, on the box itself: bytes and time in, bytes out."""

import dataclasses
import json

import numpy as np
import pytest
from fixtures.framed_bench import ANY, SHARED_COMMANDS

from capture.devices import wire
from capture.devices.wire import Code, Request
from capture.rig import load_rig
from rigsim.boxes.caliper import CALIPER_CONTROL_PERIOD_S, CaliperUnit
from rigsim.boxes.device import Wiring
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.taped_skin import TapedSkin, TapeMechanics

RIG = load_rig("gradient").cropped(16)
SKIN = TapeMechanics(
    stiffness_n=0.7,
    stiffening=5.0,
    buckles_at=0.73,
    detaches_at=1.30,
    tape_n_per_mm=6.0,
    slips_at_n=0.09,
    hardening_n_per_mm=2.0,
)

READY = ("CAL:FORC:LIM 5", "SYST:ARM")
# header -> text, what must come before, expected payload
MANUAL = {
    "CAL:HOME": ("CAL:HOME", READY, "1"),
    "CAL:STEP:ABS": ("CAL:STEP:ABS -2", (*READY, "home"), "2"),
    "CAL:POS?": ("CAL:POS?", (), "NONE"),
    "CAL:LAST?": ("CAL:LAST?", (), "NONE"),
    "CAL:ANG": ("CAL:ANG 45", ("SYST:ARM",), ""),
    "CAL:ANG?": ("CAL:ANG?", (), "0"),
    "CAL:ATT": ("CAL:ATT", (*READY, "home"), ""),
    "CAL:ATT?": ("CAL:ATT?", (), "0"),
    "CAL:REL": ("CAL:REL", (), ""),
    "CAL:FORC?": ("CAL:FORC?", (), ANY),
    "CAL:FORC:LIM": ("CAL:FORC:LIM 1.5", (), ""),
    "CAL:FORC:LIM?": ("CAL:FORC:LIM?", (), "NONE"),
}


@pytest.fixture
def make(framed):
    def make(seed=3, mechanics=SKIN, **faults):
        bench = framed(World(RIG, seed=seed, faults=Faults(**faults)), "caliper")
        skin = bench.world.skin
        skin._fixed = skin.mechanics = mechanics
        return bench

    return make


@pytest.fixture
def bench(make):
    return make()


def say(bench, lines):
    for line in lines:
        if line == "home":
            home(bench)
        else:
            bench.ask(line)


def finish(bench):
    while bench.ask("*OPC?") == "0":
        bench.wait(0.1)
    return bench.ask("CAL:LAST?").split(",")


def home(bench):
    bench.ask("CAL:HOME")
    assert finish(bench)[1] == "REACHED"


def hold(bench, limit_n=5.0):
    say(bench, (f"CAL:FORC:LIM {limit_n}", "SYST:ARM", "home", "CAL:ATT"))


def move(bench, step):
    bench.ask(f"CAL:STEP:ABS {step}")
    return finish(bench)


def test_the_manual_is_complete(bench):
    assert set(MANUAL) | SHARED_COMMANDS == set(bench.box.commands)
    assert all(command.manual for command in bench.box.commands.values())


@pytest.mark.parametrize("header", MANUAL)
def test_a_framed_command_is_answered_as_its_manual_says(bench, header):
    text, before, expected = MANUAL[header]
    say(bench, before)
    payload = bench.ask(text)
    assert expected is ANY or payload == expected


@pytest.mark.parametrize("header", [h for h in MANUAL if not h.endswith("?") and h != "CAL:REL"])
def test_a_bare_command_is_refused_and_moves_nothing(bench, header):
    text, before, _ = MANUAL[header]
    say(bench, before)
    moves, stands_mm = len(bench.unit.moves), bench.unit.aperture_mm
    assert bench.raw(text.encode() + b"\n") == b""
    assert bench.raw(b"SYST:ERR?\n") == b'203,"Unframed command"\n'
    bench.wait(0.5)
    assert (len(bench.unit.moves), bench.unit.aperture_mm) == (moves, stands_mm)
    assert not bench.unit.attached


def test_letting_go_needs_no_frame(bench):
    hold(bench)
    said = bench.raw(b"CAL:REL\n").splitlines()
    assert [wire.decode(line).name for line in said] == ["CAL:FREE"]
    assert not bench.unit.attached


@pytest.mark.parametrize("header", [h for h in MANUAL if h.endswith("?")])
def test_a_bare_query_is_answered_plainly(bench, header):
    text, _, expected = MANUAL[header]
    answer = bench.raw(text.encode() + b"\n")
    assert answer == expected.encode() + b"\n" if expected is not ANY else float(answer) < 1.0


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("CAL:STEP:ABS 9", Code.OUT_OF_RANGE),
        ("CAL:STEP:ABS -5", Code.OUT_OF_RANGE),
        ("CAL:STEP:ABS 1.5", Code.SYNTAX),
        ("CAL:STEP:ABS +1", Code.SYNTAX),
        ("CAL:STEP:ABS", Code.SYNTAX),
        ("CAL:STEP:ABS 1000", Code.SYNTAX),
        ("CAL:HOME 1", Code.SYNTAX),
        ("CAL:ANG 30", Code.OUT_OF_RANGE),
        ("CAL:ANG 181", Code.OUT_OF_RANGE),
        ("CAL:ANG x", Code.SYNTAX),
        ("CAL:FORC:LIM 0", Code.OUT_OF_RANGE),
        ("CAL:FORC:LIM 10.1", Code.OUT_OF_RANGE),
        ("CAL:FORC:LIM -1", Code.OUT_OF_RANGE),
        ("CAL:FORC:LIM a lot", Code.SYNTAX),
    ],
)
def test_what_makes_no_sense_is_refused_and_does_nothing(bench, text, code):
    say(bench, (*READY, "home"))
    moves = len(bench.unit.moves)
    assert bench.code(text) == code
    assert bench.ask("*OPC?") == "1"
    assert (len(bench.unit.moves), bench.ask("CAL:FORC:LIM?")) == (moves, "5")


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


def test_nothing_moves_before_a_person_has_set_a_force_limit(bench):
    bench.ask("SYST:ARM")
    assert bench.code("CAL:HOME") == Code.IGNORED
    assert bench.code("CAL:STEP:ABS 1") == Code.IGNORED
    assert "no default" in bench.ask("SYST:ERR?")
    assert bench.unit.moves == []


@pytest.mark.parametrize("text", ["CAL:HOME", "CAL:STEP:ABS 1", "CAL:ANG 45", "CAL:ATT"])
def test_nothing_moves_unless_armed(bench, text):
    say(bench, (*READY, "home", "SAFE"))
    stands_mm = bench.unit.aperture_mm
    assert bench.code(text) == Code.NOT_ARMED
    bench.wait(1.0)
    assert (bench.unit.aperture_mm, bench.unit.angle_deg) == (stands_mm, 0.0)


def test_steps_and_skin_wait_for_the_home_mark(bench):
    say(bench, READY)
    assert bench.code("CAL:STEP:ABS 1") == Code.IGNORED
    assert bench.code("CAL:ATT") == Code.IGNORED
    home(bench)
    assert bench.code("CAL:ATT") == Code.OK


def test_skin_is_taped_at_step_zero_only(bench):
    say(bench, (*READY, "home"))
    move(bench, 2)
    assert bench.code("CAL:ATT") == Code.IGNORED
    move(bench, 0)
    assert bench.code("CAL:ATT") == Code.OK


def test_jaws_that_hold_skin_neither_turn_nor_seek_home(bench):
    hold(bench)
    assert bench.code("CAL:ANG 45") == Code.IGNORED
    assert bench.code("CAL:HOME") == Code.IGNORED
    bench.ask("CAL:REL")
    assert bench.code("CAL:ANG 45") == Code.OK


@pytest.mark.parametrize("forget", ["*RST", "power"])
def test_limit_and_home_do_not_outlive_a_reset(bench, forget):
    hold(bench)
    if forget == "power":
        bench.box.power_cycle(bench.now, boot_s=0.0, announce=False)
    else:
        bench.ask("*RST")
    assert bench.ask("CAL:FORC:LIM?") == "NONE"
    assert bench.ask("CAL:POS?") == "NONE"
    assert not bench.world.skin.state.attached


# moves -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_home_is_found_from_wherever_the_jaws_stand(make, seed):
    bench = make(seed=seed)
    start_mm = bench.unit.aperture_mm
    assert abs(start_mm - 8.0) > 1e-3
    say(bench, (*READY, "home"))
    assert bench.unit.aperture_mm == 8.0
    assert bench.ask("CAL:POS?") == "8.000"


def test_a_move_is_accepted_at_once_and_over_after_its_time(bench):
    say(bench, (*READY, "home"))
    begin = bench.now
    assert bench.ask("CAL:STEP:ABS 3") == "2"
    assert bench.ask("*OPC?") == "0"
    assert int(bench.ask("STAT?")) & 16
    bench.wait(1.0)
    assert bench.unit.aperture_mm == pytest.approx(8.0 + 2.0 * 1.0)
    number, end, step, mm, newton, t_us = finish(bench)
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
    say(bench, (*READY, "home"))
    for step, mm in ((2, "9.600"), (2, "9.600"), (-1, "7.200"), (0, "8.000")):
        assert move(bench, step)[2:4] == [str(step), mm]


def test_a_move_under_way_is_not_meddled_with(bench):
    say(bench, (*READY, "home"))
    bench.ask("CAL:STEP:ABS 4")
    for text in ("CAL:STEP:ABS 0", "CAL:HOME", "CAL:ANG 45", "CAL:ATT"):
        assert bench.code(text) == Code.IGNORED
    assert finish(bench)[2] == "4"


def test_turning_takes_its_time_and_is_what_the_skin_is_taped_at(bench):
    say(bench, (*READY, "home"))
    bench.ask("CAL:ANG 135")
    assert bench.ask("CAL:ANG?") == "135"
    bench.wait(1.4)
    assert bench.ask("*OPC?") == "0"
    bench.wait(0.2)
    assert bench.ask("*OPC?") == "1"
    bench.ask("CAL:ATT")
    state = bench.world.skin.state
    assert (state.angle_deg, state.attached) == (135.0, True)


def test_the_force_is_tared_when_skin_is_taped(make):
    offsets = []
    for seed in range(8):
        bench = make(seed=seed)
        offsets.append(float(bench.ask("CAL:FORC?")))
        hold(bench)
        assert abs(float(bench.ask("CAL:FORC?"))) == 0.0
        move(bench, 1)
        assert float(bench.ask("CAL:FORC?")) == pytest.approx(bench.world.skin.force_n, abs=6e-4)
    assert np.std(offsets) > 0.003


def test_a_retry_of_a_move_moves_once(bench):
    say(bench, (*READY, "home", "SYST:WDOG 5000"))
    bench.seq += 1
    frame = wire.encode(Request(bench.seq, bench.box.boot, "CAL:STEP:ABS 2"))
    first, again = bench.raw(frame), bench.raw(frame)
    assert first == again
    bench.silence(1.0)
    assert bench.ask("*OPC?") == "1"
    assert bench.raw(frame) == first
    assert bench.ask("*OPC?") == "1"
    assert len(bench.unit.moves) == 2


def test_one_big_step_of_time_equals_many_small_ones(make):
    def play(step_s):
        bench = make()
        bench.ask("SYST:WDOG 5000")
        hold(bench, 0.3)
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
def test_a_force_at_its_limit_turns_the_jaws_back(bench, step, limit_n):
    hold(bench, limit_n)
    before = [t for t, _ in bench.world.grips]
    _, end, stands, mm, newton, _ = move(bench, step)
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


def test_the_way_on_which_the_limit_was_met_stays_barred(bench):
    hold(bench, 0.3)
    move(bench, 4)
    assert bench.code("CAL:STEP:ABS 4") == Code.FORCE
    assert bench.code("CAL:STEP:ABS 3") == Code.FORCE
    assert move(bench, 1)[1] == "REACHED"
    assert move(bench, -1)[1] == "REACHED"
    bench.ask("CAL:FORC:LIM 5")
    assert move(bench, 3)[1] == "REACHED"


def test_a_limit_below_the_present_force_is_refused(bench):
    hold(bench)
    move(bench, 3)
    assert bench.code("CAL:FORC:LIM 0.1") == Code.FORCE
    assert bench.ask("CAL:FORC:LIM?") == "5"


def test_skin_that_comes_off_ends_the_move_where_it_did(bench):
    hold(bench)
    assert move(bench, 3)[1] == "REACHED"
    _, end, step, mm, newton, _ = move(bench, 8)
    assert (end, float(newton)) == ("DETACHED", 0.0)
    assert 10.4 < float(mm) < 11.2
    assert step in ("3", "4")
    assert bench.ask("CAL:ATT?") == "0"
    assert not bench.world.skin.state.attached
    assert move(bench, 0)[1] == "REACHED"
    bench.ask("CAL:ATT")
    assert bench.world.skin.state.attached


def test_buckling_is_no_end_but_the_force_grows_no_more(bench):
    hold(bench)
    forces = [float(move(bench, step)[4]) for step in (-1, -2, -3, -4)]
    assert forces[1] < 1.8 * forces[0] < 0.0
    assert forces[3] == forces[2]


def test_a_motor_that_stalls_is_noticed_and_must_be_homed(make):
    bench = make(jaw_stall=1.0)
    bench.unit._stall = 0.0
    hold(bench)
    bench.unit._stall = 1.0
    _, end, _, mm, _, _ = move(bench, 3)
    assert end == "STALL"
    assert 8.0 <= float(mm) < 10.4
    assert bench.ask("CAL:POS?") == "NONE"
    assert bench.unit.attached  # held where it is, until somebody decides
    assert bench.code("CAL:STEP:ABS 0") == Code.IGNORED
    bench.unit._stall = 0.0
    bench.ask("CAL:REL")
    home(bench)


def test_a_stall_is_noticed_within_its_lag(make):
    bench = make()
    say(bench, (*READY, "home"))
    bench.unit._stall = 1.0
    begin = bench.now
    _, end, _, mm, _, t_us = move(bench, 4)
    assert end == "STALL"
    seen_s = 1e-6 * int(t_us) - begin
    assert (
        seen_s
        <= (float(mm) - 8.0 + 0.05) / RIG.caliper.speed_mm_per_s + CALIPER_CONTROL_PERIOD_S + 1e-6
    )


def test_a_home_mark_that_is_never_seen_ends_at_the_end_of_the_travel(make):
    bench = make(home_missed=True)
    say(bench, READY)
    bench.ask("CAL:HOME")
    assert finish(bench)[1] == "NOHOME"
    assert bench.ask("CAL:POS?") == "NONE"
    assert bench.code("CAL:STEP:ABS 0") == Code.IGNORED


def test_nothing_moves_with_a_dead_force_sensor(make):
    bench = make(force_dead=True)
    say(bench, READY)
    for text in ("CAL:HOME", "CAL:STEP:ABS 0", "CAL:ATT", "CAL:FORC?"):
        assert bench.code(text) == Code.HARDWARE
    assert bench.unit.moves == []


# letting go ------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["CAL:REL", "SAFE", "ABOR", "*RST"])
def test_skin_is_let_go_at_once_also_on_the_move(bench, text):
    hold(bench)
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


def test_a_silent_host_loses_the_skin_within_the_lease(bench):
    bench.ask("SYST:WDOG 300")
    hold(bench)
    move(bench, 2)
    silent_s = bench.now
    bench.silence(2.0)
    assert "WDOG:TRIP" in [name for name, _ in bench.said]
    freed_s, state = bench.world.grips[-1]
    assert (state.attached, state.stretch) == (False, 1.0)
    assert freed_s == pytest.approx(silent_s + 0.3)
    assert bench.code("CAL:STEP:ABS 0") == Code.WATCHDOG_TRIPPED
    bench.ask("SYST:ARM")
    assert move(bench, 0)[1] == "REACHED"
    assert not bench.world.skin.state.attached


def test_a_reset_in_mid_move_lets_go_and_forgets_the_move(bench):
    hold(bench)
    bench.ask("CAL:STEP:ABS 3")
    bench.wait(0.5)
    bench.box.power_cycle(bench.now, boot_s=0.5, announce=False)
    assert not bench.world.skin.state.attached
    stands_mm = bench.unit.aperture_mm
    bench.silence(2.0)
    assert bench.unit.aperture_mm == stands_mm
    assert bench.ask("CAL:LAST?") == "NONE"
    assert bench.ask("CAL:FORC:LIM?") == "NONE"


def test_the_emergency_stop_lets_go_and_bars_all_moves(make):
    bench = make(interlock_after=12.0)
    hold(bench)
    move(bench, 2)
    assert bench.now < 12.0
    bench.wait(12.0 - bench.now + 0.1)
    freed_s, state = bench.world.grips[-1]
    assert (freed_s, state.attached) == (12.0, False)
    assert int(bench.ask("STAT?")) & 256
    for text in ("CAL:HOME", "CAL:STEP:ABS 0", "CAL:ATT", "CAL:ANG 45"):
        assert bench.code(text) == Code.INTERLOCK
    closed = make(interlock=True)
    say(closed, READY)
    assert closed.code("CAL:HOME") == Code.INTERLOCK


def test_force_that_stays_beyond_its_limit_in_spite_of_all_is_let_go(make, monkeypatch):
    bench = make()
    hold(bench, 0.3)

    def pull(aperture_mm, move=bench.world.skin.move):
        move(max(aperture_mm, bench.world.skin.state.aperture_mm))  # the subject follows the jaws

    monkeypatch.setattr(bench.world.skin, "move", pull)
    assert move(bench, 4)[1] == "FORCE"
    assert bench.events("CAL:FREE")[-1].startswith("FORCE,")
    assert not bench.world.skin.state.attached
