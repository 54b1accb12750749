"""Images of exposures, their log, and a session that is refused, after an interruption."""

import itertools

import numpy as np
import pytest

from capture.session import Session
from skinrig.simulating.exposure_log import ExposureLog, repair_lines
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.resumption import ExposureStore, exposures_folder
from skinrig.simulating.simulation import simulate_session


class Enough(Exception):
    """Stands for whatever ends a run."""


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(2).integers(0, 4000, (6, 8)).astype(np.uint16)


@pytest.fixture
def interrupted(tmp_path, monkeypatch):
    """A session of four frames."""
    commits, keep = itertools.count(), Session.commit_step

    def commit(self, *args, **more):
        if next(commits) == 4:
            raise Enough
        return keep(self, *args, **more)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "commit_step", commit)
        with pytest.raises(Enough):
            simulate_session("flash", tmp_path / "s", target="white", width_px=48)
    return tmp_path / "s"


def read_bytes(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_stored_image_is_found_by_later_store(tmp_path, image):
    ExposureStore(tmp_path / "x").add("cam-1", image)
    assert np.array_equal(ExposureStore(tmp_path / "x").find("cam-1", None), image)
    assert ExposureStore(tmp_path / "x").find("cam-2", None) is None


@pytest.mark.parametrize("damage", ["empty", "cut", "zeroed", "flipped"])
def test_damaged_image_is_computed_again(tmp_path, image, damage):
    store = ExposureStore(tmp_path / "x")
    store.add("cam-1", image)
    path = tmp_path / "x/cam-1.npy"
    good = path.read_bytes()
    bad = {
        "empty": b"",
        "cut": good[:-5],
        "zeroed": good[:-20] + bytes(20),
        "flipped": good[:-1] + bytes([good[-1] ^ 1]),
    }[damage]
    path.write_bytes(bad)
    assert store.find("cam-1", None) is None
    assert not path.exists()


@pytest.mark.parametrize("tail", [b'{"exp', b"\0\0\0", b'{"a": 1}{"b": 2}\n', b"3\n", b'{"a": 1}'])
def test_log_ends_before_first_incomplete_line(tmp_path, tail):
    path = tmp_path / "log.jsonl"
    path.write_bytes(b'{"t_s": 1.0}\n' + tail)
    log = ExposureLog(path, resume=True)
    log.add({"t_s": 2.0})
    assert log.read() == [{"t_s": 1.0}, {"t_s": 2.0}]
    assert repair_lines(tmp_path / "absent") == []


def test_refused_resume_changes_no_file(interrupted):
    stray = interrupted / "frames/S999+cam.dng"
    stray.write_bytes(b"not acknowledged")
    (interrupted / "orphans/older.dng").write_bytes(b"older")
    before = read_bytes(interrupted.parent)
    with pytest.raises(SimulationError, match="SR-SIM-001"):
        simulate_session("flash", interrupted, target="white", width_px=64, resume=True)
    assert read_bytes(interrupted.parent) == before


def test_new_session_takes_no_image_of_removed_one(interrupted):
    for path in sorted(interrupted.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    store = exposures_folder(interrupted)
    left = list(store.glob("*.npy"))
    assert left
    made = []
    keep = ExposureStore.find

    def note(self, key, session):
        made.append(keep(self, key, session))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ExposureStore, "find", note)
        simulate_session("flash", interrupted, target="chart", width_px=48)
    assert made
    assert all(image is None for image in made)
