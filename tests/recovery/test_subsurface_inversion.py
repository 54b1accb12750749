"""sigma_tr from Monte Carlo profiles in fibers, made by another code than what inverts them.

Media, readings and their errors are of the size of a session's: 1.2 % from fiber to fiber, 1 % in
common, and a floor of noise in the dark.
"""

from math import inf

import numpy as np
import pytest

from model.dipole import effective_transport
from reconstruction import subsurface
from rigsim.fiber.profile import trace_fiber_profile
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons

RADIUS = 0.3 + 0.25 * np.arange(28)
FIBER_ERROR, COMMON_ERROR, FLOOR = 0.012, 0.01, 1e-8
FIBERS = {"collection": "fiber", "core_mm": 0.2, "source_core_mm": 0.2}


def medium(sigma_a, sigma_s_prime, g, eta=1.4, thickness=inf):
    return Layer(thickness, sigma_a, sigma_s_prime / (1.0 - g), g, eta)


def truth(*layers, photons, seed=1):
    return trace_fiber_profile(
        LayerStack(layers), radii_mm=RADIUS, photons=photons, rng=np.random.default_rng(seed)
    )


def readings(profile, rng, draws):
    """Draws (N, 28) of what a probe reads, and their variance, the simulation's own included."""
    clean = profile.reflectance_per_mm2
    noisy = clean * np.exp(COMMON_ERROR * rng.standard_normal((draws, 1)))
    noisy = noisy * (1.0 + FIBER_ERROR * rng.standard_normal((draws, 28)))
    noisy += FLOOR * rng.standard_normal((draws, 28))
    return noisy, (FIBER_ERROR * clean) ** 2 + profile.stderr**2 + FLOOR**2


def fit(profiles, variance, method="photon_table", **settings):
    return subsurface.invert(
        RADIUS,
        profiles,
        variance=variance,
        method=method,
        common_error=COMMON_ERROR,
        **(FIBERS | settings),
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("sigma_a", "sigma_s", "g"), [(0.04, 1.0, 0.8), (0.25, 1.5, 0.73), (1.0, 1.5, 0.8)]
)
def test_transport_inversion_recovers_sigma_tr_but_dipole_fails(sigma_a, sigma_s, g, rng):
    """Within 3 % and four standard errors; the dipole is low by 4...25 % on the same readings."""
    profiles, variance = readings(truth(medium(sigma_a, sigma_s, g), photons=60_000), rng, 20)
    expected = effective_transport(sigma_a, sigma_s)
    found = fit(profiles, variance)
    assert found.valid.all()
    error = found.sigma_tr_per_mm / expected - 1.0
    assert np.abs(error).max() < 0.03
    # The simulation's error is common to all draws: one chance in 15,000.
    assert abs(np.median(error)) < 4.0 * np.median(found.sigma_tr_stderr / found.sigma_tr_per_mm)
    low = fit(profiles, variance, "dipole").sigma_tr_per_mm / expected - 1.0
    assert -0.25 < np.median(low) < -0.04


OUTSIDE = np.uint16(subsurface.FitOutcome.ASYMMETRY_OUTSIDE_PRIOR)


@pytest.mark.parametrize(
    ("sigma_a", "sigma_s", "g", "bias"), [(0.04, 1.0, 0.0, 0.02), (0.1, 1.2, 0.3, 0.001)]
)
def test_media_outside_asymmetry_prior_are_not_valid(sigma_a, sigma_s, g, bias, rng):
    """By a prior that has their g the same readings are valid and right."""
    profiles, variance = readings(truth(medium(sigma_a, sigma_s, g), photons=60_000), rng, 20)
    expected = effective_transport(sigma_a, sigma_s)
    found = fit(profiles, variance)
    assert np.all(found.outcome & OUTSIDE)
    assert not found.valid.any()
    assert "asymmetry g is outside" in found.reason((0,))
    assert np.median(found.sigma_tr_per_mm) / expected - 1.0 > bias
    informed = fit(profiles, variance, g=g, g_error=0.1)
    assert informed.valid.all()
    assert abs(np.median(informed.sigma_tr_per_mm) / expected - 1.0) < 0.01


@pytest.mark.long
@pytest.mark.parametrize("g", [0.7, 0.94])
def test_media_at_ends_of_asymmetry_prior_are_valid(g, rng):
    """200 draws of two media; one false alarm is expected in 1000."""
    alarms = []
    for sigma_a, sigma_s in [(0.04, 1.0), (0.5, 2.0)]:
        profiles, variance = readings(truth(medium(sigma_a, sigma_s, g), photons=30_000), rng, 100)
        alarms.append(fit(profiles, variance).outcome & OUTSIDE)
    assert np.count_nonzero(alarms) <= 3


def test_far_fibers_widen_error_by_isotropic_scattering(rng):
    """Beyond 2 mm no profile shows g; the interval covers what the near fibers would find."""
    profiles, variance = readings(truth(medium(0.1, 0.7, 0.0), photons=60_000), rng, 20)
    far = {"valid": RADIUS > 2.0}
    expected = effective_transport(0.1, 0.7)
    found = fit(profiles, variance, **far)
    error = np.abs(found.sigma_tr_per_mm / expected - 1.0)
    relative = found.sigma_tr_stderr / found.sigma_tr_per_mm
    seen = found.valid
    assert np.mean(seen) > 0.5
    assert np.mean(error[seen] < 2.0 * relative[seen]) > 0.9
    firm = fit(profiles, variance, g=0.825, g_error=0.0, **far)
    narrow = firm.sigma_tr_stderr / firm.sigma_tr_per_mm
    assert np.median(np.abs(firm.sigma_tr_per_mm / expected - 1.0) / narrow) > 2.0


