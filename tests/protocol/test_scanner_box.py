"""The scanner's box: light only with safe eyes, release in steady light, and its end."""

import pytest
from fixtures.box_manuals import SCANNER

from capture.devices.wire import Code
from rigsim.boxes.scanner import ProjectorLight

READY = ("SYST:ARM", "SAFE:EYES CLOSED", "PROJ 1", "PAT COL,7")


@pytest.fixture
def bench():
    made = SCANNER.bench()
    made.light = []
    made.unit._on_light = made.light.append
    return made


def show(bench, token="a1", span_ms=45):
    """Trigger a pattern, and return the answer that comes when the cameras are released."""
    assert bench.raw(bench.frame(f"TRIG {token},{span_ms}")) == b""
    bench.now += 0.02
    return bench.box.advance(bench.now)


def test_pattern_is_lit_from_command_to_its_end(bench):
    bench.say(READY)
    show(bench)
    bench.wait(0.2)
    (light,) = bench.light
    assert light == ProjectorLight("P1", "columns", 7, 1.0, 1.0, pytest.approx(1.045))
    # released after the light is steady: the two cameras of projector P1
    assert bench.edges == [(pytest.approx(1.02), 0b1100)]
    assert bench.ask("TRIG:LAST?") == "a1,1020000,1,COL,7"
    assert float(bench.ask("DOSE?")) == pytest.approx(0.4 * 0.045, abs=1e-6)


def test_open_eyes_get_no_light(bench):
    bench.say(("SYST:ARM",))
    assert bench.code("TRIG a1,45") == Code.FLICKER
    bench.say(("SAFE:EYES SHIELDED",))
    show(bench)
    bench.ask("SAFE:EYES OPEN")
    assert not bench.unit.lit


def test_second_pattern_waits_for_the_first(bench):
    bench.say(READY)
    show(bench)
    assert bench.code("TRIG a2,45") == Code.IGNORED
    assert bench.code("PAT COL,8") == Code.IGNORED
    bench.wait(0.05)
    show(bench, "a2")
    assert bench.ask("TRIG:COUN?") == "2"


def test_dark_before_release_prevents_it(bench):
    bench.say(READY)
    assert bench.raw(bench.frame("TRIG a1,45")) == b""
    bench.now += 0.01
    bench.bare("SAFE")
    bench.now += 0.1
    bench.box.advance(bench.now)
    assert bench.edges == []
    assert bench.light[0].t_off_s == pytest.approx(1.01)
    assert bench.ask("TRIG:COUN?") == "0"


def test_lease_ends_light(bench):
    bench.say(("SYST:WDOG 300", *READY, "TRIG:COUN?"))
    show(bench, span_ms=450)
    bench.now += 0.35
    bench.box.advance(bench.now)
    assert not bench.unit.lit
    assert bench.light[0].t_off_s == pytest.approx(1.32)  # 300 ms after the answer


def test_dose_is_limited_per_subject(bench):
    bench.say(READY)
    for number in range(250):  # 0.1996 Ws each, of 50
        show(bench, f"a{number}", 499)
        bench.wait(0.5)
    assert float(bench.ask("DOSE?")) == pytest.approx(49.9, abs=1e-5)
    assert bench.code("TRIG b1,251") == Code.LIGHT_DOSE
    bench.say(("DOSE:NEW next", "SAFE:EYES CLOSED"))
    show(bench)
    assert bench.ask("TRIG:COUN?") == "251"


@pytest.mark.parametrize(
    ("faults", "code"), [({"led_dead": "1"}, Code.HARDWARE), ({"interlock": True}, Code.INTERLOCK)]
)
def test_faults_refuse_light(faults, code):
    bench = SCANNER.bench(**faults)
    bench.say(READY)
    assert bench.code("TRIG a1,45") == code
    assert not bench.unit.lit


def test_weak_lamp_emits_less():
    bench = SCANNER.bench(led_weak="1=0.5")
    light = []
    bench.unit._on_light = light.append
    bench.say(READY)
    show(bench)
    bench.wait(0.1)
    assert light[0].level == 0.5
