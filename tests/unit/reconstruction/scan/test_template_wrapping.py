"""Template pose and wrapping on faces whose deformation is known."""

import numpy as np
import pytest
import trimesh
from scipy import sparse
from scipy.spatial.transform import Rotation

from reconstruction.scan import template_wrapping
from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.face_template import FaceTemplate, load_default_template
from reconstruction.scan.repair import ScanMeshError, TriangleMesh, boundary_edges
from reconstruction.scan.template_pose import estimate_pose, fit_similarity
from reconstruction.scan.template_wrapping import folded_triangles, wrap_template


def deformed(points):
    """A longer, slightly twisted face with a wider jaw."""
    x, y, z = points.T
    jaw = np.exp(-((y + 50.0) ** 2) / 800.0)
    return np.stack([x * (1.0 + 0.06 * jaw) + 0.01 * y, 1.03 * y, z - 2.0 * jaw], axis=-1)


def scanned(keep=None, fine=False, rotation=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    """The deformed template in another frame; the fine one has four times the triangles."""
    mesh = load_default_template().mesh
    if keep is not None:
        mesh = mesh.select_faces(keep(mesh.vertices_mm[mesh.faces].mean(axis=1)))
    points, faces = deformed(mesh.vertices_mm), mesh.faces
    if fine:
        points, faces = trimesh.remesh.subdivide(points, faces)
    turn = Rotation.from_euler("xyz", rotation, degrees=True).as_matrix()
    return TriangleMesh(points @ turn.T + shift, np.asarray(faces, np.int64)), turn


@pytest.fixture(scope="module")
def wrapped():
    return wrap_template(load_default_template(), scanned(fine=True)[0], steps=4)


@pytest.mark.long
def test_wrapped_template_is_on_scan_unfolded(wrapped):
    template = load_default_template()
    true = deformed(template.mesh.vertices_mm)
    away = np.linalg.norm(wrapped.mesh.vertices_mm - true, axis=1)[wrapped.valid]
    before = np.linalg.norm(template.mesh.vertices_mm - true, axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.5 < 2.0 < np.sqrt(np.mean(before**2))
    assert wrapped.valid.mean() > 0.9
    assert wrapped.folded == 0
    assert not folded_triangles(wrapped.mesh).any()
    np.testing.assert_array_equal(wrapped.mesh.faces, template.mesh.faces)


@pytest.mark.long
def test_vertices_without_scan_are_extrapolated():
    template = load_default_template()
    scan, _ = scanned(keep=lambda centers: centers[:, 0] > -5.0)
    found = wrap_template(template, scan, steps=3)
    x = template.mesh.vertices_mm[:, 0]
    assert not found.valid[x < -12.0].any()
    assert found.valid[(x > 5.0) & (x < 50.0)].mean() > 0.9
    assert found.across_mm[x < -40.0].min() > 3.0 * np.median(found.across_mm[x > 5.0])
    assert np.isfinite(found.mesh.vertices_mm).all()
    assert found.folded == 0


@pytest.mark.long
def test_pose_is_found_in_any_frame():
    scan, turn = scanned(rotation=(80.0, -35.0, 160.0), shift=(3e3, -5e4, 20.0))
    pose = estimate_pose(load_default_template(), ScanSurface(scan))
    error = Rotation.from_matrix(pose.rotation @ turn.T).magnitude()
    assert np.degrees(error) < 4.0
    assert pose.match > 0.8


def test_pose_without_search_needs_near_frame():
    scan, _ = scanned(rotation=(0.0, 150.0, 0.0))
    with pytest.raises(ScanMeshError, match="matches"):
        estimate_pose(load_default_template(), ScanSurface(scan), search=False)


@pytest.mark.long
def test_sphere_is_refused():
    ball = trimesh.creation.icosphere(3, 95.0)
    scan = TriangleMesh(np.asarray(ball.vertices, float), np.asarray(ball.faces, np.int64))
    with pytest.raises(ScanMeshError, match="SR-REC-024"):
        wrap_template(load_default_template(), scan)


def test_landmarks_replace_search():
    template = load_default_template()
    scan, turn = scanned(rotation=(0.0, 150.0, 0.0))
    names = ("nose tip", "chin", "eye outer left", "eye outer right", "mouth")
    given = {name: deformed(template.landmarks_mm[name][None])[0] @ turn.T for name in names}
    pose = estimate_pose(template, ScanSurface(scan), landmarks_mm=given, search=False)
    assert pose.match > 0.8


def test_similarity_of_exact_pairs_is_recovered(rng):
    points = 50.0 * rng.standard_normal((6, 3))
    turn = Rotation.random(random_state=3).as_matrix()
    pose = fit_similarity(points, 1.1 * points @ turn.T + (5.0, -7.0, 900.0))
    np.testing.assert_allclose(pose.move(points), 1.1 * points @ turn.T + (5.0, -7.0, 900.0))
    assert pose.scale == pytest.approx(1.1)


def test_similarity_of_points_on_line_is_refused():
    line = np.arange(4.0)[:, None] * np.ones(3)
    with pytest.raises(ScanMeshError, match="SR-REC-025"):
        fit_similarity(line, line)


def test_unknown_landmark_is_refused():
    with pytest.raises(ScanMeshError, match="SR-REC-027"):
        wrap_template(load_default_template(), scanned()[0], landmarks_mm={"tail": np.zeros(3)})


def test_template_without_texture_is_refused():
    mesh = load_default_template().mesh
    with pytest.raises(ScanMeshError, match="SR-REC-026"):
        FaceTemplate(TriangleMesh(mesh.vertices_mm, mesh.faces))


def test_default_template_is_one_unfolded_sheet():
    mesh = load_default_template().mesh
    assert not folded_triangles(mesh).any()
    edges = boundary_edges(mesh.faces)
    assert len(np.unique(edges)) == len(edges)
    assert len(mesh.vertices_mm) - 1.5 * len(mesh.faces) - 0.5 * len(edges) + len(mesh.faces) == 1


@pytest.mark.parametrize(("weight", "warnings"), [(0.0, 0), (100.0, 1)])
def test_only_unsolved_equations_warn(weight, warnings, monkeypatch, caplog, rng):
    """One step solves equations without planes, whose preconditioner is their inverse."""
    monkeypatch.setattr(template_wrapping, "SOLVER_STEPS", 1)
    normals = rng.standard_normal((20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matrix = sparse.diags(np.linspace(1.0, 2.0, 20)).tocsc()
    system = template_wrapping._System(matrix, np.full(20, weight), normals)
    right = rng.standard_normal((20, 3))
    found = system.solve(right, np.zeros((20, 3)))
    assert len(caplog.records) == warnings
    solved = np.abs(system._times(found) - right).max() < 1e-6
    assert solved == (warnings == 0)
    assert not system.solve(np.zeros((20, 3)), np.zeros((20, 3))).any()
    assert len(caplog.records) == warnings
