"""Normals in the frame of a texture over the smooth shape."""

import numpy as np
import pytest

from reconstruction.surface.tangent_space import TangentSpaceError, tangent_frames, tangent_normals


def cylinder(shape=(96, 128), radius_mm=60.0, height_mm=80.0):
    """Points and outward normals of a standing cylinder's front, u around, v up."""
    rows, columns = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    angle = (columns / shape[1] - 0.5) * 2.0
    normal = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=2)
    points = radius_mm * normal
    points[..., 1] = height_mm * (0.5 - rows / shape[0])
    return points, normal, angle


def test_smooth_shape_normal_is_tangent_z():
    points, normal, _ = cylinder()
    found = tangent_normals(normal, points, np.ones(points.shape[:2], bool), smoothing_mm=3.0)
    inner = found.normals[8:-8, 16:-16]
    np.testing.assert_allclose(inner, np.broadcast_to([0.0, 0.0, 1.0], inner.shape), atol=5e-3)


def test_tangent_x_follows_u_and_y_points_up():
    points, _, angle = cylinder()
    axes, known = tangent_frames(points, np.ones(points.shape[:2], bool), smoothing_mm=2.0)
    middle = (48, 64)
    assert known[middle]
    around = [np.cos(angle[middle]), 0.0, -np.sin(angle[middle])]
    np.testing.assert_allclose(axes[middle][0], around, atol=1e-3)
    np.testing.assert_allclose(axes[middle][1], [0.0, 1.0, 0.0], atol=1e-3)


def test_normal_tilt_is_preserved_in_tangent_space():
    points, normal, angle = cylinder()
    along = np.stack([np.cos(angle), 0.0 * angle, -np.sin(angle)], axis=2)
    tilted = np.cos(0.2) * normal + np.sin(0.2) * along
    found = tangent_normals(tilted, points, np.ones(points.shape[:2], bool), smoothing_mm=2.0)
    np.testing.assert_allclose(found.normals[48, 64], [np.sin(0.2), 0.0, np.cos(0.2)], atol=2e-3)
    # the shape alone would not say so
    plain = tangent_normals(normal, points, np.ones(points.shape[:2], bool), smoothing_mm=2.0)
    assert abs(plain.normals[48, 64, 0]) < 0.01


def test_tangent_frame_ignores_wrinkles():
    points, normal, _ = cylinder((240, 320))
    wave_mm, depth_mm = 4.0, 0.4
    y = points[..., 1]
    wrinkled = points + depth_mm * np.sin(2 * np.pi * y / wave_mm)[..., None] * normal
    slope = 2 * np.pi * depth_mm / wave_mm * np.cos(2 * np.pi * y / wave_mm)
    bent = normal - slope[..., None] * np.array([0.0, 1.0, 0.0])
    bent /= np.linalg.norm(bent, axis=2, keepdims=True)
    whole = np.ones(y.shape, bool)
    inside = np.s_[60:-60, 60:-60]

    def lost(smoothing_mm):
        found = tangent_normals(bent, wrinkled, whole, smoothing_mm=smoothing_mm).normals[inside]
        return np.abs(-found[..., 1] / found[..., 2] - slope[inside]).max()

    assert lost(6.0) < 0.02
    assert lost(0.0) > 0.3  # without smoothing the wrinkles take themselves away


def test_errors_rotate_with_frame_and_masks_are_kept():
    points, normal, _ = cylinder()
    valid = np.ones(points.shape[:2], bool)
    valid[20:30, 20:30] = False
    points[~valid] = np.nan
    stderr = np.broadcast_to([0.02, 0.01, 0.02], normal.shape)
    found = tangent_normals(normal, points, valid, stderr=stderr, smoothing_mm=2.0)
    assert not found.valid[~valid].any()
    assert np.isfinite(found.normals).all()
    # x and z errors are equal, so that the turn about y leaves them
    np.testing.assert_allclose(found.stderr[60, 64], [0.02, 0.01, 0.02], rtol=1e-3)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(TangentSpaceError, match="position_mm"):
        tangent_frames(np.zeros((4, 4)), np.ones((4, 4), bool))
    with pytest.raises(TangentSpaceError, match="no texel"):
        tangent_frames(np.zeros((4, 4, 3)), np.zeros((4, 4), bool))
    with pytest.raises(TangentSpaceError, match="same point"):
        tangent_frames(np.zeros((8, 8, 3)), np.ones((8, 8), bool))
