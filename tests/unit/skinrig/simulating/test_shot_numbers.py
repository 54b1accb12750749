"""A session that was interrupted holds the pixels of one that was not, noise and all."""

import itertools
from collections import Counter
from contextlib import nullcontext
from functools import cache

import numpy as np
import pytest

from capture.devices.camera import Exposure, Trigger, open_camera
from capture.rig import load_rig
from capture.session import Session
from rigsim.world import World
from rigsim.world.serve import serve_world
from skinrig.errors import UnusableError
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.resumption import count_shots
from skinrig.simulating.simulation import simulate_session


class Enough(Exception):
    """Stands for whatever ends a run."""


ASKED = {
    "flash": {"target": "white", "width_px": 48},
    "dome": {"target": "charuco", "lights": 8, "views": 2, "width_px": 64},
    "probe": {"target": "dark"},
    "gradient": {"width_px": 32, "angles": (0.0,), "steps": (-1, 1)},
}


def commit_only(monkeypatch, count):
    """Have the session fail before the commit after `count` ones."""
    commits = itertools.count()
    keep = Session.commit_step

    def commit(self, *args, **more):
        if next(commits) == count:  # None: never
            raise Enough
        return keep(self, *args, **more)

    monkeypatch.setattr(Session, "commit_step", commit)


def read_files(folder):
    """Return the bytes of all files of a session and its ground truth."""
    folders = (folder, folder.with_name(f"truth-{folder.name}"))
    return {
        (number, str(path.relative_to(one))): path.read_bytes()
        for number, one in enumerate(folders)
        for path in sorted(one.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def whole_files(tmp_path_factory):
    """Files of an uninterrupted session by rig; each is simulated once."""

    @cache
    def simulate(rig):
        folder = tmp_path_factory.mktemp(rig) / "whole"
        simulate_session(rig, folder, **ASKED[rig])
        return read_files(folder)

    return simulate


@pytest.mark.long
@pytest.mark.parametrize(
    ("rig", "count"), [("flash", 2), ("dome", 3), ("dome", 8), ("probe", 3), ("gradient", 20)]
)
def test_resumed_session_has_bytes_of_uninterrupted_session(
    tmp_path, monkeypatch, whole_files, rig, count
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1795000000")
    whole = whole_files(rig)
    exposed: Counter[tuple[str, int]] = Counter()
    expose = World.expose

    def note(self, view_name, *args, seed, **more):
        exposed[view_name, seed] += 1
        return expose(self, view_name, *args, seed=seed, **more)

    monkeypatch.setattr(World, "expose", note)
    for number in range(3):
        with monkeypatch.context() as patch:
            commit_only(patch, (count, count + 2, None)[number])
            with pytest.raises(Enough) if number < 2 else nullcontext():
                simulate_session(rig, tmp_path / "parts", resume=number > 0, **ASKED[rig])
        if number < 2:  # images of committed frames are removed at once
            session = Session.open(tmp_path / "parts")
            left = {path.name for path in (tmp_path / ".parts.exposures").glob("*.npy")}
            assert len(left) <= len(session.pending_frames())
            assert len(session.frames()) >= count
    parts = read_files(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    assert [key for key in whole if whole[key] != parts[key]] == []
    # every image was stored before its frame was refused: none is computed again
    assert set(exposed.values()) == {1}
    assert not list(tmp_path.glob(".*"))


@pytest.mark.long
def test_partly_recorded_step_resumes_same_bytes(tmp_path, monkeypatch, whole_files):
    """A power cut may leave the lines of a step's first cameras alone."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1795000000")
    with monkeypatch.context() as patch:
        commit_only(patch, 3)
        with pytest.raises(Enough):
            simulate_session("dome", tmp_path / "parts", **ASKED["dome"])
    journal = tmp_path / "parts/journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-1])
    assert len(Session.open(tmp_path / "parts").frames()) == 3 * ASKED["dome"]["views"] - 1
    simulate_session("dome", tmp_path / "parts", resume=True, **ASKED["dome"])
    assert read_files(tmp_path / "parts") == whole_files("dome")


@pytest.mark.long
def test_session_of_another_journal_is_not_resumed(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        commit_only(patch, 3)
        with pytest.raises(Enough):
            simulate_session("flash", tmp_path / "s", **ASKED["flash"])
    before = read_files(tmp_path / "s")
    # a rig whose time runs otherwise stands for another version
    monkeypatch.setattr(World, "now", property(lambda self: self._now + 1.0))
    with pytest.raises(SimulationError, match="SR-SIM-008"):
        simulate_session("flash", tmp_path / "s", resume=True, **ASKED["flash"])
    assert read_files(tmp_path / "s") == before


@pytest.mark.parametrize("given", ["now", "-3", "1e9", "99999999999999", "١"])
def test_invalid_source_date_is_refused(tmp_path, monkeypatch, given):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", given)
    with pytest.raises(UnusableError, match="SOURCE_DATE_EPOCH"):
        simulate_session("flash", tmp_path / "s", **ASKED["flash"])
    assert not (tmp_path / "s").exists()


def test_running_server_does_not_repeat_first_shot_noise():
    """Frames of no scene are noise alone, drawn by the number of the shot.

    The camera of the gradient rig reads out in milliseconds; one with a flash takes five seconds.
    """
    rig = load_rig("gradient").resized(16)

    def shots(count, **made):
        with serve_world(rig, seed=5, **made) as served:
            camera = open_camera(served.addresses["cam"])
            camera.configure(Exposure(0.001, 100))
            images = []
            for _ in range(count):
                camera.arm(1, Trigger.SOFTWARE)
                camera.fire()
                images.append(camera.frame(10.0).image)
            camera.close()
        return images

    first, second, third = shots(3)
    (again,) = shots(1)
    np.testing.assert_array_equal(again, first)
    (after,) = shots(1, shots_made={"cam": 2})
    np.testing.assert_array_equal(after, third)
    assert (after != second).any()


def test_new_session_starts_at_shot_zero(tmp_path):
    simulate_session("flash", tmp_path / "s", **ASKED["flash"])
    session = Session.open(tmp_path / "s")
    assert count_shots(session) == {"cam": len(session.frames())}
