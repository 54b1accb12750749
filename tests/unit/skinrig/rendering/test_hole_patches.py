"""Holes of a scan are closed as the surface around continues, and its rim is not."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.scan import hole_patches
from rigsim.geometry.mesh import build_mesh
from skinrig.rendering import hole_patches as patch_charts

RADIUS_MM = 60.0


def _dome(holes):
    """A half sphere on a lattice, its texture a disc within a square, without faces in holes."""
    n = 81
    v, u = np.mgrid[:n, :n] / (n - 1.0)
    a, b = 2.0 * u - 1.0, 2.0 * v - 1.0
    far = np.maximum(np.hypot(a, b), 1e-9)
    colatitude = 0.9 * np.minimum(far, 1.0) * np.pi / 2.0
    way = np.sin(colatitude) / far
    points = RADIUS_MM * np.stack([way * a, way * b, np.cos(colatitude)], axis=-1).reshape(-1, 3)
    uv = np.stack([0.05 + 0.6 * u, 0.05 + 0.6 * v], axis=-1).reshape(-1, 2)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    keep = (far.ravel()[faces] < 1.0).all(axis=1)
    for x, y, size in holes:
        middle = points[faces].mean(axis=1)
        keep &= np.hypot(middle[:, 0] - x, middle[:, 1] - y) > size
    faces = faces[keep]
    used, again = np.unique(faces, return_inverse=True)
    return build_mesh(points[used], again.reshape(-1, 3), uv[used])


HOLES = ((0.0, 0.0, 12.0), (28.0, 10.0, 6.0))


@pytest.fixture(scope="module")
def scan():
    return _dome(HOLES)


def test_small_holes_close_and_the_rim_stays(scan):
    found = hole_patches.find_patches(scan.vertices_mm, scan.faces)
    assert [len(one.rim) for one in found] == sorted([len(one.rim) for one in found], reverse=True)
    assert len(found) == 2
    closed = patch_charts.close_holes(scan)
    edges = hole_patches._loops(_welded(closed.mesh))
    assert len(edges) == 1
    rim = np.linalg.norm(closed.mesh.vertices_mm[edges[0]][:, :2], axis=1)
    assert rim.min() > 0.8 * RADIUS_MM * np.sin(0.45 * np.pi)
    whole = _dome(())
    assert hole_patches.find_patches(whole.vertices_mm, whole.faces) == []


def _welded(mesh):
    _, first, place = np.unique(mesh.vertices_mm, axis=0, return_index=True, return_inverse=True)
    return first[place.reshape(-1)][mesh.faces.astype(np.int64)]


def test_a_patch_bends_on_as_the_surface_does(scan):
    """A thin plate over a sphere: the stairs of the rim, 0.1 mm high, are all that it misses."""
    for patch in hole_patches.find_patches(scan.vertices_mm, scan.faces):
        off = np.abs(np.linalg.norm(patch.inner_mm, axis=1) - RADIUS_MM)
        rim = scan.vertices_mm[patch.rim].astype(np.float64)
        lid = patch.interpolate_from_rim(rim)[len(rim) :]
        lid_off = np.abs(np.linalg.norm(lid, axis=1) - RADIUS_MM)
        assert off.max() < 0.5 * lid_off.max()
        a, b, c = (np.concatenate([rim, patch.inner_mm])[patch.faces[:, k]] for k in range(3))
        outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c)
        assert (outward > 0.0).all()


def test_patches_get_own_separate_charts(scan):
    closed = patch_charts.close_holes(scan)
    assert closed.open_loops_mm == ()
    new = closed.mesh.uv[len(scan.uv) :]
    assert new.min() > 0.0
    assert new.max() < 1.0
    old = scan.uv.astype(np.float64)
    for k, chart in enumerate(closed.charts):
        assert np.linalg.norm(old - chart.center, axis=1).min() > chart.radius + 0.01
        for other in closed.charts[k + 1 :]:
            apart = np.linalg.norm(chart.center - other.center)
            assert apart > chart.radius + other.radius + 0.01
    (_, told), *rest = closed.summary()
    assert told.startswith("2 holes")
    assert not rest


def test_measured_colors_continue_linearly_into_patches(scan):
    """A color that is linear in the texture is, on a small patch, linear across it."""
    closed = patch_charts.close_holes(scan)
    size = 256
    v, u = 1.0 - (np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size
    values = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1).astype(np.float32)
    painted = closed.paint(values)
    for chart in closed.charts:
        column, row = int(chart.center[0] * size), int((1.0 - chart.center[1]) * size)
        middle = chart.rim_uv.mean(axis=0)
        np.testing.assert_allclose(painted[row, column], middle, atol=0.01)
        low, high = chart.rim_uv.min(axis=0), chart.rim_uv.max(axis=0)
        near = painted[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 2)
        assert (near > low - 0.01).all()
        assert (near < high + 0.01).all()
    # elsewhere nothing changed, and before painting another place's color was there
    changed = np.abs(painted - values).max(axis=-1) > 1e-3
    assert 0 < changed.mean() < 0.2
    away = scan.uv[:: len(scan.uv) // 50]
    rows = np.minimum(((1.0 - away[:, 1]) * size).astype(int), size - 1)
    columns = np.minimum((away[:, 0] * size).astype(int), size - 1)
    assert not changed[rows, columns].any()


@pytest.mark.parametrize("count", [1, 2])
def test_holes_of_three_and_four_vertices_are_painted(count):
    """The corners of the rim's polygon are within the patch's circle."""
    whole = _dome(())
    middle = whole.vertices_mm[whole.faces].mean(axis=1)
    first = int(np.argmin(np.linalg.norm(middle - [10.0, 14.0, 57.0], axis=1)))
    shared = np.isin(whole.faces, whole.faces[first]).sum(axis=1) == 2
    removed = [first, int(np.flatnonzero(shared)[0])][:count]
    mesh = build_mesh(whole.vertices_mm, np.delete(whole.faces, removed, axis=0), whole.uv)
    closed = patch_charts.close_holes(mesh)
    assert [len(chart.rim_uv) for chart in closed.charts] == [2 + count]
    size = 512
    ramp = np.broadcast_to((np.arange(size, dtype=np.float32) / size)[:, None], (size, size))
    painted = closed.paint(ramp)
    assert np.isfinite(painted).all()
    row, column = np.nonzero(painted != ramp)
    assert len(row) > 20
    height = 1.0 - closed.charts[0].rim_uv[:, 1]
    assert painted[row, column].min() > height.min() - 2.0 / size
    assert painted[row, column].max() < height.max() + 2.0 / size


def test_texture_without_room_leaves_hole_open_and_reports(scan):
    wide = (scan.uv - scan.uv.min()) / np.ptp(scan.uv)
    full = build_mesh(scan.vertices_mm, scan.faces, wide)
    corners = np.array([[-90, -90, -60], [90, -90, -60], [90, 90, -60], [-90, 90, -60]], np.float32)
    count = len(full.vertices_mm)
    mesh = build_mesh(
        np.concatenate([full.vertices_mm, corners]),
        np.concatenate(
            [full.faces, [[count, count + 1, count + 2], [count, count + 2, count + 3]]]
        ),
        np.concatenate([wide, [[0, 0], [1, 0], [1, 1], [0, 1]]]),
    )
    closed = patch_charts.close_holes(mesh)
    assert closed.charts == ()
    assert len(closed.open_loops_mm) >= 2
    assert closed.summary()[0][0] == "open holes"


def test_folded_triangles_unfold_and_others_stay():
    """Rationale: a plane with a vertex beyond its neighbors has triangles that face down."""
    side = 9
    x, y = np.meshgrid(np.arange(float(side)), np.arange(float(side)))
    points = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    a = np.arange(side * side).reshape(side, side)
    quads = [a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]]
    q = np.stack(quads, axis=-1).reshape(-1, 4)
    faces = np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]])
    plane = build_mesh(points, faces, points[:, :2] / side)
    same = patch_charts.smooth_folds(plane)
    np.testing.assert_array_equal(same.vertices_mm, plane.vertices_mm)
    points[a[4, 4]] += (1.7, 0.2, 0.3)
    folded = build_mesh(points, faces, plane.uv)
    found = patch_charts.smooth_folds(folded).vertices_mm

    def up(vertices):
        one, two, three = (vertices[faces[:, k]] for k in range(3))
        return np.cross(two - one, three - one)[:, 2]

    assert up(folded.vertices_mm).min() < 0.0
    assert up(found).min() > 0.0
    moved = np.abs(found - folded.vertices_mm).max(axis=1) > 0.0
    rows, columns = np.divmod(np.flatnonzero(moved), side)
    assert moved[a[4, 4]]
    assert np.abs(rows - 4).max() <= 1
    assert np.abs(columns - 4).max() <= 2
