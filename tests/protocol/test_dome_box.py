"""Dome controller: tables, light and time, beyond the rows of its manual."""

import itertools
import json

import numpy as np
import pytest
from fixtures.box_manuals import DOME

from capture.devices import wire
from capture.devices.wire import Code, Event, Request
from capture.plan.dome import dome_plan, to_box_rows
from capture.plan.eye_light import eye_irradiance
from capture.plan.flicker import flicker_of_rows
from capture.plan.light_order import LIGHT_ORDERS
from capture.plan.rows import LedRow, led_rows
from capture.rig import load_rig
from rigsim.boxes.led_table import LEVEL_STEPS, LedTableRow, table_crc
from skinrig.soaking.light_limits import find_limit_violations

WHOLE = load_rig("dome")
RIG = DOME.rig


def rows_of(leds, *, ms=80, level=LEVEL_STEPS, mask=7):
    return [LedTableRow((led,), level, ms * 1000, mask) for led in leds]


@pytest.fixture
def bench():
    return DOME.bench()


def front(count):
    """Numbers of the LEDs that the eyes see best."""
    return [int(k) for k in np.argsort(-eye_irradiance(RIG))[:count]]


def behind(count):
    """Numbers of LEDs that the eyes do not see."""
    return [int(k) for k in np.argsort(eye_irradiance(RIG), kind="stable")[:count]]


def test_the_data_dictionary_holds_the_rigs_limits(bench):
    limits = json.loads(wire.unseal(bench.ask("SYST:CAP?")))
    assert (limits["kind"], limits["leds"], limits["cameras"]) == ("dome", 150, 3)
    for name in ("max_duty", "thermal_trip", "dose_ws", "max_flashes_per_s", "max_flicker_rms"):
        assert limits[name] == getattr(RIG.leds, name)
    assert limits["overlap_us"] == round(1e6 * RIG.leds.overlap_s)


# tables and sequences -------------------------------------------------------------------------


def test_table_checksum_covers_rows_in_canonical_spelling(bench):
    rows = [
        LedTableRow((3, 17), 500, 83333, 7),
        LedTableRow((), 0, 50000, 0),
        LedTableRow((149,), 1000, 2000, 1),
    ]
    bench.load(rows)
    text = "3+17:500:83333:7\n-:0:50000:0\n149:1000:2000:1"
    assert bench.ask("SEQ:CRC?") == f"3,{wire.crc16(text.encode()):04X}"
    assert table_crc(rows) == f"{wire.crc16(text.encode()):04X}"
    bench.ask("SEQ:DEF 1,5:10:2000:2")  # a row is replaced, the others stay
    assert bench.ask("SEQ:CRC?").startswith("3,")
    assert bench.ask("SEQ:CRC?") != f"3,{wire.crc16(text.encode()):04X}"
    bench.ask("SEQ:CLE")
    assert bench.ask("SEQ:CRC?") == "0,FFFF"


def test_sequence_steps_autonomously_and_reports_each_release(bench):
    rows = rows_of(behind(5), ms=50)
    bench.run(rows)
    start = bench.now
    bench.wait(0.5)
    steps = [payload for name, payload in bench.said if name == "SEQ:STEP"]
    settle_s = RIG.leds.settle_s
    assert [int(step.split(",")[0]) for step in steps] == [0, 1, 2, 3, 4]
    times = [1e-6 * int(step.split(",")[1]) for step in steps]
    np.testing.assert_allclose(times, start + 0.05 * np.arange(5) + settle_s, atol=1e-6)
    np.testing.assert_allclose([t for t, _ in bench.edges], times, atol=1e-6)
    assert bench.said[-1][0] == "SEQ:DONE"
    assert bench.ask("SEQ:POS?") == "DONE,4,5,r1"
    assert bench.ask("SEQ:STEP? 4") == steps[4].split(",")[1]
    assert not bench.unit.lit


def test_leds_overlap_between_rows_but_not_during_release(bench):
    rows = rows_of(behind(6), ms=40)
    bench.run(rows)
    bench.wait(0.4)
    pulses = sorted(bench.world.switched, key=lambda pulse: pulse.t_on_s)
    assert [pulse.led for pulse in pulses] == [row.leds[0] for row in rows]
    for before, after in itertools.pairwise(pulses):
        assert before.t_off_s - after.t_on_s == pytest.approx(RIG.leds.overlap_s, abs=1e-9)
    for (t_s, _), pulse in zip(bench.edges, pulses, strict=True):
        lit = [p.led for p in pulses if p.t_on_s <= t_s < p.t_off_s]
        assert lit == [pulse.led]


