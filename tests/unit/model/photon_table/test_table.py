"""The photon table against transport solved otherwise, its scaling laws and its slopes."""

from importlib.resources import files

import numpy as np
import pytest
from scipy.interpolate import BSpline

from model import dipole, photon_table
from model.photon_table import kernels
from model.photon_table import medium as photon_medium
from model.photon_table.disc_distances import distance_rule
from model.tissue_optics import adding_doubling
from rigsim.fiber.profile import trace_fiber_profile
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons

RADII = np.arange(0.3, 7.2, 0.25)
LOG_RADII = np.linspace(np.log(1e-5), np.log(1e4), 4000)


def total(sigma_a, eta, g):
    r = np.exp(LOG_RADII)
    profile = photon_table.reflectance(r, sigma_a, 1.0, eta=eta, g=g)
    return np.trapezoid(2.0 * np.pi * r**2 * profile, LOG_RADII)


def exact_total(sigma_a, eta, g):
    absorption = np.atleast_1d(sigma_a)[:, None]
    scattering, thickness = np.ones_like(absorption), np.full_like(absorption, np.inf)
    return adding_doubling.reflectance(
        absorption, scattering, thickness, eta=eta, anisotropy=g, directions=64
    )


@pytest.mark.parametrize("g", [0.0, 0.3, 0.5, 0.7, 0.8, 0.85, 0.9, 0.95])
@pytest.mark.parametrize("eta", [1.0, 1.1, 1.33, 1.4, 1.6])
def test_ring_total_reflectance_matches_adding_doubling(eta, g):
    # Stated errors of 0.1 to 0.5 % average out over the rings but for what they share. Under
    # strong absorption a fifth comes from 0.02 transport lengths, where the domain begins, or less.
    ratio = np.array([0.001, 0.03, 0.3, 3.0])
    seen = np.array([total(x, eta, g) for x in ratio])
    gap = seen / exact_total(ratio, eta, g).ravel() - 1.0
    assert np.all(np.abs(gap) < (3e-3, 3e-3, 6e-3, 2e-2))


def test_isotropic_media_reflect_the_published_totals(test_data):
    # Within 5e-4 and 4 standard errors; that of the table's total is 0.07 %.
    # Giovanelli 1955 (with the surface's 0.04), Jensen 2001's skin1 by transport at eta 1.3
    assert total(1.0 / 9.0, 1.5, 0.0) + 0.04 == pytest.approx(0.2600, abs=5e-4 + 0.0028 * 0.22)
    for sigma_a, sigma_s, published in (
        (0.032, 0.74, 0.4316),
        (0.17, 0.88, 0.2098),
        (0.48, 1.01, 0.1138),
    ):
        seen = total(sigma_a / sigma_s, 1.3, 0.0)
        assert seen == pytest.approx(published, abs=5e-4 + 0.0028 * seen)
    table = np.loadtxt(
        test_data / "radiative_transfer" / "adding_doubling_semi_infinite.csv",
        delimiter=",",
        skiprows=1,
    )
    rows = table[(table[:, 1] > 1.0) & (table[:, 1] <= 1.6)]
    assert len(rows) > 10
    for albedo, eta, with_surface, _ in rows:
        surface = ((eta - 1.0) / (eta + 1.0)) ** 2
        seen = total((1.0 - albedo) / albedo, float(eta), 0.0)
        assert seen == pytest.approx(with_surface - surface, abs=5e-4 + 0.0028 * seen)


def test_adding_doubling_test_separates_similar_phase_functions():
    assert abs(total(1.0, 1.4, 0.8) / exact_total(1.0, 1.4, 0.0).item() - 1.0) > 0.05


def test_rings_agree_with_the_simulators_own_transport():
    # The simulator's walk and sampler share nothing with the table's; 60 rings and absorptions at
    # 4 standard errors: a false alarm in 260 runs of other seeds.
    edges = np.geomspace(0.03, 12.0, 21)
    rng = np.random.default_rng(7)
    worst = []
    for sigma_a in (0.01, 0.1, 1.0):
        tissue = LayerStack((Layer(np.inf, sigma_a, 5.0, 0.8, 1.4),))
        run = trace_photons(tissue, photons=24_000, rng=rng, ring_edges_mm=edges, batches=60)
        node, weight = np.polynomial.legendre.leggauss(8)
        r = 0.5 * (edges[1:, None] * (1 + node) + edges[:-1, None] * (1 - node))
        at = photon_table.reflectance(r, sigma_a, 1.0)
        power = np.sum(at * 2.0 * np.pi * r * weight, axis=1) * 0.5 * np.diff(edges)
        stated = power * photon_table.relative_error(r[:, 4], sigma_a, 1.0)
        error = np.hypot(run.ring_reflectance_stderr, np.where(np.isfinite(stated), stated, 0.0))
        seen = run.ring_reflectance > 20.0 / run.photons  # Gaussian errors need some photons
        worst.append((power - run.ring_reflectance)[seen] / error[seen])
    gaps = np.concatenate(worst)
    assert gaps.size > 35
    assert np.max(np.abs(gaps)) < 4.0
    assert np.max(np.abs(gaps + 0.1 * power[10] / error[10])) > 4.0  # a table 10 % off is found


