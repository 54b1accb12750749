"""A second copy of a session: equal bytes, or one error that names the file."""

import errno
import fcntl
import os

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import (
    Disk,
    Session,
    SessionDamage,
    SessionDiskError,
    SessionError,
    SessionLocked,
    SubjectRecord,
    verify,
)
from capture.session.consent_seal import KEY_VARIABLE, SEAL_FILE, SEALED_STATE, UNCHECKED_STATE
from capture.session.copying import copy_session, part_folder

RIG = load_rig("flash").resized(16)
FRAMES = 6
PLAN = Plan("flash", tuple(Step(f"S{n:03d}", "subject", {}, {}, ("cam",)) for n in range(FRAMES)))


def write_session(path, *, frames=FRAMES, close=True, session_id="copied"):
    """Write a session of small frames and one attachment; return its folder."""
    session = Session.create(
        path,
        plan=PLAN,
        rig=RIG,
        devices={},
        subject=SubjectRecord("P1", ("research",)),
        source="simulated",
        session_id=session_id,
    )
    session.attach("scan.ply", b"ply: a scan")
    for step, camera in session.pending_frames()[:frames]:
        commit(session, step, camera)
    if close:
        session.close(missing_reason="" if frames == FRAMES else "stopped")
    session.release()
    return path


@pytest.fixture
def key(tmp_path_factory, monkeypatch):
    """The file of a lab's key, which is set."""
    path = tmp_path_factory.mktemp("lab") / "consent.key"
    path.write_bytes(bytes(range(32)))
    path.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    return path


def commit(session, step, camera):
    values = np.full((10, 16), 600 + int(step.id[1:]), np.uint16)
    blob = raw.encode_dng(
        values, pattern="RGGB", black=512, white=16383, step_id=step.id, session_id=session.id
    )
    session.commit(step.id, camera, blob, settings={}, actual={}, t_host_s=0.0)


def read_files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class FailingDisk(Disk):
    """A disk that raises an error at one write, or changes the bytes of it."""

    def __init__(self, number, *, code=None):
        self.number, self.code, self.count = number, code, 0

    def write(self, descriptor, data):
        self.count += 1
        if self.count == self.number:
            if self.code is not None:
                raise OSError(self.code, os.strerror(self.code))
            data = bytes(data)[:-1] + bytes([data[-1] ^ 1])
        super().write(descriptor, data)


class NetworkDisk(Disk):
    """A disk that locks as NFS does: exclusively only by a descriptor that can write."""

    def lock(self, descriptor, *, shared=False):
        mode = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE
        if mode == (os.O_WRONLY if shared else os.O_RDONLY):
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return super().lock(descriptor, shared=shared)


@pytest.mark.parametrize("read_back", [False, True])
@pytest.mark.parametrize("frames", [0, 3, FRAMES])
@pytest.mark.parametrize("close", [True, False])
def test_copy_has_equal_bytes(tmp_path, read_back, frames, close):
    source = write_session(tmp_path / "s", frames=frames, close=close)
    lines = []
    found = copy_session(source, tmp_path / "c", read_back=read_back, progress=lines.append)
    assert read_files(tmp_path / "c") == read_files(source)
    assert found.frames == frames
    assert found.content_hash == Session.open(tmp_path / "c").content_hash
    assert (found.kept, found.verified) == (0, read_back)
    assert lines[-1] == f"copy {frames + 1}/{frames + 1} files"
    assert verify(tmp_path / "c").ok
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c", "s"]


def test_copy_of_torn_journal_has_committed_lines(tmp_path):
    source = write_session(tmp_path / "s", frames=3, close=False)
    with (source / "journal.jsonl").open("ab") as stream:
        stream.write(b'{"h":"half')
    copy_session(source, tmp_path / "c")
    with Session.resume(tmp_path / "c") as session:
        assert len(session.frames()) == 3


@pytest.mark.parametrize("number", range(1, FRAMES + 4))
def test_copy_on_full_disk_continues_later(tmp_path, number):
    source = write_session(tmp_path / "s")
    disk = FailingDisk(number, code=errno.ENOSPC)
    with pytest.raises(SessionDiskError, match="run the same command again"):
        copy_session(source, tmp_path / "c", disk=disk)
    assert not (tmp_path / "c").exists()
    found = copy_session(source, tmp_path / "c", read_back=True)
    assert read_files(tmp_path / "c") == read_files(source)
    assert found.kept <= FRAMES + 1


@pytest.mark.parametrize("number", range(1, FRAMES + 4))
def test_changed_byte_of_copy_is_found(tmp_path, number):
    source = write_session(tmp_path / "s")
    with pytest.raises(SessionDamage, match=r"not as it was written|damaged"):
        copy_session(source, tmp_path / "c", read_back=True, disk=FailingDisk(number))
    assert not (tmp_path / "c").exists()
    copy_session(source, tmp_path / "c", read_back=True)
    assert read_files(tmp_path / "c") == read_files(source)


def test_damaged_file_of_unfinished_copy_is_replaced(tmp_path):
    source = write_session(tmp_path / "s")
    with pytest.raises(SessionDiskError):
        copy_session(source, tmp_path / "c", disk=FailingDisk(FRAMES + 3, code=errno.EIO))
    part = part_folder(tmp_path / "c")
    there = sorted((part / "frames").glob("*.dng"))
    there[0].write_bytes(there[0].read_bytes()[:-1] + b"\x01")
    found = copy_session(source, tmp_path / "c")
    assert found.kept == FRAMES
    assert read_files(tmp_path / "c") == read_files(source)


