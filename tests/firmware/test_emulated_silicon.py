"""The images run: every check of hardware, on a process, an ATmega2560 and two Cortex-M."""

import contextlib
import dataclasses

import numpy as np
import pytest
from fixtures.compiled.targets import TARGETS, start_target

from capture.acquire import run_plan
from capture.devices.camera import open_camera
from capture.devices.checkup import CONTROLLER_CHECKS, CheckupPort
from capture.devices.flash import FlashBox
from capture.devices.port import CommandRefused, Port
from capture.devices.wire import Code
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from rigsim.boxes.faults import Faults
from rigsim.boxes.flash import FlashPop
from rigsim.world import World

# pyserial leaves ports to the collector
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
BOARDS = [(board, box) for board, (boxes, _) in TARGETS.items() for box in boxes]
LEASE_S = 0.3
CYCLES_SLACK_S = 2e-3
DARK_SLACK_S = 0.010
BUSY_SLACK_S = 0.1


@pytest.fixture(scope="module", params=BOARDS, ids=lambda pair: "-".join(pair))
def running(request):
    target = start_target(*request.param)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        hello = port.hello()
        assert hello.kind == request.param[1]
        yield target, port


@pytest.mark.parametrize("check", CONTROLLER_CHECKS)
def test_image_passes_check_of_hardware(running, check):
    _, port = running
    port.hello()
    assert CONTROLLER_CHECKS[check](port)


@pytest.fixture(params=["posix", "mega2560", "mps2-an385"])
def flash(request):
    target = start_target(request.param, "flash")
    names = {"mega2560": {"camera": "A0", "pop": "A1", "led0": "A3"}}
    names = names.get(request.param, {})
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        yield target, port, lambda pin: names.get(pin, pin)


def rises(target, pin):
    return [edge for edge in target.of_pin(pin) if edge.value > 0.0]


def test_each_shot_is_one_camera_edge_and_pop(flash):
    target, port, pin = flash
    port.ask("FLAS:POW 0.01")
    port.ask("FLAS:SYNC 20000")
    for shot in range(4):
        port.ask("SYST:ARM")
        port.ask(f"FLAS:FIRE shot.{shot}")
        port.listen(0.05)
    port.ask("SAFE")
    with pytest.raises(CommandRefused) as caught:
        port.ask("FLAS:FIRE unarmed")
    assert caught.value.code == Code.NOT_ARMED
    target.wait_for(lambda: len(rises(target, pin("pop"))) >= 4)
    cameras, pops = rises(target, pin("camera")), rises(target, pin("pop"))
    assert (len(cameras), len(pops)) == (4, 4)
    delays_s = [b.t_s - a.t_s for a, b in zip(cameras, pops, strict=True)]
    # simavr counts cycles; a process, and QEMU, have the time that this machine gives them
    late_s = CYCLES_SLACK_S if target.board == "mega2560" else BUSY_SLACK_S
    assert all(0.02 - 1e-4 <= delay_s <= 0.02 + late_s for delay_s in delays_s)


def test_killed_host_leaves_lamp_dark_within_lease(flash):
    target, port, pin = flash
    light = pin("led0")
    port.ask(f"SYST:WDOG {round(1e3 * LEASE_S)}")
    port.ask("SYST:ARM")
    port.ask("FLAS:LAMP ON,500")
    target.wait_for(lambda: rises(target, light))
    lit_s = rises(target, light)[-1].t_s
    port.close()  # the host dies here
    target.wait_for(lambda: [e for e in target.of_pin(light) if e.value == 0.0 and e.t_s > lit_s])
    dark_s = next(e.t_s for e in target.of_pin(light) if e.value == 0.0 and e.t_s > lit_s)
    # the lease counts from the command, which the lamp follows
    slack_s = DARK_SLACK_S if target.board == "mega2560" else BUSY_SLACK_S
    assert dark_s - lit_s < LEASE_S + slack_s


def test_dome_steps_release_cameras_once_a_row():
    target = start_target("mps2-an500", "dome")
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        rows = 12
        port.ask("SAFE:EYES CLOSED")
        port.ask("SEQ:DEF 0," + ";".join(f"{led}:1000:40000:7" for led in range(rows)))
        port.ask("SYST:ARM")
        port.ask(f"SEQ:ARM {rows}")
        port.ask("TRIG t1")
        port.listen(0.04 * rows + 0.2)
        assert port.ask("SEQ:POS?") == f"DONE,{rows - 1},{rows},t1"
        cameras = target.of_pin("camera")
        assert len(cameras) == rows
        for led in range(rows):
            on, off = target.of_pin(f"led{led}", 1.0), target.of_pin(f"led{led}", 0.0)
            assert (len(on), len(off)) == (1, 1)
            assert 0.035 < off[0].t_s - on[0].t_s < 0.04 + BUSY_SLACK_S


class Photometer:
    """A scene whose every pixel counts the pops while the shutter was open."""

    def exposure(self, view_name, *, pops, exposure_s, seed):
        return np.full((10, 16), 512 + 1000 * len(pops), np.uint16)


class PinnedWorld:
    """A world whose cameras and light are those of a target's pins."""

    def __init__(self, rig, target, camera_pin, pop_pin):
        self.world = World(rig, clock="real", scene=Photometer(), faults=Faults(baud=0.0))
        self.name = self.world.register(f"pins-{target.board}")
        self._pins = {camera_pin: self._release, pop_pin: self._pop}
        self._camera_pin = camera_pin
        self._offset_s = 0.0
        target.on_edge = self._follow

    def _follow(self, edge):
        if edge.value > 0.0 and edge.pin in self._pins:
            with self.world.lock:
                # a shot begins when its camera edge is read; its pop keeps its distance to that
                if edge.pin == self._camera_pin:
                    self._offset_s = self.world.now - edge.t_s
                self._pins[edge.pin](edge.t_s + self._offset_s)

    def _release(self, now):
        self.world._trigger(now)

    def _pop(self, now):
        self.world._light.add(FlashPop("pin", now, 1.0, "parallel", None))


def test_whole_session_is_captured_with_emulated_box(flash, tmp_path):
    target, _, pin = flash
    rig = load_rig("flash").resized(16)
    rig = dataclasses.replace(rig, views=(dataclasses.replace(rig.views[0], readout_s=0.05),))
    plan = flash_plan(rig, states=("neutral",), repeats=2, power=0.25, darks=2)
    pinned = PinnedWorld(rig, target, pin("camera"), pin("pop"))
    session = Session.create(
        tmp_path / "s",
        plan=plan,
        rig=rig,
        devices={},
        subject=SubjectRecord("p"),
        source="simulated",
        seed=0,
    )
    flash[1].close()
    camera = open_camera(f"sim://{pinned.name}/cam")
    box = FlashBox(Port(target.url, timeout_s=0.5))
    try:
        run_plan(plan, rig, boxes={"flash": box}, cameras={"cam": camera}, session=session)
    finally:
        camera.close()
        box.close()
        pinned.world.unregister()
    assert session.pending_frames() == []
    records = list(session.frames())
    for record in records:
        level = 512 + 1000 * (record.kind != "dark")
        assert np.unique(session.read(record).cfa).tolist() == [level]
    lit = sum(record.kind != "dark" for record in records)
    edges = len(rises(target, pin("pop"))), len(rises(target, pin("camera")))
    assert edges == (lit, lit)  # dark frames are released by the host
    assert lit >= 4
    session.release()
