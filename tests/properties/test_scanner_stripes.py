"""Properties of decoded stripes: light, motion and order change nothing that they should not."""

import dataclasses

import numpy as np
import pytest
from fixtures.striped_scenes import CAMERA, CODE, OTHER, PROJECTOR, columns_of, hit_plane, shine
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reconstruction.scan import range_fusion, stripe_decoding, triangulation

SEEDS = st.integers(0, 10_000)
LIMITS = (600.0, 1200.0)
NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def range_maps(cameras=(CAMERA, OTHER), projector=PROJECTOR, codes=None):
    codes = codes or [columns_of(hit_plane(c, NORMAL, 10.0), PROJECTOR) for c in (CAMERA, OTHER)]
    return [
        triangulation.triangulate_stripes(
            camera, projector, shine(column).decode(), limits_mm=LIMITS
        )
        for camera, column in zip(cameras, codes, strict=True)
    ]


@given(SEEDS, st.floats(0.05, 50.0), st.floats(0.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_column_depends_on_neither_albedo_nor_ambient_light(seed, gain, ambient):
    rng = np.random.default_rng(seed)
    column = np.sort(rng.uniform(0.0, 1023.0, (3, 400)), axis=1)
    frames = shine(column, amplitude=1.0, ambient=0.1)
    albedo = gain * rng.uniform(0.2, 1.0, column.shape)
    dark = ambient * albedo
    found = stripe_decoding.decode_stripes(frames.gray, frames.phase, CODE, variance=0.0)
    lit = stripe_decoding.decode_stripes(
        albedo * frames.gray + dark, albedo * frames.phase + dark, CODE, variance=0.0
    )
    assert np.array_equal(found.valid, lit.valid)
    np.testing.assert_allclose(lit.position_px, found.position_px, atol=1e-6)
    np.testing.assert_allclose(found.position_px[found.valid], column[found.valid], atol=1e-6)


@pytest.mark.long
@given(SEEDS)
@settings(max_examples=8, deadline=None)
def test_points_move_with_all_devices(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=seed).as_matrix()
    shift = 100.0 * rng.standard_normal(3)

    def moved(device):
        rotation = device.rotation @ turn.T
        translation = device.translation_mm - rotation @ shift
        return dataclasses.replace(device, rotation=rotation, translation_mm=translation)

    codes = [columns_of(hit_plane(c, NORMAL, 10.0)) for c in (CAMERA, OTHER)]
    still = triangulation.drop_contradictions(range_maps(codes=codes), PROJECTOR)
    gone = triangulation.drop_contradictions(
        range_maps((moved(CAMERA), moved(OTHER)), moved(PROJECTOR), codes), moved(PROJECTOR)
    )
    for before, after in zip(still, gone, strict=True):
        both = before.valid & after.valid
        assert np.count_nonzero(before.valid ^ after.valid) < 0.02 * both.size
        wanted = before.points_mm[both] @ turn.T + shift
        np.testing.assert_allclose(after.points_mm[both], wanted, atol=1e-5)
        np.testing.assert_allclose(after.cosine[both], before.cosine[both], atol=1e-3)


@pytest.mark.long
@given(st.permutations([0, 1]), st.floats(2.0, 4.0))
@settings(max_examples=6, deadline=None)
def test_fused_surface_depends_on_no_order(order, voxel_mm):
    maps = range_maps()
    mesh, stderr = range_fusion.fuse_ranges(maps, voxel_mm=voxel_mm)
    other, also = range_fusion.fuse_ranges([maps[k] for k in order], voxel_mm=voxel_mm)
    np.testing.assert_allclose(other.vertices_mm, mesh.vertices_mm, atol=1e-6)
    np.testing.assert_allclose(also, stderr)
    assert np.abs(mesh.vertices_mm @ NORMAL - 10.0).max() < 0.02
