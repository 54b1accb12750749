"""Fits of radial profiles: exact on their own model, with honest errors, clear at extremes."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from model import dipole, photon_table
from model.dipole import kienle_patterson as diffusion
from reconstruction import subsurface
from reconstruction.subsurface.inversion import SubsurfaceError
from reconstruction.subsurface.models import (
    DIFFUSE_RATIO_RANGE,
    MIN_DIFFUSE_DISTANCE,
    FiberOptics,
    profile_model,
)
from reconstruction.subsurface.outcome import FitOutcome

RADIUS = 0.3 + 0.25 * np.arange(28)


def closed(method, eta=1.4):
    return profile_model(method, FiberOptics(eta, g=0.8, g_error=0.0), RADIUS)


@pytest.mark.parametrize("eta", [1.0, 1.4, 1.6])
def test_the_kernels_dipole_is_the_models(eta):
    theta = np.log([[0.04, 1.5, 1.0], [0.6, 3.0, 1.0], [5.0, 0.5, 1.0], [1e-6, 20.0, 1.0]])
    profiles, _ = closed("dipole", eta).profiles(np.pad(theta, ((0, 0), (0, 1))))
    expected = dipole.reflectance(RADIUS, *np.exp(theta[:, :2]).T[..., None], eta)
    np.testing.assert_allclose(profiles, expected, rtol=1e-11)


@pytest.mark.parametrize("eta", [1.0, 1.4, 1.6])
def test_the_kernels_diffusion_is_the_models(eta):
    theta = np.log([[0.04, 1.5, 1.0], [0.6, 3.0, 1.0], [5.0, 0.5, 1.0], [1e-6, 20.0, 1.0]])
    profiles, _ = closed("diffusion", eta).profiles(np.pad(theta, ((0, 0), (0, 1))))
    expected = diffusion.reflectance(RADIUS, *np.exp(theta[:, :2]).T[..., None], eta)
    np.testing.assert_allclose(profiles, expected, rtol=1e-9)


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
    assert fit.outcome == FitOutcome.NO_SIGNAL
    assert not fit.valid
    assert np.isnan(fit.sigma_tr_per_mm)
    assert "above their noise" in fit.reason()


FIBERS = {"collection": "fiber", "core_mm": 0.2, "source_core_mm": 0.2}


def table(a, s, **settings):
    """A profile in fibers of the photon table: consistent with the fit, so for errors only."""
    return photon_table.reflectance(RADIUS, a, s, **({"g": 0.8} | FIBERS | settings))


def noisy(clean, rng, shape=()):
    """Readings with 1.2 % from fiber to fiber and noise in the dark, and their variance."""
    variance = (0.012 * clean) ** 2 + 1e-7**2
    return clean + np.sqrt(variance) * rng.standard_normal((*shape, *np.shape(clean))), variance


def fit_table(profile, variance, **settings):
    return subsurface.invert(RADIUS, profile, variance=variance, **(FIBERS | settings))


@pytest.mark.parametrize(("g_error", "limit"), [(0.0, 5e-3), (0.07, 1.5e-2)])
def test_the_tables_layout_is_the_table(g_error, limit):
    """Within the table's domain, but for diffused light; between its g its noise is larger."""
    model = profile_model("photon_table", FiberOptics(g=0.825, g_error=g_error, **FIBERS), RADIUS)
    rng = np.random.default_rng(5)
    theta = np.full((100, 4), [0.0, 0.0, 0.0, 0.825])
    theta[:, 1] = rng.uniform(np.log(0.1), np.log(7.0), 100)
    theta[:, 0] = theta[:, 1] + rng.uniform(np.log(1e-4), np.log(9.0), 100)
    if g_error > 0.0:
        theta[:, 3] = rng.uniform(0.7, 0.94, 100)
    found, slopes = model.profiles(theta)
    expected = np.stack([table(*np.exp(each[:2]), g=float(each[3])) for each in theta])
    seen = expected > 1e-9
    weak = np.exp(theta[:, 0] - theta[:, 1]) < DIFFUSE_RATIO_RANGE[1]
    seen &= ~(weak[:, None] & (np.exp(theta[:, 1:2]) * RADIUS > MIN_DIFFUSE_DISTANCE))
    assert np.abs(np.log(found / expected))[seen].max() < limit
    for p in range(4 if g_error > 0.0 else 3):
        step = np.zeros(4)
        step[p] = 1e-4
        ahead, behind = model.profiles(theta + step)[0], model.profiles(theta - step)[0]
        numeric = np.log(ahead / behind)[seen] / 2e-4
        np.testing.assert_allclose((slopes[:, p] / found)[seen], numeric, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("ratio", [1e-4, 3e-4, 2e-3])
def test_far_weakly_absorbed_light_is_diffusion_to_factor(ratio):
    """At up to 350 transport lengths, where no table reaches; the factor is the fiber's, 5 %."""
    model = profile_model("photon_table", FiberOptics(g=0.8, g_error=0.0, **FIBERS), RADIUS)
    for scattering in (8.0, 20.0, 50.0):
        theta = np.array([[np.log(ratio * scattering), np.log(scattering), 0.0, 0.8]])
        exact = diffusion.reflectance(RADIUS, ratio * scattering, scattering, 1.4)
        # where averaging over cores does next to nothing
        far = (scattering * RADIUS > 1.05 * MIN_DIFFUSE_DISTANCE) & (RADIUS > 2.0)
        factor = np.log(model.profiles(theta)[0][0] / exact)[far]
        assert np.ptp(factor) < 0.02
        assert abs(factor.mean()) < 0.12


def test_starts_lead_to_the_least_misfit_of_all(rng):
    """The best of 80 starts on a grid is nowhere better than what the fit found."""
    model = closed("dipole")
    k, s = np.exp(rng.uniform(np.log([0.2, 0.5]), np.log([3.0, 6.0]), (12, 2))).T
    a = 0.5 * (np.sqrt(s**2 + 4.0 / 3.0 * k**2) - s)
    clean = dipole.reflectance(RADIUS, a[:, None], s[:, None], 1.4)
    profiles, variance = noisy(clean, rng)
    fit = subsurface.fit_dipole(RADIUS, profiles, variance=variance, model_error=0.0)
    for n in range(12):
        deviation = np.sqrt(variance[n])

        def residual(pair, n=n, deviation=deviation):
            value = model.profiles(np.array([[*pair, 0.0, 0.8]]))[0][0]
            return (value - profiles[n]) / deviation

        costs = [
            2.0 * least_squares(residual, np.log([a0, s0]), method="lm").cost
            for a0 in (0.003, 0.03, 0.3, 2.0)
            for s0 in (0.3, 1.0, 4.0, 15.0)
        ]
        assert fit.chi2[n] <= min(costs) * (1.0 + 1e-6)


def draws_of_everything(rng, count=1500):
    """Profiles of media, phase functions and scales drawn from the priors, with noise."""
    profiles, sigma_tr = np.empty((count, 28)), np.empty(count)
    for n in range(count // 10):
        k, s = np.exp(rng.uniform(np.log([0.3, 0.7]), np.log([3.0, 4.0])))
        a = 0.5 * (np.sqrt(s**2 + 4.0 / 3.0 * k**2) - s)
        ten = slice(10 * n, 10 * n + 10)
        profiles[ten] = table(a, s, g=float(rng.uniform(0.7, 0.95)))
        sigma_tr[ten] = k
    scale = np.exp(0.02 * rng.standard_normal((count, 1)))
    readings, variance = noisy(profiles * scale, rng)
    return sigma_tr, readings, variance


def coverage(fit, sigma_tr):
    low, high = fit.interval_per_mm.T
    return np.mean((low <= sigma_tr) & (sigma_tr <= high))


@pytest.mark.long
def test_interval_coverage_matches_nominal(rng):
    """68 % within 60...76 %; a false alarm is rarer than 1e-3 (groups of ten share a medium)."""
    sigma_tr, readings, variance = draws_of_everything(rng)
    fit = fit_table(readings, variance, common_error=0.02)
    assert fit.valid.mean() > 0.99
    assert 0.60 < coverage(fit, sigma_tr) < 0.76
    assert np.mean(fit.p_value < 0.05) < 0.08
    # They would not if the scale and the phase function were taken for known.
    certain = fit_table(readings, variance, common_error=0.0, g=0.8, g_error=0.0)
    assert coverage(certain, sigma_tr) < 0.55


def test_sigma_tr_is_better_determined_than_its_parts(rng):
    profile, variance = noisy(table(0.04, 1.5), rng)
    fit = fit_table(profile, variance, common_error=0.05)
    of_sigma_tr = fit.sigma_tr_stderr / fit.sigma_tr_per_mm
    assert of_sigma_tr < 0.6 * fit.sigma_a_stderr / fit.sigma_a_per_mm
    assert fit.correlation < -0.5
    assert fit.coefficients_identified
    vague = fit_table(profile, variance * 300.0, common_error=0.5)
    assert not vague.coefficients_identified
    assert vague.valid


def test_leading_axes_are_a_loop(rng):
    profiles, variance = noisy(table(0.1, 1.2), rng, (2, 3))
    together = fit_table(profiles, variance, common_error=0.01)
    assert together.sigma_tr_per_mm.shape == (2, 3)
    assert together.covariance.shape == (2, 3, 2, 2)
    assert together.predicted_per_mm2.shape == together.residual.shape == (2, 3, 28)
    for index in np.ndindex(2, 3):
        alone = fit_table(profiles[index], variance, common_error=0.01)
        # a fit ends where chi2 falls by less than 1e-11 of itself: each may stop so far, in
        # standard errors, from the minimum, and rounding decides where
        reach = 2.0 * np.sqrt(1e-11 * alone.chi2) * alone.sigma_tr_stderr
        assert abs(together.sigma_tr_per_mm[index] - alone.sigma_tr_per_mm) <= reach
        assert reach < 1e-6 * alone.sigma_tr_per_mm


def test_profiles_may_have_radii_of_their_own():
    radius = np.stack([RADIUS, RADIUS + 0.1])
    profile = dipole.reflectance(radius, 0.1, 1.5, 1.4)
    fit = subsurface.fit_dipole(radius, profile)
    np.testing.assert_allclose(fit.sigma_a_per_mm, 0.1, rtol=1e-6)


def test_single_precision_and_the_input_are_left_alone():
    profile = dipole.reflectance(RADIUS, 0.1, 1.5, 1.4).astype(np.float32)
    before = profile.copy()
    fit = subsurface.fit_dipole(RADIUS.astype(np.float32), profile)
    assert fit.sigma_tr_per_mm.dtype == np.float64
    assert fit.sigma_tr_per_mm == pytest.approx(dipole.effective_transport(0.1, 1.5), rel=1e-5)
    np.testing.assert_array_equal(profile, before)


def test_noise_without_variance_is_found_from_residuals(rng):
    clean = table(0.1, 1.2)
    deviation = np.where(RADIUS > 5.0, 0.2, 0.01)
    readings = clean * np.exp(deviation * rng.standard_normal((400, 28)))
    fit = subsurface.invert(RADIUS, readings, **FIBERS)
    truth = dipole.effective_transport(0.1, 1.2)
    scatter = fit.sigma_tr_per_mm.std()
    assert np.abs(fit.sigma_tr_per_mm / truth - 1.0).max() < 0.1
    assert 0.6 < np.median(fit.sigma_tr_stderr) / scatter < 1.4


def test_without_absorption_the_interval_reaches_zero(rng):
    profile, variance = noisy(table(0.0, 1.0), rng)
    fit = fit_table(profile, variance)
    assert not fit.valid
    assert fit.outcome & FitOutcome.NOT_IDENTIFIED
    assert fit.interval_per_mm[0] == 0.0
    assert fit.interval_per_mm[1] < 0.05
    assert fit.sigma_s_prime_per_mm == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("sigma_s", [0.0, 1e-3])
def test_zero_scattering_gives_no_signal(sigma_s, rng):
    profile, variance = noisy(table(0.05, sigma_s), rng)
    fit = fit_table(profile, variance)
    assert fit.outcome == FitOutcome.NO_SIGNAL
    assert np.isnan(fit.sigma_tr_per_mm)
    assert fit.interval_per_mm.tolist() == [0.0, np.inf]


def test_strong_absorption_is_beyond_diffusion_alone(rng):
    profile, variance = noisy(table(4.9, 0.5), rng)
    fit = fit_table(profile, variance)
    assert fit.valid
    assert fit.sigma_tr_per_mm == pytest.approx(dipole.effective_transport(4.9, 0.5), rel=0.1)
    for method in ("diffusion", "dipole"):
        closed_form = fit_table(profile, variance, method=method)
        assert closed_form.outcome & FitOutcome.OUTSIDE_DOMAIN
        assert not closed_form.valid
        assert "outside the model's domain" in closed_form.reason()


@pytest.mark.parametrize("eta", [1.0, 1.6])
def test_refractive_index_matters_and_is_included(eta, rng):
    profile, variance = noisy(table(0.1, 1.2, eta=eta), rng)
    truth = dipole.effective_transport(0.1, 1.2)
    fit = fit_table(profile, variance, eta=eta)
    assert abs(fit.sigma_tr_per_mm - truth) < 4.0 * fit.sigma_tr_stderr
    wrong = fit_table(profile, variance, eta=1.4)
    assert abs(wrong.sigma_s_prime_per_mm - 1.2) > 5.0 * wrong.sigma_s_prime_stderr


@pytest.mark.parametrize("how", ["valid", "variance", "value"])
def test_dead_fiber_is_omitted_and_reported(how, rng):
    profile, variance = noisy(table(0.1, 1.2), rng)
    profile[7], valid, code = 0.0, np.ones(28, bool), 1
    if how == "valid":
        valid[7] = False
    elif how == "variance":
        variance[7], code = np.inf, 3
    else:
        profile[7], code = np.nan, 2
    fit = fit_table(profile, variance, valid=valid)
    assert fit.left_out[7] == code
    assert fit.used.sum() == 27
    assert fit.dof == 25
    assert fit.valid
    assert abs(fit.sigma_tr_per_mm - dipole.effective_transport(0.1, 1.2)) < (
        4.0 * fit.sigma_tr_stderr
    )


def test_fiber_far_from_others_is_omitted(rng):
    profile, variance = noisy(table(0.1, 1.2), rng)
    profile[9] *= 2.0
    fit = fit_table(profile, variance)
    assert fit.left_out[9] == subsurface.OmissionReason.OUTLIER
    assert fit.used.sum() == 27
    assert fit.valid
    assert abs(fit.sigma_tr_per_mm - dipole.effective_transport(0.1, 1.2)) < (
        4.0 * fit.sigma_tr_stderr
    )


def test_negative_readings_far_out_are_used(rng):
    """Of 1000 draws half the far readings are negative; dropping them would bias the fit."""
    clean = table(0.6, 3.0)
    readings, variance = noisy(clean, rng, (1000,))
    assert (readings[:, -6:] < 0.0).mean() > 0.3
    fit = fit_table(readings, variance, g=0.8, g_error=0.0)
    assert fit.used.all()
    truth = dipole.effective_transport(0.6, 3.0)
    error = np.log(fit.sigma_tr_per_mm / truth)
    assert abs(error.mean()) < 5.0 * error.std() / np.sqrt(1000.0)
    assert np.sqrt(np.mean((error / (fit.sigma_tr_stderr / fit.sigma_tr_per_mm)) ** 2)) < 1.2


def test_too_few_fibers_are_refused():
    fit = subsurface.invert([1.0], [0.01], variance=[1e-8])
    assert fit.outcome == FitOutcome.TOO_FEW_FIBERS
    assert not fit.valid


def test_single_repeated_radius_does_not_determine_slope():
    fit = subsurface.invert(np.full(28, 1.0), np.full(28, 0.01), variance=1e-8)
    assert not fit.valid
    assert fit.outcome & FitOutcome.NOT_IDENTIFIED


def test_radii_may_repeat(rng):
    radius = np.repeat(RADIUS[::4], 4)
    profile = photon_table.reflectance(radius, 0.1, 1.2)
    fit = subsurface.invert(radius, profile, variance=(0.01 * profile) ** 2)
    assert fit.valid
    assert fit.sigma_tr_per_mm == pytest.approx(dipole.effective_transport(0.1, 1.2), rel=0.01)


def test_a_scale_wrong_by_a_hundred_is_flagged(rng):
    profile, variance = noisy(table(0.04, 1.5), rng)
    for method in ("photon_table", "diffusion", "dipole"):
        fit = fit_table(100.0 * profile, 1e4 * variance, method=method, common_error=0.01)
        assert not fit.valid
        assert fit.outcome & FitOutcome.WRONG_PROFILE
        assert fit.p_value < 1e-6


def test_a_misfit_widens_the_interval(rng):
    profile, variance = noisy(table(0.1, 1.2), rng)
    bent = profile * np.exp(0.15 * np.sin(1.3 * RADIUS))
    good, bad = fit_table(profile, variance), fit_table(bent, variance)
    assert not good.outcome & FitOutcome.MISFIT
    assert good.model_error == 0.0
    assert bad.outcome & FitOutcome.MISFIT
    assert 0.03 < bad.model_error < 0.3
    assert bad.sigma_tr_stderr > 3.0 * good.sigma_tr_stderr


def test_a_hundred_thousand_profiles_fit_at_once(rng):
    clean = dipole.reflectance(RADIUS, 0.1, 1.5, 1.4)
    readings = clean * (1.0 + 0.01 * rng.standard_normal((100_000, 28)))
    fit = subsurface.invert(
        RADIUS, readings, variance=(0.01 * clean) ** 2, method="dipole", model_error=0.0
    )
    assert fit.valid.all()
    z = np.log(fit.sigma_tr_per_mm / dipole.effective_transport(0.1, 1.5))
    z /= fit.sigma_tr_stderr / fit.sigma_tr_per_mm
    assert abs(z.mean()) < 0.03
    assert abs(z.std() - 1.0) < 0.03


def test_no_profiles_give_no_fits():
    assert subsurface.fit_dipole(RADIUS, np.empty((0, 28))).sigma_tr_per_mm.shape == (0,)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"method": "guess"}, "method"),
        ({"collection": "some"}, "collection"),
        ({"eta": 0.9}, "eta"),
        ({"common_error": -1.0}, "common_error"),
        ({"g_error": np.nan}, "g_error"),
        ({"core_mm": -0.2}, "core_mm"),
    ],
)
def test_settings_out_of_range_are_named(settings, field):
    with pytest.raises(SubsurfaceError, match=f"^{field}: got"):
        subsurface.invert(RADIUS, np.ones(28), **settings)
