"""Eyes and hair over a rendering of the skin, on the mean head."""

from dataclasses import replace

import numpy as np
import pytest

from rigsim.face_parts.eyelids import APEX_MM, CORNEA_CENTER_MM, CORNEA_RADIUS_MM, build_eyelids
from rigsim.face_parts.hair import draw_hair
from rigsim.geometry.mesh import build_mesh
from rigsim.render import Caster
from rigsim.subject.head import build_head
from skinrig.rendering.camera import look_at
from skinrig.rendering.lights import Light
from skinrig.unmeasured.drawing import LID_GAP_MM, PartsLayer, PartsView, open_lids
from skinrig.unmeasured.person import FaceParts

CAMERA_MM = np.array([0.0, 0.0, 700.0])
LIGHTS_DEG = (0.0, 40.0)
ELEVATION_DEG = 20.0
SUBPIXELS = 2


@pytest.fixture(scope="module")
def view():
    """Return the parts of the mean head under light from the front and from the right."""
    head = build_head(None)
    lids = build_eyelids(head)
    parts = FaceParts(lids, draw_hair(head, "III", seed=0), "", ())
    camera = look_at(CAMERA_MM, target_mm=(0, 15, 0), fov_deg=17.8, size_px=(240, 270))
    turn, up = np.radians(LIGHTS_DEG), np.radians(ELEVATION_DEG)
    ways = np.stack([np.sin(turn) * np.cos(up), np.sin(up) + 0 * turn, np.cos(turn) * np.cos(up)])
    lights = [Light(name=str(k), direction=tuple(way)) for k, way in enumerate(ways.T)]
    return PartsView(parts, head, camera, lights)


@pytest.fixture(scope="module")
def opened(view):
    """Return the head with open lids, and the image of its eyes without lashes."""
    head, lids = view.rest, view.parts.lids
    faces = np.delete(head.faces, np.concatenate([one.faces for one in lids]), axis=0)
    faces = np.concatenate([faces, *(one.edges for one in lids)])
    mesh = build_mesh(open_lids(head.vertices_mm, lids, 1.0), faces, head.uv)
    return mesh, view.draw(mesh, Caster(mesh), ("brow",), 1.0, SUBPIXELS)


def pixel(view, point_mm):
    """Return row and column of the pixel at a point."""
    x, y = np.rint(view.camera.project(np.asarray(point_mm)[None]))[0].astype(int)
    return y, x


def test_closed_lids_stay_and_open_ones_clear_eye(view):
    rest, lids = view.rest.vertices_mm, view.parts.lids
    np.testing.assert_array_equal(open_lids(rest, lids, 0.0), rest)
    moved = open_lids(rest, lids, 1.0)
    for one in lids:
        away = np.linalg.norm(moved[one.vertices] - one.center_mm, axis=1)
        assert away.min() > APEX_MM + LID_GAP_MM - 1e-6
    still = np.setdiff1d(np.arange(len(rest)), np.concatenate([one.vertices for one in lids]))
    np.testing.assert_array_equal(moved[still], rest[still])


def test_pupil_is_dark_between_iris_and_sclera(view, opened):
    _, layer = opened
    for one in view.parts.lids:
        levels = []
        for aside_mm in (0.0, 4.0, 8.5):
            at = pixel(view, one.center_mm + np.array([aside_mm, -1.0, 10.0]))
            assert layer.coverage[at] == 1.0
            assert layer.hidden[at] == 0.0
            levels.append(layer.radiance[0][at].mean())
        assert levels[0] < 0.5 * levels[1]
        assert levels[1] < 0.7 * levels[2]


def test_cornea_mirrors_light_where_normal_bisects(view, opened):
    """Rationale: a mirror shows a light where its normal bisects light and view."""
    _, layer = opened
    for light, image in zip(view.lights, layer.radiance, strict=True):
        for one in view.parts.lids:
            to_eye = CAMERA_MM - one.center_mm
            gaze = to_eye / np.linalg.norm(to_eye)
            half = np.array(light.direction) + gaze
            half /= np.linalg.norm(half)
            point = one.center_mm + CORNEA_CENTER_MM * gaze + CORNEA_RADIUS_MM * half
            row, column = pixel(view, point)
            # the sclera, brighter than the reflection of rough tears, is 4 pixels away
            near = image[row - 3 : row + 4, column - 3 : column + 4].sum(axis=-1)
            found = np.unravel_index(np.argmax(near), near.shape)
            assert np.abs(np.array(found) - 3).max() <= 1


def test_closed_eyes_are_not_drawn(view):
    layer = view.draw(view.rest, Caster(view.rest), ("brow",), 0.0, SUBPIXELS)
    np.testing.assert_array_equal(layer.coverage, layer.hidden)
    for one in view.parts.lids:
        assert layer.coverage[pixel(view, one.center_mm + np.array([0.0, 0.0, 12.0]))] == 0.0


def test_hair_covers_scalp_and_not_the_face(view):
    layer = view.draw(view.rest, Caster(view.rest), ("scalp",), 0.0, SUBPIXELS)
    row, column = pixel(view, (0.0, 112.0, -40.0))
    assert layer.hidden[row - 5 : row + 6, column - 5 : column + 6].mean() > 0.4
    assert layer.hidden[pixel(view, (0.0, 55.0, 0.0))] == 0.0
    assert (layer.radiance >= 0.0).all()
    assert (layer.radiance[:, layer.hidden == 0.0] == 0.0).all()


def test_scalp_without_hair_draws_nothing(view):
    hair = view.parts.hair
    kept = sum(hair.counts[:2])
    bald = replace(
        hair, points_mm=hair.points_mm[:kept], roots=hair.roots[:kept], counts=(*hair.counts[:2], 0)
    )
    bare = replace(view, parts=replace(view.parts, hair=bald))
    layer = bare.draw(view.rest, Caster(view.rest), ("scalp",), 0.0, SUBPIXELS)
    skin, coverage = np.full((len(LIGHTS_DEG), 270, 240, 3), 0.4), np.full((270, 240), 0.5)
    radiance, covered = layer.draw_over(skin, coverage)
    np.testing.assert_array_equal(radiance, skin)
    np.testing.assert_array_equal(covered, coverage)


def test_layer_hides_skin_by_its_fraction():
    hidden, coverage = np.array([[0.0, 0.25, 0.0]]), np.array([[0.0, 0.25, 0.5]])
    layer = PartsLayer(np.full((1, 1, 3, 3), 0.1) * coverage[..., None], coverage, hidden)
    skin = np.full((1, 1, 3, 3), 0.8) * np.array([1.0, 1.0, 0.25])[:, None]
    radiance, covered = layer.draw_over(skin, np.array([[1.0, 1.0, 0.25]]))
    np.testing.assert_allclose(covered, 1.0)
    expected = [0.8, 0.75 * 0.8 + 0.025, (0.05 + 0.2) / 0.75]
    np.testing.assert_allclose(radiance[0, 0, :, 0], expected)
