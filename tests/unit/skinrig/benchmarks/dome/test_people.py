"""Statistics of a region's BRDF, against closed forms and independent integrals."""

import numpy as np
import pytest

from rigsim.light import surface_brdf
from skinrig.benchmarks.dome import people


def skin(*, roughness, oil=0.0):
    """Return the surface part of the simulator's BRDF."""
    packed = np.array([0.4, 0.3, 0.2, roughness, oil, 0.0, 1.0], np.float32)
    return lambda light, view: surface_brdf.evaluate_brdf(
        packed, people.SURFACE_NORMAL, light, view
    )[1]


@pytest.mark.parametrize("roughness", [0.2, 0.3, 0.4])
def test_facet_roughness_is_that_of_beckmann(roughness):
    found = people.facet_roughness(skin(roughness=roughness))
    # slopes beyond 45 degrees are cut: exp(-1 / 0.4^2) = 0.2 % of the facets
    assert found == pytest.approx(roughness, rel=0.02)


def test_oil_lowers_roughness_and_raises_reflectance():
    dry, oily = skin(roughness=0.3), skin(roughness=0.3, oil=0.4)
    assert people.facet_roughness(oily) < 0.9 * people.facet_roughness(dry)
    assert people.specular_reflectance(oily) > 1.05 * people.specular_reflectance(dry)


def test_specular_reflectance_equals_monte_carlo_integral(rng):
    reflect = skin(roughness=0.3)
    n = 100_000
    z = rng.uniform(np.cos(np.radians(people.MAX_REFLECTED_DEG)), 1.0, n)
    turn = rng.uniform(0.0, 2.0 * np.pi, n)
    ring = np.sqrt(1.0 - z**2)
    out = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    angle = np.radians(people.INCIDENCE_DEG)
    incident = np.tile([np.sin(angle), 0.0, np.cos(angle)], (n, 1))
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(people.MAX_REFLECTED_DEG)))
    each = solid_angle * reflect(incident, out) * z
    stderr = each.std() / np.sqrt(n)
    # four standard errors, and 0.5 % of the 24 x 24 grid
    expected = each.mean()
    found = people.specular_reflectance(reflect)
    assert abs(found - expected) < 4 * stderr + 0.005 * expected


def test_dark_surface_has_no_roughness():
    assert np.isnan(people.facet_roughness(lambda light, view: np.zeros(len(light))))
