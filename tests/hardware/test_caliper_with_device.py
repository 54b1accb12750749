"""A real caliper, or an image of one: `pytest tests/hardware --device-port URL`.

The jaws move, with nothing between them.
"""

import pytest

from capture.devices.caliper import CaliperBox
from capture.devices.port import CommandRefused
from capture.devices.wire import Code

BOX = ("caliper",)
POSITION_MM = 0.02
"""A reading of the jaws' potentiometer, and the deviation allowed."""


@pytest.fixture
def box(attach):
    box = attach(CaliperBox)
    box.set_lease(5.0)
    return box


def test_caliper_moves_nothing_unless_armed_and_limited(box):
    with pytest.raises(CommandRefused) as caught:
        box.home()
    assert caught.value.code == Code.NOT_ARMED
    box.arm()
    with pytest.raises(CommandRefused) as caught:
        box.home()
    assert caught.value.code == Code.IGNORED


def test_jaws_home_step_hold_and_release(box):
    box.arm()
    box.set_force_limit(1.5)
    assert box.home().ended == "reached"
    home_mm = box.reading_mm()
    box.attach()
    step_mm = box.limits["step_mm"]
    for step in (1, 0):
        report = box.move_to(step)
        assert report.ended == "reached"
        assert report.reading_mm == pytest.approx(home_mm + step * step_mm, abs=POSITION_MM)
        assert box.is_attached()
    box.release()
    assert not box.is_attached()
