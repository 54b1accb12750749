import numpy as np
import pytest

from model.microstructure.mesh_strain import StrainError, index_points, strain


def sheet(n=6, size_mm=10.0):
    """A flat square sheet, its texture alike, 0.1 per mm."""
    at = np.linspace(0.0, size_mm, n)
    x, y = np.meshgrid(at, at)
    points = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    number = np.arange(n * n).reshape(n, n)
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return points, faces, points[:, :2] / size_mm


def ball(rings=12, *, tube=False):
    """A closed ball or tube of 20 mm, split along a seam; latitude and longitude as its texture."""
    v, u = np.meshgrid(np.linspace(0.08, 0.92, rings), np.linspace(0.0, 1.0, 2 * rings + 1))
    points = 20.0 * np.stack(
        [
            np.sin(np.pi * v) * np.cos(2 * np.pi * u),
            np.sin(np.pi * v) * np.sin(2 * np.pi * u),
            np.cos(np.pi * v),
        ],
        -1,
    )
    if tube:
        turned = 2 * np.pi * u
        points = 20.0 * np.stack([np.cos(turned), np.sin(turned), 4.0 * v], -1)
    points[-1] = points[0]
    number = np.arange(points.shape[0] * rings).reshape(-1, rings)
    a, b = number[:-1, :-1].ravel(), number[1:, :-1].ravel()
    c, d = number[:-1, 1:].ravel(), number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return points.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2)


def turn(rng):
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


def paper(rest, moved, uv):
    """Eqs. (10)-(13) of one triangle, as they are written: ratios and columns of S."""

    def frame(points):
        edges = np.stack([points[1] - points[0], points[2] - points[0]], axis=1)
        Q = np.stack([uv[1] - uv[0], uv[2] - uv[0]], axis=1) @ np.linalg.pinv(edges)
        U, _, Vt = np.linalg.svd(np.vstack([Q, np.cross(Q[0], Q[1])]))
        return edges, Q, (U @ Vt)[:2]

    edges, Q, R = frame(rest)
    moved_edges, _, moved_R = frame(moved)
    T = (moved_R @ moved_edges) @ np.linalg.inv(R @ edges)  # eq. (10)
    _, ratios, Vt = np.linalg.svd(T)  # eq. (11)
    return ratios, Q @ R.T @ Vt.T, (Q, R, T)  # eq. (13)


def same_line(a, b, atol):
    sign = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    np.testing.assert_allclose(a, sign * b, atol=atol)


def test_triangle_ratios_and_axes_match_eqs_10_13(rng):
    for _ in range(200):
        rest, moved = rng.standard_normal((2, 3, 3)) * 5.0
        uv = rng.random((3, 2))
        ratios, S, _ = paper(rest, moved, uv)
        found = strain(rest, moved, [[0, 1, 2]], uv)
        np.testing.assert_allclose([found.r_s[1], found.r_t[1]], ratios, rtol=1e-7, atol=1e-9)
        scale = np.linalg.norm(S, axis=0)
        np.testing.assert_allclose(
            [found.uv_per_mm_s[2], found.uv_per_mm_t[2]],
            scale,
            rtol=1e-5 * ratios[0] / np.ptp(ratios),
        )
        same_line(found.axis_s[0], S[:, 0] / scale[0], 1e-5)
        same_line(found.axis_t[0], S[:, 1] / scale[1], 1e-5)


def test_q_r_and_t_match_eq_13_text(rng):
    rest, uv = rng.standard_normal((3, 3)), rng.random((3, 2))
    F = rng.standard_normal((3, 3))
    moved = rest @ F.T
    ratios, _, (Q, R, T) = paper(rest, moved, uv)
    found = strain(rest, moved, [[0, 1, 2]], uv)
    m = found.uv_metric[0]
    np.testing.assert_allclose([[m[0], m[1]], [m[1], m[2]]], Q @ R.T, atol=1e-10)
    t = found.tensor[0]
    right = np.array([[1.0 + t[0], t[1]], [t[1], 1.0 + t[2]]])
    np.testing.assert_allclose(right @ right, T.T @ T, atol=1e-9)  # T up to its rotation U V^T
    assert ratios[0] > ratios[1]


def test_sheet_stretch_gives_ratios_and_axes_any_direction(rng):
    points, faces, uv = sheet()
    for angle in (0.0, 0.4, 1.3, np.pi / 2):
        s, t = (
            np.array([np.cos(angle), np.sin(angle), 0]),
            np.array([-np.sin(angle), np.cos(angle), 0]),
        )
        F = 1.25 * np.outer(s, s) + 0.8 * np.outer(t, t) + np.diag([0, 0, 1.0])
        found = strain(points, points @ F.T @ turn(rng).T + 7.0, faces, uv)
        np.testing.assert_allclose(found.r_s, 1.25, atol=1e-12)
        np.testing.assert_allclose(found.r_t, 0.8, atol=1e-12)
        same_line(found.axis_s, np.broadcast_to(s[:2], found.axis_s.shape), 1e-9)
        same_line(found.axis_t, np.broadcast_to(t[:2], found.axis_t.shape), 1e-9)
        np.testing.assert_allclose(found.uv_per_mm_s, 0.1, rtol=1e-9)
        assert found.valid.all()
        assert not found.isotropic.any()


