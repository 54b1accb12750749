"""Fresnel averages against values computed independently and against each other."""

import numpy as np
import pytest

from model import fresnel


@pytest.mark.parametrize(
    ("eta", "internal", "external", "factor"),
    [
        (1.3, 0.444457, 0.061132, 2.60008),
        (1.4, 0.528985, 0.076812, 3.24615),
        (1.5, 0.596346, 0.091778, 3.95474),
    ],
)
def test_diffuse_averages_are_the_exact_ones(eta, internal, external, factor):
    assert fresnel.diffuse_internal(eta) == pytest.approx(internal, abs=6e-7)
    assert fresnel.diffuse_external(eta) == pytest.approx(external, abs=6e-7)
    assert fresnel.boundary_factor(eta) == pytest.approx(factor, abs=6e-6)


def test_the_internal_flux_moment_has_its_exact_value():
    assert fresnel.diffuse_internal_flux_moment(1.5) == pytest.approx(0.464431, abs=6e-7)


def test_internal_average_agrees_with_direct_integration_inside():
    edge = np.sqrt(1.0 - 1.0 / 1.4**2)
    s = (np.arange(200_000) + 0.5) / 200_000
    mu = edge + (1.0 - edge) * s**2
    step = 2.0 * (1.0 - edge) * s / 200_000
    inside = edge**2 + 2.0 * np.sum(fresnel.reflectance(mu, 1.0 / 1.4) * mu * step)
    assert fresnel.diffuse_internal(1.4) == pytest.approx(inside, abs=1e-8)


def test_reflectance_is_equal_from_both_ray_sides():
    mu_out = np.linspace(0.01, 1.0, 50)
    mu_in = np.sqrt(1.0 - (1.0 - mu_out**2) / 1.4**2)
    np.testing.assert_allclose(
        fresnel.reflectance(mu_out, 1.4), fresnel.reflectance(mu_in, 1.0 / 1.4), rtol=1e-9
    )


def test_reflection_is_total_beyond_critical_angle_and_grazing():
    np.testing.assert_array_equal(fresnel.reflectance([0.0, 0.3, 0.69], 1.0 / 1.4), 1.0)
    assert fresnel.reflectance(0.0, 1.4) == pytest.approx(1.0)


def test_a_matched_surface_reflects_nothing_at_any_angle():
    np.testing.assert_array_equal(fresnel.reflectance([0.0, 0.5, 1.0], 1.0), 0.0)
    assert fresnel.diffuse_internal(1.0) == pytest.approx(0.0, abs=1e-12)


def test_index_below_unity_is_refused():
    with pytest.raises(ValueError, match="eta: got"):
        fresnel.diffuse_internal(0.7)
    with pytest.raises(ValueError, match="eta: got"):
        fresnel.reflectance(1.0, -1.0)
