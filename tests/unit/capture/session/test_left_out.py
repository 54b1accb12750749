"""Steps that are left out with a reason: durable, never captured afterwards, no loss of others."""

import errno

import numpy as np
import pytest

from capture import raw
from capture.plan import PlanError, flash_plan
from capture.rig import load_rig
from capture.session import Disk, Session, SessionDiskError, SessionError, SubjectRecord, verify

RIG = load_rig("flash").resized(16)
PLAN = flash_plan(RIG, states=("neutral", "anger"), darks=1)
WHY = "the skin buckled"


@pytest.fixture
def session(tmp_path):
    with Session.create(
        tmp_path / "s",
        plan=PLAN,
        rig=RIG,
        devices={},
        subject=SubjectRecord("P042", ("research",)),
        source="measured",
    ) as made:
        yield made


def commit(session, step_id):
    blob = raw.encode_dng(
        np.full((10, 16), 600, np.uint16),
        pattern="RGGB",
        black=512,
        white=16383,
        step_id=step_id,
        session_id=session.id,
    )
    session.commit(step_id, "cam", blob, settings={}, actual={}, t_host_s=0.0)


def commit_all(session):
    for step, _ in session.pending_frames():
        commit(session, step.id)


def test_omitted_steps_are_not_pending_and_session_completes(session):
    session.omit_steps(["S002", "S003"], reason=WHY, about={"aperture_mm": 5.6}, t_host_s=7.0)
    assert [step.id for step, _ in session.pending_frames()] == ["D000", "S000", "S001"]
    commit_all(session)
    session.close()
    again = Session.open(session.path)
    assert again.closed
    assert again.omitted_steps() == {"S002": WHY, "S003": WHY}
    line = again.omission_line("S003")
    assert (line.about["aperture_mm"], line.t_host_s) == (5.6, 7.0)
    found = verify(session.path)
    assert found.ok
    assert found.warnings == (f"{session.path}: 2 steps omitted: {WHY}",)


def test_omitted_steps_survive_interruption(session):
    session.omit_steps(["S003"], reason=WHY, t_host_s=0.0)
    session.release()
    with Session.resume(session.path) as again:
        assert again.omitted_steps() == {"S003": WHY}
        commit_all(again)
        again.close()
    assert [r.step_id for r in Session.open(session.path).frames()] == [
        "D000",
        "S000",
        "S001",
        "S002",
    ]


def test_frames_of_later_omitted_step_stay_uncounted(session):
    commit_all(session)
    session.omit_steps(["S001"], reason=WHY, t_host_s=0.0)
    assert "S001" not in [r.step_id for r in session.frames()]
    assert (session.path / "frames" / "S001+cam.dng").is_file()
    session.close()
    found = verify(session.path)
    assert (found.ok, found.frames) == (True, 5)


def test_other_missing_steps_still_need_reason(session):
    session.omit_steps(["S003"], reason=WHY, t_host_s=0.0)
    with pytest.raises(SessionError, match="4 missing"):
        session.close()
    session.close(missing_reason="the subject left")
    assert any("4 frames missing" in text for text in verify(session.path).warnings)


def test_omitted_step_is_neither_captured_nor_omitted_again(session):
    session.omit_steps(["S003"], reason=WHY, t_host_s=0.0)
    before = (session.path / "journal.jsonl").read_bytes()
    with pytest.raises(SessionError, match="was omitted"):
        commit(session, "S003")
    with pytest.raises(SessionError, match="not omitted before"):
        session.omit_steps(["S002", "S003"], reason=WHY, t_host_s=0.0)
    assert (session.path / "journal.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("steps", "reason", "error"),
    [
        ([], WHY, SessionError),
        (["S001", "S001"], WHY, SessionError),
        (["S001"], " ", SessionError),
        (["S9"], WHY, PlanError),
    ],
)
def test_impossible_omission_leaves_no_trace(session, steps, reason, error):
    with pytest.raises(error):
        session.omit_steps(steps, reason=reason, t_host_s=0.0)
    assert (session.path / "journal.jsonl").read_bytes() == b""


def test_flipped_bit_in_reason_is_detected(session):
    session.omit_steps(["S003"], reason=WHY, t_host_s=0.0)
    commit_all(session)
    session.close()
    file = session.path / "journal.jsonl"
    data = bytearray(file.read_bytes())
    data[data.index(b"buckled")] ^= 1
    file.write_bytes(data)
    assert not verify(session.path).ok


def test_failing_disk_costs_reason_only_keeps_acknowledged_data(session):
    class Full(Disk):
        full = False

        def write(self, descriptor, data):
            if self.full:
                raise OSError(errno.ENOSPC, "no space left")
            super().write(descriptor, data)

    session.release()
    disk = Full()
    again = Session.resume(session.path, disk=disk)
    commit(again, "D000")
    disk.full = True
    with pytest.raises(SessionDiskError):
        again.omit_steps(["S003"], reason=WHY, t_host_s=0.0)
    with Session.resume(session.path) as third:
        assert third.omitted_steps() == {}
        assert [r.step_id for r in third.frames()] == ["D000"]
