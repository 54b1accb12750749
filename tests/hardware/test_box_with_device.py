"""A real box, or one that is being served: `pytest tests/hardware --device-port URL`.

Nothing lights, moves or sucks here; what does is in test_flash_with_device.py.
"""

import pytest

from capture.devices.checkup import CONTROLLER_CHECKS, CheckupPort

QUIET = {
    "flash": ("FLAS:POW 0.5", "FLAS:POW?", "0.50000000"),
    "dome": ("SEQ:DEF 0,3:500:83333:1", "SEQ:CRC?", "1,4E2B"),
    "gradient_sphere": ("SEQ:DEF 0,X:90:500:30000:1", "SEQ:CRC?", "1,A68E"),
    "caliper": ("CAL:FORC:LIM 1.5", "CAL:FORC:LIM?", "1.5"),
    "probe": ("DOSE:NEW checkup", "DOSE?", "0.000000"),
    "scanner": ("PAT COL,3", "PAT?", "COL,3"),
}
"""By kind: a setting that neither lights nor moves, its query, and the answer."""


@pytest.fixture
def port(device_port):
    with CheckupPort(device_port) as port:
        port.hello()
        yield port


@pytest.mark.parametrize("check", CONTROLLER_CHECKS)
def test_controller_passes_check(port, check):
    assert CONTROLLER_CHECKS[check](port)


def test_setting_is_kept_until_reset(port):
    kind = port.hello().kind
    setting, query, answer = QUIET[kind]
    port.ask("*RST")
    before = port.ask(query)
    port.ask(setting)
    assert port.ask(query) == answer
    port.ask("*RST")
    assert port.ask(query) == before
