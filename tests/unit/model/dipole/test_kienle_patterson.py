"""Kienle and Patterson's diffusion: published constants, slopes, and transport beside it."""

import numpy as np
import pytest
from scipy.integrate import quad

from model import fresnel, photon_table
from model.dipole import kienle_patterson as diffusion
from model.dipole import profile as dipole

RADII = np.arange(0.3, 7.2, 0.25)


def test_surface_transmission_matches_published_value_at_1_4():
    c_phi, c_flux = diffusion.exit_coefficients(1.4)
    assert c_phi == pytest.approx(0.118, abs=5e-4)
    assert c_flux == pytest.approx(0.306, abs=5e-4)
    assert diffusion.effective_reflection(1.4) == pytest.approx(0.493, abs=5e-4)


@pytest.mark.parametrize("eta", [1.0, 1.1, 1.33, 1.4, 1.6])
def test_exit_coefficients_are_integrals_of_the_transmitted_radiance(eta):
    # Radiance (phi + 3 J mu)/(4 pi), transmitted by 1 - F, over the hemisphere.
    def outgoing(mu, power):
        return (1.0 - float(fresnel.reflectance(mu, 1.0 / eta))) * mu**power

    kink = [np.sqrt(1.0 - 1.0 / eta**2)] if eta > 1.0 else None
    moments = [quad(outgoing, 0.0, 1.0, args=(p,), points=kink, epsabs=1e-10)[0] for p in (1, 2)]
    assert diffusion.exit_coefficients(eta)[0] == pytest.approx(0.5 * moments[0], abs=1e-8)
    assert diffusion.exit_coefficients(eta)[1] == pytest.approx(1.5 * moments[1], abs=1e-8)


def test_a_matched_surface_reflects_nothing_back():
    assert diffusion.exit_coefficients(1.0) == pytest.approx((0.25, 0.5))
    assert diffusion.effective_reflection(1.0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("a", "s"), [(0.0, 1.0), (1e-12, 1.0), (0.03, 0.8), (0.5, 2.0), (8.0, 0.8)]
)
def test_slopes_are_those_of_the_profile(a, s):
    slopes = diffusion.derivatives(RADII, a, s, 1.4)
    step = 1e-5

    def profile(da, ds):
        return diffusion.reflectance(RADII, a + da, s + ds, 1.4)

    by_s = (profile(0.0, step) - profile(0.0, -step)) / (2.0 * step)
    np.testing.assert_allclose(slopes.by_sigma_s_prime, by_s, rtol=1e-6)
    if a > step:
        by_a = (profile(step, 0.0) - profile(-step, 0.0)) / (2.0 * step)
        np.testing.assert_allclose(slopes.by_sigma_a, by_a, rtol=1e-6)
    else:  # R is a series in sigma_a^(1/2) from the 2nd power on: remove the 3rd by Richardson
        h = np.array([1e-6, 4e-6])
        first, second = ((profile(x, 0.0) - profile(0.0, 0.0)) / x for x in h)
        np.testing.assert_allclose(slopes.by_sigma_a, 2.0 * first - second, rtol=1e-4)


def test_rows_of_coefficients_broadcast():
    a, s = np.array([[0.01], [0.1]]), np.array([[1.0], [2.0]])
    both = diffusion.reflectance(RADII, a, s, 1.4)
    assert both.shape == (2, RADII.size)
    np.testing.assert_array_equal(both[1], diffusion.reflectance(RADII, 0.1, 2.0, 1.4))


def test_diffusion_tends_to_transport_only_far_from_source():
    # Both per power that enters the tissue; the table counts the surface's reflection as loss.
    entered = 1.0 - fresnel.normal_reflectance(1.4)
    radius = np.array([0.2, 2.0, 4.0, 8.0, 12.0])
    ratio = {
        model: model.reflectance(radius, 0.01, 1.0, 1.4)
        * entered
        / photon_table.reflectance(radius, 0.01, 1.0)
        for model in (diffusion, dipole)
    }
    assert np.all(np.abs(ratio[diffusion][1:] - 1.0) < 0.06)
    assert abs(ratio[diffusion][0] - 1.0) > 0.1
    assert np.max(np.abs(ratio[dipole][1:] - 1.0)) > 0.1  # the paper's model is worse


def test_extreme_absorption_scattering_and_distance_are_well_defined():
    assert diffusion.reflectance(RADII, 5.0, 0.0, 1.4).tolist() == [0.0] * RADII.size
    dark = diffusion.derivatives(np.append(0.0, RADII), 10.0, 1.0, 1.6)
    assert np.all(np.isfinite(dark))
    assert np.all(dark.reflectance_per_mm2 > 0.0)
    far = diffusion.reflectance(1e4, 1.0, 1.0, 1.4)
    assert far == 0.0  # exp(-24495) is no float64
    with pytest.raises(ValueError, match="radius_mm: got -"):
        diffusion.reflectance(-1.0, 0.1, 1.0, 1.4)
    with pytest.raises(ValueError, match="eta: got"):
        diffusion.reflectance(1.0, 0.1, 1.0, 0.9)


def test_closed_dipole_and_diffusion_cover_jensen_2001_materials(test_data):
    path = test_data / "radiative_transfer" / "jensen2001.csv"
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    table = np.array([[float(x) for x in row[1:7]] for row in rows]).reshape(-1, 2, 3)
    s, a = (table[:, k].reshape(-1, 1) for k in (0, 1))
    # Jensen's equation (4), z_v of its second term in transport lengths; A for 1.3
    t = a + s
    k = np.sqrt(3.0 * a * t)
    A = fresnel.boundary_factor(1.3)
    z_r, z_v = 1.0 / t, (1.0 + 4.0 / 3.0 * A) / t
    d_r, d_v = np.sqrt(RADII**2 + z_r**2), np.sqrt(RADII**2 + z_v**2)
    printed = (
        s
        / t
        / (4.0 * np.pi)
        * (
            (k * d_r + 1.0) * np.exp(-k * d_r) / (t * d_r**3)
            + z_v * t * (k * d_v + 1.0) * np.exp(-k * d_v) / (t * d_v**3)
        )
    )
    np.testing.assert_allclose(dipole.reflectance(RADII, a, s, 1.3), printed, rtol=1e-12)
    slopes = diffusion.derivatives(RADII, a, s, 1.3)
    assert np.all(slopes.reflectance_per_mm2 > 0.0)
    assert np.all(slopes.by_sigma_a[:, -1] < 0.0)  # near the source a shallower one counts more
    # far away both fall alike
    ratio = slopes.reflectance_per_mm2 / printed
    far = (t * RADII)[:, -1] > 15.0
    assert far.sum() > 5
    assert np.all(np.ptp(ratio[far][:, -3:], axis=1) < 0.02 * ratio[far][:, -1])
