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


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=5))
@settings(max_examples=25, deadline=None)
def test_written_points_are_read_back(tmp_path_factory, points):
    path = tmp_path_factory.mktemp("points") / "points.csv"
    rows = [f"p{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(points)]
    path.write_text("\n".join(["name,x,y,z", *rows]))
    read = landmark_table.read_point_table(path)
    assert list(read.values()) == points
