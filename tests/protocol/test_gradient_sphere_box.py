"""Gradient sphere controller: patterns and time, beyond its manual's rows."""

import itertools
import json

import numpy as np
import pytest
from fixtures.box_manuals import GRADIENT_SPHERE, SPHERE_ROW

from capture.devices import wire
from capture.devices.gradient_sphere import PatternRow as HostRow
from capture.devices.wire import Code, Request
from capture.plan.steps import LIGHT_PATTERNS
from rigsim.boxes.led_table import PatternRow

RIG = GRADIENT_SPHERE.rig
LEDS = len(RIG.lights)
WAYS = np.array([light.position_mm for light in RIG.lights])
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)
TURN_S = RIG.polarizer_move_s


@pytest.fixture
def bench():
    return GRADIENT_SPHERE.bench()


def rows_of(names, *, reading_deg=0.0, ms=30, level=1000, mask=1):
    return [
        PatternRow(name, reading_deg, 0 if name == "dark" else level, ms * 1000, mask)
        for name in names
    ]


def test_table_longer_than_controller_capacity_is_refused(bench):
    bench.load(rows_of(["x"] * 60))
    many = ";".join(map(str, rows_of(["y"] * 5)))
    assert bench.code(f"SEQ:DEF 60,{many}") == Code.OUT_OF_RANGE
    assert bench.ask("SEQ:CRC?").startswith("60,")


def test_the_data_dictionary_holds_the_rigs_limits(bench):
    limits = json.loads(wire.unseal(bench.ask("SYST:CAP?")))
    assert (limits["kind"], limits["leds"], limits["cameras"]) == ("gradient_sphere", LEDS, 1)
    for name in ("max_duty", "thermal_trip", "dose_ws", "max_flashes_per_s", "max_rows"):
        assert limits[name] == getattr(RIG.leds, name)
    assert 90.0 * limits["move_s_per_deg"] == pytest.approx(TURN_S)


def test_host_and_controller_spell_rows_identically(bench):
    every = itertools.product(LIGHT_PATTERNS, (0.0, 90.0, 7.25), (1.0, 0.3333))
    for name, angle_deg, level in every:
        row = HostRow(name, angle_deg, level, 0.0301235, 1)
        bench.ask(f"SEQ:DEF 0,{row.text()}")
        assert str(bench.unit.table[0]) == row.text()


# patterns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIGHT_PATTERNS)
def test_pattern_weights_each_led_by_its_position(bench, name):
    axis = "xyz".find(name[-1])
    sign = -1.0 if name[0] == "-" else 1.0
    wanted = 0.5 * (1.0 + sign * WAYS[:, axis]) if axis >= 0 else np.ones(LEDS)
    wanted = np.zeros(LEDS) if name == "dark" else wanted
    bench.run(rows_of([name], ms=50, level=400))
    bench.wait(0.2)
    given = [float(bench.ask(f"DOSE? {led}")) for led in range(LEDS)]
    np.testing.assert_allclose(given, 0.4 * 0.05 * wanted, atol=1e-6)
    lights = [(p.pattern, p.level) for p in bench.world.switched]
    assert lights == ([] if name == "dark" else [(name, 0.4)])


def test_pattern_and_its_complement_sum_to_full(bench):
    for axis in "xyz":
        both = bench.unit._shares[axis] + bench.unit._shares["-" + axis]
        np.testing.assert_allclose(both, bench.unit._shares["full"], atol=1e-12)


def test_light_carries_its_own_end(bench):
    bench.ask("SYST:ARM")
    bench.ask("PATT -Y,80,300")
    assert bench.ask("PATT?") == "-Y"
    assert int(bench.ask("STAT?")) & 64
    bench.wait(0.1)
    assert bench.ask("PATT?") == "DARK"
    (light,) = bench.world.switched
    assert (light.pattern, light.level, light.analyzer_deg) == ("-y", 0.3, 0.0)
    assert light.t_off_s - light.t_on_s == pytest.approx(0.08)
    assert light.led_shares == ()


def test_pattern_replaces_last_and_dark_ends_light(bench):
    bench.ask("SYST:ARM")
    bench.ask("PATT FULL,300,100")
    bench.wait(0.05)
    bench.ask("PATT X,300,100")
    bench.wait(0.05)
    bench.ask("PATT DARK")
    spans = [(p.pattern, round(p.t_off_s - p.t_on_s, 9)) for p in bench.world.switched]
    assert spans == [("full", 0.05), ("x", 0.05)]
    assert not bench.unit.lit


