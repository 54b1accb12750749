"""Errors of heights: larger on steep relief and near holes, and never below the noise."""

import numpy as np
import pytest

from reconstruction.normal_integration import relief_errors

NOISE = np.full((40, 60), 0.1, np.float32)
EVERYWHERE = np.ones(NOISE.shape, bool)


def waves(amplitude_um):
    return amplitude_um * np.sin(np.arange(60) * 0.5) * np.ones((40, 1))


def test_height_error_grows_with_variance_of_slopes():
    found = [
        relief_errors.height_stderr(waves(a), NOISE, EVERYWHERE, pixel_um=6.0)[0, 0] - 0.1
        for a in (0.0, 5.0, 10.0)
    ]
    flat = np.hypot(0.1, relief_errors.HEIGHT_ERROR_UM) - 0.1
    assert found[0] == pytest.approx(flat, rel=1e-5)
    assert 2.0 < (found[2] - found[0]) / (found[1] - found[0]) < 4.5


def test_height_error_falls_with_distance_from_hole():
    valid = EVERYWHERE.copy()
    valid[20, 10] = False
    relief = waves(10.0)
    whole = relief_errors.height_stderr(relief, NOISE, EVERYWHERE, pixel_um=6.0)
    found = relief_errors.height_stderr(relief, NOISE, valid, pixel_um=6.0)
    excess = np.sqrt(found.astype(float) ** 2 - 0.01) - np.sqrt(whole.astype(float) ** 2 - 0.01)
    expected = relief_errors.HOLE_HEIGHT_ERROR * relief[valid].std()
    expected *= np.exp(-6.0 * np.arange(1, 45) / relief_errors.HOLE_REACH_UM)
    np.testing.assert_allclose(excess[20, 11:55], expected, atol=0.01)
    assert found[20, 10] == NOISE[20, 10]
