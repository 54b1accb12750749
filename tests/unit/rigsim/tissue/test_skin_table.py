"""The skin table against live photons, real skin and its own claims."""

import importlib.util
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from rigsim.tissue import skin_layers, skin_table, skin_transport
from rigsim.tissue.lateral_kernels import GAUSSIAN_SIGMAS_MM, LateralKernels
from rigsim.tissue.skin_layers import PAPER_SKIN, TYPICAL_SKIN, TissueProperties
from rigsim.tissue.skin_table import RING_EDGES_MM, SkinTable, SkinTableError
from rigsim.tissue.skin_transport import TABLE_AXES, SkinTransport, SkinTransportError
from rigsim.tissue.tissue_mc import TransportError, trace_escape_paths, trace_photons

# Wavelength (nm), C_m, C_hd, photons: fair to dark, bloodless to Soret peak, on and off the nodes.
ENTRIES = (
    (400.0, 0.5, 0.32, 2_000_000),
    (420.0, 0.003, 0.003, 240_000),
    (420.0, 0.01, 0.3, 600_000),
    (450.0, 0.06, 0.05, 600_000),
    (540.0, 0.0, 0.02, 60_000),
    (580.0, 0.24, 0.1, 800_000),
    (700.0, 0.02, 0.005, 40_000),
    (700.0, 0.45, 0.0, 400_000),
)
FALSE_ALARM = 1e-4
UNUSUAL = TissueProperties(
    epidermis_mm=0.06,
    basal_melanin_fraction=0.5,
    oxygenation=0.5,
    scattering_per_mm=7.0,
    rayleigh_fraction=0.3,
    scattering_slope=0.7,
    baseline_amplitude=1.5,
    eumelanin_fraction=1.0,
)
TISSUES = (TYPICAL_SKIN, PAPER_SKIN, UNUSUAL)


@pytest.fixture(scope="module")
def table():
    return SkinTable.load()


def traced(entries, *, seed, tissue=TYPICAL_SKIN):
    """Photons traced now, per entry."""
    return [
        trace_photons(
            skin_layers.skin_layer_stack(nm, c_m, c_hd, tissue),
            photons=photons,
            rng=np.random.default_rng([seed, index]),
            batches=40,
            threads=2,
        )
        for index, (nm, c_m, c_hd, photons) in enumerate(entries)
    ]


@pytest.fixture(scope="module", params=TISSUES, ids=["skin", "papers", "unusual"])
def first_four(request):
    return SkinTable.load(request.param), traced(ENTRIES[:4], seed=1, tissue=request.param)


def z_values(table, entries, photons, *, factor=1.0):
    """Live minus tabulated reflectance (times a factor) in standard errors of the difference."""
    scores = []
    for (nm, c_m, c_hd, _), live in zip(entries, photons, strict=True):
        w = int(np.flatnonzero(table.wavelength_nm == nm)[0])
        i = int(np.abs(table.c_m - c_m).argmin())
        j = int(np.abs(table.c_hd - c_hd).argmin())
        relative = table.standard_error[i, j, w] / table.reflectance[i, j, w]
        tabulated = factor * table.spectra(c_m, c_hd)[w]
        error = np.hypot(live.reflectance_stderr, relative * tabulated)
        scores.append((live.reflectance - tabulated) / error)
    return np.array(scores)


def p_value(scores):
    """Two-sided p of the largest score, Student with 39 degrees of freedom, Sidak-corrected."""
    return 1.0 - (1.0 - 2.0 * stats.t.sf(np.abs(scores).max(), 39)) ** scores.size


@pytest.mark.long
def test_table_agrees_with_photons_traced_now(first_four):
    # The very layers of the entry, traced without the table's reweighting. False alarms: 1e-4.
    table, photons = first_four
    assert p_value(z_values(table, ENTRIES[:4], photons)) > FALSE_ALARM


@pytest.mark.long
def test_table_two_percent_off_does_not_agree(first_four):
    table, photons = first_four
    assert p_value(z_values(table, ENTRIES[:4], photons, factor=1.02)) < FALSE_ALARM


@pytest.mark.long
def test_table_of_another_tissue_does_not_agree(first_four):
    table, photons = first_four
    for other in TISSUES:
        if other != table.tissue:
            assert p_value(z_values(SkinTable.load(other), ENTRIES[:4], photons)) < FALSE_ALARM


