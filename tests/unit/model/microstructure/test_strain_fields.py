import numpy as np
import pytest

from model.microstructure.kernel_table import FOREHEAD, kernel_parameters
from model.microstructure.map_windows import MapWindow
from model.microstructure.mesh_strain import StrainError, strain
from model.microstructure.strain_fields import line_kernels, rasterize

POINTS = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def wavy(n=9):
    at = np.linspace(0.0, 20.0, n)
    x, y = np.meshgrid(at, at)
    points = np.stack([x.ravel(), y.ravel(), np.sin(x / 4.0).ravel()], axis=1)
    number = np.arange(n * n).reshape(n, n)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    uv = 0.1 + 0.8 * points[:, :2] / 20.0
    moved = points * [1.25, 0.8, 1.0] + 0.4 * np.sin(points[:, [1, 0, 0]] / 3.0)
    return strain(points, moved, faces, uv), faces, uv


def test_image_pixel_down_lowers_v_right_raises_u():
    uv = np.array([[0.0, 0.5], [0.5, 0.5], [0.5, 1.0], [0.0, 1.0]])  # top left quarter
    found = rasterize(
        strain(POINTS, POINTS * [1.2, 0.9, 1], FACES, uv), FACES, uv, (40, 80), pad_px=0
    )
    expected = np.zeros((40, 80), bool)
    expected[:20, :40] = True
    np.testing.assert_array_equal(found.covered, expected)
    inside = found.covered
    np.testing.assert_allclose(
        found.stretch[inside], np.broadcast_to([1.2, 0.9], (800, 2)), rtol=1e-6
    )
    np.testing.assert_allclose(
        np.abs(found.axes[inside][:, 0]), np.broadcast_to([1.0, 0.0], (800, 2)), atol=1e-6
    )
    # 10 mm are half of 80 columns along s, half of 40 rows along t
    np.testing.assert_allclose(
        found.px_per_mm[inside], np.broadcast_to([4.0, 2.0], (800, 2)), rtol=1e-6
    )
    np.testing.assert_array_equal(found.stretch[~inside], 1.0)


def test_axes_leaning_up_in_uv_do_in_image():
    uv = POINTS[:, :2] / 10.0
    c, s = np.cos(0.5), np.sin(0.5)
    axis = np.array([c, s, 0.0])
    moved = POINTS @ (np.eye(3) + 0.3 * np.outer(axis, axis))
    found = rasterize(strain(POINTS, moved, FACES, uv), FACES, uv, (16, 16))
    a = found.axes[8, 8, 0]
    np.testing.assert_allclose(a * np.sign(a[0]), [c, -s], atol=1e-6)


def test_pixel_decomposition_is_that_of_interpolated_tensor():
    found_strain, faces, uv = wavy()
    size = (67, 53)
    found = rasterize(found_strain, faces, uv, size, pad_px=0)
    y, x = np.mgrid[: size[0], : size[1]]
    at = np.stack([(x + 0.5) / size[1], 1.0 - (y + 0.5) / size[0]], axis=-1)
    seen = np.zeros(size, int)
    for face in faces:
        M = np.stack([uv[face[1]] - uv[face[0]], uv[face[2]] - uv[face[0]]], axis=1)
        weight = np.einsum("ij,yxj->yxi", np.linalg.inv(M), at - uv[face[0]])
        w = np.concatenate([1.0 - weight.sum(-1, keepdims=True), weight], axis=-1)
        inside = (w > 1e-9).all(-1)
        seen += inside
        t = w[inside] @ found_strain.tensor[face]
        m = w[inside] @ found_strain.uv_metric[face]
        T = np.eye(2) + np.stack([t[:, [0, 1]], t[:, [1, 2]]], axis=1)
        Q = np.stack([m[:, [0, 1]], m[:, [1, 2]]], axis=1)
        _, ratios, Vt = np.linalg.svd(T)
        S = Q @ np.swapaxes(Vt, 1, 2) * np.array([[size[1]], [-size[0]]])
        np.testing.assert_allclose(found.stretch[inside], ratios, rtol=2e-6)
        scale = np.linalg.norm(S, axis=1)
        np.testing.assert_allclose(found.px_per_mm[inside], scale, rtol=1e-5)
        for axis in range(2):
            unit = S[:, :, axis] / scale[:, [axis]]
            along = np.sum(unit * found.axes[inside][:, axis], axis=-1)
            np.testing.assert_allclose(np.abs(along), 1.0, atol=1e-5)
    assert seen.max() == 1
    assert (found.covered[seen == 1]).all()


