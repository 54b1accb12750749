"""Landmarks: on the skin, where the camera sees them, and they go with it."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from capture.rig import Rig
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import SceneEffects
from rigsim.render.caster import Caster
from rigsim.scenes.flash.scene import FlashScene
from rigsim.subject import face_regions, landmarks
from rigsim.subject.expressions import displacement_mm
from rigsim.subject.person import SimulatedSubject
from skinrig.simulating.flash_truth import scale_landmarks, to_superpixels

# Embree traces the rays, so these tests need no Mitsuba.
EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
WIDTH = 252  # of the shared rig


@pytest.fixture(scope="module")
def scenes(rig: Rig, face: SimulatedSubject) -> dict[str, FlashScene]:
    return {
        state: FlashScene(
            rig,
            face,
            state=state,
            choice=EMBREE,
            effects=SceneEffects(lateral=False, interreflections=False),
        )
        for state in ("neutral", "smile", "surprise")
    }


@pytest.mark.long
def test_landmarks_are_on_skin_at_mean_head_positions(face):
    points = face.surface_landmarks()
    assert set(points.names) == set(landmarks.POINTS_MM)
    wanted = np.array([(*landmarks.POINTS_MM[name], 0.0) for name in points.names])
    at = face_regions.from_mean_head(wanted, face.mesh)[:, :2]
    places = points.positions_on(face.mesh)
    np.testing.assert_allclose(places[:, :2], at, atol=1e-3)
    assert (places[:, 2] > -60.0).all()
    assert points.weights.min() > -1e-6


@pytest.mark.long
@pytest.mark.parametrize("state", ["neutral", "smile", "surprise"])
def test_position_map_gives_landmarks_at_their_superpixels(scenes, state):
    """Rationale: half a pixel of the sensor is a quarter of a superpixel.

    Expected: the map of positions, averaged over 2 x 2 pixels and read at a landmark, is where the
    landmark is. Tolerance: a fifth of that quarter in the median, as the averaged surface is bent.
    Read without the half pixel, the error must be the quarter.
    """
    scene = scenes[state]
    truth = scene.truth()
    named = scale_landmarks(scene.landmarks_px())
    assert len(named) >= 20
    points = scene.subject.surface_landmarks()
    places = dict(zip(points.names, points.positions_on(scene.subject.mesh), strict=True))
    position = to_superpixels(np.asarray(truth["position_mm"], np.float64), truth["mask"])
    whole = to_superpixels(truth["mask"].astype(float)) == 1.0

    def errors_mm(offset: float) -> np.ndarray:
        found = []
        for name, (x, y) in named.items():
            at = np.array([[y + offset], [x + offset]])
            if map_coordinates(whole.astype(float), at, order=1)[0] < 1.0:
                continue  # beside hair and outlines there is no truth
            seen = [map_coordinates(position[..., k], at, order=1)[0] for k in (0, 1)]
            found.append(np.array(seen) - places[name][:2])
        assert len(found) >= 15
        return np.array(found)

    view = scene.rig.views[0]
    quarter_mm = 0.5 * view.distance_mm / view.focal_px
    assert np.median(np.abs(errors_mm(0.0))) < 0.2 * quarter_mm
    assert np.median(np.abs(errors_mm(0.25))) > 0.7 * quarter_mm


@pytest.mark.long
def test_expression_landmarks_shift_by_projected_movement(scenes, rig, face):
    """Expected: f / (D - z) times the movement of the nearest vertex, plus what coming nearer
    enlarges. Tolerance: 0.15 px, as movement changes by a few percent from vertex to vertex."""
    view = rig.views[0]
    rest, smile = scenes["neutral"].landmarks_px(), scenes["smile"].landmarks_px()
    points = face.surface_landmarks()
    deltas = displacement_mm(face.mesh, "smile", seed=face.seed)
    compared = 0
    for name, place in zip(points.names, points.positions_on(face.mesh), strict=True):
        if name not in rest or name not in smile:
            continue
        nearest = np.argmin(np.linalg.norm(face.mesh.vertices_mm - place, axis=-1))
        before, after = place, place + deltas[nearest]
        scale = [view.focal_px / (view.distance_mm - p[2]) for p in (before, after)]
        expected = scale[1] * after[:2] - scale[0] * before[:2]
        found = np.subtract(smile[name], rest[name]) * [1.0, -1.0]
        np.testing.assert_allclose(found, expected, atol=0.15)
        compared += 1
    assert compared >= 20
    corner = np.subtract(smile["mouth corner right"], rest["mouth corner right"])
    assert corner[0] > 2.0
    assert corner[1] < -2.0


@pytest.mark.long
def test_landmarks_hidden_by_head_are_not_visible(rig, face):
    caster = Caster(face.mesh, choice=EMBREE)
    points = face.surface_landmarks().positions_on(face.mesh)
    assert landmarks.is_visible(points, rig.views[0], caster).mean() > 0.9
    behind = points - np.array([0.0, 0.0, 30.0])
    assert landmarks.is_visible(behind, rig.views[0], caster).mean() < 0.1
    outside = points + np.array([400.0, 0.0, 0.0])
    assert not landmarks.is_visible(outside, rig.views[0], caster).any()