def test_ongoing_light_is_recorded_up_to_now(bench):
    world = bench.world
    bench.ask("SYST:ARM")
    bench.ask("PATT Z,300,100")
    world._now = bench.now = 1.1
    (seen,) = world.light_between(1.02, 1.05)
    assert (seen.pattern, seen.t_on_s, seen.t_off_s) == ("z", 1.02, 1.05)
    assert world.light_between(0.5, 0.9) == ()


# analyzer --------------------------------------------------------------------------------------


def test_analyzer_rotation_takes_time(bench):
    bench.ask("POL 90")
    assert bench.ask("POL?") == "90.000"
    assert bench.ask("*OPC?") == "0"
    assert int(bench.ask("STAT?")) & 1024
    bench.wait(0.9 * TURN_S)
    assert bench.ask("*OPC?") == "0"
    bench.wait(0.11 * TURN_S)
    assert bench.ask("*OPC?") == "1"
    bench.ask("POL:ANG 85")
    bench.wait(5.0 / 90.0 * TURN_S)
    assert bench.ask("*OPC?") == "1"


def test_light_and_analyzer_rotation_exclude_each_other(bench):
    bench.ask("SYST:ARM")
    bench.ask(f"SEQ:DEF 0,{SPHERE_ROW}")
    bench.ask("POL 90")
    assert bench.code("PATT X") == Code.IGNORED
    assert bench.code("SEQ:ARM 1") == Code.IGNORED
    bench.wait(TURN_S)
    bench.ask("PATT X,100")
    assert bench.code("POL 0") == Code.IGNORED
    assert bench.unit.analyzer_deg == 90.0
    bench.wait(0.2)
    bench.ask("POL 0")
    assert bench.world.switched[0].analyzer_deg == 90.0


def test_rotation_after_table_check_requires_new_check(bench):
    bench.ask("SYST:ARM")
    bench.ask(f"SEQ:DEF 0,{SPHERE_ROW}")
    bench.ask("SEQ:ARM 1")
    bench.ask("POL 90")
    bench.wait(TURN_S)
    assert bench.code("TRIG r1") == Code.NOT_ARMED


# scans -----------------------------------------------------------------------------------------


def test_scan_rotates_in_dark_and_reports_each_release(bench):
    rows = rows_of(["full", "x"]) + rows_of(["-x", "dark"], reading_deg=90.0)
    bench.run(rows)
    start = bench.now
    bench.wait(0.6)
    settle_s = RIG.leds.settle_s
    wanted = start + np.array([0.0, 0.03, 0.06 + TURN_S, 0.09 + TURN_S]) + settle_s
    steps = [payload.split(",") for payload in bench.events("SEQ:STEP")]
    assert [int(row) for row, _ in steps] == [0, 1, 2, 3]
    np.testing.assert_allclose([1e-6 * int(t) for _, t in steps], wanted, atol=1e-6)
    np.testing.assert_allclose([t for t, _ in bench.edges], wanted, atol=1e-6)
    full, x, minus_x = bench.world.switched
    assert (full.pattern, x.pattern, minus_x.pattern) == ("full", "x", "-x")
    assert full.t_off_s == x.t_on_s
    assert minus_x.t_on_s - x.t_off_s == pytest.approx(TURN_S)
    assert (x.analyzer_deg, minus_x.analyzer_deg) == (0.0, 90.0)
    assert bench.ask("SEQ:POS?") == "DONE,3,4,r1"
    assert bench.ask("POL?") == "90.000"
    assert not bench.unit.lit


def test_published_sixteen_conditions_form_half_second_scan(bench):
    calm = ["full", "z", "x", "y", "-x", "-y", "-z", "dark"]
    rows = rows_of(calm) + rows_of(calm[::-1], reading_deg=90.0)
    bench.ask("SYST:ARM")
    bench.load(rows)
    flashes, _, duty, heat, _ = (float(x) for x in bench.ask("SEQ:ARM 16").split(","))
    assert flashes < 3.0
    # every LED gives full and three pairs that add up to full, twice, 30 ms each
    assert duty == pytest.approx(8 * 0.03, abs=1e-6)
    assert heat < 0.1
    bench.ask("TRIG s")
    bench.wait(0.8)
    assert len(bench.edges) == 16
    lit_s = sum(p.t_off_s - p.t_on_s for p in bench.world.switched)
    assert lit_s == pytest.approx(14 * 0.03)


def test_scan_begins_with_rotation_where_required(bench):
    bench.run(rows_of(["x"], reading_deg=45.0))
    bench.wait(0.3)
    assert bench.edges[0][0] == pytest.approx(1.0 + TURN_S / 2.0 + RIG.leds.settle_s)


