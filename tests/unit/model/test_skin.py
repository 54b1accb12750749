"""Maps of skin."""

import numpy as np

from model.skin import SkinMap


def test_mask_without_valid_is_all_true():
    skin_map = SkinMap(np.zeros((2, 3, 3)), "1")
    assert skin_map.mask.shape == (2, 3)
    assert skin_map.mask.all()


def test_mask_with_valid_is_that():
    valid = np.array([[True, False]])
    np.testing.assert_array_equal(SkinMap(np.zeros((1, 2)), "1", valid=valid).mask, valid)
