"""A face off the white tile's place: light, view, focus and truth move with it."""

import numpy as np
import pytest

from capture.rig import Rig, load_rig
from rigsim.as_built.polarizers import IDEAL_POLARIZERS
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import SceneEffects
from rigsim.render.depth_of_field import depth_range
from rigsim.scenes.flash.scene import FlashScene
from rigsim.subject import landmarks
from rigsim.subject.person import SimulatedSubject, SubjectError

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
WIDTH = 192
NEARER_MM = 50.0
PLAIN = {"choice": EMBREE, "films": IDEAL_POLARIZERS}


def scene_of(rig: Rig, face: SimulatedSubject, *, optics: bool) -> FlashScene:
    effects = SceneEffects(lateral=False, interreflections=False, optics=optics)
    return FlashScene(rig, face, effects=effects, **PLAIN)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("flash").resized(WIDTH)


@pytest.fixture(scope="module")
def nearer(face: SimulatedSubject) -> SimulatedSubject:
    return face.translate((0.0, 0.0, NEARER_MM))


@pytest.fixture(scope="module")
def places(
    rig: Rig, face: SimulatedSubject, nearer: SimulatedSubject
) -> tuple[FlashScene, FlashScene]:
    here, there = (scene_of(rig, one, optics=False) for one in (face, nearer))
    return here, there


def test_unmoved_face_is_same_object(face):
    assert face.translate((0.0, 0.0, 0.0)) is face


def test_moved_face_differs_only_in_position(face, nearer):
    covered = face.atlas.covered
    for way in (
        nearer.mesh.vertices_mm - face.mesh.vertices_mm,
        (nearer.atlas.position_mm - face.atlas.position_mm)[covered],
    ):
        np.testing.assert_allclose(way, np.broadcast_to([0, 0, NEARER_MM], way.shape), atol=1e-4)
    for name in ("melanin", "normal", "roughness", "hair", "height_um"):
        assert getattr(nearer, name) is getattr(face, name)
    assert nearer.offset_mm == (0.0, 0.0, NEARER_MM)
    assert nearer.translate((0.0, 0.0, -NEARER_MM)).offset_mm == face.offset_mm


def test_moving_and_building_face_commute(face, nearer):
    smile = face.with_expression("smile")
    first, last = smile.translate((0.0, 0.0, NEARER_MM)), nearer.with_expression("smile")
    np.testing.assert_allclose(first.mesh.vertices_mm, last.mesh.vertices_mm, atol=1e-3)
    way = last.mesh.vertices_mm - smile.mesh.vertices_mm
    np.testing.assert_allclose(way, np.broadcast_to([0, 0, NEARER_MM], way.shape), atol=1e-3)
    assert last.offset_mm == first.offset_mm == nearer.offset_mm


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.0, 0.0, np.nan), (0.0, np.inf, 0.0)])
def test_invalid_offset_is_refused_by_name(face, offset):
    with pytest.raises(SubjectError, match="offset_mm"):
        face.translate(offset)


def test_light_on_moved_face_matches_its_position(rig, places):
    """Rationale: cosine and inverse square from each flash's place, over those on the tile.

    Expected: the closed form where skin faces both flashes. Tolerance 2 %: relief bends normals
    within a pixel, whose truth is a mean.
    """
    for scene in places:
        truth = scene.truth()
        open_skin = truth["mask"] & (truth["normals"][..., 2] > 0.9)
        place, normal = truth["position_mm"][open_skin], truth["normals"][open_skin]
        light, tile = np.zeros(len(place)), 0.0
        for flash in rig.lights:
            way = np.asarray(flash.position_mm) - place
            far = np.linalg.norm(way, axis=-1)
            light += (way * normal).sum(axis=-1) / far**3
            own = np.asarray(flash.position_mm)
            tile += own[2] / np.linalg.norm(own) ** 3
        ratio = truth["irradiance"][open_skin] / (light / tile)
        assert np.median(np.abs(ratio - 1.0)) < 0.02
    here, there = (np.median(one["shading"][one["mask"]]) for one in map(FlashScene.truth, places))
    # 5 % nearer to both flashes: some 10 % more light
    assert 1.05 < there / here < 1.15


def test_images_and_landmarks_follow_moved_face_truth(rig, places):
    view = rig.views[0]
    for scene in places:
        truth = scene.truth()
        rows, columns = np.nonzero(truth["mask"])
        seen = landmarks.project_points(truth["position_mm"][rows, columns].astype(float), view)
        off = np.hypot(seen[:, 0] - columns, seen[:, 1] - rows)
        assert np.quantile(off, 0.95) < 0.5
        assert not (scene.radiance()[rows, columns] <= 0.0).any()
    here, there = (scene.landmarks_px() for scene in places)
    middle = 0.5 * np.array([view.width_px - 1, view.height_px - 1])
    points = places[0].subject.surface_landmarks()
    for name, place in zip(points.names, points.positions_on(places[0].subject.mesh), strict=True):
        if name in here and name in there:
            larger = (view.distance_mm - place[2]) / (view.distance_mm - place[2] - NEARER_MM)
            np.testing.assert_allclose(
                there[name] - middle, larger * (here[name] - middle), atol=0.02
            )


@pytest.mark.long
def test_lens_blurs_face_out_of_focus(rig, face):
    """The lens stays focused on the tile's place: slopes of the picture lose energy with depth."""
    view = rig.views[0]
    kept = []
    for nearer_mm in (0.0, 200.0):
        moved = face.translate((0.0, 0.0, nearer_mm))
        depths = np.array(depth_range(view, moved.mesh)) - depth_range(view, face.mesh)
        assert depths[1] == pytest.approx(nearer_mm, abs=1e-2)
        sharp, blurred = (
            scene_of(rig, moved, optics=optics).radiance() for optics in (False, True)
        )
        energy = [np.square(np.diff(image, axis=1)).sum() for image in (sharp, blurred)]
        kept.append(energy[1] / energy[0])
    assert kept[1] < kept[0] - 0.05
