"""Order of disk operations: data reach the medium before their name, the name before its line.

What a power cut leaves of each order is in `tests/faults/test_power_cut.py`. Here each operation
is in its place, also those whose loss only another file system shows.
"""

import shutil

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
    plan_of,
)

from capture.session import Session, SessionError, reopen_copy
from capture.session.consent_seal import KEY_VARIABLE
from capture.session.folder import seal_consent


@pytest.fixture
def disk(tmp_path):
    return NotedDisk(tmp_path)


@pytest.fixture
def key(tmp_path, monkeypatch):
    """The file of a lab's key, which is set."""
    path = tmp_path / "consent.key"
    path.write_bytes(bytes(range(32)))
    path.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    return path


def written(file):
    """Operations that write a new file."""
    return [f"{one} {file}" for one in ("create", "write", "fsync", "close")]


def manifest_written(folder):
    return [
        *written(f"{folder}/session.json.part"),
        *(f"fsync_dir {folder}", f"rename {folder}/session.json", f"fsync_dir {folder}"),
        "fsync_dir .",
    ]


def acquired(folder):
    return [f"{one} {folder}/journal.jsonl" for one in ("open_append", "lock", "fdatasync")]


def resumed(folder):
    """Operations that resume: the last process may have ended before its names were durable."""
    return [*acquired(folder), f"fsync_dir {folder}", "fsync_dir ."]


def line_written(folder):
    return [f"{one} {folder}/journal.jsonl" for one in ("write", "fdatasync")]


def test_session_exists_once_its_parts_are_durable(tmp_path, disk):
    create_session(tmp_path / "s", disk=disk).release()
    assert disk.take_notes() == [
        *(f"make_dir {folder}" for folder in ("s", "s/frames", "s/orphans")),
        *written("s/journal.jsonl"),
        *manifest_written("s"),
        *acquired("s"),
        "close s/journal.jsonl",
    ]


def test_frame_is_durable_before_its_line(tmp_path, disk):
    with create_session(tmp_path / "s", disk=disk) as session:
        disk.take_notes()
        commit_frame(session, "S000")
        assert disk.take_notes() == [
            *written("s/frames/S000+cam.dng.part"),
            *("rename s/frames/S000+cam.dng", "fsync_dir s/frames"),
            *line_written("s"),
        ]


def test_frames_of_step_share_flushes(tmp_path, disk):
    plan = plan_of(1, len(CAMERAS))
    files = [f"s/frames/S000+{camera}.dng" for camera in CAMERAS]
    with create_session(tmp_path / "s", disk=disk, plan=plan, rig=DOME) as session:
        disk.take_notes()
        commit_step(session, "S000")
        assert disk.take_notes() == [
            *(one for file in files for one in written(f"{file}.part")),
            *(f"rename {file}" for file in files),
            *("fsync_dir s/frames", *line_written("s")),
        ]


def test_first_attachment_makes_durable_folder(tmp_path, disk):
    with create_session(tmp_path / "s", disk=disk) as session:
        for before in (["make_dir s/attachments", "fsync_dir s"], []):
            name = f"{len(before)}.ply"
            disk.take_notes()
            session.attach(name, b"scan")
            assert disk.take_notes() == [
                *before,
                *written(f"s/attachments/{name}.part"),
                *(f"rename s/attachments/{name}", "fsync_dir s/attachments"),
                *line_written("s"),
            ]


def test_folder_of_interrupted_attachment_becomes_durable(tmp_path, disk):
    """The folder is there, but its name may not have reached the medium."""
    with create_session(tmp_path / "s", disk=disk) as session:
        (tmp_path / "s/attachments").mkdir()
        disk.take_notes()
        session.attach("scan.ply", b"scan")
    assert disk.take_notes()[:2] == ["fsync_dir s", "create s/attachments/scan.ply.part"]


def test_omission_and_end_are_durable_lines(tmp_path, disk):
    session = create_session(tmp_path / "s", disk=disk)
    disk.take_notes()
    session.omit_steps([step.id for step in PLAN.steps], reason="blinked", t_host_s=0.0)
    assert disk.take_notes() == line_written("s")
    session.close()
    assert disk.take_notes() == [*line_written("s"), "close s/journal.jsonl"]
    session.release()
    assert disk.take_notes() == []


def test_resuming_cuts_line_then_moves_strays(tmp_path, disk):
    with create_session(tmp_path / "s") as session:
        session.attach("scan.ply", b"scan")
    for stray in ("frames/S000+cam.dng.part", "attachments/b.ply"):
        (tmp_path / "s" / stray).write_bytes(b"half")
    with (tmp_path / "s/journal.jsonl").open("ab") as journal:
        journal.write(b'{"h":"half')
    Session.resume(tmp_path / "s", disk=disk).release()
    opened, locked, *flushed = resumed("s")
    assert disk.take_notes() == [
        *(opened, locked, "truncate s/journal.jsonl", *flushed),
        *(f"rename s/orphans/{name}.1" for name in ("b.ply", "S000+cam.dng.part")),
        *(f"fsync_dir s/{folder}" for folder in ("orphans", "attachments", "frames")),
        "close s/journal.jsonl",
    ]