def test_damaged_source_is_refused_by_name(tmp_path):
    source = write_session(tmp_path / "s")
    frame = source / "frames/S002+cam.dng"
    frame.write_bytes(frame.read_bytes()[:-1] + b"\x01")
    with pytest.raises(SessionDamage, match=r"S002\+cam"):
        copy_session(source, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_source_that_changes_meanwhile_is_refused(tmp_path):
    source = write_session(tmp_path / "s", frames=3, close=False)

    def extend(line):
        if line.startswith("copy 4/"):  # by a program that ignores the lock
            (source / "journal.jsonl").write_bytes(b"")

    with pytest.raises(SessionError, match="changed while it was copied"):
        copy_session(source, tmp_path / "c", progress=extend)
    assert not (tmp_path / "c").exists()


def test_session_being_captured_is_refused(tmp_path):
    source = write_session(tmp_path / "s", frames=3, close=False)
    with Session.resume(source), pytest.raises(SessionLocked):
        copy_session(source, tmp_path / "c")
    # and nobody captures while it is copied
    refused = []

    def resume(_):
        with pytest.raises(SessionLocked):
            Session.resume(source)
        refused.append(True)

    copy_session(source, tmp_path / "c", progress=resume)
    assert refused


def test_unfinished_copy_of_another_session_is_refused(tmp_path):
    first = write_session(tmp_path / "s")
    other = write_session(tmp_path / "t", session_id="other")
    with pytest.raises(SessionDiskError):
        copy_session(first, tmp_path / "c", disk=FailingDisk(4, code=errno.ENOSPC))
    with pytest.raises(SessionError, match="SR-SES-019"):
        copy_session(other, tmp_path / "c")


@pytest.mark.parametrize("name", ["there", "s/inside", "none/c", "s"])
def test_unusable_folder_of_copy_is_refused(tmp_path, name):
    source = write_session(tmp_path / "s")
    (tmp_path / "there").mkdir()
    before = read_files(tmp_path)
    with pytest.raises(SessionError, match="SR-SES-022"):
        copy_session(source, tmp_path / name)
    assert read_files(tmp_path) == before


@pytest.mark.parametrize("read_back", [False, True])
@pytest.mark.parametrize("with_key", [False, True])
def test_copy_of_sealed_session_keeps_seal(tmp_path, key, monkeypatch, read_back, with_key):
    source = write_session(tmp_path / "s")
    if not with_key:
        monkeypatch.delenv(KEY_VARIABLE)
    copy_session(source, tmp_path / "c", read_back=read_back)
    assert read_files(tmp_path / "c") == read_files(source)
    assert (tmp_path / "c" / SEAL_FILE).is_file()
    found = verify(tmp_path / "c")
    assert found.ok
    assert found.consent_seal == (SEALED_STATE if with_key else UNCHECKED_STATE)
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    assert verify(tmp_path / "c").consent_seal == SEALED_STATE


@pytest.mark.parametrize("code", [errno.ENOSPC, None])
@pytest.mark.parametrize("number", range(1, FRAMES + 5))
def test_failed_copy_of_sealed_session_continues(tmp_path, key, code, number):
    source = write_session(tmp_path / "s")
    with pytest.raises((SessionDiskError, SessionDamage)):
        copy_session(source, tmp_path / "c", read_back=True, disk=FailingDisk(number, code=code))
    assert not (tmp_path / "c").exists()
    copy_session(source, tmp_path / "c", read_back=True)
    assert read_files(tmp_path / "c") == read_files(source)


def test_unfinished_copy_drops_seal_of_before(tmp_path, key, monkeypatch):
    """The seal was removed between an interrupted copy and its continuation."""
    source = write_session(tmp_path / "s")
    with pytest.raises(SessionDiskError):
        copy_session(source, tmp_path / "c", disk=FailingDisk(FRAMES + 4, code=errno.ENOSPC))
    assert (part_folder(tmp_path / "c") / SEAL_FILE).exists()
    (source / SEAL_FILE).unlink()
    monkeypatch.delenv(KEY_VARIABLE)
    copy_session(source, tmp_path / "c")
    assert read_files(tmp_path / "c") == read_files(source)


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("close", [False, True])
def test_second_copy_to_same_place_is_refused(tmp_path, cut, close):
    """Also when the first continues a copy whose manifest was cut off."""
    source = write_session(tmp_path / "s", close=close)
    refused = []
    if cut:
        with pytest.raises(SessionDiskError):
            copy_session(source, tmp_path / "c", disk=FailingDisk(1, code=errno.ENOSPC))
        stamp = part_folder(tmp_path / "c") / "session.json.part"
        stamp.write_bytes((source / "session.json").read_bytes()[:100])

    def copy_again(_):
        with pytest.raises(SessionLocked, match=r"\.c\.copying"):
            copy_session(source, tmp_path / "c")
        refused.append(True)

    copy_session(source, tmp_path / "c", progress=copy_again)
    assert len(refused) == FRAMES + 1
    assert read_files(tmp_path / "c") == read_files(source)


@pytest.mark.parametrize("close", [False, True])
def test_copy_locks_files_as_nfs_allows(tmp_path, close):
    source = write_session(tmp_path / "s", close=close)
    copy_session(source, tmp_path / "c", disk=NetworkDisk())
    assert read_files(tmp_path / "c") == read_files(source)


def test_open_session_is_copied_twice_at_once(tmp_path):
    source = write_session(tmp_path / "s", frames=1, close=False)
    copies = iter(["d", "e"])
    copy_session(
        source, tmp_path / "c", progress=lambda _: copy_session(source, tmp_path / next(copies))
    )
    for name in "cde":
        assert read_files(tmp_path / name) == read_files(source)
