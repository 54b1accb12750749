"""Properties of closest points, similarities, stiffness and folds of scanned surfaces."""

import numpy as np
from fixtures.flat_sheets import sheet
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reconstruction.correspondence import landmark_table
from reconstruction.scan import (
    closest_points,
    face_template,
    hole_patches,
    surface_stiffness,
    template_pose,
    template_wrapping,
)
from reconstruction.scan.repair import TriangleMesh

SEEDS = st.integers(0, 10_000)


@given(SEEDS, st.floats(1e-3, 1e3))
@settings(max_examples=50, deadline=None)
def test_closest_weights_do_not_depend_on_unit(seed, unit):
    rng = np.random.default_rng(seed)
    corners, points = rng.standard_normal((20, 3, 3)), 2.0 * rng.standard_normal((20, 3))
    weights = closest_points.closest_barycentric(points, corners)
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
    scaled = closest_points.closest_barycentric(unit * points, unit * corners)
    np.testing.assert_allclose(scaled, weights, atol=1e-6)


@given(SEEDS, st.floats(0.8, 1.3))
@settings(max_examples=50, deadline=None)
def test_exact_similarity_is_recovered(seed, scale):
    rng = np.random.default_rng(seed)
    points = 50.0 * rng.standard_normal((5, 3))
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = scale * points @ turn.T + 100.0 * rng.standard_normal(3)
    np.testing.assert_allclose(
        template_pose.fit_similarity(points, moved).move(points), moved, atol=1e-6
    )


@given(SEEDS)
@settings(max_examples=15, deadline=None)
def test_rigid_motion_changes_no_area_bending_or_fold(seed):
    rng = np.random.default_rng(seed)
    flat = sheet(cells=4)
    rough = flat.vertices_mm + rng.standard_normal(flat.vertices_mm.shape)
    turn = Rotation.random(random_state=seed).as_matrix()
    here = TriangleMesh(rough, flat.faces)
    there = TriangleMesh(rough @ turn.T + 7.0, flat.faces)
    np.testing.assert_allclose(
        face_template.vertex_areas_mm2(there), face_template.vertex_areas_mm2(here)
    )
    np.testing.assert_array_equal(
        template_wrapping.folded_triangles(there), template_wrapping.folded_triangles(here)
    )
    shift = rng.standard_normal(len(rough))
    np.testing.assert_allclose(
        surface_stiffness.surface_stiffness(there).bending @ shift,
        surface_stiffness.surface_stiffness(here).bending @ shift,
        atol=1e-9,
    )


@given(SEEDS, st.floats(1.5, 3.0))
@settings(max_examples=15, deadline=None)
def test_hole_of_plane_is_closed_in_plane(seed, radius):
    """In any pose; the patch has the scan's noise alone, as the rim's normals agree."""
    flat = sheet(side_mm=80.0, cells=16)
    points = flat.vertices_mm - flat.vertices_mm.mean(axis=0)
    cell = np.sqrt(np.ptp(points[:, 0]) * np.ptp(points[:, 1])) / 16.0
    away = np.linalg.norm(points[flat.faces].mean(axis=1), axis=1)
    scan = TriangleMesh(points, flat.faces).select_faces(away > radius * cell)
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = TriangleMesh(scan.vertices_mm @ turn.T + 7.0, scan.faces)
    closed = hole_patches.close_scan(moved)
    (patch,) = hole_patches.find_patches(moved.vertices_mm, moved.faces)
    assert closed.hole_faces.sum() == len(patch.faces)
    np.testing.assert_allclose((closed.mesh.vertices_mm - 7.0) @ turn[:, 2], 0.0, atol=1e-6 * cell)
    patched = np.arange(len(closed.stderr_mm)) >= len(moved.vertices_mm)
    np.testing.assert_allclose(
        closed.stderr_mm, np.where(patched, hole_patches.SCAN_NOISE_MM, 0.0), atol=1e-3
    )
    np.testing.assert_array_equal(closed.corner_stderr_mm().all(axis=1), closed.hole_faces)
    area = np.linalg.norm(closed.mesh.face_vectors(), axis=1).sum() / 2.0
    np.testing.assert_allclose(area, np.ptp(points[:, 0]) * np.ptp(points[:, 1]), rtol=1e-6)


@given(SEEDS, st.floats(0.1, 10.0))
@settings(max_examples=25, deadline=None)
def test_patch_error_grows_away_from_bent_rim(seed, step_mm):
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    round_rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=-1)
    tilt = np.random.default_rng(seed).uniform(0.1, 1.0)
    normals = np.sin(tilt) * round_rim + np.array([0.0, 0.0, np.cos(tilt)])
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]) * step_mm
    near, far = hole_patches.estimate_patch_error(points, round_rim, normals)
    assert 0.0 < near < far


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=5))
@settings(max_examples=25, deadline=None)
def test_written_points_are_read_back(tmp_path_factory, points):
    path = tmp_path_factory.mktemp("points") / "points.csv"
    rows = [f"p{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(points)]
    path.write_text("\n".join(["name,x,y,z", *rows]))
    read = landmark_table.read_point_table(path)
    assert list(read.values()) == points
