"""Conformance of every camera, over sim:// and over TCP."""

import dataclasses
import socket
import sys
import threading

import numpy as np
import pytest

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
    WrongExposure,
    check_frame,
    next_frame,
    open_camera,
)
from capture.devices.cameras import camera_wire
from capture.devices.cameras.remote_camera import RemoteCamera
from capture.devices.port import LinkLost
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.serve import serve_world

WANT = Exposure(0.008, 100)
LIT, DARK = 10_512, 512


def pop(box, token="a"):
    box.wait_charged(5.0)
    box.arm()
    return box.fire(token)


def test_camera_reports_its_identity(bench):
    info = bench.camera().info
    view = bench.world.rig.view("cam")
    assert (info.serial, info.model) == (view.serial, view.camera_model)
    assert (info.width_px, info.height_px, info.pattern) == (16, 10, "RGGB")
    assert (info.black, info.white) == ((512.0,) * 4, 16383)
    assert set(info.triggers) == {Trigger.SOFTWARE, Trigger.EDGE}


def test_edge_trigger_exposes_with_its_pop_light(bench):
    camera, box = bench.camera(), bench.box()
    assert camera.configure(WANT) == WANT
    camera.arm(1, Trigger.EDGE)
    before = camera.clock_s()
    pop(box)
    frame, stale = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=5.0)
    assert stale == 0
    assert frame.image.dtype == np.uint16
    np.testing.assert_array_equal(frame.image, np.full((10, 16), LIT))
    assert frame.t_end_s - frame.t_start_s == pytest.approx(0.008)
    assert before <= frame.t_start_s <= camera.clock_s()


def test_a_software_trigger_without_a_pop_is_dark(bench):
    camera = bench.camera()
    camera.configure(WANT)
    camera.arm(1, Trigger.SOFTWARE)
    before = camera.clock_s()
    camera.fire()
    frame, _ = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=5.0)
    np.testing.assert_array_equal(frame.image, np.full((10, 16), DARK))


def test_controller_dark_trigger_exposes_without_light(bench):
    camera, box = bench.camera(), bench.box()
    camera.configure(WANT)
    camera.arm(1, Trigger.EDGE)
    box.trigger_cameras("d")
    assert camera.frame(5.0).image.max() == DARK


def test_pop_before_shutter_opens_is_not_recorded(bench):
    camera, box = bench.camera(), bench.box()
    pop(box)
    camera.configure(WANT)
    camera.arm(1, Trigger.SOFTWARE)
    camera.fire()
    assert camera.frame(5.0).image.max() == DARK


@pytest.mark.parametrize("delay_s", [0.0, 0.020, 0.030, 0.034, 0.045])
def test_lagging_shutter_records_the_delayed_pop(bench, delay_s):
    """The shutter is open from 30 to 38 ms after the edge: earlier and later pops are missed."""
    view = dataclasses.replace(bench.world.rig.views[0], shutter_lag_s=0.030)
    camera, box = bench.camera(), bench.box()
    bench.world.camera("cam").view = view
    box.set_sync_delay(delay_s)
    assert box.sync_delay_s() == pytest.approx(delay_s)
    camera.configure(WANT)
    camera.arm(1, Trigger.EDGE)
    before = camera.clock_s()
    report = pop(box)
    frame, _ = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=5.0)
    assert frame.image.max() == (LIT if 0.030 <= delay_s <= 0.038 else DARK)
    assert report.count == 1


def test_frames_are_counted_from_arming(bench):
    camera = bench.camera()
    camera.configure(WANT)
    for _ in range(2):
        camera.arm(2, Trigger.SOFTWARE)
        for seq in range(2):
            camera.fire()
            assert camera.frame(5.0).seq == seq


def test_without_a_trigger_no_frame_comes(bench):
    camera, box = bench.camera(), bench.box()
    with pytest.raises(FrameTimeout):
        camera.frame(0.05)
    camera.arm(1, Trigger.SOFTWARE)
    pop(box)  # an edge is no software trigger
    with pytest.raises(FrameTimeout):
        camera.frame(0.05)