def test_scan_runs_once_per_arming_despite_repeated_trigger(bench):
    bench.ask("SYST:ARM")
    bench.load(rows_of(["x", "y"]))
    bench.ask("SEQ:ARM 2")
    bench.seq += 1
    frame = wire.encode(Request(bench.seq, bench.box.boot, "TRIG once"))
    first, again = bench.raw(frame), bench.raw(frame)
    assert [line for line in first.splitlines() if line[:1] == b"="] == again.splitlines()
    bench.wait(0.3)
    assert bench.code("TRIG once") == Code.NOT_ARMED
    assert [token for token, _ in bench.unit.runs] == ["once"]


@pytest.mark.parametrize(
    "text",
    [
        "SEQ:CLE",
        "SEQ:DEF 0,X:0:1:30000:1",
        "SEQ:ARM 2",
        "PATT X,80",
        "PATT DARK",
        "POL 90",
        "POL:ANG 5",
        "GAIN:CLE",
        "GAIN:DEF 0,5",
        "CAM:MASK 1",
        "CAM:TRIG x",
        "DOSE:NEW p",
    ],
)
def test_a_running_scan_is_not_meddled_with(bench, text):
    bench.run(rows_of(["x", "y"], ms=100))
    assert bench.code(text) == Code.IGNORED
    assert bench.ask("*OPC?") == "0"


@pytest.mark.parametrize("text", ["SAFE", "ABOR", "*RST"])
def test_a_scan_can_be_stopped_at_once(bench, text):
    bench.run(rows_of(["full", "x", "-x"], ms=100, level=500))
    bench.wait(0.15)
    assert bench.unit.lit
    bench.ask(text)
    assert not bench.unit.lit
    assert bench.events("SEQ:STOP")
    edges = len(bench.edges)
    bench.silence(1.0)
    assert len(bench.edges) == edges
    assert bench.world.switched[-1].t_off_s == pytest.approx(1.15)


def test_silent_host_ends_scan_dark_within_lease(bench):
    bench.ask("SYST:WDOG 300")
    bench.run(rows_of(["x", "y"] * 10, ms=50, level=200))
    fell_silent = bench.now
    bench.silence(2.0)
    assert not bench.unit.lit
    assert bench.world.switched[-1].t_off_s <= fell_silent + 0.3 + 1e-9
    assert {"WDOG:TRIP", "SEQ:STOP"} <= {name for name, _ in bench.said}
    assert bench.code("TRIG r2") == Code.WATCHDOG_TRIPPED


def test_large_time_step_equals_many_small_steps():
    def play(step_s):
        bench = GRADIENT_SPHERE.bench()
        bench.ask("SYST:WDOG 5000")
        bench.run(rows_of(["x", "z"]) + rows_of(["z", "y"], reading_deg=90.0))
        while bench.now < 2.0:
            bench.silence(step_s)
        return bench.world.switched, bench.edges, bench.said

    assert play(1.0) == play(0.0131)


# limits ----------------------------------------------------------------------------------------


def test_a_scan_beyond_the_duty_is_refused_whole(bench):
    bench.ask("SYST:ARM")
    bench.load(rows_of(["full"] * 6, ms=50))
    assert bench.code("SEQ:ARM 6") == Code.DUTY
    bench.load(rows_of(["full"] * 5, ms=50))
    assert bench.code("SEQ:ARM 5") == Code.OK
    bench.load(rows_of(["full"] * 12, ms=50, level=400))
    assert bench.code("SEQ:ARM 12") == Code.OK


def test_heat_and_dose_limits_match_other_led_controllers():
    hot = GRADIENT_SPHERE.bench(heat=0.9)
    hot.ask("SYST:ARM")
    assert hot.code("PATT X,5") == Code.THERMAL
    bench = GRADIENT_SPHERE.bench()
    bench.ask("SYST:ARM")
    bench.unit.bank._dose_ws[7] = RIG.leds.dose_ws - 0.001
    assert bench.code("PATT FULL,50") == Code.LIGHT_DOSE
    bench.load(rows_of(["full"]))
    assert bench.code("SEQ:ARM 1") == Code.LIGHT_DOSE


def test_flickering_scan_is_refused_without_eye_safety_confirmation(bench):
    flicker = rows_of(["full", "dark"] * 5)
    bench.ask("SYST:ARM")
    bench.load(flicker)
    assert bench.code("SEQ:ARM 10") == Code.FLICKER
    for word in ("CLOSED", "SHIELDED"):
        bench.ask(f"SAFE:EYES {word}")
        assert float(bench.ask("SEQ:ARM 10").split(",")[0]) >= 3.0
        assert int(bench.ask("STAT?")) & 512
    bench.ask("SAFE:EYES OPEN")
    assert bench.code("SEQ:ARM 10") == Code.FLICKER


