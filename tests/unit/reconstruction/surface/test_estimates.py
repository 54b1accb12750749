"""Estimates at surface points from samples written out here: what is known comes back."""

import dataclasses
import itertools

import numpy as np
import pytest
from scipy.stats import chi2

from model import fresnel
from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis, diffuse_albedo
from reconstruction.lumitexels.samples import Lumitexels
from reconstruction.surface import estimates
from reconstruction.surface.model_normals import PointLobes

R_D = np.array([0.6, 0.35, 0.2])
VIEWS = np.array([[0.0, 0.1, 1.0], [0.5, 0.0, 1.0], [-0.5, 0.2, 1.0], [0.1, -0.5, 1.0]])
VIEWS /= np.linalg.norm(VIEWS, axis=1, keepdims=True)
SNELL = 1.0 / fresnel.ETA_SKIN


def spiral(count):
    """Directions spread evenly over the half sphere about +z."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - k / count, k * np.pi * (3.0 - np.sqrt(5.0))
    side = np.sqrt(1.0 - z * z)
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=-1)


def cap(count=60, widest_rad=0.5):
    """Normals spread over a cap about +z."""
    way = spiral(4000)
    way = way[way[:, 2] > np.cos(widest_rad)]
    return way[np.linspace(0, len(way) - 1, count).astype(int)]


def through(cosine):
    """What a smooth boundary lets through, Fresnel's equations written out."""
    cosine = np.clip(cosine, 1e-6, 1.0)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) * SNELL**2)
    s = (cosine - inside / SNELL) / (cosine + inside / SNELL)
    p = (cosine / SNELL - inside) / (cosine / SNELL + inside)
    return 1.0 - (s * s + p * p) / 2.0


def turned(normals, angle_rad):
    """Normals tilted by an angle about an axis across them."""
    side = np.cross(normals, [0.3, 1.0, 0.2])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.cos(angle_rad) * normals + np.sin(angle_rad) * side


def make(normals, *, scan=None, lights=60, views=VIEWS, lobe=None, r_d=R_D, noise=0.0, rng=None):
    """Samples of points with f_r = R_d T T / pi + lobe, as a scan's normals have them."""
    scan = normals if scan is None else scan
    way = spiral(lights) if isinstance(lights, int) else lights
    light_dir = np.tile(way, (len(views), 1))
    view_dir = np.repeat(views, len(way), axis=0)
    cos_light, cos_view = normals @ light_dir.T, normals @ view_dir.T
    f = np.asarray(r_d) / np.pi * (through(cos_light) * through(cos_view))[..., None]
    if lobe is not None:
        half = light_dir + view_dir
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        f = f + lobe(np.arccos(np.clip(normals @ half.T, -1.0, 1.0)))[..., None]
    radiance = f * np.maximum(cos_light, 0.0)[..., None]
    if noise:
        radiance = radiance + noise * rng.standard_normal(radiance.shape)
    scan_light, scan_view = scan @ light_dir.T, scan @ view_dir.T
    # a point turned from the light lies in its own shadow, whatever the scan says
    valid = (scan_light > 0.1) & (scan_view > 0.1) & (cos_light > 0.0) & (cos_view > 0.0)
    safe = np.maximum(scan_light, 0.1)[..., None]
    spread = max(noise, 1e-5) ** 2
    shape = (*valid.shape, 3)
    return Lumitexels(
        f=np.where(valid[..., None], radiance / safe, 0.0).astype(np.float32),
        variance=np.where(valid[..., None], spread / safe**2, np.inf).astype(np.float32)
        * np.ones(3, np.float32),
        light_dir=np.broadcast_to(light_dir.astype(np.float32), shape),
        view_dir=np.broadcast_to(view_dir.astype(np.float32), shape),
        cos_light=scan_light.astype(np.float32),
        cos_view=scan_view.astype(np.float32),
        light=np.tile(np.arange(len(way), dtype=np.int32), len(views)),
        view=np.repeat(np.arange(len(views), dtype=np.int32), len(way)),
        valid=valid,
    )


