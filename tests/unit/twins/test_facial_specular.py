"""Kelemen and Szirmay-Kalos' reflection: reciprocity, energy, limits."""

from __future__ import annotations

import numpy as np
import pytest
from twins.facial_specular import F0, kelemen, schlick

from model import fresnel


def _hemisphere(cosines=64, turns=128):
    x, w = np.polynomial.legendre.leggauss(cosines)
    mu, weight = 0.5 * (x + 1.0), 0.5 * w
    phi = 2.0 * np.pi * (np.arange(turns) + 0.5) / turns
    sine = np.sqrt(1.0 - mu**2)
    way = np.stack(
        [
            sine[:, None] * np.cos(phi),
            sine[:, None] * np.sin(phi),
            np.broadcast_to(mu[:, None], (cosines, turns)),
        ],
        axis=-1,
    )
    return way, np.broadcast_to((weight * mu * 2.0 * np.pi / turns)[:, None], (cosines, turns))


def _tilted(angle):
    return np.array([np.sin(angle), 0.0, np.cos(angle)])


@pytest.mark.parametrize("roughness", [0.2, 0.35, 0.5])
def test_exchanging_light_and_eye_changes_nothing(roughness):
    way, _ = _hemisphere(8, 12)
    z = np.array([0.0, 0.0, 1.0])
    there = kelemen(z, _tilted(0.6), way, roughness)
    back = kelemen(z, way, _tilted(0.6), roughness)
    np.testing.assert_allclose(there, back, rtol=1e-12)


@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5])
@pytest.mark.parametrize("angle", [0.0, 0.7, 1.2])
def test_less_light_is_reflected_than_falls_in(roughness, angle):
    way, weight = _hemisphere()
    total = float(
        np.sum(weight * kelemen(np.array([0.0, 0.0, 1.0]), way, _tilted(angle), roughness))
    )
    assert total < 0.5
    if angle == 0.0:
        # facets that face the eye reflect F0 of what they get; 1/(4 (l.h)^2) is exact for a peak
        assert total == pytest.approx(F0, rel=0.25)


def test_smooth_surface_has_fresnel_reflectance_at_normal_incidence():
    way, weight = _hemisphere(400, 16)
    total = float(np.sum(weight * kelemen([0.0, 0.0, 1.0], way, [0.0, 0.0, 1.0], 0.05)))
    assert total == pytest.approx(F0, rel=0.02)


def test_light_from_behind_is_not_reflected():
    assert float(kelemen([0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, 0.0, 1.0], 0.3)) == 0.0


def test_schlick_is_near_fresnels_equations_for_skin():
    cosine = np.linspace(0.2, 1.0, 9)
    exact = fresnel.reflectance(cosine, 1.4)
    # the least near at 78 degrees, where both are a third
    assert np.abs(schlick(cosine) - exact).max() < 0.03
