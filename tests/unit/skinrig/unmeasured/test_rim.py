"""The trimmed rim is smooth, lies on the scan, and moves none of its vertices."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.head_scans import draw_scan

from skinrig.unmeasured import rim

SEEDS = (300, 301, 302)


@pytest.mark.parametrize("seed", SEEDS)
def test_trimmed_rim_of_heads_is_smooth(seed):
    """Length over that of the smoothed curve; trimming set no constant on these seeds."""
    scan, _ = draw_scan(seed)
    points = scan.vertices_mm.astype(np.float64)
    trimmed = rim.trim_rim(points, scan.faces)
    before = rim.measure_raggedness(points[rim.find_rim(points, scan.faces)])
    carried = trimmed.carry(points)
    after = rim.measure_raggedness(carried[trimmed.rim])
    assert before > 1.2
    assert after < 1.1
    np.testing.assert_array_equal(carried[: len(trimmed.vertices)], points[trimmed.vertices])
    assert len(trimmed.vertices) > 0.8 * len(points)


def test_new_rim_lies_on_edges_of_scan():
    scan, _ = draw_scan(SEEDS[0])
    points = scan.vertices_mm.astype(np.float64)
    trimmed = rim.trim_rim(points, scan.faces)
    new = trimmed.carry(points)[len(trimmed.vertices) :]
    ends = points[trimmed.edges]
    way = ends[:, 1] - ends[:, 0]
    assert np.all((trimmed.fraction >= 0.0) & (trimmed.fraction <= 1.0))
    assert np.abs(np.cross(new - ends[:, 0], way)).max() < 1e-9
    sides = np.sort(scan.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    known = set(map(tuple, sides.tolist()))
    assert set(map(tuple, np.sort(trimmed.edges, axis=1).tolist())) <= known


def test_raggedness_of_teeth_is_their_length():
    """Square teeth of 3 mm on a ring of 80 mm: 200 vertical sides add 600 mm to 503 mm."""
    angle = np.repeat(np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False), 2)
    radius = np.tile([80.0, 83.0, 83.0, 80.0], 100)
    loop = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle], axis=-1)
    found = rim.measure_raggedness(loop)
    middle = 2.0 * np.pi * 81.5
    assert found == pytest.approx((middle + 600.0) / middle, rel=0.02)


def test_closed_surface_and_sliver_are_refused():
    corners = np.array([[0.0, 0, 0], [50, 0, 0], [0, 50, 0], [0, 0, 50]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(rim.RimError, match="closed surface"):
        rim.trim_rim(corners, faces)
    with pytest.raises(rim.RimError, match="nothing inside"):
        rim.trim_rim(corners[:3], faces[:1])
