"""Points from which a dome's basis BRDFs are estimated."""

import numpy as np

from reconstruction.pipeline.dome.lobes import BASIS_POINTS, draw_basis_points


def test_basis_points_exclude_closed_holes():
    valid = np.arange(3 * BASIS_POINTS) % 5 > 0
    patch_mm = np.where(np.arange(len(valid)) % 3 == 0, 0.2, 0.0)
    drawn = draw_basis_points(valid, patch_mm)
    assert len(np.unique(drawn)) == BASIS_POINTS
    assert valid[drawn].all()
    assert not patch_mm[drawn].any()
    few = draw_basis_points(valid & (np.arange(len(valid)) < 15), patch_mm)
    np.testing.assert_array_equal(few, [1, 2, 4, 7, 8, 11, 13, 14])
