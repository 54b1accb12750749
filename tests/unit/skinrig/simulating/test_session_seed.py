"""Two sessions of one simulated subject: what the session's seed changes, and what it keeps."""

from pathlib import Path

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.subject.head_motion import POSITION_DEVIATION_MM, draw_head_position
from rigsim.world import World
from skinrig.simulating import dome
from skinrig.simulating.driving import manifest_settings
from skinrig.simulating.gradient import make_scene
from skinrig.simulating.orders import DomeOrder, SimulationError

TEXELS = 64


def order(**options):
    return DomeOrder(
        out=Path("session"), width_px=64, lights=2, views=1, seed=3, texels=TEXELS, **options
    )


def scene(**options):
    asked = order(**options)
    return dome._scene(dome._rig(asked), asked, dome._plan(dome._rig(asked), None, "small"))


def test_session_seed_keeps_person_and_rig():
    first, second = scene(session_seed=1), scene(session_seed=2)
    assert np.array_equal(first.subject.melanin, second.subject.melanin)
    assert first.rig.lights == second.rig.lights
    shift = second.subject.mesh.vertices_mm - first.subject.mesh.vertices_mm
    expected = np.subtract(draw_head_position(2), draw_head_position(1))
    np.testing.assert_allclose(shift, np.broadcast_to(expected, shift.shape), atol=2e-4)
    assert np.linalg.norm(expected) > 0.5
    assert (first.seed, second.seed) == (1, 2)


def test_seed_without_session_seed_centers_the_face():
    plain = scene()
    assert plain.subject.offset_mm == (0.0, 0.0, 0.0)
    assert plain.seed == 3
    assert "session_seed" not in manifest_settings(order())
    assert manifest_settings(order(session_seed=0))["session_seed"] == 0


def test_gradient_session_seed_moves_the_target_only():
    rig = load_rig("gradient").cropped(32)
    first, second = (make_scene(rig, "flat", seed=3, noise_seed=seed) for seed in (1, 2))
    assert np.array_equal(first.sphere.intensity, second.sphere.intensity)
    assert (first.seed, second.seed) == (1, 2)


def test_world_subject_seed_keeps_mechanics_of_skin():
    rig = load_rig("gradient")
    worlds = [World(rig, seed=seed, subject_seed=3) for seed in (1, 2)]
    skins = [world.skin.mechanics for world in worlds]
    assert skins[0].stiffness_n == skins[1].stiffness_n
    assert skins[0].tape_n_per_mm != skins[1].tape_n_per_mm
    assert World(rig, seed=3).skin.mechanics.stiffness_n == skins[0].stiffness_n
    assert World(rig, seed=4).skin.mechanics.stiffness_n != skins[0].stiffness_n


def test_head_position_has_stated_deviation():
    drawn = np.array([draw_head_position(seed) for seed in range(400)])
    assert drawn.std() == pytest.approx(POSITION_DEVIATION_MM, rel=0.1)
    assert np.abs(drawn).max() <= 2.5 * POSITION_DEVIATION_MM


def test_negative_session_seed_is_refused():
    with pytest.raises(SimulationError, match="session_seed: got -1, expected 0 or more"):
        order(session_seed=-1)