def angle_deg(found, truth):
    assert found.valid.any()
    apart = np.linalg.norm(np.cross(found.values, truth)[found.valid], axis=1)
    return np.degrees(np.arcsin(np.clip(apart, 0.0, 1.0)))


def assert_clean(found):
    assert np.isfinite(found.values).all()
    assert np.isfinite(found.stderr).all()
    assert not found.values[~found.valid].any()


def known(normals):
    """Normals as an estimate without error."""
    count = len(normals)
    return estimates.PointValues(
        np.asarray(normals), np.full((count, 3), 1e-3), np.ones(count, bool)
    )


def albedo_of(normals, r_d=R_D):
    count = len(normals)
    return estimates.PointValues(
        np.tile(r_d, (count, 1)), np.full((count, 3), 1e-3), np.ones(count, bool)
    )


def test_normals_from_subsurface_light_are_exact():
    truth = cap()
    samples = make(truth)
    found = estimates.normals_from_shading(samples, truth)
    assert found.valid.all()
    assert angle_deg(found, truth).max() < 0.001
    assert_clean(found)
    # the boundary matters: light that it did not hold back gives other normals
    matte = dataclasses.replace(
        samples, f=samples.f / (through(samples.cos_light) * through(samples.cos_view))[..., None]
    )
    assert np.median(angle_deg(estimates.normals_from_shading(matte, truth), truth)) > 0.3


@pytest.mark.parametrize("tilt_deg", [2.0, 5.0, 10.0])
def test_normal_iteration_reduces_scan_error_below_one_third(tilt_deg):
    """The boundary's transmittance is that of the round before: its error shrinks, not to zero."""
    truth = cap()
    scan = turned(truth, np.radians(tilt_deg))
    samples = make(truth, scan=scan)
    left = [
        np.median(angle_deg(estimates.normals_from_shading(samples, scan, rounds=n), truth))
        for n in (1, 2, 3, 4)
    ]
    assert left[0] < tilt_deg / 3
    assert all(after < before / 3 for before, after in itertools.pairwise(left))
    assert left[3] < 0.01 * tilt_deg
    # a scan's normals that are taken for the truth keep all of it
    taken = estimates.normals_from_shading(make(turned(truth, 0.1), scan=scan), scan)
    assert np.median(angle_deg(taken, truth)) > 4.0


def shine(half_rad):
    """A broad lobe that ends 33 degrees from the normal, as strong as the light from inside."""
    return 0.3 * np.clip(1.0 - half_rad / np.radians(33.0), 0.0, None)


def test_normals_ignore_highlights_within_35_degrees():
    truth = cap()
    samples = make(truth, lobe=shine)
    assert angle_deg(estimates.normals_from_shading(samples, truth), truth).max() < 0.1
    bent = estimates.normals_from_shading(samples, truth, highlight_rad=0.0)
    assert np.median(angle_deg(bent, truth)) > 0.5


def pulls(truth, samples, rounds):
    """Squared angles over the stated variance of one direction: two degrees of freedom a point."""
    found = estimates.normals_from_shading(samples, truth, rounds=rounds)
    assert found.valid.mean() > 0.98
    return (np.radians(angle_deg(found, truth)) / found.stderr[found.valid, 0]) ** 2


