"""Durable writes: synchronization is called for the file or folder concerned.

`tests/conftest.py` has the tests wait for no disk, and a model of the disk stands in
`tests/faults/test_power_cut.py`; here the calls to the operating system themselves are seen.
"""

import contextlib
import errno
import os
import stat
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from capture import raw
from capture.calibration import store as calibration_store
from capture.session.disk import N_WRITERS, Disk, read_file
from capture.session.errors import SessionDamage, SessionError
from capture.session.folder import write_group


@pytest.fixture
def synced(monkeypatch):
    """What was brought to the disk: how, and which file or folder, by its number."""
    seen = []
    for call in ("fsync", "fdatasync"):
        monkeypatch.setattr(
            os, call, lambda descriptor, call=call: seen.append((call, os.fstat(descriptor).st_ino))
        )
    return seen


def test_files_and_folders_are_synchronized_by_named_call(tmp_path, synced):
    disk = Disk()
    descriptor = disk.create(tmp_path / "frame")
    disk.write(descriptor, b"light")
    disk.fsync(descriptor)
    disk.fdatasync(descriptor)
    disk.close(descriptor)
    disk.fsync_dir(tmp_path)
    file, folder = (tmp_path / "frame").stat().st_ino, tmp_path.stat().st_ino
    assert synced == [("fsync", file), ("fdatasync", file), ("fsync", folder)]


def test_synchronized_folder_is_closed_again(tmp_path, synced, monkeypatch):
    """A session of many frames would end with too many open files."""
    opened, open_file = [], os.open

    def open_noted(*args, **named):
        opened.append(open_file(*args, **named))
        return opened[-1]

    monkeypatch.setattr(os, "open", open_noted)
    Disk().fsync_dir(tmp_path)
    (descriptor,) = opened
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)


def test_raw_file_is_on_disk_before_naming(tmp_path, synced):
    raw.write_dng(
        tmp_path / "a.dng",
        np.full((16, 16), 600, np.uint16),
        pattern="RGGB",
        black=512,
        white=16383,
        step_id="S000",
        session_id="s",
    )
    assert synced == [("fsync", (tmp_path / "a.dng").stat().st_ino)]


def test_calibration_and_its_name_are_on_disk(tmp_path, synced):
    calibration_store._write_atomically(tmp_path / "white.json", b"{}")
    file, folder = (tmp_path / "white.json").stat().st_ino, tmp_path.stat().st_ino
    assert synced == [("fsync", file), ("fsync", folder)]


def test_files_of_step_are_synchronized_before_their_names(tmp_path, synced):
    files = [tmp_path / f"{number}.dng" for number in range(9)]
    write_group(Disk(), [(path, b"light") for path in files])
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"light"}
    inodes = {("fsync", path.stat().st_ino) for path in files}
    assert (set(synced[:-1]), len(synced)) == (inodes, len(files) + 1)
    assert synced[-1] == ("fsync", tmp_path.stat().st_ino)


def test_work_is_done_by_several_threads_at_once():
    together = threading.Barrier(N_WRITERS, timeout=10.0)
    Disk().for_each(lambda _: together.wait(), range(2 * N_WRITERS))


def test_error_of_work_begins_no_further_item():
    """It is raised once no thread writes any more: the caller may then release the session."""
    begun, ended, made = [], [], []
    together = threading.Barrier(N_WRITERS, timeout=10.0)

    def make():
        for number in range(1000):
            made.append(number)
            yield number
            if number >= N_WRITERS:
                time.sleep(0.01)

    def work(number):
        begun.append(number)
        together.wait()
        if number == 0:
            raise OSError(errno.ENOSPC, "full")
        time.sleep(0.3)
        ended.append(number)

    with pytest.raises(OSError, match="full"):
        Disk().for_each(work, make())
    assert sorted(begun) == list(range(N_WRITERS))
    assert sorted(ended) == list(range(1, N_WRITERS))
    assert len(made) < 10 * N_WRITERS


def test_first_error_in_time_is_raised():
    """Not that of the first item, and not that of the items: the disk's releases the session."""
    failing = threading.Event()

    def make():
        yield from (0, 1)
        failing.wait(10.0)
        raise ZeroDivisionError("lost")

    def work(number):
        if number == 0:
            failing.wait(10.0)
            time.sleep(0.2)
        failing.set()
        raise OSError(errno.EIO, f"item {number}")

    with pytest.raises(OSError, match="item 1"):
        Disk().for_each(work, make())


def test_second_stop_leaves_no_thread_at_work(monkeypatch):
    """A thread could create a file after the session's lock is released."""
    begun, released, ended, calls = threading.Event(), threading.Event(), [], []
    shutdown = ThreadPoolExecutor.shutdown

    def interrupted(pool, **words):
        calls.append(words)
        if len(calls) == 1:
            raise KeyboardInterrupt("second")
        released.set()
        shutdown(pool, **words)

    def make():
        yield 0
        begun.wait(10.0)
        raise KeyboardInterrupt("first")

    def work(number):
        begun.set()
        released.wait(10.0)
        ended.append(number)

    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Disk().for_each(work, make())
    assert ended == [0]


@pytest.mark.parametrize("threads", [0, 2])
@pytest.mark.parametrize("failing", [False, True])
def test_work_is_done_where_no_thread_starts(monkeypatch, threads, failing):
    """A limit of addresses can refuse any thread; each item is done once."""
    started, done, start = [], [], threading.Thread.start

    def start_some(thread):
        if len(started) == threads:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    def work(number):
        done.append(number)
        time.sleep(0.005)
        if failing and number == 3:
            raise OSError(errno.EIO, "refused")

    monkeypatch.setattr(threading.Thread, "start", start_some)
    with pytest.raises(OSError, match="refused") if failing else contextlib.nullcontext():
        Disk().for_each(work, range(20))
    assert len(set(done)) == len(done)
    assert len(done) < 10 if failing else sorted(done) == list(range(20))