@pytest.mark.long
@pytest.mark.parametrize("tissue", TISSUES, ids=["skin", "papers", "unusual"])
def test_table_agrees_with_many_photons_traced_now(tissue):
    # Random entries over all ranges, uniform in the cube roots, and the four that the shorter test
    # leaves. False alarms: 1e-4.
    table = SkinTable.load(tissue)
    rng = np.random.default_rng(2)
    drawn = [
        (float(rng.choice(table.wavelength_nm)), 0.5 * u**3, 0.32 * v**3, 150_000)
        for u, v in rng.random((12, 2))
    ]
    entries = (*ENTRIES[4:], *drawn)
    scores = z_values(table, entries, traced(entries, seed=3, tissue=tissue))
    assert p_value(scores) > FALSE_ALARM
    # Neither is the error overstated: sum z^2 is chi-square within 1e-4.
    assert stats.chi2.sf(np.sum(scores**2), scores.size) > FALSE_ALARM
    assert stats.chi2.cdf(np.sum(scores**2), scores.size) > FALSE_ALARM


@pytest.fixture(scope="module")
def recipe():
    path = Path(__file__).parents[4] / "tools" / "make_skin_reflectance.py"
    spec = importlib.util.spec_from_file_location("make_skin_reflectance", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_recipe_makes_the_stored_numbers_from_other_photons(recipe):
    stored = SkinTransport.load()
    made = recipe.simulate(float(TABLE_AXES.scattering[6]), seed=1, scale=0.02, threads=2)
    some = np.s_[::3, ::10, ::9]
    error = np.hypot(made["reflectance_standard_error"][some], stored.standard_error[6][some])
    scores = (made["reflectance"][some] - stored.reflectance[6][some]) / error
    # Forty nodes that share photons; false alarms: below 40 x 7e-5.
    assert np.abs(scores).max() < 4.5
    # The rings hold all but 3e-4 of the light.
    lateral = made["lateral"].sum(axis=-1)
    missing = 1.0 - lateral / made["reflectance"][::3, ::4, ::2]
    assert np.all((missing > -1e-9) & (missing < 1e-3))


def test_recipe_runs_divide_each_estimate_without_gaps(recipe):
    shares = recipe.shares(TABLE_AXES)
    np.testing.assert_allclose(shares.sum(axis=0), 1.0, rtol=1e-12)
    for (traced_depth, _), share in zip(recipe.TRACED_RUNS, shares, strict=True):
        # A run must not be reweighted to less absorption than it had, in either part.
        upper = 1.5 * (1.0 - TABLE_AXES.basal[:, None]) * TABLE_AXES.absorption
        assert np.all(share[upper < traced_depth * (1.0 - 1e-9)] == 0.0)


@pytest.mark.long
def test_interrupted_recipe_resumes_and_ends_with_same_numbers(recipe, tmp_path):
    arguments = ["--photons-scale", "1e-4", "--work", str(tmp_path), "--out"]
    assert recipe.main([*arguments, str(tmp_path / "whole.npz")]) == 0
    parts = sorted(tmp_path.glob("*/*.npz"))
    assert len(parts) == TABLE_AXES.scattering.size
    kept = {part: part.stat().st_mtime_ns for part in parts[1:]}
    parts[0].unlink()
    assert recipe.main([*arguments, str(tmp_path / "resumed.npz")]) == 0
    assert {part: part.stat().st_mtime_ns for part in kept} == kept
    with np.load(tmp_path / "whole.npz") as whole, np.load(tmp_path / "resumed.npz") as resumed:
        for name in set(whole.files) - {"provenance"}:
            np.testing.assert_array_equal(whole[name], resumed[name])


def test_standard_errors_stay_within_documented_limits(table):
    relative = table.standard_error / table.reflectance
    middle = (table.reflectance > 0.1) & (table.reflectance < 0.5)
    assert np.median(relative[middle]) < 0.002
    assert np.quantile(relative[middle], 0.95) < 0.003
    assert relative.max() < 0.0075


def test_table_covers_the_ranges_and_the_visible(table):
    np.testing.assert_array_equal(table.wavelength_nm, np.arange(400.0, 701.0, 10.0))
    assert (table.c_m[0], table.c_m[-1]) == (0.0, 0.5)
    assert (table.c_hd[0], table.c_hd[-1]) == (0.0, 0.32)
    np.testing.assert_allclose(np.diff(np.cbrt(table.c_m), 2), 0.0, atol=1e-12)
    assert table.reflectance.min() > 0.0
    assert table.reflectance.max() < 1.0


def test_table_was_made_with_the_constants_of_today():
    found = SkinTransport.load().provenance
    assert found["g"] == skin_layers.SKIN_ANISOTROPY
    assert found["eta"] == skin_layers.ETA
    assert found["dermis_scattering_ratio"] == skin_layers.DERMIS_SCATTERING_RATIO
    assert found["basal_thickness_fraction"] == skin_layers.BASAL_THICKNESS_FRACTION
    for axes, name in ((TABLE_AXES, "axes"), (skin_transport.LATERAL_AXES, "lateral_axes")):
        for axis, nodes in found[name].items():
            np.testing.assert_allclose(getattr(axes, axis), nodes, rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"epidermis_mm": 0.01}, "epidermis_mm"),
        ({"basal_melanin_fraction": 0.9}, "basal_melanin_fraction"),
        ({"oxygenation": np.nan}, "oxygenation"),
        ({"scattering_per_mm": -1.0}, "scattering_per_mm"),
    ],
)
def test_properties_outside_their_ranges_are_refused(change, field):
    with pytest.raises(TransportError, match=f"^{field}: expected "):
        TissueProperties(**change)


