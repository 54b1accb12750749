"""Closest points of a scan's surface, against dense sampling and planes."""

import numpy as np
from fixtures.flat_sheets import sheet

from reconstruction.scan.closest_points import ScanSurface, closest_barycentric
from reconstruction.scan.repair import TriangleMesh


def test_closest_point_matches_dense_sampling(rng):
    corners, points = rng.standard_normal((40, 3, 3)), 2.0 * rng.standard_normal((40, 3))
    weights = closest_barycentric(points, corners)
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    away = np.linalg.norm(np.einsum("nk,nkc->nc", weights, corners) - points, axis=1)
    dense = rng.dirichlet(np.full(3, 0.5), 20_000) @ corners  # (40, samples, 3)
    sampled = np.linalg.norm(dense - points[:, None], axis=-1).min(axis=1)
    assert (away <= sampled + 1e-12).all()
    np.testing.assert_allclose(away, sampled, atol=0.05)


def test_long_triangles_are_found_away_from_corners(rng):
    surface = ScanSurface(sheet(cells=2))  # edges of 30 mm
    points = np.column_stack([rng.uniform(5.0, 55.0, (200, 2)), rng.uniform(-4.0, 4.0, 200)])
    found = surface.find_closest(points)
    np.testing.assert_allclose(found.distance_mm, np.abs(points[:, 2]), atol=1e-9)
    np.testing.assert_allclose(found.points_mm[:, :2], points[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.abs(found.normals[:, 2]), 1.0, atol=1e-9)


def test_points_beyond_border_are_marked():
    found = ScanSurface(sheet()).find_closest(np.array([[-8.0, 31.0, 1.0], [31.0, 33.0, 2.0]]))
    assert found.on_border.tolist() == [True, False]


def test_small_island_is_omitted():
    main, island = sheet(), sheet(side_mm=6.0, cells=1)
    raised = island.vertices_mm + np.array([0.0, 0.0, 20.0])
    both = TriangleMesh(
        np.concatenate([main.vertices_mm, raised]),
        np.concatenate([main.faces, island.faces + len(main.vertices_mm)]),
    )
    assert ScanSurface(both).find_closest(np.array([[3.0, 3.0, 20.0]])).distance_mm[0] == 20.0