def test_led_in_consecutive_rows_stays_on(bench):
    a, b, c = behind(3)
    rows = [LedTableRow(tuple(sorted(leds)), 300, 50_000, 7) for leds in ((a, b), (b, c), (b, c))]
    bench.run(rows)
    bench.wait(0.3)
    spans = {pulse.led: pulse.t_off_s - pulse.t_on_s for pulse in bench.world.switched}
    assert len(bench.world.switched) == 3
    assert spans[b] == pytest.approx(0.15)
    assert spans[c] == pytest.approx(0.1 + RIG.leds.overlap_s)


def test_only_cameras_in_row_and_mask_are_released(bench):
    rows = [
        LedTableRow((led,), 1000, 50_000, mask)
        for led, mask in zip(behind(3), (7, 2, 5), strict=True)
    ]
    bench.ask("CAM:MASK 3")
    bench.run(rows)
    bench.wait(0.3)
    assert [mask for _, mask in bench.edges] == [3, 2, 1]


def test_a_sequence_runs_once_for_each_arming(bench):
    bench.run(rows_of(behind(2)))
    assert bench.code("TRIG r2") == Code.IGNORED
    bench.wait(0.4)
    assert bench.code("TRIG r2") == Code.NOT_ARMED
    assert [token for token, _ in bench.unit.runs] == ["r1"]


@pytest.mark.parametrize(
    "text",
    [
        "SEQ:CLE",
        "SEQ:DEF 0,3:1:80000:7",
        "SEQ:ARM 2",
        "LED:ON 3,80",
        "CAM:MASK 1",
        "CAM:TRIG x",
        "LED:OFF ALL",
        "DOSE:NEW p",
    ],
)
def test_a_running_sequence_is_not_meddled_with(bench, text):
    bench.run(rows_of(behind(2)))
    assert bench.code(text) == Code.IGNORED
    assert bench.ask("*OPC?") == "0"


@pytest.mark.parametrize("text", ["SAFE", "ABOR", "*RST"])
def test_a_sequence_can_be_stopped_at_once(bench, text):
    bench.run(rows_of(behind(4)))
    bench.wait(0.1)
    assert bench.unit.lit
    bench.ask(text)
    assert not bench.unit.lit
    assert "SEQ:STOP" in [name for name, _ in bench.said]
    edges = len(bench.edges)
    bench.silence(1.0)
    assert len(bench.edges) == edges


def test_silent_host_ends_sequence_dark_within_lease(bench):
    bench.ask("SYST:WDOG 300")
    bench.run(rows_of(behind(40)))
    fell_silent = bench.now
    bench.silence(2.0)
    assert not bench.unit.lit
    assert max(p.t_off_s for p in bench.world.switched) <= fell_silent + 0.3 + 1e-9
    names = [name for name, _ in bench.said]
    assert names[-2:] == ["WDOG:TRIP", "SEQ:STOP"] or names[-2:] == ["SEQ:STOP", "WDOG:TRIP"]
    assert bench.ask("SEQ:POS?").startswith("STOP,")
    assert bench.code("TRIG r2") == Code.WATCHDOG_TRIPPED


def test_large_time_step_equals_many_small_steps():
    def play(step_s):
        bench = DOME.bench()
        bench.ask("SYST:WDOG 5000")
        bench.run(rows_of(behind(20)))
        while bench.now < 4.0:
            bench.silence(step_s)
        return bench.world.switched, bench.edges, bench.said

    assert play(3.0)[0] == pytest.approx(play(0.013)[0])
    assert play(3.0)[2] == play(0.013)[2]


# light and its limits -------------------------------------------------------------------------


def test_light_carries_its_own_end(bench):
    bench.ask("SYST:ARM")
    bench.ask("LED:ON 3+17,80,500")
    assert bench.ask("LED?") == "3+17"
    bench.wait(0.1)
    assert bench.ask("LED?") == "-"
    assert {(p.led, p.level) for p in bench.world.switched} == {(3, 0.5), (17, 0.5)}
    assert all(p.t_off_s - p.t_on_s == pytest.approx(0.08) for p in bench.world.switched)


