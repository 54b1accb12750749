"""A whole capture while line, box and camera fail: what is kept is right, and the box ends dark."""

import itertools
from collections import Counter

import numpy as np
import pytest

from capture.acquire import AcquisitionError, run_plan
from capture.devices.camera import open_camera
from capture.devices.flash import FlashBox
from capture.devices.port import BoxRebooted, DeviceError, LinkLost, Port
from capture.plan import Plan, Step, flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from rigsim.boxes.faults import Faults
from rigsim.world import World

RIG = load_rig("flash").resized(16)
NAMES = (f"capture-{number}" for number in itertools.count())


class Photometer:
    """Every pixel tells the light of the exposure: power, and 5000 more when crossed."""

    def exposure(self, view_name, *, pops, exposure_s, seed):
        light = sum(round(1000 * p.power) + 5000 * (p.polarizer == "crossed") for p in pops)
        return np.full((10, 16), 512 + light, np.uint16)


@pytest.fixture
def world():
    made = []

    def world(seed=0, **faults):
        made.append(World(RIG, seed=seed, scene=Photometer(), faults=Faults(**faults)))
        made[-1].name = made[-1].register(next(NAMES))
        return made[-1]

    yield world
    for one in made:
        one.unregister()


@pytest.fixture
def session(tmp_path):
    plan = flash_plan(RIG, states=("neutral", "smile"), repeats=3, power=0.5, darks=2)
    session = Session.create(
        tmp_path / "s",
        plan=plan,
        rig=RIG,
        devices={},
        subject=SubjectRecord("p"),
        source="simulated",
        seed=0,
    )
    yield session
    session.release()


def capture(world, session, plan=None):
    box = FlashBox(Port(f"sim://flash?world={world.name}", retries=12))
    camera = open_camera(f"sim://{world.name}/cam")
    try:
        return run_plan(
            plan or session.plan,
            RIG,
            boxes={"flash": box},
            cameras={"cam": camera},
            session=session,
        )
    finally:
        camera.close()
        box.close()
        assert not world.box("flash").device.lit


def check(world, session):
    """Fail where a frame is not lit by exactly the pop that it names."""
    assert session.pending_frames() == []
    made = Counter(pop.token for pop in world.pops)
    assert all(count == 1 for count in made.values())
    for record in session.frames():
        frame = session.read(record)
        if record.kind == "dark":
            assert frame.light["light"] == "none"
            assert np.unique(frame.cfa).tolist() == [512]
            continue
        assert frame.light["token"] in made
        assert frame.light["polarizer"] == record.step.settings["polarizer"]
        crossed = frame.light["polarizer"] == "crossed"
        assert np.unique(frame.cfa).tolist() == [512 + 500 + 5000 * crossed]
    session.close()
    assert verify(session.path).ok


@pytest.mark.parametrize(
    "faults",
    [
        {},
        {"drop": 0.001, "flip": 0.001, "lose_answer": 0.05, "duplicate": 0.05, "babble": 0.1},
        {"misfire": 0.15},
        {"stale": 0.5},
        {"drop_frame": 0.1},
        {"late_frame": 0.3, "late_frame_s": 12.0},
        {"repeat_frame": 0.5, "late_frame_s": 12.0},
        {"wrong_camera": 0.15},
        {"wrong_exposure": 0.15},
        {"drift_ppm": 200.0},
        {"slow_charge": 8.0},
        {"reset_on_open": True},
    ],
    ids=lambda faults: "+".join(faults) or "none",
)
def test_kept_frames_show_the_pop_they_name(world, session, faults):
    simulated = world(seed=4, **faults)
    done = capture(simulated, session)
    assert done.steps == 14
    check(simulated, session)
    if set(faults) & {"misfire", "drop_frame", "late_frame", "wrong_camera", "wrong_exposure"}:
        assert done.retakes > 0
    assert (done.stale > 0) == bool(set(faults) & {"stale", "late_frame", "repeat_frame"})


@pytest.mark.parametrize(
    ("faults", "error"),
    [({"reset_after": 20.0}, BoxRebooted), ({"unplug_after": 20.0, "replug_after": 0.5}, LinkLost)],
)
def test_interrupted_capture_continues_from_same_step(world, session, faults, error):
    simulated = world(seed=1, **faults)
    with pytest.raises(error):
        capture(simulated, session)
    kept = len(session.frames())
    assert 0 < kept < 14
    simulated.clock.sleep(5.0)
    assert capture(simulated, session).frames == 14 - kept
    check(simulated, session)


@pytest.mark.parametrize(
    "faults", [{"wrong_camera": 1.0}, {"misfire": 1.0}, {"interlock": True}, {"drop_frame": 1.0}]
)
def test_persistent_fault_ends_dark_with_single_error(world, session, faults):
    simulated = world(**faults)
    with pytest.raises(DeviceError):
        capture(simulated, session)
    assert not simulated.box("flash").armed


@pytest.mark.parametrize("settings", [{"power": 0.001}, {"power": 1.0, "analyzer_deg": 270.0}])
def test_plan_beyond_controller_limits_moves_and_lights_nothing(world, session, settings):
    simulated = world()
    more = {"polarizer": "parallel", "exposure_s": 0.008, "iso": 100, **settings}
    plan = Plan("flash", (Step("S1", "subject", {}, more, ("cam",)),))
    with pytest.raises(AcquisitionError, match="the controller allows"):
        capture(simulated, session, plan)
    assert simulated.pops == []
    assert not any("FLAS:PO" in line or "ARM" in line for line in simulated.transcript)


def test_controller_is_armed_only_during_its_pops(world, session):
    simulated = world()
    capture(simulated, session)
    sent = [line.split("FLAS:FIRE")[0] for line in simulated.transcript if " > " in line]
    words = [
        w
        for line in simulated.transcript
        if " > " in line
        for w in ("SYST:ARM*", "FLAS:FIRE", "SAFE")
        if w in line
    ]
    assert len(sent) > 0
    assert words.count("FLAS:FIRE") == words.count("SYST:ARM*") == 12
    at = [k for k, word in enumerate(words) if word == "FLAS:FIRE"]
    assert all(words[k - 1 : k + 2] == ["SYST:ARM*", "FLAS:FIRE", "SAFE"] for k in at)
