"""Writing a session: what each call leaves in memory, on the disk, and in its error."""

import errno
import logging
import math
import os
import time
from datetime import UTC, datetime

import numpy as np
import pytest
from fixtures.small_sessions import (
    CAMERAS,
    DOME,
    PLAN,
    NotedDisk,
    commit_frame,
    commit_pending,
    commit_step,
    create_session,
    encode_frame,
    plan_of,
)

from capture.session import (
    Disk,
    NewFrame,
    Session,
    SessionDamage,
    SessionDiskError,
    SessionError,
    SessionLocked,
    reopen_copy,
    verify,
)
from capture.session.reopening import resume_unless_complete


@pytest.fixture
def session(tmp_path):
    with create_session(tmp_path / "s") as made:
        yield made


def journal_of(session):
    return (session.path / "journal.jsonl").read_bytes()


def test_defaults_of_session_are_recorded(tmp_path):
    before = datetime.now(UTC)
    with create_session(tmp_path / "a") as one, create_session(tmp_path / "b") as other:
        assert before <= one.manifest.created_at <= datetime.now(UTC)
        assert one.id != other.id
        assert len(one.id) == 32
        assert (one.seed, one.manifest.calibrations, dict(one.manifest.extra)) == (None, (), {})
    with create_session(tmp_path / "c", session_id="visit-2", extra={"room": 3}) as named:
        assert (named.id, dict(named.manifest.extra)) == ("visit-2", {"room": 3})


def test_line_of_frame_has_its_times(session):
    commit_frame(session, "S000", t_box_s=3, t_host_s=4, settings={"a": 1}, actual={"b": 2})
    commit_frame(session, "S001", t_host_s=5)
    for opened in (session, Session.open(session.path)):
        first, second = (record.line for record in opened.frames("subject"))
        assert (first.t_box_s, first.t_host_s) == (3.0, 4.0)
        assert (dict(first.settings), dict(first.actual)) == ({"a": 1}, {"b": 2})
        assert (second.t_box_s, second.t_host_s, second.attempt) == (None, 5.0, 1)
        assert first.bytes == (session.path / first.file).stat().st_size


def test_attempts_count_up_by_one(session):
    """The first number is free: a frame may have been taken before the session was lost."""
    commit_frame(session, "S000", attempt=2)
    for wrong in (0, 1, 2, 4):
        with pytest.raises(SessionError, match=f"attempt: got {wrong}, expected 3\n"):
            commit_frame(session, "S000", attempt=wrong)
    commit_frame(session, "S000", attempt=3)
    assert session.frames("subject")[0].attempt == 3
    for wrong in (0, -1):
        with pytest.raises(SessionError, match=f"attempt: got {wrong}, expected 1\n"):
            commit_frame(session, "S001", attempt=wrong)
    assert [path.name for path in sorted((session.path / "frames").iterdir())] == [
        "S000+cam+2.dng",
        "S000+cam+3.dng",
    ]


def test_foreign_camera_and_blob_are_refused(session):
    blob = encode_frame(session, "S000")
    words = {"settings": {}, "actual": {}, "t_host_s": 0.0}
    with pytest.raises(SessionError, match=r"no such camera\n  camera: got 'left', expected one"):
        session.commit("S000", "left", blob, **words)
    with pytest.raises(SessionError, match="names another step or session"):
        session.commit("S001", "cam", blob, **words)
    assert journal_of(session) == b""


