"""Fits of radial profiles: exact on their own model, with honest errors, clear at extremes."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from model import dipole
from reconstruction import subsurface
from reconstruction.subsurface import Outcome, SubsurfaceError
from reconstruction.subsurface_models import profile_model

RADIUS = 0.3 + 0.25 * np.arange(28)


def closed(method, eta=1.4):
    return profile_model(
        method, RADIUS, eta=eta, collection="all", core_mm=0.0, source_core_mm=0.0, g=0.8,
        g_error=0.0,
    )  # fmt: skip


@pytest.mark.parametrize("eta", [1.0, 1.4, 1.6])
def test_the_kernels_dipole_is_the_models(eta):
    theta = np.log([[0.04, 1.5, 1.0], [0.6, 3.0, 1.0], [5.0, 0.5, 1.0], [1e-6, 20.0, 1.0]])
    profiles, _ = closed("dipole", eta).profiles(np.pad(theta, ((0, 0), (0, 1))))
    expected = dipole.reflectance(RADIUS, *np.exp(theta[:, :2]).T[..., None], eta)
    np.testing.assert_allclose(profiles, expected, rtol=1e-11)


@pytest.mark.parametrize("method", ["dipole", "diffusion"])
def test_slopes_are_those_of_the_profile(method):
    model, step = closed(method), 1e-4
    for a, s in [(0.04, 1.5), (0.6, 3.0), (2.0, 0.5), (1e-4, 10.0)]:
        theta = np.array([[np.log(a), np.log(s), 0.1, 0.8]])
        _, slopes = model.profiles(theta)
        for p in range(3):
            ahead, behind = theta.copy(), theta.copy()
            ahead[0, p] += step
            behind[0, p] -= step
            numeric = (model.profiles(ahead)[0] - model.profiles(behind)[0]) / (2.0 * step)
            np.testing.assert_allclose(
                slopes[0, p], numeric[0], rtol=1e-5, atol=1e-7 * abs(numeric).max()
            )


@pytest.mark.parametrize("given", [False, True])
def test_a_dipoles_own_profiles_come_back(given):
    a, s = np.meshgrid([0.005, 0.04, 0.25, 1.0], [0.5, 1.5, 6.0])
    profiles = dipole.reflectance(RADIUS, a[..., None], s[..., None], 1.4)
    variance = (0.01 * profiles) ** 2 + 1e-18 if given else None
    fit = subsurface.fit_dipole(RADIUS, profiles, variance=variance)
    np.testing.assert_allclose(fit.sigma_a_per_mm, a, rtol=1e-6)
    np.testing.assert_allclose(fit.sigma_s_prime_per_mm, s, rtol=1e-6)
    np.testing.assert_allclose(fit.predicted_per_mm2, profiles, rtol=1e-6)


def test_the_optimum_is_scipys(rng):
    a, s = 0.12, 1.8
    clean = dipole.reflectance(RADIUS, a, s, 1.4)
    variance = (0.03 * clean) ** 2 + 1e-12
    noisy = clean + rng.standard_normal(28) * np.sqrt(variance)

    def residual(log_pair):
        return (dipole.reflectance(RADIUS, *np.exp(log_pair), 1.4) - noisy) / np.sqrt(variance)

    peer = least_squares(residual, np.log([0.1, 1.0]), method="lm", xtol=1e-14, ftol=1e-14)
    fit = subsurface.fit_dipole(RADIUS, noisy, variance=variance, model_error=0.0)
    found = np.log([fit.sigma_a_per_mm, fit.sigma_s_prime_per_mm])
    np.testing.assert_allclose(found, peer.x, atol=1e-7)
    assert fit.chi2 == pytest.approx(2.0 * peer.cost, rel=1e-9)
    pair = np.exp(peer.x)
    expected = np.linalg.inv(peer.jac.T @ peer.jac) * pair[:, None] * pair
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-3)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(SubsurfaceError, match="radius_mm: got shape"):
        subsurface.fit_dipole(RADIUS[:-1], np.ones(28))
    with pytest.raises(SubsurfaceError, match="variance: got shape"):
        subsurface.fit_dipole(RADIUS, np.ones((2, 28)), variance=np.ones(3))


def test_nothing_but_zeros_has_no_signal():
    fit = subsurface.fit_dipole(RADIUS, np.zeros(28), variance=np.ones(28))
    assert fit.outcome == Outcome.NO_SIGNAL
    assert not fit.valid
    assert np.isnan(fit.sigma_tr_per_mm)
    assert "stand out" in fit.reason()
