"""Smooth curves through noisy fibers, against splines and kriging written anew."""

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from reconstruction.subsurface import smooth_misfit as module
from reconstruction.subsurface.smooth_misfit import (
    BEND_STRENGTHS,
    PRIOR_LOG_SIGMA,
    PRIOR_STRENGTH,
    smooth_misfit,
)

RADIUS = 0.3 + 0.25 * np.arange(28)
PLACE = np.sqrt(RADIUS)
CURVE = 0.1 * np.sin(3.0 * PLACE)


def kriged(value, variance, strength):
    """Return log posterior, curve and covariance by the integrated Wiener process's kernel."""
    x = PLACE - PLACE[0]
    low, high = np.minimum(x[:, None], x), np.maximum(x[:, None], x)
    kernel = strength * low**2 * (3.0 * high - low) / 6.0
    lines = np.stack([np.ones_like(x), x], axis=1)
    inverse = np.linalg.inv(kernel + np.diag(variance))
    firm = lines.T @ inverse @ lines
    beta = np.linalg.solve(firm, lines.T @ inverse @ value)
    rest = value - lines @ beta
    likely = -0.5 * (
        np.linalg.slogdet(kernel + np.diag(variance))[1]
        + np.linalg.slogdet(firm)[1]
        + rest @ inverse @ rest
        + (np.log(strength / PRIOR_STRENGTH) / PRIOR_LOG_SIGMA) ** 2
    )
    left = lines - kernel @ inverse @ lines
    covariance = kernel - kernel @ inverse @ kernel + left @ np.linalg.solve(firm, left.T)
    return likely, lines @ beta + kernel @ inverse @ rest, covariance


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.3])
def test_curve_and_errors_match_kriging_at_likeliest_strength(noise):
    rng = np.random.default_rng(2)
    spread = noise * np.exp(0.2 * RADIUS)
    value = CURVE + spread * rng.standard_normal(28)
    each = [kriged(value, spread**2, strength) for strength in BEND_STRENGTHS]
    best = int(np.argmax([one[0] for one in each]))
    curve, covariance = smooth_misfit(RADIUS, value[None], (spread**2)[None])
    np.testing.assert_allclose(curve[0], each[best][1], atol=1e-4 * noise)
    np.testing.assert_allclose(covariance[0], each[best][2], atol=1e-3 * noise**2)
    spline = make_smoothing_spline(PLACE, value, w=spread**-2.0, lam=1.0 / BEND_STRENGTHS[best])
    np.testing.assert_allclose(curve[0], spline(PLACE), atol=1e-4 * noise)


@pytest.mark.parametrize("unread", [0.0, 0.3, 0.9])
def test_strength_likelihoods_match_full_matrix(unread):
    """Five diagonals against determinant and solution of the full matrix, up to a constant.

    Readings of next to no weight have a hundredth here, not `WEAKEST`: the full matrix would lose
    ten digits to it. Tolerance: rounding of the full matrix, conditions to 1e9.
    """
    rng = np.random.default_rng(5)
    bend, mass = module._bends(PLACE)
    value = CURVE + 0.03 * rng.standard_normal((6, 28))
    gone = rng.random((6, 28)) < unread
    weight = np.where(gone, 0.01, 0.03**-2.0 * np.exp(-0.4 * RADIUS))
    value = np.where(gone, 0.0, value)
    whole = bend @ np.linalg.solve(mass, bend.T) / BEND_STRENGTHS[:, None, None]
    whole = whole + (weight[:, None, :, None] * np.eye(28))
    told = (weight * value)[:, None]
    curve = np.linalg.solve(whole, np.broadcast_to(told, whole.shape[:-1])[..., None])[..., 0]
    square = (told * curve).sum(axis=-1)
    expected = square - np.linalg.slogdet(whole)[1]
    expected -= (
        26 * np.log(BEND_STRENGTHS)
        + (np.log(BEND_STRENGTHS / PRIOR_STRENGTH) / PRIOR_LOG_SIGMA) ** 2
    )
    found = module.log_posterior(bend, mass, value, weight)
    assert np.ptp(found, axis=1).min() > 3.0  # some are unlikely
    np.testing.assert_allclose(
        found - found[:, :1], expected - expected[:, :1], atol=1e-5, rtol=1e-7
    )


def test_unread_fibers_extrapolate_straight_with_growing_errors():
    value = np.broadcast_to(CURVE, (3, 28))
    variance = np.full((3, 28), 0.002**2)
    variance[1, 20:] = np.inf
    variance[2] = np.inf
    curve, covariance = smooth_misfit(RADIUS, value, variance)
    error = np.sqrt(np.einsum("nff->nf", covariance))
    assert np.isfinite(curve).all()
    assert (np.diff(error[1, 19:]) > 0).all()
    bend = np.diff(curve[1, 19:]) / np.diff(PLACE[19:])
    np.testing.assert_allclose(bend[1:], bend[1], rtol=1e-3)
    assert np.abs(curve[1] - CURVE)[20:].max() < 3.0 * error[1, 27]
    assert (error[2] > 100.0).all()  # nothing is told


def test_errors_are_those_of_joint_fiber_noise():
    """Intervals of splines hold on the average of all places (Wahba 1983); 400 draws."""
    rng = np.random.default_rng(3)
    noise = 0.02
    value = CURVE + noise * rng.standard_normal((400, 28))
    curve, covariance = smooth_misfit(RADIUS, value, np.full((400, 28), noise**2))
    error = np.sqrt(np.einsum("nff->nf", covariance))
    held = np.abs(curve - CURVE) < error
    assert 0.60 < held.mean() < 0.76
    assert np.median(error) < 0.6 * noise


def test_fiber_order_does_not_matter():
    rng = np.random.default_rng(4)
    value, variance = CURVE[None] + 0.01 * rng.standard_normal((1, 28)), np.full((1, 28), 1e-4)
    mixed = rng.permutation(28)
    curve, covariance = smooth_misfit(RADIUS, value, variance)
    again, other = smooth_misfit(RADIUS[mixed], value[:, mixed], variance)
    np.testing.assert_allclose(again[0], curve[0, mixed], atol=1e-9)
    np.testing.assert_allclose(other[0], covariance[0][np.ix_(mixed, mixed)], atol=1e-9)
