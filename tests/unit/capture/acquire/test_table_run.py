"""Clocks of cameras whose link is lost around the arming of a table."""

from types import SimpleNamespace

import pytest

from capture.acquire.table_run import arm_camera, count_attempts
from capture.devices.camera import FrameRefused


class RestartedCamera:
    """A camera whose program starts again, with another clock, at a chosen request."""

    def __init__(self, lost_at):
        self.lost_at, self.requests, self.armed, self.offset_s = lost_at, 0, 0, 5.0

    def _count(self):
        self.requests += 1
        if self.requests == self.lost_at:
            self.offset_s, self.armed = 905.0, 0
            return True
        return False

    def arm(self, count, trigger):
        self._count()  # the request is sent again on the new link
        self.armed = count

    def clock_s(self):
        if self._count():
            raise FrameRefused("the link was lost and made again")
        return 100.0 + self.offset_s


@pytest.mark.parametrize("lost_at", [0, 1, 2, 3])
def test_armed_camera_has_clock_of_its_link(lost_at):
    camera = RestartedCamera(lost_at)
    clock = arm_camera(camera, 7, lambda: 100.0)
    assert clock.offset_s == camera.offset_s == (905.0 if lost_at else 5.0)
    assert camera.armed == 7


def test_attempt_that_finds_dead_led_counts_extra():
    box, numbers = SimpleNamespace(failed_leds=set()), []
    for number in count_attempts(box):
        numbers.append(number)
        if number in (1, 2, 4):
            box.failed_leds.add(number)
    assert numbers == [1, 2, 3, 4, 5, 6]
