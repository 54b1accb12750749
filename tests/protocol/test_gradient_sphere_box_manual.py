"""Every row of the manual of the gradient sphere's box, on the box itself."""

import itertools
import json

import numpy as np
import pytest
from fixtures.framed_bench import ANY, SHARED_COMMANDS

from capture.devices import wire
from capture.devices.gradient_sphere import PatternRow as HostRow
from capture.devices.wire import Code, Request
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.boxes.led_table import PatternRow
from rigsim.world import World

RIG = load_rig("gradient").cropped(16)
LEDS = len(RIG.lights)
WAYS = np.array([light.position_mm for light in RIG.lights])
WAYS /= np.linalg.norm(WAYS, axis=1, keepdims=True)
TURN_S = RIG.polarizer_move_s

ROW = "SEQ:DEF 0,X:0:500:30000:1"
# header -> text, what must come before, expected payload
MANUAL = {
    "SEQ:CLE": ("SEQ:CLE", (), ""),
    "SEQ:DEF": ("SEQ:DEF 0,FULL:0:1000:30000:1;-X:90:500:30000:1;DARK:12.5:0:30000:0", (), ""),
    "SEQ:CRC?": ("SEQ:CRC?", (), "0,FFFF"),
    "SEQ:ARM": ("SEQ:ARM 1", ("SYST:ARM", ROW), ANY),
    "TRIG": ("TRIG a1", ("SYST:ARM", ROW, "SEQ:ARM 1"), "a1,1000000"),
    "SEQ:POS?": ("SEQ:POS?", (), "IDLE,-1,0,-"),
    "SEQ:STEP?": ("SEQ:STEP? 0", (), "NONE"),
    "PATT": ("PATT -Z,80,500", ("SYST:ARM",), ""),
    "PATT?": ("PATT?", (), "DARK"),
    "POL": ("POL 90", (), ""),
    "POL:ANG": ("POL:ANG 12.5", (), ""),
    "POL?": ("POL?", (), "0.000"),
    "GAIN:CLE": ("GAIN:CLE", (), ""),
    "GAIN:DEF": ("GAIN:DEF 0,1000+990+0", (), ""),
    "GAIN:CRC?": ("GAIN:CRC?", (), "0,FFFF"),
    "CAM:MASK": ("CAM:MASK 0", (), ""),
    "CAM:MASK?": ("CAM:MASK?", (), "1"),
    "CAM:TRIG": ("CAM:TRIG d1", (), "d1,1000000"),
    "SAFE:EYES": ("SAFE:EYES CLOSED", (), ""),
    "SAFE:EYES?": ("SAFE:EYES?", (), "OPEN"),
    "DOSE?": ("DOSE? 3", (), "0.000000"),
    "DOSE:NEW": ("DOSE:NEW P042", (), ""),
}


@pytest.fixture
def make(framed):
    def make(**faults):
        bench = framed(World(RIG, seed=3, faults=Faults(**faults)), "gradient_sphere")
        bench.edges = []
        bench.unit._on_trigger = lambda now, mask: bench.edges.append((now, mask))
        return bench

    return make


@pytest.fixture
def bench(make):
    return make()


def rows_of(names, *, reading_deg=0.0, ms=30, level=1000, mask=1):
    return [
        PatternRow(name, reading_deg, 0 if name == "dark" else level, ms * 1000, mask)
        for name in names
    ]


def load(bench, rows):
    bench.ask("SEQ:CLE")
    for first in range(0, len(rows), 6):
        bench.ask(f"SEQ:DEF {first},{';'.join(map(str, rows[first : first + 6]))}")


def run(bench, rows, token="r1"):
    bench.ask("SYST:ARM")
    load(bench, rows)
    bench.ask(f"SEQ:ARM {len(rows)}")
    bench.ask(f"TRIG {token}")


def test_the_manual_is_complete(bench):
    assert set(MANUAL) | SHARED_COMMANDS == set(bench.box.commands)
    assert all(command.manual for command in bench.box.commands.values())


@pytest.mark.parametrize("header", MANUAL)
def test_a_framed_command_is_answered_as_its_manual_says(bench, header):
    text, before, expected = MANUAL[header]
    for line in before:
        bench.ask(line)
    payload = bench.ask(text)
    assert expected is ANY or payload == expected


@pytest.mark.parametrize("header", [h for h in MANUAL if not h.endswith("?")])
def test_a_bare_command_is_refused_and_changes_nothing(bench, header):
    def look():
        unit = bench.unit
        return bench.ask("SEQ:CRC?"), unit.mask, unit.eyes, unit.analyser_deg, unit.gains, unit.lit

    for line in ("SYST:ARM", ROW, "SEQ:ARM 1"):
        bench.ask(line)
    before = look()
    assert bench.raw(MANUAL[header][0].encode() + b"\n") == b""
    assert bench.raw(b"SYST:ERR?\n") == b'203,"Unframed command"\n'
    assert look() == before
    assert (bench.edges, bench.unit.running) == ([], False)


