import numpy as np
import pytest

from reconstruction.normal_histogram.relief_slopes import (
    HistogramError,
    slope_stencil,
    slopes,
    slopes_from_normals,
)


def test_wide_pixel_halves_slope_along_rows():
    height = np.tile(0.4 * np.arange(9.0), (9, 1))
    wide, _, _ = slopes(height, pixel=(1.0, 2.0))
    np.testing.assert_allclose(wide, 0.2, atol=1e-12)


def test_slopes_match_numpy_gradient_single_sided_near_holes(rng):
    height = rng.standard_normal((9, 12))
    a, b, known = slopes(height, pixel=(2.0, 3.0))
    assert known.all()
    rows, columns = np.gradient(height, 2.0, 3.0)
    np.testing.assert_allclose(a, columns, atol=1e-12)
    np.testing.assert_allclose(b, -rows, atol=1e-12)  # y up: rows run down
    height[4, 6] = np.nan
    a, _, known = slopes(height, pixel=(2.0, 3.0))
    assert np.argwhere(~known).tolist() == [[4, 6]]
    assert a[4, 5] == pytest.approx((height[4, 5] - height[4, 4]) / 3.0)
    assert a[4, 7] == pytest.approx((height[4, 8] - height[4, 7]) / 3.0)


def test_a_list_of_rows_is_a_map():
    rows = [[0.0, 1.0, 2.0], [0.5, 1.5, 4.0]]
    for ours, theirs in zip(
        slopes(rows, pixel=1.0), slopes(np.array(rows), pixel=1.0), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    whole = [[0, 1, 2], [0, 1, 2]]
    assert slopes(whole, pixel=1)[0].tolist() == [[1.0] * 3] * 2


@pytest.mark.parametrize(
    ("height", "told"),
    [
        (np.zeros((2, 4, 4)), r"float64 of shape \(2, 4, 4\), .*one by one"),
        ([0.0, 1.0], r"shape \(2,\)"),
        (1.0, r"shape \(\)"),
        ([[0.0, 1.0], [0.0]], "no array"),
        (np.zeros((4, 4), complex), "complex128"),
        ([["a", "b"], ["c", "d"]], "<U1"),
        (None, "object"),
    ],
)
def test_non_real_map_is_refused(height, told):
    with pytest.raises(HistogramError, match=f"height: got {told}" if told[0] != "s" else told):
        slope_stencil(height)


@pytest.mark.parametrize("valid", [np.ones((4, 4)), np.ones((4, 1), bool), True, [[1, 0]]])
def test_masks_of_another_shape_or_type_are_refused(valid):
    with pytest.raises(HistogramError, match="valid: got"):
        slope_stencil(np.zeros((4, 4)), valid)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (4, 4, 3))
    with pytest.raises(HistogramError, match="valid: got"):
        slopes_from_normals(normals, valid=valid)


def test_back_facing_or_nonfinite_normals_have_no_slope():
    normals = np.array([[0.3, -0.4, 1.0], [0.3, -0.4, 0.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 1.0]])
    kept = normals.copy()
    a, b, known = slopes_from_normals(2.0 * normals)
    assert known.tolist() == [True, False, False, False]
    np.testing.assert_allclose(a, [-0.3, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(b, [0.4, 0, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(normals, kept)
    with pytest.raises(HistogramError, match="normals: got shape"):
        slopes_from_normals(np.zeros((3, 4)))
