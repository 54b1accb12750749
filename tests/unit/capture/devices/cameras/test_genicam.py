"""The way through the GenICam backend, against a stand-in for the library; no camera was at hand.

The stand-in has the calls of harvesters 1.4 and the access modes and exceptions of genicam 1.6 that
the backend uses. What the library itself does is tested with its simulated producer, in
tests/protocol/test_genicam_producer.py.
"""

import itertools
import signal
import subprocess
import sys
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from capture.acquire.table_run import FrameStream, compare_clocks
from capture.devices.camera import (
    CameraBusy,
    CameraError,
    CameraUrlError,
    Exposure,
    FrameRefused,
    FrameTimeout,
    StaleFrame,
    Trigger,
    WrongCamera,
    next_frame,
    open_camera,
)
from capture.devices.cameras import genicam, genicam_producer
from capture.devices.port import LinkLost

WANT = Exposure(0.008, 200)
NUMBERS = {"Mono8": 0x01080001, "BayerRG8": 0x01080009, "BayerRG12": 0x01100011, "RGB8": 0x02180014}
RO, RW = 3, 4


class GenericError(Exception):
    pass


def error(name):
    return type(name, (GenericError,), {})("as the library says it")


class Node:
    """A feature, as GenApi shows it."""

    def __init__(
        self,
        value=None,
        *,
        choices=(),
        access=RW,
        low=None,
        high=None,
        inc=None,
        unit="",
        do=None,
        read=None,
        numbers=None,
    ):
        self._value, self._read, self._do, self._numbers = value, read, do, numbers
        self._names, self._access = list(choices), access
        self.min, self.max, self._inc, self.unit = low, high, inc, unit

    def get_access_mode(self):
        return self._access

    @property
    def entries(self):
        return [SimpleNamespace(symbolic=name, get_access_mode=lambda: RO) for name in self._names]

    @property
    def value(self):
        return self._value if self._read is None else self._read()

    @value.setter
    def value(self, value):
        if self._access != RW:
            raise error("AccessException")
        if (self._names and value not in self._names) or not self._allowed(value):
            raise error("OutOfRangeException")
        self._value = value

    def _allowed(self, value):
        if self.min is None:
            return True
        off_grid = 0 if self._inc is None else (value - self.min) / self._inc % 1
        return self.min <= value <= self.max and abs(off_grid - round(off_grid)) < 1e-6

    def has_inc(self):
        return self._inc is not None

    @property
    def inc(self):
        return self._inc if self._inc is not None else 1

    def get_int_value(self):
        return self._numbers[self._value]

    def execute(self):
        self._do()