def test_bent_unstretched_surface_has_ratios_exactly_1(rng):
    points, faces, uv = ball()
    still = strain(points, points, faces, uv)
    np.testing.assert_array_equal(still.r_s, 1.0)
    np.testing.assert_array_equal(still.r_t, 1.0)
    assert still.isotropic.all()
    moved = strain(points, points @ turn(rng).T + 100.0, faces, uv)
    np.testing.assert_allclose([moved.r_s, moved.r_t], 1.0, atol=1e-12)


def test_inflated_ball_is_stretched_uniformly_and_isotropic():
    points, faces, uv = ball()
    for factor in (0.8, 1.3):
        found = strain(points, factor * points, faces, uv)
        np.testing.assert_allclose([found.r_s, found.r_t], factor, atol=1e-12)
        assert found.isotropic.all()
        np.testing.assert_allclose(np.linalg.norm(found.axis_s, axis=1), 1.0)
        # the frame's first axis: along longitude, whose lines the texture keeps
        np.testing.assert_allclose(np.abs(found.axis_s[:, 0]), 1.0, atol=0.02)


def test_texture_seam_does_not_appear_in_strain(rng):
    points, faces, uv = ball()
    squashed = points * np.array([1.1, 0.9, 0.7]) + 0.3 * np.sin(points[:, ::-1] / 4.0)
    found = strain(points, squashed, faces, uv)
    rings = 12
    np.testing.assert_array_equal(found.r_s[:rings], found.r_s[-rings:])
    np.testing.assert_array_equal(found.r_t[:rings], found.r_t[-rings:])
    n = len(points) - rings
    apart = strain(points[:n], squashed[:n], faces[(faces < n).all(axis=1)], uv[:n])
    assert np.abs(apart.r_s[:rings] - found.r_s[:rings]).max() > 1e-3  # without the other side
    # on a tube both sides have the same texture, and so the same axes
    points, faces, uv = ball(tube=True)
    wrung = points * np.array([1.1, 0.9, 0.7]) + 0.3 * np.sin(points[:, ::-1] / 4.0)
    found = strain(points, wrung, faces, uv)
    same_line(found.axis_s[:rings], found.axis_s[-rings:], 1e-9)
    same_line(found.axis_t[:rings], found.axis_t[-rings:], 1e-9)


def test_island_rotated_mirrored_scaled_transforms_its_axes(rng):
    points, faces, uv = sheet()
    F = np.eye(3) + np.array([[0.2, 0.1, 0], [0.1, -0.1, 0], [0, 0, 0]])
    moved = points @ F.T
    plain = strain(points, moved, faces, uv)
    c, s = np.cos(0.7), np.sin(0.7)
    for M in (
        np.array([[c, -s], [s, c]]),
        np.array([[-1.0, 0], [0, 1]]),
        0.3 * np.array([[c, s], [s, -c]]),
    ):
        found = strain(points, moved, faces, uv @ M.T)
        np.testing.assert_allclose(found.r_s, plain.r_s, atol=1e-12)
        same_line(
            found.axis_s * found.uv_per_mm_s[:, None],
            plain.axis_s * plain.uv_per_mm_s[:, None] @ M.T,
            1e-9,
        )
        assert found.uv_turned_share == 0.0


def test_lips_touching_then_parting_do_not_interact():
    points, faces, uv = sheet()
    both = np.concatenate([points, points])
    moved = np.concatenate([points, points * [1.5, 1.0, 1.0] + [0, 0, 3.0]])
    found = strain(
        both, moved, np.concatenate([faces, faces + len(points)]), np.concatenate([uv, uv])
    )
    np.testing.assert_allclose(found.r_s[: len(points)], 1.0, atol=1e-12)
    np.testing.assert_allclose(found.r_s[len(points) :], 1.5, atol=1e-12)


def test_degenerate_triangles_are_undefined_and_spare_neighbors(rng):
    points, faces, uv = sheet()
    n = len(points)
    more = np.concatenate([points, [[3.0, 3.0, 0.0], [50.0, 0, 0], [60.0, 0, 0], [70.0, 0, 0]]])
    more_uv = np.concatenate([uv, [[0.3, 0.3], [0.1, 0.9], [0.2, 0.9], [0.3, 0.8]]])
    bad = [[0, 0, 1], [0, 2, 4], [n + 1, n + 2, n + 3]]  # a point, a line, a line of its own
    moved = more @ np.diag([1.2, 0.9, 1.0])
    found = strain(more, moved, np.concatenate([faces, bad]), more_uv)
    np.testing.assert_allclose(found.r_s[:n], 1.2, atol=1e-12)
    np.testing.assert_allclose(found.r_t[:n], 0.9, atol=1e-12)
    np.testing.assert_array_equal(found.valid, np.arange(n + 4) < n)
    np.testing.assert_array_equal(found.r_s[n:], 1.0)
    assert found.degenerate_share == pytest.approx(3 / (len(faces) + 3))