def test_leds_switch_off_individually_or_all(bench):
    bench.ask("SYST:ARM")
    bench.ask("LED:ON 3+17+20,80,500")
    bench.ask("LED:OFF 17")
    assert bench.ask("LED?") == "3+20"
    bench.ask("LED:OFF all")
    assert bench.ask("LED?") == "-"


def test_led_duty_is_at_most_quarter_per_second(bench):
    led = behind(1)[0]
    bench.ask("SYST:ARM")
    bench.ask(f"LED:ON {led},200")
    bench.wait(0.3)
    assert bench.code(f"LED:ON {led},60") == Code.DUTY
    assert bench.code(f"LED:ON {led},50") == Code.OK
    bench.wait(0.2)
    assert bench.code(f"LED:ON {led},10") == Code.DUTY
    bench.wait(0.75)
    assert bench.code(f"LED:ON {led},100") == Code.OK
    assert bench.code(f"LED:ON {led},500,900") == Code.DUTY


def test_a_table_beyond_the_duty_is_refused_whole(bench):
    a, b = behind(2)
    bench.ask("SYST:ARM")
    bench.load(rows_of([a, b, a, b, a, b], ms=90))
    assert bench.code("SEQ:ARM 6") == Code.DUTY
    bench.load(rows_of([a, b, a, b], ms=90))
    judged = bench.ask("SEQ:ARM 4").split(",")
    assert float(judged[2]) == pytest.approx(0.18, abs=1e-3)


def test_duty_counts_light_of_before_the_table(bench):
    led = behind(1)[0]
    bench.ask("SYST:ARM")
    bench.ask(f"LED:ON {led},200")
    bench.wait(0.25)
    bench.load(rows_of([led]))
    assert bench.code("SEQ:ARM 1") == Code.DUTY


def test_light_running_at_arming_goes_out_and_counts(bench):
    bench.ask("SAFE:EYES CLOSED")
    bench.ask("SYST:ARM")
    bench.ask("SEQ:DEF 0,17:1000:40000:7")
    bench.ask("LED:ON 17,240")
    bench.wait(0.22)
    assert bench.code("SEQ:ARM 1") == Code.DUTY
    assert not bench.unit.lit
    bench.wait(1.0)
    bench.ask("LED:ON 17,100")
    bench.wait(0.05)
    assert float(bench.ask("SEQ:ARM 1").split(",")[2]) == pytest.approx(0.09, abs=1e-3)
    assert not bench.unit.lit
    bench.ask("TRIG r2")


@pytest.mark.parametrize("pause_s", [0.0, 0.05, 0.25, 0.4])
def test_pause_before_trigger_adds_no_uncounted_flash(bench, pause_s):
    """Light just before SEQ:ARM is a flash of its own if the table begins later."""
    lit, *others = front(6)
    rows = [LedTableRow((lit,), LEVEL_STEPS, 60_000, 7), LedTableRow((), 0, 60_000, 0)] * 2
    rows += rows_of(others[1:], ms=200)
    bench.ask("SYST:ARM")
    bench.ask("SYST:WDOG 5000")
    bench.load(rows)
    assert float(bench.ask(f"SEQ:ARM {len(rows)}").split(",")[0]) == 2.5
    bench.ask(f"LED:ON {others[0]},50")
    bench.wait(0.03)
    assert bench.code(f"SEQ:ARM {len(rows)}") == Code.FLICKER
    bench.wait(1.1)
    assert bench.code(f"SEQ:ARM {len(rows)}") == Code.OK
    bench.wait(pause_s)
    bench.ask("TRIG r1")
    bench.wait(3.0)
    emitted = {"pops": [], "switched": bench.world.switched, "eyes": "open"}
    assert list(find_limit_violations(RIG, **emitted)) == []


def test_led_warms_as_rc_circuit_and_trips():
    bench = DOME.bench(heat=0.55)
    led = behind(1)[0]
    tau, trip = RIG.leds.thermal_tau_s, RIG.leds.thermal_trip
    cooled = 0.55 * np.exp(-1.0 / tau)
    bench.ask("SYST:ARM")
    bench.load(rows_of([led], ms=50))
    heat = float(bench.ask("SEQ:ARM 1").split(",")[3])
    assert heat == pytest.approx(1.0 + (cooled - 1.0) * np.exp(-0.05 / tau), abs=1e-4)
    hot = DOME.bench(heat=0.9)
    hot.ask("SYST:ARM")
    assert hot.code(f"LED:ON {led},5") == Code.THERMAL
    assert int(hot.ask("STAT?")) & 128
    wait_s = tau * np.log(0.9 / (0.5 * trip)) - 1.0
    hot.wait(wait_s - 0.1)
    assert hot.code(f"LED:ON {led},5") == Code.THERMAL
    hot.wait(0.2)
    assert hot.code(f"LED:ON {led},5") == Code.OK