@pytest.mark.parametrize("header", [h for h in MANUAL if h.endswith("?")])
def test_a_bare_query_is_answered_plainly(bench, header):
    text, _, expected = MANUAL[header]
    assert bench.raw(text.encode() + b"\n") == expected.encode() + b"\n"


@pytest.mark.parametrize("header", ["PATT", "SEQ:ARM", "TRIG"])
def test_what_makes_light_is_refused_unless_armed(bench, header):
    bench.ask(ROW)
    assert bench.code(MANUAL[header][0]) == Code.NOT_ARMED
    assert not bench.unit.lit


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("PATT W,80", Code.SYNTAX),
        ("PATT X,501", Code.OUT_OF_RANGE),
        ("PATT X,0", Code.OUT_OF_RANGE),
        ("PATT X,80,1001", Code.OUT_OF_RANGE),
        ("PATT X,80,0", Code.OUT_OF_RANGE),
        ("PATT X,80,1,1", Code.SYNTAX),
        ("PATT DARK,80", Code.SYNTAX),
        ("POL 45", Code.SYNTAX),
        ("POL:ANG 181", Code.OUT_OF_RANGE),
        ("POL:ANG -1", Code.OUT_OF_RANGE),
        ("POL:ANG x", Code.SYNTAX),
        ("SEQ:DEF 1,X:0:1000:30000:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0", Code.SYNTAX),
        ("SEQ:DEF 0,X:0:1000:30000", Code.SYNTAX),
        ("SEQ:DEF 0,X:0:1000:30000:1;", Code.SYNTAX),
        ("SEQ:DEF 0,W:0:1000:30000:1", Code.SYNTAX),
        ("SEQ:DEF 0,X:0:0:30000:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,X:0:1001:30000:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,DARK:0:1:30000:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,X:181:1000:30000:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,X:-1:1000:30000:1", Code.SYNTAX),
        ("SEQ:DEF 0,X:0:1000:1999:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,X:0:1000:500001:1", Code.OUT_OF_RANGE),
        ("SEQ:DEF 0,X:0:1000:30000:2", Code.OUT_OF_RANGE),
        ("SEQ:ARM 2", Code.OUT_OF_RANGE),
        ("SEQ:STEP? 64", Code.OUT_OF_RANGE),
        ("GAIN:DEF 1,1000", Code.OUT_OF_RANGE),
        ("GAIN:DEF 0,1001", Code.OUT_OF_RANGE),
        ("GAIN:DEF 0,1000+", Code.SYNTAX),
        ("GAIN:DEF 0,-1", Code.SYNTAX),
        ("GAIN:DEF 0," + "+".join(["9"] * (LEDS + 1)), Code.OUT_OF_RANGE),
        ("CAM:MASK 2", Code.OUT_OF_RANGE),
        ("SAFE:EYES SHUT", Code.SYNTAX),
        (f"DOSE? {LEDS}", Code.OUT_OF_RANGE),
        ("TRIG a b", Code.SYNTAX),
    ],
)
def test_what_makes_no_sense_is_refused_and_does_nothing(bench, text, code):
    bench.ask("SYST:ARM")
    before = bench.ask("SEQ:CRC?"), list(bench.unit.gains), bench.unit.analyser_deg
    assert bench.code(text) == code
    assert (bench.ask("SEQ:CRC?"), bench.unit.gains, bench.unit.analyser_deg) == before
    assert not bench.unit.lit
    assert bench.edges == []


def test_a_table_longer_than_the_box_holds_is_refused(bench):
    load(bench, rows_of(["x"] * 60))
    many = ";".join(map(str, rows_of(["y"] * 5)))
    assert bench.code(f"SEQ:DEF 60,{many}") == Code.OUT_OF_RANGE
    assert bench.ask("SEQ:CRC?").startswith("60,")


def test_the_data_dictionary_holds_the_rigs_limits(bench):
    limits = json.loads(wire.unseal(bench.ask("SYST:CAP?")))
    assert (limits["kind"], limits["leds"], limits["cameras"]) == ("gradient_sphere", LEDS, 1)
    for name in ("max_duty", "thermal_trip", "dose_ws", "max_flashes_per_s", "max_rows"):
        assert limits[name] == getattr(RIG.leds, name)
    assert 90.0 * limits["move_s_per_deg"] == pytest.approx(TURN_S)