def test_an_aborted_frame_never_comes(bench):
    camera = bench.camera()
    camera.configure(WANT)
    camera.arm(1, Trigger.SOFTWARE)
    camera.fire()
    camera.abort()
    with pytest.raises(FrameTimeout):
        camera.frame(0.2)


def test_unarmed_or_reading_camera_is_not_fired(bench):
    camera = bench.camera()
    with pytest.raises(CameraError, match="not armed"):
        camera.fire()
    camera.configure(Exposure(0.2, 100))
    camera.arm(2, Trigger.SOFTWARE)
    camera.fire()
    with pytest.raises(CameraError, match="reading out"):
        camera.fire()
    camera.arm(1, Trigger.EDGE)
    with pytest.raises(CameraError, match="not armed for software"):
        camera.fire()


def test_camera_sets_nearest_available_exposure(bench):
    assert bench.camera().configure(Exposure(100.0, 1)) == Exposure(30.0, 50)


@pytest.mark.parametrize(("count", "trigger"), [(0, Trigger.EDGE), (1, Trigger.LEVEL)])
def test_camera_refuses_unsupported_arming(bench, count, trigger):
    with pytest.raises(CameraError):
        bench.camera().arm(count, trigger)


# faults of cameras ----------------------------------------------------------------------------


@pytest.fixture
def faulty(rig):
    """A camera on a virtual clock with faults; every frame is asked for and checked."""
    worlds = []

    def camera(**faults):
        world = World(rig, seed=len(worlds), faults=Faults(**faults))
        worlds.append(world)
        world.register(f"faulty-{len(worlds)}")
        return open_camera(f"sim://faulty-{len(worlds)}/cam")

    yield camera
    for world in worlds:
        world.unregister()


def shoot(camera):
    camera.configure(WANT)
    camera.arm(1, Trigger.SOFTWARE)
    before = camera.clock_s()
    camera.fire()
    return before


def test_a_stale_frame_is_noticed_by_its_time(faulty):
    camera = faulty(stale=1.0)
    first, dropped = next_frame(camera, seq=0, not_before_s=shoot(camera), want=WANT, timeout_s=1.0)
    assert dropped == 0
    second, dropped = next_frame(
        camera, seq=0, not_before_s=shoot(camera), want=WANT, timeout_s=1.0
    )
    assert dropped == 1
    assert second.t_start_s > first.t_end_s


def test_late_frame_is_refused_after_next_trigger(faulty):
    """It was exposed before the trigger, although its number is the requested one."""
    camera = faulty(late_frame=1.0, late_frame_s=2.0)
    with pytest.raises(FrameTimeout):
        next_frame(camera, seq=0, not_before_s=shoot(camera), want=WANT, timeout_s=0.01)
    camera.world.clock.sleep(3.0)
    before = shoot(camera)
    frame, dropped = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=5.0)
    assert dropped == 1
    assert frame.t_start_s >= before


def test_frame_that_comes_twice_is_taken_once(faulty):
    camera = faulty(repeat_frame=1.0, late_frame_s=0.5)
    kept = []
    for number in range(5):
        before = shoot(camera)
        frame, dropped = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=1.0)
        assert dropped == (number > 0)
        assert frame.t_start_s >= before
        kept.append(frame.t_start_s)
        camera.world.clock.sleep(1.0)
    assert len(set(kept)) == 5


def test_a_lost_frame_is_a_timeout(faulty):
    camera = faulty(drop_frame=1.0)
    with pytest.raises(FrameTimeout):
        next_frame(camera, seq=0, not_before_s=shoot(camera), want=WANT, timeout_s=1.0)


@pytest.mark.parametrize(
    ("fault", "error"), [("wrong_camera", WrongCamera), ("wrong_exposure", WrongExposure)]
)
def test_a_foreign_or_wrongly_exposed_frame_is_refused(faulty, fault, error):
    camera = faulty(**{fault: 1.0})
    with pytest.raises(error):
        next_frame(camera, seq=0, not_before_s=shoot(camera), want=WANT, timeout_s=1.0)