def test_overheated_led_goes_out_despite_all_limits(bench, monkeypatch):
    monkeypatch.setattr(
        bench.unit.bank, "require_within_limits", lambda wanted, now: (0.0, 0.0, 0.0)
    )
    led = behind(1)[0]
    bench.ask("SYST:ARM")
    bench.unit.bank._heat[led] = 0.59
    bench.ask(f"LED:ON {led},500")
    bench.silence(0.45)
    assert not bench.unit.lit
    assert ("LED:HOT", str(led)) in bench.said


def test_led_dose_accumulates_and_its_limit_applies(bench):
    led = behind(1)[0]
    bench.ask("SYST:ARM")
    bench.ask(f"LED:ON {led},200,500")
    bench.wait(0.3)
    assert float(bench.ask(f"DOSE? {led}")) == pytest.approx(0.1)
    bench.unit.bank._dose_ws[led] = RIG.leds.dose_ws - 0.01
    assert bench.code(f"LED:ON {led},50") == Code.LIGHT_DOSE
    bench.load(rows_of([led]))
    assert bench.code("SEQ:ARM 1") == Code.LIGHT_DOSE
    bench.ask("*RST")
    assert float(bench.ask(f"DOSE? {led}")) > 1.0  # survives a reset
    bench.ask("DOSE:NEW P2")
    assert float(bench.ask(f"DOSE? {led}")) == 0.0


def test_flickering_table_is_refused_without_eye_safety_confirmation(bench):
    on, off = front(1)[0], behind(1)[0]
    rows = rows_of([on, off] * 6, ms=40, level=300)
    bench.ask("SYST:ARM")
    bench.load(rows)
    assert bench.code("SEQ:ARM 12") == Code.FLICKER
    for word in ("CLOSED", "SHIELDED"):
        bench.ask(f"SAFE:EYES {word}")
        assert float(bench.ask("SEQ:ARM 12").split(",")[0]) >= 3.0
        assert int(bench.ask("STAT?")) & 512
    bench.ask("SAFE:EYES OPEN")
    assert bench.code("SEQ:ARM 12") == Code.FLICKER


@pytest.mark.parametrize("forget", ["*RST", "DOSE:NEW p2"])
def test_eye_state_is_cleared_by_subject_or_reset(bench, forget):
    bench.ask("SAFE:EYES CLOSED")
    bench.ask(forget)
    assert bench.ask("SAFE:EYES?") == "OPEN"


@pytest.mark.parametrize("change", ["SAFE:EYES OPEN", "DOSE:NEW p2"])
def test_armed_table_ends_with_eye_statement(bench, change):
    """Six flashes per second were allowed for the eyes of before."""
    bench.ask("SYST:ARM")
    bench.ask("SAFE:EYES CLOSED")
    bench.load(rows_of([front(1)[0], behind(1)[0]] * 6, ms=40, level=300))
    assert float(bench.ask("SEQ:ARM 12").split(",")[0]) >= 3.0
    bench.ask(change)
    assert bench.ask("SAFE:EYES?") == "OPEN"
    assert not int(bench.ask("STAT?")) & 32
    assert bench.code("TRIG r1") == Code.NOT_ARMED
    assert bench.code("SEQ:ARM 12") == Code.FLICKER


def test_open_eyes_end_running_sequence(bench):
    """What runs was allowed for closed eyes: six flashes per second would follow."""
    bench.ask("SYST:ARM")
    bench.ask("SAFE:EYES CLOSED")
    bench.load(rows_of([front(1)[0], behind(1)[0]] * 6, ms=40, level=300))
    bench.ask("SEQ:ARM 12")
    bench.ask("TRIG r1")
    bench.ask("SAFE:EYES SHIELDED")
    bench.wait(0.1)
    assert bench.ask("SEQ:POS?").startswith("RUN,")
    bench.ask("SAFE:EYES OPEN")
    assert bench.ask("LED?") == "-"
    assert bench.ask("SEQ:POS?").startswith("STOP,")


