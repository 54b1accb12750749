"""Point values as textures: what is measured, what is filled, what is known of neither."""

import dataclasses
import io

import numpy as np
import pytest
import trimesh

from reconstruction.scan.mesh import RefinedScan
from reconstruction.scan.repair import RepairReport, TriangleMesh
from reconstruction.surface.estimates import PointValues
from reconstruction.surface.texture import SurfaceTexture

SIDE = 17
REPORT = RepairReport(**{f.name: 0 for f in dataclasses.fields(RepairReport)})


@pytest.fixture
def surface():
    """A square plate of 160 mm, +u along +x and +v along +y, with a margin around it."""
    line = np.linspace(-80.0, 80.0, SIDE)
    x, y = np.meshgrid(line, line)
    points = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    at = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, d), (a, d, c))]).astype(
        np.int32
    )
    uv = (points[:, :2] / 200.0 + 0.5)[faces]
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1)).astype(np.float32)
    mesh = TriangleMesh(points, faces.astype(np.int64), uv)
    return RefinedScan(
        points.astype(np.float32), normals, faces, uv.astype(np.float32), mesh, REPORT
    )


def whole(surface):
    return np.ones(len(surface.points_mm), bool)


def test_position_map_gives_texel_positions_on_plate(surface):
    size = 50
    texture = SurfaceTexture.of(surface, size=size)
    found = texture.map(surface.points_mm, None, whole(surface), "mm", "rig frame")
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    x = ((column + 0.5) / size - 0.5) * 200.0
    y = (0.5 - (row + 0.5) / size) * 200.0  # the top row is v of one
    inside = (np.abs(x) < 80.0) & (np.abs(y) < 80.0)
    np.testing.assert_array_equal(found.valid, inside)
    expected = np.stack([x, y, 0.0 * x], axis=-1)
    np.testing.assert_allclose(found.values[inside], expected[inside], atol=1e-3)


def test_triangle_with_unmeasured_corner_is_filled_but_invalid(surface):
    values = np.linspace(1.0, 2.0, len(surface.points_mm))
    valid = whole(surface)
    valid[SIDE * SIDE // 2] = False
    values[~valid] = 1e6
    texture = SurfaceTexture.of(surface, size=64)
    found = texture.map(values, 0.1 * values, valid, "1", "")
    full = texture.map(values, 0.1 * values, whole(surface), "1", "")
    lost = full.valid & ~found.valid
    # six triangles meet in a corner, each half a square of 10 mm; a texel is 200 / 64 mm
    assert np.count_nonzero(lost) == pytest.approx(6 * 50.0 / (200 / 64) ** 2, rel=0.25)
    assert found.values[lost].max() < 2.1
    assert found.values[lost].min() > 0.9
    assert found.stderr[found.valid].max() < 0.21
    assert found.stderr[found.valid].min() > 0.09


def test_map_without_measurements_is_invalid_without_nan(surface):
    texture = SurfaceTexture.of(surface, size=32)
    count = len(surface.points_mm)
    none = PointValues(np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, bool))
    for found in (
        texture.normals(none, ""),
        texture.map(none.values, none.stderr, none.valid, "1", ""),
    ):
        assert not found.valid.any()
        assert np.isfinite(found.values).all()
        assert np.isfinite(found.stderr).all()


def test_normals_between_points_are_unit_vectors(surface):
    way = surface.points_mm + np.array([0.0, 0.0, 60.0])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    found = SurfaceTexture.of(surface, size=64).normals(
        PointValues(way, np.full(way.shape, 0.01), whole(surface)), "world"
    )
    length = np.linalg.norm(found.values, axis=-1)
    np.testing.assert_allclose(length, 1.0, atol=1e-6)
    np.testing.assert_allclose(found.stderr[found.valid], 0.01, rtol=1e-5)
    # straight interpolation between corners would be shorter
    texture = SurfaceTexture.of(surface, size=64)
    bare = texture.map(way, None, whole(surface), "1", "")
    assert np.linalg.norm(bare.values, axis=-1)[bare.valid].min() < 0.999


def test_exported_mesh_is_read_unchanged_by_other_programs(surface):
    text = SurfaceTexture.of(surface, size=32).wavefront()
    read = trimesh.load(io.BytesIO(text), file_type="obj", process=False)
    assert len(read.faces) == len(surface.faces)
    np.testing.assert_allclose(
        np.sort(read.triangles_center, axis=0),
        np.sort(surface.points_mm[surface.faces].mean(axis=1), axis=0),
        atol=1e-3,
    )
    # texture and place go together: u and v are those of x and y
    np.testing.assert_allclose(read.visual.uv, read.vertices[:, :2] / 200.0 + 0.5, atol=1e-4)
    np.testing.assert_allclose(read.face_normals[:, 2], 1.0)
