"""Profiles seen by fibers against the all-angle walk, each other, closed forms and energy."""

import time
from math import inf

import numpy as np
import pytest
from scipy import stats

from rigsim.fiber.profile import (
    FiberGeometry,
    SpectralStack,
    trace_fiber_paths,
    trace_fiber_profile,
)
from rigsim.fiber.rings import KERNEL_NODES, ring_kernels
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError, trace_photons

RED = LayerStack((Layer(inf, 0.1, 7.5, 0.8, 1.4),))
LAYERED = LayerStack(
    (
        Layer(0.10, 0.5, 12.0, 0.80, 1.50),
        Layer(0.05, 0.2, 0.0, 0.00, 1.33),
        Layer(0.60, 1.0, 6.0, -0.30, 1.40),
    ),
    eta_below=1.45,
)
RADII_MM = (0.0, 0.1, 0.3, 0.8, 1.3, 2.0)


def exit_profile(stack, radii_mm, *, core_mm, source_core_mm, photons, seed):
    """Exitance averaged over pairs of points in two discs, from rings of the all-angle walk.

    The weights of the rings come from random points in the discs: no code is shared.
    """
    edges = np.linspace(0.0, 4.0, 401)
    run = trace_photons(
        stack, photons=photons, rng=np.random.default_rng(seed), ring_edges_mm=edges, threads=2
    )
    rng = np.random.default_rng(seed + 1)

    def disc(diameter):
        radius = 0.5 * diameter * np.sqrt(rng.random(200_000))
        angle = rng.uniform(0.0, 2.0 * np.pi, radius.size)
        return radius * np.cos(angle), radius * np.sin(angle)

    mean, error = [], []
    for radius in radii_mm:
        (x, y), (x_s, y_s) = disc(core_mm), disc(source_core_mm)
        apart = np.hypot(radius + x - x_s, y - y_s)
        share = np.histogram(apart, edges)[0] / apart.size
        density = run.reflectance_per_mm2
        mean.append(share @ density)
        error.append(
            np.hypot(
                np.linalg.norm(share * run.reflectance_per_mm2_stderr),
                np.sqrt((share @ density**2 - (share @ density) ** 2) / apart.size),
            )
        )
    return np.array(mean), np.array(error)


FORWARD = LayerStack((Layer(inf, 0.1, 7.5, 0.85, 1.4),))


@pytest.mark.long
@pytest.mark.parametrize(
    ("stack", "twin", "agree"), [(RED, RED, True), (LAYERED, LAYERED, True), (RED, FORWARD, False)]
)
def test_fibers_accepting_all_angles_collect_core_exitance(stack, twin, agree):
    # Independent runs; |z| < 4.5 for each of six radii: false alarms below 2e-3 (t, 19 dof).
    seen = trace_fiber_profile(
        stack,
        radii_mm=RADII_MM,
        photons=60_000,
        rng=np.random.default_rng(1),
        numerical_aperture=1.0,
        source_numerical_aperture=0.0,
        threads=2,
    )
    mean, error = exit_profile(
        twin, RADII_MM, core_mm=0.2, source_core_mm=0.2, photons=200_000, seed=3
    )
    z = (seen.reflectance_per_mm2 - mean) / np.hypot(seen.stderr, error)
    assert (np.abs(z).max() < 4.5) == agree


def test_paths_reweighted_to_more_absorption_match_direct_run():
    kept = trace_fiber_paths(
        RED, FiberGeometry(RADII_MM), photons=40_000, rng=np.random.default_rng(2), threads=2
    ).profile(0.4)
    darker = LayerStack((Layer(inf, 0.5, 7.5, 0.8, 1.4),))
    run = trace_fiber_profile(
        darker, radii_mm=RADII_MM, photons=40_000, rng=np.random.default_rng(3), threads=2
    )
    z = (kept.reflectance_per_mm2 - run.reflectance_per_mm2) / np.hypot(kept.stderr, run.stderr)
    assert np.abs(z).max() < 4.5