def test_sequence_for_open_eyes_goes_on_with_them(bench):
    bench.ask("SYST:ARM")
    bench.load(rows_of(behind(2)))
    bench.ask("SEQ:ARM 2")
    bench.ask("TRIG r1")
    bench.ask("SAFE:EYES OPEN")
    assert bench.ask("SEQ:POS?").startswith("RUN,")


def test_eye_state_is_cleared_by_brown_out(bench):
    bench.ask("SAFE:EYES CLOSED")
    bench.box.power_cycle(bench.now, boot_s=0.0, announce=False)
    assert bench.ask("SAFE:EYES?") == "OPEN"


def test_single_leds_cannot_be_made_to_flicker_either(bench):
    leds = front(4)
    bench.ask("SYST:ARM")
    codes = []
    for number in range(6):
        codes.append(bench.code(f"LED:ON {leds[number % 4]},20"))
        bench.wait(0.12)
    assert codes[0] == Code.OK
    assert Code.FLICKER in codes
    bench.wait(1.1)
    assert bench.code(f"LED:ON {leds[0]},20") == Code.OK
    bench.ask("SAFE:EYES SHIELDED")
    bench.wait(0.1)
    assert [bench.code(f"LED:ON {led},5") for led in leds[1:]] == [Code.OK] * 3


def test_planned_order_is_accepted_and_bad_order_refused():
    bench = DOME.bench(rig=WHOLE.resized(16))
    rig, plan = bench.world.rig, dome_plan(WHOLE)
    steps = [step for step in plan.steps if step.index.get("pass") == 0]
    table = to_box_rows(led_rows(steps, rig))
    bench.ask("SYST:ARM")
    bench.load([LedTableRow(tuple(sorted(leds)), level, us, 0xFFFF) for leds, level, us in table])
    flashes, rms, duty, _, dose = (float(x) for x in bench.ask(f"SEQ:ARM {len(steps)}").split(","))
    # the box's own arithmetic, with one eye and Fourier sums, against the planner's two and FFT
    host = flicker_of_rows(led_rows(steps, rig), eye_irradiance(rig), overlap_s=rig.leds.overlap_s)
    assert rms == pytest.approx(host.rms, rel=0.05)
    assert abs(flashes - host.flashes_per_s) <= 0.5
    assert duty < rig.leds.max_duty
    assert dose < 1.0
    bad = [LedRow((k,), 1.0, 1 / 12) for k in LIGHT_ORDERS["name"](rig)]
    bench.load([LedTableRow(r.leds, 1000, 83333, 0xFFFF) for r in bad])
    assert bench.code("SEQ:ARM 150") == Code.FLICKER


# faults ---------------------------------------------------------------------------------------


def failed_in(bench):
    """Numbers of the LEDs that the box lists as failed."""
    mask = bench.ask("LED:FAIL?")
    assert len(mask) == 38
    return {led for led in range(150) if int(mask, 16) >> led & 1}


def test_dead_led_ends_sequence_and_stays_dark(box_side):
    a, b, c = behind(3)
    bench = DOME.bench(led_dead=str(b))
    bench.ask("SYST:ARM")
    assert bench.code(f"LED:ON {b},50") == Code.HARDWARE
    assert failed_in(bench) == set()
    bench.run(rows_of([a, b, c]))
    bench.wait(0.3)
    assert bench.said[-2][:2] == ("LED:FAIL", str(b))
    assert bench.said[-1][0] == "SEQ:STOP"
    assert bench.ask("SEQ:POS?") == "STOP,0,3,r1"
    assert failed_in(bench) == {b}
    assert not bench.unit.lit
    if box_side == "compiled":  # else an LED whose contact closes again would be lit without end
        assert bench.unit.driven == set()
    bench.run(rows_of([a, b, c]), "r2")
    bench.wait(0.3)
    assert bench.ask("SEQ:POS?") == "DONE,2,3,r2"
    assert [pulse.led for pulse in bench.world.switched] == [a, a, c]
    assert len(bench.edges) == 1 + 3
    assert bench.events("LED:FAIL") == [str(b)]
    assert bench.code(f"LED:ON {b},50") == Code.HARDWARE
    bench.ask("*RST")
    assert failed_in(bench) == set()


def test_all_dead_leds_of_row_are_found_together():
    a, b, c = sorted(behind(3))
    bench = DOME.bench(led_dead=f"{a}+{c}")
    bench.run([LedTableRow((a, b, c), LEVEL_STEPS, 50_000, 7)])
    assert bench.ask("SEQ:POS?") == "STOP,-1,1,r1"
    assert failed_in(bench) == {a, c}
    assert (bench.world.switched, bench.edges) == ([], [])


