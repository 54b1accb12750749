"""Findings of `verify`: each in its list, with its figures."""

import threading
from datetime import UTC, date, datetime, timedelta

import pytest
from fixtures.small_sessions import (
    CAMERAS,
    DOME,
    commit_frame,
    commit_pending,
    commit_step,
    create_session,
    plan_of,
)

from capture.session import Session, SessionDamage, SubjectRecord, verification, verify

DAY = date(2026, 11, 21)


@pytest.fixture
def session(tmp_path):
    with create_session(tmp_path / "s") as made:
        yield made


def test_new_session_lacks_all_its_frames(session):
    report = verify(session.path, today=DAY)
    assert (report.ok, report.complete) == (True, True)
    assert (report.problems, report.frames, report.bytes) == ((), 0, 0)
    assert report.warnings == (f"{session.path}: not closed, 3 frames of the plan are missing",)


def test_missing_frames_are_counted_per_step(session):
    commit_frame(session, "S000")
    commit_frame(session, "S000", attempt=2)
    session.omit_steps(["D000"], reason="no cap", t_host_s=0.0)
    path = session.path
    assert verify(path, today=DAY).warnings == (
        f"{path}: not closed, 1 frames of the plan are missing",
        f"{path}: 1 steps omitted: no cap",
    )
    session.close(missing_reason="the subject left")
    report = verify(path, today=DAY)
    assert report.warnings == (
        f"{path}: closed with 1 frames missing: the subject left",
        f"{path}: 1 steps omitted: no cap",
    )
    assert report.frames == 2
    assert report.bytes == sum(file.stat().st_size for file in (path / "frames").iterdir())


def test_complete_session_has_nothing_to_warn_of(session):
    commit_pending(session)
    session.attach("a.ply", b"scan")
    session.close()
    (session.path / "ascmhl").mkdir()
    report = verify(session.path, today=DAY)
    assert (report.ok, report.complete, report.warnings, report.problems) == (True, True, (), ())


def test_omissions_are_counted_per_reason(session):
    for step, reason in (("D000", "no cap"), ("S000", "blinked"), ("S001", "no cap")):
        session.omit_steps([step], reason=reason, t_host_s=0.0)
    assert verify(session.path, today=DAY).warnings[1:] == (
        f"{session.path}: 2 steps omitted: no cap",
        f"{session.path}: 1 steps omitted: blinked",
    )


def test_progress_has_one_line_per_file(session):
    commit_pending(session)
    session.attach("a.ply", b"scan")
    lines = []
    verify(session.path, progress=lines.append)
    assert lines == [f"check {number}/4 files" for number in (1, 2, 3, 4)]


def test_damaged_files_are_not_counted(session):
    commit_pending(session)
    session.attach("a.ply", b"scan")
    session.attach("b.ply", b"12345")
    sizes = {file.name: file.stat().st_size for file in (session.path / "frames").iterdir()}
    (session.path / "frames/S001+cam.dng").write_bytes(b"x")
    (session.path / "attachments/a.ply").write_bytes(b"scam")
    report = verify(session.path)
    assert (report.ok, report.frames) == (False, 2)
    assert report.bytes == sizes["D000+cam.dng"] + sizes["S000+cam.dng"] + 5
    assert ["S001" in report.problems[0], "a.ply" in report.problems[1]] == [True, True]
    assert report.damage == report.problems
    assert len(report.problems) == 2


def test_stray_of_open_session_is_warning(session):
    """An interruption leaves it; of a closed session it is a problem."""
    stray = session.path / "frames/S000+cam.dng"
    stray.write_bytes(b"x")
    note = f"{stray}: no line in the journal; it was never acknowledged; resuming sets it aside"
    report = verify(session.path, today=DAY)
    assert (report.ok, report.complete) == (True, True)
    assert report.warnings[0] == note
    stray.unlink()
    commit_pending(session)
    session.close()
    for name in ("x.part", "y.dng"):
        (session.path / "frames" / name).write_bytes(b"x")
    report = verify(session.path, today=DAY)
    assert (report.ok, report.complete, report.warnings) == (False, True, ())
    assert len(report.problems) == 2


