"""A real dome or gradient sphere, or an image: `pytest tests/hardware --device-port URL`.

Lights up for tenths of a second. Nobody looks into the lights while this runs.
"""

import itertools

import pytest

from capture.devices.checkup import CheckupPort
from capture.devices.port import CommandRefused
from capture.devices.wire import Code

BOX = ("dome", "gradient_sphere")
ROWS = {
    "dome": "3:500:40000:1;17:500:40000:1;-:0:40000:1",
    "gradient_sphere": "X:0:500:40000:1;FULL:0:500:40000:1;DARK:0:0:40000:1",
}
LIT = {"dome": "LED:ON 3,400,300", "gradient_sphere": "PATT FULL,400,300"}
DWELL_US = 40_000
LATE_US = 15_000
"""An emulated box also waits for its host."""


@pytest.fixture
def box(device_port):
    with CheckupPort(device_port, timeout_s=0.5) as port:
        kind = port.hello().kind
        if kind not in BOX:
            pytest.skip("another box than the dome or the gradient sphere")
        port.ask("*RST")
        port.ask("SAFE:EYES CLOSED")
        yield port, kind
        port.ask("SAFE")


def test_table_runs_once_and_reports_rows(box):
    port, kind = box
    port.ask(f"SEQ:DEF 0,{ROWS[kind]}")
    with pytest.raises(CommandRefused) as caught:
        port.ask("TRIG early")
    assert caught.value.code == Code.NOT_ARMED
    port.ask("SYST:ARM")
    port.ask("SEQ:ARM 3")
    port.listen(0.3)
    port.ask("TRIG once")
    events = [event.name for event in port.listen(0.5)]
    assert events == ["SEQ:STEP"] * 3 + ["SEQ:DONE"]
    times_us = [int(port.ask(f"SEQ:STEP? {row}")) for row in range(3)]
    for earlier, later in itertools.pairwise(times_us):
        assert later - earlier == pytest.approx(DWELL_US, abs=LATE_US)
    assert not int(port.ask("STAT?")) & 64


def test_silent_host_leaves_leds_dark(box):
    port, kind = box
    port.ask("SYST:WDOG 300")
    port.ask("SYST:ARM")
    port.ask(LIT[kind])
    assert int(port.ask("STAT?")) & 64
    assert "WDOG:TRIP" in [event.name for event in port.listen(0.6)]
    assert not int(port.ask("STAT?")) & 64
