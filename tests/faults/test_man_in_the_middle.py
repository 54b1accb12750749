"""Sessions through a man in the middle: each accepted frame shows the light that was requested."""

import dataclasses
import itertools
import os
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.operators import by_operator

from capture.acquire import run_plan
from capture.acquire.flash import shot
from capture.devices import wire
from capture.devices.camera import open_camera
from capture.devices.dome import DomeBox, TableRow
from capture.devices.flash import FlashBox
from capture.devices.gradient_sphere import GradientSphereBox, PatternRow
from capture.devices.port import DeviceError, Port
from capture.plan import flash_plan
from capture.plan.dome import dome_plan
from capture.plan.gradient import gradient_calibration_plan
from capture.plan.rows import step_lights
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from rigsim.boxes import controller
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.line_faults import LINE_FAULT_KINDS, LineFaults

NAMES = (f"middle-{number}" for number in itertools.count())
LEASE_SLACK_S = 0.01
MAX_RUNS = 200
ANGLES_DEG = {"parallel": 0, "crossed": 90}


class Witness:
    """A scene whose pixels state the light of an exposure: rows of numbers."""

    def exposure(self, view_name, *, pops, exposure_s, seed, grip=None):
        view = self.rig.view(view_name)
        image = np.zeros((view.height_px, view.width_px), np.uint16)
        image[0, 0] = len(pops)
        for number, pop in enumerate(pops[:8]):
            image[1 + number, :3] = self.describe(pop)
        return image


def subset(rig, step, count):
    lights = [light.name for light in rig.lights[::step]][:count]
    return rig.subset(lights=lights, views=[rig.views[0].name]).resized(16)


class FlashRig(Witness):
    kind, driver = "flash", FlashBox
    rig = load_rig("flash").resized(16)

    def plan(self, rng):
        plan = flash_plan(self.rig, states=("neutral", "smile"), repeats=2, darks=1)
        steps = [
            step
            if step.kind == "dark"
            else dataclasses.replace(
                step, settings={**step.settings, "power": float(rng.integers(1, 11)) / 10}
            )
            for step in plan.steps
        ]
        return dataclasses.replace(plan, steps=tuple(steps))

    @staticmethod
    def describe(pop):
        return round(1e4 * pop.power), ANGLES_DEG[pop.polarizer], 1

    def expected(self, step):
        if step.kind == "dark":
            return []
        power = round(1e4 * step.settings["power"])
        return [(power, ANGLES_DEG[step.settings["polarizer"]], 1)]


class DomeRig(Witness):
    kind, driver = "dome", DomeBox
    rig = subset(load_rig("dome"), 12, 13)

    def plan(self, rng):
        return dome_plan(self.rig, tracking_interval=100)

    @staticmethod
    def describe(pop):
        return 1 + pop.led, round(1000 * pop.level), 1

    def expected(self, step):
        numbers = {light.name: 1 + number for number, light in enumerate(self.rig.lights)}
        level = round(1000 * step.settings.get("level", 1.0))
        return [(numbers[name], level, 1) for name in step_lights(step)]


class GradientRig(Witness):
    kind, driver = "gradient_sphere", GradientSphereBox
    rig = load_rig("gradient").resized(16)

    def plan(self, rng):
        return gradient_calibration_plan(self.rig, "ball")

    @staticmethod
    def describe(pop):
        pattern = 1 + LIGHT_PATTERNS.index(pop.pattern)
        return pattern, round(pop.analyzer_deg), round(1000 * pop.level)

    def expected(self, step):
        if step.settings["pattern"] == "dark":
            return []
        reading = step.settings.get("analyzer_deg", ANGLES_DEG[step.settings["polarizer"]])
        level = round(1000 * step.settings["level"])
        return [(1 + LIGHT_PATTERNS.index(step.settings["pattern"]), round(reading), level)]


RIGS = {rig.kind: rig for rig in (FlashRig(), DomeRig(), GradientRig())}


SESSIONS_VARIABLE = "MIDDLE_SESSIONS"
"""Number of sessions of each long test, for the published figures."""


def wrong_frames(scene, session):
    """Return the accepted frames that another light made than the requested one."""
    found = []
    for record in session.frames():
        cfa = session.read(record).cfa
        count = int(cfa[0, 0])
        seen = sorted(tuple(int(value) for value in row[:3]) for row in cfa[1 : 1 + min(count, 8)])
        exposed_s = record.actual["exposure_s"]
        wanted = sorted(scene.expected(record.step))[:8]
        if seen != wanted or exposed_s != record.settings["exposure_s"]:
            found.append((record.step_id, seen, wanted))
    return found


