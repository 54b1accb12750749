"""Sessions: what is committed stays, what does not belong is refused, what is known is kept."""

import errno
import hashlib
import json
import os
import threading
from datetime import UTC, date, datetime

import numpy as np
import pytest

from capture import raw
from capture.plan import PlanError, flash_plan
from capture.rig import load_rig
from capture.session import (
    CalibrationRef,
    ConsentError,
    Disk,
    Session,
    SessionDamage,
    SessionDiskError,
    SessionError,
    SessionLocked,
    SubjectRecord,
    reopen_copy,
    verification,
    verify,
)
from capture.session.manifest import seal

RIG = load_rig("flash").resized(16)
PLAN = flash_plan(RIG, states=("neutral", "anger"), darks=1)
NOON = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


def create(path, **changes):
    description = {
        "plan": PLAN,
        "rig": RIG,
        "devices": {"flash": {"idn": "SKINRIG,FLASH,0001,1.0"}},
        "subject": SubjectRecord("P042", ("research",), date(2031, 1, 1)),
        "source": "measured",
        "now": lambda: NOON,
    }
    return Session.create(path, **(description | changes))


def dng(session, step_id, *, fill=600):
    values = np.full((10, 16), fill, np.uint16)
    return raw.encode_dng(
        values, pattern="RGGB", black=512, white=16383, step_id=step_id, session_id=session.id
    )


def commit(session, step_id, *, fill=600, **changes):
    settings = session.plan.step(step_id).settings
    words = {"settings": settings, "actual": {"power": 1.0}, "t_box_s": 1.5, "t_host_s": 2.5}
    session.commit(step_id, "cam", dng(session, step_id, fill=fill), **(words | changes))


def commit_all(session):
    for number, (step, _) in enumerate(session.pending_frames()):
        commit(session, step.id, fill=600 + number)


@pytest.fixture
def session(tmp_path):
    with create(tmp_path / "s") as made:
        yield made


@pytest.fixture
def closed(session):
    commit_all(session)
    session.close()
    return session.path


