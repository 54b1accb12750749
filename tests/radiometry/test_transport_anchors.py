"""Both engines, and light in a cone, against published and exact values.

Every comparison allows 4 standard errors of 40 batches (false alarms: below 3e-4 each by Student's
distribution with 39 degrees of freedom) and 5e-4 for the digits of the published number. The same
comparison with one thing wrong has to fail; for the scalar engine see also test_tissue_anchors.
"""

import csv
from dataclasses import replace
from math import inf, pi

import numpy as np
import pytest
from scipy import stats
from scipy.special import roots_legendre

from rigsim.fiber.profile import trace_fiber_profile
from rigsim.tissue import photon_lanes
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError, trace_photons

BATCHES = 40
NEEDS_LANES = pytest.mark.skipif(
    not photon_lanes.is_usable(), reason="Dr.Jit finds no LLVM 17 or newer here"
)
ENGINES = ["numba", pytest.param("drjit", marks=NEEDS_LANES)]

VAN_DE_HULST = LayerStack((Layer(0.2, 1.0, 9.0, 0.75, 1.0),))
GIOVANELLI = LayerStack((Layer(inf, 1.0, 9.0, 0.0, 1.5),))
MCML_SAMPLE = LayerStack(
    (
        Layer(1.0, 0.1, 10.0, 0.9, 1.37),
        Layer(1.0, 0.1, 1.0, 0.0, 1.37),
        Layer(2.0, 0.2, 1.0, 0.7, 1.37),
    )
)


def traced(stack, photons, engine, *, seed=1, **more):
    rng = np.random.default_rng(seed)
    return trace_photons(
        stack, photons=photons, rng=rng, batches=BATCHES, threads=2, engine=engine, **more
    )


def agrees(value, stderr, published):
    return bool(abs(value - published) < 4.0 * stderr + 5e-4)


def half_space(albedo, eta, g=0.0):
    return LayerStack((Layer(inf, 1.0 - albedo, albedo / (1.0 - g), g, eta),))


def rows(folder, name):
    with (folder / "radiative_transfer" / name).open(newline="", encoding="utf-8") as file:
        return list(csv.reader(line for line in file if not line.startswith("#")))


def h_at_one(albedo, order=200):
    """Chandrasekhar's H(1) of an isotropic half-space (1950, Radiative Transfer, chapter V)."""
    nodes, weights = roots_legendre(order)
    mu, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    root, h = np.sqrt(1.0 - albedo), np.ones(order)
    for _ in range(2000):
        h = 1.0 / (root + 0.5 * albedo * (weights * mu * h / (mu[:, None] + mu)).sum(axis=1))
    return float(1.0 / (root + 0.5 * albedo * (weights * mu * h / (1.0 + mu)).sum()))


@NEEDS_LANES
def test_slab_lanes_match_van_de_hulst_uniquely():
    """Expected: van de Hulst 1980, table 35, R .09739, T .66096 (direct light included)."""

    def agree(stack):
        run = traced(stack, 2_000_000, "drjit")
        return agrees(run.reflectance, run.reflectance_stderr, 0.09739) and agrees(
            run.transmittance, run.transmittance_stderr, 0.66096
        )

    assert agree(VAN_DE_HULST)
    assert not agree(LayerStack((replace(VAN_DE_HULST.layers[0], g=0.74),)))


@NEEDS_LANES
def test_mismatched_half_space_in_lanes_matches_giovanelli():
    """Expected: Giovanelli 1955 (doi:10.1080/713821040), .2600 with the specular .04."""
    run = traced(GIOVANELLI, 1_000_000, "drjit")
    assert agrees(run.specular + run.reflectance, run.reflectance_stderr, 0.2600)
    matched = traced(half_space(0.9, 1.0), 1_000_000, "drjit")
    assert not agrees(matched.specular + matched.reflectance, matched.reflectance_stderr, 0.2600)


