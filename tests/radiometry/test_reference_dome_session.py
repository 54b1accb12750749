"""Faces of voxel skin in the dome: light of single LEDs, ground truth, whole sessions."""

from math import pi

import numpy as np
import pytest

from capture.rig import load_rig
from capture.session import Session
from model import store
from rigsim.boxes.led_table import LedPulse
from rigsim.mitsuba.variant import choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.reference import dome_session
from rigsim.scenes.reference.directions import DirectionalReflectance
from rigsim.scenes.reference.dome_session import VoxelDomeScene
from rigsim.scenes.reference.face_skin import FaceDirections
from rigsim.sensor import apply_cfa
from rigsim.subject import make_subject
from skinrig.simulating import reference
from skinrig.simulating.dome import small_dome
from skinrig.simulating.simulation import simulate_session

pytestmark = [
    pytest.mark.render,
    pytest.mark.skipif(
        not choose_variant("rgb").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
    ),
]
UP = np.array([[0.0, 0.0, 1.0]])
DIRECT = SceneEffects(lateral=False, interreflections=False, relief_shadows=False, optics=False)


def lambertian(factors=(1.0, 1.0, 1.0, 1.0)):
    """Interior whose light has a factor for each of four pigments, the same in all directions."""
    coefficients = np.zeros((11, 12))
    coefficients[0] = np.repeat(factors, 3)
    shape = DirectionalReflectance(coefficients, np.ones(12), np.zeros(12))
    return FaceDirections(shape, np.log([0.01, 0.1]), np.log([0.005, 0.05]))


@pytest.fixture(scope="module")
def dome():
    return small_dome(load_rig("dome"), lights=3, views=1, width_px=48)


@pytest.fixture(scope="module")
def face():
    return make_subject("III", size=64)


def test_four_pigments_interpolate_in_logarithms():
    """Expected: the factor of each rendered pigment, their mean halfway, the nearest beyond."""
    melanin = np.float32([0.01, 0.1, 0.01, 0.1, np.sqrt(0.001), 0.5])
    blood = np.float32([0.005, 0.005, 0.05, 0.05, 0.005, 0.5])
    found = lambertian((1.0, 3.0, 2.0, 4.0)).evaluate(melanin, blood, UP, UP, UP)
    passed = lambertian().evaluate(melanin, blood, UP, UP, UP)
    np.testing.assert_allclose((found / passed)[:, 0], [1.0, 2.0, 3.0, 4.0, 1.5, 4.0], rtol=1e-6)


@pytest.mark.long
def test_lambertian_voxels_have_light_of_session(dome, face):
    """Rationale: with a Lambertian interior both renderers reflect the same light.

    Tolerance: 16 bits of the stored surface, and vellus hair, which is at most 2 % of the light.
    Light of voxels that is stronger by a tenth fails.
    """
    camera = dome.views[0].spectral_sensitivity
    expected = DomeScene(dome, face, effects=DIRECT).radiance(dome.views[0].name)
    images = [
        VoxelDomeScene(dome, face, {camera: lambertian(factors)}).radiance(dome.views[0].name)
        for factors in ((1.0, 1.0, 1.0, 1.0), (1.1, 1.1, 1.1, 1.1))
    ]
    ratio = [image.sum(axis=(1, 2)) / expected.sum(axis=(1, 2)) for image in images]
    np.testing.assert_allclose(ratio[0], 1.0, atol=0.02)
    # a highlight of the third light is most of its image
    assert np.all(ratio[1] > 1.02)
    bright = expected > 0.2 * expected.max()
    assert np.percentile(np.abs(images[0][bright] / expected[bright] - 1.0), 90) < 0.03


@pytest.mark.long
def test_exposure_has_the_light_of_voxels(dome, face):
    """Voxels that reflect half have half the light, whatever their boundary reflects."""
    view, pulse = dome.views[0], LedPulse(led=0, level=1.0, t_on_s=0.0, t_off_s=0.01)
    found = []
    for factor in (1.0, 0.5):
        voxels = {view.spectral_sensitivity: lambertian((factor,) * 4)}
        scene = VoxelDomeScene(dome, face, voxels)
        light = apply_cfa(scene.radiance(view.name, [0])[0], view.cfa)
        frame = scene.exposure(view.name, pops=[pulse], exposure_s=0.1, seed=1)
        found.append((light.mean(), frame.mean() - view.black_level))
    light, signal = np.array(found).T
    assert light[1] / light[0] < 0.9
    assert signal[1] / signal[0] == pytest.approx(light[1] / light[0], rel=0.02)


@pytest.mark.long
def test_blocks_of_rows_have_light_of_whole_image(dome, face, monkeypatch):
    view = dome.views[0]
    scene = VoxelDomeScene(dome, face, {view.spectral_sensitivity: lambertian()})
    whole, rows = scene.radiance(view.name), []
    reflected = VoxelDomeScene._reflected

    def reflect(*given):
        rows.append(len(given[-1]))
        return reflected(*given)

    monkeypatch.setattr(dome_session, "BLOCK_ROWS", 100)
    monkeypatch.setattr(VoxelDomeScene, "_reflected", reflect)
    scene = VoxelDomeScene(dome, face, {view.spectral_sensitivity: lambertian()})
    np.testing.assert_array_equal(scene.radiance(view.name), whole)
    assert max(rows) == 100


@pytest.mark.long
def test_reflection_truth_is_that_of_images(dome, face):
    """Expected: R_d T T / pi below facets; forward light of the voxels raises it."""
    camera = dome.views[0].spectral_sensitivity
    uv = face.mesh.uv[:50]
    light, view = np.array([0.5, 0.0, np.sqrt(0.75)]), np.array([-0.5, 0.0, np.sqrt(0.75)])
    total, surface = VoxelDomeScene(dome, face, {camera: lambertian()}).brdf(uv, light, view)
    more, same = VoxelDomeScene(dome, face, {camera: lambertian((2.0,) * 4)}).brdf(uv, light, view)
    lit = (total - surface[:, None] > 1e-4).all(axis=1)
    assert lit.any()
    np.testing.assert_array_equal(surface, same)
    np.testing.assert_allclose(
        more[lit] - surface[lit, None], 2.0 * (total[lit] - surface[lit, None]), rtol=1e-3
    )
    assert total.max() < 1.0 / pi + surface.max()


@pytest.mark.long
def test_dome_session_states_renderer_and_omissions(tmp_path, monkeypatch):
    given, lines = [], []

    def render(rig, face, **options):
        given.append(options)
        return {rig.views[0].spectral_sensitivity: lambertian()}

    monkeypatch.setattr(reference, "render_directions_of_views", render)
    done = simulate_session(
        "dome",
        tmp_path / "session-dome",
        renderer="reference",
        width_px=32,
        lights=2,
        views=1,
        texels=64,
        session_seed=3,
        progress=lines.append,
    )
    assert given[0]["seed"] == 3
    assert any(line.startswith("voxels: about") for line in lines)
    assert Session.open(done.session).manifest.extra["renderer"]["name"] == "reference"
    verdicts = {one["name"]: one["verdict"] for one in done.effects}
    assert verdicts["interreflection of voxels"] == "unmodeled"
    assert "lateral scattering in skin" not in verdicts
    assert store.read(done.truth).maps["fuzz"].values.max() == 0.0