def files(path):
    return {
        str(file.relative_to(path)): file.read_bytes()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


# --- life of a session ----------------------------------------------------------------------------


def test_session_is_folder_of_manifest_journal_and_frames(closed):
    assert set(files(closed)) == {
        "session.json",
        "journal.jsonl",
        *(f"frames/{step.id}+cam.dng" for step in PLAN.steps),
    }
    assert (closed / "orphans").is_dir()


def test_committed_frames_read_back_bit_for_bit(closed):
    opened = Session.open(closed)
    for number, record in enumerate(opened.frames()):
        frame = opened.read(record)
        assert set(np.unique(frame.cfa)) == {600 + number}
        assert (frame.step_id, frame.session_id) == (record.step_id, opened.id)
        assert record.settings == PLAN.step(record.step_id).settings
        assert (record.actual, record.line.t_box_s, record.line.t_host_s) == (
            {"power": 1.0},
            1.5,
            2.5,
        )


def test_todo_is_plan_minus_completed_steps(session):
    assert [step.id for step, _ in session.pending_frames()] == [step.id for step in PLAN.steps]
    commit(session, "S001")
    assert [step.id for step, _ in session.pending_frames()] == ["D000", "S000", "S002", "S003"]


def test_frames_are_found_by_kind_and_index(closed):
    opened = Session.open(closed)
    crossed = opened.frames("subject", polarizer="crossed")
    assert [record.index["state"] for record in crossed] == ["neutral", "anger"]
    assert [r.step_id for r in opened.frames("dark")] == ["D000"]
    assert opened.frames("chart") == []
    assert opened.frames(bracket=1) == []


def test_interrupted_session_continues_from_last_step(session):
    commit(session, "D000")
    session.release()
    with Session.resume(session.path) as again:
        assert [record.step_id for record in again.frames()] == ["D000"]
        assert len(again.pending_frames()) == 4
        commit_all(again)
        again.close()
    assert verify(session.path, today=NOON.date()).warnings == ()


def test_last_frame_attempt_counts_and_first_stays(session):
    commit(session, "D000", fill=700)
    commit(session, "D000", fill=800, attempt=2)
    (record,) = session.frames("dark")
    assert (record.attempt, int(session.read(record).cfa[0, 0])) == (2, 800)
    assert (session.path / "frames/D000+cam.dng").exists()


def test_reading_without_lock_shows_acknowledged_frames(session):
    commit(session, "D000")
    assert [record.step_id for record in Session.open(session.path).frames()] == ["D000"]


def test_a_second_writer_is_refused(session):
    with pytest.raises(SessionLocked, match="another process"):
        Session.resume(session.path)


def test_a_closed_session_is_never_modified(closed):
    before = files(closed)
    with pytest.raises(SessionError, match="closed"):
        Session.resume(closed)
    with pytest.raises(SessionError, match="never modified"):
        commit(Session.open(closed), "S000")
    with pytest.raises(SessionError, match="cannot start here"):
        create(closed)
    verify(closed)
    assert files(closed) == before
    assert Session.open(closed).closed


def test_an_incomplete_session_closes_only_with_a_reason(session):
    commit(session, "D000")
    with pytest.raises(SessionError, match="4 missing"):
        session.close()
    session.close(missing_reason="the subject left")
    report = verify(session.path, today=NOON.date())
    assert report.ok
    assert any("the subject left" in warning for warning in report.warnings)


def test_a_session_opened_for_reading_cannot_be_written(session):
    with pytest.raises(SessionError, match="not open for writing"):
        commit(Session.open(session.path), "D000")


def test_interrupted_creation_debris_can_be_reused(tmp_path):
    path = tmp_path / "s"
    (path / "frames").mkdir(parents=True)
    (path / "journal.jsonl").touch()
    (path / "session.json.part").write_bytes(b"{")
    with pytest.raises(SessionError, match="is not a session"):
        Session.resume(path)
    create(path).release()
    assert verify(path).ok


def test_files_without_line_are_set_aside_never_lost(session):
    commit(session, "D000")
    session.release()
    (session.path / "frames/S000+cam.dng").write_bytes(b"unacknowledged")
    (session.path / "frames/S001+cam.dng.part").write_bytes(b"half")
    with Session.resume(session.path) as again:
        assert next(step.id for step, _ in again.pending_frames()) == "S000"
    aside = sorted(file.read_bytes() for file in (session.path / "orphans").iterdir())
    assert aside == [b"half", b"unacknowledged"]
    assert [file.name for file in (session.path / "frames").iterdir()] == ["D000+cam.dng"]


def test_orphans_of_same_name_do_not_overwrite(session):
    for content in (b"first", b"second"):
        session.release()
        (session.path / "frames/S000+cam.dng").write_bytes(content)
        session = Session.resume(session.path)
    session.release()
    aside = sorted(file.read_bytes() for file in (session.path / "orphans").iterdir())
    assert aside == [b"first", b"second"]


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "error", "reason"),
    [
        ({"step_id": "S999"}, PlanError, "no step"),
        ({"step_id": "../../x"}, PlanError, "no step"),
        ({"camera": "left"}, SessionError, "no such camera"),
        ({"attempt": 0}, SessionError, "attempt: got 0, expected 1"),
        ({"settings": {"power": float("nan")}}, SessionError, r"cannot be written\n  settings"),
        ({"actual": {"note": "x" * 70_000}}, SessionError, "too long"),
        ({"blob": b"not a frame"}, raw.RawError, "not a raw file"),
        ({"blob": b""}, raw.RawError, "is not a raw file|is empty"),
    ],
)
def test_a_commit_that_cannot_be_leaves_no_trace(session, change, error, reason):
    before = files(session.path)
    words = {
        "step_id": "S000",
        "camera": "cam",
        "blob": dng(session, "S000"),
        "settings": {},
        "actual": {},
        "t_host_s": 0.0,
    } | change
    with pytest.raises(error, match=reason):
        session.commit(words.pop("step_id"), words.pop("camera"), words.pop("blob"), **words)
    assert files(session.path) == before
    commit(session, "S000")


def test_frame_of_other_step_or_session_is_refused(session, tmp_path):
    with pytest.raises(SessionError, match="step_id: got 'S001', expected S000"):
        session.commit("S000", "cam", dng(session, "S001"), settings={}, actual={}, t_host_s=0.0)
    with create(tmp_path / "other") as other, pytest.raises(SessionError, match="session_id"):
        session.commit("S000", "cam", dng(other, "S000"), settings={}, actual={}, t_host_s=0.0)


def test_a_committed_frame_is_not_committed_twice(session):
    commit(session, "D000")
    with pytest.raises(SessionError, match="already committed"):
        commit(session, "D000")