class Body:
    """A camera on the bus: what it is set to, what it has shot, and what is wrong with it."""

    def __init__(self, serial, clock):
        self.serial, self.clock = serial, clock
        self.buffers, self.requeued = deque(), []
        self.running = self.open = self.busy = self.gone = False
        self.shots = self.announced = self.ahead_s = 0
        self.latched_ns = 0
        self.nodes = {
            "DeviceSerialNumber": Node(serial, access=RO),
            "DeviceModelName": Node("Body 12µ", access=RO),
            "Width": Node(6),
            "Height": Node(4),
            "PayloadSize": Node(48, access=RO),
            "PixelFormat": Node("Mono8", choices=list(NUMBERS), numbers=NUMBERS),
            "ExposureTime": Node(5000.0, low=20.0, high=1e6, inc=20.0),
            "Gain": Node(3.0, low=0.0, high=24.0, unit="dB"),
            "GainSelector": Node("Red", choices=["Red", "All"]),
            "BlackLevel": Node(64.0, unit="DN"),
            "ExposureAuto": Node("Continuous", choices=["Off", "Continuous"]),
            "GammaEnable": Node(True),
            "AcquisitionMode": Node("SingleFrame", choices=["SingleFrame", "Continuous"]),
            "BalanceRatioSelector": Node("Red", choices=["Red", "Blue"]),
            "BalanceRatio": Node(1.8, low=0.5, high=4.0),
            "TriggerSelector": Node("FrameStart", choices=["AcquisitionStart", "FrameStart"]),
            "TriggerMode": Node("Off", choices=["Off", "On"]),
            "TriggerSource": Node("Line2", choices=["Software", "Line1", "Line2"]),
            "TriggerActivation": Node("FallingEdge", choices=["RisingEdge", "FallingEdge"]),
            "TriggerSoftware": Node(do=lambda: self.released_by("Software")),
            "TimestampLatch": Node(do=self.latch),
            "TimestampLatchValue": Node(access=RO, read=lambda: self.latched_ns),
        }

    def now_s(self):
        return self.clock.now + 5000.0  # counts from when it was switched on

    def latch(self):
        if self.gone:
            raise error("RuntimeException")
        self.latched_ns = round(1e9 * self.now_s())
        self.clock.now += 1e-4

    def released_by(self, source):
        at = {name: self.nodes[name].value for name in ("TriggerMode", "TriggerSource")}
        if self.running and at == {"TriggerMode": "On", "TriggerSource": source}:
            self.expose()

    def expose(self, **changes):
        self.shots += 1
        name = self.nodes["PixelFormat"].value
        width, height = self.nodes["Width"].value, self.nodes["Height"].value
        values = np.full((height, width), 64 + self.shots, "u1" if name.endswith("8") else "<u2")
        fields = {
            "payload_type": 1,
            "pixel_format": NUMBERS[name],
            "width": width,
            "height": height,
            "raw_buffer": values.tobytes(),
            "image_offset": 0,
            "padding_x": 0,
            "pixel_endianness": 1,
            "frame_id": self.shots,
            "timestamp_ns": round(1e9 * (self.now_s() + self.ahead_s)),
            "parent": SimpleNamespace(queue_buffer=self.requeued.append),
        }
        self.buffers.append(SimpleNamespace(**(fields | changes)))


class Acquirer:
    min_num_buffers = 2

    def __init__(self, body):
        self.body = body
        self.remote_device = SimpleNamespace(node_map=SimpleNamespace(**body.nodes))
        body.open = True

    @property
    def num_buffers(self):
        return self.body.announced

    @num_buffers.setter
    def num_buffers(self, count):
        self.body.announced = count

    def start(self):
        self.body.buffers.clear()
        self.body.running = True

    def stop(self):
        self.body.running = False
        self.body.buffers.clear()

    def try_fetch(self, *, timeout, is_raw):
        assert is_raw
        assert timeout > 0  # 0 waits for ever in the library
        if self.body.gone == "transport":
            raise error("InvalidHandleException")
        if self.body.buffers:
            self.body.clock.now += 0.01
            return self.body.buffers.popleft()
        self.body.clock.now += timeout
        return None

    def destroy(self):
        self.body.running = self.body.open = False
        if self.body.gone:
            raise error("InvalidHandleException")


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def body(clock):
    return Body("B2", clock)


@pytest.fixture
def bus(clock, body, tmp_path, monkeypatch):
    """Three cameras behind two producers; the second has the one that is asked for."""
    producers = {}
    for name, bodies in (("one.cti", [Body("A1", clock)]), ("two.cti", [body, Body("C3", clock)])):
        (tmp_path / name).touch()
        producers[str((tmp_path / name).resolve())] = bodies
    opened = []

    class Harvester:
        def __init__(self, logger):
            self.device_info_list = []

        def add_file(self, path, *, check_existence, check_validity):
            self.path = path

        def update(self):
            assert self.path not in opened, "a producer can be opened once only"
            opened.append(self.path)
            self.device_info_list = [
                SimpleNamespace(serial_number=b.serial, id_=f"id-{b.serial}", model="Body", body=b)
                for b in producers[self.path]
            ]

        def create(self, device, *, config):
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # as the library does
            if device.body.busy:
                raise error("ResourceInUseException")
            return Acquirer(device.body)

        def reset(self):
            opened.remove(self.path)

    core = SimpleNamespace(
        Harvester=Harvester,
        ParameterSet=dict,
        ParameterKey=SimpleNamespace(ENABLE_AUTO_CHUNK_DATA_UPDATE="chunks"),
    )
    library = genicam_producer.GenicamLibrary(core, (GenericError,))
    monkeypatch.setattr(genicam, "load_library", lambda url: library)
    monkeypatch.setattr(genicam.GenicamCamera.__init__, "__kwdefaults__", {"clock": clock})
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    handler = signal.getsignal(signal.SIGINT)
    yield opened
    assert signal.getsignal(signal.SIGINT) is handler
    assert not opened, "a producer was left open"


