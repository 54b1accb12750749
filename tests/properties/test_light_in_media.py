"""Diffusion, dipole, photon table and layers, driven over all that their docstrings admit."""

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from model import dipole, fresnel, spectra, tissue_optics
from model.dipole import direct_sum as dipole_sum
from model.dipole import gather as dipole_gather
from model.dipole import kienle_patterson as diffusion
from model.photon_table import disc_distances
from model.photon_table import medium as photon_medium
from model.photon_table import table as photon_table
from model.tissue_optics import adding_doubling, discrete_ordinates, layered_diffusion

CHEAP = settings(derandomize=True, deadline=None, max_examples=25, database=None)
FEW = settings(CHEAP, max_examples=10)

ETA = st.floats(1.0, 1.6)
ANY_SIZE = st.floats(0.0, 1e100)  # subnormals among them
USUAL = st.floats(1e-6, 1e3)
SHARE = st.floats(0.0, 1.0)
TABLE_G = st.floats(
    float(photon_medium.stored_asymmetries()[0]), float(photon_medium.stored_asymmetries()[-1])
)


@CHEAP
@given(cosine=SHARE, eta=st.floats(0.5, 3.0))
def test_a_surface_reflects_between_nothing_and_all(cosine, eta):
    found = fresnel.reflectance(np.array([cosine, 1.0, 0.0]), eta)
    assert np.all((found >= 0.0) & (found <= 1.0))
    # the same for both ways along one ray: Stokes' reversibility
    sine = np.sqrt(1.0 - cosine**2) / eta
    assume(sine < 1.0 - 1e-9)
    there = fresnel.reflectance(cosine, eta)
    back = fresnel.reflectance(np.sqrt(1.0 - sine**2), 1.0 / eta)
    assert abs(there - back) < 1e-6
    assert fresnel.normal_reflectance(eta) == pytest.approx(float(found[1]), abs=1e-12)


@CHEAP
@given(eta=st.floats(1.0, 3.0))
def test_diffuse_light_meets_same_surface_from_both_sides(eta):
    inside, outside = fresnel.diffuse_internal(eta), fresnel.diffuse_external(eta)
    assert -1e-12 <= outside <= inside + 1e-12 < 1.0
    assert 1.0 - inside == pytest.approx((1.0 - outside) / eta**2, rel=1e-9)
    assert 0.0 <= fresnel.diffuse_internal_flux_moment(eta) <= inside + 1e-12
    assert fresnel.boundary_factor(eta) == pytest.approx((1 + inside) / (1 - inside), rel=1e-9)
    assert 0.0 <= diffusion.effective_reflection(eta) < 1.0
    assert diffusion.image_depth(eta) >= 1.0 + 4.0 / 3.0 - 1e-9
    fluence, flux = diffusion.exit_coefficients(eta)
    assert 0.0 < fluence <= 0.25 + 1e-9
    assert 0.0 < flux <= 0.5 + 1e-9


@CHEAP
@given(radius=ANY_SIZE, sigma_a=ANY_SIZE, sigma_s=ANY_SIZE, eta=ETA)
@pytest.mark.parametrize("model", [dipole.reflectance, diffusion.reflectance])
def test_profile_is_finite_nonnegative_for_any_size(model, radius, sigma_a, sigma_s, eta):
    found = model(radius, sigma_a, sigma_s, eta)
    assert np.isfinite(found)
    assert found >= 0.0


@CHEAP
@given(radius=st.floats(0.0, 50.0), sigma_a=USUAL, sigma_s=USUAL, eta=ETA, scale=USUAL)
@pytest.mark.parametrize("model", [dipole.reflectance, diffusion.reflectance])
def test_a_profile_scales_with_the_length(model, radius, sigma_a, sigma_s, eta, scale):
    found = model(radius, sigma_a, sigma_s, eta)
    scaled = model(radius / scale, sigma_a * scale, sigma_s * scale, eta)
    np.testing.assert_allclose(scaled, found * scale**2, rtol=1e-6, atol=1e-290)