@pytest.mark.parametrize(
    ("content", "reason"),
    [("file", "got a file"), ("link", "got a link"), ("folder", r"got a folder with notes\.txt")],
)
def test_session_never_starts_over_existing_content(tmp_path, content, reason):
    path = tmp_path / "s"
    if content == "file":
        path.write_text("notes")
    elif content == "link":
        path.symlink_to(tmp_path / "elsewhere")
    else:
        path.mkdir()
        (path / "notes.txt").write_text("notes")
    with pytest.raises(SessionError, match=f"cannot start here\n  folder: {reason}"):
        create(path)
    with pytest.raises(SessionError, match="no such folder"):
        create(tmp_path / "nowhere" / "s")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"source": "guessed"}, "source"),
        ({"devices": {"flash": object()}}, "cannot be written"),
        ({"extra": {"gain": float("nan")}}, "cannot be written"),
        ({"calibrations": [{"kind": "sensor", "sha256": "abc"}]}, "sha256"),
        ({"session_id": "../x"}, "id"),
        ({"now": lambda: datetime(2026, 1, 1)}, "created_at"),
    ],
)
def test_impossible_manifest_is_refused_before_creation(tmp_path, changes, reason):
    with pytest.raises(SessionError, match=reason):
        create(tmp_path / "s", **changes)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("name", ["Ada Lovelace", "", "a/b", "x" * 65])
def test_a_subject_has_a_pseudonym_and_no_name(name):
    with pytest.raises(SessionError, match="pseudonym"):
        SubjectRecord(name)


def test_a_plan_for_another_rig_starts_no_session(tmp_path):
    plan = type(PLAN)("dome", PLAN.steps)
    with pytest.raises(PlanError, match="rig"):
        create(tmp_path / "s", plan=plan)


# --- what is kept ---------------------------------------------------------------------------------


def test_manifest_records_subject_plan_devices_and_source(tmp_path):
    digest = "sha256:" + "0" * 64
    reference = CalibrationRef("sensor", digest)
    create(
        tmp_path / "s", source="simulated", seed=7, calibrations=[reference], extra={"size": 16}
    ).release()
    opened = Session.open(tmp_path / "s")
    assert (opened.source, opened.seed) == ("simulated", 7)
    assert (opened.plan, opened.rig) == (PLAN, RIG)
    assert opened.subject == SubjectRecord("P042", ("research",), date(2031, 1, 1))
    assert opened.manifest.calibrations == (reference,)
    assert opened.manifest.created_at == NOON
    assert opened.manifest.devices["flash"]["idn"].startswith("SKINRIG")
    assert {"skinrig", "python", "numpy"} <= set(opened.manifest.versions)
    assert json.loads((tmp_path / "s/session.json").read_text())["schema"] == "skinrig.session/2"


def test_the_content_hash_vouches_for_every_commit(session):
    seen = {session.content_hash}
    for step, _ in session.pending_frames():
        commit(session, step.id)
        assert session.content_hash not in seen
        assert session.content_hash.startswith("sha256:")
        seen.add(session.content_hash)
    assert Session.open(session.path).content_hash == session.content_hash


@pytest.mark.parametrize(
    ("scope", "today", "allowed"),
    [
        ("research", date(2030, 12, 31), True),
        ("research", date(2031, 1, 1), True),
        ("research", date(2031, 1, 2), False),
        ("publication", date(2030, 1, 1), False),
    ],
)
def test_consent_ends_with_scope_and_last_day(session, scope, today, allowed):
    assert session.is_export_allowed(scope, today=today) == allowed
    if not allowed:
        with pytest.raises(ConsentError, match="P042 has not agreed"):
            session.require_consent(scope, today=today)


def test_consent_to_any_use_covers_all_scopes(tmp_path):
    subject = SubjectRecord("virtual-III", ("any",), date(2031, 1, 1))
    with create(tmp_path / "s", source="simulated", subject=subject) as made:
        assert made.is_export_allowed("publication", today=date(2031, 1, 1))
        assert not made.is_export_allowed("publication", today=date(2031, 1, 2))


def test_verify_warns_of_expired_and_of_missing_consent(closed, tmp_path):
    assert verify(closed, today=date(2031, 1, 1)).warnings == ()
    late = verify(closed, today=date(2031, 1, 2))
    assert late.ok
    assert ["consent expired on 2031-01-01" in warning for warning in late.warnings] == [True]
    with create(tmp_path / "t", subject=SubjectRecord("P1")) as made:
        assert any("no consent" in warning for warning in verify(made.path).warnings)


