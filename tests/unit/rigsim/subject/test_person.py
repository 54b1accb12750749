"""The simulated face: ranges, determinism, what states do, geometry in the rig frame."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, MeshError, MeshFileError, build_mesh, load_mesh
from rigsim.subject import face_regions, relief
from rigsim.subject.perfusion import STATE_NAMES, StateError
from rigsim.subject.person import PRESET_NAMES, SimulatedSubject, SubjectError, make_subject
from rigsim.subject.pigment import MELANIN_PRESETS

SIZE = 256


@pytest.fixture(scope="module")
def regions(face: SimulatedSubject) -> dict[str, np.ndarray]:
    return face_regions.region_masks(face_regions.to_mean_head(face.atlas.position_mm, face.mesh))


def test_same_seed_makes_same_face_another_seed_another(face):
    again = make_subject("II", seed=4, size=SIZE)
    other = make_subject("II", seed=5, size=SIZE)
    for field in ("melanin", "roughness", "height_um", "normal", "hair"):
        np.testing.assert_array_equal(getattr(face, field), getattr(again, field))
        assert (getattr(face, field) != getattr(other, field)).any()
    np.testing.assert_array_equal(face.mesh.vertices_mm, again.mesh.vertices_mm)
    np.testing.assert_array_equal(face.hemoglobin("anger"), again.hemoglobin("anger"))
    assert np.abs(face.mesh.vertices_mm - other.mesh.vertices_mm).max() > 0.5


@pytest.mark.long
@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_every_preset_stays_inside_skin_model_ranges(preset):
    face = make_subject(preset, seed=1, size=96)
    assert 0.0005 < face.melanin.min()
    assert face.melanin.max() < 0.5
    typical = float(np.median(face.melanin))
    assert typical == pytest.approx(MELANIN_PRESETS[preset], rel=0.35)
    for state in STATE_NAMES:
        blood = face.hemoglobin(state)
        assert 0.001 < blood.min()
        assert blood.max() < 0.32
    assert 0.15 <= face.roughness.min()
    assert face.roughness.max() <= 0.5


def test_the_presets_span_the_stated_range_in_order():
    values = [MELANIN_PRESETS[name] for name in PRESET_NAMES]
    assert values == sorted(values)
    assert (values[0], values[-1]) == (0.0075, 0.23)


def test_face_has_adult_size_and_faces_camera(face):
    low, high = face.mesh.vertices_mm.min(axis=0), face.mesh.vertices_mm.max(axis=0)
    assert 140.0 < high[0] - low[0] < 190.0
    assert 20_000 <= len(face.mesh.faces) <= 60_000
    tip = face.mesh.vertices_mm[np.argmax(face.mesh.vertices_mm[:, 2])]
    assert abs(tip[0]) < 1.0
    assert 15.0 < tip[2] < 35.0
    front = face.mesh.normals[face.mesh.vertices_mm[:, 2] > 0.0]
    assert (front[:, 2] > 0.0).mean() > 0.95


def test_triangles_are_wound_towards_the_outside(face):
    corners = face.mesh.vertices_mm[face.mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    agrees = np.sum(flat * face.mesh.normals[face.mesh.faces[:, 0]], axis=-1) > 0.0
    assert agrees.mean() > 0.99


def test_texture_u_runs_right_row_0_is_top(face):
    x, y = face.atlas.position_mm[..., 0], face.atlas.position_mm[..., 1]
    middle = SIZE // 2
    assert (np.diff(x[middle, SIZE // 4 : 3 * SIZE // 4]) > 0.0).all()
    assert y[SIZE // 4, middle] > y[3 * SIZE // 4, middle] + 50.0


def test_cheeks_nose_and_lips_exceed_forehead_in_blood(face, regions):
    blood = face.hemoglobin()
    mean = {name: blood[regions[name] > 0.7].mean() for name in regions}
    for name, factor in (("cheeks", 1.05), ("nose", 1.2), ("lips", 2.5)):
        assert mean[name] > factor * mean["forehead"]


@pytest.mark.parametrize("region", ["forehead", "cheeks", "nose"])
def test_blood_is_locally_near_gaussian_with_own_deviation(face, regions, region):
    """Within a region: |skewness| below 0.8, |excess kurtosis| below 1.5 (an exponential has 2, 6),
    and a relative deviation between 8 and 35 %."""
    values = face.hemoglobin()[regions[region] > 0.7]
    assert abs(stats.skew(values)) < 0.8
    assert abs(stats.kurtosis(values)) < 1.5
    assert 0.08 < values.std() / values.mean() < 0.35


def test_states_change_blood_only_where_expected(face, regions):
    neutral = face.hemoglobin()

    def change(state: str, region: str) -> float:
        inside = regions[region] > 0.6
        return float(face.hemoglobin(state)[inside].mean() / neutral[inside].mean())

    everywhere = np.ones_like(neutral, bool)
    overall = {s: face.hemoglobin(s)[everywhere].mean() / neutral.mean() for s in STATE_NAMES}
    assert overall["neutral"] == 1.0
    assert overall["anger"] > 1.1 > 0.9 > overall["fear"]
    assert overall["exercise"] > 1.15
    # where expressions press blood, see test_tissue_pressure
    assert change("smile", "lids") > 1.03 > 1.0 > change("smile", "mouth corners")
    assert change("anger", "cheeks") > 1.2
    # Exercise and alcohol redden different regions (observation 5).
    assert change("alcohol", "nose") / change("alcohol", "cheeks") > 1.05
    assert change("exercise", "cheeks") / change("exercise", "nose") > 1.1


def test_state_map_is_not_affine_in_neutral_map(face, regions):
    """Within one small patch, the best affine map leaves a part that is not rounding."""
    inside = regions["cheeks"] > 0.8
    x, y = face.hemoglobin()[inside], face.hemoglobin("exercise")[inside]
    slope, offset = np.polyfit(x, y, 1)
    rest = np.std(y - slope * x - offset) / np.std(y)
    assert rest > 0.03


def test_moles_and_freckles_are_darker_spots(face):
    """Expected: a tail of melanin above three times the median that covers little of the skin."""
    share = np.mean(face.melanin > 3.0 * np.median(face.melanin))
    assert 1e-4 < share < 0.03


def test_pale_skin_has_more_freckles_than_dark_skin():
    def rough_share(preset: str) -> float:
        m = make_subject(preset, seed=1, size=256).melanin
        return float(np.mean(m > 1.6 * np.median(m)))

    assert rough_share("palest") > 2.0 * rough_share("VI")


def test_relief_tilts_plane_normals_against_its_slope():
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    plane = build_mesh(
        np.column_stack([corners * [32.0, 16.0], np.zeros(4)]),
        [[0, 1, 2], [0, 2, 3]],
        0.5 * (corners + 1.0),
    )
    atlas = unwrap(plane, 64)
    x, y = atlas.position_mm[..., 0], atlas.position_mm[..., 1]
    normal = relief.relief_normals(atlas, 100.0 * x - 50.0 * y)[10:-10, 10:-10]
    expected = np.array([-0.1, 0.05, 1.0]) / np.linalg.norm([-0.1, 0.05, 1.0])
    np.testing.assert_allclose(normal, np.broadcast_to(expected, normal.shape), atol=1e-5)


def test_texel_lengths_match_surface_below():
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    plane = build_mesh(
        np.column_stack([corners * [32.0, 16.0], np.zeros(4)]),
        [[0, 1, 2], [0, 2, 3]],
        0.5 * (corners + 1.0),
    )
    along_u, along_v = unwrap(plane, 64).texel_mm()
    np.testing.assert_allclose(along_u, 1.0, rtol=1e-5)
    np.testing.assert_allclose(along_v, 0.5, rtol=1e-5)


def test_mesh_file_replaces_head_centered_in_rig(tmp_path, face):
    path = tmp_path / "someone.npz"
    np.savez(
        path,
        vertices_mm=face.mesh.vertices_mm + np.array([100.0, -40.0, 500.0], np.float32),
        faces=face.mesh.faces,
        uv=face.mesh.uv,
    )
    someone = make_subject("II", seed=4, size=SIZE, mesh=path)
    moved = someone.mesh.vertices_mm - face.mesh.vertices_mm
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-3)
    assert np.abs(moved[0]).max() < 3.0


def test_obj_file_is_read_with_texture_coordinates(tmp_path):
    path = tmp_path / "plate.obj"
    path.write_text("v -50 -50 0\nv 50 -50 0\nv 50 50 5\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n")
    mesh = load_mesh(path)
    assert isinstance(mesh, Mesh)
    order = np.argsort(mesh.uv.sum(axis=1))
    np.testing.assert_allclose(mesh.vertices_mm[order, 0], [-50.0, 50.0, 50.0])


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("gone.npz", None, "cannot be read"),
        ("noise.npz", b"not a zip file", "cannot be read"),
        ("face.stl", b"solid", "expected .npz or .obj"),
        ("bare.obj", b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n", "no texture coordinates"),
    ],
)
def test_unusable_mesh_file_is_named(tmp_path, name, content, word):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshFileError, match=word) as caught:
        load_mesh(path)
    assert name in str(caught.value)


def test_a_mesh_archive_without_its_arrays_is_named(tmp_path):
    path = tmp_path / "half.npz"
    np.savez(path, vertices_mm=np.zeros((3, 3)))
    with pytest.raises(MeshError, match="lacks faces, uv"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"preset": "VII"}, "preset: got 'VII'"),
        ({"seed": -1}, "seed: got -1"),
        ({"size": 16}, "size: got 16"),
        ({"blood": 9.0}, "blood: got 9.0"),
    ],
)
def test_invalid_options_are_named(change, word):
    with pytest.raises(SubjectError, match=word):
        make_subject(**({"preset": "I", "seed": 0, "size": 64} | change))


def test_an_unknown_state_is_named(face):
    with pytest.raises(StateError, match="state: got 'joy'"):
        face.hemoglobin("joy")


def test_a_face_cannot_be_changed(face):
    with pytest.raises(dataclasses.FrozenInstanceError):
        face.seed = 3
