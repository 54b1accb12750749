"""The images run: every check of hardware, on a process, an ATmega2560 and two Cortex-M."""

import contextlib
import dataclasses
import functools
from collections import Counter

import numpy as np
import pytest
from fixtures.compiled.pinned import pin_name, pinned_world
from fixtures.compiled.targets import TARGETS, start_target

from capture.acquire import run_plan
from capture.devices.camera import open_camera
from capture.devices.checkup import CONTROLLER_CHECKS, CheckupPort
from capture.devices.dome import DomeBox
from capture.devices.flash import FlashBox
from capture.devices.port import CommandRefused, Port
from capture.devices.wire import Code
from capture.plan import flash_plan
from capture.plan.dome import dome_plan
from capture.plan.rows import led_rows
from capture.rig import load_rig
from capture.session import Session, SubjectRecord
from rigsim.boxes.flash import FlashPop

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
BLACK = 512
CAMERAS = 3
MAX_RETAKES = 15
"""Rows of 157 that a busy machine may spoil: their cameras' release comes late in QEMU."""


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
    counted = "session" not in request.node.name  # a session keeps the host's time
    target = start_target(request.param, "flash", counted=counted)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        yield target, port, functools.partial(pin_name, request.param)


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
    # simavr and QEMU count cycles; a process has the time that this machine gives it
    late_s = BUSY_SLACK_S if target.board == "posix" else CYCLES_SLACK_S
    assert all(0.02 - 1e-4 <= delay_s <= 0.02 + late_s for delay_s in delays_s)


LIT = {
    "flash": ("led0", ("FLAS:LAMP ON,500",)),
    "dome": ("led3", ("SAFE:EYES CLOSED", "LED:ON 3,500,400")),
    "gradient_sphere": ("led3", ("SAFE:EYES CLOSED", "PATT FULL,500,100")),
    "probe": ("shutter", ("HEAD:SITE cheek,0", "LED 1000", "SHUT OPEN,400")),
}
"""By box, a pin that is high while there is light, and what lights it for longer than a lease."""


@pytest.fixture(params=[pair for pair in BOARDS if pair[1] in LIT], ids="-".join)
def lit(request):
    board, box = request.param
    pin, texts = LIT[box]
    target = start_target(board, box, counted=True)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        port.hello()
        port.ask(f"SYST:WDOG {round(1e3 * LEASE_S)}")
        port.ask("SYST:ARM")
        for text in texts:
            port.ask(text)
        target.wait_for(lambda: rises(target, pin_name(board, pin)))
        yield target, port, pin_name(board, pin)


def test_killed_host_leaves_darkness_within_lease(lit):
    target, port, light = lit
    lit_s = rises(target, light)[-1].t_s
    port.close()  # the host dies here
    target.wait_for(lambda: [e for e in target.of_pin(light, 0.0) if e.t_s > lit_s])
    dark_s = next(e.t_s for e in target.of_pin(light, 0.0) if e.t_s > lit_s)
    # the lease counts from the command, which the light follows
    slack_s = BUSY_SLACK_S if target.board == "posix" else DARK_SLACK_S
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
    """A scene whose every pixel counts the pops, and the light of LEDs weighed by their number."""

    def __init__(self, rig):
        self.shape = rig.views[0].height_px, rig.views[0].width_px

    def exposure(self, view_name, *, pops, exposure_s, seed):
        total = 0.0
        for light in pops:
            if isinstance(light, FlashPop):
                total += 1000.0
            else:
                share = (light.t_off_s - light.t_on_s) / exposure_s
                total += 10.0 * (1 + light.led) * light.level * share
        return np.full(self.shape, BLACK + round(total), np.uint16)


def capture(driver, plan, rig, world, folder, **more):
    """Capture a plan in a new session; return the result, and each frame's record and level."""
    session = Session.create(
        folder,
        plan=plan,
        rig=rig,
        devices={},
        subject=SubjectRecord("p"),
        source="simulated",
        seed=0,
    )
    cameras = {view.name: open_camera(f"sim://{world}/{view.name}") for view in rig.views}
    try:
        done = run_plan(
            plan, rig, boxes={rig.boxes[0]: driver}, cameras=cameras, session=session, **more
        )
        assert session.pending_frames() == []
        frames = [(r, np.unique(session.read(r).cfa).tolist()) for r in session.frames()]
    finally:
        for camera in cameras.values():
            camera.close()
        driver.close()
        session.release()
    return done, frames


def test_whole_session_is_captured_with_emulated_flash(flash, monkeypatch, tmp_path):
    target, port, pin = flash
    rig = load_rig("flash").resized(16)
    rig = dataclasses.replace(rig, views=(dataclasses.replace(rig.views[0], readout_s=0.05),))
    plan = flash_plan(rig, states=("neutral",), repeats=2, power=0.25, darks=2)
    with pinned_world(monkeypatch, rig, target, port, Photometer(rig)) as (world, _):
        port.close()
        box = FlashBox(Port(target.url, timeout_s=0.5))
        _, frames = capture(box, plan, rig, world, tmp_path / "s")
    for record, levels in frames:
        assert levels == [BLACK + 1000 * (record.kind != "dark")]
    lit = sum(record.kind != "dark" for record, _ in frames)
    edges = len(rises(target, pin("pop"))), len(rises(target, pin("camera")))
    assert edges == (lit, lit)  # dark frames are released by the host
    assert lit >= 4


def test_whole_session_is_captured_with_emulated_dome(monkeypatch, tmp_path):
    target = start_target("mps2-an500", "dome")
    rig = load_rig("dome").resized(16)
    whole = dome_plan(rig, exposures_s=(0.02,), tracking_interval=50, order=range(len(rig.lights)))
    few = [view.name for view in rig.views[:CAMERAS]]
    plan = dataclasses.replace(
        whole, steps=tuple(dataclasses.replace(step, cameras=few) for step in whole.steps)
    )
    with contextlib.closing(target), contextlib.ExitStack() as open_parts:
        with CheckupPort(target.url, timeout_s=0.5) as port:
            port.hello()
            parts = pinned_world(monkeypatch, rig, target, port, Photometer(rig))
            world, _ = open_parts.enter_context(parts)
        box = DomeBox(Port(target.url, timeout_s=0.5))
        done, frames = capture(box, plan, rig, world, tmp_path / "s", eyes="closed")
    assert len(frames) == CAMERAS * len(plan.steps)
    runs = {}
    for record, levels in frames:
        (row,) = led_rows([record.step], rig)
        light = sum(10.0 * (1 + led) * row.level for led in row.leds)
        assert levels == [BLACK + round(light)], record.step_id
        runs[record.step_id] = record.actual["tries"], row.leds
    # one edge a row, on the lines of its cameras, and one pulse a light; rows that the host's load
    # spoiled were run again
    edges = [edge.value for edge in rises(target, "camera")]
    assert edges == [2**CAMERAS - 1] * (len(plan.steps) + done.retakes)
    assert done.retakes <= MAX_RETAKES
    pulses = Counter(edge.pin for edge in target.edges if edge.pin[:3] == "led" and edge.value)
    expected = Counter()
    for tries, leds in runs.values():
        expected.update({f"led{led}": tries for led in leds})
    assert pulses == expected
