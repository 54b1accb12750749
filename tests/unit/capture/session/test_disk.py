"""Durable writes: synchronization is called for the file or folder concerned.

`tests/conftest.py` has the tests wait for no disk, and a model of the disk stands in
`tests/faults/test_power_cut.py`; here the calls to the operating system themselves are seen.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from capture import raw
from capture.calibration import store as calibration_store
from capture.session.disk import Disk, read_file
from capture.session.errors import SessionDamage


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
