import math

import numpy as np
import pytest

from model.texture_statistics import pyramid_kernels, steerable_pyramid
from model.texture_statistics.steerable_pyramid import (
    PyramidError,
    Responses,
    analyze,
    level_sizes,
    synthesize,
)

ODD_SIZES = [(1, 1), (1, 7), (2, 2), (8, 5), (4096, 1), (33, 70), (101, 97), (128, 128), (96, 200)]


@pytest.mark.parametrize("shape", ODD_SIZES)
@pytest.mark.parametrize(("dtype", "bound"), [(np.float32, 4e-6), (np.float64, 1e-14)])
def test_image_of_any_size_equals_sum_of_responses(shape, dtype, bound, rng):
    image = rng.standard_normal(shape).astype(dtype)
    before = image.copy()
    found = analyze(image)
    assert len(list(found)) == 30
    again = synthesize(found)
    assert again.dtype == dtype
    assert np.abs(again - image).max() <= bound * np.abs(image).max()
    np.testing.assert_array_equal(image, before)


def test_changed_response_alters_synthesized_image(rng):
    image = rng.standard_normal((40, 30))
    found = analyze(image)
    found.bands[1][2][...] = 0.0
    assert np.abs(synthesize(found) - image).max() > 0.1


@pytest.mark.parametrize(("levels", "orientations"), [(1, 1), (3, 2), (5, 3), (9, 6)])
def test_other_depths_and_orientations_rebuild_too(levels, orientations, rng):
    image = rng.standard_normal((50, 37))
    found = analyze(image, levels=levels, orientations=orientations)
    assert len(list(found)) == levels * orientations + 2
    np.testing.assert_allclose(synthesize(found), image, atol=1e-13)


@pytest.mark.parametrize("level", range(5))
@pytest.mark.parametrize("angle", range(4))
def test_wave_at_band_center_responds_only_in_band(level, angle):
    """Expected: amplitude sqrt(0.8) |cos^3| of the angle between wave and filter, one level."""
    side = 128
    along = side / 2 ** (level + 2)  # cycles an image where the level's filter is 1
    way = [(1, 0), (1, 1), (0, 1), (-1, 1)][angle]
    fx, fy = (along * np.array(way) / (math.sqrt(2) if angle % 2 else 1.0)).round()
    y, x = np.mgrid[0:side, 0:side]
    found = analyze(np.cos(2 * np.pi * (fx * x + fy * y) / side))
    energy = np.array([(band**2).mean(axis=(1, 2)) for band in found.bands])
    radius = np.log2(2 * math.hypot(fx, fy) / side)
    own = math.sin(0.5 * math.pi * min(max(radius + level + 2, 0), 1))
    own *= math.cos(0.5 * math.pi * min(max(radius + level + 1, 0), 1))
    turned = np.cos(np.arctan2(fy, fx) - np.pi * np.arange(4) / 4)
    np.testing.assert_allclose(energy[level], 0.5 * own**2 * 0.8 * turned**6, atol=1e-12)
    assert energy[level].argmax() == angle
    if not angle % 2:
        assert np.delete(energy, level, axis=0).max() < 1e-20


def test_low_pass_keeps_image_unit():
    found = analyze(np.full((64, 48), 0.4))
    np.testing.assert_allclose(found.low, 0.4, atol=1e-15)
    assert max(np.abs(band).max() for band in found.bands) < 1e-15


def test_energy_is_that_of_the_image(rng):
    """The filters' squares sum to 1: mean squares add up, where the grid holds the whole band."""
    image = rng.standard_normal((64, 64))
    assert sum((r**2).mean() for r in analyze(image)) == pytest.approx((image**2).mean())


def test_levels_below_image_lowest_frequency_are_exactly_zero(rng):
    found = analyze(rng.standard_normal((8, 5)))
    assert [np.abs(band).max() > 0 for band in found.bands] == [True] * 3 + [False] * 4
    assert level_sizes((8, 5))[-1] == (1, 1)


def test_shift_by_last_level_sample_shifts_all_responses(rng):
    image = rng.standard_normal((128, 256))
    found, shifted = analyze(image), analyze(np.roll(image, (64, 128), (0, 1)))
    for level, (a, b) in enumerate(zip(found.bands, shifted.bands, strict=True)):
        moved = np.roll(a, (64 // 2**level, 128 // 2**level), (1, 2))
        np.testing.assert_allclose(b, moved, atol=1e-13)


def test_kernels_match_array_operations(rng):
    """The adjoint pair, and both against the same sums in plain NumPy."""
    filters = steerable_pyramid._filters((21, 18), 2, 4, "<f8")
    level = filters.levels[1]
    half = rng.standard_normal((21, 10)) + 1j * rng.standard_normal((21, 10))
    out = np.empty((4, *level.weight.shape), complex)
    common = (level.rows, level.weight, level.fy, level.fx, filters.toward, filters.factor)
    pyramid_kernels.split(half, *common, out, 0, len(level.rows))
    along = level.fx * filters.toward[:, 0, None, None] + (
        level.fy[:, None] * filters.toward[:, 1, None, None]
    )
    gain = filters.factor * along**3 * level.weight
    np.testing.assert_allclose(out, gain * half[level.rows, : level.columns], atol=1e-13)
    back = np.zeros_like(half)
    pyramid_kernels.merge(out, *common, back, 0, len(level.rows))
    expected = np.zeros_like(half)
    expected[level.rows, : level.columns] = (gain * out).sum(axis=0)
    np.testing.assert_allclose(back, expected, atol=1e-13)


def test_any_thread_count_gives_same_numbers(rng):
    image = rng.standard_normal((300, 40)).astype(np.float32)
    for one, two in zip(analyze(image, workers=1), analyze(image, workers=3), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("image", "wrong"),
    [
        (np.zeros((0, 4)), "shape"),
        (np.zeros(4), "shape"),
        ([[np.nan, 1.0]], "finite"),
        ([[np.inf, -np.inf]], "finite"),
    ],
)
def test_invalid_pyramid_image_is_refused(image, wrong):
    with pytest.raises(PyramidError, match=wrong):
        analyze(image)


def test_wrong_counts_and_sizes_are_named(rng):
    with pytest.raises(PyramidError, match="levels"):
        analyze(np.zeros((4, 4)), levels=0)
    with pytest.raises(PyramidError, match="workers"):
        analyze(np.zeros((4, 4)), workers=0)
    found = analyze(rng.standard_normal((16, 16)))
    with pytest.raises(PyramidError, match="sizes"):
        Responses((16, 16), found.high, found.bands, found.high)
