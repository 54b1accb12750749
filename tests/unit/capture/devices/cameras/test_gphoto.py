"""The way through the gphoto2 backend, against a stand-in for the library; no camera was at hand.

The stand-in has the calls and constants of python-gphoto2 2.6 that the backend uses.
"""

import dataclasses
import itertools
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from capture import raw
from capture.devices.camera import (
    CameraError,
    CameraUrlError,
    Exposure,
    FrameTimeout,
    Trigger,
    next_frame,
)
from capture.devices.cameras.gphoto import GphotoCamera

WANT = Exposure(0.008, 100)


class GPhoto2Error(Exception):
    pass


class Widget:
    def __init__(self, value, choices=()):
        self.value, self.choices = value, list(choices)

    def get_value(self):
        return self.value

    def set_value(self, value):
        assert value in self.choices
        self.value = value

    def get_choices(self):
        return self.choices


@dataclasses.dataclass
class Body:
    """A camera on the bus: what it is set to, what it has shot, what it will say."""

    serial: str
    address: str
    seconds: list = dataclasses.field(default_factory=lambda: ["bulb", "1/60", "1/125", "1/250"])
    iso: list = dataclasses.field(default_factory=lambda: ["Auto", "100", "200"])
    broken: bool = False
    held: bool = False
    stuck: bool = False
    events: deque = dataclasses.field(default_factory=deque)
    files: dict = dataclasses.field(default_factory=dict)
    shots: int = 0

    def __post_init__(self):
        self.tree = {
            "serialnumber": Widget(self.serial),
            "shutterspeed": Widget("1/60", self.seconds),
            "iso": Widget("200", self.iso),
        }

    def expose(self):
        """Make a file as the body is set now; return its path."""
        self.shots += not self.stuck
        top, _, bottom = self.tree["shutterspeed"].value.partition("/")
        self.files["capt0000.nef"] = raw.encode_dng(  # one name for all: the camera's memory
            np.full((16, 16), 600 + self.shots, np.uint16),
            pattern="RGGB",
            black=512,
            white=16383,
            exposure_s=float(top) / float(bottom),
            camera_model="Body",
            iso=int(self.tree["iso"].value),
            camera_serial=self.serial,
        )
        return SimpleNamespace(folder="/", name="capt0000.nef")

    def edge(self):
        """The box's line releases the camera; it will tell of the file."""
        self.events.append(("property", "battery"))
        self.events.append(("file", self.expose()))


def library(*bodies, clock):
    by_address = {body.address: body for body in bodies}

    class Camera:
        @staticmethod
        def autodetect():
            return [("USB camera", body.address) for body in bodies]

        def set_port_info(self, address):
            self.body = by_address[address]

        def init(self):
            if self.body.held:
                raise GPhoto2Error("[-53] Could not claim the USB device")

        def get_config(self):
            if self.body.broken:
                raise GPhoto2Error("[-110] I/O in progress")
            return SimpleNamespace(get_child_by_name=self.body.tree.__getitem__)

        def set_config(self, tree):
            pass

        def capture(self, kind):
            assert kind == "image"
            clock.now += 0.2
            return self.body.expose()

        def file_get(self, folder, name, kind):
            assert kind == "normal"
            clock.now += 0.5
            blob = self.body.files[name]
            return SimpleNamespace(get_data_and_size=lambda: memoryview(blob))

        def wait_for_event(self, timeout_ms):
            if self.body.events:
                return self.body.events.popleft()
            clock.now += timeout_ms / 1e3
            return "timeout", None

        def exit(self):
            self.body.held = False

    class PortInfoList(list):
        def load(self):
            self.extend(by_address)

        def lookup_path(self, address):
            return self.index(address)

    return SimpleNamespace(
        Camera=Camera,
        PortInfoList=PortInfoList,
        GPhoto2Error=GPhoto2Error,
        GP_CAPTURE_IMAGE="image",
        GP_FILE_TYPE_NORMAL="normal",
        GP_EVENT_TIMEOUT="timeout",
        GP_EVENT_FILE_ADDED="file",
    )


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def body():
    return Body("B2", "usb:1,5")


@pytest.fixture
def camera(body, clock):
    others = Body("A1", "usb:1,4"), Body("C3", "usb:1,6", held=True)
    found = GphotoCamera(library(*others, body, clock=clock), "B2", clock=clock)
    assert found.info.serial == "B2"
    return found