@CHEAP
@given(sigma_a=USUAL, sigma_s=USUAL, eta=ETA)
@pytest.mark.parametrize("model", [dipole.reflectance, diffusion.reflectance])
def test_a_profile_falls_with_the_distance_and_broadcasts(model, sigma_a, sigma_s, eta):
    radius = np.array([[0.0], [0.3], [2.0], [9.0]], np.float32)
    kept = radius.copy()
    found = model(radius, np.full(3, sigma_a), sigma_s, eta)
    assert found.shape == (4, 3)
    assert np.all(np.diff(found, axis=0) <= 0.0)
    np.testing.assert_array_equal(radius, kept)
    one_by_one = [[model(float(r), sigma_a, sigma_s, eta) for _ in range(3)] for r in radius[:, 0]]
    np.testing.assert_allclose(found, one_by_one, rtol=1e-12)
    assert model(np.empty((0, 1)), np.full(3, sigma_a), sigma_s, eta).shape == (0, 3)


@CHEAP
@given(bad=st.sampled_from([-1.0, -5e-324, np.nan, np.inf, 1e301]), place=st.integers(0, 2))
@pytest.mark.parametrize(
    "model",
    [dipole.reflectance, diffusion.reflectance, diffusion.derivatives, photon_table.reflectance],
)
def test_profile_of_impossible_medium_raises_error(model, bad, place):
    # the table's media may be as black as they like: nothing comes back
    assume(not (bad == 1e301 and place == 1 and model is photon_table.reflectance))
    values = [1.0, 0.1, 1.0]
    values[place] = bad
    more = () if model is photon_table.reflectance else (1.4,)
    with pytest.raises(ValueError):
        model(*values, *more)


@CHEAP
@given(radius=st.floats(0.05, 20.0), sigma_a=st.floats(1e-4, 1.0), sigma_s=st.floats(0.3, 5.0))
@pytest.mark.parametrize("model", [diffusion, photon_table])
def test_derivatives_are_those_of_the_profile(model, radius, sigma_a, sigma_s):
    more = () if model is photon_table else (1.4,)
    slopes = model.derivatives(radius, sigma_a, sigma_s, *more)
    for found, step in (
        (slopes.by_sigma_a, (1e-5 * sigma_a, 0.0)),
        (slopes.by_sigma_s_prime, (0.0, 1e-5)),
    ):
        high = model.reflectance(radius, sigma_a + step[0], sigma_s + step[1], *more)
        low = model.reflectance(radius, sigma_a - step[0], sigma_s - step[1], *more)
        expected = (high - low) / (2.0 * sum(step))
        scale = abs(float(model.reflectance(radius, sigma_a, sigma_s, *more))) / sum(step) * 1e-9
        np.testing.assert_allclose(found, expected, rtol=2e-3, atol=max(scale, 1e-300))


@CHEAP
@given(albedo=SHARE, eta=ETA)
def test_total_reflectance_comes_back_from_its_inverse(albedo, eta):
    r_d = dipole.total_reflectance(np.array([albedo, 0.0, 1.0]), eta)
    assert np.all((r_d >= 0.0) & (r_d <= 1.0))
    assert r_d[1] == 0.0
    assert r_d[2] == 1.0
    again = dipole.total_reflectance(dipole.invert_total_reflectance(r_d, eta), eta)
    np.testing.assert_allclose(again, r_d, atol=1e-7)
    deficit = dipole.invert_to_deficit(r_d, eta)
    np.testing.assert_allclose(dipole.absorbed_fraction(deficit, eta), 1.0 - r_d, atol=1e-9)


@CHEAP
@given(r_d=st.floats(allow_nan=True, allow_infinity=True), eta=ETA)
def test_inverse_is_masked_exactly_where_unreachable(r_d, eta):
    outlier = dipole.is_outlier([r_d])
    for invert in (dipole.invert_total_reflectance, dipole.invert_to_deficit):
        found = invert(np.array([r_d]), eta)
        np.testing.assert_array_equal(np.isnan(found), outlier)
        if outlier[0]:
            with pytest.raises(dipole.ReflectanceOutlierError):
                invert(r_d, eta)
        else:
            assert 0.0 <= found[0] <= 1.0


@CHEAP
@given(sigma_a=st.floats(1e-8, 1e3), sigma_s=st.floats(0.0, 1e3))
def test_coefficients_come_back_from_albedo_and_translucency(sigma_a, sigma_s):
    deficit = sigma_a / (sigma_a + sigma_s)
    found = dipole.coefficients(deficit, dipole.effective_transport(sigma_a, sigma_s))
    np.testing.assert_allclose(found[0], sigma_a, rtol=1e-9)
    np.testing.assert_allclose(found[1], sigma_s, rtol=1e-9, atol=1e-9 * sigma_a)


