"""Photon transport against published and exact values.

Every comparison allows 4 standard errors of 40 batches (false alarms: below 3e-4 each by Student's
distribution with 39 degrees of freedom) and 5e-4 for the digits of the published number. Beside
each, the same comparison with one thing wrong has to fail.
"""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from scipy import stats
from scipy.special import roots_legendre

from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons

BATCHES = 40

VAN_DE_HULST = LayerStack((Layer(0.2, 1.0, 9.0, 0.75, 1.0),))
GIOVANELLI = LayerStack((Layer(inf, 1.0, 9.0, 0.0, 1.5),))
MCML_SAMPLE = LayerStack(
    (
        Layer(1.0, 0.1, 10.0, 0.9, 1.37),
        Layer(1.0, 0.1, 1.0, 0.0, 1.37),
        Layer(2.0, 0.2, 1.0, 0.7, 1.37),
    )
)


def traced(stack, photons, *, seed=1, **more):
    rng = np.random.default_rng(seed)
    return trace_photons(stack, photons=photons, rng=rng, batches=BATCHES, threads=2, **more)


def agrees(value, stderr, published):
    return bool(abs(value - published) < 4.0 * stderr + 5e-4)


def with_layer(stack, index, **changes):
    layers = list(stack.layers)
    layers[index] = replace(layers[index], **changes)
    return replace(stack, layers=tuple(layers))


def half_space(albedo, eta=1.0):
    return LayerStack((Layer(inf, 1.0 - albedo, albedo, 0.0, eta),))


def chandrasekhar_reflectance(albedo, order=200):
    """Reflectance 1 - H(1) sqrt(1 - a) of an isotropic half-space, light at normal incidence.

    H solves 1/H(mu) = sqrt(1 - a) + a/2 int_0^1 mu' H(mu') / (mu + mu') dmu'
    (Chandrasekhar 1950, Radiative Transfer, chapter V).
    """
    nodes, weights = roots_legendre(order)
    mu, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    root = np.sqrt(1.0 - albedo)
    h = np.ones(order)
    for _ in range(1000):
        inverse = root + 0.5 * albedo * (weights * mu * h / (mu[:, None] + mu)).sum(axis=1)
        if np.abs(h - 1.0 / inverse).max() < 1e-13:
            break
        h = 1.0 / inverse
    h_one = 1.0 / (root + 0.5 * albedo * (weights * mu * h / (1.0 + mu)).sum())
    return float(1.0 - h_one * root)


def test_slab_matches_van_de_hulst():
    """Rationale: forward scattering, finite slab, both exits. Expected: van de Hulst 1980,
    table 35, R .09739, T .66096 (direct light included)."""
    run = traced(VAN_DE_HULST, 2_000_000)
    assert agrees(run.reflectance, run.reflectance_stderr, 0.09739)
    assert agrees(run.transmittance, run.transmittance_stderr, 0.66096)


@pytest.mark.parametrize("wrong", [{"g": 0.74}, {"thickness_mm": 0.205}, {"sigma_a_per_mm": 1.05}])
def test_slab_with_wrong_property_misses_van_de_hulst(wrong):
    run = traced(with_layer(VAN_DE_HULST, 0, **wrong), 2_000_000)
    assert not (
        agrees(run.reflectance, run.reflectance_stderr, 0.09739)
        and agrees(run.transmittance, run.transmittance_stderr, 0.66096)
    )


def test_mismatched_half_space_matches_giovanelli():
    """Rationale: internal reflection. Expected: Giovanelli 1955 (doi:10.1080/713821040), .2600 with
    the specular .04."""
    run = traced(GIOVANELLI, 1_000_000)
    assert run.specular == pytest.approx(0.04)
    assert agrees(run.specular + run.reflectance, run.reflectance_stderr, 0.2600)


def test_half_space_without_mismatch_misses_giovanelli():
    run = traced(with_layer(GIOVANELLI, 0, eta=1.0), 100_000)
    assert not agrees(run.specular + run.reflectance, run.reflectance_stderr, 0.2600)