def test_invalid_descriptor_is_refused(tmp_path):
    """Also where the tests wait for no disk."""
    descriptor = Disk().create(tmp_path / "frame")
    os.close(descriptor)
    with pytest.raises(OSError, match="descriptor"):
        Disk().fsync(descriptor)


def test_second_writer_gets_no_lock(tmp_path):
    disk = Disk()
    disk.close(disk.create(tmp_path / "journal"))
    first, second = (disk.open_append(tmp_path / "journal") for _ in range(2))
    assert disk.lock(first) is True
    assert disk.lock(second) is False
    disk.close(first)
    assert disk.lock(second) is True
    disk.close(second)


def test_file_above_limit_is_refused(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_file(tmp_path / "a", limit=5, label="a") == b"12345"
    with pytest.raises(SessionDamage, match="got 5 bytes, expected at most 4"):
        read_file(tmp_path / "a", limit=4, label="a")


def test_pipe_is_refused_as_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SessionDamage, match="not a plain file"):
        read_file(tmp_path / "pipe", limit=5, label="pipe")


def test_file_that_cannot_be_read_is_damage():
    with pytest.raises(SessionDamage, match="expected a readable file"):
        read_file(Path("/proc/self/mem"), limit=5, label="memory")


def test_short_writes_continue_until_all_is_written(tmp_path, monkeypatch):
    """A full or slow medium may take a part of a call's bytes."""
    taken, write = [], os.write

    def write_little(descriptor, data):
        taken.append(write(descriptor, data[:3]))
        return taken[-1]

    monkeypatch.setattr(os, "write", write_little)
    disk = Disk()
    descriptor = disk.create(tmp_path / "frame")
    disk.write(descriptor, b"skin light")
    disk.close(descriptor)
    assert taken == [3, 3, 3, 1]
    assert (tmp_path / "frame").read_bytes() == b"skin light"


@pytest.mark.parametrize("opening", ["create", "open_append", "open_update"])
def test_writing_follows_no_link(tmp_path, opening):
    (tmp_path / "elsewhere").write_bytes(b"kept")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="link"):
        getattr(Disk(), opening)(tmp_path / "link")
    assert (tmp_path / "elsewhere").read_bytes() == b"kept"


def test_existing_file_is_never_created_again(tmp_path):
    (tmp_path / "frame").write_bytes(b"kept")
    with pytest.raises(FileExistsError):
        Disk().create(tmp_path / "frame")
    with pytest.raises(FileNotFoundError):
        Disk().open_append(tmp_path / "none")
    assert (tmp_path / "frame").read_bytes() == b"kept"
    assert not (tmp_path / "none").exists()


def test_updated_file_is_its_owners_alone(tmp_path):
    disk, before = Disk(), os.umask(0)
    try:
        disk.close(disk.open_update(tmp_path / "index"))
        disk.make_dir(tmp_path / "folder")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "index").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "folder").stat().st_mode) == 0o700
    descriptor = disk.open_update(tmp_path / "index")
    disk.write(descriptor, b"12345")
    disk.truncate(descriptor, 3)
    assert os.pread(descriptor, 9, 0) == b"123"
    disk.close(descriptor)


def test_renamed_and_removed_files_are_gone(tmp_path):
    (tmp_path / "old").write_bytes(b"light")
    Disk().rename(tmp_path / "old", tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    Disk().remove(tmp_path / "new")
    assert list(tmp_path.iterdir()) == []


def test_shared_locks_exclude_writer_alone(tmp_path):
    disk = Disk()
    disk.close(disk.create(tmp_path / "journal"))
    first, second, writer = (disk.open_append(tmp_path / "journal") for _ in range(3))
    assert [disk.lock(one, shared=True) for one in (first, second)] == [True, True]
    assert disk.lock(writer) is False
    for descriptor in (first, second, writer):
        disk.close(descriptor)


@pytest.mark.parametrize(
    ("kind", "got"),
    [("none", "No such file or directory"), ("link", "a symbolic link"), ("folder", "not a plain")],
)
def test_unreadable_place_is_named_with_finding(tmp_path, kind, got):
    (tmp_path / "link").symlink_to(tmp_path / "none")
    (tmp_path / "folder").mkdir()
    with pytest.raises(SessionDamage, match=rf"{kind}: cannot be read\n  frame: got {got}"):
        read_file(tmp_path / kind, limit=5, label="frame")


@pytest.mark.parametrize("kind", ["sound", "folder", "long"])
def test_read_file_is_closed_again(tmp_path, kind, monkeypatch):
    opened, open_file = [], os.open

    def open_noted(*args, **named):
        opened.append(open_file(*args, **named))
        return opened[-1]

    (tmp_path / "sound").write_bytes(b"12345")
    (tmp_path / "long").write_bytes(b"123456")
    (tmp_path / "folder").mkdir()
    monkeypatch.setattr(os, "open", open_noted)
    with contextlib.suppress(SessionDamage):
        read_file(tmp_path / kind, limit=5, label="frame")
    (descriptor,) = opened
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)


def test_missing_file_alone_raises_given_error(tmp_path):
    """A link or a folder in its place is damage, whatever the caller makes of a missing file."""
    words = {"limit": 5, "label": "frame", "missing": lambda: SessionError("not there")}
    with pytest.raises(SessionError, match="not there") as caught:
        read_file(tmp_path / "none", **words)
    assert not isinstance(caught.value, SessionDamage)
    (tmp_path / "link").symlink_to(tmp_path / "none")
    with pytest.raises(SessionDamage, match="a symbolic link"):
        read_file(tmp_path / "link", **words)
