"""Bits flipped on the way to a camera and back: the connection is made again, the step retaken."""

import contextlib
import dataclasses
import itertools
import socket
import threading
from types import SimpleNamespace

import pytest
from fixtures.operators import by_operator

from capture.acquire import run_plan
from capture.devices.camera import Exposure, FrameRefused, Trigger, open_camera
from capture.devices.cameras import remote_camera
from capture.devices.flash import FlashBox
from capture.devices.port import LinkLost, Port
from capture.session import Session, SubjectRecord, verify
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.camera_service import CameraService
from skinrig.errors import EXIT_DEVICE_FAILED, exit_code
from skinrig.soaking.witnesses import FlashWitness

NAMES = (f"camera-link-{number}" for number in itertools.count())
READOUT_S = 6.0


@pytest.fixture(autouse=True)
def box_side():
    """Leave the boxes emulated: the camera's link is under test."""


class FlippingProxy:
    """A proxy of a TCP server; it flips a bit of chosen messages, counted over all connections.

    A message begins with the brace of its header; its data may come later, and do not count.
    """

    def __init__(self, port, way, struck):
        self.target, self.way, self.struck = port, way, set(struck)
        self.count = 0
        self.ends, self.threads = [], []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.start(self.accept)

    def start(self, target, *arguments):
        self.threads.append(threading.Thread(target=target, args=arguments, daemon=True))
        self.threads[-1].start()

    def close(self):
        with contextlib.suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        self.end(*self.ends)
        for thread in self.threads:
            thread.join(5.0)
        for connection in self.ends:
            connection.close()

    @staticmethod
    def end(*connections):
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def accept(self):
        with contextlib.suppress(OSError):
            while True:
                near, _ = self.listener.accept()
                far = socket.create_connection(("127.0.0.1", self.target))
                self.ends += [near, far]
                self.start(self.pump, "request", near, far)
                self.start(self.pump, "answer", far, near)

    def pump(self, way, source, sink):
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                if way == self.way and data.startswith(b"{"):
                    self.count += 1
                    if self.count in self.struck:
                        data = bytes([data[0] ^ 1]) + data[1:]
                sink.sendall(data)
        self.end(source, sink)


@pytest.fixture
def flash_session(tmp_path, monkeypatch):
    """Return a function that captures flashes through a proxy; results: run, session, proxy."""
    with contextlib.ExitStack() as opened:

        def capture(way, struck):
            scene = FlashWitness()
            world = World(scene.rig, seed=1, scene=scene, faults=Faults(baud=0.0))
            name = world.register(next(NAMES))
            opened.callback(world.unregister)
            # the camera reads out on the world's clock while the host waits for it
            monkeypatch.setattr(remote_camera, "sleep", world.clock.sleep)
            monkeypatch.setattr(remote_camera, "RECONNECTION_PAUSE_S", READOUT_S)
            service = CameraService(world, "127.0.0.1", 0)
            opened.callback(service.close)
            view = scene.rig.views[0].name
            port = int(service.addresses[view].rpartition(":")[2].partition("/")[0])
            proxy = FlippingProxy(port, way, struck)
            opened.callback(proxy.close)
            camera = open_camera(f"tcp://127.0.0.1:{proxy.port}/{view}")
            opened.callback(camera.close)
            box = FlashBox(Port(f"sim://flash?world={name}", clock=world.clock, first_seq=1))
            opened.callback(box.close)
            plan = scene.plan(world.rng_for("plan"))
            words = {"devices": {}, "subject": SubjectRecord("p"), "source": "simulated"}
            session = Session.create(tmp_path / "s", plan=plan, rig=scene.rig, **words)
            opened.callback(session.release)
            devices = {"boxes": {"flash": box}, "cameras": {view: camera}}
            done = run_plan(plan, scene.rig, **devices, session=session, **by_operator({}))
            return done, session, proxy

        yield capture


@pytest.fixture
def link(monkeypatch):
    """A camera behind a proxy, and a function that ends its connection."""
    with contextlib.ExitStack() as opened:
        scene = FlashWitness()
        world = World(scene.rig, seed=1, scene=scene, faults=Faults(baud=0.0))
        monkeypatch.setattr(remote_camera, "sleep", world.clock.sleep)
        monkeypatch.setattr(remote_camera, "RECONNECTION_PAUSE_S", READOUT_S)
        service = CameraService(world, "127.0.0.1", 0)
        opened.callback(service.close)
        address = service.addresses[scene.rig.views[0].name]
        _, _, rest = address.rpartition(":")
        port, _, view = rest.partition("/")
        proxy = FlippingProxy(int(port), "request", ())
        opened.callback(proxy.close)
        camera = open_camera(f"tcp://127.0.0.1:{proxy.port}/{view}")
        opened.callback(camera.close)
        yield camera, lambda: proxy.end(*proxy.ends)


WANTED = Exposure(0.01, 100)


def test_reconnection_to_another_camera_is_refused(link, monkeypatch):
    camera, cut = link
    camera.clock_s()
    cut()
    camera.clock_s()  # the same camera
    camera._is_reconnected = False
    cut()
    decode = remote_camera.camera_wire.info_from_json
    changed = SimpleNamespace(
        **{
            **vars(remote_camera.camera_wire),
            "info_from_json": lambda table: dataclasses.replace(decode(table), serial="other"),
        }
    )
    monkeypatch.setattr(remote_camera, "camera_wire", changed)
    with pytest.raises(LinkLost, match="another camera answered") as lost:
        camera.clock_s()
    assert exit_code(lost.value) == EXIT_DEVICE_FAILED
    assert camera.info.serial != "other"


@pytest.mark.parametrize("is_fetched", [True, False])
def test_link_lost_after_last_frame_costs_nothing(link, is_fetched):
    camera, cut = link
    camera.configure(WANTED)
    camera.arm(1, Trigger.SOFTWARE)
    camera.fire()
    if is_fetched:
        camera.frame(5.0)
    cut()
    with contextlib.nullcontext() if is_fetched else pytest.raises(FrameRefused):
        camera.configure(WANTED)


def check_frames(session):
    for record in session.frames():
        cfa = session.read(record).cfa
        assert FlashWitness().find_deviation(record.step, cfa, record.actual) == ""


@pytest.mark.parametrize("way", ["request", "answer"])
@pytest.mark.parametrize("struck", [(3,), (5,), (6,), (7,), (8, 16, 25)], ids=str)
def test_flipped_bit_costs_one_retake_at_most(flash_session, way, struck):
    done, session, proxy = flash_session(way, struck)
    assert proxy.count > max(struck)
    assert session.pending_frames() == []
    assert done.retakes <= len(struck)
    check_frames(session)
    session.close()
    assert verify(session.path).ok


def test_link_lost_twice_without_frame_ends_capture(flash_session):
    with pytest.raises(LinkLost, match="lost in") as lost:
        flash_session("request", range(3, 60))
    assert exit_code(lost.value) == EXIT_DEVICE_FAILED


def test_capture_without_second_connection_is_lost(flash_session, monkeypatch):
    def give_up(camera, lost):
        raise lost

    monkeypatch.setattr(remote_camera.RemoteCamera, "_reconnect", give_up)
    with pytest.raises(LinkLost):
        flash_session("answer", (5,))
