import numpy as np
import pytest

from reconstruction.chromophores.pixel_checks import is_detectable

SHAPE = (80, 80)
WHOLE = np.ones(SHAPE, bool)


def test_pixel_detection_is_not_selected_by_noise(rng):
    """An estimate clamped at 0, of a quantity far below its noise, is dropped whole."""
    noisy = np.maximum(rng.normal(0.01, 0.05, SHAPE), 0.0)
    stderr = np.full(SHAPE, 0.05)
    assert not is_detectable(noisy, stderr, WHOLE).any()
    alone = stderr <= 0.5 * noisy  # what a pixel by itself would say
    assert alone.any()
    assert noisy[alone].mean() > 5 * 0.01


def test_detectable_region_keeps_its_low_pixels(rng):
    estimate = rng.normal(0.1, 0.03, SHAPE)
    kept = is_detectable(estimate, np.full(SHAPE, 0.03), WHOLE)
    assert kept.all()


def test_masked_pixels_neither_count_nor_pass():
    estimate = np.full(SHAPE, 0.1)
    stderr = np.full(SHAPE, 0.01)
    stderr[:, :40] = np.nan
    valid = WHOLE.copy()
    valid[:, :45] = False
    kept = is_detectable(estimate, stderr, valid)
    np.testing.assert_array_equal(kept, valid)


@pytest.mark.parametrize("size", [0, 4, -3])
def test_an_even_neighborhood_is_refused(size):
    with pytest.raises(ValueError, match="odd"):
        is_detectable(np.ones(SHAPE), np.ones(SHAPE), WHOLE, size_px=size)