def test_host_and_box_spell_a_row_alike(bench):
    every = itertools.product(LIGHT_PATTERNS, (0.0, 90.0, 7.25), (1.0, 0.3333))
    for name, angle_deg, level in every:
        row = HostRow(name, angle_deg, level, 0.0301235, 1)
        bench.ask(f"SEQ:DEF 0,{row.text()}")
        assert str(bench.unit.table[0]) == row.text()


# patterns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIGHT_PATTERNS)
def test_a_pattern_weighs_each_led_by_its_place(bench, name):
    axis = "xyz".find(name[-1])
    sign = -1.0 if name[0] == "-" else 1.0
    wanted = 0.5 * (1.0 + sign * WAYS[:, axis]) if axis >= 0 else np.ones(LEDS)
    wanted = np.zeros(LEDS) if name == "dark" else wanted
    run(bench, rows_of([name], ms=50, level=400))
    bench.wait(0.2)
    given = [float(bench.ask(f"DOSE? {led}")) for led in range(LEDS)]
    np.testing.assert_allclose(given, 0.4 * 0.05 * wanted, atol=1e-6)
    lights = [(p.pattern, p.level) for p in bench.world.switched]
    assert lights == ([] if name == "dark" else [(name, 0.4)])


def test_a_pattern_and_its_complement_add_up_to_full(bench):
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
    assert (light.pattern, light.level, light.analyser_deg) == ("-y", 0.3, 0.0)
    assert light.t_off_s - light.t_on_s == pytest.approx(0.08)
    assert light.led_shares == ()


def test_a_pattern_replaces_the_last_and_dark_ends_it(bench):
    bench.ask("SYST:ARM")
    bench.ask("PATT FULL,300,100")
    bench.wait(0.05)
    bench.ask("PATT X,300,100")
    bench.wait(0.05)
    bench.ask("PATT DARK")
    spans = [(p.pattern, round(p.t_off_s - p.t_on_s, 9)) for p in bench.world.switched]
    assert spans == [("full", 0.05), ("x", 0.05)]
    assert not bench.unit.lit


def test_light_that_goes_on_is_seen_as_given_so_far(bench):
    world = bench.world
    bench.ask("SYST:ARM")
    bench.ask("PATT Z,300,100")
    world._now = bench.now = 1.1
    (seen,) = world.light_between(1.02, 1.05)
    assert (seen.pattern, seen.t_on_s, seen.t_off_s) == ("z", 1.02, 1.05)
    assert world.light_between(0.5, 0.9) == ()


# analyser --------------------------------------------------------------------------------------


def test_the_analyser_takes_its_time(bench):
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


def test_no_light_while_the_analyser_turns_and_no_turning_in_the_light(bench):
    bench.ask("SYST:ARM")
    bench.ask(ROW)
    bench.ask("POL 90")
    assert bench.code("PATT X") == Code.IGNORED
    assert bench.code("SEQ:ARM 1") == Code.IGNORED
    bench.wait(TURN_S)
    bench.ask("PATT X,100")
    assert bench.code("POL 0") == Code.IGNORED
    assert bench.unit.analyser_deg == 90.0
    bench.wait(0.2)
    bench.ask("POL 0")
    assert bench.world.switched[0].analyser_deg == 90.0


def test_turning_after_a_table_was_judged_means_judging_it_again(bench):
    bench.ask("SYST:ARM")
    bench.ask(ROW)
    bench.ask("SEQ:ARM 1")
    bench.ask("POL 90")
    bench.wait(TURN_S)
    assert bench.code("TRIG r1") == Code.NOT_ARMED


# scans -----------------------------------------------------------------------------------------


def test_a_scan_steps_by_itself_turns_in_the_dark_and_reports_each_release(bench):
    rows = rows_of(["full", "x"]) + rows_of(["-x", "dark"], reading_deg=90.0)
    run(bench, rows)
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
    assert (x.analyser_deg, minus_x.analyser_deg) == (0.0, 90.0)
    assert bench.ask("SEQ:POS?") == "DONE,3,4,r1"
    assert bench.ask("POL?") == "90.000"
    assert not bench.unit.lit


def test_the_paper_s_sixteen_conditions_are_one_scan_of_half_a_second_of_light(bench):
    calm = ["full", "z", "x", "y", "-x", "-y", "-z", "dark"]
    rows = rows_of(calm) + rows_of(calm[::-1], reading_deg=90.0)
    bench.ask("SYST:ARM")
    load(bench, rows)
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


def test_a_scan_begins_with_turning_where_it_must(bench):
    run(bench, rows_of(["x"], reading_deg=45.0))
    bench.wait(0.3)
    assert bench.edges[0][0] == pytest.approx(1.0 + TURN_S / 2.0 + RIG.leds.settle_s)


