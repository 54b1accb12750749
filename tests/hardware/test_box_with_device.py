"""A real box, or one that is being served: `pytest tests/hardware --device-port URL`.

Nothing lights, moves or sucks here; what does is in test_flash_with_device.py.
"""

import time

import pytest

from capture.devices.checkup import CONTROLLER_CHECKS, MAX_CLOCK_ERROR, CheckupPort

QUIET = {
    "flash": ("FLAS:POW 0.5", "FLAS:POW?", "0.50000000"),
    "dome": ("SEQ:DEF 0,3:500:83333:1", "SEQ:CRC?", "1,4E2B"),
    "gradient_sphere": ("SEQ:DEF 0,X:90:500:30000:1", "SEQ:CRC?", "1,A68E"),
    "caliper": ("CAL:FORC:LIM 1.5", "CAL:FORC:LIM?", "1.5"),
    "probe": ("DOSE:NEW checkup", "DOSE?", "0.000000"),
    "scanner": ("PAT COL,3", "PAT?", "COL,3"),
}
"""By kind: a setting that neither lights nor moves, its query, and the answer."""


MAX_CLOCK_S = 60.0
"""Longest measurement of a clock: readings that are apart by up to 0.3 s are narrow enough."""


@pytest.fixture
def port(device_port):
    with CheckupPort(device_port) as port:
        port.hello()
        yield port


def clock_rate_range(port, elapsed_s):
    """Return the least and the greatest rate of a controller's clock, within 1 % of each other.

    The clock is read between two readings of `elapsed_s`, so that the range holds the true rate
    whatever else the machine does. A busy machine only makes the measurement longer.
    """

    def read():
        before_s = elapsed_s()
        clock_s = int(port.ask("SYST:PING?")) / 1e6
        return clock_s, before_s, elapsed_s()

    first, began_s = read(), time.monotonic()
    while time.monotonic() - began_s < MAX_CLOCK_S:
        port.listen(0.5)
        last = read()
        passed_s = last[0] - first[0]
        low, high = passed_s / (last[2] - first[1]), passed_s / (last[1] - first[2])
        if 0.0 < high - low < MAX_CLOCK_ERROR:
            return low, high
    return pytest.fail(
        f"clock rate: got {low} to {high} after {MAX_CLOCK_S} s, expected within 1 %"
    )


@pytest.mark.parametrize("check", CONTROLLER_CHECKS)
def test_controller_passes_check(port, target, check):
    """An emulation in simavr falls behind on a busy machine: its own cycles judge its clock."""
    if (check, target.board) != ("clock", "mega2560"):
        assert CONTROLLER_CHECKS[check](port)
        return
    low, high = clock_rate_range(port, target.elapsed_s)
    assert low <= 1.0 <= high
    low, high = clock_rate_range(port, lambda: 1.02 * target.elapsed_s())
    assert high < 1.0  # a clock 2 % slow would be found


def test_setting_is_kept_until_reset(port):
    kind = port.hello().kind
    setting, query, answer = QUIET[kind]
    port.ask("*RST")
    before = port.ask(query)
    port.ask(setting)
    assert port.ask(query) == answer
    port.ask("*RST")
    assert port.ask(query) == before