def test_dropped_folder_of_orphans_is_made_again(tmp_path, disk):
    """Mail and archives drop empty folders; resuming named the disk as its cause."""
    create_session(tmp_path / "s").release()
    (tmp_path / "s/orphans").rmdir()
    Session.resume(tmp_path / "s", disk=disk).release()
    assert disk.take_notes() == [*resumed("s"), "close s/journal.jsonl"]
    (tmp_path / "s/frames/S000+cam.dng").write_bytes(b"stray")
    Session.resume(tmp_path / "s", disk=disk).release()
    assert disk.take_notes() == [
        *resumed("s"),
        *("make_dir s/orphans", "fsync_dir s", "rename s/orphans/S000+cam.dng.1"),
        *("fsync_dir s/orphans", "fsync_dir s/frames", "close s/journal.jsonl"),
    ]


def test_refused_resumption_leaves_no_lock(tmp_path, disk):
    with create_session(tmp_path / "s") as session:
        commit_frame(session, "S000")
    frame = tmp_path / "s/frames/S000+cam.dng"
    frame.rename(tmp_path / "away")
    with pytest.raises(SessionError, match="a committed file is gone"):
        Session.resume(tmp_path / "s", disk=disk)
    assert disk.take_notes() == [*resumed("s"), "close s/journal.jsonl"]
    (tmp_path / "away").rename(frame)
    Session.resume(tmp_path / "s").release()


def test_session_closed_meanwhile_is_not_resumed(tmp_path, disk):
    with create_session(tmp_path / "s") as session:
        commit_pending(session)
        session.close()
    with pytest.raises(SessionError, match="the session is closed") as caught:
        Session.resume(tmp_path / "s", disk=disk)
    assert "[SR-SES-002]" in str(caught.value)
    assert disk.take_notes() == [*resumed("s")[:2], "close s/journal.jsonl"]


def test_consent_seal_is_durable(tmp_path, disk, key, monkeypatch):
    monkeypatch.delenv(KEY_VARIABLE)
    create_session(tmp_path / "s").release()
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    seal_consent(tmp_path / "s", disk=disk)
    sealed = [*written("s/consent.seal.part"), "rename s/consent.seal"]
    assert disk.take_notes() == [*sealed, "fsync_dir s"]
    seal_consent(tmp_path / "s", disk=disk)
    assert disk.take_notes() == []
    create_session(tmp_path / "t", disk=disk).release()
    notes = disk.take_notes()
    place = notes.index("create t/consent.seal.part")
    assert notes[place : place + 6] == [
        *(one.replace("s/", "t/") for one in sealed),
        "create t/session.json.part",
    ]


def test_leftovers_of_creation_are_removed_first(tmp_path, disk, key, monkeypatch):
    create_session(tmp_path / "s").release()
    (tmp_path / "s/session.json").rename(tmp_path / "s/session.json.part")
    shutil.copy(tmp_path / "s/consent.seal", tmp_path / "s/consent.seal.part")
    monkeypatch.delenv(KEY_VARIABLE)
    create_session(tmp_path / "s", disk=disk).release()
    assert disk.take_notes() == [
        *("remove s/consent.seal.part", "remove s/consent.seal", "remove s/session.json.part"),
        *manifest_written("s"),
        *acquired("s"),
        "close s/journal.jsonl",
    ]


@pytest.mark.parametrize("attached", [False, True])
@pytest.mark.parametrize("interrupted", [False, True])
def test_copy_exists_once_its_files_are_durable(tmp_path, disk, attached, interrupted):
    with create_session(tmp_path / "s") as session:
        commit_frame(session, "S000")
        if attached:
            session.attach("a.ply", b"scan")
        session.close(missing_reason="the subject left")
    if interrupted:
        (tmp_path / "c").mkdir()
        (tmp_path / "c/journal.jsonl").touch()
    copy, _ = reopen_copy(tmp_path / "s", tmp_path / "c", disk=disk)
    copy.release()
    folders = ["c/frames", "c/orphans", *["c/attachments"] * attached]
    assert disk.take_notes() == [
        *(f"make_dir {folder}" for folder in (*["c"] * (not interrupted), *folders)),
        *written("c/frames/S000+cam.dng"),
        *(written("c/attachments/a.ply") if attached else []),
        *(f"fsync_dir {folder}" for folder in folders),
        *["remove c/journal.jsonl"] * interrupted,
        *written("c/journal.jsonl"),
        *manifest_written("c"),
        *resumed("c"),
        "close c/journal.jsonl",
    ]
