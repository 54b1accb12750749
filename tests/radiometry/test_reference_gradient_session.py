"""Grooves of voxel skin in the gradient rig: light by moment, states, whole sessions."""

import numpy as np
import pytest

from capture.rig import load_rig
from capture.session import Session
from model import store
from rigsim.as_built.sphere import diffuser_radiance, nominal_sphere
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import DRIFT_MARGIN_PX
from rigsim.scenes.reference import gradient_session
from rigsim.scenes.reference.gradient_session import RenderedGrooves, VoxelGradientScene
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.world.taped_skin import GripState
from skinrig.reporting.sections import session as session_section
from skinrig.simulating import reference
from skinrig.simulating.simulation import simulate_session

pytestmark = [
    pytest.mark.render,
    pytest.mark.skipif(
        not choose_variant("rgb").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
    ),
]
WIDTH = 16


@pytest.fixture(scope="module")
def rig():
    return load_rig("gradient").cropped(WIDTH)


def scene_of(rig, level):
    """Scene whose voxels reflect a part of a white diffuser's light."""
    side = WIDTH + 2 * DRIFT_MARGIN_PX
    moments = np.zeros((4, side, side), np.float32)
    moments[0] = level
    skin = make_micro_skin("cheek", size_mm=1.0, texel_um=20.0)
    grooves = RenderedGrooves(skin, moments, 0.02)
    return VoxelGradientScene(rig, grooves, sphere=nominal_sphere(rig))


def test_crossed_light_is_that_of_voxels(rig):
    """Expected: level over a white diffuser's half light behind the crossed analyzer.

    Tolerance: facets leak 0.1 % through the crossed polarizers. Parallel light has facets too.
    """
    scene = scene_of(rig, 0.4)
    bright, dim = (one.moments(NEUTRAL_GRIP) for one in (scene, scene_of(rig, 0.2)))
    center, extinction = np.zeros(1), scene.films.light_extinction
    white = diffuser_radiance(scene.sphere, center, center, extinction=extinction)[0, 0]
    added = (bright["crossed"] - dim["crossed"])[0]
    np.testing.assert_allclose(added, 0.5 * 0.2 * white * scene.unit, rtol=0.01)
    np.testing.assert_allclose((bright["parallel"] - dim["parallel"])[0], added, rtol=0.01)
    assert np.all(bright["parallel"][0] > 1.02 * bright["crossed"][0])


def test_stretched_voxels_are_refused(rig):
    with pytest.raises(SceneError, match="expected skin at rest"):
        scene_of(rig, 0.4).stokes(GripState(0.0, 1, 9.0, 1.1, True, False))


@pytest.mark.long
def test_gradient_session_states_renderer_and_noise(tmp_path, monkeypatch):
    monkeypatch.setitem(reference.GROOVE_SAMPLES, "small", 2)
    monkeypatch.setattr(gradient_session, "BAND_NODES_NM", (540.0,))
    monkeypatch.setattr(gradient_session, "weigh_bands", lambda rig: np.ones(1))
    done = simulate_session("gradient", tmp_path / "session", renderer="reference", width_px=16)
    renderer = Session.open(done.session).manifest.extra["renderer"]
    assert renderer["name"] == "reference"
    assert "% per 8 pixels" in renderer["why"]
    facts = session_section.read_session_facts([done.session])
    assert "simulated (reference)" in facts["session"].cells
    verdicts = {one["name"]: one["verdict"] for one in done.effects}
    assert verdicts["lateral scattering in skin"] == "built"
    assert verdicts["noise of the voxels"] == "unmodeled"
    albedo = store.read(done.truth).maps["albedo_a000_n0"].values
    assert np.ptp(albedo) < 1e-6
