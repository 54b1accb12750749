"""A session that was interrupted holds the pixels of one that was not, noise and all."""

import itertools

import numpy as np
import pytest

from capture.devices.camera import Exposure, Trigger, open_camera
from capture.rig import load_rig
from capture.session import Session
from rigsim.world.serve import serve_world
from skinrig.simulating.resumption import count_shots
from skinrig.simulating.simulation import simulate_session


class Enough(Exception):
    """Stands for whatever ends a run."""


ASKED = {
    "flash": {"target": "white", "width_px": 48},
    "dome": {"target": "charuco", "lights": 8, "views": 2, "width_px": 64},
    "probe": {"target": "dark"},
}


def commit_only(monkeypatch, count):
    """Have the session fail before the commit after `count` ones."""
    commits = itertools.count()
    keep = Session.commit

    def commit(self, *args, **more):
        if next(commits) == count:
            raise Enough
        return keep(self, *args, **more)

    monkeypatch.setattr(Session, "commit", commit)


def pixels(folder):
    session = Session.open(folder)
    return {(r.step_id, r.camera): session.read(r).cfa for r in session.frames()}


@pytest.mark.long
@pytest.mark.parametrize(("rig", "count"), [("flash", 2), ("dome", 3), ("dome", 8), ("probe", 3)])
def test_resumed_session_has_pixels_of_uninterrupted_session(tmp_path, monkeypatch, rig, count):
    simulate_session(rig, tmp_path / "whole", **ASKED[rig])
    with monkeypatch.context() as patch:
        commit_only(patch, count)
        with pytest.raises(Enough):
            simulate_session(rig, tmp_path / "parts", **ASKED[rig])
    with monkeypatch.context() as patch:  # and once more
        commit_only(patch, 2)
        with pytest.raises(Enough):
            simulate_session(rig, tmp_path / "parts", resume=True, **ASKED[rig])
    simulate_session(rig, tmp_path / "parts", resume=True, **ASKED[rig])
    whole, parts = pixels(tmp_path / "whole"), pixels(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    for key, frame in whole.items():
        np.testing.assert_array_equal(parts[key], frame, err_msg=str(key))


@pytest.mark.long
def test_shots_of_retaped_caliper_skin_have_independent_noise(tmp_path, monkeypatch):
    from rigsim.world.world import World

    asked = {"width_px": 32, "angles": (0.0,), "steps": (-1, 1)}
    seed_of: dict[bytes, int] = {}
    expose = World.expose

    def noted(self, *args, seed, **more):
        image = expose(self, *args, seed=seed, **more)
        seed_of[image.tobytes()] = seed
        return image

    monkeypatch.setattr(World, "expose", noted)
    for number in range(3):
        with monkeypatch.context() as patch:
            if number < 2:
                commit_only(patch, 20)
                with pytest.raises(Enough):
                    simulate_session("gradient", tmp_path / "s", resume=number > 0, **asked)
            else:
                simulate_session("gradient", tmp_path / "s", resume=True, **asked)
    # what a run shot and lost may come again; what was kept may not
    session = Session.open(tmp_path / "s")
    assert session.attachments()  # skin that was taped anew
    seeds = [seed_of[session.read(record).cfa.tobytes()] for record in session.frames()]
    assert len(seeds) == len(session.frames()) > 40
    assert len(set(seeds)) == len(seeds)


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