def test_frames_of_step_are_committed_in_order(tmp_path):
    plan = plan_of(2, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        commit_step(session, "S001")
        for opened in (session, Session.open(session.path)):
            assert [(r.step_id, r.camera) for r in opened.frames()] == [
                ("S001", camera) for camera in CAMERAS
            ]
            assert [one.id for one, _ in opened.pending_frames()] == ["S000"] * len(CAMERAS)
        commit_step(session, "S000")
        session.close()
    report = verify(tmp_path / "s")
    assert (report.ok, report.frames) == (True, 2 * len(CAMERAS))


def test_refused_frame_leaves_no_file_of_others(tmp_path):
    """Frames before it may be on the disk already, as each is written while the next is made."""
    plan = plan_of(1, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        words = {"settings": {}, "actual": {}, "t_host_s": 0.0}
        blob = encode_frame(session, "S000")
        first, other, foreign = (
            NewFrame(camera=camera, blob=blob, **words) for camera in ("C00", "C01", "C09")
        )

        def fail():
            yield first
            yield other
            raise ZeroDivisionError("lost")

        for frames, error, text in [
            ([first, other, first], SessionError, "got 'C00', expected one frame of each camera"),
            ([first, other, foreign], SessionError, "no such camera"),
            (fail(), ZeroDivisionError, "lost"),
        ]:
            with pytest.raises(error, match=text):
                session.commit_step("S000", frames)
            assert journal_of(session) == b""
            assert list((session.path / "frames").iterdir()) == []
        session.commit_step("S000", [])
        assert journal_of(session) == b""
        commit_step(session, "S000")
        session.close()
    assert verify(tmp_path / "s").ok


@pytest.mark.parametrize("first_error", ["exists", "full", "caller"])
def test_file_that_was_there_before_is_kept(tmp_path, first_error):
    """The session's own files are removed, whatever ends the step."""
    plan = plan_of(1, len(CAMERAS))
    disk = DiskFullAt("C00" if first_error == "full" else "none")
    with create_session(tmp_path / "s", plan=plan, rig=DOME, disk=disk) as session:
        stray = session.path / "frames/S000+C01.dng.part"
        stray.write_bytes(b"of another program")
        if first_error == "caller":
            blob = encode_frame(session, "S000")
            words = {"blob": blob, "settings": {}, "actual": {}, "t_host_s": 0.0}
            frames = [NewFrame(camera=name, **words) for name in ("C00", "C01", "C09")]
            with pytest.raises(SessionError):  # of the camera C09, or of the file
                session.commit_step("S000", frames)
        else:
            with pytest.raises(SessionDiskError, match=r"File exists|No space left"):
                commit_step(session, "S000")
        assert stray.read_bytes() == b"of another program"
        assert list((session.path / "frames").iterdir()) == [stray]
    with Session.resume(session.path) as again:
        commit_step(again, "S000")
        again.close()
    orphans = [path.read_bytes() for path in (session.path / "orphans").iterdir()]
    assert orphans == [b"of another program"]
    assert verify(session.path).ok


@pytest.mark.parametrize("operation", ["rename", "fsync_dir", "fdatasync"])
def test_stop_while_naming_releases_session(tmp_path, monkeypatch, operation):
    """What reached the medium is unknown: a further step would hide that lines are missing."""

    def stop(*_):
        raise KeyboardInterrupt

    disk = Disk()
    session = create_session(tmp_path / "s", plan=plan_of(2, len(CAMERAS)), rig=DOME, disk=disk)
    with monkeypatch.context() as patch:
        patch.setattr(disk, operation, stop)
        with pytest.raises(KeyboardInterrupt):
            commit_step(session, "S000")
    for call in (
        lambda: commit_step(session, "S001"),
        lambda: session.omit_steps(["S001"], reason="blinked", t_host_s=0.0),
    ):
        with pytest.raises(SessionError, match="not open for writing"):
            call()
    with Session.resume(session.path) as again:
        for step in dict.fromkeys(step.id for step, _ in again.pending_frames()):
            commit_step(again, step)
        again.close()
    assert verify(session.path).ok


def test_stop_while_writing_line_releases_session(session, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(session._disk, "fdatasync", stop)
        with pytest.raises(KeyboardInterrupt):
            session.omit_steps(["S000"], reason="blinked", t_host_s=0.0)
    with pytest.raises(SessionError, match="not open for writing"):
        commit_frame(session, "S001")


def test_error_of_caller_is_not_the_disks(tmp_path):
    """A camera's timeout is an error of the operating system's kind, too."""

    def fail():
        yield NewFrame(
            camera="C00", blob=encode_frame(session, "S000"), settings={}, actual={}, t_host_s=0.0
        )
        raise TimeoutError("camera")

    plan = plan_of(1, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        with pytest.raises(TimeoutError, match="camera"):
            session.commit_step("S000", fail())
        assert list((session.path / "frames").iterdir()) == []
        commit_step(session, "S000")
        session.close()
    assert verify(tmp_path / "s").ok


def test_frames_are_written_while_next_ones_are_made(tmp_path):
    plan = plan_of(1, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:

        def make():
            for camera in CAMERAS:
                blob = encode_frame(session, "S000")
                yield NewFrame(camera=camera, blob=blob, settings={}, actual={}, t_host_s=0.0)
                deadline_s = time.monotonic() + 10.0
                part = session.path / f"frames/S000+{camera}.dng.part"
                while not part.exists() or part.stat().st_size < len(blob):
                    assert time.monotonic() < deadline_s
                    time.sleep(0.001)

        session.commit_step("S000", make())
        assert len(session.frames()) == len(CAMERAS)


class DiskFullAt(Disk):
    """A disk without space for one file; the other ones are written by threads."""

    def __init__(self, name):
        self.name, self.refused = name, None

    def create(self, path):
        descriptor = super().create(path)
        if self.name in path.name:
            self.refused = descriptor
        return descriptor

    def write(self, descriptor, data):
        if descriptor == self.refused:
            super().write(descriptor, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(descriptor, data)


@pytest.mark.parametrize("camera", CAMERAS)
def test_full_disk_within_step_loses_no_committed_frame(tmp_path, camera):
    disk = DiskFullAt(f"S001+{camera}")
    plan = plan_of(3, len(CAMERAS))
    session = create_session(tmp_path / "s", plan=plan, rig=DOME, disk=disk)
    commit_step(session, "S000")
    with pytest.raises(SessionDiskError, match="the disk refused: No space left") as caught:
        commit_step(session, "S001")
    assert "committed frames are safe" in str(caught.value)
    with pytest.raises(SessionError, match="not open for writing"):
        commit_step(session, "S002")
    assert {r.step_id for r in Session.open(session.path).frames()} == {"S000"}
    assert list((session.path / "frames").glob("S001*")) == []
    with Session.resume(session.path) as again:
        for step in ("S001", "S002"):
            commit_step(again, step)
        again.close()
    report = verify(session.path)
    assert (report.ok, report.frames) == (True, 3 * len(CAMERAS))


@pytest.mark.parametrize("call", ["commit", "attach", "omit", "close"])
def test_released_and_closed_sessions_refuse_every_call(session, call):
    def write():
        match call:
            case "commit":
                commit_frame(session, "S000")
            case "attach":
                session.attach("a.ply", b"x")
            case "omit":
                session.omit_steps(["S000"], reason="blinked", t_host_s=0.0)
            case "close":
                session.close(missing_reason="over")

    session.release()
    with pytest.raises(SessionError, match="the session is not open for writing"):
        write()
    with Session.resume(session.path) as again:
        again.close(missing_reason="over")
        assert again.closed
        session = again
        with pytest.raises(SessionError, match="the session is closed"):
            write()


def test_attachment_line_has_its_provenance(session):
    session.attach("a.ply", bytearray(b"scan"), about={"unit": "mm"})
    session.attach("b.ply", b"x")
    with pytest.raises(SessionError, match=r"there already\n  name: got 'a\.ply', expected a name"):
        session.attach("a.ply", b"scan")
    for opened in (session, Session.open(session.path)):
        lines = [opened.attachment_line(name) for name in ("a.ply", "b.ply")]
        assert [(line.bytes, dict(line.about)) for line in lines] == [(4, {"unit": "mm"}), (1, {})]
        assert opened.attachments() == ("a.ply", "b.ply")


def test_impossible_attachment_is_named_by_field(session, monkeypatch):
    monkeypatch.setattr("capture.session.store.MAX_FRAME_BYTES", 4)
    session.attach("whole.ply", b"scan")
    with pytest.raises(SessionError, match="data: got '5 bytes', expected 1 to 4 bytes"):
        session.attach("a.ply", b"scan+")
    with pytest.raises(SessionError, match=r"name: got '\.hidden', .*\n  data: got '0 bytes'"):
        session.attach(".hidden", b"")


def test_impossible_omission_is_named_by_field(session):
    words = {"t_host_s": 0.0}
    for steps in ([], ["S000", "S000"]):
        with pytest.raises(SessionError, match=r"step_ids: .* expected at least one, none twice"):
            session.omit_steps(steps, reason="blinked", **words)
    with pytest.raises(SessionError, match="reason: got ' ', expected a text") as caught:
        session.omit_steps(["S000"], reason=" ", **words)
    assert not isinstance(caught.value, SessionDamage)  # the caller is wrong, not the session
    session.omit_steps(["S000"], reason="blinked", about={"x": 1}, t_host_s=2)
    for opened in (session, Session.open(session.path)):
        line = opened.omission_line("S000")
        assert (line.reason, dict(line.about), line.t_host_s) == ("blinked", {"x": 1}, 2.0)
    with pytest.raises(SessionError, match="step_ids: got 'S000', expected steps not omitted"):
        session.omit_steps(["S001", "S000"], reason="blinked", **words)


def test_refused_line_changes_nothing_in_memory(session):
    head = session.content_hash
    for call in (
        lambda: commit_frame(session, "S000", actual={"gain": math.nan}),
        lambda: session.attach("a.ply", b"x", about={"gain": math.inf}),
        lambda: session.omit_steps(["S000"], reason="x" * 70_000, t_host_s=0.0),
    ):
        with pytest.raises(SessionError):
            call()
    assert session.content_hash == head
    assert len(session.pending_frames()) == len(PLAN.steps)
    assert (session.attachments(), session.omitted_steps()) == ((), {})
    commit_frame(session, "S000")
    assert session.content_hash == Session.open(session.path).content_hash != head


def test_missing_steps_are_counted_when_closing(session):
    commit_frame(session, "D000")
    session.omit_steps(["S000"], reason="blinked", t_host_s=0.0)
    with pytest.raises(SessionError, match="steps: got 1 missing, first 'S001', expected none"):
        session.close()
    assert not session.closed
    session.close(missing_reason="the subject left")
    assert session.closed
    opened = Session.open(session.path)
    assert opened.content_hash == session.content_hash
    (line,) = [line for line in journal_of(session).splitlines() if b'"close"' in line]
    assert b'"frames":1,"missing":["S001"],"reason":"the subject left"' in line


def test_reason_of_complete_session_is_dropped(session):
    """Frames taken twice count twice: the line has the number of files."""
    commit_pending(session)
    commit_frame(session, "S000", attempt=2)
    session.close(missing_reason="unneeded")
    assert b'"frames":4,"missing":[],"reason":""' in journal_of(session)
    assert verify(session.path).frames == 4


def test_torn_line_is_cut_and_logged(session, caplog):
    commit_frame(session, "D000")
    session.release()
    whole = journal_of(session)
    (session.path / "journal.jsonl").write_bytes(whole + b'{"h":"')
    with caplog.at_level(logging.WARNING), Session.resume(session.path) as again:
        assert journal_of(session) == whole
        commit_frame(again, "S000")
    assert [record.getMessage() for record in caplog.records] == [
        f"{session.path / 'journal.jsonl'}: cut 6 torn bytes"
    ]
    assert journal_of(session).startswith(whole)


def test_reading_cuts_no_torn_line(session):
    commit_frame(session, "D000")
    torn = journal_of(session) + b'{"h":"'
    (session.path / "journal.jsonl").write_bytes(torn)
    assert [record.step_id for record in Session.open(session.path).frames()] == ["D000"]
    assert journal_of(session) == torn


def test_context_ends_with_lock_and_no_end(session):
    with pytest.raises(SessionLocked, match="another process is writing") as caught:
        Session.resume(session.path)
    assert "[SR-SES-003]" in str(caught.value)
    with session as same:
        assert same is session
    with Session.resume(session.path) as again:
        assert not again.closed


def test_resumption_writes_unless_session_is_complete(session):
    session.release()
    with resume_unless_complete(session.path) as open_one:
        commit_pending(open_one)
    with resume_unless_complete(session.path) as unclosed:
        unclosed.close()
    complete = resume_unless_complete(session.path)
    assert (complete.closed, complete.complete) == (True, True)
    with pytest.raises(SessionError, match="the session is closed"):
        complete.attach("a.ply", b"x")


def test_closed_session_with_missing_frames_is_refused(session):
    session.close(missing_reason="the subject left")
    assert not session.complete
    with pytest.raises(SessionError, match="the session is closed"):
        resume_unless_complete(session.path)


def test_copy_has_lines_up_to_the_end(session, tmp_path):
    commit_frame(session, "S000")
    session.attach("a.ply", b"scan")
    head = session.content_hash
    session.close(missing_reason="the subject left")
    copy, reason = reopen_copy(session.path, tmp_path / "c")
    with copy:
        assert (reason, copy.closed, copy.content_hash) == ("the subject left", False, head)
        assert journal_of(session).startswith(journal_of(copy))
        assert [step.id for step, _ in copy.pending_frames()] == ["D000", "S001"]
        np.testing.assert_array_equal(copy.read(copy.frames()[0]).cfa, 600)
        assert copy.attachment("a.ply") == b"scan"
        commit_pending(copy)
        copy.close()
    assert not any("left" in one for one in verify(tmp_path / "c").warnings)


def test_copy_leaves_occupied_folder_alone(session, tmp_path):
    session.close(missing_reason="the subject left")
    disk, target = NotedDisk(tmp_path), tmp_path / "c"
    (target / "frames").mkdir(parents=True)
    (target / "frames/a.dng").write_bytes(b"x")
    with pytest.raises(SessionError, match="cannot start here"):
        reopen_copy(session.path, target, disk=disk)
    assert disk.take_notes() == []
    with pytest.raises(SessionError, match="cannot start here"):
        reopen_copy(session.path, session.path, disk=disk)
    assert disk.take_notes() == []
    assert verify(session.path).ok


def test_open_session_is_not_copied(session, tmp_path):
    with pytest.raises(SessionError, match=r"is not closed\n  session: got open, expected closed"):
        reopen_copy(session.path, tmp_path / "c")
    assert not (tmp_path / "c").exists()
