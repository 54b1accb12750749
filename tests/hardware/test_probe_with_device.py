"""A real contact probe, or an image of one: `pytest tests/hardware --device-port URL`.

The head is on a flat plate. It sucks for a second and lights up for some hundredths of one.
"""

import pytest

from capture.devices.port import CommandRefused
from capture.devices.probe import ProbeBox
from capture.devices.wire import Code

BOX = ("probe",)
SUCTION_MBAR = 40.0


@pytest.fixture
def box(attach):
    box = attach(ProbeBox)
    box.set_lease(5.0)
    return box


def test_probe_lights_nothing_unless_head_is_held(box):
    box.arm()
    box.set_level(0.5)
    with pytest.raises(CommandRefused) as caught:
        box.open_shutter(0.02)
    assert caught.value.code == Code.IGNORED


def test_probe_sucks_lights_once_and_vents(box):
    box.arm()
    before, count = box.dose_ws(), box.count_openings()
    box.place("plate", 0.0)
    box.suck(SUCTION_MBAR, 3.0)
    box.listen(0.6)
    assert box.pressure_mbar() == pytest.approx(SUCTION_MBAR, rel=0.1)
    box.set_level(1.0)
    box.open_shutter(0.05)
    box.listen(0.2)
    assert box.count_openings() == count + 1
    assert box.dose_ws() > before
    box.vent()
    box.listen(0.8)
    assert box.pressure_mbar() == pytest.approx(0.0, abs=2.0)