def capture(tmp_path, kind, seed, *, share=0.08):
    """Capture a session through a man in the middle; return his strikes and the wrong frames."""
    scene, rng = RIGS[kind], np.random.default_rng([seed, len(kind)])
    world = World(scene.rig, seed=seed, scene=scene, faults=Faults(baud=0.0))
    name = world.register(next(NAMES))
    plan = scene.plan(rng)
    words = {"devices": {}, "subject": SubjectRecord("p"), "source": "simulated", "seed": seed}
    session = Session.create(tmp_path / f"{kind}-{seed}", plan=plan, rig=scene.rig, **words)
    middle, errors = LineFaults(rng, share), Counter()
    unit, world.link(kind).tap = world.box(kind), middle
    start = int(rng.integers(2**32))
    for run in range(MAX_RUNS):
        box = port = None
        cameras = {v.name: open_camera(f"sim://{name}/{v.name}") for v in scene.rig.views}
        try:
            url, first_seq = f"sim://{kind}?world={name}", (start + 10_000 * run) % 2**32
            port = Port(url, clock=world.clock, first_seq=first_seq)
            box = scene.driver(port)
            boxes = {kind: box}
            words = by_operator({"eyes": "closed", "run_id": f"run{run}"})
            run_plan(plan, scene.rig, boxes=boxes, cameras=cameras, session=session, **words)
            box.close()
            break
        except DeviceError as error:
            errors[type(error).__name__] += 1
        finally:
            if port is not None:
                port.close()  # the host dies: it sends no SAFE
            for camera in cameras.values():
                camera.close()
        world.clock.sleep(unit._lease_ms / 1e3 + LEASE_SLACK_S)
        assert not unit.armed
        assert not unit.device.lit
        world.clock.sleep(2.0)
    assert session.pending_frames() == [], errors
    wrong = wrong_frames(scene, session)
    session.close()
    assert verify(session.path).ok
    world.unregister()
    return middle.strikes, wrong


@pytest.mark.parametrize(
    ("kind", "sessions", "faults"),
    [
        ("flash", 2, 20),
        ("dome", 1, 20),
        ("gradient_sphere", 1, 15),
        pytest.param("flash", 20, 250, marks=pytest.mark.long),
        pytest.param("dome", 10, 250, marks=pytest.mark.long),
        pytest.param("gradient_sphere", 10, 200, marks=pytest.mark.long),
    ],
)
def test_accepted_frames_show_requested_light(tmp_path, kind, sessions, faults):
    strikes = Counter()
    if sessions >= 10:
        sessions = int(os.environ.get(SESSIONS_VARIABLE, sessions))
    for seed in range(100, 100 + sessions):
        struck, wrong = capture(tmp_path, kind, seed)
        strikes += struck
        assert wrong == [], seed
    assert strikes.total() >= faults
    assert sessions < 10 or set(strikes) == set(LINE_FAULT_KINDS)
    print(f"{kind}: {sessions} sessions, {strikes.total()} faults, 0 wrong frames")


def test_unchecked_replays_would_give_wrong_frame(tmp_path, monkeypatch):
    deaf = {**vars(wire), "is_behind": lambda number, latest: False}
    monkeypatch.setattr(controller, "wire", SimpleNamespace(**deaf))  # the host's rule stays
    monkeypatch.setattr(shot, "check_report", lambda *_: None)
    _, wrong = capture(tmp_path, "flash", seed=111)
    assert wrong


LIGHTS = {
    "flash": lambda box: box.lamp_on(0.5),
    "dome": lambda box: (
        box.load([TableRow((0,), 0.05, 0.5, 0)] * 8),
        box.arm_sequence(8),
        box.trigger("t"),
    ),
    "gradient_sphere": lambda box: (
        box.load([PatternRow("full", 0.0, 0.05, 0.5, 0)] * 8),
        box.arm_scan(8),
        box.trigger("t"),
    ),
}


@pytest.mark.parametrize("kind", RIGS)
@pytest.mark.parametrize("seed", range(3))
def test_lost_host_leaves_dark_although_lines_repeat(kind, seed):
    scene = RIGS[kind]
    world = World(scene.rig, seed=seed, faults=Faults(baud=0.0))
    name, unit = world.register(next(NAMES)), world.box(kind)
    middle = world.link(kind).tap = LineFaults(np.random.default_rng(seed), share=0.0)
    for host in range(2):  # lines of the earlier host repeat, too
        box = scene.driver(Port(f"sim://{kind}?world={name}", clock=world.clock))
        box.set_lease(1.0)
        if kind != "flash":
            box.set_eyes("closed")
        box.arm()
        LIGHTS[kind](box)
        for _ in range(12):
            box.ping()
        if host == 0:
            box.close()
            world.clock.sleep(1.0)
    last_s = world.now
    assert unit.device.lit
    for number in range(1, 300):
        now_s = last_s + 0.01 * number
        line = middle.lines[">"][int(middle.rng.integers(len(middle.lines[">"])))]
        unit.feed(line if number % 2 else middle.lines[">"][-1], now_s)
        late = now_s > last_s + 1.0 + LEASE_SLACK_S
        assert not (late and (unit.armed or unit.device.lit)), now_s - last_s
    assert not unit.armed
    world.unregister()
