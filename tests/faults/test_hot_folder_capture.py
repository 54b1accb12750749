"""A whole capture through a hot folder: the box releases a camera that another program reads."""

import dataclasses

import numpy as np
import pytest

from capture import raw
from capture.acquire import run_plan
from capture.devices.cameras.hot_folder import HotFolder
from capture.devices.flash import FlashBox
from capture.devices.port import Port
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from rigsim.world import World

LEVEL_DARK, LEVEL_LIT = 512, 3000


class Tether:
    """A camera on the box's line and a program that writes its files, in the world's time."""

    def __init__(self, world, folder, lag_s):
        self.world, self.folder, self.lag_s = world, folder, lag_s
        self.due = []
        world.box("flash").device._on_trigger = self.edge

    def write(self, name, level):
        view = self.world.rig.views[0]
        cfa = np.full((view.height_px, view.width_px), level, np.uint16)
        blob = raw.encode_dng(
            cfa,
            pattern="RGGB",
            black=512,
            white=16383,
            exposure_s=0.008,
            iso=100,
            camera_serial=view.serial,
            camera_model=view.camera_model,
        )
        (self.folder / name).write_bytes(blob)

    def edge(self, now_s):
        self.due.append(now_s + self.lag_s)

    def clock(self):
        return 2e9 + self.world.now  # later than any file's own time stamp

    def sleep(self, seconds):
        self.world.wait(self.world.now + seconds)
        while self.due and self.due[0] + 0.008 <= self.world.now:
            start_s = self.due.pop(0)
            pops = self.world.light_between(start_s, start_s + 0.008)
            number = len(list(self.folder.iterdir()))
            self.write(f"IMG_{number:04d}.dng", LEVEL_LIT if pops else LEVEL_DARK)


@pytest.fixture
def capture(tmp_path, monkeypatch):
    """Return a function that captures one pair and two darks with a shutter of some lag."""

    def capture(lag_s, told_s):
        rig = load_rig("flash").resized(16)
        rig = dataclasses.replace(
            rig, views=(dataclasses.replace(rig.views[0], shutter_lag_s=told_s),)
        )
        world = World(rig, seed=1)
        name = world.register(f"hot-folder-{tmp_path.name}-{lag_s}-{told_s}")
        folder = tmp_path / f"incoming-{told_s}"
        folder.mkdir()
        tether = Tether(world, folder, lag_s)
        tether.write("IMG_0000.dng", LEVEL_DARK)
        camera = HotFolder(folder, clock=tether.clock, sleep=tether.sleep)
        box = FlashBox(Port(f"sim://flash?world={name}", clock=world.clock))
        plan = flash_plan(rig, darks=2)
        # files bear the computer's time, the world has its own
        take = HotFolder._take
        monkeypatch.setattr(
            HotFolder,
            "_take",
            lambda self, path: dataclasses.replace(take(self, path), t_start_s=tether.clock()),
        )
        with Session.create(
            tmp_path / f"s-{told_s}",
            plan=plan,
            rig=rig,
            devices={},
            subject=SubjectRecord("p"),
            source="simulated",
        ) as session:
            run_plan(plan, rig, boxes={"flash": box}, cameras={"cam": camera}, session=session)
            session.close()
        box.close()
        world.unregister()
        assert verify(session.path).ok
        return {r.step_id: int(session.read(r).cfa.max()) for r in session.frames()}

    return capture


def test_plan_with_darks_runs_by_controller_line_alone(capture):
    assert capture(lag_s=0.0, told_s=0.0) == {
        "D000": LEVEL_DARK,
        "D001": LEVEL_DARK,
        "S000": LEVEL_LIT,
        "S001": LEVEL_LIT,
    }


def test_slow_shutter_is_met_only_when_rig_declares(capture):
    assert capture(lag_s=0.03, told_s=0.03)["S000"] == LEVEL_LIT
    assert capture(lag_s=0.03, told_s=0.0)["S000"] == LEVEL_DARK
