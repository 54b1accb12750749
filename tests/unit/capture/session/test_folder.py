"""A session's folder: where one may begin, what is set aside, how the disk's errors are named."""

import errno
import logging
import os

import pytest
from fixtures.small_sessions import CAMERAS, DOME, commit_frame, create_session, plan_of

from capture.session import Session, SessionDamage, SessionDiskError, SessionError
from capture.session.disk import Disk
from capture.session.folder import DiskErrors, require_free, write_new


@pytest.mark.parametrize("kept", [(), ("frames", "orphans"), ("journal.jsonl",)])
def test_parts_of_interrupted_creation_are_free(tmp_path, kept):
    for name in kept:
        (tmp_path / name).touch() if "." in name else (tmp_path / name).mkdir()
    for name in ("session.json.part", "consent.seal", "consent.seal.part"):
        require_free(tmp_path)
        (tmp_path / name).write_bytes(b"half")
    require_free(tmp_path)


@pytest.mark.parametrize(
    ("file", "shown"),
    [
        ("frames/a.dng", "frames"),
        ("orphans/a.dng.1", "orphans"),
        ("journal.jsonl", "journal.jsonl"),
        ("session.json", "session.json"),
        ("attachments/a.ply", "attachments"),
    ],
)
def test_folder_with_captured_content_is_occupied(tmp_path, file, shown):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_bytes(b"x")
    with pytest.raises(SessionError) as caught:
        require_free(tmp_path)
    assert f"folder: got a folder with {shown}, expected a new or empty folder" in str(caught.value)
    assert "[SR-SES-008]" in str(caught.value)


def test_occupied_folder_shows_five_names_at_most(tmp_path):
    for name in "gfedcba":
        (tmp_path / name).touch()
    with pytest.raises(SessionError, match="a folder with a, b, c, d, e, expected"):
        require_free(tmp_path)


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        ("file", "folder: got a file, expected a new or empty folder"),
        ("link", "folder: got a link, expected a new or empty folder"),
        ("nowhere/s", "parent: got no such folder, expected an existing folder"),
    ],
)
def test_place_without_folder_is_named(tmp_path, kind, fault):
    (tmp_path / "file").touch()
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(SessionError) as caught:
        require_free(tmp_path / kind)
    assert f"{tmp_path / kind}: cannot start here\n  {fault}" in str(caught.value)