@CHEAP
@given(sigma_a=st.floats(0.0, 1e300), sigma_s=st.floats(0.0, 1e300))
def test_effective_transport_of_any_medium_is_a_number(sigma_a, sigma_s):
    found = float(dipole.effective_transport(sigma_a, sigma_s))
    assert np.isfinite(found)
    assert found >= np.sqrt(3.0) * sigma_a * (1.0 - 1e-12)


@CHEAP
@given(
    radius=st.floats(1e-3, 200.0),
    sigma_a=st.floats(0.0, 50.0),
    sigma_s=st.floats(0.0, 50.0),
    eta=ETA,
    g=TABLE_G,
    collection=st.sampled_from(["all", "fiber"]),
)
@example(radius=1.0, sigma_a=1.0, sigma_s=2.2e-311, eta=1.4, g=0.0, collection="all")
def test_photon_table_is_finite_and_reports_validity(radius, sigma_a, sigma_s, eta, g, collection):
    told = {"eta": eta, "g": g, "collection": collection}
    value = photon_table.reflectance(radius, sigma_a, sigma_s, **told)
    assert np.isfinite(value)
    assert value >= 0.0
    error = photon_table.relative_error(radius, sigma_a, sigma_s, **told)
    inside = photon_table.is_in_domain(radius, sigma_a, sigma_s, **told)
    assert not np.isnan(error)
    if inside:
        assert error <= 0.03
        assert value > 0.0
    slopes = photon_table.derivatives(radius, sigma_a, sigma_s, **told)
    np.testing.assert_allclose(slopes.reflectance_per_mm2, value, rtol=1e-12)
    assert np.isfinite([slopes.by_sigma_a, slopes.by_sigma_s_prime]).all()


@CHEAP
@given(
    radius=st.floats(0.5, 10.0),
    sigma_a=st.floats(0.0, 0.5),
    sigma_s=st.floats(0.5, 3.0),
    scale=st.floats(0.5, 2.0),
)
def test_the_photon_table_scales_with_the_length(radius, sigma_a, sigma_s, scale):
    found = photon_table.reflectance(radius, sigma_a, sigma_s)
    scaled = photon_table.reflectance(radius / scale, sigma_a * scale, sigma_s * scale)
    np.testing.assert_allclose(scaled, found * scale**2, rtol=1e-9)


@CHEAP
@given(
    radius=st.floats(1e-50, 1e50),
    sigma_a=st.floats(0.0, 1e50),
    sigma_s=st.floats(0.0, 1e50),
    core=st.one_of(st.just(0.0), st.floats(0.0, 1e50)),
)
@example(radius=1e50, sigma_a=0.0, sigma_s=1e50, core=0.0)
@example(radius=1e-50, sigma_a=1e50, sigma_s=1e50, core=0.0)
@example(radius=1.0, sigma_a=5e-324, sigma_s=5e-324, core=1e50)
@example(radius=1.0, sigma_a=0.0, sigma_s=5e-324, core=0.0)
@example(radius=1e-50, sigma_a=0.0, sigma_s=4.757e-289, core=0.0)
@example(radius=1e-50, sigma_a=0.0, sigma_s=1e-100, core=0.0)
@example(radius=1e-50, sigma_a=1e50, sigma_s=1e-100, core=0.0)
@example(radius=1e50, sigma_a=0.0, sigma_s=1e-100, core=0.0)
def test_photon_table_is_finite_far_beyond_rings(radius, sigma_a, sigma_s, core):
    slopes = photon_table.derivatives(radius, sigma_a, sigma_s, core_mm=core)
    assert slopes.reflectance_per_mm2 >= 0.0
    assert np.isfinite(slopes).all()


@CHEAP
@given(bad=st.sampled_from([0.0, 5e-324, 1e-60]))
def test_no_table_has_the_pole_of_a_point(bad):
    with pytest.raises(ValueError, match="radius_mm"):
        photon_table.reflectance([1.0, bad], 0.1, 1.0)


