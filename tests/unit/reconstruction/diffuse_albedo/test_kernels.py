"""The envelope fit in whole vectors, against plain NumPy, at few and odd numbers of samples."""

from pathlib import Path

import numpy as np
import pytest

from model import fresnel
from reconstruction.diffuse_albedo import kernels

ETA, TILT_RAD = 1.4, 0.02


def make_lobes(mu, nu, cos_h, cos_d):
    """Return the lobes, shape (6, n): D F / (2 pi hidden), as in Walter et al. (2007)."""
    lobes = []
    rough = kernels.BECKMANN_ROUGHNESS + kernels.GGX_ROUGHNESS
    for k, alpha in enumerate(rough):
        a2, c2 = alpha**2, cos_h**2
        if k < len(kernels.BECKMANN_ROUGHNESS):
            density = np.exp(np.maximum((1.0 - 1.0 / c2) / a2, -80.0)) / (a2 * c2**2)
        else:
            density = a2 / (1.0 + c2 * (a2 - 1.0)) ** 2
        hidden = nu * np.sqrt(a2 + (1.0 - a2) * mu**2) + mu * np.sqrt(a2 + (1.0 - a2) * nu**2)
        lobes.append(density * fresnel.reflectance(cos_d, ETA) / (2.0 * np.pi * hidden))
    return np.array(lobes)


def fit_plain(f, variance, light, view, normal, valid, start):
    """Return R_d, its standard error, and samples used and dropped of one point."""
    light, view = light.astype(np.float64), view.astype(np.float64)
    mu, nu = light @ normal.astype(np.float64), view @ normal.astype(np.float64)
    keep = valid.any(axis=1) & (mu >= kernels.MIN_FACTOR_COSINE) & (nu >= kernels.MIN_FACTOR_COSINE)
    channels = f.shape[1]
    used = valid[keep].astype(np.float64)
    if not keep.any() or not used.sum(axis=0).all():
        return np.full(channels, np.nan), np.full(channels, np.nan), [0, 0]
    between = np.einsum("ij,ij->i", light, view)[keep]
    mu, nu = np.minimum(mu[keep], 1.0), np.minimum(nu[keep], 1.0)
    value = np.where(used > 0.0, f[keep], 0.0).astype(np.float64)
    noise = np.where(used > 0.0, variance[keep], 1.0).astype(np.float64)
    cos_d = np.sqrt(0.5 * (1.0 + between))
    lobes = make_lobes(mu, nu, np.minimum((mu + nu) / (2.0 * cos_d), 1.0), cos_d)
    passed = (1.0 - fresnel.reflectance(mu, ETA)) * (1.0 - fresnel.reflectance(nu, ETA)) / np.pi
    steep = np.sqrt(np.maximum(1.0 / mu**2 - 1.0, 0.0))
    n, seen = channels + len(lobes), used.sum(axis=0)
    x, scale = np.append(start, np.zeros(len(lobes))), np.ones(channels)
    free, low, b = np.empty(n, np.int64), np.empty((n, n)), np.empty(n)
    for step in range(kernels.N_FIT_STEPS):
        cut = kernels.TUKEY_SIGMAS * 2.0 ** max(4 - step, 0) if step <= 3 else kernels.TUKEY_SIGMAS
        shine = x[channels:] @ lobes
        h, rhs, clipped, kept = np.zeros((n, n)), np.zeros(n), np.zeros(channels), 0
        for c in range(channels):
            dull = x[c] * passed
            shaped = kernels.LOBE_SHAPE_ERROR * shine
            total = noise[:, c] * scale[c] + (TILT_RAD * steep * dull) ** 2 + shaped**2
            z2 = (value[:, c] - dull - shine) ** 2 / total
            clipped[c] = used[:, c] @ np.minimum(z2, kernels.CLIP_SIGMAS**2)
            share = np.maximum(1.0 - z2 / cut**2, 0.0)
            kept += int(used[:, c] @ (share > 0.0))
            weight = used[:, c] * share**2 / total
            columns = np.zeros((n, len(mu)))
            columns[c], columns[channels:] = passed, lobes
            h += (columns * weight) @ columns.T
            rhs += columns @ (weight * value[:, c])
        if seen.min() < 3:
            lobe = np.arange(channels, n)
            h[lobe, lobe] = 0.0
        size = kernels._bounded(h, rhs, channels, free, low, b, x)
        scale = np.where(
            seen > 3, np.maximum(scale * clipped / seen / kernels.CLIPPED_MEAN, 1.0), scale
        )
    picked = free[:size]
    stderr = np.sqrt(np.diag(np.linalg.inv(h[np.ix_(picked, picked)]))[:channels])
    return x[:channels], stderr, [kept, int(seen.sum()) - kept]


def directions(rng, *shape):
    way = rng.standard_normal((*shape, 3))
    way[..., 2] = np.abs(way[..., 2]) + 0.3
    return (way / np.linalg.norm(way, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("samples", [1, 2, 7, 33, 65])
def test_envelope_fit_equals_plain_one(rng, samples, channels):
    points = 5
    light, view = directions(rng, points, samples), directions(rng, points, samples)
    normal = directions(rng, points)
    f = rng.uniform(0.1, 0.2, (points, samples, channels)).astype(np.float32)
    f[:, ::6] *= 3.0  # highlights, which lobes or the biweight take
    variance = np.float32(1e-4) * (1.0 + rng.random(f.shape, np.float32))
    valid = rng.random(f.shape) < 0.85
    start = np.full((points, channels), 0.4)
    r_d, stderr = np.empty((points, channels)), np.empty((points, channels))
    counts = np.zeros((points, 2), np.int64)
    data = (f, variance, light, view, normal, valid)
    out = (r_d, stderr, counts)
    kernels.fit_envelope(*data, start, ETA, TILT_RAD, True, *out, 0, points)
    for p in range(points):
        expected = fit_plain(*(one[p] for one in data), start[p])
        np.testing.assert_allclose(r_d[p], expected[0], rtol=1e-7, err_msg=str(p))
        np.testing.assert_allclose(stderr[p], expected[1], rtol=1e-6, err_msg=str(p))
        assert counts[p].tolist() == expected[2]
    assert samples < 7 or np.isfinite(r_d).all()


def test_lobes_not_in_threes_are_refused():
    text = Path(kernels.__file__).read_text("utf-8")
    fewer = text.replace("GGX_ROUGHNESS = (0.2, 0.35)", "GGX_ROUGHNESS = (0.2,)")
    assert fewer != text
    head = fewer[: fewer.index("@njit")]  # before anything is compiled
    with pytest.raises(ImportError, match="multiple of 3"):
        exec(compile(head, "kernels", "exec"), {})