@pytest.fixture
def camera(bus):
    camera = genicam.open_camera("B2")
    yield camera
    camera.close()


def released(camera, body, trigger, clock):
    """Arm, release, and return the camera's time of before."""
    camera.configure(WANT)
    camera.arm(1, trigger)
    before = camera.clock_s()
    clock.now += 0.1
    if trigger is Trigger.SOFTWARE:
        camera.fire()
    else:
        body.released_by("Line2")
    return before


@pytest.mark.parametrize("trigger", [Trigger.SOFTWARE, Trigger.EDGE])
def test_frame_matches_camera_settings_and_its_release(camera, body, clock, trigger):
    for shot in (1, 2):
        before = released(camera, body, trigger, clock)
        frame, stale = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=2.0)
        assert stale == 0
        assert frame.serial == "B2"
        np.testing.assert_array_equal(frame.image, np.full((4, 6), 64 + shot, np.uint16))
        assert frame.t_start_s == pytest.approx(before + 0.1, abs=0.01)
        assert frame.t_end_s - frame.t_start_s == pytest.approx(0.008)
        assert len(body.requeued) == shot


def test_camera_reports_its_identity(camera):
    info = camera.info
    assert (info.serial, info.model) == ("B2", "Body 12?")
    assert (info.width_px, info.height_px, info.pattern) == (6, 4, "RGGB")
    assert (info.black, info.white) == ((64.0,) * 4, 4095)
    assert info.triggers == (Trigger.SOFTWARE, Trigger.EDGE)


def test_a_camera_is_set_to_raw_values(camera, body):
    at = {name: node.value for name, node in body.nodes.items()}
    assert (at["PixelFormat"], at["ExposureAuto"], at["GammaEnable"]) == ("BayerRG12", "Off", False)
    assert (at["AcquisitionMode"], at["BalanceRatio"]) == ("Continuous", 1.0)


def test_edges_come_from_requested_line(bus, body):
    camera = genicam.open_camera("B2?line=Line1&format=BayerRG8&black=3.5")
    assert (camera.info.black, camera.info.white) == ((3.5,) * 4, 255)
    camera.arm(2, Trigger.EDGE)
    assert body.nodes["TriggerActivation"].value == "RisingEdge"
    body.released_by("Line2")
    assert body.shots == 0
    body.released_by("Line1")
    assert (camera.frame(1.0).image == 65).all()
    with pytest.raises(FrameTimeout, match="plugged into the camera's Line1"):
        camera.frame(1.0)
    camera.close()


def test_every_other_trigger_is_switched_off(camera, body):
    seen = []
    mode, selector = body.nodes["TriggerMode"], body.nodes["TriggerSelector"]
    per_selector = {"AcquisitionStart": "On", "FrameStart": "Off"}

    class PerSelector(Node):
        @property
        def value(self):
            return per_selector[selector.value]

        @value.setter
        def value(self, value):
            seen.append(selector.value)
            per_selector[selector.value] = value

    mode.__class__ = PerSelector
    camera.arm(1, Trigger.EDGE)
    assert per_selector == {"AcquisitionStart": "Off", "FrameStart": "On"}
    assert seen == ["AcquisitionStart", "FrameStart"]


def test_settings_are_nearest_available_and_reported(camera, body):
    # steps of 20 us from 20 us; 6.02 dB is a factor of 2
    got = camera.configure(Exposure(0.000033, 200))
    assert (got.exposure_s, got.iso) == (pytest.approx(40e-6), 200)
    assert body.nodes["Gain"].value == pytest.approx(6.0206, abs=1e-4)
    assert body.nodes["GainSelector"].value == "All"
    assert camera.configure(Exposure(60.0, 50)) == Exposure(1.0, 100)
    got = camera.configure(Exposure(1e-7, 10**6))
    assert (got.exposure_s, got.iso) == (pytest.approx(20e-6), 1585)  # 24 dB