def test_single_patterns_cannot_be_made_to_flicker_either(bench):
    bench.ask("SYST:ARM")
    codes = []
    for _ in range(5):
        codes.append(bench.code("PATT FULL,20"))
        bench.wait(0.15)
    assert codes[0] == Code.OK
    assert Code.FLICKER in codes
    assert bench.code("PATT DARK") == Code.OK


# gains, faults ---------------------------------------------------------------------------------


def test_gains_dim_their_leds_in_every_pattern(bench):
    gains = [1000 - k for k in range(LEDS)]
    for first in range(0, LEDS, 40):
        bench.ask(f"GAIN:DEF {first},{'+'.join(map(str, gains[first : first + 40]))}")
    text = "\n".join(map(str, gains))
    assert bench.ask("GAIN:CRC?") == f"{LEDS},{wire.crc16(text.encode()):04X}"
    bench.ask("SYST:ARM")
    bench.ask("PATT X,50")
    bench.wait(0.1)
    (light,) = bench.world.switched
    np.testing.assert_allclose(light.led_shares, 1e-3 * np.array(gains))
    given = [float(bench.ask(f"DOSE? {led}")) for led in (0, 100)]
    shares = 0.5 * (1.0 + WAYS[[0, 100], 0])
    np.testing.assert_allclose(given, 0.05 * shares * np.array([1.0, 0.9]), atol=1e-6)
    bench.ask("GAIN:CLE")
    assert bench.ask("GAIN:CRC?") == "0,FFFF"
    bench.ask("PATT X,50")
    bench.wait(0.1)
    assert bench.world.switched[-1].led_shares == ()


@pytest.mark.parametrize("forget", ["*RST", "power"])
def test_reset_clears_table_gains_and_eye_state(bench, forget):
    for line in (f"SEQ:DEF 0,{SPHERE_ROW}", "GAIN:DEF 0,5", "SAFE:EYES CLOSED", "POL 90"):
        bench.ask(line)
    if forget == "power":
        bench.box.power_cycle(bench.now, boot_s=0.0, announce=False)
    else:
        bench.ask("*RST")
    assert bench.ask("SEQ:CRC?") == "0,FFFF"
    assert bench.unit.gains == [1000] * LEDS
    assert bench.ask("SAFE:EYES?") == "OPEN"
    assert bench.ask("POL?") == "0.000"
    assert bench.ask("*OPC?") == "0"  # on its way back


def test_dead_led_ends_one_scan_weak_led_none():
    bench = GRADIENT_SPHERE.bench(led_dead="5", led_weak="9=0.25")
    bench.run(rows_of(["x", "-x"]))
    assert bench.ask("SEQ:POS?") == "STOP,-1,2,r1"
    assert int(bench.ask("LED:FAIL?"), 16) == 1 << 5
    assert bench.world.switched == []
    bench.run(rows_of(["x", "-x"]), "r2")
    bench.wait(0.3)
    assert bench.events("LED:FAIL") == ["5"]
    assert len(bench.world.switched) == 2
    for light in bench.world.switched:
        assert len(light.led_shares) == LEDS
        assert {k: s for k, s in enumerate(light.led_shares) if s != 1.0} == {5: 0.0, 9: 0.25}
    bench.ask("*RST")
    bench.wait(1.0)
    bench.ask("SYST:ARM")
    bench.ask("PATT Y,50")  # one light is not ended
    bench.wait(0.1)
    assert bench.events("LED:FAIL") == ["5", "5"]
    assert len(bench.world.switched) == 3


def test_dead_led_at_level_zero_ends_no_scan():
    """A board measures the current of LEDs that it drives."""
    bench = GRADIENT_SPHERE.bench(led_dead="0")
    for gain, state, failed in ((0, "DONE,1,2,r0", 0), (1000, "STOP,-1,2,r1000", 1)):
        bench.ask(f"GAIN:DEF 0,{gain}")
        bench.run(rows_of(["full", "full"]), f"r{gain}")
        bench.wait(0.3)
        assert bench.ask("SEQ:POS?") == state
        assert int(bench.ask("LED:FAIL?"), 16) == failed


def test_the_emergency_stop_is_reported_and_nothing_lights():
    bench = GRADIENT_SPHERE.bench(interlock=True)
    bench.ask("SYST:ARM")
    assert int(bench.ask("STAT?")) & 256
    assert bench.code("PATT X,50") == Code.INTERLOCK
    bench.load(rows_of(["x"]))
    assert bench.code("SEQ:ARM 1") == Code.INTERLOCK
