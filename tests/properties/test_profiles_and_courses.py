"""Radial profiles, directions, and blood in time over their declared domains."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import dipole, photon_table
from reconstruction import brdf_basis, diffuse_albedo, subsurface, tiles
from reconstruction.anisotropy import (
    diffusion_ellipse,
    direction_harmonics,
    plane_vectors,
    profile_anisotropy,
)
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.anisotropy.estimation import estimate_single_direction_bias
from reconstruction.facial_color import perfusion_curves, perfusion_fit, repeatability
from reconstruction.subsurface import smooth_misfit, translucency

CHEAP = settings(derandomize=True, deadline=None, max_examples=25, database=None)
FEW = settings(CHEAP, max_examples=8)

SEED = st.integers(0, 9999)
RADIUS = np.linspace(0.5, 9.0, 18)
ANY = st.floats(allow_nan=True, allow_infinity=True)


@FEW
@given(sigma_a=st.floats(0.01, 0.5), sigma_s=st.floats(0.7, 3.0), gain=st.floats(0.999, 1.001))
def test_coefficients_of_a_clean_profile_come_back(sigma_a, sigma_s, gain):
    profile = gain * photon_table.reflectance(RADIUS, sigma_a, sigma_s)
    kept = profile.copy()
    fit = subsurface.invert(RADIUS, profile, variance=(0.01 * profile) ** 2, g_error=0.0)
    np.testing.assert_array_equal(profile, kept)
    if fit.valid:
        truth = float(dipole.effective_transport(sigma_a, sigma_s))
        assert fit.sigma_tr_per_mm == pytest.approx(truth, rel=0.02)
        low, high = fit.interval_per_mm
        assert low <= fit.sigma_tr_per_mm <= high
    baseline = subsurface.fit_dipole(RADIUS, dipole.reflectance(RADIUS, sigma_a, sigma_s, 1.4))
    if baseline.valid:
        truth = float(dipole.effective_transport(sigma_a, sigma_s))
        assert baseline.sigma_tr_per_mm == pytest.approx(truth, rel=1e-3)


@FEW
@given(
    values=st.lists(ANY, min_size=18, max_size=18),
    method=st.sampled_from(["photon_table", "diffusion", "dipole"]),
)
def test_fit_of_any_readings_is_finite_or_invalid(values, method):
    readings = np.array(values)
    # beyond these sizes no unit of length makes a reflectance per area
    readings[np.abs(readings) > 1e30] = np.inf
    readings[np.abs(readings) < 1e-30] = 0.0
    fit = subsurface.invert(RADIUS, readings[None], variance=1e-6, method=method)
    if fit.valid[0]:
        assert np.isfinite(fit.sigma_tr_per_mm[0])
        assert np.isfinite(fit.interval_per_mm[0]).all()
    else:
        assert fit.reason(0)


ANGLES = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)


@CHEAP
@given(
    ratio=st.floats(1.0, 2.0),
    axis=st.floats(0.0, 3.1),
    level=st.floats(1e-6, 1e6),
    turn=st.floats(0.0, 3.0),
)
def test_anisotropy_is_unit_invariant_and_rotates_with_skin(ratio, axis, level, turn):
    uv = 0.5 * np.log(ratio) * np.array([[np.cos(2 * axis), np.sin(2 * axis)]])
    values, slopes = diffusion_ellipse.relative_sigma_tr(ANGLES, uv)
    assert np.all(values > 0.0)
    assert np.isfinite(slopes).all()
    first = anisotropy.estimate(ANGLES, level * values[0])
    again = anisotropy.estimate(ANGLES + turn, values[0])
    assert first.ratio >= 1.0
    assert first.ratio == pytest.approx(float(again.ratio), rel=1e-6)
    parameters = np.array([[0.0, *uv[0], 0.0, 0.0]])
    mean, by = diffusion_ellipse.mean_over_directions(parameters)
    assert values.min() - 1e-9 <= mean[0] <= values.max() + 1e-9
    assert np.isfinite(by).all()
    assert diffusion_ellipse.uniform_axial_directions().ndim == 1
    bias = estimate_single_direction_bias(first, ANGLES)
    expected = values[0] / mean[0] - 1.0
    np.testing.assert_allclose(bias.bias, expected, atol=1e-5)
    assert bias.lowest <= expected.min() + 1e-5
    assert bias.highest >= expected.max() - 1e-5


@CHEAP
@given(seed=SEED, unit=st.floats(1e-6, 1e6), turn=st.floats(-20.0, 20.0))
def test_lengths_and_directions_rotate_with_axes_unit_invariant(seed, unit, turn):
    rng = np.random.default_rng(seed)
    pair, root = rng.standard_normal((7, 2)), rng.standard_normal((7, 2, 2))
    covariance = root @ root.transpose(0, 2, 1)
    length, along, across = plane_vectors.estimate_length(pair, covariance)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, -s], [s, c]])
    moved = turned @ covariance @ turned.T
    for one, other in zip(
        (length, along, across),
        plane_vectors.estimate_length(unit * pair @ turned.T, unit**2 * moved),
        strict=True,
    ):
        np.testing.assert_allclose(unit * one, other, rtol=1e-6, atol=1e-6 * unit)
    # along and across together hold all of the covariance
    np.testing.assert_allclose(
        along**2 + across**2, np.trace(covariance, axis1=1, axis2=2), rtol=1e-9
    )
    np.testing.assert_allclose(
        plane_vectors.quadratic_form(pair, covariance),
        [v @ m @ v for v, m in zip(pair, covariance, strict=True)],
        rtol=1e-9,
        atol=1e-9,
    )
    stderr = plane_vectors.axis_stderr(length, across)
    assert np.all((stderr > 0.0) & (stderr <= plane_vectors.UNKNOWN_AXIS_RAD))
    np.testing.assert_allclose(
        stderr, plane_vectors.axis_stderr(unit * length, unit * across), rtol=1e-6
    )
    angle = plane_vectors.wrap_angle(np.arctan2(pair[:, 1], pair[:, 0]) + turn, np.pi)
    assert np.all((angle >= 0.0) & (angle < np.pi))


@CHEAP
@given(coefficients=st.lists(st.floats(-1.0, 1.0), min_size=5, max_size=5))
def test_harmonics_come_back_from_enough_directions(coefficients):
    columns = direction_harmonics.design_matrix(ANGLES)
    values = (columns @ coefficients)[:, None]
    weight = np.ones_like(values)
    count = direction_harmonics.count_distinct_directions(ANGLES, weight > 0)
    assert count.tolist() == [16]
    kept, outliers = direction_harmonics.exclude_outliers(ANGLES, values, weight)
    assert kept.shape == outliers.shape == (16, 1)
    assert outliers.sum() <= 2
    found = direction_harmonics.fit_harmonics(ANGLES, values, weight)
    np.testing.assert_allclose(found.coefficients[0], coefficients, atol=1e-6)


@CHEAP
@given(power=st.floats(1e-12, 1e12), residual=st.floats(1e-12, 1e12), dof=st.integers(1, 40))
def test_tail_is_probability_decreasing_with_power(power, residual, dof):
    tail = direction_harmonics.log_p_value(
        np.array([power, 2.0 * power]), np.full(2, residual), np.full(2, dof)
    )
    assert np.all(tail <= 1e-12)
    assert tail[1] <= tail[0] + 1e-12
    assert not np.isnan(tail).any()


@FEW
@given(seed=SEED, constant=st.floats(0.5, 3.0), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_time_course_is_unit_invariant(seed, constant, scale):
    rng = np.random.default_rng(seed)
    time_s = np.linspace(0.0, 12.0, 40)
    course = 1.0 + 2.0 * (1.0 - np.exp(-time_s / constant)) + 0.01 * rng.standard_normal(40)
    first = perfusion_fit.fit_course(time_s, course)
    other = perfusion_fit.fit_course(time_s, scale * course)
    assert first.time_constant_s == pytest.approx(constant, rel=0.2)
    assert other.time_constant_s == pytest.approx(first.time_constant_s, rel=1e-3)
    phase = np.sort(rng.uniform(0.0, 10.0, 40))
    level = np.where(
        phase < 5.0, 1.0 - np.exp(-phase / constant), np.exp(-(phase - 5.0) / constant)
    )
    cycle = perfusion_fit.fit_cycle(phase, level, cycle_s=10.0)
    assert np.isfinite(cycle.time_constant_s)
    assert cycle.interval_s[0] <= cycle.interval_s[1]


@CHEAP
@given(seed=SEED, scale=st.sampled_from([1e-6, 1.0, 1e6]), radius=st.floats(0.1, 4.0))
def test_disc_means_scale_and_stay_within_pixel_range(seed, scale, radius):
    rng = np.random.default_rng(seed)
    maps, places = rng.uniform(1.0, 2.0, (2, 12, 12)), {"cheek": (5.0, 6.0)}
    found = perfusion_curves.average_discs(scale * maps, places, radius)
    assert np.all((found.mean >= scale) & (found.mean <= 2.0 * scale))
    rows, columns = perfusion_curves.disc_pixels((12, 12), "cheek", (5.0, 6.0), radius)
    assert 1 <= rows.size == columns.size


@CHEAP
@given(seed=SEED, cycle=st.floats(1.0, 100.0))
def test_periodic_levels_have_no_transition_and_repeat(seed, cycle):
    rng = np.random.default_rng(seed)
    phase = np.sort(rng.uniform(0.0, cycle, 30))
    values = np.where(phase < cycle / 2, 1.0, 2.0) + 1e-6 * rng.standard_normal(30)
    groups = perfusion_curves.group_by_phase(phase, cycle_s=cycle)
    assert groups.shape == (30,)
    late = np.tile((np.arange(8) + 0.5) / 8 * cycle, 2)
    level = np.where(late < cycle / 2, 1.0, 2.0) + 1e-6 * rng.standard_normal(16)
    found = perfusion_curves.find_transition(late, level, cycle_s=cycle, false_alarm=1e-9)
    assert not found.seen
    told = perfusion_curves.estimate_reproducibility(
        np.arange(16.0) * cycle, late, level, cycle_s=cycle
    )
    assert told is not None
    assert values.size == 30


@FEW
@given(seed=SEED, scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_repeats_are_judged_the_same_in_any_unit(seed, scale):
    rng = np.random.default_rng(seed)
    level = np.array([2.0, 3.0, 2.0, 3.0])[:, None, None]
    maps = level + 0.1 * rng.standard_normal((4, 12, 12))
    states = ["neutral", "smile"] * 2
    for judge in (
        lambda k: (
            repeatability.compare_states(k * maps, states, stderr=np.full(maps.shape, 0.1 * k))
            .region("whole face")
            .correlation
        ),
        lambda k: (
            repeatability.fit_drift(
                k * maps, states, [0.0, 10.0, 20.0, 30.0], stderr=np.full(maps.shape, 0.1 * k)
            )[-1].slope_per_minute
            / k
        ),
    ):
        assert judge(scale) == pytest.approx(judge(1.0), rel=1e-6, abs=1e-9)


@FEW
@given(seed=SEED, level=st.floats(0.2, 3.0))
def test_map_between_equal_sites_is_nearly_their_value(seed, level):
    places = np.random.default_rng(seed).uniform(0.1, 0.9, (6, 2))
    sigma_tr = np.full((6, 3), level)
    found = translucency.interpolate(places, sigma_tr, 1e-3 * sigma_tr, (10, 9))
    assert np.all(np.isfinite(found.values) & (found.values > 0.0))
    assert np.all(found.stderr > 0.0)
    prior = translucency.population_prior()
    assert np.isfinite(prior.log_mean).all()


UP = np.array([0.0, 0.0, 1.0])


@FEW
@given(albedo=st.floats(0.02, 0.95), seed=SEED, scale=st.sampled_from([1.0, 0.5]))
def test_the_albedo_of_matte_points_comes_back(albedo, seed, scale):
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(2, 1, 30, 3))
    ways[..., 2] = np.abs(ways[..., 2]) + 0.5
    light, view = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    from model import skin_reflectance

    through = skin_reflectance.transmittance(light[..., 2]) * skin_reflectance.transmittance(
        view[..., 2]
    )
    samples = np.repeat((scale * albedo * through / np.pi)[..., None], 3, axis=-1)
    found = diffuse_albedo.estimate(samples, light, view, UP[None], eta=1.4)
    if found.valid[0]:
        np.testing.assert_allclose(found.r_d[0], scale * albedo, rtol=0.02)
    rest = brdf_basis.surface_samples(samples, light, view, UP[None], found.r_d, eta=1.4)
    assert np.isfinite(rest.value[rest.valid]).all()


@CHEAP
@given(errors=st.lists(st.floats(0.0, 1e6), min_size=1, max_size=20), share=st.floats(0.0, 1.0))
def test_plateau_is_within_valid_ranks(errors, share):
    rank = brdf_basis.find_plateau_rank(errors, fraction=share)
    assert 1 <= rank <= len(errors)


@CHEAP
@given(values=st.lists(st.integers(), max_size=30), window=st.integers(1, 9))
def test_tiles_come_back_in_their_order(values, window):
    more = [v + 1 for v in values]
    assert list(tiles.map_tiles(lambda v: v + 1, values, window=window)) == more
    assert tiles.map_on_threads(lambda v: v + 1, values, window=window) == more


TURNS = np.arange(12) * (np.pi / 6)


@FEW
@given(
    seed=SEED,
    ratio=st.floats(1.0, 1.3),
    axis=st.floats(0.0, np.pi),
    unit=st.sampled_from([1e-20, 1.0, 1e20]),
    lost=st.integers(0, 3),
)
def test_profile_axis_found_with_lost_fibers_any_unit(seed, ratio, axis, unit, lost):
    rng = np.random.default_rng(seed)
    scattering = 1.5 * (1.0 - (ratio - 1.0) * np.cos(2 * (TURNS - axis)))
    profiles = unit * photon_table.reflectance(RADIUS, 0.04, scattering[:, None])
    profiles *= np.exp(0.05 * rng.standard_normal((12, 1)))  # how well the head couples
    for _ in range(lost):
        profiles[rng.integers(12), rng.integers(18)] = rng.choice([np.nan, np.inf, -np.inf])
    kept = profiles.copy()
    told = {"sigma_a_per_mm": 0.04, "sigma_s_prime_per_mm": 1.5}
    found = profile_anisotropy.estimate_from_profiles(TURNS, RADIUS, profiles, **told)
    np.testing.assert_array_equal(profiles, kept)
    assert found.valid
    assert found.ratio >= 1.0
    assert found.ratio == pytest.approx(1.0 + 1.1 * (ratio - 1.0), abs=0.05)
    if ratio > 1.1:
        off = abs((float(found.axis_rad) - axis + np.pi / 2) % np.pi - np.pi / 2)
        assert off < 0.05
        assert found.p_value < 1e-6
    none = profile_anisotropy.estimate_from_profiles(TURNS, RADIUS, np.zeros((12, 18)), **told)
    assert not none.valid
    assert none.ratio == 1.0
    for name in ("sigma_a_per_mm", "sigma_s_prime_per_mm"):
        for bad in (np.nan, 0.0, -1.0, np.inf):
            unknown = profile_anisotropy.estimate_from_profiles(
                TURNS, RADIUS, profiles, **(told | {name: bad})
            )
            assert not unknown.valid
    with pytest.raises(anisotropy.AnisotropyError, match="radius_mm"):
        profile_anisotropy.estimate_from_profiles(TURNS, -RADIUS, profiles, **told)
    with pytest.raises(anisotropy.AnisotropyError, match="floor"):
        profile_anisotropy.estimate_from_profiles(TURNS, RADIUS, profiles, floor=np.nan, **told)


@CHEAP
@given(h=st.floats(0.0, 3.0), axis=st.floats(0.0, np.pi), level=st.floats(-0.5, 0.5), drawn=SEED)
def test_ellipse_fit_recovers_its_own_values(h, axis, level, drawn):
    uv = h * np.array([[np.cos(2 * axis), np.sin(2 * axis)]])
    shape, _ = diffusion_ellipse.relative_sigma_tr(TURNS, uv)
    values = np.exp(0.5 * level) * shape.T
    weight = np.random.default_rng(drawn).uniform(0.5, 2.0, (12, 1))
    start = direction_harmonics.fit_harmonics(TURNS, values, weight)
    found, inverse, residual = diffusion_ellipse.fit_ellipses(TURNS, values, weight, start)
    assert start.determined.all()
    np.testing.assert_allclose(found[0, :3], [level, *uv[0]], atol=1e-5 * (1.0 + h))
    assert residual[0] < 1e-9
    assert np.isfinite(inverse).all()
    assert np.linalg.eigvalsh(inverse[0])[0] >= -1e-9
    # a series without a fit has zeros and no NaN
    few = np.where(np.arange(12)[:, None] < 3, weight, 0.0)
    nothing = direction_harmonics.fit_harmonics(TURNS, values, few)
    p, covariance, left = diffusion_ellipse.fit_ellipses(TURNS, values, few, nothing)
    assert not p.any()
    assert not covariance.any()
    assert left[0] == 0.0


@CHEAP
@given(seed=SEED, sides=st.tuples(st.integers(1, 40), st.integers(1, 40)))
def test_usual_positions_are_within_face_rectangle(seed, sides):
    rng = np.random.default_rng(seed)
    skin = rng.uniform(size=sides) < 0.5
    skin[rng.integers(sides[0]), rng.integers(sides[1])] = True
    rows, columns = np.nonzero(skin)
    for x, y in perfusion_curves.standard_positions(skin).values():
        assert columns.min() <= x <= columns.max()
        assert rows.min() <= y <= rows.max()
    for none in (np.zeros(sides, bool), np.ones(3, bool), np.ones((2, 2, 2), bool)):
        with pytest.raises(perfusion_curves.CurveError, match="skin"):
            perfusion_curves.standard_positions(none)


@CHEAP
@given(seed=SEED, line=st.tuples(*[st.floats(-1.0, 1.0)] * 2), lost=st.integers(0, 10))
def test_misfit_keeps_root_distance_line_with_lost_fibers(seed, line, lost):
    rng = np.random.default_rng(seed)
    radius = rng.permutation(RADIUS)
    straight = line[0] + line[1] * np.sqrt(radius)
    variance = rng.uniform(1e-4, 1e-2, (2, 18))
    variance[1, :lost] = np.inf
    curve, covariance = smooth_misfit.smooth_misfit(radius, np.stack([straight] * 2), variance)
    np.testing.assert_allclose(curve, np.stack([straight] * 2), atol=1e-6)
    assert (np.linalg.eigvalsh(covariance) > -1e-12).all()
    read = np.isfinite(variance)
    told = np.einsum("nff->nf", covariance)
    assert (told[read] <= variance[read] * (1 + 1e-9)).all()
    order = rng.permutation(18)
    values = rng.standard_normal((1, 18))
    one = smooth_misfit.smooth_misfit(radius, values, variance[:1])[0]
    other = smooth_misfit.smooth_misfit(radius[order], values[:, order], variance[:1, order])[0]
    np.testing.assert_allclose(other, one[:, order], atol=1e-9)


@CHEAP
@given(
    seed=st.integers(0, 99),
    fibers=st.integers(3, 30),
    least=st.floats(1e-6, 1e6),
    level=st.floats(-10.0, 10.0),
    slope=st.floats(-10.0, 10.0),
)
def test_misfit_bend_posterior_ignores_level_and_slope(seed, fibers, least, level, slope):
    rng = np.random.default_rng(seed)
    place = np.cumsum(rng.uniform(0.02, 0.3, fibers))
    bend, mass = smooth_misfit._bends(place)
    value = rng.standard_normal((2, fibers))
    weight = least * 10.0 ** rng.uniform(0.0, 3.0, (2, fibers))
    found = smooth_misfit.log_posterior(bend, mass, value, weight)
    assert found.shape == (2, smooth_misfit.BEND_STRENGTHS.size)
    assert np.isfinite(found).all()
    moved = smooth_misfit.log_posterior(bend, mass, value + level + slope * place, weight)
    np.testing.assert_allclose(moved, found, rtol=1e-7, atol=1e-6)