def test_gain_of_0_db_has_name_from_address(bus, body):
    camera = genicam.open_camera("B2?iso=160")
    assert camera.configure(Exposure(0.008, 160)).iso == 160
    assert body.nodes["Gain"].value == 0.0
    assert camera.configure(Exposure(0.008, 1600)).iso == 1600
    assert body.nodes["Gain"].value == pytest.approx(20.0)
    camera.close()


def test_gain_of_other_unit_stays_at_minimum(bus, body):
    body.nodes["Gain"] = Node(4.0, low=1.0, high=16.0)
    camera = genicam.open_camera("B2?iso=160")
    assert camera.configure(Exposure(0.008, 640)) == Exposure(0.008, 160)
    assert body.nodes["Gain"].value == 1.0
    camera.close()


def test_white_is_where_the_converter_ends(bus, body):
    body.nodes["PixelDynamicRangeMax"] = Node(4080, access=RO)
    camera = genicam.open_camera("B2")
    assert camera.info.white == 4080
    camera.close()


def test_the_clock_of_older_cameras_counts_ticks(bus, body, clock):
    for name in ("TimestampLatch", "TimestampLatchValue"):
        del body.nodes[name]
    body.nodes["GevTimestampControlLatch"] = Node(do=body.latch)
    body.nodes["GevTimestampValue"] = Node(access=RO, read=lambda: body.latched_ns // 8)
    body.nodes["GevTimestampTickFrequency"] = Node(125_000_000, access=RO)
    camera = genicam.open_camera("B2")
    now = body.now_s()
    assert camera.clock_s() == pytest.approx(now, abs=1e-6)
    camera.arm(1, Trigger.EDGE)
    body.expose()
    del body.buffers[0].timestamp_ns

    class Ticks(SimpleNamespace):
        @property
        def timestamp_ns(self):
            raise error("NotAvailableException")

    body.buffers[0] = Ticks(**vars(body.buffers[0]), timestamp=round(125e6 * body.now_s()))
    stamp = body.now_s()
    assert camera.frame(1.0).t_start_s == pytest.approx(stamp, abs=1e-6)
    camera.close()


def test_frames_are_counted_from_arming_including_lost(camera, body):
    for _ in range(2):
        camera.arm(4, Trigger.EDGE)
        for _ in range(4):
            body.released_by("Line2")
        del body.buffers[1]  # of which bytes were lost
        assert [camera.frame(1.0).seq for _ in range(3)] == [0, 2, 3]


def test_sequence_frames_match_light_rows_by_camera_clock(camera, body, clock):
    """Twelve releases a second, as a light dome gives them; one frame is lost on its way."""
    camera.configure(WANT)
    offset = compare_clocks(camera, lambda: clock.now)
    assert offset.offset_s == pytest.approx(5000.0, abs=offset.uncertainty_s)
    camera.arm(6, Trigger.EDGE)
    times = {}
    for row in range(6):
        clock.now += 1.0 / 12.0
        times[row] = clock.now
        body.released_by("Line2")
    del body.buffers[2]
    stream = FrameStream(
        "cam",
        camera,
        row_times_s=times,
        dwell_s=1.0 / 12.0,
        clock=offset,
        want=WANT,
        lag_s=0.0,
        timeout_s=1.0,
    )
    frames = stream.read_until(5)
    assert {row: int(frame.image[0, 0]) for row, frame in frames.items()} == {
        row: 65 + row for row in (0, 1, 3, 4, 5)
    }
    assert (stream.stale, stream.refused) == (0, [])


def test_frames_of_before_arming_are_dropped(camera, body, clock):
    released(camera, body, Trigger.EDGE, clock)
    camera.arm(1, Trigger.EDGE)
    with pytest.raises(FrameTimeout):
        camera.frame(1.0)


def test_a_frame_of_before_the_trigger_is_stale(camera, body):
    camera.configure(WANT)
    camera.arm(1, Trigger.EDGE)
    before = camera.clock_s()
    body.expose(timestamp_ns=round(1e9 * (before - 0.5)))
    with pytest.raises((StaleFrame, FrameTimeout)):
        next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=1.0)


