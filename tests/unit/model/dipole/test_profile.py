"""The dipole's profile, eq. (5) and its inverse, against published values and closed relations."""

import csv

import numpy as np
import pytest
from scipy.integrate import quad

from model import dipole


@pytest.mark.parametrize(
    ("sigma_a", "sigma_s", "published"),
    [(0.032, 0.74, 0.4360), (0.17, 0.88, 0.2273), (0.48, 1.01, 0.1310)],
)
def test_jensen_2001_skin_has_closed_form_reflectance(sigma_a, sigma_s, published):
    r_d = dipole.total_reflectance(sigma_s / (sigma_a + sigma_s), 1.3)
    assert float(r_d) == pytest.approx(published, abs=1e-4)


def materials(test_data):
    with (test_data / "radiative_transfer" / "jensen2001.csv").open() as stream:
        rows = list(csv.reader(stream))[1:]
    return np.array([[float(x) for x in row[1:7]] for row in rows]).reshape(-1, 2, 3)


def test_profile_integrates_to_total_for_jensen_2001_materials(test_data):
    for sigma_s, sigma_a in np.moveaxis(materials(test_data), 1, 2).reshape(-1, 2):
        if sigma_a == 0.0:
            continue
        # r = z tan(t) maps the plane to (0, pi/2); z is the source's depth
        z = 1.0 / (sigma_a + sigma_s)

        def ring(t, z=z, a=sigma_a, s=sigma_s):
            r = z * np.tan(t)
            return 2 * np.pi * r * dipole.reflectance(r, a, s, 1.3) * z / np.cos(t) ** 2

        total = quad(ring, 0.0, np.pi / 2, limit=200, epsabs=1e-10)[0]
        expected = dipole.total_reflectance(sigma_s / (sigma_a + sigma_s), 1.3)
        assert total == pytest.approx(float(expected), rel=1e-6)


def test_diffusion_is_near_transport_only_for_high_albedo(test_data):
    path = test_data / "radiative_transfer" / "adding_doubling_semi_infinite.csv"
    with path.open() as stream:
        rows = [[float(x) for x in row] for row in list(csv.reader(stream))[1:]]
    specular = ((1.4 - 1.0) / (1.4 + 1.0)) ** 2
    error = {}
    for albedo, n, total, _ in rows:
        if n == 1.4:
            truth = (total - specular) / (1.0 - specular)  # of the light that entered
            error[albedo] = float(dipole.total_reflectance(albedo, n)) / truth - 1.0
    assert abs(error[0.999]) < 0.02
    assert abs(error[0.5]) > 0.02


@pytest.mark.parametrize("eta", [1.0, 1.3, 1.4, 1.6])
def test_inverse_returns_reflectance_from_1e_6_toward_1(eta):
    near_one = 10.0 ** -np.linspace(0.4, 9.0, 60)
    r_d = np.concatenate([10.0 ** np.linspace(-6.0, -0.3, 60), 1.0 - near_one])
    deficit = dipole.invert_to_deficit(r_d, eta)
    # One unit in the last place of R_d is all that can be asked for.
    np.testing.assert_allclose(
        dipole.absorbed_fraction(deficit, eta), 1.0 - r_d, rtol=1e-12, atol=3e-16
    )
    alpha = dipole.invert_total_reflectance(r_d[:60], eta)
    np.testing.assert_allclose(dipole.total_reflectance(alpha, eta), r_d[:60], rtol=1e-14)


def test_inverse_is_monotone_in_deficit_near_unity():
    r_d = np.concatenate([np.linspace(1e-6, 0.9, 2000), 1.0 - np.logspace(-1.001, -9, 2000)])
    assert np.all(np.diff(r_d) > 0.0)
    assert np.all(np.diff(dipole.invert_to_deficit(r_d, 1.3)) < 0.0)
    assert np.all(np.diff(dipole.invert_total_reflectance(r_d, 1.3)) >= 0.0)


def test_albedo_arithmetic_would_lose_deficit_near_unity():
    deficit = dipole.invert_to_deficit(1.0 - 1e-9, 1.3)
    assert 4e-20 < deficit < 5e-20
    assert 1.0 - dipole.invert_total_reflectance(1.0 - 1e-9, 1.3) == 0.0


def test_black_and_white_are_inverted_exactly_any_index():
    for eta in (1.0, 1.3, 1.5):
        np.testing.assert_array_equal(dipole.invert_total_reflectance([0.0, 1.0], eta), [0.0, 1.0])


def test_reflectance_outside_unit_interval_is_flagged_outlier():
    r_d = np.array([[0.3, 1.0 + 1e-12], [np.nan, -1e-6]])
    outlier = dipole.is_outlier(r_d)
    np.testing.assert_array_equal(outlier, [[False, True], [True, True]])
    np.testing.assert_array_equal(np.isnan(dipole.invert_total_reflectance(r_d, 1.3)), outlier)
    with pytest.raises(dipole.ReflectanceOutlierError, match=r"r_d: got 1.1"):
        dipole.invert_total_reflectance(1.1, 1.3)


def test_albedo_and_translucency_give_back_the_coefficients():
    sigma_a, sigma_s = np.array([1e-9, 0.032, 5.0]), np.array([3.0, 0.74, 1e-3])
    sigma_tr = dipole.effective_transport(sigma_a, sigma_s)
    a, s = dipole.coefficients(sigma_a / (sigma_a + sigma_s), sigma_tr)
    np.testing.assert_allclose(a, sigma_a, rtol=1e-12)
    np.testing.assert_allclose(s, sigma_s, rtol=1e-12)
    with pytest.raises(ValueError, match="deficit: got 0"):
        dipole.coefficients(0.0, 1.0)


def test_profiles_at_the_extremes_are_finite():
    radius = np.array([0.0, 1e-6, 1.0, 1e6])
    for sigma_a, sigma_s in [(0.0, 1.0), (1e4, 1e-4), (1e-12, 1e3), (0.0, 0.0), (1.0, 0.0)]:
        profile = dipole.reflectance(radius, sigma_a, sigma_s, 1.4)
        assert np.all(np.isfinite(profile))
        assert np.all(profile >= 0.0)
    np.testing.assert_array_equal(dipole.reflectance(radius, 1.0, 0.0, 1.4), 0.0)


def test_profiles_broadcast_and_refuse_negative_coefficients():
    both = dipole.reflectance(np.linspace(0, 3, 5)[:, None], [0.1, 0.2], [1.0, 2.0], 1.3)
    assert both.shape == (5, 2)
    np.testing.assert_array_equal(
        both[:, 1], dipole.reflectance(np.linspace(0, 3, 5), 0.2, 2.0, 1.3)
    )
    with pytest.raises(ValueError, match="sigma_a_per_mm"):
        dipole.reflectance(1.0, -0.1, 1.0, 1.3)
    with pytest.raises(ValueError, match="albedo_prime"):
        dipole.total_reflectance(1.2, 1.3)


def test_shapes_that_do_not_broadcast_are_named():
    with pytest.raises(ValueError, match=r"radius_mm, sigma_a_per_mm, sigma_s_prime_per_mm: got"):
        dipole.reflectance(np.ones(4), np.ones(3), 1.0, 1.4)