def fibers(sigma_a, sigma_s, g, photons, rng):
    tissue = LayerStack((Layer(np.inf, sigma_a, sigma_s / (1.0 - g), g, 1.4),))
    return trace_fiber_profile(tissue, radii_mm=tuple(RADII), photons=photons, rng=rng)


def z_scores(run, sigma_a, sigma_s, g, cores=(0.2, 0.2)):
    options = {"collection": "fiber", "g": g}
    table = photon_table.reflectance(
        RADII, sigma_a, sigma_s, core_mm=cores[0], source_core_mm=cores[1], **options
    )
    stated = table * photon_table.relative_error(RADII, sigma_a, sigma_s, **options)
    return (run.reflectance_per_mm2 - table) / np.hypot(run.stderr, stated)


def test_fiber_signals_match_simulated_fibers():
    # Neither walk, scoring in the cone nor averages over the cores are shared. The errors of 20
    # batches follow Student's t with 19 degrees of freedom: beyond 5 once in 400 runs of 28.
    rng = np.random.default_rng(3)
    run = fibers(0.2, 1.5, 0.8, 12_000, rng)
    assert np.max(np.abs(z_scores(run, 0.2, 1.5, 0.8))) < 5.0


@pytest.mark.long
def test_table_of_other_optics_or_cores_is_detected():
    rng = np.random.default_rng(4)
    run = fibers(0.3, 1.5, 0.8, 800_000, rng)
    assert np.max(np.abs(z_scores(run, 0.3, 1.5, 0.8))) < 5.0
    assert np.max(np.abs(z_scores(run, 0.3, 1.5, 0.8, cores=(0.0, 0.6)))) > 5.0


@pytest.mark.parametrize("collection", ["all", "fiber"])
def test_reflectance_is_positive_and_falls_with_absorption(collection):
    radius = np.geomspace(0.02, 50.0, 80)
    absorption = np.concatenate([[0.0], np.geomspace(1e-6, 10.0, 60)])[:, None]
    for eta in (1.0, 1.25, 1.4, 1.6):
        slopes = photon_table.derivatives(radius, absorption, 1.0, eta=eta, collection=collection)
        holds = photon_table.is_in_domain(radius, absorption, 1.0, eta=eta, collection=collection)
        assert np.mean(holds) > 0.6
        assert np.all(slopes.reflectance_per_mm2 > 0.0)
        assert np.all(slopes.by_sigma_a[holds] < 0.0)
        assert np.all(np.diff(slopes.reflectance_per_mm2, axis=0)[holds[1:]] < 0.0)


@pytest.mark.parametrize("collection", ["all", "fiber"])
@pytest.mark.parametrize("cores", [(0.0, 0.0), (0.2, 0.2)])
def test_slopes_are_those_of_the_reflectance(collection, cores):
    options = {"collection": collection, "core_mm": cores[0], "source_core_mm": cores[1]}
    a, s = np.array([[0.003], [0.2], [2.0], [30.0]]), np.array([[0.8], [1.5], [2.0], [1.0]])
    slopes = photon_table.derivatives(RADII, a, s, **options)
    step = 1e-5

    def central(da, ds):
        high = photon_table.reflectance(RADII, a * (1 + da), s * (1 + ds), **options)
        low = photon_table.reflectance(RADII, a * (1 - da), s * (1 - ds), **options)
        return (high - low) / (2.0 * (a * da + s * ds))

    scale = slopes.reflectance_per_mm2
    np.testing.assert_allclose(
        slopes.by_sigma_a * a / scale, central(step, 0.0) * a / scale, rtol=1e-6, atol=1e-7
    )
    np.testing.assert_allclose(
        slopes.by_sigma_s_prime * s / scale, central(0.0, step) * s / scale, rtol=1e-6, atol=1e-7
    )


