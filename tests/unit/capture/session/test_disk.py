"""Durable writes: synchronization is called for the file or folder concerned.

`tests/conftest.py` has the tests wait for no disk, and a model of the disk stands in
`tests/faults/test_power_cut.py`; here the calls to the operating system themselves are seen.
"""

import os

import numpy as np
import pytest

from capture import raw
from capture.calibration import store as calibration_store
from capture.session.disk import Disk


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