def test_two_strays_are_lost_lines(session):
    for step in ("S000", "S001"):
        (session.path / f"frames/{step}+cam.dng").write_bytes(b"x")
    report = verify(session.path, today=DAY)
    assert (report.ok, report.complete) == (False, False)
    assert [problem.count("2 files without a line") for problem in report.problems] == [1]
    assert report.warnings == (f"{session.path}: not closed, 3 frames of the plan are missing",)


def test_damaged_journal_reports_no_strays(session):
    """Files whose lines cannot be read have lines: they are not called strays."""
    commit_frame(session, "S000")
    commit_frame(session, "S001")
    journal = session.path / "journal.jsonl"
    journal.write_bytes(journal.read_bytes().replace(b"S000", b"S00x", 1))
    report = verify(session.path, today=DAY)
    assert ["byte 0: " in problem for problem in report.problems] == [True]
    assert report.frames == 0


def test_torn_line_and_orphans_are_counted(session):
    commit_frame(session, "S000")
    end = (session.path / "journal.jsonl").stat().st_size
    with (session.path / "journal.jsonl").open("ab") as journal:
        journal.write(b'{"h":')
    for name in ("a", "b"):
        (session.path / "orphans" / name).write_bytes(b"x")
    path = session.path
    assert verify(path, today=DAY).warnings == (
        f"{path / 'journal.jsonl'}, byte {end}: 5 bytes of a line cut off by a crash; "
        "resuming cuts them",
        f"{path}: not closed, 2 frames of the plan are missing",
        f"{path / 'orphans'}: 2 files set aside after interruptions",
    )


def test_session_without_orphans_folder_is_sound(session):
    (session.path / "orphans").rmdir()
    assert verify(session.path, today=DAY).ok


def test_foreign_files_are_listed_by_name(session):
    for name in ("notes.txt", "index.sqlite", "Icon"):
        (session.path / name).touch()
    assert verify(session.path, today=DAY).warnings[1:] == tuple(
        f"{session.path / name}: not a part of the session, not verified"
        for name in ("Icon", "notes.txt")
    )


@pytest.mark.parametrize(("days", "warned"), [(-1, True), (1, False), (None, False)])
def test_consent_is_evaluated_on_current_day(tmp_path, days, warned):
    expires = None if days is None else datetime.now(UTC).date() + timedelta(days)
    subject = SubjectRecord("P042", ("research",), expires)
    with create_session(tmp_path / "s", subject=subject) as made:
        warnings = verify(made.path).warnings
    assert [f"consent expired on {expires}" in one for one in warnings] == [False, *[True] * warned]


def test_unreadable_manifest_ends_verification(session):
    (session.path / "session.json").write_bytes(b"{}")
    report = verify(session.path)
    assert (report.ok, report.warnings, report.frames, report.bytes) == (False, (), 0, 0)
    assert len(report.problems) == 1


def test_files_are_checked_at_same_time(session, monkeypatch):
    """Each reader waits until all are busy, which one reader alone would never see."""
    for number in range(verification.N_READERS):
        session.attach(f"{number}.txt", b"x")
    together = threading.Barrier(verification.N_READERS)
    monkeypatch.setattr(verification, "check_file", lambda *_: together.wait(10.0))
    assert verify(session.path).ok


@pytest.mark.parametrize("back", [2, 3, 4])
@pytest.mark.parametrize("place", [3, 75, 200, -3])
def test_zeros_in_lines_before_end_are_damage(tmp_path, back, place):
    """Two zero bytes in a line of the last step; the line of the end is whole."""
    plan = plan_of(2, len(CAMERAS))
    with create_session(tmp_path / "s", plan=plan, rig=DOME) as session:
        for step in plan.steps:
            commit_step(session, step.id)
        session.close()
    journal = tmp_path / "s/journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    start = place % len(lines[-back])
    lines[-back] = lines[-back][:start] + b"\0\0" + lines[-back][start + 2 :]
    journal.write_bytes(b"".join(lines))
    (problem,) = verify(tmp_path / "s").problems
    assert f"journal.jsonl, byte {sum(map(len, lines[:-back]))}: " in problem
    with pytest.raises(SessionDamage):
        Session.resume(tmp_path / "s")
    assert journal.read_bytes() == b"".join(lines)
    assert list((tmp_path / "s/orphans").iterdir()) == []