def test_verify_counts_frames_and_bytes(closed):
    report = verify(closed, today=NOON.date())
    sizes = [file.stat().st_size for file in (closed / "frames").iterdir()]
    assert (report.frames, report.bytes) == (len(sizes), sum(sizes))
    (closed / "session.json").write_bytes(b"{}")
    damaged = verify(closed, today=NOON.date())
    assert (damaged.ok, damaged.frames, damaged.bytes) == (False, 0, 0)


def test_interrupted_verification_leaves_other_files(session, monkeypatch):
    """Ctrl-C does not wait until a large session has been read."""
    for number in range(40):
        session.attach(f"{number}.txt", b"x")
    checked, stopped = [], threading.Event()

    def check_file(path, line):
        checked.append(line.name)
        if len(checked) > 1:
            stopped.wait(10.0)

    def stop(line):
        stopped.set()
        raise KeyboardInterrupt

    monkeypatch.setattr(verification, "check_file", check_file)
    with pytest.raises(KeyboardInterrupt):
        verify(session.path, progress=stop)
    assert len(checked) < 20


# --- the disk -------------------------------------------------------------------------------------


class FullDisk(Disk):
    """Refuses one operation, once ``after`` of its kind have worked."""

    def __init__(self, operation, after):
        self._operation, self._left = operation, after
        real = getattr(Disk, operation)

        def refuse(*arguments):
            self._left -= 1
            if self._left < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(self, *arguments)

        setattr(self, operation, refuse)


@pytest.mark.parametrize(
    "operation", ["create", "write", "fsync", "rename", "fsync_dir", "fdatasync"]
)
def test_failing_disk_costs_single_frame_not_acknowledged_ones(session, operation):
    commit(session, "D000")
    session.release()
    resumed = {"fdatasync": 1, "fsync_dir": 2}.get(operation, 0)  # the session is made durable
    writer = Session.resume(session.path, disk=FullDisk(operation, after=resumed))
    with pytest.raises(SessionDiskError, match="No space left"):
        commit(writer, "S000")
    with pytest.raises(SessionError, match="not open for writing"):
        commit(writer, "S001")
    with Session.resume(session.path) as again:
        assert "D000" in [record.step_id for record in again.frames()]
        commit_all(again)
        again.close()
    assert verify(session.path).ok


def test_disk_error_is_also_operating_system_error(tmp_path):
    with pytest.raises(OSError, match="disk refused"):
        create(tmp_path / "s", disk=FullDisk("make_dir", after=1))


def test_vanished_frame_is_reported_not_silently_retaken(session):
    commit(session, "D000")
    session.release()
    (session.path / "frames/D000+cam.dng").unlink()
    with pytest.raises(SessionDamage, match=r"frames/D000\+cam.dng: got nothing"):
        Session.resume(session.path)


# --- attachments ----------------------------------------------------------------------------------


def test_attachment_reads_back_bit_for_bit_after_closing(session):
    data = bytes(range(256)) * 9
    session.attach("scan.ply", data, about={"unit": "mm", "triangles": 12})
    assert session.attachment("scan.ply") == data
    commit_all(session)
    session.close()
    opened = Session.open(session.path)
    assert (opened.attachments(), opened.attachment("scan.ply")) == (("scan.ply",), data)
    assert opened.attachment_line("scan.ply").about == {"unit": "mm", "triangles": 12}
    assert verify(session.path, today=NOON.date()).warnings == ()
    assert verify(session.path).bytes == sum(
        file.stat().st_size
        for folder in ("frames", "attachments")
        for file in (session.path / folder).iterdir()
    )


def test_the_content_hash_vouches_for_an_attachment(session):
    before = session.content_hash
    session.attach("scan.ply", b"one")
    assert session.content_hash != before
    assert Session.open(session.path).content_hash == session.content_hash


def test_attachment_survives_interruption_strays_become_orphans(session):
    session.attach("scan.ply", b"scan")
    session.release()
    (session.path / "attachments/other.ply.part").write_bytes(b"half")
    with Session.resume(session.path) as again:
        assert again.attachment("scan.ply") == b"scan"
        again.attach("other.ply", b"whole")
    assert [file.read_bytes() for file in (session.path / "orphans").iterdir()] == [b"half"]
    assert Session.open(session.path).attachments() == ("scan.ply", "other.ply")