def test_properties_beyond_the_table_are_refused():
    with pytest.raises(SkinTransportError, match="scattering depth: got"):
        SkinTable.load(TissueProperties(epidermis_mm=0.4, scattering_per_mm=20.0))


def test_basal_melanin_reflects_more_than_even_melanin():
    even, basal = (
        SkinTable.load(TissueProperties(basal_melanin_fraction=share)).spectra(0.05, 0.01)
        for share in (1.0 / 3.0, 0.55)
    )
    assert np.all(basal > even)


def test_spectra_pass_through_the_nodes(table):
    c_m, c_hd = np.meshgrid(table.c_m, table.c_hd, indexing="ij")
    np.testing.assert_allclose(table.spectra(c_m, c_hd), table.reflectance, rtol=1e-12)


def test_more_of_either_chromophore_is_never_brighter(table):
    many = np.linspace(0.0, 1.0, 1201) ** 3
    some = np.linspace(0.0, 1.0, 37) ** 3
    by_melanin = table.spectra(0.5 * many[:, None], 0.32 * some)
    by_blood = table.spectra(0.5 * some[:, None], 0.32 * many)
    assert np.all(np.diff(by_melanin, axis=0) < 0.0)
    # In the darkest skin blood changes R by less than the table's float32 can hold.
    assert np.all(np.diff(by_blood, axis=1) <= 1e-9 * by_blood[:, 1:])
    assert np.all(np.diff(by_blood[:25], axis=1) < 0.0)


@pytest.mark.parametrize("nm", [420.0, 540.0, 700.0])
def test_interpolation_between_nodes_is_exact_to_3e_4(nm):
    # The same photons, reweighted at nodes and at cell centres: the difference holds no noise.
    nodes = 41
    at = (np.arange(nodes - 1) + 0.5) / (nodes - 1)
    u = np.concatenate([np.linspace(0.0, 1.0, nodes), at])
    base, melanin, blood = (
        np.array([layer.sigma_a_per_mm for layer in skin_layers.skin_layer_stack(nm, *c).layers])
        for c in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.32))
    )
    paths = trace_escape_paths(
        skin_layers.skin_layer_stack(nm, 0.0, 0.0), photons=20_000, rng=np.random.default_rng(4)
    )
    live = np.zeros((u.size, u.size))
    for batch in paths:
        by_m = np.exp(-np.outer(u**3, batch.path_mm @ (melanin - base)))
        by_h = np.exp(-np.outer(u**3, batch.path_mm @ (blood - base)))
        live += (by_m * batch.weight) @ by_h.T
    patches = skin_table._hermite_patches(np.log(live[:nodes, :nodes, None]))
    x, y = np.meshgrid(at, at, indexing="ij")
    out = np.empty((x.size, 1))
    skin_table._interpolate_f64(patches, x.ravel(), y.ravel(), out)
    error = out.reshape(x.shape) / live[nodes:, nodes:] - 1.0
    assert np.abs(error).max() < 3e-4
    assert np.sqrt(np.mean(error**2)) < 3e-5