def shoot(camera, body, trigger, clock):
    camera.configure(WANT)
    camera.arm(1, trigger)
    armed_s = clock.now
    if trigger is Trigger.EDGE:
        clock.now += 0.1
        body.edge()
    else:
        camera.fire()
    return next_frame(camera, seq=0, not_before_s=armed_s, want=WANT, timeout_s=5.0)


def test_camera_is_found_by_serial_on_any_port(clock, body):
    for bus in itertools.permutations([Body("A1", "usb:1,4"), body, Body("C3", "usb:1,6")]):
        assert GphotoCamera(library(*bus, clock=clock), "B2", clock=clock).info.serial == "B2"


def test_missing_camera_error_lists_available_cameras(clock):
    bus = library(Body("A1", "usb:1,4"), Body("C3", "usb:1,6", held=True), clock=clock)
    with pytest.raises(CameraUrlError, match=r"(?s)serial A1.*claim"):
        GphotoCamera(bus, "B2", clock=clock)


@pytest.mark.parametrize("trigger", [Trigger.EDGE, Trigger.SOFTWARE])
def test_frame_matches_camera_settings_and_its_release(camera, body, clock, trigger):
    before = body.shots
    frame, stale = shoot(camera, body, trigger, clock)
    assert (stale, body.shots) == (0, before + 1)
    assert frame.exposure == WANT
    picture = raw.decode(memoryview(frame.image), where="test")
    assert picture.cfa.max() == 600 + body.shots
    again, _ = shoot(camera, body, trigger, clock)
    assert again.image != frame.image


def test_settings_are_nearest_available_and_reported(camera):
    # nearest in stops: 0.004 is 0.3 stops from 0.005, 0.008 is 0.7
    assert camera.configure(Exposure(0.005, 130)) == Exposure(0.004, 100)
    assert camera.configure(Exposure(0.02, 1600)) == Exposure(1 / 60, 200)


def test_a_camera_on_automatic_has_nothing_to_set(clock):
    body = Body("B2", "usb:1,5", seconds=["auto"])
    body.tree["shutterspeed"].value = "auto"
    camera = GphotoCamera(library(body, clock=clock), "B2", clock=clock)
    with pytest.raises(CameraError, match="set the dial to M"):
        camera.configure(WANT)


def test_file_from_before_arming_is_not_frame(camera, body, clock):
    camera.configure(WANT)
    body.edge()  # somebody pressed the shutter
    camera.arm(1, Trigger.EDGE)
    with pytest.raises(FrameTimeout, match="trigger line"):
        camera.frame(2.0)


def test_camera_returning_last_file_again_is_stale(camera, body, clock):
    shoot(camera, body, Trigger.EDGE, clock)
    body.stuck = True
    with pytest.raises(FrameTimeout):
        shoot(camera, body, Trigger.EDGE, clock)
    body.stuck = False
    frame, stale = shoot(camera, body, Trigger.EDGE, clock)
    assert stale == 0
    assert raw.decode(memoryview(frame.image), where="test").cfa.max() == 600 + body.shots


def test_stale_file_before_right_file_is_dropped_counted(camera, body, clock):
    shoot(camera, body, Trigger.EDGE, clock)
    camera.arm(1, Trigger.EDGE)
    armed_s = clock.now
    old = SimpleNamespace(folder="/", name="old.nef")
    body.files["old.nef"] = body.files["capt0000.nef"]
    body.events.append(("file", old))
    body.edge()
    frame, stale = next_frame(camera, seq=0, not_before_s=armed_s, want=WANT, timeout_s=5.0)
    assert stale == 1
    assert raw.decode(memoryview(frame.image), where="test").cfa.max() == 600 + body.shots


def test_unfired_camera_gives_no_frame(camera):
    camera.arm(1, Trigger.SOFTWARE)
    with pytest.raises(FrameTimeout, match="not fired"):
        camera.frame(1.0)


def test_library_exception_becomes_camera_error(camera, body):
    body.broken = True
    with pytest.raises(CameraError, match="I/O in progress"):
        camera.configure(WANT)


@pytest.mark.parametrize("trigger", [Trigger.LEVEL, Trigger.HAND])
def test_other_triggers_are_refused(camera, trigger):
    with pytest.raises(CameraError, match="cannot be triggered"):
        camera.arm(1, trigger)
