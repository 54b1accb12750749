"""A real flash box, or one that is being served: `pytest tests/hardware --device-port URL`.

It flashes at the lowest power. Nobody looks into the lights while this runs.
"""

import pytest

from capture.devices.flash import FlashBox
from capture.devices.port import CommandRefused
from capture.devices.wire import Code

BOX = ("flash",)


@pytest.fixture
def box(attach):
    return attach(FlashBox)


def test_controller_reports_its_limits(box):
    limits = box.limits
    assert limits["kind"] == "flash"
    assert 0.0 < limits["power_min"] < limits["power_max"] <= 1.0
    assert limits["recycle_s"] >= 1.5
    assert limits["pops_per_min"] <= 20
    assert limits["lease_max_ms"] <= 5000
    assert limits["lamp_max_ms"] <= 500


def test_controller_lights_nothing_unless_armed(box):
    count = box.count()
    with pytest.raises(CommandRefused) as caught:
        box.fire("unarmed")
    assert caught.value.code == Code.NOT_ARMED
    assert box.count() == count


def test_single_pop_is_made_and_counted_once(box):
    count = box.count()
    box.set_polarizer("crossed")
    box.set_power(box.limits["power_min"])
    box.wait_charged(30.0)
    box.arm()
    report = box.fire("hardware-test")
    box.dark()
    assert (report.token, report.polarizer, report.count) == ("hardware-test", "crossed", count + 1)
    assert box.last_pop() == report


def test_silent_host_leaves_controller_dark_and_disarmed(box):
    box.set_lease(0.3)
    box.arm()
    box.lamp_on(0.5)
    events = box.port.listen(0.45)
    assert "WDOG:TRIP" in [event.name for event in events]
    assert not box.is_lamp_lit()
    assert not box.is_armed()