def test_leading_axes_broadcast_and_inputs_stay_untouched(table):
    rng = np.random.default_rng(5)
    c_m, c_hd = 0.5 * rng.random((3, 1)), 0.32 * rng.random(4)
    before = c_m.copy(), c_hd.copy()
    spectra = table.spectra(c_m, c_hd)
    assert spectra.shape == (3, 4, 31)
    for i in range(3):
        for j in range(4):
            np.testing.assert_array_equal(spectra[i, j], table.spectra(c_m[i, 0], c_hd[j]))
    np.testing.assert_array_equal(c_m, before[0])
    np.testing.assert_array_equal(c_hd, before[1])


def test_single_precision_stays_single_and_reaches_the_rim(table):
    spectrum = table.spectra(np.float32(0.5), np.float32(0.32))
    assert spectrum.dtype == np.float32
    np.testing.assert_allclose(spectrum, table.spectra(0.5, 0.32), rtol=1e-6)


@pytest.mark.parametrize(
    ("c_m", "c_hd", "field"),
    [(-1e-6, 0.1, "c_m"), (0.51, 0.1, "c_m"), (0.1, 0.33, "c_hd"), (0.1, np.nan, "c_hd")],
)
def test_fractions_outside_the_table_are_refused_by_name(table, c_m, c_hd, field):
    with pytest.raises(SkinTableError, match=f"^{field}: expected volume fractions"):
        table.spectra([0.1, c_m], c_hd)


def test_arrays_of_the_shared_table_are_read_only(table):
    for field in fields(table):
        value = getattr(table, field.name)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable


def forearm_misfit(table):
    """Return fractions, and the root mean square and largest misfit of the mean of 100 forearms.

    Specular included: Cooksey, Allen, Tsai 2017, doi:10.18434/M38597.
    """
    nm = [400.0, 450.0, 500.0, 540.0, 560.0, 575.0, 600.0, 650.0, 700.0]
    forearms = np.array([0.185, 0.252, 0.328, 0.317, 0.323, 0.327, 0.447, 0.557, 0.602])

    def residual(roots):
        spectrum = table.spectra(roots[0] ** 3, roots[1] ** 3)
        return np.interp(nm, table.wavelength_nm, spectrum) + 0.028 - forearms

    fit = least_squares(residual, [0.3, 0.2], bounds=([0.0, 0.0], [0.79, 0.68]))
    return fit.x**3, np.sqrt(np.mean(fit.fun**2)), np.abs(fit.fun).max()


def test_table_spectrum_fits_real_skin(table):
    (c_m, c_hd), rms, worst = forearm_misfit(table)
    assert 0.01 < c_m < 0.03
    assert 0.003 < c_hd < 0.02
    assert rms < 0.02
    assert worst < 0.04
    # The papers' thick epidermis does not fit.
    assert forearm_misfit(SkinTable.load(PAPER_SKIN))[1] > 1.5 * rms


def band_weights():
    """Three smooth bands, red, green and blue, columns summing to 1."""
    nm = np.arange(400.0, 701.0, 10.0)[:, None]
    bands = np.exp(-0.5 * ((nm - [600.0, 540.0, 460.0]) / 30.0) ** 2)
    return bands / bands.sum(axis=0)


