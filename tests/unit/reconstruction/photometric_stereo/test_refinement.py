"""Normals turned until a fitted BRDF explains the samples; its parameters are known here."""

import numpy as np
import pytest

from model.metrics import angular_error_rad
from reconstruction import photometric_stereo
from reconstruction.normal_maps import PhotometricStereoError

RHO, GLOSS, EXPONENT = 0.3, 0.12, 25.0


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def glossy(n, light, view, points=None):
    """Return f_r (P, M), 1/sr, of a diffuse part and a lobe around the half vector."""
    half = unit(light + view)
    return RHO / np.pi + GLOSS * np.maximum(np.einsum("pmk,pk->pm", half, n), 0.0) ** EXPONENT


def matte(n, light, view, points=None):
    return np.full(light.shape[:2], RHO / np.pi)


def samples(rng, count=60, lights=40, views=3, noise=0.002):
    """Return values (P, M), light_dir, view_dir, true normals."""
    direction = unit(rng.standard_normal((lights, 3)) + np.array([0, 0, 1.2]))
    camera = unit(rng.standard_normal((views, 3)) * 0.5 + [0, 0, 1.5])
    light = np.broadcast_to(np.tile(direction, (views, 1)), (count, lights * views, 3))
    view = np.broadcast_to(np.repeat(camera, lights, axis=0), light.shape)
    n = unit(rng.standard_normal((count, 3)) * 0.25 + [0, 0, 1])
    values = glossy(n, light, view) * np.maximum(np.einsum("pmk,pk->pm", light, n), 0.0)
    return values + noise * rng.standard_normal(values.shape), light, view, n


def nudged(rng, n, angle_rad=0.05):
    return unit(n + angle_rad * rng.standard_normal(n.shape))


def test_a_known_brdf_brings_normals_back_to_the_noise(rng):
    values, light, view, n = samples(rng)
    start = nudged(rng, n)
    found = photometric_stereo.refine(values, light, view, start, glossy, variance=4e-6)
    before = angular_error_rad(start, n).mean()
    after = angular_error_rad(found.normals, n).mean()
    assert found.valid.all()
    assert after < 0.1 * before
    np.testing.assert_allclose(found.albedo, 1.0, atol=0.05)
    # the test can fail: with a matte BRDF the highlight turns the normals
    matt = photometric_stereo.refine(values, light, view, start, matte, variance=4e-6)
    assert angular_error_rad(matt.normals, n)[matt.valid].mean() > 3 * after


@pytest.mark.parametrize("known", [True, False])
def test_standard_errors_have_the_size_of_the_errors(known, rng):
    values, light, view, n = samples(rng, count=600, lights=30, views=2)
    found = photometric_stereo.refine(
        values, light, view, nudged(rng, n, 0.02), glossy, variance=4e-6 if known else None
    )
    ratio = (angular_error_rad(found.normals, n) / found.stderr_rad)[found.valid] ** 2
    assert found.valid.mean() > 0.99
    assert abs(ratio.mean() - 1.0) < 5 * ratio.std() / np.sqrt(600) + 0.1


def test_an_albedo_that_is_off_turns_no_normals(rng):
    values, light, view, n = samples(rng, noise=0.0)
    start = nudged(rng, n, 0.02)
    found = photometric_stereo.refine(1.3 * values, light, view, start, glossy)
    assert angular_error_rad(found.normals, n).max() < 1e-4
    np.testing.assert_allclose(found.albedo, 1.3, rtol=1e-3)
    held = photometric_stereo.refine(1.3 * values, light, view, start, glossy, free_scale=False)
    assert angular_error_rad(held.normals, n)[held.valid].mean() > 0.01


def test_shadows_and_sparks_move_the_normals_little(rng):
    values, light, view, n = samples(rng)
    clean = photometric_stereo.refine(values, light, view, n, glossy, variance=4e-6)
    values = np.where(rng.random(values.shape) < 0.15, 0.0, values)
    values = np.where(rng.random(values.shape) < 0.05, values + 0.3, values)
    found = photometric_stereo.refine(values, light, view, nudged(rng, n), glossy, variance=4e-6)
    worst = 2.0 * angular_error_rad(clean.normals, n).mean()
    assert angular_error_rad(found.normals, n)[found.valid].mean() < worst


def test_predicted_values_of_a_matte_surface_give_the_linear_solution(rng):
    _, light, view, n = samples(rng, noise=0.0)
    f_r = matte(n, light, view)
    values = f_r * np.maximum(np.einsum("pmk,pk->pm", light, n), 0.0)
    found = photometric_stereo.refine(values, light, view, nudged(rng, n), f_r)
    assert angular_error_rad(found.normals, n).max() < 1e-6


def test_extreme_points_are_masked_and_never_nan(rng):
    values, light, view, n = samples(rng, count=8)
    usable = np.ones(values.shape, bool)
    values[0] = 0.0
    values[1] = np.nan
    usable[2] = False
    usable[3, 2:] = False
    start = nudged(rng, n, 0.01)
    start[4] = 0.0
    start[5] = -start[5]  # everything behind
    values[6, 3] = np.inf
    found = photometric_stereo.refine(values, light, view, start, glossy, valid=usable)
    for name in ("normals", "albedo", "residual", "stderr_rad"):
        assert np.isfinite(getattr(found, name)).all(), name
    assert found.valid.tolist()[1:] == [False, False, False, False, False, True, True]


def test_tiles_change_nothing(rng, monkeypatch):
    values, light, view, n = samples(rng, count=10)
    seen = []

    def predict(normals, light_dir, view_dir, points):
        seen.append(points)
        return glossy(normals, light_dir, view_dir)

    whole = photometric_stereo.refine(values, light, view, n, glossy)
    monkeypatch.setattr(
        "reconstruction.photometric_stereo.refinement.TILE_SAMPLES", 3 * values.shape[1]
    )
    tiled = photometric_stereo.refine(values, light, view, n, predict)
    np.testing.assert_allclose(tiled.normals, whole.normals, atol=1e-9)
    assert set(np.concatenate(seen).tolist()) == set(range(10))


def test_shapes_that_do_not_fit_are_named(rng):
    values, light, view, n = samples(rng, count=4)
    with pytest.raises(PhotometricStereoError, match="view_dir"):
        photometric_stereo.refine(values, light, view[:, :3], n, glossy)
    with pytest.raises(PhotometricStereoError, match="variance"):
        photometric_stereo.refine(values, light, view, n, glossy, variance=np.ones(7))
