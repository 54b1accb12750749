"""The GenICam backend with the library itself and its simulated producer; needs the extra.

``viky.cti`` comes with the package ``genicam``: three cameras that stream a moving ball at their
own pace. They have no exposure time, no trigger and no clock, so that they are refused as cameras
of a rig; where a test needs a whole camera, these features are put beside those that the producer
has, and the frames are the producer's.
"""

import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from capture.devices.camera import (
    CameraBusy,
    CameraError,
    CameraUrlError,
    Exposure,
    FrameTimeout,
    Trigger,
    next_frame,
    open_camera,
)
from capture.devices.cameras import genicam as backend
from capture.devices.cameras import genicam_producer
from capture.devices.cameras.genicam_producer import Features
from capture.devices.cameras.genicam_readout import parse_address

package = pytest.importorskip("genicam")
pytest.importorskip("harvesters")

PRODUCER = Path(package.__file__).with_name("viky.cti")
WANT = Exposure(0.01, 100)


@pytest.fixture(autouse=True)
def search_path(monkeypatch):
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(PRODUCER.parent))


@pytest.fixture
def connection():
    library = genicam_producer.load_library("genicam:1")
    files = genicam_producer.producer_files("genicam:1", str(PRODUCER))
    connection = genicam_producer.connect_camera(library, "genicam:1", "1", files)
    connection.library = library
    yield connection
    connection.close()
    assert not genicam_producer._opened_producers


def test_unknown_camera_serial_error_lists_found_serials():
    with pytest.raises(CameraUrlError, match=r"genicam:77: no such camera; found Viky 0, Viky 1, "):
        open_camera("genicam:77")


def test_camera_without_exposure_is_refused_and_released():
    for _ in range(2):  # one that were held would be busy
        with pytest.raises(CameraError, match="genicam:1: has no feature ExposureTime"):
            open_camera(f"genicam:1?producer={PRODUCER}&black=0")
    assert not genicam_producer._opened_producers


def test_open_camera_is_busy_but_neighbor_is_not(connection):
    files = (PRODUCER.resolve(),)
    with pytest.raises(CameraBusy, match="close the other program"):
        genicam_producer.connect_camera(connection.library, "genicam:1", "1", files)
    other = genicam_producer.connect_camera(
        connection.library, "genicam:2", "VikyTL_DEV_blue", files
    )
    assert other.identifier == "VikyTL_DEV_blue"
    other.close()


def test_file_that_is_not_library_cannot_be_loaded(tmp_path):
    (tmp_path / "broken.cti").write_bytes(b"no library")
    with pytest.raises(CameraUrlError, match=r"broken\.cti cannot be loaded"):
        open_camera(f"genicam:1?producer={tmp_path}")


def test_interrupting_stays_with_the_program(connection):
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_library_features_are_read_set_and_refused(connection):
    nodes = connection.acquirer.remote_device.node_map
    features = Features(nodes, connection.library, "genicam:1")
    # an entry that cannot be chosen now (Coord3D_ABC32f_Planar) is none
    assert features.choices("PixelFormat") == ["RGBa8", "Mono8"]
    features.set("PixelFormat", "Mono8")
    assert (features.read("PixelFormat"), features.enum_number("PixelFormat")) == (
        "Mono8",
        0x01080001,
    )
    with pytest.raises(CameraError, match="got 'BayerRG8', expected one of RGBa8, Mono8"):
        features.set("PixelFormat", "BayerRG8")
    assert features.set_nearest("Width", 1e6) == 800
    assert features.set_nearest("Width", 400.2) == 400
    with pytest.raises(CameraError, match=r"Width to 10\*\*9|Width to 1000000000"):
        features.set("Width", 10**9)
    assert features.set_nearest("AcquisitionFrameRate", 30.0) == pytest.approx(30.0)
    assert not features.has("ExposureTime")
    assert not features.has("EventGameProgress")  # there, but not now
    with pytest.raises(CameraError, match="no feature ChunkNrBounces"):
        features.read("ChunkNrBounces")
    with pytest.raises(CameraError, match="no command TriggerSoftware"):
        features.execute("TriggerSoftware")


