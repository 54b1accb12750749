"""Radius and color of subsurface light: against exact transport of light, not our own formula."""

import numpy as np
import pytest
from scipy.optimize import brentq

from model.tissue_optics.layers import layer_stack_reflectance
from skinrig.exporting.materials.material import similarity_albedo_deficit
from skinrig.exporting.materials.subsurface_radius import (
    decay,
    deficit_root,
    radius_mm,
    translucency_mm,
)


@pytest.mark.parametrize("color", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_medium_of_color_shows_color_by_exact_transport(color):
    """Half space of the same index, isotropic scattering, light at normal incidence.

    The published fit is of even light from all sides: at normal incidence less comes back.
    """
    deficit = float(deficit_root(color)) ** 2
    shown = layer_stack_reflectance([deficit], [1.0 - deficit], [np.inf], eta=1.0)
    even = _even_light(1.0 - deficit)
    assert abs(even - color) < 0.01
    assert float(shown) < even


def _even_light(albedo, nodes=400):
    """Spherical albedo of a half space by Chandrasekhar's H function."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    mu, w = 0.5 * (x + 1.0), 0.5 * w
    h = np.ones(nodes)
    root = np.sqrt(1.0 - albedo)
    for _ in range(2000):
        new = 1.0 / (root + 0.5 * albedo * ((mu * h * w)[None] / (mu[:, None] + mu[None])).sum(1))
        if np.abs(new - h).max() < 1e-12:
            break
        h = new
    return float(1.0 - 2.0 * root * np.sum(mu * h * w))


def exact_decay(albedo):
    """Solve albedo / (2 k) ln((1 + k) / (1 - k)) = 1 for the decay k in units of sigma_t."""
    return brentq(lambda k: albedo / (2 * k) * np.log((1 + k) / (1 - k)) - 1, 1e-9, 1 - 1e-15)


@pytest.mark.parametrize("albedo", [0.2, 0.4, 0.7, 0.9, 0.99, 0.99999])
def test_light_decay_matches_transport_theory(albedo):
    assert decay(1.0 - albedo) == pytest.approx(exact_decay(albedo), rel=1e-5)


def test_diffusion_alone_deviates_as_documented():
    """sqrt(3 (1 - albedo)) over the exact decay: why the exact one is used."""
    off = [np.sqrt(3.0 * (1.0 - a)) / exact_decay(a) for a in (0.9, 0.7, 0.4)]
    np.testing.assert_allclose(off, [1.042, 1.145, 1.361], atol=0.002)


def test_renderer_medium_decays_like_measured_medium(rng):
    for depth, color, deficit in rng.uniform([0.2, 0.05, 0.02], [8.0, 0.95, 0.6], (20, 3)):
        radius = float(radius_mm(depth, color, deficit))
        rendered = exact_decay(1.0 - float(deficit_root(color)) ** 2) / radius
        total = 1.0 / (depth * np.sqrt(3.0 * deficit))  # sigma_t' of the measured medium
        assert rendered == pytest.approx(exact_decay(1.0 - deficit) * total, rel=2e-5)


def test_the_radius_gives_the_measured_translucency_back(rng):
    depth, color, deficit = rng.uniform([0.2, 0.0, 0.02], [8.0, 1.0, 0.6], (50, 3)).T
    radius = radius_mm(depth, color, deficit)
    np.testing.assert_allclose(translucency_mm(radius, color, deficit), depth, rtol=1e-12)


def test_albedos_are_looked_up_as_they_are_inverted(rng):
    from model import dipole

    r_d = rng.uniform(0.002, 0.998, 200)
    exact = dipole.invert_to_deficit(r_d, 1.4)
    np.testing.assert_allclose(similarity_albedo_deficit(r_d, 1.4), exact, rtol=1e-4, atol=1e-7)


def test_white_black_and_unknown_media_have_finite_radii():
    color = [-0.2, 0.0, 1.0, 1.3]
    for deficit in (0.0, 1e-12, 1.0, np.nan):
        found = radius_mm(1.0, color, deficit)
        assert np.isfinite(found).all()
        assert (found > 0.0).all()
