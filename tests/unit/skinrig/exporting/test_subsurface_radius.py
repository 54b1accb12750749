"""Radius and color of subsurface light: against exact transport of light, not our own formula."""

import numpy as np
import pytest
from scipy.optimize import brentq

from model.tissue_optics import layer_stack_reflectance
from skinrig.exporting.subsurface_radius import deficit_root, radius_mm, translucency_mm


@pytest.mark.parametrize("color", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_the_medium_of_a_color_shows_that_color_by_exact_transport(color):
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


def test_the_radius_gives_the_measured_decay_back(rng):
    depth, color = rng.uniform(0.2, 8.0, 50), rng.uniform(0.02, 0.98, 50)
    np.testing.assert_allclose(translucency_mm(radius_mm(depth, color), color), depth, rtol=1e-12)
    # sigma_tr = sqrt(3 sigma_a sigma_t') of the medium that the renderer will build
    total = 1.0 / radius_mm(depth, color)
    absorbed = total * deficit_root(color) ** 2
    np.testing.assert_allclose(1.0 / np.sqrt(3.0 * absorbed * total), depth, rtol=1e-12)


@pytest.mark.parametrize(("albedo", "above"), [(0.9, 0.042), (0.7, 0.145)])
def test_diffusion_decays_faster_than_light_by_what_the_docs_say(albedo, above):
    """Exact: albedo / (2 k) ln((1 + k) / (1 - k)) = 1 for the decay k in units of sigma_t."""
    exact = brentq(lambda k: albedo / (2 * k) * np.log((1 + k) / (1 - k)) - 1, 1e-6, 1 - 1e-9)
    assert np.sqrt(3.0 * (1.0 - albedo)) / exact - 1.0 == pytest.approx(above, abs=0.002)


def test_white_and_black_have_finite_radii():
    assert np.isfinite(radius_mm(1.0, [-0.2, 0.0, 1.0, 1.3])).all()
