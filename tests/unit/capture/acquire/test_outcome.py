"""Frames of a step are written together, as far as memory is bounded."""

from types import SimpleNamespace

import pytest
from fixtures.small_sessions import CAMERAS, DOME, create_session, plan_of

from capture.acquire import outcome
from capture.acquire.outcome import CaptureRun, Operator
from capture.devices.camera import Exposure, Frame

FRAME_BYTES = 1000
IMAGE = bytes(FRAME_BYTES)


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
        frames = {name: Frame("1", 0, 0.0, 0.1, Exposure(0.1, 100), IMAGE) for name in CAMERAS}
        for attempt in (1, 2):
            committed.clear()
            words = {"light": {}, "tries": 1, "t_box_s": None, "journal_entries": {}}
            run.commit_frames(plan.steps[0], frames, **words)
            assert [len(group) for _, group in committed] == sizes
            found = [one for _, group in committed for one in group]
            assert found == [(camera, attempt) for camera in CAMERAS]
        assert len(memory) == max(sizes)
        assert (run.steps, run.frames) == (2, 2 * len(CAMERAS))