@CHEAP
@given(bad=st.sampled_from([np.nan, -1.0, -5e-324, np.inf]), place=st.integers(0, 2))
def test_layers_of_impossible_medium_raise_error(bad, place):
    values = [np.array([[0.1, 0.2]]), np.array([[1.0, 2.0]]), np.array([[1.0, 2.0]])]
    values[place][0, 0] = bad
    assume(place != 2 or bad != np.inf)
    with pytest.raises(ValueError, match=("sigma_a", "sigma_s", "thickness")[place]):
        adding_doubling.reflectance(*values)
    with pytest.raises(ValueError, match=("sigma_a", "sigma_s", "thickness")[place]):
        layered_diffusion.reflectance(*values)


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -500.0, 1e308]))
@pytest.mark.parametrize(
    "of",
    [
        spectra.eumelanin_absorption,
        spectra.pheomelanin_absorption,
        spectra.baseline_absorption,
        spectra.reduced_scattering,
        spectra.color_matching_functions,
        lambda nm: spectra.illuminant("D65", nm),
        lambda nm: spectra.camera_sensitivity("Nikon 5100 (NPL)", nm),
    ],
)
def test_impossible_wavelength_raises_error(of, bad):
    with pytest.raises(ValueError, match="wavelength_nm"):
        of(np.array([500.0, bad]))


@FEW
@given(tiny=st.sampled_from([5e-324, 1e-300, 1e-46]))
def test_dipole_gather_of_negligible_areas_sends_no_light(tiny):
    place = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    light, at = np.ones((3, 3)), np.array([[0.5, 0.5, 0.0]])
    told = dipole_gather.exitance(place, np.array([1.0, tiny, 1.0]), light, at, 0.5, 1.0)
    bare = dipole_gather.exitance(place, np.array([1.0, 0.0, 1.0]), light, at, 0.5, 1.0)
    np.testing.assert_allclose(told, bare, rtol=1e-6)
    none = dipole_gather.exitance(place, np.full(3, tiny), light, at, 0.5, 1.0)
    assert np.isfinite(none).all()


@CHEAP
@given(eta=st.sampled_from([np.nan, np.inf, -1.0, 0.0, -np.inf]))
@pytest.mark.parametrize(
    "average",
    [
        fresnel.normal_reflectance,
        fresnel.boundary_factor,
        fresnel.diffuse_internal,
        fresnel.diffuse_external,
        fresnel.diffuse_internal_flux_moment,
        lambda eta: fresnel.reflectance(0.5, eta),
        lambda eta: discrete_ordinates.quadrature(eta, 4),
    ],
)
def test_impossible_refractive_index_raises_error(average, eta):
    with pytest.raises(ValueError, match="eta"):
        average(eta)


@CHEAP
@given(eta=st.floats(1.0, 1.79e308))
def test_averages_of_any_index_are_finite_or_refused(eta):
    assert 0.0 <= fresnel.reflectance(0.3, eta) <= 1.0
    assert 0.0 <= fresnel.reflectance(0.3, 1.0 / eta) <= 1.0
    if eta > fresnel.MAX_INDEX:
        with pytest.raises(ValueError, match="eta"):
            fresnel.boundary_factor(eta)
    else:
        assert np.isfinite(fresnel.boundary_factor(eta))


@FEW
@given(eta=st.one_of(st.floats(-1.0, 0.99), st.floats(1.61, 5.0), st.just(np.nan)))
def test_photon_table_refuses_index_outside_table(eta):
    with pytest.raises(photon_medium.TableDomainError):
        photon_medium.prepare_medium(eta, 0.8, "all")
    with pytest.raises(photon_medium.TableDomainError):
        photon_medium.prepare_medium(1.4, eta - 3.0, "all")


@CHEAP
@given(bad=st.sampled_from([0.0, 5e-324, -1.0, 1e301, np.nan, np.inf]))
def test_asymptotic_decay_in_invalid_medium_is_refused(bad):
    with pytest.raises(ValueError, match="absorption_ratio"):
        photon_medium.asymptotic_decay(bad, 0.8)
    with pytest.raises(ValueError, match="g: "):
        photon_medium.asymptotic_decay(1.0, 1.0 if 0.0 <= bad < 1.0 else bad)


@CHEAP
@given(ratio=st.floats(1e-8, 1e3), g=TABLE_G)
def test_distant_light_decays_between_absorption_and_diffusion(ratio, g):
    decay = float(photon_medium.asymptotic_decay(ratio, g))
    # in units of sigma_s': never faster than a straight ray is attenuated
    assert 0.0 < decay <= (ratio + 1.0 / (1.0 - g)) * (1.0 + 1e-4)
    assert decay >= ratio * (1.0 - 1e-9)
    assert np.all(np.isfinite(photon_medium.decay_coefficients(g)))