@pytest.mark.long
@pytest.mark.parametrize(("albedo", "published"), [(0.5, 0.11523), (0.9, 0.41495), (0.99, 0.75272)])
def test_matched_half_space_matches_the_exact_h_function(albedo, published):
    """Rationale: long walks, roulette. Expected: Chandrasekhar's H function, solved here."""
    exact = chandrasekhar_reflectance(albedo)
    assert exact == pytest.approx(published, abs=1e-5)
    run = traced(half_space(albedo), 500_000)
    assert agrees(run.reflectance, run.reflectance_stderr, exact)
    darker = traced(half_space(1.0 - 1.05 * (1.0 - albedo)), 500_000)
    assert not agrees(darker.reflectance, darker.reflectance_stderr, exact)


@pytest.mark.long
@pytest.mark.parametrize(("albedo", "total"), [(0.5, 0.08009), (0.9, 0.27840), (0.99, 0.63139)])
def test_half_space_of_skins_index_matches_adding_doubling(albedo, total):
    """Rationale: the index of skin, 1.4. Expected: iadpython (UR1, specular included)."""
    run = traced(half_space(albedo, eta=1.4), 200_000)
    assert agrees(run.specular + run.reflectance, run.reflectance_stderr, total)
    darker = traced(half_space(1.0 - 1.1 * (1.0 - albedo), eta=1.4), 200_000)
    assert not agrees(darker.specular + darker.reflectance, darker.reflectance_stderr, total)


@pytest.mark.long
def test_three_layers_match_the_sample_output_of_mcml():
    """Rationale: several layers with unlike g. Expected: sample.mco of MCML, 1e6 photons
    (Wang, Jacques, Zheng 1995, doi:10.1016/0169-2607(95)01640-F); its own noise is allowed for."""
    run = traced(MCML_SAMPLE, 1_000_000)
    assert run.specular == pytest.approx(0.0243729, abs=1e-7)
    mcml_noise = 5e-4  # an upper bound: sqrt(R (1 - R) / 1e6) is 4.3e-4 for whole photons
    for value, stderr, published in (
        (run.reflectance, run.reflectance_stderr, 0.237544),
        (run.transmittance, run.transmittance_stderr, 0.0964896),
        *zip(run.absorbed, run.absorbed_stderr, (0.2612, 0.1488, 0.2316), strict=True),
    ):
        assert agrees(value, np.hypot(stderr, mcml_noise), published)


def test_layers_in_wrong_order_miss_sample_output():
    reversed_ = LayerStack(MCML_SAMPLE.layers[::-1])
    run = traced(reversed_, 200_000)
    assert not agrees(run.reflectance, np.hypot(run.reflectance_stderr, 5e-4), 0.237544)


def radial_p_value(stack):
    """Sidak-corrected p value of the worst of ten rings against MCML's sample R(r)."""
    # Rd_r in 1/cm^2, rings of 0.01 cm: 1e6 photons, MCML's sample.mco.
    mcml = [30.924, 10.071, 6.1187, 4.4015, 3.5138, 2.8528, 2.4344, 2.0692, 1.7715, 1.5409]
    edges = 0.1 * np.arange(11.0)
    run = traced(stack, 1_000_000, ring_edges_mm=edges)
    published = np.array(mcml) / 100.0 * np.pi * np.diff(edges**2)
    # A weight is at most 1, so whole photons bound the published numbers' noise from above.
    error = np.hypot(run.ring_reflectance_stderr, np.sqrt(published / 1e6))
    worst = (np.abs(run.ring_reflectance - published) / error).max()
    return 1.0 - (1.0 - 2.0 * stats.t.sf(worst, BATCHES - 1)) ** len(mcml)


@pytest.mark.long
def test_radial_profile_matches_the_sample_output_of_mcml():
    """Expected: ten rings of sample.mco. False alarms: below 1e-3 for all rings together."""
    assert radial_p_value(MCML_SAMPLE) > 1e-3


@pytest.mark.long
def test_reduced_forward_scattering_misses_radial_profile():
    assert radial_p_value(with_layer(MCML_SAMPLE, 0, g=0.88)) < 1e-3


@pytest.mark.parametrize("stack", [VAN_DE_HULST, GIOVANELLI, MCML_SAMPLE, half_space(0.99, 1.4)])
def test_energy_is_conserved(stack):
    run = traced(stack, 40_000)
    assert run.balance == pytest.approx(1.0, abs=1e-11)
    # The roulette takes as much as it gives: its share is far below the reflectance's noise.
    assert abs(run.roulette) < 4.0 * run.reflectance_stderr
