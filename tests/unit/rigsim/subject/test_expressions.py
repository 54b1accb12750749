"""Expressions: skin goes where the muscles pull it, no triangle folds, persons differ."""

from pathlib import Path

import numpy as np
import pytest
from twins.triangle_stretch import principal_stretches

from rigsim.geometry.mesh import Mesh, MeshError, build_mesh, center_face, load_mesh
from rigsim.subject import expressions, face_regions
from rigsim.subject.expressions import EXPRESSION_STRENGTHS, ExpressionError, displacement_mm
from rigsim.subject.head import LANDMARKS_MM, build_head
from rigsim.subject.perfusion import STATE_NAMES

SCANNED_HEAD = Path(__file__).parents[5] / "shared" / "data" / "ict_face.npz"


@pytest.fixture(scope="module")
def head() -> Mesh:
    return build_head(np.random.default_rng([0, 0]))


def at(mesh: Mesh, state: str, landmark: str, **kwargs) -> np.ndarray:
    """Return how the skin nearest to a landmark of the mean head moves, mm."""
    place = face_regions.from_mean_head(np.array(LANDMARKS_MM[landmark]), mesh)
    nearest = np.argmin(np.linalg.norm(mesh.vertices_mm - place, axis=-1))
    return displacement_mm(mesh, state, **kwargs)[nearest]


def test_smile_moves_mouth_corners_up_out_6_10mm(head):
    for seed in range(12):
        for side, outward in (("left", -1.0), ("right", 1.0)):
            way = at(head, "smile", f"mouth corner {side}", seed=seed)
            assert 6.0 < np.linalg.norm(way) < 10.0
            assert outward * way[0] > 3.0
            assert way[1] > 3.0


@pytest.mark.parametrize(
    ("state", "landmark", "axis", "low", "high"),
    [
        ("smile", "cheek right", 1, 0.5, 4.0),
        ("happiness", "cheek left", 1, 1.0, 6.0),
        ("anger", "brow right", 1, -4.0, -0.5),
        ("surprise", "brow left", 1, 4.0, 9.0),
        ("surprise", "chin", 1, -10.0, -4.0),
        ("surprise", "chin", 2, -9.0, -2.0),
        ("surprise", "upper lip", 1, -3.0, 0.5),
        ("fear", "mouth corner right", 0, 2.0, 6.0),
        ("disgust", "nose wing left", 1, 1.0, 5.0),
        ("sadness", "mouth corner left", 1, -6.0, -2.0),
    ],
)
def test_each_expression_moves_its_regions_its_way(head, state, landmark, axis, low, high):
    assert low < at(head, state, landmark)[axis] < high


def test_anger_draws_the_brows_together(head):
    points = face_regions.to_mean_head(head.vertices_mm, head)
    inner = [
        np.argmin(np.linalg.norm(points - np.array([x, 42.0, 4.0]), axis=-1)) for x in (-12, 12)
    ]
    moved = displacement_mm(head, "anger")
    before = head.vertices_mm[inner[1], 0] - head.vertices_mm[inner[0], 0]
    after = before + moved[inner[1], 0] - moved[inner[0], 0]
    assert 2.0 < before - after < 9.0


def test_whole_body_states_and_rest_keep_face_still(head):
    for state in ("neutral", "exercise", "alcohol"):
        assert not displacement_mm(head, state).any()
    assert not displacement_mm(head, "smile", amount=0.0).any()
    assert {state for state in STATE_NAMES if expressions.is_moving_state(state)} == set(
        EXPRESSION_STRENGTHS
    )


def test_the_back_of_the_head_stays(head):
    back = head.vertices_mm[:, 2] < -85.0
    for state in EXPRESSION_STRENGTHS:
        assert np.abs(displacement_mm(head, state, amount=1.5)[back]).max() < 0.3


def test_subjects_have_individual_strengths_and_slight_asymmetry(head):
    ways = np.array([at(head, "smile", "mouth corner left", seed=seed) for seed in range(8)])
    sizes = np.linalg.norm(ways, axis=-1)
    assert 0.02 < sizes.std() / sizes.mean() < 0.15
    other = np.array([at(head, "smile", "mouth corner right", seed=seed) for seed in range(8)])
    uneven = np.abs(sizes / np.linalg.norm(other, axis=-1) - 1.0)
    assert 0.0 < uneven.max() < 0.2
    np.testing.assert_array_equal(
        displacement_mm(head, "smile", seed=3), displacement_mm(head, "smile", seed=3)
    )


@pytest.mark.parametrize("state", sorted(EXPRESSION_STRENGTHS))
def test_extreme_expression_folds_no_triangle_and_bounds_stretch(head, state):
    """Bounds: between 0.6 and 1.65 of the length in a full expression, 0.42 and 2 in an extreme."""
    for amount, low, high in ((1.0, 0.6, 1.65), (1.5, 0.42, 2.0)):
        for seed in (0, 7):
            moved = head.vertices_mm + displacement_mm(head, state, amount=amount, seed=seed)
            stretch, folded = principal_stretches(head.vertices_mm, moved, head.faces)
            assert not folded.any()
            assert low < stretch.min()
            assert stretch.max() < high