@pytest.mark.parametrize(
    ("name", "data", "about", "reason"),
    [
        ("../scan.ply", b"x", {}, "name"),
        ("a/b", b"x", {}, "name"),
        ("scan.part", b"x", {}, "name"),
        ("", b"x", {}, "name"),
        ("scan.ply", b"", {}, "0 bytes"),
        ("scan.ply", b"x", {"scale": float("nan")}, r"cannot be written\n  about"),
        ("there.ply", b"y", {}, "there already"),
    ],
)
def test_an_attachment_that_cannot_be_leaves_no_trace(session, name, data, about, reason):
    session.attach("there.ply", b"x")
    before = files(session.path)
    with pytest.raises(SessionError, match=reason):
        session.attach(name, data, about=about)
    assert files(session.path) == before
    with pytest.raises(SessionError, match=r"one of: there\.ply"):
        session.attachment("their.ply")


def test_nothing_is_attached_to_a_closed_session(closed):
    before = files(closed)
    with pytest.raises(SessionError, match="never modified"):
        Session.open(closed).attach("scan.ply", b"x")
    assert files(closed) == before


@pytest.mark.parametrize(
    "operation", ["make_dir", "create", "write", "fsync", "rename", "fsync_dir", "fdatasync"]
)
def test_failing_disk_costs_attachment_only_keeps_acknowledged_data(session, operation):
    commit(session, "D000")
    session.release()
    resumed = {"fdatasync": 1, "fsync_dir": 2}.get(operation, 0)  # the session is made durable
    writer = Session.resume(session.path, disk=FullDisk(operation, after=resumed))
    with pytest.raises(SessionDiskError, match="No space left"):
        writer.attach("scan.ply", b"scan")
    with Session.resume(session.path) as again:
        assert [record.step_id for record in again.frames()] == ["D000"]
        if not again.attachments():  # a refused sync leaves open whether the line arrived
            again.attach("scan.ply", b"scan")
        assert again.attachment("scan.ply") == b"scan"
    assert verify(session.path).ok


def test_copy_of_closed_session_takes_attachment_original_unchanged(tmp_path, session):
    commit(session, "D000")
    session.attach("notes.txt", b"as captured")
    session.close(missing_reason="the subject left")
    before = files(session.path)
    copy, reason = reopen_copy(session.path, tmp_path / "copy")
    copy.attach("scan.ply", b"scan")
    copy.close(missing_reason=reason)
    assert files(session.path) == before
    both = Session.open(session.path), Session.open(tmp_path / "copy")
    assert both[0].id == both[1].id
    assert both[0].content_hash != both[1].content_hash
    assert both[1].attachments() == ("notes.txt", "scan.ply")
    assert verify(tmp_path / "copy").ok
    records = [opened.read(opened.frames()[0]).cfa for opened in both]
    np.testing.assert_array_equal(*records)


def test_interrupted_copy_of_closed_session_starts_again(tmp_path, closed):
    (tmp_path / "copy/frames").mkdir(parents=True)
    (tmp_path / "copy/journal.jsonl").touch()
    copy, reason = reopen_copy(closed, tmp_path / "copy")
    copy.close(missing_reason=reason)
    assert verify(tmp_path / "copy").ok


def test_only_a_closed_and_sound_session_is_copied(tmp_path, session):
    commit(session, "D000")
    with pytest.raises(SessionError, match="is not closed"):
        reopen_copy(session.path, tmp_path / "copy")
    session.close(missing_reason="the subject left")
    file = session.path / "frames/D000+cam.dng"
    file.write_bytes(file.read_bytes()[:-1] + b"\xff")
    with pytest.raises(SessionDamage, match="D000"):
        reopen_copy(session.path, tmp_path / "copy")


def test_sealed_bytes_are_those_of_the_json_module():
    content = {"z": {"b": [1.5, {"a": None}], "a": []}, "schema": "x\ny", "\u00fc": {}}
    data, digest = seal(content)
    unsealed, sealed = (
        (json.dumps(table, sort_keys=True, indent=1) + "\n").encode("ascii")
        for table in (content, {**content, "seal": digest})
    )
    assert data == sealed
    assert digest == f"sha256:{hashlib.sha256(unsealed).hexdigest()}"