def test_normal_stderr_matches_one_round_and_bounds_two(rng):
    """The second round sees that shading falls faster than the cosine, so it errs less."""
    truth = np.tile(cap(100), (5, 1))
    samples = make(truth, noise=0.01, rng=rng)
    once, twice = (pulls(truth, samples, rounds) for rounds in (1, 2))
    degrees = 2 * len(once)
    # residuals of some 80 samples tell the noise to 8 %
    assert np.sum(once) > 0.92**2 * chi2.ppf(5e-4, degrees)
    assert np.sum(once) < 1.08**2 * chi2.ppf(1 - 5e-4, degrees)
    assert np.sum(twice) < 1.08**2 * chi2.ppf(1 - 5e-4, 2 * len(twice))
    assert np.sum(twice) > 0.35 * degrees
    # it can fail: samples twice as noisy as the errors say leave more
    loud = dataclasses.replace(make(truth, noise=0.03, rng=rng), variance=samples.variance)
    found = estimates.normals_from_shading(loud, truth, rounds=1)
    stated = estimates.normals_from_shading(samples, truth, rounds=1)
    both = found.valid & stated.valid
    apart = np.linalg.norm(np.cross(found.values, truth), axis=1)[both]
    assert np.sum((apart / stated.stderr[both, 0]) ** 2) > 3 * degrees


@pytest.mark.long
def test_half_vector_normals_are_accurate_to_light_spacing():
    truth = cap()
    samples = make(truth, lights=150, lobe=lambda h: 5.0 * np.exp(-((h / 0.15) ** 2)))
    found = estimates.normals_from_half_vectors(samples)
    # 150 lights on a half sphere stand 12 degrees apart; half vectors turn half as far
    assert np.median(angle_deg(found, truth)) < 3.0
    matte = estimates.normals_from_half_vectors(make(truth, lights=150))
    assert np.median(angle_deg(matte, truth)) > 6.0


def test_albedo_is_exact_with_exact_normals_and_lobe():
    truth = cap()
    samples = make(truth, lobe=shine)
    found = estimates.estimate_albedo(samples, known(truth), stderr_rad=1e-3)
    assert found.valid.all()
    assert np.abs(found.values / R_D - 1.0).max() < 0.01
    assert_clean(found)
    # a mean instead of a minimum would hold the highlight
    naive = np.array([f[v].mean(axis=0) for f, v in zip(samples.f, samples.valid, strict=True)])
    assert (naive * np.pi / R_D).mean() > 1.02


def test_albedo_does_not_depend_on_scan_normal_error():
    truth = cap()
    scan = turned(truth, np.radians(8.0))
    # one light ring to a side, as on a cheek: errors of the cosine do not even out
    lights = spiral(60)[spiral(60)[:, 0] > -0.2]
    samples = make(truth, scan=scan, lights=lights)
    found = estimates.estimate_albedo(samples, known(truth), stderr_rad=1e-3)
    assert found.valid.all()
    np.testing.assert_allclose(found.values, np.tile(R_D, (len(truth), 1)), rtol=1e-3)
    # by the scan's cosines it is off by percents
    scanned = dataclasses.replace(samples, cos_light=make(truth, lights=lights).cos_light)
    taken = estimates.estimate_albedo(scanned, known(truth), stderr_rad=1e-3)
    assert np.median(np.abs(taken.values / R_D - 1.0)) > 0.01


def test_albedo_weights_oblique_views_beyond_point_less():
    truth = cap(30, 0.3)
    aslant = np.array([[0.95, 0.0, 0.3], [-0.93, 0.2, 0.3], [0.1, -0.95, 0.3], [0.0, 0.95, 0.3]])
    aslant /= np.linalg.norm(aslant, axis=1, keepdims=True)
    rng = np.random.default_rng(6)
    samples = make(truth, views=np.concatenate([VIEWS, aslant]), noise=1e-3, rng=rng)
    # what a strip 1 / cos long averages is darker in proportion to its length squared
    lost = 0.004 / np.square(np.maximum(samples.cos_view, 0.1))
    darker = dataclasses.replace(samples, f=samples.f * (1.0 - lost)[..., None].astype(np.float32))

    def off(r_d):
        return np.median(np.abs(r_d / R_D - 1.0))

    alike = diffuse_albedo.estimate(
        darker.f,
        darker.light_dir,
        darker.view_dir,
        truth.astype(np.float32),
        eta=fresnel.ETA_SKIN,
        variance=darker.variance,
        valid=darker.valid,
        normal_stderr_rad=1e-3,
    )
    found = estimates.estimate_albedo(darker, known(truth), stderr_rad=1e-3)
    assert found.valid.all()
    assert off(found.values) < 0.75 * off(alike.r_d)
    assert 0.004 < off(found.values)  # what views from the front lose stays