def test_a_movement_far_beyond_an_extreme_folds(head):
    """Shows that the test above can fail."""
    moved = head.vertices_mm + 5.0 * displacement_mm(head, "smile")
    assert principal_stretches(head.vertices_mm, moved, head.faces)[1].any()


def test_stretch_of_sheared_triangle_matches_its_map():
    flat = np.array([[0.0, 0, 0], [2.0, 0, 0], [0.5, 1.5, 0], [0.0, 0, 0]])
    linear = np.array([[1.3, 0.4, 0.0], [0.0, 0.7, 0.0], [0.0, 0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 3, 1]], np.int32)  # the second has no area
    stretch, folded = principal_stretches(flat, flat @ linear.T, faces)
    expected = np.linalg.svd(linear[:2, :2], compute_uv=False)[::-1]
    np.testing.assert_allclose(stretch[0], expected, rtol=1e-12)
    np.testing.assert_array_equal(stretch[1], 1.0)
    assert not folded.any()
    mirrored = flat * np.array([-1.0, 1.0, 1.0])
    assert principal_stretches(flat, mirrored, faces)[1].tolist() == [True, False]


def test_normals_rotate_with_surface(head):
    """Expected: shading normals are as near to the triangles' as they are at rest."""

    def away_deg(mesh: Mesh) -> np.ndarray:
        corners = mesh.vertices_mm[mesh.faces].astype(np.float64)
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
        mean = mesh.normals[mesh.faces].mean(axis=1)
        mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
        return np.degrees(np.arccos(np.clip(np.sum(flat * mean, axis=-1), -1.0, 1.0)))

    deltas = displacement_mm(head, "surprise")
    moving = np.linalg.norm(deltas, axis=-1)[head.faces].max(axis=1) > 1.0
    rest, turned = away_deg(head)[moving], away_deg(expressions.displace_mesh(head, deltas))[moving]
    kept = away_deg(build_mesh(head.vertices_mm + deltas, head.faces, head.uv, head.normals))
    assert np.quantile(turned, 0.95) < np.quantile(rest, 0.95) + 1.0
    assert np.quantile(kept[moving], 0.95) > np.quantile(rest, 0.95) + 3.0


def test_mesh_with_own_shapes_moves_by_them(head):
    """A shape's left is the person's own: the image's right."""
    side = head.vertices_mm[:, 0] > 0.0
    lift = np.zeros(head.vertices_mm.shape)
    lift[side, 1] = 10.0
    own = build_mesh(
        head.vertices_mm, head.faces, head.uv, head.normals, shapes={"mouthSmile_L": lift}
    )
    moved = displacement_mm(own, "smile")
    # the cheeks have no shape here and are raised by the field
    fallback = displacement_mm(head, "smile") - moved
    lowest = head.vertices_mm[:, 1] < -100.0
    right = side & lowest
    assert 3.0 < moved[right, 1].mean() < 8.0
    assert np.abs(moved[~side & lowest]).max() < 0.5
    assert np.abs(fallback).max() > 3.0


def test_blend_shapes_for_export_are_the_full_expressions(head):
    shapes = expressions.blend_shapes(head, seed=2)
    assert set(shapes) == set(EXPRESSION_STRENGTHS)
    np.testing.assert_array_equal(shapes["fear"], displacement_mm(head, "fear", seed=2))


def test_file_shapes_are_loaded_and_must_fit_mesh(tmp_path, head):
    path = tmp_path / "shapes.npz"
    deltas = np.zeros((1, *head.vertices_mm.shape), np.float16)
    deltas[0, 5] = 2.0
    np.savez(
        path,
        vertices_mm=head.vertices_mm,
        faces=head.faces,
        uv=head.uv,
        shape_names=np.array(["jawOpen"]),
        shape_deltas_mm=deltas,
    )
    mesh = center_face(load_mesh(path))
    assert mesh.shapes["jawOpen"][5].tolist() == [2.0, 2.0, 2.0]
    with pytest.raises(MeshError, match=r"shapes\['jawOpen'\]: got shape"):
        build_mesh(head.vertices_mm, head.faces, head.uv, shapes={"jawOpen": deltas[0, :9]})


@pytest.mark.skipif(not SCANNED_HEAD.exists(), reason="the head with blend shapes is not here")
def test_head_with_blend_shapes_smiles_and_opens_mouth():
    """Its own shapes fold a few of 18,460 triangles inside the lips, and stretch their rims."""
    mesh = center_face(load_mesh(SCANNED_HEAD))
    assert len(mesh.shapes) == 22
    way = at(mesh, "smile", "mouth corner right")
    assert way[0] > 2.0
    assert way[1] > 2.0
    assert at(mesh, "surprise", "chin")[1] < -3.0
    for state in EXPRESSION_STRENGTHS:
        moved = mesh.vertices_mm + displacement_mm(mesh, state)
        stretch, folded = principal_stretches(mesh.vertices_mm, moved, mesh.faces)
        assert folded.mean() < 1e-3
        assert 0.4 < np.quantile(stretch, 0.001)


def test_invalid_options_are_named(head):
    with pytest.raises(ExpressionError, match="state: got 'joy', expected one of neutral"):
        displacement_mm(head, "joy")
    for amount in (-0.1, 1.6, float("nan")):
        with pytest.raises(ExpressionError, match="amount: got"):
            displacement_mm(head, "smile", amount=amount)