def test_producer_stamping_by_other_clock_is_reported(camera, body):
    camera.arm(1, Trigger.EDGE)
    body.ahead_s = 3600.0
    body.released_by("Line2")
    with pytest.raises(CameraError, match="another clock"):
        camera.frame(1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"payload_type": 10}, "multi-part"),
        ({"pixel_format": 0x02180014}, "0x02180014"),
        ({"width": 4}, "4 x 4 pixels"),
        ({"raw_buffer": bytes(47)}, "47 bytes, expected 48"),
    ],
)
def test_frame_of_wrong_format_is_refused_buffer_returned(camera, body, changes, message):
    camera.arm(2, Trigger.EDGE)
    body.expose(**changes)
    with pytest.raises(FrameRefused, match=message):
        camera.frame(1.0)
    assert len(body.requeued) == 1
    body.expose()
    assert camera.frame(1.0).image.shape == (4, 6)


def test_buffer_padding_and_offset_are_omitted(camera, body):
    camera.arm(1, Trigger.EDGE)
    lines = np.arange(24, dtype="<u2").reshape(4, 6)
    blob = b"header--" + b"".join(line.tobytes() + b"pad." for line in lines)
    body.expose(raw_buffer=blob, image_offset=8, padding_x=4)
    np.testing.assert_array_equal(camera.frame(1.0).image, lines)


def test_incomplete_frames_are_reported(camera, body):
    camera.arm(1, Trigger.EDGE)
    body.buffers.append(None)
    with pytest.raises(FrameTimeout, match="1 came with bytes missing"):
        camera.frame(1.0)


def test_unarmed_camera_gives_no_frame_and_is_unfired(camera):
    with pytest.raises(FrameTimeout, match="not armed"):
        camera.frame(1.0)
    with pytest.raises(CameraError, match="not armed"):
        camera.fire()
    camera.arm(1, Trigger.SOFTWARE)
    camera.fire()
    with pytest.raises(CameraError, match="not armed"):
        camera.fire()
    camera.abort()
    with pytest.raises(FrameTimeout, match="not armed"):
        camera.frame(1.0)


@pytest.mark.parametrize("trigger", [Trigger.LEVEL, Trigger.HAND])
def test_other_triggers_are_refused(camera, trigger):
    with pytest.raises(CameraError, match="cannot be triggered"):
        camera.arm(1, trigger)
    with pytest.raises(CameraError, match="count: got 0"):
        camera.arm(0, Trigger.EDGE)


def test_sequence_without_buffer_per_frame_is_refused(camera, body):
    """They are fetched when the sequence is over; one without a buffer would be lost."""
    camera.arm(300, Trigger.EDGE)
    assert body.announced == 301
    body.nodes["PayloadSize"]._value = 2**26
    with pytest.raises(CameraError, match=r"300 frames of 67\.1 MB.*packed"):
        camera.arm(300, Trigger.EDGE)
    assert not body.running
    camera.arm(40, Trigger.EDGE)
    assert body.announced == 41


def test_missing_camera_library_error_names_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "harvesters", None)  # as if it were not installed
    with pytest.raises(ImportError, match=r"skinrig\[genicam\]") as caught:
        open_camera("genicam:1234")
    assert isinstance(caught.value, CameraError)


