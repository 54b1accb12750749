"""Gaps of a face's normals are filled from their neighborhood, with errors that contain it."""

import numpy as np
import pytest

from model.skin import SkinMap
from model.vectors import unit_vectors
from reconstruction.surface.texture_fill import push_pull
from skinrig.fusing.filled_normals import BEND_RAD_PER_MM, MAX_GAP_DISTANCE_MM, fill_normals

SIDE = 60
"""Texels of 1 mm along a side."""


def face(gap):
    """Interpolated normals of a waved surface with a gap, its points, and the true normals."""
    at = np.arange(SIDE) - SIDE / 2
    x, y = np.meshgrid(at, at)
    slopes = 0.3 * np.cos(x / 4.0), 0.3 * np.sin(y / 5.0)
    points = np.stack([x, y, 1.2 * np.sin(x / 4.0) - 1.5 * np.cos(y / 5.0)], axis=-1)
    true = unit_vectors(np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=-1))
    filled = unit_vectors(push_pull(true, (~gap).astype(float)).values.astype(float))
    stderr = np.full((SIDE, SIDE, 3), 0.01)
    return SkinMap(filled, "1", stderr, ~gap, "drawn"), SkinMap(points, "mm"), true


def disc(radius_mm):
    at = np.arange(SIDE) - SIDE / 2
    return np.hypot(*np.meshgrid(at, at)) <= radius_mm


def test_fill_normals_of_gap_states_its_error():
    gap = disc(4.5)
    normals, position, true = face(gap)
    found, measured = fill_normals(normals, position)
    assert found.mask.all()
    np.testing.assert_array_equal(measured.values, ~gap)
    off = np.arccos(np.clip((found.values * true).sum(axis=-1), -1, 1))[gap]
    # 68 % of a direction's two errors are within 1.515 standard errors; neighbors' are too small
    held = np.mean(off < 1.515 * found.stderr[gap, 0])
    assert 0.95 > held > 0.68 > np.mean(off < 1.515 * 0.01)
    np.testing.assert_array_equal(found.stderr[~gap], normals.stderr[~gap])


def test_fill_normals_far_from_measured_stay_masked():
    normals, position, _ = face(disc(20.0))
    found, _ = fill_normals(normals, position)
    assert not found.mask[disc(19.0 - MAX_GAP_DISTANCE_MM)].any()
    assert found.mask[~disc(10.0)].all()


def test_filled_normal_error_grows_with_distance():
    gap = disc(8.0)
    normals, position, _ = face(gap)
    found, _ = fill_normals(normals, position)
    at = np.hypot(*np.meshgrid(*[np.arange(SIDE) - SIDE / 2] * 2))
    deep, rim = (found.stderr[..., 0][gap & ring] for ring in (at < 2.0, at > 6.0))
    assert np.median(deep) > 1.2 * np.median(rim)
    assert (found.stderr[gap][:, 0] >= BEND_RAD_PER_MM * (8.0 - at[gap]) * 0.9).all()


def test_fill_normals_without_near_neighbors_changes_nothing():
    normals, position, _ = face(disc(3.0))
    far = SkinMap(MAX_GAP_DISTANCE_MM * 1.5 * position.values, "mm")
    assert fill_normals(normals, far) == (normals, None)


@pytest.mark.parametrize("known", [True, False])
def test_fill_normals_without_gap_or_neighbors_changes_nothing(known):
    normals, position, _ = face(disc(3.0))
    given = SkinMap(normals.values, "1", normals.stderr, np.full((SIDE, SIDE), known))
    assert fill_normals(given, position) == (given, None)
