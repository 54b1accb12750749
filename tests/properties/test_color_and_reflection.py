"""Spectra, color tables, chromophores, lobes and error measures over their declared domains."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from capture.calibration.color import colorimetry
from model import color_table, merl, metrics, skin_reflectance, spectra
from model.brdf import microfacet
from model.tissue_optics import uncertainty as optics_uncertainty
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores, polarization, tsumura
from reconstruction.chromophores import pixel_checks, shading_prior
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.gradient_normals import lobe_response, sphere_lights
from reconstruction.normal_integration import relief_errors

CHEAP = settings(derandomize=True, deadline=None, max_examples=25, database=None)
FEW = settings(CHEAP, max_examples=10)

SHARE = st.floats(0.0, 1.0)
ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)
FINITE = st.floats(-1e100, 1e100)
VECTOR = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@pytest.fixture(scope="module")
def table():
    return color_table.build(
        "Nikon 5100 (NPL)", "D55", size=32, anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )


def unit(vector):
    length = np.linalg.norm(vector)
    assume(length > 1e-3)
    return np.asarray(vector) / length


@CHEAP
@given(a=VECTOR, b=VECTOR, scale=st.floats(1e-100, 1e100))
def test_angle_ignores_length_and_order(a, b, scale):
    assume(np.linalg.norm(a) > 1e-3)
    assume(np.linalg.norm(b) > 1e-3)
    found = metrics.angular_error_rad(a, b)
    assert 0.0 <= found <= np.pi
    assert metrics.angular_error_rad(b, a) == pytest.approx(float(found), abs=1e-9)
    longer = metrics.angular_error_rad(scale * np.asarray(a), b)
    assert longer == pytest.approx(float(found), abs=1e-9)
    assert np.isnan(metrics.angular_error_rad([0, 0, 0], b))


@CHEAP
@given(
    first=st.tuples(st.floats(0, 100), *[st.floats(-120, 120)] * 2),
    second=st.tuples(st.floats(0, 100), *[st.floats(-120, 120)] * 2),
)
def test_color_difference_is_symmetric_and_zero_to_itself(first, second):
    there = colorimetry.delta_e_2000(first, second)
    assert np.isfinite(there)
    assert there >= 0.0
    assert colorimetry.delta_e_2000(second, first) == pytest.approx(
        float(there), rel=1e-6, abs=1e-9
    )
    assert colorimetry.delta_e_2000(first, first) == 0.0


@CHEAP
@given(lightness=st.floats(0.0, 100.0), b_star=st.floats(1e-300, 100.0))
def test_the_typology_angle_rises_with_lightness(lightness, b_star):
    angle = metrics.individual_typology_angle_deg([lightness, lightness + 1.0], b_star)
    assert np.all((angle >= -90.0) & (angle <= 90.0))
    assert angle[1] >= angle[0]


@CHEAP
@given(values=st.lists(ANY_FLOAT, max_size=30), level=st.floats(0.01, 0.99))
def test_coverage_counts_finite_trials_and_is_within_interval(values, level):
    found = metrics.coverage(values, 1.0, 0.0, level=level)
    assert found.count == int(np.isfinite(values).sum())
    if found.count:
        assert 0.0 <= found.interval[0] <= found.fraction <= found.interval[1] <= 1.0
    else:
        assert np.isnan(found.fraction)


@CHEAP
@given(values=st.lists(ANY_FLOAT, max_size=30), seed=st.integers(0, 99))
def test_median_is_within_its_interval_and_values(values, seed):
    values = np.clip(values, -1e300, 1e300).tolist()
    finite = [v for v in values if np.isfinite(v)]
    rng = np.random.default_rng(seed)
    median, (low, high) = metrics.median_with_interval(values, rng=rng)
    known = [v for v in values if not np.isnan(v)]
    if not known:
        assert np.isnan(median)
    elif len(finite) == len(known):
        assert min(finite) <= low <= high <= max(finite)
        assert min(finite) <= median <= max(finite)


@CHEAP
@given(wavelength=st.lists(st.floats(380.0, 780.0), min_size=1, max_size=5))
@pytest.mark.parametrize(
    "spectrum",
    [
        spectra.hemoglobin_extinction,
        spectra.eumelanin_absorption,
        spectra.pheomelanin_absorption,
        spectra.baseline_absorption,
        spectra.reduced_scattering,
        spectra.color_matching_functions,
    ],
)
def test_spectrum_is_nonnegative_and_evaluates_wavelengths_independently(spectrum, wavelength):
    found = np.asarray(spectrum(wavelength))
    assert np.all(np.isfinite(found) & (found >= 0.0))
    one = np.asarray(spectrum([wavelength[0]]))
    many = found[..., 0] if spectrum is spectra.hemoglobin_extinction else found[0]
    np.testing.assert_array_equal(np.squeeze(one), np.squeeze(many))


@FEW
@given(
    camera=st.sampled_from(spectra.camera_names()),
    light=st.sampled_from(spectra.illuminant_names()),
    level=SHARE,
)
def test_flat_reflectance_has_zero_chroma_under_any_light(camera, light, level):
    found = spectra.band_average(np.full(31, level), camera, light)
    np.testing.assert_allclose(found, level, atol=1e-9)
    weights = spectra.band_weights(camera, light)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-9)
    assert spectra.camera_white(camera, light).max() == pytest.approx(1.0)
    assert np.all(spectra.illuminant(light) >= 0.0)
    assert spectra.camera_sensitivity(camera).shape == (spectra.WAVELENGTH_NM.size, 3)


@FEW
@given(nodes=st.integers(2, 200))
def test_axes_of_color_tables_rise_from_nothing(nodes):
    for axis in color_table.spectral_axes(nodes):
        assert axis[0] == 0.0
        assert np.all(np.diff(axis) > 0.0)


CHROMOPHORES = st.tuples(st.floats(0.005, 0.2), st.floats(0.01, 0.2))


@FEW
@given(truth=CHROMOPHORES)
def test_chromophores_of_a_clean_color_come_back(table, truth):
    rgb = table.lookup(*truth).astype(np.float32)[None, None]
    kept = rgb.copy()
    found = chromophores.invert(rgb, table, shading="known")
    np.testing.assert_array_equal(rgb, kept)
    if found.valid[0, 0]:
        assert found.melanin[0, 0] == pytest.approx(truth[0], rel=0.05)
        assert found.hemoglobin[0, 0] == pytest.approx(truth[1], rel=0.25)
    free = chromophores.invert(0.5 * rgb, table)
    twice = chromophores.invert(rgb, table)
    if free.valid[0, 0] and twice.valid[0, 0]:
        # a shading is no chromophore
        moved = abs(free.melanin[0, 0] - twice.melanin[0, 0])
        assert moved <= 0.3 * twice.stderr_melanin[0, 0]


COLOR = st.lists(
    st.one_of(st.floats(width=32, allow_nan=True, allow_infinity=True), SHARE.map(np.float32)),
    min_size=3,
    max_size=3,
)


@CHEAP
@given(pixels=st.lists(COLOR, min_size=0, max_size=4), free=st.booleans())
def test_chromophores_of_any_pixels_are_numbers_or_masked(table, pixels, free):
    rgb = np.asarray(pixels, np.float32).reshape(1, len(pixels), 3)
    kept = rgb.copy()
    found = chromophores.invert(rgb, table, shading=None if free else "known")
    np.testing.assert_array_equal(rgb, kept)
    for name in ("melanin", "hemoglobin", "stderr_melanin", "stderr_hemoglobin", "residual"):
        assert np.isfinite(getattr(found, name)[found.valid]).all(), name
    assert not found.valid[~np.isfinite(rgb).all(axis=-1)].any()
    weighed = chromophore_posterior.estimate(rgb, table, prior=shading_prior.face_prior())
    assert not weighed.valid[~np.isfinite(rgb).all(axis=-1)].any()
    for name in ("melanin", "hemoglobin", "stderr_melanin", "stderr_hemoglobin"):
        assert np.isfinite(getattr(weighed, name)[weighed.valid]).all(), name


@FEW
@given(noise=st.floats(1e-4, 0.1))
def test_more_noise_leaves_chromophores_less_identifiable(table, noise):
    found = [
        chromophores.compute_identifiability(
            table, shading="known", variance=lambda c, n=n: (n * c) ** 2
        )
        for n in (noise, 2.0 * noise)
    ]
    for name in ("stderr_melanin", "stderr_hemoglobin"):
        fine, coarse = (np.asarray(getattr(each, name), float) for each in found)
        both = np.isfinite(fine) & np.isfinite(coarse)
        assert np.all(coarse[both] >= fine[both] * (1.0 - 1e-6))


@CHEAP
@given(values=st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9))
def test_error_common_to_channels_has_no_color_weight(values):
    root = np.array(values).reshape(3, 3)
    plane = np.eye(3) - 1.0 / 3.0
    covariance = plane @ root @ root.T @ plane + 1e-4 * plane
    found = chromophores.add_brightness_variance(covariance)
    assert np.linalg.eigvalsh(found).min() > 0.0
    # colors without brightness are as uncertain as before
    np.testing.assert_allclose(plane @ found @ plane, covariance, atol=1e-12)
    again = chromophores.model_covariance(covariance, default_noise=False)
    assert np.isfinite(again).all()


@CHEAP
@given(center=st.floats(-2.0, 0.5), spread=st.floats(0.05, 1.0))
def test_lognormal_prior_has_its_mean_and_deviation(center, spread):
    prior = shading_prior.lognormal_prior(np.exp(center), spread)
    assert prior.sd == pytest.approx(spread, rel=0.05)
    assert prior.broaden(1.5).sd >= prior.sd * (1.0 - 1e-9)
    assert np.isfinite(prior.mean)
    assert np.all(np.diff(prior.nodes) > 0.0)


@CHEAP
@given(counts=st.lists(st.integers(0, 1000), min_size=3, max_size=40), low=st.floats(-3.0, 0.0))
def test_shading_prior_mean_is_within_sample_nodes(counts, low):
    assume(sum(counts) > 0)
    prior = shading_prior.prior_from_histogram(low, 0.05, counts)
    assert prior.nodes[0] <= prior.mean <= prior.nodes[-1]


@CHEAP
@given(cosine=st.floats(-1.0, 1.0))
def test_surface_transmittance_is_between_zero_and_all(cosine):
    share = skin_reflectance.transmittance(cosine)
    assert 0.0 <= share <= 1.0


KIND = st.sampled_from(["ggx", "beckmann"])


@FEW
@given(roughness=st.floats(0.05, 1.0), kind=KIND)
def test_facets_cover_the_surface_once(roughness, kind):
    theta = (np.arange(20_000) + 0.5) / 20_000 * np.pi / 2
    cosine, sine = np.cos(theta), np.sin(theta)
    density = microfacet.facet_density(cosine, roughness, kind)
    assert np.all(np.isfinite(density) & (density >= 0.0))
    area = 2.0 * np.pi * np.sum(density * cosine * sine) * np.pi / 2 / theta.size
    assert area == pytest.approx(1.0, rel=1e-3)


@CHEAP
@given(
    light=SHARE,
    view=SHARE,
    half=SHARE,
    turn=SHARE,
    roughness=st.floats(1e-3, 1.0),
    eta=st.floats(1.01, 2.0),
    kind=KIND,
)
def test_lobe_is_reciprocal_and_nonnegative(light, view, half, turn, roughness, eta, kind):
    there, back = (
        microfacet.brdf(a, b, half, turn, roughness=roughness, eta=eta, kind=kind)
        for a, b in ((light, view), (view, light))
    )
    assert np.isfinite(there)
    assert there >= 0.0
    np.testing.assert_allclose(there, back, rtol=1e-9)
    seen = microfacet.visibility(light, view, roughness, kind)
    assert np.isfinite(seen)
    assert seen >= 0.0


@CHEAP
@given(light=VECTOR, view=VECTOR)
def test_half_and_difference_angles_come_back_as_directions(light, view):
    light, view = unit(light), unit(view)
    light[2], view[2] = abs(light[2]), abs(view[2])
    up = np.array([0.0, 0.0, 1.0])
    assume(np.linalg.norm(light + view) > 1e-3)
    angles = merl.to_angles(light, view, up)
    again = merl.to_angles(*merl.to_directions(*angles), up)
    np.testing.assert_allclose(again[:2], angles[:2], atol=1e-6)
    for place, centers in zip(merl.bin_indices(*angles), merl.bin_centers(), strict=True):
        assert 0 <= place < centers.size


@FEW
@given(
    seed=st.integers(0, 999),
    size=st.sampled_from([1, 3, 5, 9]),
    scale=st.sampled_from([1e-30, 1.0, 1e30]),
)
def test_detectability_is_unit_invariant(seed, size, scale):
    rng = np.random.default_rng(seed)
    estimate, stderr = rng.standard_normal((12, 10)), rng.uniform(0.1, 3.0, (12, 10))
    valid = rng.uniform(size=(12, 10)) > 0.2
    first = pixel_checks.is_detectable(estimate, stderr, valid, size_px=size)
    scaled = pixel_checks.is_detectable(scale * estimate, scale * stderr, valid, size_px=size)
    np.testing.assert_array_equal(first, scaled)
    assert first.dtype == bool


@CHEAP
@given(diffuse=st.floats(0.0, 1e6), specular=st.floats(0.0, 1e6))
def test_polarized_images_are_separated_into_their_components(diffuse, specular):
    parallel = np.full((2, 3, 3), specular + 0.5 * diffuse)
    crossed = np.full((2, 3, 3), 0.5 * diffuse)
    found = polarization.separate(parallel, crossed)
    good = found.valid
    np.testing.assert_allclose(found.diffuse[good], diffuse, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.specular[good], specular, rtol=1e-6, atol=1e-9 * diffuse)


@FEW
@given(seed=st.integers(0, 99), scale=st.floats(0.1, 10.0))
def test_independent_components_of_image_are_exposure_invariant(seed, scale):
    rng = np.random.default_rng(seed)
    pigment = rng.uniform(0.1, 1.0, (2, 24, 24))
    absorb = np.array([[0.2, 0.6, 1.1], [0.1, 0.9, 0.4]])
    rgb = np.exp(-np.tensordot(pigment, absorb, axes=(0, 0)))
    valid = np.ones((24, 24), bool)
    found, other = (tsumura.tsumura_ica(k * rgb, valid) for k in (1.0, scale))
    for name in type(found).__slots__:
        value, again = getattr(found, name), getattr(other, name)
        if isinstance(value, np.ndarray) and value.shape[:2] == (24, 24) and value.dtype != bool:
            assert np.isfinite(value).all()
            assert np.isfinite(again).all()


@CHEAP
@given(place=st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), view=VECTOR)
def test_normal_positions_round_trip(place, view):
    at = np.array(place)
    normal = sphere_lights.normal_from_disc(at)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    if normal[2] > 0.05:
        np.testing.assert_allclose(sphere_lights.disc_from_normal(normal), at, atol=1e-6)
    frame = sphere_lights.view_frame(unit(view))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)


RING = sphere_lights.SphereLights(np.concatenate([np.eye(3), -np.eye(3)]))


@CHEAP
@given(
    view=VECTOR,
    eta=st.floats(1.01, 3.9),
    vector=st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    mirror=st.booleans(),
)
@example(view=(0.0, 0.0, 1.0), eta=2.0, vector=(0.0, 0.0, 2.7e-204), mirror=False)
def test_lobe_response_to_lights_is_finite_in_domain(view, eta, vector, mirror):
    across = 1.0 - unit(view)[1] ** 2  # of the analyzer, squared: 1 where it faces the view
    if abs(unit(view)[1]) > 0.9999995:
        with pytest.raises(sphere_lights.SphereLightsError, match="analyzer"):
            lobe_response.facet_reflectance(RING, unit(view), eta)
    else:
        sent = lobe_response.facet_reflectance(RING, unit(view), eta)
        assert sent.shape == (6,)
        assert ((sent >= 0.0) & (sent * across <= 1.0 + 1e-9)).all()
    place, slope = lobe_response.direction_from_moments(np.array([vector]), mirror)
    assert np.hypot(*place[0]) <= 2.0 + 1e-9
    assert np.isfinite(slope).all() or not np.any(vector)


@FEW
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_lobes_of_nonfinite_values_raise_error(bad):
    up = np.array([0.0, 0.0, 1.0])
    with pytest.raises(sphere_lights.SphereLightsError, match="position"):
        sphere_lights.normal_from_disc(np.array([0.1, bad]))
    with pytest.raises(sphere_lights.SphereLightsError, match="normal"):
        sphere_lights.disc_from_normal(np.array([0.1, bad, 1.0]))
    with pytest.raises(sphere_lights.SphereLightsError, match="view"):
        sphere_lights.view_frame([0.0, bad, 1.0])
    with pytest.raises(sphere_lights.SphereLightsError, match="view"):
        sphere_lights.view_frame([0.0, 0.0, 0.0])
    with pytest.raises(sphere_lights.SphereLightsError, match="view"):
        lobe_response.facet_reflectance(RING, np.array([bad, 0.0, 1.0]), 1.4)
    with pytest.raises(sphere_lights.SphereLightsError, match="eta"):
        lobe_response.facet_reflectance(RING, up, bad)
    with pytest.raises(sphere_lights.SphereLightsError, match="vector"):
        lobe_response.direction_from_moments(np.array([[0.0, bad, 1.0]]), True)
    with pytest.raises(sphere_lights.SphereLightsError, match="alpha"):
        lobe_response.specular_response(RING, view=up, alpha=bad, eta=1.4)
    with pytest.raises(sphere_lights.SphereLightsError, match="alpha_stderr"):
        lobe_response.specular_response(RING, view=up, alpha=0.3, eta=1.4, alpha_stderr=bad)
    with pytest.raises(sphere_lights.SphereLightsError, match="eta"):
        lobe_response.diffuse_response(RING, view=up, eta=bad)


@CHEAP
@given(seed=st.integers(0, 999), scale=st.sampled_from([1e-30, 1.0, 1e30]))
def test_topography_model_errors_only_widen_and_scale(seed, scale):
    rng = np.random.default_rng(seed)
    height = (scale * rng.standard_normal((6, 5))).astype(np.float32)
    stderr = (scale * rng.uniform(0.01, 1.0, (6, 5))).astype(np.float32)
    valid = rng.uniform(size=(6, 5)) > 0.3
    found = relief_errors.height_stderr(height, stderr, valid, pixel_um=6.0)
    assert np.all(found >= stderr)
    np.testing.assert_array_equal(found[~valid], stderr[~valid])
    whole = relief_errors.height_stderr(height, stderr, np.ones_like(valid), pixel_um=6.0)
    assert np.isfinite(whole).all()
    normals = rng.standard_normal((6, 5, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    angles = rng.uniform(0.01, 1.0, (6, 5)).astype(np.float32)
    for with_relief in (relief_errors.normal_stderr, relief_errors.diffuse_normal_stderr):
        assert np.all(with_relief(normals, angles, valid) >= angles)
        np.testing.assert_array_equal(with_relief(normals, angles, valid & False), angles)


@CHEAP
@given(wavelength_nm=st.lists(st.floats(380.0, 730.0), min_size=1, max_size=9))
def test_chart_spectra_are_reflectances(wavelength_nm):
    found = colorimetry.chart_spectra(wavelength_nm)
    assert found.shape == (24, len(wavelength_nm))
    assert ((found > 0.0) & (found < 1.0)).all()


@FEW
@given(level=st.floats(0.01, 0.9))
def test_sigma_spectra_surround_the_given_ones(level):
    nodes = optics_uncertainty.COVARIANCE_NODES
    given_spectra = np.full((nodes, nodes, 31), level)
    found = optics_uncertainty.sigma_spectra(given_spectra)
    np.testing.assert_array_equal(found[0], given_spectra)
    product = found[1::2] * found[2::2]  # a step down and a step up of each unknown
    np.testing.assert_allclose(product, level**2, rtol=1e-9)