@CHEAP
@given(radius=st.floats(0.0, 1e3), core=st.floats(0.0, 5.0), source=st.floats(0.0, 5.0))
@example(radius=0.0, core=1.0, source=1e-5)
def test_two_core_averages_match_mean_square_distance_exactly(radius, core, source):
    distance, weight = disc_distances.distance_rule(radius, core, source)
    assert np.all(distance >= 0.0)
    assert np.all(distance <= radius + 0.5 * (core + source) + 1e-9)
    assert weight.sum() == pytest.approx(1.0, abs=1e-9)
    expected = radius**2 + (core**2 + source**2) / 8.0
    assert weight @ distance**2 == pytest.approx(expected, rel=1e-6, abs=1e-12)
    if radius > 0 and distance.min() > 0:
        radii = np.array([radius, 2.0 * radius])
        starts, logs, weights = disc_distances.distance_rules(radii, core, source)
        assert starts[0] == 0
        assert starts[-1] == logs.size == weights.size
        np.testing.assert_allclose(np.exp(logs[: starts[1]]), distance, rtol=1e-9)


LAYERS = st.lists(
    st.tuples(st.floats(0.0, 1e3), st.floats(0.0, 1e3), st.floats(0.0, 1e2)), min_size=1, max_size=3
)


@FEW
@given(layers=LAYERS, eta=ETA, deep=st.booleans())
def test_layers_reflect_between_nothing_and_all(layers, eta, deep):
    sigma_a, sigma_s, thickness = np.array(layers).T[:, None, :]
    if deep:
        thickness = thickness.copy()
        thickness[..., -1] = np.inf
    exact = adding_doubling.reflectance(sigma_a, sigma_s, thickness, eta=eta)
    assert exact.shape == (1,)
    assert np.all((exact >= 0.0) & (exact <= 1.0))
    rough = layered_diffusion.reflectance(sigma_a, sigma_s, thickness, eta=eta)
    assert np.all(np.isfinite(rough) & (rough >= 0.0))
    same = tissue_optics.layer_stack_reflectance(sigma_a, sigma_s, thickness, eta=eta)
    np.testing.assert_allclose(same, exact, atol=1e-12)


@FEW
@given(
    sigma_a=st.floats(1e-3, 10.0),
    sigma_s=st.floats(1e-2, 50.0),
    thickness=st.floats(0.01, 5.0),
    cut=st.floats(0.1, 0.9),
    scale=st.floats(0.1, 10.0),
)
def test_layer_split_or_scaled_leaves_result_unchanged(sigma_a, sigma_s, thickness, cut, scale):
    def reflect(a, s, d):
        return tissue_optics.layer_stack_reflectance(a, s, d, eta=1.4)

    whole = reflect([sigma_a], [sigma_s], [thickness])
    parts = [thickness * cut, thickness * (1.0 - cut)]
    np.testing.assert_allclose(reflect([sigma_a] * 2, [sigma_s] * 2, parts), whole, atol=1e-9)
    scaled = reflect([sigma_a * scale], [sigma_s * scale], [thickness / scale])
    np.testing.assert_allclose(scaled, whole, atol=1e-9)
    assert reflect([1.5 * sigma_a], [sigma_s], [thickness]) <= whole + 1e-12


@FEW
@given(eta=ETA, directions=st.sampled_from([4, 8, 12, 20]))
def test_directions_of_layers_integrate_half_a_sphere(eta, directions):
    rule = discrete_ordinates.quadrature(eta, directions)
    assert rule.mu.shape == rule.weight.shape == (directions,)
    assert np.all(np.diff(rule.mu) > 0.0)
    assert rule.mu[0] > 0.0
    assert rule.mu[-1] == pytest.approx(1.0, abs=1e-12)
    assert rule.weight.sum() == pytest.approx(1.0, rel=1e-12)
    for power in range(1, 3) if directions > 8 else ():
        assert rule.weight @ rule.mu**power == pytest.approx(1.0 / (power + 1), rel=1e-9)
    assert np.all((rule.surface >= 0.0) & (rule.surface <= 1.0))


