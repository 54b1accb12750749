"""Differences of normals: exact at a weight of 1, bent between, and what they hold."""

import numpy as np
import pytest

from model import metrics, wrinkles
from model.wrinkles import differences as wrinkle_differences
from model.wrinkles.expressions import WrinkleError

ONE = np.ones((1, 1, 1))


def slopes(rng, steepest, shape=(8, 8)):
    return rng.uniform(-steepest, steepest, (*shape, 2))


def test_unit_weight_gives_wrinkled_normals_zero_gives_base(rng):
    base, wrinkle = slopes(rng, 0.3), slopes(rng, 0.3)
    b, w = wrinkles.decode(base), wrinkles.decode(base + wrinkle)
    difference = wrinkle_differences.difference_map(b, w)
    assert difference.clamped_fraction == 0.0
    got = wrinkle_differences.combine(b, difference, ONE, np.ones(1))
    np.testing.assert_allclose(got, w, atol=1e-15)
    np.testing.assert_allclose(
        wrinkle_differences.combine(b, difference, ONE, np.zeros(1)), b, atol=1e-15
    )


def test_intermediate_weight_errs_to_second_order_derivatives_exact(rng):
    base, wrinkle = slopes(rng, 0.2, (64, 64)), slopes(rng, 0.2, (64, 64))
    errors = []
    for scale in (1.0, 0.5):
        b = wrinkles.decode(scale * base)
        w = wrinkles.decode(scale * (base + wrinkle))
        half = wrinkles.decode(scale * (base + 0.5 * wrinkle))
        d = wrinkle_differences.difference_map(b, w)
        got = wrinkle_differences.combine(b, d, ONE, np.full(1, 0.5))
        errors.append(metrics.angular_error_rad(got, half).mean())
        exact = wrinkles.combine(scale * base, scale * wrinkle, ONE, np.full(1, 0.5))
        np.testing.assert_allclose(exact, half, atol=1e-15)
    assert errors[0] > 1e-4
    assert errors[0] / errors[1] == pytest.approx(8.0, rel=0.15)  # slope times squared slope


def test_sum_without_renormalization_is_not_unit_vector(rng):
    b, w = wrinkles.decode(slopes(rng, 0.5)), wrinkles.decode(slopes(rng, 0.5))
    d = wrinkle_differences.difference_map(b, w)
    raw = wrinkle_differences.combine(b, d, ONE, np.full(1, 0.5), renormalize=False)
    np.testing.assert_allclose(raw, 0.5 * (b + w), atol=1e-15)
    lengths = np.linalg.norm(raw, axis=2)
    assert lengths.min() < 0.99
    unit = wrinkle_differences.combine(b, d, ONE, np.full(1, 0.5))
    np.testing.assert_allclose(unit, raw / lengths[..., None], atol=1e-15)


def test_differences_keep_slopes_beyond_45_degrees_unlike_derivatives():
    b = np.array([[[0.0, 0.0, 1.0]]])
    w = np.array([[[np.sin(1.0), 0.0, np.cos(1.0)]]])  # 57 degrees
    d = wrinkle_differences.difference_map(b, w)
    assert d.clamped_fraction == 0.0
    np.testing.assert_allclose(wrinkle_differences.combine(b, d, ONE, np.ones(1)), w, atol=1e-15)
    clamped = wrinkles.combine(np.zeros((1, 1, 2)), wrinkles.encode(w), ONE, np.ones(1))
    assert metrics.angular_error_rad(clamped, w)[0, 0] == pytest.approx(1.0 - np.pi / 4)


def test_opposite_slopes_beyond_30_degrees_are_clamped_counted():
    a = np.radians([29.0, 31.0])
    b = np.stack([-np.sin(a), 0 * a, np.cos(a)], axis=-1)[None]
    w = b * [-1, 1, 1]
    d = wrinkle_differences.difference_map(b, w)
    assert d.clamped_fraction == 0.5
    assert d.values.max() == 1.0


def test_missing_normals_add_nothing_base_holes_are_zero(rng):
    b = wrinkles.decode(slopes(rng, 0.5, (4, 4)))
    w = b.copy()
    w[0, 0] = np.nan
    w[0, 1] = 0.0
    d = wrinkle_differences.difference_map(b, w)
    np.testing.assert_array_equal(~d.valid, np.isnan(w[..., 0]) | (w == 0).all(axis=2))
    b[3, 3] = np.nan
    got = wrinkle_differences.combine(b, d, ONE, np.ones(1))
    assert not got[3, 3].any()
    assert np.isfinite(got).all()


def test_maps_that_do_not_fit_are_refused():
    n = np.zeros((4, 4, 3))
    with pytest.raises(WrinkleError, match="wrinkled: got shape"):
        wrinkle_differences.difference_map(n, n[:2])
    with pytest.raises(WrinkleError, match=r"expected \(H, W, 3\)"):
        wrinkle_differences.difference_map(n[..., :2], n[..., :2])
    with pytest.raises(WrinkleError, match="difference: got"):
        wrinkle_differences.combine(n, n * np.nan, ONE, np.ones(1))