def test_failed_led_is_judged_as_dark_row():
    """All lit, the rows give even light; each dark row between lit ones is a flash."""
    lit, dead = front(2)
    bench = DOME.bench(led_dead=str(dead))
    rows = rows_of([lit, dead] * 6, ms=60, level=300)
    bench.ask("SYST:ARM")
    bench.load(rows)
    assert float(bench.ask("SEQ:ARM 12").split(",")[0]) <= 1.0
    bench.ask("TRIG r1")
    bench.wait(2.0)
    assert bench.ask("SEQ:POS?") == "STOP,0,12,r1"
    assert bench.code("SEQ:ARM 12") == Code.FLICKER
    bench.ask("SAFE:EYES CLOSED")
    assert float(bench.ask("SEQ:ARM 12").split(",")[0]) > 3.0


def test_weak_led_emits_less_than_driven_without_detection():
    a, b = behind(2)
    bench = DOME.bench(led_weak=f"{b}=0.25")
    bench.run(rows_of([a, b]))
    bench.wait(0.3)
    assert [(p.led, p.level) for p in bench.world.switched] == [(a, 1.0), (b, 0.25)]
    assert not [name for name, _ in bench.said if name.startswith("LED:")]


def test_the_emergency_stop_is_reported_and_nothing_lights():
    bench = DOME.bench(interlock=True)
    bench.ask("SYST:ARM")
    assert int(bench.ask("STAT?")) & 256
    assert bench.code("LED:ON 3,50") == Code.INTERLOCK
    bench.load(rows_of(behind(2)))
    assert bench.code("SEQ:ARM 2") == Code.INTERLOCK


def judged_slowly():
    """A dome that judges a table for 0.5 s, and the frame that asked it to."""
    bench = DOME.bench(slow_judgment=0.5)
    bench.say(("SYST:ARM", "SAFE:EYES CLOSED"))
    bench.load(rows_of(behind(2)))
    frame = bench.frame("SEQ:ARM 2")
    assert bench.raw(frame) == b""
    return bench, frame


def test_slow_judgment_is_answered_late_and_once():
    bench, frame = judged_slowly()
    assert bench.ask("*OPC?") == "0"
    for text in ("SEQ:CLE", "SEQ:ARM 2", "LED:ON 3,50", "TRIG a1"):
        assert bench.code(text) == Code.IGNORED
    bench.now += 0.2
    assert bench.raw(frame) == b""
    bench.now += 0.3
    late = wire.decode(bench.box.advance(bench.now).rstrip())
    assert late.code == Code.OK
    assert bench.raw(frame).rstrip() == wire.encode(late).rstrip()
    assert bench.ask("*OPC?") == "1"
    assert bench.ask("SEQ:POS?").startswith("READY")


@pytest.mark.parametrize("text", ["SAFE", "*RST", "SAFE:EYES OPEN"])
def test_dark_ends_a_slow_judgment(text):
    bench, _ = judged_slowly()
    bench.ask(text)
    assert wire.decode(bench.box.advance(bench.now).rstrip()).code == Code.HARDWARE
    assert bench.ask("*OPC?") == "1"
    assert bench.code("SEQ:CLE") == Code.OK
    bench.now += 0.5
    assert bench.box.advance(bench.now) == b""
    assert bench.ask("SEQ:POS?").startswith("IDLE")


def test_retried_trigger_runs_table_once(bench):
    bench.ask("SYST:ARM")
    bench.load(rows_of(behind(2)))
    bench.ask("SEQ:ARM 2")
    bench.seq += 1
    frame = wire.encode(Request(bench.seq, bench.box.boot, "TRIG once"))
    first, again = bench.raw(frame), bench.raw(frame)
    assert [line for line in first.splitlines() if line[:1] == b"="] == again.splitlines()
    bench.wait(0.3)
    assert bench.code("TRIG once") == Code.NOT_ARMED
    assert [token for token, _ in bench.unit.runs] == ["once"]


def test_sequence_event_is_frame_with_own_number(bench):
    bench.run(rows_of(behind(1)))
    bench.now += 0.2
    events = [wire.decode(line) for line in bench.box.advance(bench.now).splitlines()]
    assert all(isinstance(event, Event) for event in events)
    numbers = [event.number for event in events]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