def test_edge_sharing_triangles_leave_no_gap_windows_agree():
    found_strain, faces, uv = wavy()
    size = (200, 240)
    whole = rasterize(found_strain, faces, uv, size)
    y, x = np.mgrid[: size[0], : size[1]]
    u, v = (x + 0.5) / size[1], 1.0 - (y + 0.5) / size[0]
    inside = (u > 0.1) & (u < 0.9) & (v > 0.1) & (v < 0.9)
    np.testing.assert_array_equal(whole.covered, inside)
    for window in (
        MapWindow(0, 70, 0, 240),
        MapWindow(33, 101, 77, 200),
        MapWindow(150, 200, 190, 240),
    ):
        part = rasterize(found_strain, faces, uv, size, window=window)
        for name in ("stretch", "axes", "px_per_mm", "covered", "padded"):
            np.testing.assert_array_equal(
                getattr(part, name), getattr(whole, name)[window.rows, window.columns]
            )


def test_islands_extend_beyond_border_by_padding_only():
    found_strain, faces, uv = wavy()
    found = rasterize(found_strain, faces, uv, (100, 100), pad_px=3)
    assert found.covered[10:90, 10:90].all()
    ring = found.covered | found.padded
    assert ring[7:93, 7:93].all()
    assert ring.sum() == 86 * 86
    np.testing.assert_array_equal(found.stretch[7, 50], found.stretch[10, 50])
    np.testing.assert_array_equal(found.axes[7, 50], found.axes[10, 50])


def test_pixel_kernels_are_table_kernels_in_pixel_lengths():
    found_strain, faces, uv = wavy()
    found = rasterize(found_strain, faces, uv, (64, 64))
    for extrapolate in ("hold", "formula"):
        lines = line_kernels(found, extrapolate=extrapolate)
        for axis, line in enumerate(lines):
            alpha, sigma_um = kernel_parameters(found.stretch[..., axis], extrapolate=extrapolate)
            known = found.covered | found.padded
            np.testing.assert_allclose(line.alpha[known], alpha[known], atol=1e-6)
            sigma = 1e-3 * sigma_um * found.px_per_mm[..., axis]
            np.testing.assert_allclose(line.sigma_px[known], sigma[known], atol=1e-6)
            assert not line.alpha[~known].any()
    inside = FOREHEAD.inside(found.stretch)
    assert not inside.all()  # both rules were tried beyond the range


def test_neutral_pose_leaves_every_kernel_at_nothing():
    _, faces, uv = wavy()
    points = np.concatenate([20.0 * uv, np.zeros((len(uv), 1))], axis=1)
    still = rasterize(strain(points, points, faces, uv), faces, uv, (32, 32))
    assert all(line.is_identity for line in line_kernels(still))


def test_zero_area_or_strainless_triangles_cover_nothing():
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9], [0.5, 0.5]])
    points = np.concatenate([POINTS, [[5.0, 5.0, 0.0]]])
    faces = np.array([[0, 1, 2], [0, 2, 4], [3, 3, 4]])  # the diagonal twice over, and a line
    found = strain(points, points * 1.1, faces, uv)
    shown = rasterize(found, faces, uv, (20, 20), pad_px=0)
    y, x = np.mgrid[:20, :20]
    assert not shown.covered[x < 18 - y].any()
    assert np.isfinite(shown.axes).all()


def test_mismatched_windows_and_meshes_are_refused():
    found, faces, uv = wavy()
    with pytest.raises(StrainError, match="window"):
        rasterize(found, faces, uv, (10, 10), window=MapWindow(0, 11, 0, 5))
    with pytest.raises(StrainError, match="uv"):
        rasterize(found, faces, uv[:-1], (10, 10))
    with pytest.raises(StrainError, match="size"):
        rasterize(found, faces, uv, (0, 10))
    with pytest.raises(ValueError, match="extrapolate"):
        line_kernels(rasterize(found, faces, uv, (4, 4)), extrapolate="refuse")
