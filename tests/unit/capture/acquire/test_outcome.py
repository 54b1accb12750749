"""Frames of a step are written together, as far as memory is bounded."""

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.small_sessions import CAMERAS, DOME, create_session, plan_of

from capture.acquire import outcome
from capture.acquire.outcome import CaptureRun, Operator
from capture.devices.camera import CameraInfo, Exposure, Frame, Trigger
from capture.session import Disk, verify

VIEW = DOME.view(CAMERAS[0])
FRAME_BYTES = 2 * VIEW.width_px * VIEW.height_px
COMPRESSED = bytes(FRAME_BYTES // 4)
"""A raw file of another program: its pixels are larger when they are encoded again."""


@pytest.fixture
def groups(monkeypatch):
    """Cameras and attempts of each group that was committed, and the memory of the frames."""
    seen, memory = [], set()
    monkeypatch.setattr(outcome, "describe_step_frame", lambda *_: None)
    monkeypatch.setattr(outcome.raw, "encode_frame_into", lambda _, allocate: allocate(FRAME_BYTES))

    def commit_step(_, step_id, frames):
        group = list(frames)
        seen.append((step_id, [(one.camera, one.attempt) for one in group]))
        memory.update(id(one.blob.obj) for one in group)
        assert len({id(one.blob.obj) for one in group}) == len(group)

    monkeypatch.setattr(outcome.Session, "commit_step", commit_step)
    return seen, memory


@pytest.mark.parametrize(
    ("limit", "sizes"),
    [(3 * FRAME_BYTES, [3]), (3 * FRAME_BYTES - 1, [2, 1]), (FRAME_BYTES, [1] * 3), (1, [1] * 3)],
)
def test_frames_wait_together_up_to_limit(tmp_path, monkeypatch, groups, limit, sizes):
    """Without the limit, all encoded frames of a step are in memory at once; it is used again."""
    committed, memory = groups
    monkeypatch.setattr(outcome, "MAX_GROUP_BYTES", limit)
    plan = plan_of(1, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        cameras = dict.fromkeys(CAMERAS, SimpleNamespace())
        run = CaptureRun(plan, DOME, cameras, session, Operator(clock=lambda: 7.0))
        frames = {name: Frame("1", 0, 0.0, 0.1, Exposure(0.1, 100), COMPRESSED) for name in CAMERAS}
        for attempt in (1, 2):
            committed.clear()
            words = {"light": {}, "tries": 1, "t_box_s": None, "journal_entries": {}}
            run.commit_frames(plan.steps[0], frames, **words)
            assert [len(group) for _, group in committed] == sizes
            found = [one for _, group in committed for one in group]
            assert found == [(camera, attempt) for camera in CAMERAS]
        assert len(memory) == max(sizes)
        assert (run.steps, run.frames) == (2, 2 * len(CAMERAS))


def test_step_without_frames_commits_none(tmp_path):
    plan = plan_of(1, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        run = CaptureRun(plan, DOME, {}, session, Operator())
        words = {"light": {}, "tries": 1, "t_box_s": None, "journal_entries": {}}
        run.commit_frames(plan.steps[0], {}, **words)
        assert (run.frames, session.frames()) == (0, [])


class SlowDisk(Disk):
    """A disk that takes a while before it reads the memory of a frame, and another between."""

    def write(self, descriptor, data):
        half = len(data) // 2
        for part in (memoryview(data)[:half], memoryview(data)[half:]):
            time.sleep(0.02)
            super().write(descriptor, part)


def test_frames_on_disk_are_those_encoded(tmp_path, monkeypatch, rng):
    """Two groups per step and two steps use the same memory while threads write it."""
    monkeypatch.setattr(outcome, "MAX_GROUP_BYTES", 2 * FRAME_BYTES)
    plan, shape = plan_of(2, len(CAMERAS)), (VIEW.height_px, VIEW.width_px)
    about = {"width_px": shape[1], "height_px": shape[0], "pattern": "RGGB", "white": 16383}
    about |= {"model": "model", "black": (512.0,) * 4, "triggers": (Trigger.EDGE,)}
    cameras = {name: SimpleNamespace(info=CameraInfo(serial=name, **about)) for name in CAMERAS}
    words = {"tries": 1, "t_box_s": None, "journal_entries": {}}
    path, expected = tmp_path / "s", {}
    with create_session(path, plan=plan, rig=DOME, disk=SlowDisk()) as session:
        run = CaptureRun(plan, DOME, cameras, session, Operator(clock=lambda: 7.0))
        for step in plan.steps:
            frames = {}
            for name in CAMERAS:
                image = rng.integers(512, 16383, shape, dtype=np.uint16)
                frames[name] = Frame(name, 0, 0.0, 0.1, Exposure(0.1, 100), image)
                encoded = run.encode_frame(step, name, frames[name], {})
                expected[f"{step.id}+{name}.dng"] = encoded
            run.commit_frames(step, frames, light={}, **words)
        assert len(run._buffers) == 2
        session.close()
    assert sorted(os.listdir(path / "frames")) == sorted(expected)
    for name, encoded in expected.items():
        assert (path / "frames" / name).read_bytes() == encoded
    assert verify(path).ok
