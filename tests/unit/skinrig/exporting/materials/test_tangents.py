"""Frames of normal maps: a renderer that decodes a map gets the measured normals back."""

import numpy as np
import pytest

from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from skinrig.exporting.materials.tangents import (
    FramedMesh,
    fill_tangent_normals,
    rotate_from_tangent,
    rotate_to_tangent,
)

SIZE = 48


def angle_rad(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def renderer_decodes(framed, codes, size):
    """Decode a map at texel centres with code of its own: barycentric search, frames, sum."""
    out = np.zeros((size, size, 3))
    tangent, normal = framed.tangents.astype(float), framed.normals.astype(float)
    bitangent = tangent[:, 3:] * np.cross(normal, tangent[:, :3])
    for face in framed.faces:
        (a, b, c) = framed.uv[face].astype(float)
        basis = np.linalg.inv(np.stack([b - a, c - a], axis=1))
        for row in range(size):
            v = 1.0 - (row + 0.5) / size
            for column in range(size):
                s, t = basis @ (np.array([(column + 0.5) / size, v]) - a)
                if min(s, t, 1.0 - s - t) < -1e-9:
                    continue
                mix = np.array([1.0 - s - t, s, t])
                x, y, z = codes[row, column]
                up = mix @ normal[face]
                shaded = x * (mix @ tangent[face, :3]) + y * (mix @ bitangent[face])
                shaded += z * up / np.linalg.norm(up)
                out[row, column] = shaded / np.linalg.norm(shaded)
    return out


def test_independent_renderer_recovers_measured_normals(patch):
    mesh, size = patch.mesh(), 12
    world = patch.bumpy(unwrap(mesh, size).normal)
    framed = FramedMesh.of(mesh)
    codes = rotate_to_tangent(world, *framed.texel_frames(size))
    assert angle_rad(renderer_decodes(framed, codes, size), world).max() < 1e-5
    flipped = codes * [1.0, -1.0, 1.0]  # what a reader of the other green would see
    assert angle_rad(renderer_decodes(framed, flipped, size), world).max() > 0.1


def test_world_to_tangent_and_back_loses_nothing(patch):
    framed = FramedMesh.of(patch.mesh())
    axes, covered = framed.texel_frames(SIZE)
    world = patch.bumpy(unwrap(patch.mesh(), SIZE).normal)
    back = rotate_from_tangent(rotate_to_tangent(world, axes, covered), axes)
    assert angle_rad(back, world)[covered].max() < 2e-6


def test_smooth_surface_is_flat_in_own_frame(patch):
    framed = FramedMesh.of(patch.mesh())
    axes, covered = framed.texel_frames(SIZE)
    flat = rotate_to_tangent(unwrap(patch.mesh(), SIZE).normal, axes, covered)
    assert np.abs(flat[covered] - [0.0, 0.0, 1.0]).max() < 1e-3


def test_slope_towards_u_and_v_is_red_green():
    flat = build_mesh(
        [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]],
        [[0, 1, 2], [0, 2, 3]],
        [[0, 0], [1, 0], [1, 1], [0, 1]],
    )
    axes, covered = FramedMesh.of(flat).texel_frames(8)
    for tilted, channel in (((0.6, 0.0, 0.8), 0), ((0.0, 0.6, 0.8), 1)):
        found = rotate_to_tangent(np.full((8, 8, 3), tilted), axes, covered)
        assert found[4, 4, channel] == pytest.approx(0.6, abs=1e-6)


def test_mirrored_chart_gets_own_vertices_with_opposite_sign():
    points = [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]]
    faces = [[0, 1, 2], [0, 2, 3]]
    mirrored = [[0.5, 0], [1, 0], [1, 1], [1, 1]]  # the second triangle folds back over the first
    mirrored[3] = [1.0, 0.5]
    framed = FramedMesh.of(build_mesh(points, faces, mirrored))
    assert sorted(set(framed.tangents[:, 3].tolist())) == [-1.0, 1.0]
    assert len(framed.source) == 6
    axes, covered = framed.texel_frames(16)
    world = np.full((16, 16, 3), (0.36, 0.48, 0.8))
    back = rotate_from_tangent(rotate_to_tangent(world, axes, covered), axes)
    assert angle_rad(back, world)[covered].max() < 2e-6


def test_triangle_without_texture_area_leaves_finite_frames():
    points = [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]]
    uv = [[0.2, 0.2], [0.2, 0.2], [0.2, 0.2], [0.9, 0.9]]
    framed = FramedMesh.of(build_mesh(points, [[0, 1, 2], [0, 2, 3]], uv))
    length = np.linalg.norm(framed.tangents[:, :3], axis=1)
    np.testing.assert_allclose(length, 1.0, atol=1e-6)


def test_normal_behind_surface_is_clamped_to_horizon():
    flat = build_mesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]])
    axes, covered = FramedMesh.of(flat).texel_frames(8)
    found = rotate_to_tangent(np.full((8, 8, 3), (0.6, 0.0, -0.8)), axes, covered)
    assert 0.0 < found[7, 0, 2] < 0.01
    assert found[7, 0, 0] > 0.99


def test_relief_continues_smoothly_where_unmeasured(patch):
    """What is filled in the rig's frame is laid onto another part's horizon: dark specks."""
    framed = FramedMesh.of(patch.mesh())
    axes, covered = framed.texel_frames(SIZE)
    relief = np.full((SIZE, SIZE, 3), (0.2, 0.1, np.sqrt(1 - 0.05)))
    measured = covered.copy()
    measured[10:30, 10:30] = False
    shown = fill_tangent_normals(np.where(measured[..., None], relief, (1.0, 0.0, 1e-3)), measured)
    np.testing.assert_allclose(shown, relief, atol=1e-4)
    world = np.where(measured[..., None], rotate_from_tangent(relief, axes), (0.0, -1.0, 0.0))
    old = rotate_to_tangent(world, axes, covered)
    assert old[20, 20, 2] < 0.5


def test_holes_are_counted_without_seams_and_outer_rim(patch):
    mesh = patch.mesh()
    middle = mesh.vertices_mm[mesh.faces].mean(axis=1)
    near = [np.linalg.norm(middle[:, :2] - [x, y], axis=1) < 9.0 for x, y in ((0, 0), (25, 25))]
    cut = build_mesh(mesh.vertices_mm, mesh.faces[~(near[0] | near[1])], mesh.uv)
    assert FramedMesh.of(cut).count_holes() == 2
    # each triangle a chart of its own
    corners = mesh.vertices_mm[mesh.faces].reshape(-1, 3)
    apart = build_mesh(
        corners, np.arange(len(corners)).reshape(-1, 3), mesh.uv[mesh.faces].reshape(-1, 2)
    )
    assert FramedMesh.of(apart).count_holes() == 0


def test_where_nothing_was_measured_the_surface_is_smooth():
    shown = fill_tangent_normals(np.full((8, 8, 3), np.nan), np.zeros((8, 8), bool))
    np.testing.assert_array_equal(shown, np.broadcast_to([0, 0, 1], (8, 8, 3)))