def test_new_folder_is_free(tmp_path):
    require_free(tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_interrupted_creation_continues_where_it_ended(tmp_path):
    """Whatever was made before: folders, the empty journal, a part of the manifest."""
    create_session(tmp_path / "whole").release()
    names = ["frames", "orphans", "journal.jsonl", "session.json.part"]
    for count in range(len(names) + 1):
        path = tmp_path / f"s{count}"
        path.mkdir()
        for name in names[:count]:
            (path / name).touch() if "." in name else (path / name).mkdir()
        with create_session(path) as session:
            commit_frame(session, "S000")
        assert {one.name for one in path.iterdir()} == {
            one.name for one in (tmp_path / "whole").iterdir()
        }


def test_disk_errors_name_file_and_cause(tmp_path):
    with pytest.raises(SessionDiskError, match="the disk refused: No space left") as caught:
        with DiskErrors(tmp_path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(caught.value).startswith(f"{tmp_path}: ")
    assert "committed frames are safe. [SR-SES-013]" in str(caught.value)
    with pytest.raises(SessionDiskError, match=r"/a\.dng: the disk refused: Input") as caught:
        with DiskErrors(tmp_path, advice="Try again."):
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(tmp_path / "a.dng"))
    assert "Try again. [SR-SES-013]" in str(caught.value)
    with pytest.raises(SessionDiskError, match="the disk refused: torn"), DiskErrors(tmp_path):
        raise OSError("torn")


@pytest.mark.parametrize(
    "error", [ValueError("x"), SessionError("x"), SessionDiskError("x"), KeyboardInterrupt()]
)
def test_other_errors_pass_unchanged(tmp_path, error):
    with pytest.raises(type(error)) as caught, DiskErrors(tmp_path):
        raise error
    assert caught.value is error


def test_refused_new_file_is_closed(tmp_path):
    class Refusing(Disk):
        def fsync(self, descriptor):
            raise OSError(errno.EIO, "refused")

        def close(self, descriptor):
            closed.append(descriptor)
            super().close(descriptor)

    closed = []
    with pytest.raises(OSError, match="refused"):
        write_new(Refusing(), tmp_path / "a", b"light")
    assert len(closed) == 1


@pytest.mark.parametrize("size", [None, 3])
def test_changed_committed_file_stops_resumption(tmp_path, size):
    with create_session(tmp_path / "s") as session:
        commit_frame(session, "S000")
        session.attach("a.ply", b"scan")
    file = tmp_path / "s/attachments/a.ply"
    (tmp_path / "s/frames/S001+cam.dng").write_bytes(b"stray")
    if size is None:
        file.unlink()
    else:
        file.write_bytes(b"x" * size)
    got = "nothing" if size is None else "3 bytes"
    fault = f"attachments/a.ply: got {got}, expected 4 bytes, as committed"
    with pytest.raises(SessionDamage) as caught:
        Session.resume(tmp_path / "s")
    assert fault in str(caught.value)
    assert "a committed file is gone" in str(caught.value)
    assert (tmp_path / "s/frames/S001+cam.dng").exists()


def test_strays_of_equal_name_keep_their_content(tmp_path, caplog):
    """Of frames and attachments at once, and of two interruptions."""
    create_session(tmp_path / "s").release()
    (tmp_path / "s/attachments").mkdir()
    contents = set()
    for turn in range(2):
        for folder in ("frames", "attachments"):
            contents.add(content := f"{folder} {turn}")
            (tmp_path / "s" / folder / "x.part").write_text(content)
        with caplog.at_level(logging.WARNING):
            Session.resume(tmp_path / "s").release()
    orphans = {path.name: path.read_text() for path in (tmp_path / "s/orphans").iterdir()}
    assert sorted(orphans) == [f"x.part.{number}" for number in (1, 2, 3, 4)]
    assert set(orphans.values()) == contents
    shown = [record.getMessage() for record in caplog.records]
    assert shown == [
        f"{tmp_path / 's' / folder / 'x.part'}: no line in the journal, set aside"
        for _ in range(2)
        for folder in ("attachments", "frames")
    ]


@pytest.mark.parametrize("cameras", [1, 3])
def test_strays_of_one_step_are_set_aside(tmp_path, cameras):
    """One interruption leaves the files of one step; of more, the journal has lost lines."""
    create_session(tmp_path / "s", plan=plan_of(2, cameras), rig=DOME).release()
    strays = [tmp_path / f"s/frames/S000+{camera}.dng" for camera in CAMERAS[:cameras]]
    for stray in strays:
        stray.write_bytes(b"x")
    (tmp_path / "s/frames/S001+C00.dng").write_bytes(b"x")
    with pytest.raises(SessionDamage, match=rf"got {cameras + 1} files .* at most {cameras}, "):
        Session.resume(tmp_path / "s")
    assert list((tmp_path / "s/orphans").iterdir()) == []
    (tmp_path / "s/frames/S001+C00.dng").unlink()
    Session.resume(tmp_path / "s").release()
    assert len(list((tmp_path / "s/orphans").iterdir())) == cameras


def test_several_strays_are_lost_lines(tmp_path):
    """One interruption leaves one file without a line; of two, the journal has lost a line."""
    create_session(tmp_path / "s").release()
    for step in ("S000", "S001"):
        (tmp_path / f"s/frames/{step}+cam.dng").write_bytes(b"x")
    with pytest.raises(SessionDamage, match="got 2 files without a line, first frames/S000"):
        Session.resume(tmp_path / "s")
    assert list((tmp_path / "s/orphans").iterdir()) == []