def test_library_is_imported_only_by_genicam_address():
    code = (
        "import sys, capture.devices.cameras.genicam\n"
        "from capture.devices.camera import check_address\n"
        "check_address('genicam:1')\n"
        "print(sorted({'harvesters', 'genicam'} & set(sys.modules)))\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "[]\n"


def test_vanished_camera_is_lost_link_and_closable(bus, body):
    camera = genicam.open_camera("B2")
    camera.arm(1, Trigger.EDGE)
    body.gone = True
    with pytest.raises(LinkLost, match=r"genicam:B2.*cable"):
        camera.frame(1.0)
    body.gone = "transport"
    with pytest.raises(LinkLost, match="waiting for a frame"):
        camera.frame(1.0)
    camera.close()
    camera.close()


# finding it -----------------------------------------------------------------------------------


def test_cameras_of_producer_reuse_handle_and_last_closes(bus):
    first, second = genicam.open_camera("B2"), genicam.open_camera("C3")
    assert len(bus) == 1
    first.close()
    assert len(bus) == 1
    second.close()
    assert bus == []
    genicam.open_camera("B2").close()


def test_producer_identifier_is_accepted_as_address(bus):
    camera = genicam.open_camera("id-B2")
    assert camera.info.serial == "id-B2"
    camera.close()


def test_missing_camera_error_lists_available_cameras(bus):
    with pytest.raises(CameraUrlError, match=r"genicam:D4.*A1.*B2.*C3.*one\.cti, two\.cti"):
        genicam.open_camera("D4")


def test_a_camera_that_another_program_has_is_busy(bus, body):
    body.busy = True
    with pytest.raises(CameraBusy, match="other program"):
        genicam.open_camera("B2")


def test_missing_producer_error_lists_searched_locations(bus, tmp_path, monkeypatch):
    (tmp_path / "empty").mkdir()
    for given in ("empty", "none.cti"):
        with pytest.raises(CameraUrlError, match=rf"no GenTL producer.*{given}"):
            genicam.open_camera(f"B2?producer={tmp_path / given}")
    monkeypatch.delenv("GENICAM_GENTL64_PATH")
    with pytest.raises(CameraUrlError, match="GENICAM_GENTL64_PATH is not set"):
        genicam.open_camera("B2")


def test_a_camera_under_another_number_is_not_taken(bus, body):
    body.nodes["DeviceSerialNumber"] = Node("Z9", access=RO)
    with pytest.raises(WrongCamera, match="Z9"):
        genicam.open_camera("B2")
    assert not body.open


def without(*names):
    return lambda nodes: [nodes.pop(name) for name in names]


def having(**changed):
    return lambda nodes: nodes.update(changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("ExposureTime"), "ExposureTime"),
        (without("TimestampLatch"), "clock"),
        (without("TriggerSource"), "no trigger"),
        (without("BlackLevel"), "black=DN"),
        (having(BlackLevel=Node(2.0, unit="%")), "black=DN"),
        (having(BlackLevel=Node(4095.0, unit="DN")), "4095 DN"),
        (having(PixelFormat=Node("RGB8", choices=["RGB8"])), "no raw one.*RGB8"),
        (having(Width=Node(5)), "5 x 4"),
        (having(GammaEnable=Node(True, access=RO)), "GammaEnable.*cannot be set"),
        (having(BalanceRatio=Node(2.0, low=2.0, high=4.0)), "BalanceRatio of Red: got 2"),
    ],
)
def test_camera_with_unreliable_frames_is_refused_and_released(bus, body, change, message):
    change(body.nodes)
    with pytest.raises(CameraError, match=rf"genicam:B2.*{message}"):
        genicam.open_camera("B2")
    assert not body.open


@pytest.mark.parametrize(
    "rest",
    [
        "",
        "?black=3",
        "B2?format=RGB8",
        "B2?format=",
        "B2?iso=0",
        "B2?iso=x",
        "B2?black=nan",
        "B2?black=-1",
        "B2?gain=3",
        "B2?line",
        "B2?line=Line1&line=Line2",
    ],
)
def test_address_of_other_form_is_refused(rest):
    with pytest.raises(CameraUrlError, match="expected genicam:SERIAL"):
        genicam.parse_address(rest)


def test_missing_format_or_line_error_lists_available(bus):
    with pytest.raises(CameraError, match=r"Mono12p.*BayerRG12"):
        genicam.open_camera("B2?format=Mono12p")
    with pytest.raises(CameraUrlError, match=r"Line9.*Software, Line1, Line2"):
        genicam.open_camera("B2?line=Line9")


def test_every_library_error_is_camera_error():
    library = genicam_producer.GenicamLibrary(None, (GenericError,))
    kinds = {
        "AccessException": CameraError,
        "ResourceInUseException": CameraBusy,
        "AccessDeniedException": CameraBusy,
        "IoException": LinkLost,
        "TimeoutException": LinkLost,
        "GenericException": LinkLost,
    }
    for (name, kind), doing in itertools.product(kinds.items(), ["a", "b"]):
        with pytest.raises(kind, match=doing), library.translate_errors(doing):
            raise error(name)