def test_paths_without_reweighting_give_profile_itself():
    rng = np.random.default_rng
    kept = trace_fiber_paths(RED, FiberGeometry(RADII_MM), photons=2000, rng=rng(4)).profile()
    run = trace_fiber_profile(RED, radii_mm=RADII_MM, photons=2000, rng=rng(4))
    np.testing.assert_allclose(kept.reflectance_per_mm2, run.reflectance_per_mm2, rtol=1e-5)


def test_band_is_the_weighted_mean_of_its_wavelengths():
    stacks = tuple(LayerStack((Layer(inf, a, 7.5, 0.8, 1.4),)) for a in (0.05, 0.5))
    weights = np.array([[1.0, 0.25], [0.0, 0.75]])
    both = trace_fiber_profile(
        SpectralStack((650.0, 550.0), stacks, weights),
        radii_mm=RADII_MM,
        photons=60_000,
        rng=np.random.default_rng(5),
        threads=2,
    )
    apart = [
        trace_fiber_profile(
            stack, radii_mm=RADII_MM, photons=30_000, rng=np.random.default_rng(6), threads=2
        )
        for stack in stacks
    ]
    for band in (0, 1):
        mean = sum(
            w * run.reflectance_per_mm2 for w, run in zip(weights[:, band], apart, strict=True)
        )
        error = np.sqrt(
            sum((w * run.stderr) ** 2 for w, run in zip(weights[:, band], apart, strict=True))
            + both.stderr[:, band] ** 2
        )
        assert np.abs((both.reflectance_per_mm2[:, band] - mean) / error).max() < 4.5


def test_profile_ignores_fiber_order_and_thread_count():
    rng = np.random.default_rng
    run = trace_fiber_profile(RED, radii_mm=RADII_MM, photons=2000, rng=rng(7))
    other = trace_fiber_profile(RED, radii_mm=RADII_MM[::-1], photons=2000, rng=rng(7), threads=3)
    np.testing.assert_array_equal(run.reflectance_per_mm2, other.reflectance_per_mm2[::-1])


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        ({"radii_mm": ()}, "radii_mm"),
        ({"radii_mm": (-0.1,)}, "radii_mm"),
        ({"core_mm": 0.0}, "core_mm"),
        ({"source_core_mm": -0.1}, "source_core_mm"),
        ({"numerical_aperture": 0.0}, "numerical_aperture"),
        ({"source_numerical_aperture": 1.1}, "source_numerical_aperture"),
        ({"photons": 0}, "photons"),
        ({"batches": 19}, "batches"),
    ],
)
def test_impossible_requests_are_refused_by_name(request_, field):
    arguments = {"radii_mm": (0.3,), "photons": 100, "rng": np.random.default_rng(0), **request_}
    with pytest.raises(TransportError, match=field):
        trace_fiber_profile(RED, **arguments)


@pytest.mark.parametrize(("detector_mm", "source_mm"), [(0.2, 0.2), (0.4, 0.1), (0.2, 0.0)])
def test_ring_fractions_match_random_points_in_cores(detector_mm, source_mm):
    rng = np.random.default_rng(8)
    rows, _, _ = ring_kernels(np.array([0.25]), 0.5 * detector_mm, 0.5 * source_mm)
    nodes = rows[0, 0] + np.arange(KERNEL_NODES) / rows[0, 1]
    count = 400_000
    points = []
    for diameter in (detector_mm, source_mm):
        r, a = 0.5 * diameter * np.sqrt(rng.random(count)), rng.uniform(0.0, 2 * np.pi, count)
        points.append((r * np.cos(a), r * np.sin(a)))
    apart = np.hypot(0.25 + points[0][0] - points[1][0], points[0][1] - points[1][1])
    edges = np.linspace(nodes[0], nodes[-1], 21)
    fine = np.linspace(nodes[0], nodes[-1], 20 * 500 + 1)
    density = 2.0 * np.pi * fine * np.interp(fine, nodes, rows[0, 3:-1])
    cumulative = np.concatenate(
        [[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(fine))]
    )
    expected = np.diff(cumulative[::500]) * count
    found = np.histogram(apart, edges)[0]
    # Poisson counts in 20 rings: |z| < 4.5 alarms falsely with a chance below 2e-4.
    assert np.abs((found - expected) / np.sqrt(np.maximum(expected, 1.0))).max() < 4.5