def test_collapsed_triangles_are_rank_one_or_invalid():
    points, faces, uv = sheet()
    line = strain(points, points * [1.5, 0.0, 0.0], faces, uv)
    np.testing.assert_allclose(line.r_s, 1.5, atol=1e-12)
    np.testing.assert_allclose(line.r_t, 0.0, atol=1e-7)
    same_line(line.axis_s, np.broadcast_to([1.0, 0.0], line.axis_s.shape), 1e-7)
    dot = strain(points, 0.0 * points, faces, uv)
    np.testing.assert_allclose([dot.r_s, dot.r_t], 0.0, atol=1e-7)
    assert dot.valid.all()


def test_flipped_triangles_are_strained_by_their_edges(rng):
    points, faces, uv = sheet()
    moved = points * [-1.2, 0.9, 1.0]  # the sheet seen from behind
    found = strain(points, moved, faces, uv)
    np.testing.assert_allclose(found.r_s, 1.2, atol=1e-12)
    np.testing.assert_allclose(found.r_t, 0.9, atol=1e-12)
    mixed = faces.copy()
    mixed[::3] = mixed[::3, ::-1]  # inconsistent windings
    again = strain(points, moved, mixed, uv)
    np.testing.assert_allclose(again.r_s, 1.2, atol=1e-12)
    same_line(again.axis_s, found.axis_s, 1e-9)


def test_zero_area_and_folded_textures_keep_axes_valid():
    points, faces, uv = sheet()
    moved = points @ np.diag([1.2, 0.9, 1.0])
    folded = uv.copy()
    folded[14] = folded[16]  # one vertex past its neighbours
    found = strain(points, moved, faces, folded)
    assert found.uv_turned_share + found.uv_degenerate_share > 0.0
    np.testing.assert_allclose(found.r_s, 1.2, atol=1e-12)
    far = np.abs(points[:, :2] - points[14, :2]).max(axis=1) > 4.5
    same_line(found.axis_s[far], np.broadcast_to([1.0, 0.0], found.axis_s[far].shape), 1e-9)
    nowhere = strain(points, moved, faces, np.zeros_like(uv))
    assert nowhere.uv_degenerate_share == 1.0
    assert not nowhere.valid.any()
    np.testing.assert_array_equal(nowhere.r_s, 1.0)


def test_three_sheets_on_common_edge_are_area_averaged():
    # not a manifold: fins at right angles, each stretched along the common edge
    points = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, -10, 0], [0, 0, 10.0]])
    uv = np.array([[0.5, 0.5], [0.9, 0.5], [0.5, 0.9], [0.5, 0.1], [0.1, 0.7]])
    faces = [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
    found = strain(points, points * [1.3, 1.0, 1.0], faces, uv)
    np.testing.assert_allclose(found.r_s, 1.3, atol=1e-12)
    np.testing.assert_allclose(found.r_t, 1.0, atol=1e-12)


def test_averages_weight_triangles_by_neutral_area():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-3, 0, 0], [0, -1, 0.0]])
    faces = [[0, 1, 2], [0, 3, 4]]  # areas 1 : 3
    moved = points.copy()
    moved[1, 0], moved[3, 0] = 1.4, -3.0
    found = strain(points, moved, faces, points[:, :2] * 0.1)
    assert found.r_s[0] == pytest.approx((1.4 + 3 * 1.0) / 4)


def test_tiny_strains_keep_their_digits():
    points, faces, uv = sheet()
    found = strain(points, points * [1.0 + 1e-11, 1.0, 1.0], faces, uv)
    np.testing.assert_allclose(found.tensor[:, 0], 1e-11, rtol=1e-3)


def test_meshes_that_do_not_fit_are_refused():
    points, faces, uv = sheet()
    for arguments, word in (
        ((points, points[:-1], faces, uv), "deformed"),
        ((points[:, :2], points, faces, uv), "rest_vertices"),
        ((points, points, faces.astype(float), uv), "faces"),
        ((points, points, faces + 1, uv), "faces: got"),
        ((points, points * np.nan, faces, uv), "got nan"),
        ((points, points, faces, uv[:, :1]), "uv"),
    ):
        with pytest.raises(StrainError, match=word):
            strain(*arguments)
    nothing = strain(np.zeros((3, 3)), np.ones((3, 3)), np.zeros((0, 3), int), np.zeros((3, 2)))
    assert not nothing.valid.any()
    np.testing.assert_array_equal(index_points(np.array([[0.0], [-0.0], [1.0]])), [0, 0, 1])
