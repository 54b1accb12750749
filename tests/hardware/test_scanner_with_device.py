"""A real face scanner, or an image of one: `pytest tests/hardware --device-port URL`.

It shows stripes for some hundredths of a second. Nobody looks into the projectors meanwhile.
"""

import pytest

from capture.devices.port import CommandRefused
from capture.devices.scanner import ScannerBox
from capture.devices.wire import Code

BOX = ("scanner",)


@pytest.fixture
def box(attach):
    return attach(ScannerBox)


def test_scanner_shows_nothing_at_open_eyes(box):
    box.arm()
    shown = box.shown_patterns()
    with pytest.raises(CommandRefused) as caught:
        box.trigger("open", 0.05)
    assert caught.value.code == Code.FLICKER
    assert box.shown_patterns() == shown


def test_each_projector_shows_each_axis_once(box):
    box.set_eyes("closed")
    box.arm()
    shown, dose_ws = box.shown_patterns(), box.dose_ws()
    released_s = [0.0]
    for number in range(int(box.limits["projectors"])):
        box.select_projector(number)
        for axis in ("columns", "rows"):
            box.select_pattern(axis, 1)
            released_s.append(box.trigger(f"{axis}.{number}", 0.05))
            box.listen(0.1)
            assert not box.status().showing
    assert box.shown_patterns() == shown + len(released_s) - 1
    assert released_s == sorted(released_s)
    assert box.dose_ws() > dose_ws


def test_silent_host_leaves_projectors_dark(box):
    box.set_lease(0.3)
    box.set_eyes("closed")
    box.arm()
    box.select_white()
    box.trigger("white", 0.5)
    events = box.port.listen(0.45)
    assert "WDOG:TRIP" in [event.name for event in events]
    assert not box.status().showing
    assert not box.is_armed()
