"""Facet densities and energy of the rough dielectric surface."""

import numpy as np
import pytest

from model import fresnel
from model.brdf import microfacet

KINDS = ["ggx", "beckmann", "blinn"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6])
def test_projected_facets_cover_the_surface_once(kind, roughness):
    theta = (np.arange(200_000) + 0.5) / 200_000 * np.pi / 2
    density = microfacet.facet_density(np.cos(theta), roughness, kind)
    covered = np.sum(density * np.cos(theta) * 2 * np.pi * np.sin(theta)) * np.pi / 2 / 200_000
    assert covered == pytest.approx(1.0, abs=2e-4)


def reflected(theta_light, roughness, kind, eta):
    """Integrate BRDF times cosine over all views."""
    mu = (np.arange(700) + 0.5) / 700
    phi = (np.arange(700) + 0.5) / 700 * np.pi
    mu_v, azimuth = np.meshgrid(mu, phi, indexing="ij")
    mu_l, s_l = np.cos(theta_light), np.sin(theta_light)
    cos_2d = s_l * np.sqrt(1 - mu_v**2) * np.cos(azimuth) + mu_l * mu_v
    cos_d = np.sqrt(0.5 * (1 + cos_2d))
    cos_h = (mu_l + mu_v) / (2 * cos_d)
    f = microfacet.brdf(mu_l, mu_v, cos_h, cos_d, roughness=roughness, eta=eta, kind=kind)
    return float(np.mean(f * mu_v) * 2 * np.pi)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("theta_light", [0.0, 0.6, 1.1])
def test_nearly_smooth_surface_reflects_fresnel_fraction_once(kind, theta_light):
    expected = float(fresnel.reflectance(np.cos(theta_light), 1.4))
    assert reflected(theta_light, 0.05, kind, 1.4) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("kind", KINDS)
def test_surface_never_reflects_more_than_incident_light(kind):
    for roughness in (0.1, 0.4, 0.5 if kind == "blinn" else 0.9):
        for theta_light in (0.0, 1.0, 1.4):
            assert reflected(theta_light, roughness, kind, 1e6) < 1.01


def test_surface_is_finite_at_and_behind_horizon():
    f = microfacet.brdf([0.0, -0.5], 0.0, 1.0, 0.0, roughness=0.2, eta=1.4)
    assert np.all(np.isfinite(f))
    with pytest.raises(ValueError, match="roughness"):
        microfacet.facet_density(1.0, 0.0)
