"""Normals from many lights: exact where the model holds, robust and free of NaN where not."""

import numpy as np
import pytest

from model.metrics import angular_error_rad
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.photometric_stereo import estimation as stereo
from reconstruction.photometric_stereo.estimation import Robustness, estimate_normals


def ring(count, elevation=0.7, turn=0.0):
    """Return lights spread over a cap around +z, shape (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1.0 - k / count * (1.0 - elevation)
    phi = np.pi * (1.0 + np.sqrt(5.0)) * k + turn
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def tilted(tilt_rad, turn_rad=0.3):
    s = np.sin(tilt_rad)
    return np.array([s * np.cos(turn_rad), s * np.sin(turn_rad), np.cos(tilt_rad)])


def lambertian(lights, normals, albedo=1.0):
    """Return samples (N, P) of normals (P, 3)."""
    return np.maximum(albedo * (lights @ np.asarray(normals).T), 0.0)


def caps(rng, count, most_rad=0.6):
    """Return normals within a cone around +z, (count, 3)."""
    angle = most_rad * np.sqrt(rng.random(count))
    turn = 2 * np.pi * rng.random(count)
    s = np.sin(angle)
    return np.stack([s * np.cos(turn), s * np.sin(turn), np.cos(angle)], axis=-1)


def assert_clean(found):
    """No NaN anywhere, and what is not valid says so in every map."""
    for name in ("normals", "albedo", "residual", "stderr_rad"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert not np.isnan(found.stderr_albedo).any()
    assert (found.normals[~found.valid] == 0).all()
    assert (found.stderr_rad[~found.valid] == np.float32(np.pi)).all() or found.valid.all()
    length = np.linalg.norm(found.normals[found.valid], axis=-1)
    np.testing.assert_allclose(length, 1.0, atol=1e-5)


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("tilt_rad", [0.0, 0.2, 0.6])
def test_normals_of_a_tilted_lambertian_plane_are_exact(tilt_rad, robust):
    lights, normal = ring(12), tilted(tilt_rad)
    image = 0.4 * lambertian(lights, normal[None])[:, :, None] * np.ones((1, 3, 5))
    found = estimate_normals(image, lights, robust=robust)
    np.testing.assert_allclose(found.normals[0, 0], normal, atol=1e-12)
    np.testing.assert_allclose(found.albedo, 0.4, atol=1e-12)
    assert found.normals.shape == (3, 5, 3)
    assert found.normals.dtype == np.float64


def test_surface_tilted_plus_x_brightens_from_plus_x():
    lights = ring(12)
    image = np.maximum(lights[:, 0], 0.0)[:, None] + 0.5 * lights[:, 2:]
    found = estimate_normals(image, lights, robust=False)
    assert found.normals[0, 0] > 0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_whole_numbers_are_read_as_they_are(dtype):
    lights, normal = ring(24), tilted(0.3)
    image = np.rint(200 * lambertian(lights, normal[None])).astype(dtype)
    kept = image.copy()
    found = estimate_normals(image, lights)
    assert found.normals.dtype == np.float32
    assert angular_error_rad(found.normals[0], normal) < 0.005
    np.testing.assert_array_equal(image, kept)


def test_points_of_any_shape_are_fitted_individually(rng):
    lights, normals = ring(20), caps(rng, 24)
    samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((20, 24))
    whole = estimate_normals(samples.reshape(20, 2, 3, 4), lights)
    alone = [estimate_normals(samples[:, k : k + 1], lights).normals[0] for k in range(24)]
    np.testing.assert_allclose(whole.normals.reshape(24, 3), alone, atol=1e-12)


def test_per_point_directions_and_near_lights_are_equal(rng):
    lights = 700.0 * ring(30)
    points = rng.uniform(-80, 80, (40, 3))
    normals = caps(rng, 40)
    towards = lights[:, None] - points[None]
    distance = np.linalg.norm(towards, axis=-1)
    direction = towards / distance[..., None]
    power = rng.uniform(0.5, 2.0, 30) * 700.0**2
    cosine = np.maximum(np.einsum("npk,pk->np", direction, normals), 0.0)
    samples = 0.6 * power[:, None] / distance**2 * cosine
    near = estimate_normals(
        samples, lights, light_positions_mm=lights, points_mm=points, light_intensity=power
    )
    given = estimate_normals(samples, direction, light_intensity=power[:, None] / distance**2)
    for found in (near, given):
        assert found.valid.all()
        np.testing.assert_allclose(found.normals, normals, atol=1e-9)
        np.testing.assert_allclose(found.albedo, 0.6, atol=1e-9)
    # the test can fail: lights taken to be far away leave degrees
    far = estimate_normals(samples, lights, light_intensity=power / 700.0**2)
    assert np.degrees(angular_error_rad(far.normals, normals)).mean() > 1.0


def reference_irls(lights, samples, *, shadow=0.1, steps=16, ends=8, tuning=4.685, grazing=0.05):
    """Fit one point as the kernel does, in plain NumPy."""
    bright = np.sort(samples)[::-1][min(len(samples), max(4, len(samples) // 8)) - 1]
    dark = shadow * bright
    if (samples < 0).any():
        dark = max(dark, 3.0 * np.sqrt(np.mean(samples[samples < 0] ** 2)))
    lit, soft = samples > dark, 0.01 * bright
    b = np.linalg.lstsq(lights[lit], samples[lit])[0]
    for _ in range(steps):
        w = 1.0 / np.maximum(np.abs(samples[lit] - lights[lit] @ b), soft)
        b = np.linalg.solve(
            (w[:, None] * lights[lit]).T @ lights[lit], lights[lit].T @ (w * samples[lit])
        )
    for step in range(ends):
        fit = lights @ b
        seen = fit > max(grazing * np.linalg.norm(b), 1.5 * dark)
        r = samples - fit
        if step in (0, 2):
            free = np.sort(np.abs(r[seen & lit]))[3:]
            scale = np.sort(free)[(len(free) - 1) // 2] / 0.67449
        w = np.where(seen, np.maximum(1 - (r / (tuning * scale)) ** 2, 0.0) ** 2, 0.0)
        b = np.linalg.solve((w[:, None] * lights).T @ lights, lights.T @ (w * samples))
    return b


def test_kernel_equals_numpy_implementation(rng):
    lights, normals = ring(40, 0.3), caps(rng, 30)
    samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((40, 30))
    samples[rng.random(samples.shape) < 0.1] = 0.0
    samples[rng.random(samples.shape) < 0.05] += 0.8
    found = estimate_normals(samples, lights)
    twin = np.array([reference_irls(lights, samples[:, k]) for k in range(30)])
    ours = found.normals * found.albedo[:, None]
    # the twin takes all steps, the kernel stops when a step is below 1e-3
    assert np.abs(ours - twin).max() < 2e-3


def outliers(rng, lights, normals, noise):
    """Return samples with a third in cast shadow and one in ten a highlight."""
    samples = lambertian(lights, normals) + noise * rng.standard_normal((len(lights), len(normals)))
    turn = np.arctan2(lights[:, 1], lights[:, 0])[:, None] + rng.uniform(0, 6, len(normals))
    samples[(np.cos(turn) > 0.5)] = 0.0
    samples[rng.random(samples.shape) < 0.1] += 0.7
    return samples.astype(np.float32)


def test_shadows_and_highlights_move_robust_fit_only_little(rng):
    lights, normals = ring(60, 0.4), caps(rng, 500)
    samples = outliers(rng, lights, normals, 0.01)
    robust = estimate_normals(samples, lights)
    plain = estimate_normals(samples, lights, robust=False)
    error = np.degrees(angular_error_rad(robust.normals, normals))
    squares = np.degrees(angular_error_rad(plain.normals, normals))
    assert robust.valid.all()
    assert error.mean() < 0.5
    assert squares.mean() > 5.0


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("count", [8, 40, 150])
def test_standard_errors_have_the_size_of_the_errors(known, count, rng):
    # mean of (error / stderr)^2 over 2000 points: chi square of about 2 x 2000 degrees of freedom,
    # heavier tails where the noise is estimated from few lights; 5 sigma of the sample's own spread
    lights, normals = ring(count), caps(rng, 2000, 0.4)
    noise = 0.01 * rng.uniform(0.5, 2.0, count) if known else np.full(count, 0.01)
    samples = lambertian(lights, normals) + noise[:, None] * rng.standard_normal((count, 2000))
    found = estimate_normals(samples, lights, variance=noise**2 if known else None, robust=False)
    assert found.valid.all()
    ratio = (angular_error_rad(found.normals, normals) / found.stderr_rad) ** 2
    expected = 1.0 if known else (count - 3) / (count - 5)  # mean of F(2, count - 3)
    assert abs(ratio.mean() - expected) < 5 * ratio.std() / np.sqrt(2000)


def test_standard_errors_of_the_robust_fit_cover(rng):
    lights, normals = ring(60), caps(rng, 4000, 0.4)
    samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((60, 4000))
    for variance in (None, 1e-4):
        found = estimate_normals(samples, lights, variance=variance)
        ratio = (angular_error_rad(found.normals, normals) / found.stderr_rad) ** 2
        assert 0.9 < ratio.mean() < 1.15
        albedo = (found.albedo - 1.0) / found.stderr_albedo
        assert 0.9 < np.mean(albedo**2) < 1.15
    # the test can fail: half the variance given, and nothing beyond chance to see it by
    few = ring(6)
    thin = lambertian(few, normals) + 0.01 * rng.standard_normal((6, 4000))
    found = estimate_normals(thin, few, variance=0.25e-4, robust=False)
    assert np.mean((angular_error_rad(found.normals, normals) / found.stderr_rad) ** 2) > 1.5


def test_understated_variance_is_detected_with_many_lights(rng):
    lights, normals = ring(100), caps(rng, 500, 0.4)
    samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((100, 500))
    found = estimate_normals(samples, lights, variance=1e-6, robust=False)
    ratio = (angular_error_rad(found.normals, normals) / found.stderr_rad) ** 2
    assert 0.8 < ratio.mean() < 1.2


def test_noisy_lights_weight_less_when_variance_is_known(rng):
    lights, normals = ring(20), caps(rng, 800, 0.4)
    noise = np.where(np.arange(20) % 2, 0.1, 0.002)
    samples = lambertian(lights, normals) + noise[:, None] * rng.standard_normal((20, 800))
    weighed = estimate_normals(samples, lights, variance=noise**2, robust=False)
    equal = estimate_normals(samples, lights, robust=False)
    ours = angular_error_rad(weighed.normals, normals).mean()
    assert ours < 0.1 * angular_error_rad(equal.normals, normals).mean()


def test_error_falls_with_root_of_light_count(rng):
    normals = caps(rng, 3000, 0.4)
    errors = []
    for count in (30, 120):
        lights = ring(count)
        samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((count, 3000))
        errors.append(angular_error_rad(estimate_normals(samples, lights).normals, normals).mean())
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def matte_few(rng, count, points=3000):
    """Return a matte surface with 2 % noise under soft shadows, lights, normals."""
    lights, normals = ring(count, 0.35), caps(rng, points, 1.0)
    turn = np.arctan2(lights[:, 1], lights[:, 0])[:, None] + rng.uniform(0, 6, points)
    shadow = np.clip((1.2 - np.cos(turn) - rng.random(points)) / 0.5, 0.0, 1.0)
    samples = 0.5 * lambertian(lights, normals) * shadow
    samples *= 1.0 + 0.02 * rng.standard_normal(samples.shape)
    samples += 0.002 * rng.standard_normal(samples.shape)
    return samples, lights, normals


@pytest.mark.parametrize("count", [8, 10, 12, 15])
def test_few_light_matte_fit_matches_weighted_least_squares(count, rng):
    samples, lights, normals = matte_few(rng, count)
    plain = estimate_normals(samples, lights, robust=False)
    ours = estimate_normals(samples, lights)
    always = estimate_normals(samples, lights, robustness=Robustness(few=0))
    both = plain.valid & ours.valid & always.valid
    error = [angular_error_rad(m.normals[both], normals[both]) for m in (plain, ours, always)]
    # paired over points; false alarms of 3 sigma, one side: 0.13 %
    more = error[1] - error[0]
    assert more.mean() < 3 * more.std() / np.sqrt(both.sum())
    # the test can fail: the robust fit alone takes edges of shadows for the surface
    worse = error[2] - error[0]
    assert worse.mean() > 3 * worse.std() / np.sqrt(both.sum())


def test_clear_highlights_are_omitted_under_few_lights(rng):
    lights, normals = ring(12, 0.4), caps(rng, 2000, 0.5)
    samples = lambertian(lights, normals) + 0.03 * rng.standard_normal((12, 2000))
    samples[rng.integers(0, 12, 2000), np.arange(2000)] += 0.8
    robust = angular_error_rad(estimate_normals(samples, lights).normals, normals)
    plain = angular_error_rad(estimate_normals(samples, lights, robust=False).normals, normals)
    assert robust.mean() < 0.5 * plain.mean()


# --- extremes


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("count", [3, 4, 6, 12, 33])
def test_extreme_pixels_are_masked_or_right_never_nan(count, robust):
    lights = ring(count)
    image = np.zeros((count, 8), np.float32)
    image[:, 1] = lights @ tilted(0.2)  # albedo 1
    image[:, 2] = 1.0  # all saturated, and said so
    image[0, 3] = 1e4  # one hot pixel in the dark
    image[:, 4] = np.nan
    image[:, 5] = lights @ tilted(0.2)
    image[count // 2, 5] = np.inf
    image[:, 6] = -0.01
    image[:, 7] = 1e-30 * (lights @ tilted(0.2))
    usable = np.ones(image.shape, bool)
    usable[:, 2] = False
    found = estimate_normals(image, lights, valid=usable, robust=robust)
    assert_clean(found)
    assert found.valid[1]
    assert angular_error_rad(found.normals[1], tilted(0.2)) < 1e-4
    assert not found.valid[[0, 2, 4]].any()
    assert found.valid[5] == (count > 3)
    if robust:
        assert not found.valid[[3, 6]].any()


def test_point_shadowed_from_half_its_lights_is_exact():
    lights = np.concatenate([ring(40, 0.0), -ring(40, 0.0)])
    normal = tilted(1.0)
    found = estimate_normals(lambertian(lights, normal[None]), lights)
    np.testing.assert_allclose(found.normals[0], normal, atol=1e-10)
    weighed = estimate_normals(lambertian(lights, normal[None]), lights, robust=False)
    np.testing.assert_allclose(weighed.normals[0], normal, atol=1e-10)
    wrong = estimate_normals(lambertian(lights, normal[None]), lights, robust=False, variance=1e-4)
    np.testing.assert_allclose(wrong.albedo, 0.5, atol=0.02)  # least squares halves it


def test_single_hot_pixel_does_not_move_normal():
    lights, normal = ring(16), tilted(0.3)
    image = lambertian(lights, normal[None])
    image[5] = 50.0
    found = estimate_normals(image, lights)
    np.testing.assert_allclose(found.normals[0], normal, atol=1e-9)
    assert found.used[0] == 15


def test_pixels_of_noise_alone_are_not_valid(rng):
    lights = ring(30)
    image = 0.01 * rng.standard_normal((30, 2000)).astype(np.float32)
    found = estimate_normals(image, lights, variance=1e-4)
    assert_clean(found)
    assert found.valid.mean() < 0.5


def test_three_lights_bound_errors_only_with_variance():
    lights, normal = ring(3), tilted(0.1)
    image = lambertian(lights, normal[None])
    unknown = estimate_normals(image, lights)
    known = estimate_normals(image, lights, variance=1e-4)
    assert unknown.valid[0]
    assert unknown.stderr_rad[0] == np.pi
    assert known.stderr_rad[0] < 0.2


def test_points_whose_good_lights_are_coplanar_are_masked():
    lights = np.concatenate([ring(8), [[1, 0, 0], [0, 0, 1], [0.6, 0, 0.8], [0.8, 0, 0.6]]])
    image = lambertian(lights, tilted(0.2)[None])
    usable = np.zeros(image.shape, bool)
    usable[8:] = True
    for robust in (True, False):
        assert not estimate_normals(image, lights, valid=usable, robust=robust).valid.any()


@pytest.mark.parametrize(
    ("lights", "expected"),
    [
        (ring(1), "lights of intensity: got"),
        (ring(2), "lights of intensity: got"),
        (np.tile([[0.0, 0.0, 1.0]], (5, 1)), "plane"),
        (np.array([[0, 0, 1], [1, 0, 0], [0.6, 0, 0.8], [-0.6, 0, 0.8]]), "plane"),
        (np.array([[0, 0, 1], [1, 0, 0], [0, 0, 0], [0, 1, 0]]), r"light_directions\[2\]"),
        (np.array([[0, 0, 1], [1, 0, 0], [0, np.nan, 0], [0, 1, 0]]), r"light_directions\[2\]"),
    ],
)
def test_lights_determining_no_normal_are_refused_by_name(lights, expected):
    with pytest.raises(PhotometricStereoError, match=expected):
        estimate_normals(np.ones((len(lights), 2, 2)), lights)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"valid": np.ones((3, 3), bool)}, "valid"),
        ({"valid": np.ones((2, 2))}, "valid"),
        ({"variance": np.ones(3)}, "variance"),
        ({"light_intensity": np.ones((2, 2))}, "light_intensity"),
        ({"light_intensity": -np.ones(6)}, "light_intensity"),
        ({"points_mm": np.ones((2, 2, 3))}, "both or neither"),
        ({"points_mm": np.ones((2, 3)), "light_positions_mm": np.ones((6, 3))}, "points_mm"),
    ],
)
def test_shapes_that_do_not_fit_are_named(change, expected):
    with pytest.raises(PhotometricStereoError, match=expected):
        estimate_normals(np.ones((6, 2, 2)), ring(6), **change)


def test_settings_out_of_range_are_named():
    with pytest.raises(PhotometricStereoError, match="shadow"):
        Robustness(shadow=1.0)


def test_tiles_and_threads_change_nothing(rng, monkeypatch):
    lights, normals = ring(12), caps(rng, 300)
    samples = outliers(rng, lights, normals, 0.01)
    whole = estimate_normals(samples, lights)
    monkeypatch.setattr(stereo, "TILE_POINTS", 37)
    tiled = estimate_normals(samples, lights)
    np.testing.assert_array_equal(whole.normals, tiled.normals)


def test_biweight_keeps_95_percent_of_least_squares_efficiency(rng):
    lights, normals = ring(60), caps(rng, 6000, 0.3)
    samples = lambertian(lights, normals) + 0.01 * rng.standard_normal((60, 6000))
    robust = angular_error_rad(estimate_normals(samples, lights).normals, normals)
    squares = estimate_normals(samples, lights, robust=False, variance=1e-4)
    plain = angular_error_rad(squares.normals, normals)
    efficiency = np.mean(plain**2) / np.mean(robust**2)
    draws = [rng.integers(0, 6000, 6000) for _ in range(200)]
    spread = np.std([np.mean(plain[k] ** 2) / np.mean(robust[k] ** 2) for k in draws])
    # 95 % for many lights, less for 60; five sigma
    assert 0.90 - 5 * spread < efficiency < 0.97 + 5 * spread
    assert spread < 0.01


@pytest.mark.parametrize("photons", [3.0, 10.0])
def test_few_photon_coverage_is_nominal_with_expected_variance(photons):
    """Rationale: Poisson counts, whose own variance is a draw as well. Expected: 68 % intervals
    hold 60 to 76 %. Tolerance: that range; 2000 points tell it to a percent.

    By each sample's own photons they hold fewer.
    """
    rng = np.random.default_rng(521)
    lights, read = ring(24), 0.25
    mean = np.repeat(photons * (lights @ tilted(0.2))[:, None], 2000, axis=1)
    samples = rng.poisson(mean) + np.sqrt(read) * rng.standard_normal(mean.shape)

    def held(variance):
        found = estimate_normals(samples, lights, variance=variance, robust=False)
        inside = np.abs(found.albedo - photons) < found.stderr_albedo
        return found, inside[found.valid].mean()

    found, _ = held(np.ones(24))
    for _ in range(3):
        normal = found.albedo[:, None] * found.normals
        found, share = held(np.maximum(lights @ normal.T, 0.0) + read)
    assert 0.60 < share < 0.76
    assert held(np.maximum(samples, 0.0) + read)[1] < 0.60