def test_kernels_hold_all_light_and_red_spreads_farthest(table):
    kernels = table.lateral_kernels(0.01, 0.03, band_weights())
    areas = np.pi * np.diff(kernels.ring_edges_mm**2)
    np.testing.assert_allclose((kernels.density_per_mm2 * areas).sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(kernels.encircled[:, -1], 1.0, rtol=1e-12)
    assert np.all(np.diff(kernels.encircled, axis=1) >= 0.0)
    assert kernels.rms_mm[0] > kernels.rms_mm[1] > kernels.rms_mm[2]


def test_melanin_and_blood_narrow_the_kernels(table):
    rms = [
        table.lateral_kernels(c_m, c_hd, band_weights()).rms_mm
        for c_m, c_hd in ((0.0, 0.01), (0.0, 0.1), (0.2, 0.1))
    ]
    assert np.all(rms[0] > rms[1])
    assert np.all(rms[1] > rms[2])


def test_channel_weights_wavelengths_by_reflected_light(table):
    c_m, c_hd = 0.01, 0.05
    pair = np.zeros((31, 1))
    pair[[14, 20], 0] = 0.5
    mixed = table.lateral_kernels(c_m, c_hd, pair).density_per_mm2[0]
    alone = table.lateral_kernels(c_m, c_hd).density_per_mm2
    share = table.spectra(c_m, c_hd)[[14, 20]]
    np.testing.assert_allclose(mixed, share / share.sum() @ alone[[14, 20]], rtol=1e-12)


LIVE_KERNELS = (
    (420.0, 0.003, 0.01, 100_000),
    (540.0, 0.003, 0.03, 100_000),
    (600.0, 0.04, 0.06, 200_000),
    (700.0, 0.1, 0.1, 200_000),
)


def excess_deviation(table, batches, c_m, c_hd, *, tabulated_nm):
    """Largest deviation of the encircled fraction from a live run, less what noise explains.

    Noise: Kolmogorov's bound, 2.23 / sqrt(n) with a false-alarm rate of 1e-4, for the effective
    numbers of photons of the live run and of the table.
    """
    weight = np.concatenate([batch.weight for batch in batches])
    radius = np.concatenate([batch.radius_mm for batch in batches])
    live = np.cumsum(np.histogram(radius, RING_EDGES_MM, weights=weight)[0]) / weight.sum()
    w = int(np.flatnonzero(table.wavelength_nm == tabulated_nm)[0])
    i, j = np.abs(table.c_m - c_m).argmin(), np.abs(table.c_hd - c_hd).argmin()
    table_noise = table.standard_error[i, j, w] / table.reflectance[i, j, w]
    noise = 2.23 * np.hypot(np.sqrt((weight**2).sum()) / weight.sum(), table_noise)
    return np.abs(table.lateral_kernels(c_m, c_hd).encircled[w] - live).max() - noise


@pytest.mark.long
@pytest.mark.parametrize(("nm", "c_m", "c_hd", "photons"), LIVE_KERNELS)
def test_kernels_agree_with_photons_of_their_wavelength(table, nm, c_m, c_hd, photons):
    # Interpolation between nodes is off by 0.0021 of the light at most (420 nm, no noise).
    live = trace_escape_paths(
        skin_layers.skin_layer_stack(nm, c_m, c_hd),
        photons=photons,
        rng=np.random.default_rng(6),
        threads=2,
    )
    assert excess_deviation(table, live, c_m, c_hd, tabulated_nm=nm) < 0.0025
    # those of another wavelength do not agree
    other = {420.0: 450.0, 540.0: 500.0, 600.0: 640.0, 700.0: 600.0}[nm]
    assert excess_deviation(table, live, c_m, c_hd, tabulated_nm=other) > 0.0025


def test_gaussians_approximate_kernels_within_two_percent(table):
    for c_m, c_hd in ((0.0, 0.0), (0.01, 0.03), (0.05, 0.1), (0.5, 0.32)):
        kernels = table.lateral_kernels(c_m, c_hd, band_weights())
        fit = kernels.gaussians()
        assert fit.weights.shape == (3, len(GAUSSIAN_SIGMAS_MM))
        assert np.all(fit.weights >= 0.0)
        np.testing.assert_allclose(fit.weights.sum(axis=1), 1.0, rtol=1e-12)
        assert fit.worst_encircled.max() < 0.02
        rms = np.sqrt(2.0 * fit.weights @ fit.sigmas_mm**2)
        np.testing.assert_allclose(rms, kernels.rms_mm, rtol=0.1)


def test_malformed_requests_for_kernels_are_refused(table):
    with pytest.raises(SkinTableError, match=r"band_weights: expected .*shape \(31, channels\)"):
        table.lateral_kernels(0.1, 0.1, np.ones((30, 3)))
    with pytest.raises(SkinTableError, match="c_m"):
        table.lateral_kernels(0.6, 0.1)
    with pytest.raises(ValueError, match="rings: expected shape"):
        LateralKernels.from_rings([0.0, 1.0], [[1.0, 2.0]])
    with pytest.raises(ValueError, match="some in every channel"):
        LateralKernels.from_rings([0.0, 1.0], [[0.0]])
    with pytest.raises(ValueError, match="sigmas_mm"):
        table.lateral_kernels(0.1, 0.1).gaussians([0.0, 1.0])