@FEW
@given(
    c_m=st.floats(0.0, 0.5),
    c_hd=st.floats(0.0, 0.32),
    oxygenation=SHARE,
    tier=st.sampled_from(["diffusion", "adding_doubling"]),
)
def test_skin_darkens_with_melanin_at_every_wavelength(c_m, c_hd, oxygenation, tier):
    wavelength = np.array([420.0, 550.0, 700.0])
    reflect = [
        tissue_optics.two_layer_reflectance(
            wavelength, value, c_hd, oxygenation=oxygenation, tier=tier
        )
        for value in (c_m, min(c_m + 0.05, 0.5))
    ]
    assert np.all((reflect[0] >= 0.0) & (reflect[0] < 1.0))
    assert np.all(reflect[1] <= reflect[0] + 1e-9)
    layers = tissue_optics.skin_layers(wavelength, c_m, c_hd, oxygenation=oxygenation)
    assert all((part >= 0.0).all() for part in layers)  # the dermis is infinite
    assert all(np.isfinite(part).all() for part in layers[:2])
    blood = tissue_optics.blood_absorption(wavelength, oxygenation=oxygenation)
    assert np.all(blood > 0.0)


@FEW
@given(bad=st.sampled_from([-1e-300, 1.1, np.nan, np.inf]))
def test_fractions_that_no_skin_has_are_an_error(bad):
    for pair in ((bad, 0.02), (0.02, bad)):
        with pytest.raises(tissue_optics.TissueError):
            tissue_optics.skin_layers([550.0], *pair)
        with pytest.raises(tissue_optics.TissueError):
            tissue_optics.two_layer_reflectance([550.0], *pair)


MEDIUM = st.tuples(st.floats(0.0, 1.0), st.floats(1e-3, 1e3), ETA)


@CHEAP
@given(medium=MEDIUM, radius=st.floats(0.0, 1e4), reach=st.floats(0.0, 100.0))
def test_scattered_light_fractions_grow_from_zero_to_all(medium, radius, reach):
    media = dipole_sum.DipoleMedia.of(medium[0], medium[1], eta=medium[2])
    radii = np.array([0.0, 0.5 * radius, radius])
    share = dipole_sum.encircled_fraction(radii, media)
    assert np.all((share >= 0.0) & (share <= 1.0 + 1e-9))
    assert np.all(np.diff(share) >= -1e-9)
    density = dipole_sum.profile(radii, media)
    assert np.all(np.isfinite(density) & (density >= 0.0))
    if reach > 0.0:
        own, rest = dipole_sum.kernel_parts(radii, reach, media)
        whole = dipole_sum.kernel(radii, reach, media)
        assert np.all(np.isfinite(whole) & (whole >= 0.0))
        np.testing.assert_allclose(own + rest, whole, rtol=1e-6, atol=1e-12 * (1 + whole.max()))


@FEW
@given(
    r_d=st.floats(0.05, 0.95),
    length=st.floats(0.2, 5.0),
    level=st.one_of(st.just(0.0), st.floats(1e-30, 1e6)),
    seed=st.integers(0, 99),
)
def test_uniform_light_returns_albedo_and_sums_agree(r_d, length, level, seed):
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(0.0, 10.0, (40, 2)), np.zeros(40)])
    area, light = np.full(40, 2.5), np.full((40, 3), level)
    args = (points, area, light, points[:4], r_d, length)
    even = dipole_gather.exitance(*args)
    np.testing.assert_allclose(even, r_d * level, rtol=dipole_gather.GATHER_TOL)
    light *= rng.uniform(0.0, 1.0, (40, 3))
    quick = dipole_gather.exitance(*args)
    slow = dipole_sum.sum_exitance(*args)
    np.testing.assert_allclose(quick, slow, atol=dipole_gather.GATHER_TOL * max(level, 1e-300))
    tree = dipole_gather.SourceTree.of(points, area)
    told = dipole_gather.gather(tree, light, points[:4], r_d, length)
    np.testing.assert_array_equal(told.exitance, quick)


@CHEAP
@given(shape=st.sampled_from([(), (0,), (3, 0)]), which=st.integers(0, 2))
def test_a_stack_without_layers_is_an_error(shape, which):
    values = [np.ones((3, 1)) for _ in range(3)]
    values[which] = np.ones(shape)
    with pytest.raises(ValueError, match="layers"):
        layered_diffusion.reflectance(*values)