@pytest.mark.parametrize("drift_ppm", [-500.0, 500.0])
def test_clock_drift_still_detects_stale_accepts_good_frames(faulty, drift_ppm):
    camera = faulty(drift_ppm=drift_ppm)
    camera.world.clock.sleep(3600.0)
    kept = []
    for _ in range(5):
        before = shoot(camera)
        frame, dropped = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=1.0)
        assert dropped == 0
        kept.append(frame)
    with pytest.raises(StaleFrame):
        check_frame(kept[-2], camera.info, seq=0, not_before_s=before, want=WANT)


def test_two_hundred_exposures_accept_only_good_frames(faulty):
    late = {"late_frame": 0.2, "repeat_frame": 0.2, "late_frame_s": 3.0}
    camera = faulty(stale=0.3, drop_frame=0.2, wrong_camera=0.2, wrong_exposure=0.2, **late)
    accepted = refused = 0
    for _ in range(200):
        before = shoot(camera)
        try:
            frame, _ = next_frame(camera, seq=0, not_before_s=before, want=WANT, timeout_s=1.0)
        except (FrameRefused, FrameTimeout):
            refused += 1
            camera.abort()
            camera.world.clock.sleep(0.1)
            continue
        accepted += 1
        assert frame.serial == camera.info.serial
        assert frame.t_start_s >= before
        assert frame.exposure == WANT
    assert accepted + refused == 200
    assert refused > 50


# addresses ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        "sim://nowhere/cam",
        "sim://nowhere",
        "sim:///cam",
        "tcp://127.0.0.1/cam",
        "tcp://:1/cam",
        "tcp://127.0.0.1:0/cam",
        "tcp://127.0.0.1:99999/cam",
        "tcp://127.0.0.1:80",
    ],
)
def test_an_address_of_no_camera_is_named(url):
    with pytest.raises(CameraUrlError, match="expected"):
        open_camera(url)


def test_unknown_view_of_world_is_reported(rig):
    world = World(rig)
    world.register("conformance-views")
    with pytest.raises(CameraUrlError, match="no view 'cma'"):
        open_camera("sim://conformance-views/cma")
    world.unregister()


# over TCP -------------------------------------------------------------------------------------


def test_served_camera_has_single_client_and_known_views(rig):
    with serve_world(rig) as served:
        url = served.addresses["cam"]
        camera = open_camera(url)
        with pytest.raises(CameraBusy, match="another program"):
            open_camera(url)
        with pytest.raises(CameraError, match="expected one of cam"):
            open_camera(url.replace("/cam", "/cma"))
        camera.close()
        camera.close()


def test_nobody_listening_is_a_lost_link():
    with socket.socket() as taken:  # nobody else can listen there meanwhile
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(LinkLost, match="is it being served"):
            open_camera(f"tcp://127.0.0.1:{taken.getsockname()[1]}/cam")


def test_vanished_server_is_lost_link(rig):
    with serve_world(rig) as served:
        camera = open_camera(served.addresses["cam"])
    with pytest.raises(LinkLost):
        camera.clock_s()
    with pytest.raises(LinkLost, match="closed"):
        camera.clock_s()
    camera.close()


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"\n",
        b"x" * 70_000,
        b"[]*0A50\n",
        b'{"id":1,"do":"clock"}*0000\n',
    ],
)
def test_garbage_ends_own_connection_but_not_service(rig, garbage):
    with serve_world(rig) as served:
        host, _, port = served.addresses["cam"][6:].partition("/")[0].rpartition(":")
        with socket.create_connection((host, int(port)), timeout=5.0) as connection:
            connection.sendall(garbage)
            try:
                assert connection.recv(10) == b""
            except ConnectionResetError:
                pass
        open_camera(served.addresses["cam"]).close()


@pytest.mark.parametrize(
    "request_",
    [
        {"do": "frame"},
        {"do": "dance"},
        {},
        {"do": "arm", "count": "x", "trigger": "edge"},
        {"do": "arm", "count": 1, "trigger": "sneeze"},
        {"do": "configure", "exposure_s": -1, "iso": 1},
    ],
)
def test_invalid_request_is_answered_with_error(rig, request_):
    with serve_world(rig) as served:
        camera = open_camera(served.addresses["cam"])
        with pytest.raises(CameraError):
            camera._ask(request_.pop("do", "?"), **request_)
        assert camera.clock_s() >= 0.0
        camera.close()