@NEEDS_LANES
@pytest.mark.parametrize("albedo", [0.5, 0.9, 0.99])
def test_matched_half_space_lanes_match_exact_h_function(albedo):
    exact = 1.0 - h_at_one(albedo) * np.sqrt(1.0 - albedo)
    run = traced(half_space(albedo, 1.0), 500_000, "drjit")
    assert agrees(run.reflectance, run.reflectance_stderr, exact)


@pytest.mark.long
@pytest.mark.parametrize("engine", ENGINES)
def test_half_space_of_fast_photons_matches_mcml(engine):
    """Expected: .3592 by MCML for g .9, sigma_s 10, sigma_a .05 per mm, n 1.4."""
    run = traced(LayerStack((Layer(inf, 0.05, 10.0, 0.9, 1.4),)), 100_000, engine)
    assert agrees(run.reflectance, run.reflectance_stderr, 0.3592)
    similar = traced(LayerStack((Layer(inf, 0.05, 1.0, 0.0, 1.4),)), 1_000_000, engine)
    assert not agrees(similar.reflectance, similar.reflectance_stderr, 0.3592)


@pytest.mark.parametrize("engine", ENGINES)
def test_radial_profile_matches_all_rings_of_mcmls_sample(engine, test_data):
    """Expected: the 49 rings of sample.mco, 1e6 photons; its noise is bounded by whole photons.

    False alarms: below 1e-3 for all rings together (Sidak)."""
    mcml = np.array([float(x) for x in rows(test_data, "sample_mco_Rr.csv")[0]]) / 100.0
    edges = 0.1 * np.arange(len(mcml) + 1.0)
    area = pi * np.diff(edges**2)

    def p_value(stack):
        run = traced(stack, 400_000, engine, ring_edges_mm=edges)
        error = np.hypot(run.ring_reflectance_stderr, np.sqrt(mcml * area / 1e6))
        worst = (np.abs(run.ring_reflectance - mcml * area) / error).max()
        return 1.0 - (1.0 - 2.0 * stats.t.sf(worst, BATCHES - 1)) ** len(mcml)

    assert p_value(MCML_SAMPLE) > 1e-3
    assert p_value(replace(MCML_SAMPLE, layers=MCML_SAMPLE.layers[::-1])) < 1e-3


def test_all_angle_fibers_match_mcml_sample_rings(test_data):
    """Rationale: scoring at collisions, splitting, three layers. The mean over a disc .1 mm wide
    and over a ring .1 mm wide differ by less than .2 % from .5 mm on; 1 % is added for MCML."""
    mcml = np.array([float(x) for x in rows(test_data, "sample_mco_Rr.csv")[0]])[5:40] / 100.0
    radii = 0.55 + 0.1 * np.arange(len(mcml))
    area = 2.0 * pi * radii * 0.1

    def p_value(stack):
        run = trace_fiber_profile(
            stack,
            radii_mm=radii,
            core_mm=0.1,
            source_core_mm=0.0,
            numerical_aperture=1.0,
            source_numerical_aperture=0.0,
            photons=80_000,
            rng=np.random.default_rng(1),
            batches=BATCHES,
            threads=2,
        )
        error = np.sqrt(run.stderr**2 + mcml / area / 1e6 + (0.002 * mcml) ** 2)
        worst = (np.abs(run.reflectance_per_mm2 - mcml) / error).max()
        return 1.0 - (1.0 - 2.0 * stats.t.sf(worst, BATCHES - 1)) ** len(mcml)

    assert p_value(MCML_SAMPLE) > 1e-3
    assert p_value(replace(MCML_SAMPLE, layers=MCML_SAMPLE.layers[::-1])) < 1e-3


def all_light_in_a_cone(stack, photons, seed=1):
    """pi times the radiance along the normal, of all the surface: a fiber that covers it."""
    core = 400.0 / stack.layers[0].sigma_s_per_mm
    run = trace_fiber_profile(
        stack,
        radii_mm=(0.0,),
        core_mm=core,
        source_core_mm=0.0,
        numerical_aperture=0.05,
        source_numerical_aperture=0.0,
        photons=photons,
        rng=np.random.default_rng(seed),
        batches=BATCHES,
        threads=2,
    )
    area = pi * (core / 2.0) ** 2
    return run.reflectance_per_mm2[0] * area, run.stderr[0] * area