def all_angle_z(layer, *, photons=40_000, radii_mm=(0.0, 0.3, 1.0), core_mm=0.2):
    """Standard errors between fibers that take all angles and the exitance of the plain walk."""
    stack = LayerStack((layer,))
    seen = trace_fiber_profile(
        stack,
        radii_mm=radii_mm,
        photons=photons,
        rng=np.random.default_rng(11),
        core_mm=core_mm,
        numerical_aperture=1.0,
        source_numerical_aperture=0.0,
        threads=2,
    )
    mean, error = exit_profile(
        stack, radii_mm, core_mm=core_mm, source_core_mm=0.2, photons=4 * photons, seed=12
    )
    # Forward peaks of g = .99 make rare large scores.
    known = 0.5 if layer.g > 0.9 else 0.25
    assert np.all(seen.stderr < known * seen.reflectance_per_mm2)
    return np.abs((seen.reflectance_per_mm2 - mean) / np.hypot(seen.stderr, error)).max()


@pytest.mark.parametrize(
    "layer",
    [
        Layer(inf, 0.1, 7.5, 0.8, 1.0),
        Layer(inf, 0.1, 7.5, 0.8, 1.6),
        pytest.param(Layer(inf, 0.5, 50.0, 0.99, 1.4), marks=pytest.mark.long),
        Layer(inf, 0.5, 1.0, -0.9, 1.4),
        Layer(inf, 15.0, 7.5, 0.8, 1.4),
    ],
    ids=["eta 1", "eta 1.6", "g .99", "g -.9", "sigma_a = 10 sigma_s'"],
)
def test_extreme_media_agree_with_the_plain_walk(layer):
    # |z| < 4.5 for three radii: false alarms below 8e-4 (t, 19 dof). Fibers touch the source.
    dark = layer.sigma_a_per_mm > 1.0 or layer.g < 0.0
    radii = (0.0, 0.2, 0.3) if dark else (0.0, 0.2, 1.0)
    assert all_angle_z(layer, radii_mm=radii) < 4.5


def test_vanishing_absorption_terminates_without_change_near_source():
    """A half-space without absorption keeps photons for ever; far ones end by roulette here."""
    runs = [
        trace_fiber_profile(
            LayerStack((Layer(inf, sigma_a, 7.5, 0.8, 1.4),)),
            radii_mm=(0.3, 2.0, 7.0),
            photons=8000,
            rng=np.random.default_rng(13 + k),
            threads=2,
        )
        for k, sigma_a in enumerate((1e-5, 1e-12))
    ]
    both = np.hypot(runs[0].stderr, runs[1].stderr)
    difference = runs[1].reflectance_per_mm2 - runs[0].reflectance_per_mm2
    assert np.abs(difference / both).max() < 4.5
    assert np.all(both < 0.3 * runs[0].reflectance_per_mm2)


def test_tissue_that_does_not_scatter_sends_nothing_back():
    clear = LayerStack((Layer(inf, 0.1, 0.0, 0.8, 1.4),))
    run = trace_fiber_profile(
        clear, radii_mm=(0.0, 0.3), photons=1000, rng=np.random.default_rng(15)
    )
    np.testing.assert_array_equal(run.reflectance_per_mm2, 0.0)
    np.testing.assert_array_equal(run.stderr, 0.0)


def test_little_scattering_goes_as_its_amount():
    """Single scattering: half the scatterers, half the light (and 1 % of double scattering)."""
    one, half = (
        trace_fiber_profile(
            LayerStack((Layer(inf, 1.0, sigma_s, 0.0, 1.0),)),
            radii_mm=(0.3,),
            photons=200_000,
            rng=np.random.default_rng(16),
            threads=2,
        )
        for sigma_s in (2e-3, 1e-3)
    )
    ratio = one.reflectance_per_mm2[0] / half.reflectance_per_mm2[0]
    error = ratio * np.hypot(
        one.stderr[0] / one.reflectance_per_mm2[0], half.stderr[0] / half.reflectance_per_mm2[0]
    )
    assert abs(ratio - 2.0) < 4.5 * error + 0.02
    assert error < 0.2


