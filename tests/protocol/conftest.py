"""Worlds, and the same box and camera behind every transport."""

import contextlib
import dataclasses
import itertools
import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import serial
from fixtures.compiled.sides import choose_side, leave_real_lines_to_one_side, on_both_sides
from fixtures.quick_close import quick_close
from fixtures.scripted_line import open_port
from serial import rfc2217

from capture.devices.camera import open_camera
from capture.devices.flash import FlashBox
from capture.devices.port import Port
from capture.rig import load_rig
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.rig_boxes import BOXES
from rigsim.world.serve import serve_world

__all__ = ["open_port", "quick_close"]
NAMES = (f"protocol-{number}" for number in itertools.count())

EMULATED_ONLY = {
    "test_controller_of_other_kind_is_refused": "renames the emulated class",
    "test_invalid_answer_is_reported": "lets the emulated box lie",
    "test_an_answer_that_makes_no_sense_is_named": "lets the emulated box lie",
    "test_host_and_controller_spell_rows_identically": "reads the emulated table",
    "test_heat_and_dose_limits_match_other_led_controllers": "sets the emulated dose",
    "test_led_dose_accumulates_and_its_limit_applies": "sets the emulated dose",
    "test_overheated_led_goes_out_despite_all_limits": "leaves the emulated limits out",
    "test_subject_dose_is_counted_and_limited": "sets the emulated dose",
    "test_another_table_than_was_sent_is_noticed": "exchanges the emulated checksum",
    "test_analyzer_that_never_arrives_is_abandoned": "holds the emulated analyzer",
    "test_a_caliper_that_never_arrives_is_given_up": "holds the emulated jaws",
    "test_a_cover_that_never_arrives_is_given_up": "holds the emulated cover",
    "test_slow_judgment_is_awaited_with_retries": "delays the emulated judgment",
    "test_slow_judgment_is_answered_late_and_once": "delays the emulated judgment",
    "test_dark_ends_a_slow_judgment": "delays the emulated judgment",
    "test_charge_falls_by_power_recovers_within_recycle_time": "reads the emulated capacitor",
}
"""Tests that exchange parts of the emulation, with what they exchange."""


def pytest_generate_tests(metafunc):
    on_both_sides(
        metafunc,
        quick=("test_box_manuals.py", "test_flash_box.py"),
        long=(
            *("test_box_fuzz.py", "test_boxes_side_by_side.py", "test_flash_sequence.py"),
            *(f"test_{kind}_box.py" for kind in BOXES if kind != "flash"),
            *(f"test_{kind}_driver.py" for kind in BOXES),
        ),
    )


def pytest_collection_modifyitems(config, items):
    leave_real_lines_to_one_side(config, items)


@pytest.fixture(autouse=True)
def box_side(request, monkeypatch):
    return choose_side(request, monkeypatch, EMULATED_ONLY)


class Photometer:
    """A scene whose every pixel tells how much light popped while the shutter was open."""

    def __init__(self, rig):
        self.rig = rig

    def exposure(self, view_name, *, pops, exposure_s, seed):
        view = self.rig.view(view_name)
        level = view.black_level + round(10_000 * sum(pop.power for pop in pops))
        return np.full((view.height_px, view.width_px), level, np.uint16)


def quick_rig():
    """The flash rig, small, with a camera that reads out in 50 ms."""
    rig = load_rig("flash").resized(16)
    view = dataclasses.replace(rig.views[0], readout_s=0.05)
    return dataclasses.replace(rig, views=(view,), polarizer_move_s=0.1)


@pytest.fixture
def rig():
    return quick_rig()


class Gateway:
    """A serial port handed on over RFC 2217, as terminal servers do, by pyserial's server half."""

    def __init__(self, url):
        self.port = serial.serial_for_url(url, timeout=0.005)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"rfc2217://127.0.0.1:{self.listener.getsockname()[1]}"
        self.closing = threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self):
        while not self.closing.is_set():
            with contextlib.suppress(OSError):
                client, _ = self.listener.accept()
                with client:
                    self.serve(client)

    def serve(self, client):
        client.settimeout(0.002)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        lock = threading.Lock()

        def write(data):
            with lock:
                client.sendall(data)

        telnet = rfc2217.PortManager(self.port, SimpleNamespace(write=write))
        while not self.closing.is_set():
            with contextlib.suppress(TimeoutError):
                data = client.recv(4096)
                if not data:
                    return
                self.port.write(b"".join(telnet.filter(data)))
            waiting = self.port.read(4096)
            if waiting:
                write(b"".join(telnet.escape(waiting)))

    def close(self):
        self.closing.set()
        with contextlib.suppress(OSError):
            socket.create_connection(self.listener.getsockname()).close()
        self.thread.join(5.0)
        self.listener.close()
        self.port.close()


RFC2217 = pytest.param(
    "rfc2217",
    marks=[
        pytest.mark.long,
        # pyserial's own client
        pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning"),
    ],
)


@pytest.fixture(params=["sim", "pty", "tcp", RFC2217])
def bench(request, rig):
    """A world with a box and a camera behind one transport; closes what it opened."""
    if request.param == "sim":
        world = World(rig, seed=5, scene=Photometer(rig))
        name = world.register(next(NAMES))
        addresses = {"flash": f"sim://flash?world={name}", "cam": f"sim://{name}/cam"}
        yield from _bench(world, addresses, request.param)
        world.unregister()
        return
    world = World(rig, seed=5, clock="real", scene=Photometer(rig), faults=Faults(baud=0.0))
    with serve_world(rig, world=world, pty=request.param == "pty") as served:
        if request.param == "rfc2217":
            with contextlib.closing(Gateway(served.addresses["flash"])) as gateway:
                addresses = {**served.addresses, "flash": gateway.address}
                yield from _bench(world, addresses, request.param)
            return
        yield from _bench(world, served.addresses, request.param)


def _bench(world, addresses, transport):
    opened = []

    def box(**settings):
        opened.append(FlashBox(Port(addresses["flash"], clock=_clock(world)), **settings))
        return opened[-1]

    def camera():
        opened.append(open_camera(addresses["cam"]))
        return opened[-1]

    yield SimpleNamespace(
        world=world, addresses=addresses, transport=transport, box=box, camera=camera
    )
    for device in opened:
        device.close()


def _clock(world):
    return world.clock if world.virtual else None