FRAME = {
    "serial": "S",
    "seq": 0,
    "t_start_s": 1.0,
    "t_end_s": 1.1,
    "exposure_s": 0.1,
    "iso": 100,
    "light": {},
    "shape": [2, 4],
}


class Impostor:
    """A server that opens like a camera and then plays one answer."""

    def __init__(self, answer):
        info = {
            "serial": "S",
            "model": "M",
            "width_px": 4,
            "height_px": 2,
            "pattern": "MONO",
            "black": [0],
            "white": 255,
            "triggers": ["edge"],
        }
        self.server = socket.create_server(("127.0.0.1", 0))
        self.replies = [camera_wire.encode_message({"id": 1, "ok": True, "info": info}), answer]
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self):
        client, _ = self.server.accept()
        self.server.close()  # nobody connects again
        with client:
            for reply in self.replies:
                client.recv(4096)
                client.sendall(reply)

    def camera(self):
        return RemoteCamera(*self.server.getsockname(), "cam")

    def close(self):
        self.thread.join(5.0)
        self.server.close()


@pytest.fixture
def impostor():
    made = []

    def impostor(answer):
        made.append(Impostor(answer))
        return made[-1].camera()

    yield impostor
    for one in made:
        one.close()


def frame_answer(**changes):
    pixels = np.arange(8, dtype="<u2").tobytes()
    message = camera_wire.encode_message(
        {"id": 2, "ok": True, "frame": {**FRAME, **changes}}, pixels
    )
    return message, pixels


def test_frame_arrives_as_sent(impostor):
    message, _ = frame_answer(light={"lamp": "left"})
    busy = camera_wire.encode_message({"id": 2, "developing": True})
    camera = impostor(busy + message)
    frame = camera.frame(1.0)
    np.testing.assert_array_equal(frame.image, np.arange(8).reshape(2, 4))
    assert (frame.light, frame.serial) == ({"lamp": "left"}, "S")
    camera.close()


def test_a_flipped_pixel_is_a_refused_frame(impostor):
    message, pixels = frame_answer()
    camera = impostor(message.removesuffix(pixels) + b"\x01" + pixels[1:])
    with pytest.raises(FrameRefused, match="damaged"):
        camera.frame(1.0)
    camera.close()


@pytest.mark.parametrize(
    "changes", [{"shape": [3, 4]}, {"seq": "x"}, {"exposure_s": 0.0}, {"shape": [-2, -4]}]
)
def test_a_frame_that_contradicts_itself_is_refused(impostor, changes):
    camera = impostor(frame_answer(**changes)[0])
    with pytest.raises(FrameRefused):
        camera.frame(1.0)
    camera.close()


@pytest.mark.parametrize(
    "answer",
    [
        b"hello\n",
        b"x" * 70_000,
        b"",
        b'{"id":2,"ok":true}*0000\n',
        camera_wire.encode_message({"id": 2, "ok": True, "blob_bytes": -1}),
    ],
)
def test_answer_without_message_is_lost_link(impostor, answer):
    camera = impostor(answer)
    with pytest.raises(LinkLost):
        camera.clock_s()
    camera.close()


def test_an_answer_without_its_value_is_an_error(impostor):
    camera = impostor(camera_wire.encode_message({"id": 2, "ok": True}))
    with pytest.raises(CameraError, match="cannot be decoded"):
        camera.clock_s()


def test_every_flipped_bit_of_a_header_is_noticed():
    line = camera_wire.encode_message({"id": 3, "do": "arm", "count": 1})[:-1]
    for bit in range(8 * len(line)):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(camera_wire.BadMessage):
            camera_wire.decode_header(bytes(flipped))


def test_real_camera_full_frame_fits_message():
    view = load_rig("flash").view("cam")
    assert 2 * view.width_px * view.height_px < camera_wire.MAX_BLOB_BYTES


def test_missing_camera_library_error_names_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gphoto2", None)  # as if it were not installed
    with pytest.raises(ImportError, match=r"skinrig\[gphoto\]") as caught:
        open_camera("gphoto2:1234")
    assert isinstance(caught.value, CameraError)