def test_a_scan_runs_once_for_each_arming_also_when_the_trigger_is_repeated(bench):
    bench.ask("SYST:ARM")
    load(bench, rows_of(["x", "y"]))
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
    run(bench, rows_of(["x", "y"], ms=100))
    assert bench.code(text) == Code.IGNORED
    assert bench.ask("*OPC?") == "0"


@pytest.mark.parametrize("text", ["SAFE", "ABOR", "*RST"])
def test_a_scan_can_be_stopped_at_once(bench, text):
    run(bench, rows_of(["full", "x", "-x"], ms=100, level=500))
    bench.wait(0.15)
    assert bench.unit.lit
    bench.ask(text)
    assert not bench.unit.lit
    assert bench.events("SEQ:STOP")
    edges = len(bench.edges)
    bench.silence(1.0)
    assert len(bench.edges) == edges
    assert bench.world.switched[-1].t_off_s == pytest.approx(1.15)


def test_a_scan_of_a_silent_host_ends_dark_within_the_lease(bench):
    bench.ask("SYST:WDOG 300")
    run(bench, rows_of(["x", "y"] * 10, ms=50, level=200))
    fell_silent = bench.now
    bench.silence(2.0)
    assert not bench.unit.lit
    assert bench.world.switched[-1].t_off_s <= fell_silent + 0.3 + 1e-9
    assert {"WDOG:TRIP", "SEQ:STOP"} <= {name for name, _ in bench.said}
    assert bench.code("TRIG r2") == Code.WATCHDOG_TRIPPED


def test_one_big_step_of_time_equals_many_small_ones(make):
    def play(step_s):
        bench = make()
        bench.ask("SYST:WDOG 5000")
        run(bench, rows_of(["x", "z"]) + rows_of(["z", "y"], reading_deg=90.0))
        while bench.now < 2.0:
            bench.silence(step_s)
        return bench.world.switched, bench.edges, bench.said

    assert play(1.0) == play(0.0131)


# limits ----------------------------------------------------------------------------------------


def test_a_scan_beyond_the_duty_is_refused_whole(bench):
    bench.ask("SYST:ARM")
    load(bench, rows_of(["full"] * 6, ms=50))
    assert bench.code("SEQ:ARM 6") == Code.DUTY
    load(bench, rows_of(["full"] * 5, ms=50))
    assert bench.code("SEQ:ARM 5") == Code.OK
    load(bench, rows_of(["full"] * 12, ms=50, level=400))
    assert bench.code("SEQ:ARM 12") == Code.OK


def test_heat_and_dose_are_limited_as_in_all_boxes_with_leds(make):
    hot = make(heat=0.9)
    hot.ask("SYST:ARM")
    assert hot.code("PATT X,5") == Code.THERMAL
    bench = make()
    bench.ask("SYST:ARM")
    bench.unit.bank._dose_ws[7] = RIG.leds.dose_ws - 0.001
    assert bench.code("PATT FULL,50") == Code.LIGHT_DOSE
    load(bench, rows_of(["full"]))
    assert bench.code("SEQ:ARM 1") == Code.LIGHT_DOSE


def test_a_scan_that_flickers_is_refused_unless_a_person_says_the_eyes_are_safe(bench):
    flicker = rows_of(["full", "dark"] * 5)
    bench.ask("SYST:ARM")
    load(bench, flicker)
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
def test_table_gains_and_eyes_do_not_outlive_a_reset(bench, forget):
    for line in (ROW, "GAIN:DEF 0,5", "SAFE:EYES CLOSED", "POL 90"):
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


def test_a_dead_led_is_named_once_and_a_weak_one_is_not_but_the_scene_learns_of_both(make):
    bench = make(led_dead="5", led_weak="9=0.25")
    run(bench, rows_of(["x", "-x"]))
    bench.wait(0.3)
    assert bench.events("LED:FAIL") == ["5"]
    assert len(bench.world.switched) == 2
    for light in bench.world.switched:
        assert len(light.led_shares) == LEDS
        assert {k: s for k, s in enumerate(light.led_shares) if s != 1.0} == {5: 0.0, 9: 0.25}
    run(bench, rows_of(["y"]), "r2")
    bench.wait(0.3)
    assert bench.events("LED:FAIL") == ["5", "5"]


def test_the_emergency_stop_is_reported_and_nothing_lights(make):
    bench = make(interlock=True)
    bench.ask("SYST:ARM")
    assert int(bench.ask("STAT?")) & 256
    assert bench.code("PATT X,50") == Code.INTERLOCK
    load(bench, rows_of(["x"]))
    assert bench.code("SEQ:ARM 1") == Code.INTERLOCK