def test_narrow_cone_light_matches_van_de_hulst_normal():
    """Expected: I_R(mu = 1) = .06180 of the slab; within the cone I differs by 1e-4."""
    assert agrees(*all_light_in_a_cone(VAN_DE_HULST, 200_000), 0.06180)
    assert not agrees(
        *all_light_in_a_cone(LayerStack((replace(VAN_DE_HULST.layers[0], g=0.74),)), 200_000),
        0.06180,
    )


@pytest.mark.parametrize("albedo", [0.5, 0.9, 0.99])
def test_narrow_cone_light_matches_h_function(albedo):
    """Expected: reflected radiance a / 4 H(1)^2 / 2 per incident flux / pi (Chandrasekhar)."""
    exact = albedo * h_at_one(albedo) ** 2 / 8.0
    assert agrees(*all_light_in_a_cone(half_space(albedo, 1.0), 50_000), exact)
    assert not agrees(*all_light_in_a_cone(half_space(albedo - 0.01, 1.0), 50_000), exact)


@pytest.mark.long
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("eta", [1.3, 1.4, 1.5])
def test_half_spaces_match_adding_and_doubling(engine, eta, test_data):
    """Expected: UR1 of iadpython, ten albedos (its rows of n = 1 are known to be off)."""
    table = rows(test_data, "adding_doubling_semi_infinite.csv")[1:]
    chosen = [(float(a), float(total)) for a, n, total, _ in table if float(n) == eta]
    assert len(chosen) == 10
    for albedo, total in chosen:
        run = traced(half_space(albedo, eta), 100_000, engine)
        assert agrees(run.specular + run.reflectance, run.reflectance_stderr, total), albedo


def materials(folder):
    """(name, sigma_s', sigma_a, eta) of each material and channel of Jensen et al. 2001."""
    for name, *numbers in rows(folder, "jensen2001.csv")[1:]:
        for sigma_s, sigma_a in zip(numbers[:3], numbers[3:], strict=True):
            yield name, float(sigma_s), float(sigma_a), 1.5 if name == "Marble" else 1.3


@pytest.mark.long
@pytest.mark.parametrize("engine", ENGINES)
def test_whole_material_table_matches_adding_and_doubling(engine, test_data):
    """Rationale: albedos from .11 to .99997. Expected: iadpython at g = 0, computed here."""
    iad = pytest.importorskip("iadpython")
    seen = 0
    for name, sigma_s, sigma_a, eta in materials(test_data):
        if sigma_a == 0.0:
            continue  # Spectralon: see the next test
        albedo = sigma_s / (sigma_s + sigma_a)
        sample = iad.Sample(a=albedo, b=np.inf, g=0.0, n=eta, quad_pts=32)
        total = sample.rt()[0]
        run = traced(half_space(albedo, eta), 100_000, engine)
        assert agrees(run.specular + run.reflectance, run.reflectance_stderr, total), name
        seen += 1
    assert seen == 33


def test_half_space_that_does_not_absorb_is_refused(test_data):
    spectralon = [m for m in materials(test_data) if m[0] == "Spectralon"]
    for _, sigma_s, sigma_a, eta in spectralon:
        with pytest.raises(TransportError, match="must absorb"):
            LayerStack((Layer(inf, sigma_a, sigma_s, 0.0, eta),))


@pytest.mark.parametrize(("channel", "published"), [(0, 0.4316), (1, 0.2098), (2, 0.1138)])
def test_jensen_skin1_reflectance_matches_transport(channel, published, test_data):
    """Expected: R_d of skin1 by transport, g = 0, n = 1.3, four digits."""
    skin = [m for m in materials(test_data) if m[0] == "Skin1"][channel]
    run = traced(half_space(skin[1] / (skin[1] + skin[2]), 1.3), 200_000, "numba")
    assert agrees(run.reflectance, run.reflectance_stderr, published)
