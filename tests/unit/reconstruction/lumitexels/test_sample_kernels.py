"""Compiled passes over samples against plain twins in NumPy."""

import numba
import numpy as np
import pytest

from model import fresnel
from reconstruction.lumitexels import sample_kernels

P, M = 37, 50
LEAST = 0.05


def units(rng, *shape):
    vectors = rng.standard_normal((*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def passed(cos_light, cos_view):
    inside = 1.0 - fresnel.reflectance(np.clip(cos_light, 0.0, 1.0), fresnel.ETA_SKIN)
    return inside * (1.0 - fresnel.reflectance(np.clip(cos_view, 0.0, 1.0), fresnel.ETA_SKIN))


@pytest.fixture
def given(rng):
    """Samples, of which some are invalid, with their normals."""
    normals = units(rng, P)
    around = (normals[:, None] + 0.9 * units(rng, P, M) for _ in range(2))
    light, view = ((v / np.linalg.norm(v, axis=-1, keepdims=True)).astype("f4") for v in around)
    f, variance = rng.uniform(0.1, 1.0, (2, P, M, 3)).astype("f4")
    scan = rng.uniform(0.2, 1.0, (2, P, M)).astype("f4")
    valid = rng.random((P, M)) < 0.8
    f[3, 4], variance[5, 6] = np.nan, np.inf
    valid[3, 4] = valid[5, 6] = False
    return f, variance, light, view, *scan, valid, normals


def cosines(light, view, normals):
    return (np.einsum("pmk,pk->pm", way.astype(float), normals) for way in (light, view))


def test_reprojected_samples_equal_plain_twin(given):
    f, variance, light, view, cos_light, cos_view, valid, normals = given
    known = np.arange(P) % 5 > 0
    out = [np.full_like(v, 7) for v in (f, variance, cos_light, cos_view, valid)]
    sample_kernels.reproject(
        (f, variance, light, view, cos_light, cos_view, valid), normals, known, LEAST, tuple(out)
    )
    cl, cv = cosines(light, view, normals)
    good = valid & known[:, None] & (cl > LEAST)
    assert 0.2 < good.mean() < 0.8
    ratio = (cos_light / np.where(good, cl, 1.0))[..., None]
    np.testing.assert_array_equal(out[4], good)
    np.testing.assert_allclose(out[0], np.where(good[..., None], f * ratio, 0.0), rtol=1e-6)
    expected = np.where(good[..., None], variance * ratio**2, np.inf)
    np.testing.assert_allclose(out[1], expected, rtol=1e-6)
    np.testing.assert_allclose(out[2], np.where(good, cl, cos_light), rtol=1e-6)
    np.testing.assert_allclose(out[3], np.where(good, cv, cos_view), rtol=1e-6)


def test_shading_equals_plain_twin(given):
    f, variance, light, view, cos_light, _, valid, normals = given
    limits = (0.1, 0.2, 0.9)
    out = np.empty((M, P), "f4"), np.empty((M, P), "f4"), np.empty((M, P), bool)
    samples = f, variance, light, view, cos_light, valid
    sample_kernels.shade(samples, normals, limits, fresnel.ETA_SKIN, out)
    cl, cv = cosines(light, view, normals)
    half = light.astype(float) + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    good = valid & (cl > limits[0]) & (cv > limits[1])
    good &= np.einsum("pmk,pk->pm", half, normals) < limits[2]
    assert 0.1 < good.mean() < 0.8
    scale = np.pi * cos_light / np.maximum(passed(cl, cv), 1e-3)
    np.testing.assert_array_equal(out[2], good.T)
    expected = np.where(good, f.astype(float).mean(axis=-1) * scale, 0.0)
    np.testing.assert_allclose(out[0], expected.T, rtol=1e-6)
    expected = np.where(good, variance.astype(float).mean(axis=-1) / 3 * scale**2, 1.0)
    np.testing.assert_allclose(out[1], expected.T, rtol=1e-6)


@pytest.mark.parametrize("known", [False, True])
def test_specular_part_equals_plain_twin(given, rng, known):
    f, variance, light, view, _, _, valid, normals = given
    r_d = rng.uniform(0.1, 0.6, (P, 3))
    r_d[7] = np.nan
    out = np.empty((P, M), "f4"), np.empty((P, M), "f4"), np.empty((P, M), bool)
    spread = variance if known else np.empty((P, M, 0), "f4")
    sample_kernels.subtract_diffuse(
        f, spread, (light, view), normals, r_d, valid, fresnel.ETA_SKIN, 0.1, out
    )
    cl, cv = cosines(light, view, normals)
    rest = f - passed(cl, cv)[..., None] * r_d[:, None] / np.pi
    good = valid & (cl >= 0.1) & (cv >= 0.1) & np.isfinite(rest).all(axis=-1)
    assert 0.1 < good.mean() < 0.8
    assert not good[7].any()
    weight = 1.0 / np.where(good[..., None], variance, 1.0) if known else np.ones((P, M, 3))
    total = weight.sum(axis=-1)
    np.testing.assert_array_equal(out[2], good)
    value = (weight * np.where(good[..., None], rest, 0.0)).sum(axis=-1) / total * cl
    np.testing.assert_allclose(out[0], value, rtol=1e-5, atol=1e-7)
    expected = np.where(good, cl**2 / total if known else 0.0, 1.0)
    np.testing.assert_allclose(out[1], expected, rtol=1e-6)


def test_samples_do_not_depend_on_number_of_threads(given):
    f, variance, light, view, cos_light, _, valid, normals = given
    before, found = numba.get_num_threads(), []
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            out = np.empty((M, P), "f4"), np.empty((M, P), "f4"), np.empty((M, P), bool)
            samples = f, variance, light, view, cos_light, valid
            sample_kernels.shade(samples, normals, (0.1, 0.2, 0.9), fresnel.ETA_SKIN, out)
            found.append([v.tobytes() for v in out])
    finally:
        numba.set_num_threads(before)
    assert found[0] == found[-1]