def test_layers_misfit_but_homogeneous_skin_fits(rng):
    layered = truth(medium(1.5, 2.5, 0.8, thickness=0.1), medium(0.05, 1.5, 0.8), photons=30_000)
    profiles, variance = readings(layered, rng, 10)
    found = fit(profiles, variance)
    assert np.all(found.outcome & np.uint16(subsurface.FitOutcome.MISFIT))
    assert np.all(found.model_error > 0.02)
    assert not np.any(found.outcome & OUTSIDE)
    plain, variance = readings(truth(medium(0.05, 1.5, 0.8), photons=30_000), rng, 10)
    assert np.mean(fit(plain, variance).outcome == 0) >= 0.9


@pytest.mark.long
@pytest.mark.parametrize("eta", [1.0, 1.6])
def test_sigma_tr_is_recovered_at_other_refractive_indices(eta, rng):
    profiles, variance = readings(truth(medium(0.1, 1.2, 0.8, eta), photons=200_000), rng, 20)
    expected = effective_transport(0.1, 1.2)
    found = fit(profiles, variance, eta=eta)
    error = np.median(found.sigma_tr_per_mm) / expected - 1.0
    assert abs(error) < 0.02
    assert abs(error) < 4.0 * np.median(found.sigma_tr_stderr / found.sigma_tr_per_mm)


@pytest.mark.long
def test_nearly_forward_scattering_is_recovered(rng):
    """g = 0.99 lies outside the prior and the table; beyond a millimetre it looks like 0.95."""
    edges = np.linspace(0.175, 7.175, 29)
    stack = LayerStack((medium(0.1, 0.7, 0.99),))
    run = trace_photons(stack, photons=20_000, rng=np.random.default_rng(3), ring_edges_mm=edges)
    expected = effective_transport(0.1, 0.7)
    found = subsurface.invert(
        0.5 * (edges[1:] + edges[:-1]),
        run.reflectance_per_mm2,
        variance=run.reflectance_per_mm2_stderr**2 + 1e-5**2,
    )
    assert found.valid
    assert abs(found.sigma_tr_per_mm - expected) < 4.0 * found.sigma_tr_stderr
    assert abs(found.sigma_tr_per_mm / expected - 1.0) < 0.08


@pytest.mark.long
def test_the_exitance_of_all_directions_is_inverted_alike(rng):
    """R(r) as counted in rings by the pencil beam's transport, ring by ring 0.1 mm wide."""
    edges = np.stack([RADIUS - 0.05, RADIUS + 0.05], axis=1).ravel()
    stack = LayerStack((medium(0.1, 1.2, 0.8),))
    run = trace_photons(stack, photons=600_000, rng=np.random.default_rng(3), ring_edges_mm=edges)
    profile = run.reflectance_per_mm2[::2]
    variance = run.reflectance_per_mm2_stderr[::2] ** 2
    expected = effective_transport(0.1, 1.2)
    found = subsurface.invert(RADIUS, profile, variance=variance)
    assert found.valid
    assert abs(found.sigma_tr_per_mm - expected) < 4.0 * found.sigma_tr_stderr
    assert abs(found.sigma_tr_per_mm / expected - 1.0) < 0.03


@pytest.mark.long
@pytest.mark.timeout(600)
def test_errors_and_intervals_from_weak_to_strong_absorption(rng):
    """Twelve media: median error below 3 %, worst below 8 %, intervals as honest as they say.

    The simulation's own error is common to a medium's draws and makes their coverage scatter, by
    about 0.15 a medium and 0.045 over twelve; the limits are the promised 60...76 %, with twice
    that on either side. The dipole beside it is biased by -4...-25 %.
    """
    held, errors, dipole_bias = [], [], []
    for n, sigma_tr in enumerate(np.geomspace(0.3, 3.0, 12)):
        g = (0.8, 0.73, 0.9)[n % 3]
        s = float(np.exp(rng.uniform(np.log(0.7), np.log(3.0))))
        a = 0.5 * (np.sqrt(s**2 + 4.0 / 3.0 * sigma_tr**2) - s)
        profiles, variance = readings(truth(medium(a, s, g), photons=200_000, seed=n), rng, 50)
        found = fit(profiles, variance)
        low, high = found.interval_per_mm.T
        held.append(np.mean((low <= sigma_tr) & (sigma_tr <= high)))
        errors.append(np.abs(found.sigma_tr_per_mm / sigma_tr - 1.0))
        biased = fit(profiles, variance, "dipole").sigma_tr_per_mm / sigma_tr - 1.0
        dipole_bias.append(np.median(biased))
    assert np.median(errors) < 0.03
    assert np.max(errors) < 0.08
    assert 0.51 < np.mean(held) < 0.85
    assert -0.27 < min(dipole_bias) < -0.1
    assert max(dipole_bias) < -0.03