class Feature:
    """A feature that the producer lacks."""

    def __init__(self, value=None, *, choices=(), do=lambda: None, read=None):
        self._value, self._read, self.execute = value, read, do
        self.entries = [SimpleNamespace(symbolic=c, get_access_mode=lambda: 3) for c in choices]
        self.min, self.max, self.unit = 10.0, 1e6, ""

    @property
    def value(self):
        return self._value if self._read is None else self._read()

    @value.setter
    def value(self, value):
        self._value = value

    def get_access_mode(self):
        return 4

    def has_inc(self):
        return False


class WithMore:
    """An object of the library, with more attributes than it has."""

    def __init__(self, own, **more):
        self._own = own
        self.__dict__.update(more)

    def __getattr__(self, name):
        return getattr(self._own, name)


@pytest.fixture
def camera(connection):
    """A camera of the producer with the features that it lacks."""
    real = connection.acquirer
    clock = {"latched": 0}
    nodes = WithMore(
        real.remote_device.node_map,
        ExposureTime=Feature(10_000.0),
        TriggerMode=Feature("Off", choices=["Off", "On"]),
        TriggerSource=Feature("Line0", choices=["Line0", "Software"]),
        TimestampLatch=Feature(do=lambda: clock.update(latched=time.monotonic_ns())),
        TimestampLatchValue=Feature(read=lambda: clock["latched"]),
    )
    fetched = []

    class Acquirer:
        remote_device = SimpleNamespace(node_map=nodes)
        min_num_buffers = real.min_num_buffers
        start, stop, destroy = real.start, real.stop, real.destroy

        @property
        def num_buffers(self):
            return real.num_buffers

        @num_buffers.setter
        def num_buffers(self, count):
            real.num_buffers = count

        @staticmethod
        def try_fetch(**how):
            buffer = real.try_fetch(**how)
            if buffer is None:
                return None
            fetched.append(buffer.frame_id)
            return WithMore(
                buffer,
                timestamp_ns=time.monotonic_ns(),
                parent=SimpleNamespace(queue_buffer=lambda _: buffer.parent.queue_buffer(buffer)),
            )

    connection.acquirer = Acquirer()
    library, address = connection.library, parse_address("1?black=0")
    camera = backend.GenicamCamera(library, connection, address)
    camera.fetched = fetched
    yield camera
    camera.close()


def test_camera_properties_match_its_producer(camera):
    info = camera.info
    assert (info.serial, info.model, info.pattern) == ("1", "Viky", "MONO")
    assert (info.width_px, info.height_px, info.black, info.white) == (400, 400, (0.0,), 255)


def test_frames_stream_in_order_and_show_motion(camera):
    assert camera.configure(WANT) == WANT
    for _ in range(2):  # stopping frees what starting again needs
        camera.arm(8, Trigger.EDGE)
        before = camera.clock_s()
        frames = []
        for _ in range(8):  # more than there are buffers, were they not given back
            frames.append(camera.frame(10.0))
        assert [frame.seq for frame in frames] == [
            frame_id - camera.fetched[-8] for frame_id in camera.fetched[-8:]
        ]
        for frame in frames:
            assert frame.image.shape == (400, 400)
            assert frame.image.dtype == np.uint16
            assert 0 <= frame.image.min() < frame.image.max() <= 255
            assert frame.t_start_s > before
        assert (frames[0].image != frames[-1].image).any()
        camera.abort()


def test_first_frame_after_arming_is_the_requested_frame(camera):
    camera.configure(WANT)
    camera.arm(1, Trigger.EDGE)
    before = camera.clock_s()
    frame, stale = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=10.0)
    assert (frame.serial, stale) == ("1", 0)


def test_no_frame_in_time_is_a_timeout(camera):
    camera.arm(1, Trigger.EDGE)
    camera._features.execute("AcquisitionStop")
    with pytest.raises(FrameTimeout, match=r"no frame came in 0\.2 s"):
        deque(iter(lambda: camera.frame(0.2), None), maxlen=0)  # those that were on their way


def test_closed_camera_can_be_opened_by_other_process(camera):
    code = (
        "from capture.devices.camera import CameraError, open_camera\n"
        "try: open_camera('genicam:1?black=0')\n"
        "except CameraError as error: print(error)\n"
    )
    camera.close()
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "ExposureTime" in run.stdout
    assert run.stderr == ""  # the library logs nothing past the error