def test_absorbing_film_of_one_micrometer_attenuates_twice():
    """Index matched, parallel light in and a narrow cone out: exp(-2 sigma_a d), nothing else."""
    tissue = Layer(inf, 0.1, 7.5, 0.8, 1.0)
    runs = [
        trace_fiber_profile(
            LayerStack(layers),
            radii_mm=(0.3, 1.3),
            photons=40_000,
            threads=2,
            rng=np.random.default_rng(seed),
            numerical_aperture=0.05,
            source_numerical_aperture=0.0,
        )
        for seed, layers in ((17, (tissue,)), (18, (Layer(0.001, 500.0, 0.0, 0.0, 1.0), tissue)))
    ]
    ratio = runs[1].reflectance_per_mm2 / runs[0].reflectance_per_mm2
    error = ratio * np.hypot(*(run.stderr / run.reflectance_per_mm2 for run in runs))
    assert np.abs((ratio - np.exp(-1.0)) / error).max() < 4.5
    assert error.max() < 0.1


def test_film_of_identical_tissue_changes_nothing():
    tissue = Layer(inf, 0.1, 7.5, 0.8, 1.4)
    runs = [
        trace_fiber_profile(
            LayerStack(layers),
            radii_mm=RADII_MM,
            photons=30_000,
            threads=2,
            rng=np.random.default_rng(seed),
        )
        for seed, layers in ((19, (tissue,)), (20, (Layer(0.001, 0.1, 7.5, 0.8, 1.4), tissue)))
    ]
    difference = runs[1].reflectance_per_mm2 - runs[0].reflectance_per_mm2
    assert np.abs(difference / np.hypot(runs[0].stderr, runs[1].stderr)).max() < 4.5


@pytest.mark.parametrize("stack", [RED, LAYERED])
def test_light_goes_both_ways_alike(stack):
    """Helmholtz: a wide source with a wide cone and a thin fiber, or the fibers exchanged."""
    wide, thin = (0.4, 0.9), (0.1, 0.2)
    runs = [
        trace_fiber_profile(
            stack,
            radii_mm=(0.3, 0.8),
            photons=80_000,
            rng=np.random.default_rng(21 + k),
            core_mm=detector[0],
            numerical_aperture=detector[1],
            source_core_mm=source[0],
            source_numerical_aperture=source[1],
            threads=2,
        )
        for k, (source, detector) in enumerate(((wide, thin), (thin, wide)))
    ]
    difference = runs[1].reflectance_per_mm2 - runs[0].reflectance_per_mm2
    error = np.hypot(runs[0].stderr, runs[1].stderr)
    assert np.abs(difference / error).max() < 4.5
    assert np.all(error < 0.05 * runs[0].reflectance_per_mm2)


@pytest.mark.long
def test_standard_error_matches_scatter_of_repeated_profiles():
    rng = np.random.default_rng(23)
    runs = [trace_fiber_profile(RED, radii_mm=(0.3, 3.3), photons=2000, rng=rng) for _ in range(60)]
    spread = np.var([run.reflectance_per_mm2 for run in runs], axis=0, ddof=1)
    stated = np.mean([run.stderr**2 for run in runs], axis=0)
    # Near normal batches would follow F(59, 60 x 19); tails are heavier, so this alarms at 1e-3.
    low, high = stats.f.ppf([5e-5, 1.0 - 5e-5], 59, 60 * 19)
    assert np.all((low < spread / stated) & (spread / stated < high))


def test_fiber_profile_reaches_one_percent_within_half_minute():
    """Red tissue (sigma_a .04, sigma_s' 1.5), on 2 cores; a margin of 8 was measured."""
    radii = 0.3 + 0.25 * np.arange(27)
    red = LayerStack((Layer(inf, 0.04, 7.5, 0.8, 1.4),))
    begin = time.process_time()
    run = trace_fiber_profile(
        red, radii_mm=radii, photons=20_000, rng=np.random.default_rng(24), batches=100
    )
    seconds = time.process_time() - begin
    worst = (run.stderr / run.reflectance_per_mm2).max()
    assert 0.5 * seconds * (worst / 0.01) ** 2 < 30.0
