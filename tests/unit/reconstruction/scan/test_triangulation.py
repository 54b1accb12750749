"""Triangulated stripes and fused ranges against plane, sphere and step."""

import dataclasses

import numpy as np
import pytest
from fixtures.striped_scenes import (
    CAMERA,
    OTHER,
    PROJECTOR,
    columns_of,
    hit_plane,
    hit_sphere,
    pinhole,
    shine,
)

from reconstruction.scan.range_fusion import fuse_ranges
from reconstruction.scan.repair import ScanMeshError
from reconstruction.scan.triangulation import drop_contradictions, triangulate_stripes

LIMITS = (600.0, 1200.0)
SHIFT_MM = np.array([1.0, 0.0, 0.0])
TILTED = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])


def scan(camera, points, **light):
    return triangulate_stripes(
        camera, PROJECTOR, shine(columns_of(points), **light).decode(), limits_mm=LIMITS
    )


def test_plane_is_recovered_exactly():
    points = hit_plane(CAMERA, TILTED, 20.0)
    found = scan(CAMERA, points)
    assert found.valid.mean() > 0.9
    np.testing.assert_allclose(found.points_mm[found.valid], points[found.valid], atol=1e-6)
    way = points - CAMERA.center_mm
    cosine = -(way @ TILTED) / np.linalg.norm(way, axis=-1)
    np.testing.assert_allclose(found.cosine[found.valid], cosine[found.valid], atol=1e-6)


def test_lens_distortion_of_both_is_undone():
    camera = dataclasses.replace(CAMERA, distortion=np.array([-0.1, 0.05, 1e-3, -1e-3, 0.0]))
    projector = dataclasses.replace(PROJECTOR, distortion=np.array([0.15, 0.1, -1e-3, 1e-3, 0]))
    points = hit_plane(camera, TILTED, 20.0)
    stripes = shine(columns_of(points, projector)).decode()
    found = triangulate_stripes(camera, projector, stripes, limits_mm=LIMITS)
    assert found.valid.mean() > 0.9
    np.testing.assert_allclose(found.points_mm[found.valid], points[found.valid], atol=1e-5)
    plain = triangulate_stripes(camera, PROJECTOR, stripes, limits_mm=LIMITS)
    assert np.nanmax(np.abs(plain.range_mm - found.range_mm)) > 1.0


def test_noisy_plane_has_its_standard_error(rng):
    points = hit_plane(CAMERA, TILTED, 20.0)
    found = scan(CAMERA, points, noise=5.0, rng=rng)
    miss = (found.points_mm - points)[found.valid]
    error = np.einsum("nk,nk->n", miss, CAMERA.rays(np.argwhere(found.valid)[:, ::-1]))
    z = error / found.stderr_mm[found.valid]
    assert found.valid.mean() > 0.85
    assert np.mean(np.abs(z) < 1) == pytest.approx(0.683, abs=0.02)  # n about 17,000
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.05)


def test_wrong_projector_pose_displaces_plane():
    points = hit_plane(CAMERA, TILTED, 20.0)
    stripes = shine(columns_of(points)).decode()
    moved = dataclasses.replace(PROJECTOR, translation_mm=PROJECTOR.translation_mm + SHIFT_MM)
    found = triangulate_stripes(CAMERA, moved, stripes, limits_mm=LIMITS)
    assert np.sqrt(np.nanmean((found.range_mm - scan(CAMERA, points).range_mm) ** 2)) > 1.0


def test_step_invents_no_points_between():
    high, low = (hit_plane(CAMERA, [0.0, 0.0, 1.0], z) for z in (0.0, -30.0))
    points = np.where(high[..., :1] < 0.0, high, low)
    found = scan(CAMERA, points)
    z = found.points_mm[found.valid][:, 2]
    assert found.valid.mean() > 0.8
    assert np.minimum(np.abs(z), np.abs(z + 30.0)).max() < 1e-6


def test_parallel_stripes_are_masked():
    points = hit_plane(CAMERA, TILTED, 20.0)
    stripes = shine(columns_of(points)).decode()
    beside = pinhole((250.0, 0.0, 860.0), focal_px=2800.0, size=(1024, 768))
    above = triangulate_stripes(CAMERA, beside, stripes, limits_mm=LIMITS)
    assert not above.valid.any()  # camera and projector in one plane of stripes


def test_cameras_that_agree_are_kept():
    maps = [scan(camera, hit_plane(camera, TILTED, 20.0)) for camera in (CAMERA, OTHER)]
    kept = drop_contradictions(maps, PROJECTOR)
    for before, after in zip(maps, kept, strict=True):
        assert np.array_equal(before.valid, after.valid)


def test_mirror_patch_of_one_camera_is_masked():
    points = [hit_plane(camera, [0.0, 0.0, 1.0], 0.0) for camera in (CAMERA, OTHER)]
    # one camera sees the plane in a mirror: the columns of a patch are those of points elsewhere
    patch = np.linalg.norm(points[0] - [20.0, 0.0, 0.0], axis=-1) < 12.0
    columns = columns_of(points[0])
    columns[patch] = columns_of(points[0] + [25.0, 0.0, 0.0])[patch]
    first = triangulate_stripes(CAMERA, PROJECTOR, shine(columns).decode(), limits_mm=LIMITS)
    wrong = first.valid & (np.abs(first.points_mm[..., 2]) > 1.0)
    assert np.count_nonzero(wrong) > 100
    kept, _ = drop_contradictions([first, scan(OTHER, points[1])], PROJECTOR)
    assert not (kept.valid & wrong).any()
    assert np.count_nonzero(kept.valid) > 0.6 * np.count_nonzero(first.valid & ~wrong)


def test_fused_sphere_is_closed_form(rng):
    center, radius = np.array([0.0, 0.0, -50.0]), 70.0
    maps = [
        scan(camera, hit_sphere(camera, center, radius), noise=5.0, rng=rng)
        for camera in (CAMERA, OTHER)
    ]
    mesh, stderr = fuse_ranges(maps, voxel_mm=3.0)
    out = np.linalg.norm(mesh.vertices_mm - center, axis=1) - radius
    inner = mesh.vertices_mm[:, 2] > center[2] + 0.6 * radius  # normals within 53 degrees
    assert np.count_nonzero(inner) > 1000
    assert np.abs(out[inner].mean()) < 0.03
    z = out[inner] / stderr[inner]
    assert 0.6 < np.mean(np.abs(z) < 1.0) < 0.9
    # counter-clockwise from outside
    normals = mesh.normals()[inner]
    outward = (mesh.vertices_mm[inner] - center) / radius
    assert np.einsum("nk,nk->n", normals, outward).mean() > 0.9


def test_fusion_leaves_holes_open():
    points = hit_plane(CAMERA, [0.0, 0.0, 1.0], 0.0)
    found = scan(CAMERA, points)
    hole = np.linalg.norm(points, axis=-1) < 15.0
    mesh, _ = fuse_ranges([found.keep(found.valid & ~hole)], voxel_mm=2.0)
    assert np.linalg.norm(mesh.vertices_mm, axis=1).min() > 12.0
    # ranges between pixels are linear, those of a plane are not
    np.testing.assert_allclose(mesh.vertices_mm[:, 2], 0.0, atol=2e-3)


def test_no_range_is_refused():
    found = scan(CAMERA, hit_plane(CAMERA, TILTED, 20.0))
    with pytest.raises(ScanMeshError, match="got no decoded range"):
        fuse_ranges([found.keep(np.zeros_like(found.valid))], voxel_mm=2.0)