def test_zero_absorption_slope_is_limit_and_mean_path():
    slope = [photon_table.derivatives(RADII, a, 1.0) for a in (0.0, 1e-9, 1e-7)]
    np.testing.assert_allclose(slope[1].by_sigma_a, slope[0].by_sigma_a, rtol=1e-3)
    path = -slope[0].by_sigma_a / slope[0].reflectance_per_mm2
    assert np.all(path > RADII)  # no light comes by a shorter way


def test_lengths_scale_with_the_scattering():
    plain = photon_table.reflectance(RADII, 0.05, 1.0, core_mm=0.2)
    scaled = photon_table.reflectance(RADII / 4.0, 0.2, 4.0, core_mm=0.05)
    np.testing.assert_allclose(scaled, 16.0 * plain, rtol=1e-12)


def test_rows_of_profiles_equal_single_evaluations(rng):
    a, s = rng.uniform(0.01, 1.0, (5, 2, 1)), rng.uniform(0.5, 3.0, (2, 1))
    options = {"collection": "fiber", "core_mm": 0.2, "source_core_mm": 0.2}
    rows = photon_table.reflectance(RADII, a, s, **options)
    assert rows.shape == (5, 2, RADII.size)
    full = np.broadcast_to(a, rows.shape)
    np.testing.assert_allclose(
        photon_table.reflectance(RADII, full, s, **options), rows, rtol=1e-13
    )
    one = photon_table.reflectance(RADII[3], a[2, 1, 0], s[1, 0], **options)
    assert float(one) == pytest.approx(rows[2, 1, 3], rel=1e-13)


def test_the_kernel_equals_a_spline_of_scipy():
    medium = photon_medium.prepare_medium(1.37, 0.83, "fiber")
    radius, a, s = 2.3, 0.4, 1.7
    x = (np.log(radius * s) - kernels.RADIUS_START) / kernels.RADIUS_STEP
    u = np.sqrt(a / s)
    y = np.log1p(u / kernels.ROOT_SCALE) / kernels.ROOT_STEP
    rows, columns = medium.coefficients.shape
    along = BSpline(np.arange(-3.0, columns + 1), medium.coefficients.T, 3)(y)
    value = float(BSpline(np.arange(-3.0, rows + 1), along, 3)(x))
    kappa = u * float(BSpline(np.arange(-3.0, columns + 1), medium.decay, 3)(y))
    d = np.hypot(radius * s, 1.0)
    expected = s**2 * (1.0 + kappa * d) / d**3 * np.exp(value - kappa * d)
    got = photon_table.reflectance(radius, a, s, eta=1.37, g=0.83, collection="fiber")
    assert float(got) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("radius_mm", [0.0, 0.15, 0.3, 1.0, 4.0])
def test_cores_are_averaged_like_pairs_of_points(radius_mm, rng):
    count = 200_000

    def disc(diameter):
        r = 0.5 * diameter * np.sqrt(rng.random(count))
        return r * np.exp(2j * np.pi * rng.random(count))

    distance = np.abs(radius_mm + disc(0.2) - disc(0.1))
    samples = photon_table.reflectance(distance, 0.1, 2.0)
    averaged = photon_table.reflectance(radius_mm, 0.1, 2.0, core_mm=0.2, source_core_mm=0.1)
    error = samples.std() / np.sqrt(count)
    assert abs(samples.mean() - averaged) < 4.0 * error + 1e-5 * averaged
    if radius_mm == 0.3:
        centre = photon_table.reflectance(0.3, 0.1, 2.0)
        assert abs(samples.mean() - centre) > 4.0 * error


def test_few_distances_do_for_cores():
    for radius in (0.25, 0.3, 0.55, 0.8, 2.05, 7.0):
        node, weight = distance_rule(radius, 0.2, 0.2)
        fine = np.linspace(0.0, np.pi, 2001)
        mean_inverse = np.mean(1.0 / np.hypot(radius - 0.1 * np.cos(fine), 0.1 * np.sin(fine)))
        assert weight.sum() == pytest.approx(1.0, abs=1e-12)
        assert np.all((node > max(0.0, radius - 0.2)) & (node < radius + 0.2))
        assert weight @ node**2 == pytest.approx(radius**2 + 0.01, rel=1e-9)
        assert 1.0 / radius < weight @ (1.0 / node) < mean_inverse * 1.05


def test_far_away_the_profile_falls_like_diffusion():
    radius = np.array([15.0, 20.0, 25.0])
    for a in (0.001, 0.01, 0.03):
        ratio = photon_table.reflectance(radius, a, 1.0) / dipole.reflectance(radius, a, 1.0, 1.4)
        assert np.ptp(ratio) < 0.03 * ratio.mean()


