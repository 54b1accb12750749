"""The hidden part of a relief's sky, against plain sums over elevations."""

import math

import numpy as np
import pytest

from model.fresnel import reflectance
from rigsim.light import hidden_sky_kernels
from rigsim.light.relief_shadow import HorizonError, hidden_sky_fraction, horizon_tangent
from rigsim.tissue.skin_layers import ETA

SECTORS = 8
MARGIN = 3


def make_relief(rng, shape):
    """Return heights with a margin, and normals of any tilt below 80 degrees."""
    wide = tuple(n + 2 * MARGIN for n in shape)
    height = (2.0 * rng.standard_normal(wide)).cumsum(axis=1).astype(np.float32)
    turn, tilt = rng.uniform(0.0, 2.0 * math.pi, shape), rng.uniform(0.0, 1.4, shape)
    normals = [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
    return height, np.stack(normals, axis=-1).astype(np.float32)


def sum_plain(height, normals, nodes):
    """Return the hidden fraction by Gauss's rule between tangent plane and horizon."""
    place, weight = np.polynomial.legendre.leggauss(nodes)
    inner = slice(MARGIN, -MARGIN)
    out = np.zeros(normals.shape[:2])
    for k in range(SECTORS):
        angle = 2.0 * math.pi * k / SECTORS
        tangent = horizon_tangent(height, pixel_um=1.0, azimuth_rad=angle)[inner, inner]
        along = normals[..., 0] * math.cos(angle) + normals[..., 1] * math.sin(angle)
        low = np.arctan2(-along, normals[..., 2].astype(np.float64))
        half = np.maximum(0.5 * (np.arctan(tangent.astype(np.float64)) - low), 0.0)
        for x, share in zip(place, weight, strict=True):
            elevation = low + half * (1.0 + x)
            cosine = along * np.cos(elevation) + normals[..., 2] * np.sin(elevation)
            passed = 1.0 - reflectance(np.clip(cosine, 0.0, 1.0), ETA)
            out += 2.0 / SECTORS * share * half * cosine * np.cos(elevation) * passed**2
    return out


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (7, 13), (2, 33)])
def test_boundaries_equal_plain_quadrature_at_odd_sizes(rng, shape):
    height, normals = make_relief(rng, shape)
    settings = {"margin": MARGIN, "pixel_um": 1.0, "sectors": SECTORS}
    found = hidden_sky_fraction(height, normals, **settings, boundaries=True)
    nodes = hidden_sky_kernels.ELEVATION_NODES
    np.testing.assert_allclose(found, sum_plain(height, normals, nodes), atol=2e-7)
    np.testing.assert_allclose(found, sum_plain(height, normals, 200), atol=2e-3)
    assert found.max() > 0.05


def test_normals_without_length_or_across_add_zero():
    normals = np.zeros((3, 1, 3), np.float32)
    normals[1, 0, 1] = normals[2, 0, 2] = 1.0  # the second across the sector
    out, tangent = np.zeros((1, 3), np.float32), np.full((1, 3), 0.5, np.float32)
    hidden_sky_kernels.add_sector_through(out, normals.T.copy(), tangent, 0.0, 0.1)
    assert out[0, :2].tolist() == [0.0, 0.0]
    assert out[0, 2] > 0.0


@pytest.mark.parametrize("boundaries", [False, True])
def test_normals_that_face_down_are_refused(boundaries):
    normals = np.float32([[[0.6, 0.0, 0.8], [0.6, 0.0, -0.8]]])
    settings = {"margin": 0, "pixel_um": 1.0, "sectors": 4, "boundaries": boundaries}
    with pytest.raises(HorizonError, match="1 with z < 0"):
        hidden_sky_fraction(np.zeros((1, 2), np.float32), normals, **settings)