def test_samples_at_other_normals_keep_their_radiance():
    truth = cap(20)
    samples = make(truth, scan=turned(truth, 0.1), noise=1e-3, rng=np.random.default_rng(2))
    moved = estimates.reproject_samples(samples, known(truth))
    assert moved.valid.any()
    assert not (moved.valid & ~samples.valid).any()
    at = moved.valid
    for name, power in (("f", 1), ("variance", 2)):
        before, after = (
            getattr(s, name)[at] * s.cos_light[at][:, None] ** power for s in (samples, moved)
        )
        np.testing.assert_allclose(after, before, rtol=1e-5)
    assert np.isinf(moved.variance[~at]).all()
    # points without a normal have no samples
    none = dataclasses.replace(known(truth), valid=np.zeros(len(truth), bool))
    assert not estimates.reproject_samples(samples, none).valid.any()


def test_albedo_without_normal_is_masked():
    truth = cap()
    normals = known(truth)
    normals = dataclasses.replace(normals, valid=np.arange(len(truth)) % 2 == 0)
    found = estimates.estimate_albedo(make(truth), normals, stderr_rad=1e-3)
    np.testing.assert_array_equal(found.valid, normals.valid)
    assert_clean(found)


def test_lobe_subtraction_removes_highlight_bias_of_normals():
    truth = cap(40)
    basis = brdf_tables.default_basis()
    mix = np.zeros((1, len(basis.names)))
    mix[0, np.argmax([n == basis.names[len(basis.names) // 2] for n in basis.names])] = 1.0
    one = basis.mix_materials(mix)
    samples = make(truth)
    weights = np.full((len(truth), 1), 0.02 / one.strength()[0])
    from reconstruction import brdf_basis

    lobes = brdf_basis.evaluate(
        weights[:, None], one, samples.light_dir, samples.view_dir, truth[:, None]
    )
    shiny = dataclasses.replace(samples, f=samples.f + np.asarray(lobes, np.float32)[..., None])
    found = estimates.normals_from_remainder(
        shiny, known(truth), albedo_of(truth), PointLobes(weights, one)
    )
    assert angle_deg(found, truth).max() < 0.2
    none = estimates.normals_from_remainder(
        shiny, known(truth), albedo_of(truth), PointLobes(0.0 * weights, one)
    )
    assert np.median(angle_deg(none, truth)) > 1.5 * np.median(angle_deg(found, truth))


def glossy(truth, one, share):
    """Dark samples under one lobe, and the lobe's shares."""
    from reconstruction import brdf_basis

    samples = make(truth, r_d=[0.02] * 3)
    weights = np.full((len(truth), 1), share / one.strength()[0])
    lobes = brdf_basis.evaluate(
        weights[:, None], one, samples.light_dir, samples.view_dir, truth[:, None]
    )
    f = samples.f + np.asarray(lobes, np.float32)[..., None]
    return dataclasses.replace(samples, f=np.where(samples.valid[..., None], f, 0.0)), weights


def test_highlights_refine_only_normals_uncertain_from_subsurface_light():
    truth = cap(40)
    basis = brdf_tables.default_basis()
    one = basis.mix_materials(np.eye(basis.size)[[basis.names.index("beckmann 0.3")]])
    samples, weights = glossy(truth, one, 0.2)
    start = known(turned(truth, np.radians(1.5)))
    stderr = np.full((40, 3), np.radians(2.0))
    stderr[::2] = np.radians(0.1)
    start = dataclasses.replace(start, stderr=stderr)
    r_d = dataclasses.replace(albedo_of(truth), values=np.full((40, 3), 0.02))
    found = estimates.normals_from_full_model(samples, start, r_d, PointLobes(weights, one))
    np.testing.assert_array_equal(found.values[::2], start.values[::2])
    np.testing.assert_array_equal(found.stderr[::2], start.stderr[::2])
    assert np.median(angle_deg(found, truth)[1::2]) < 0.3 * 1.5
    # two looks at one normal tell more than either, and no more than lobes are known
    assert (found.stderr[1::2] < start.stderr[1::2]).all()
    assert (found.stderr[1::2] > 0.9 * estimates.LOBE_TILT_RAD).all()
    # the same without the lobe: highlights then pull where nothing is
    bare = estimates.normals_from_full_model(samples, start, r_d, PointLobes(0.0 * weights, one))
    assert np.median(angle_deg(bare, truth)[1::2]) > 2 * np.median(angle_deg(found, truth)[1::2])


@pytest.mark.parametrize(
    ("lights", "views", "enough"), [(10, 2, True), (9, 2, False), (10, 1, False), (60, 4, True)]
)
def test_points_need_ten_lights_and_two_views(lights, views, enough):
    up = np.tile([0.0, 0.0, 1.0], (3, 1))
    way = spiral(200)
    way = way[way[:, 2] > 0.3][:lights]
    samples = make(up, lights=way, views=VIEWS[:views])
    np.testing.assert_array_equal(estimates.has_enough_samples(samples), enough)
    # nothing but the mask keeps a point off: hide one light of a point that has just enough
    hidden = dataclasses.replace(samples, valid=samples.valid & (samples.light != 0))
    np.testing.assert_array_equal(estimates.has_enough_samples(hidden), enough and lights > 10)
    if not enough:
        assert not estimates.normals_from_shading(samples, up).valid.any()
        assert not estimates.normals_from_half_vectors(samples).valid.any()
    assert estimates.count_samples(samples).values[:, 0].tolist() == [float(lights * views)] * 3


def emptied(samples):
    return dataclasses.replace(
        samples,
        f=np.zeros_like(samples.f),
        variance=np.full_like(samples.variance, np.inf),
        valid=np.zeros_like(samples.valid),
    )


def all_saturated(samples):
    """What the images make of pixels that no exposure held: not valid, their values 0."""
    return emptied(samples)


def black(samples):
    return dataclasses.replace(samples, f=np.zeros_like(samples.f))


def one_hot(samples):
    f = samples.f.copy()
    f[:, 5] = 1e4
    return dataclasses.replace(samples, f=f)


def repeated(samples, new_views):
    """Every sample twice, of the same views or of as many others."""
    twice = {
        field.name: np.concatenate([getattr(samples, field.name)] * 2, axis=1)
        for field in dataclasses.fields(samples)
        if field.name not in ("light", "view")
    }
    other = samples.view + (len(VIEWS) if new_views else 0)
    views = np.concatenate([samples.view, other])
    return dataclasses.replace(samples, **twice, light=np.tile(samples.light, 2), view=views)


@pytest.mark.parametrize(("new_views", "factor"), [(False, 1.0), (True, np.sqrt(0.5))])
def test_lobe_errors_fall_with_views_only(new_views, factor):
    """Lights of a view share the pixel's errors, so that more of them do not help."""
    truth, basis = cap(20), brdf_tables.default_basis()
    samples = make(truth, lobe=lambda angle: 0.3 * np.exp(-((angle / 0.3) ** 2)))
    few = basis.mix_materials(np.eye(len(basis.names))[:2])
    once, twice = (
        estimates.fit_lobe_weights(one, known(truth), albedo_of(truth), few)
        for one in (samples, repeated(samples, new_views))
    )
    relative = [found.stderr.max(axis=1) / found.values.max(axis=1) for found in (once, twice)]
    np.testing.assert_allclose(relative[1], factor * relative[0], rtol=0.02)


def test_lobe_errors_reach_those_of_independent_samples():
    truth, basis = cap(20), brdf_tables.default_basis()
    samples = make(truth, lobe=lambda angle: 0.3 * np.exp(-((angle / 0.3) ** 2)))
    alone = dataclasses.replace(samples, view=np.arange(len(samples.view)))
    few = basis.mix_materials(np.eye(len(basis.names))[:2])
    stated = estimates.fit_lobe_weights(alone, known(truth), albedo_of(truth), few)
    shine = estimates.specular_samples(alone, known(truth), albedo_of(truth))
    own = brdf_basis.fit_weights(shine, few).stderr
    relative = stated.stderr.max(axis=1) / stated.values.max(axis=1)
    good = stated.valid & np.isfinite(own) & (own < 0.5)
    assert good.all()
    np.testing.assert_allclose(relative[good], own[good], rtol=1e-5)


def by_one_light(samples):
    return dataclasses.replace(samples, valid=samples.valid & (samples.light == 7))


def without_noise(samples):
    return dataclasses.replace(samples, variance=np.zeros_like(samples.variance))


def negative(samples):
    """Dark pixels after the darks were subtracted."""
    return dataclasses.replace(samples, f=-1e-4 * np.ones_like(samples.f))


EXTREMES = [emptied, all_saturated, black, one_hot, by_one_light, without_noise, negative]
NOTHING = {emptied, all_saturated, by_one_light}


@pytest.mark.parametrize("spoil", EXTREMES, ids=lambda f: f.__name__)
def test_no_estimate_of_spoiled_samples_holds_a_nan(spoil):
    truth = cap(30)
    samples = spoil(make(truth))
    basis = brdf_tables.default_basis()
    few = basis.mix_materials(np.eye(len(basis.names))[:2])
    normals = estimates.normals_from_shading(samples, truth)
    r_d = estimates.estimate_albedo(samples, known(truth), stderr_rad=1e-3)
    lobes = estimates.fit_lobe_weights(samples, known(truth), albedo_of(truth), few)
    made = [
        normals,
        r_d,
        lobes,
        estimates.normals_from_half_vectors(samples),
        estimates.normals_from_remainder(
            samples, known(truth), albedo_of(truth), PointLobes(lobes.values[:, :2], few)
        ),
    ]
    for found in made:
        assert_clean(found)
    if spoil in NOTHING:
        assert not normals.valid.any()
        assert not estimates.estimate_albedo(samples, normals, stderr_rad=1e-3).valid.any()
    if spoil is one_hot:
        assert angle_deg(normals, truth).max() < 0.3


def test_black_skin_has_invalid_normal_and_zero_albedo():
    truth = cap(30)
    samples = make(truth, r_d=(0.0, 0.0, 0.0), noise=1e-3, rng=np.random.default_rng(4))
    normals = estimates.normals_from_shading(samples, truth)
    assert_clean(normals)
    assert np.mean(normals.valid & (normals.stderr[:, 0] < np.radians(5.0))) < 0.1
    found = estimates.estimate_albedo(samples, known(truth), stderr_rad=1e-3)
    assert_clean(found)
    good = found.values[found.valid] / found.stderr[found.valid]
    assert not len(good) or np.abs(np.median(good)) < 3.0


def test_coplanar_lights_give_invalid_normal():
    """Photometric stereo knows nothing across the plane of the lights; near one it says so."""
    truth = cap(30, 0.3)
    tilt = np.linspace(-1.2, 1.2, 40)
    way = np.stack([np.sin(tilt), np.zeros(40), np.cos(tilt)], axis=-1)
    found = estimates.normals_from_shading(make(truth, lights=way), truth)
    assert_clean(found)
    assert not found.valid.any()


def test_rows_of_samples_are_those_of_their_points():
    samples = make(cap(10))
    rows = np.array([7, 2])
    part = estimates.select_points(samples, rows)
    np.testing.assert_array_equal(part.f, samples.f[rows])
    np.testing.assert_array_equal(part.valid, samples.valid[rows])
    np.testing.assert_array_equal(part.light, samples.light)
