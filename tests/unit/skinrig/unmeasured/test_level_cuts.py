"""Triangles that are cut along a level keep their area, orientation and vertices."""

from __future__ import annotations

import numpy as np
import pytest

from skinrig.unmeasured.level_cuts import cut_at_zero


def _sheet(n=12):
    y, x = np.mgrid[:n, :n].astype(np.float64)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    return np.stack([x, y], axis=-1).reshape(-1, 2), faces


def _area(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    (x1, y1), (x2, y2) = (b - a).T, (c - a).T
    return 0.5 * (x1 * y2 - y1 * x2)


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 1.1, 2.4])
def test_cut_halves_have_areas_of_sheet(turn_rad):
    points, faces = _sheet()
    level = (points - 5.37) @ (np.cos(turn_rad), np.sin(turn_rad))
    found = cut_at_zero(faces, level, np.arange(len(points)))
    whole = found.extend(points)
    high, low = _area(whole, found.above), _area(whole, found.below)
    assert min(high.min(), low.min()) >= 0.0
    np.testing.assert_allclose(high.sum() + low.sum(), 121.0)
    np.testing.assert_allclose(found.extend(level)[len(points) :], 0.0, atol=1e-12)
    np.testing.assert_array_equal(whole[: len(points)], points)
    assert found.extend(level)[found.above].min() > -1e-12
    assert found.extend(level)[found.below].max() < 1e-12


def test_new_vertices_of_seams_coincide_bitwise():
    """Two charts with own vertices along x = 0, in opposite order."""
    points = np.array([[0.0, 0.1], [0, 1.3], [1, 0.5], [0, 1.3], [0, 0.1], [-1, 0.4]])
    faces = np.array([[0, 2, 1], [3, 5, 4]])
    place = np.array([0, 1, 2, 1, 0, 5])
    found = cut_at_zero(faces, points[:, 1] - 0.7, place)
    new = found.extend(points)[6:]
    on_seam = new[new[:, 0] == 0.0]
    assert len(on_seam) == 2
    np.testing.assert_array_equal(on_seam[0], on_seam[1])


def test_triangles_that_are_not_chosen_stay_whole():
    points, faces = _sheet()
    level = points[:, 0] - 5.37
    chosen = points[faces, 1].mean(axis=1) < 4.0
    found = cut_at_zero(faces, level, np.arange(len(points)), chosen=chosen)
    both = {tuple(row) for row in np.concatenate([found.above, found.below]).tolist()}
    assert {tuple(row) for row in faces[~chosen].tolist()} <= both
    assert np.all(found.extend(points)[len(points) :, 1] <= 4.0)
