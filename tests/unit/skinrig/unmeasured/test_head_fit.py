"""A fitted head: its size, and its file with any byte changed."""

from __future__ import annotations

import numpy as np
import pytest

from skinrig.unmeasured.head_fit import FIT_GRID, FittedHead, HeadFitError, mean_head


def _turned_head(scale):
    """The mean head, scaled, turned by 0.2 rad about y, and shifted."""
    c, s = np.cos(0.2), np.sin(0.2)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    points = scale * mean_head(FIT_GRID).vertices_mm.astype(np.float64) @ turn.T + (3.0, 25.0, -9.0)
    shape = points.reshape(*FIT_GRID, 3)
    return FittedHead(shape, np.ones(FIT_GRID), np.ones(FIT_GRID, bool)), turn


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.3])
def test_similarity_of_head_is_found(scale):
    fitted, turn = _turned_head(scale)
    rotation, shift, found = fitted.locate_head()
    assert found == pytest.approx(scale, rel=1e-6)
    np.testing.assert_allclose(rotation, turn, atol=1e-6)
    np.testing.assert_allclose(shift, [3.0, 25.0, -9.0], atol=1e-3)


def test_measured_part_around_eyes_is_counted():
    fitted, _ = _turned_head(1.0)
    high = mean_head(FIT_GRID).vertices_mm[:, 1].reshape(FIT_GRID) > 5.0
    half = FittedHead(fitted.vertices_mm, fitted.stderr_mm, ~high)
    assert fitted.measured_near_eye(1.0) == pytest.approx(1.0)
    assert half.measured_near_eye(-1.0) < 0.2


def test_damaged_file_is_refused_or_read():
    """Any changed byte, and any end: no other exception."""
    data = _turned_head(1.0)[0].to_bytes()
    refused = 0
    for at in [*range(0, 200), *range(200, len(data), 97), *range(len(data) - 300, len(data))]:
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 0x5A]) + data[at + 1 :]):
            try:
                FittedHead.from_bytes(damaged, "x.npz")
            except HeadFitError:
                refused += 1
    assert refused > 500