def test_profiles_continue_beyond_table_without_step():
    for edge in (np.exp(kernels.RADIUS_START), np.exp(kernels.RADIUS_START + 9.5)):
        low, high = photon_table.reflectance([edge * 0.999999, edge * 1.000001], 0.1, 1.0)
        assert high == pytest.approx(low, rel=1e-4)
    low, high = photon_table.reflectance(0.5, [15.9999, 16.0001], 1.0)
    assert high == pytest.approx(low, rel=1e-3)
    assert high < low


def test_similar_phase_functions_differ_only_near_source():
    ratio = photon_table.reflectance([0.1, 10.0], 0.01, 1.0, g=0.9) / photon_table.reflectance(
        [0.1, 10.0], 0.01, 1.0, g=0.8
    )
    assert abs(ratio[0] - 1.0) > 0.05
    assert abs(ratio[1] - 1.0) < 0.02


def test_indices_between_the_nodes_are_interpolated():
    nodes = photon_medium._stored()["eta"].astype(float)
    for eta in (1.25, 1.37, 1.45):
        weight = photon_medium._lagrange("eta", nodes, eta)
        assert weight.sum() == pytest.approx(1.0)
        assert weight @ nodes**3 == pytest.approx(eta**3, rel=1e-9)
    others = np.delete(nodes, 4)  # what a cubic over 1.2, 1.3, 1.5, 1.6 makes of 1.4
    weight = photon_medium._lagrange("eta", others, 1.4)
    left_out = sum(
        w * np.log(photon_table.reflectance(RADII, 0.05, 1.0, eta=float(n)))
        for w, n in zip(weight, others, strict=True)
        if w != 0.0
    )
    np.testing.assert_allclose(
        left_out, np.log(photon_table.reflectance(RADII, 0.05, 1.0)), atol=3e-3
    )


def test_stated_errors_are_small_where_fibers_measure():
    for collection in ("all", "fiber"):
        near = photon_table.relative_error(
            np.geomspace(0.3, 10.0, 30), [[0.0], [0.03], [0.3]], 1.0, collection=collection
        )
        assert np.max(near) < 0.01
        assert np.median(near) < 0.003
        assert np.all(photon_table.relative_error(20.0, [0.0, 0.1], 1.0) < 0.01)
    assert photon_table.relative_error(20.0, 8.0, 1.0) == np.inf
    assert photon_table.relative_error(2.0, 1.0, 0.0) == np.inf


def test_the_domain_ends_where_the_table_does():
    holds = photon_table.is_in_domain
    assert holds([0.3, 7.05], 0.05, 1.5).all()
    assert not holds(1.0, 20.0, 1.0)
    assert holds(0.1, 10.0, 1.0)
    assert not holds(0.1, 10.1, 1.0)
    assert not holds([0.001, 100.0], 0.01, 1.0).any()
    assert not holds(1.0, 0.1, 0.0)


def test_extreme_absorption_scattering_and_distance_are_well_defined():
    assert photon_table.reflectance(RADII, 5.0, 0.0).tolist() == [0.0] * RADII.size
    dark = photon_table.reflectance(RADII, 10.0, 1.0)
    assert np.all((dark >= 0.0) & (np.diff(dark, prepend=1.0) <= 0.0))
    for black in ((1e6, 1e-3), (1e300, 1e-300), (1e4, 1.0)):
        assert np.all(np.array(photon_table.derivatives(RADII, *black)) == 0.0)
    assert np.all(np.isfinite(photon_table.derivatives(RADII, 1e-300, 1e6)))
    with pytest.raises(ValueError, match="radius_mm: got 0"):
        photon_table.reflectance(0.0, 0.1, 1.0)
    assert 0.0 < photon_table.reflectance(0.0, 0.1, 1.0, core_mm=0.2) < np.inf
    assert photon_table.reflectance(np.empty((0,)), 0.1, 1.0).shape == (0,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"eta": 1.7}, "eta: got 1.7, expected 1 to 1.6"),
        ({"eta": np.nan}, "eta: got nan"),
        ({"g": 0.99}, "g: got 0.99"),
        ({"collection": "some"}, "collection: got 'some'"),
    ],
)
def test_media_outside_table_are_refused(options, message):
    with pytest.raises(photon_table.TableDomainError, match=message):
        photon_table.reflectance(1.0, 0.1, 1.0, **options)


@pytest.mark.parametrize("arguments", [(-1.0, 0.1, 1.0), (1.0, np.nan, 1.0), (1.0, 0.1, np.inf)])
def test_negative_and_unbounded_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match="_mm: got"):
        photon_table.reflectance(*arguments)


def test_the_table_is_small():
    assert (files("model") / "data" / "photon_table.npz").stat().st_size < 2e6
