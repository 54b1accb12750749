"""Polarized shading against closed forms, without a renderer."""

import math

import numpy as np
import pytest

from rigsim import shading

Z = np.array([[0.0, 0.0, 1.0]], np.float32)
RIGHT, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
HORIZONTAL, VERTICAL = RIGHT, UP


def unit(*vector: float) -> np.ndarray:
    v = np.array([vector], np.float64)
    return (v / np.linalg.norm(v)).astype(np.float32)


def hemisphere(count: int) -> np.ndarray:
    """Directions on a regular grid of (cos theta, phi), midpoints: a quadrature of the sphere."""
    z = (np.arange(count) + 0.5) / count
    phi = 2.0 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    z, phi = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)


@pytest.mark.parametrize("eta", [1.3, 1.4, 1.5])
def test_transmittance_at_normal_incidence_is_that_of_fresnel(eta):
    inside = 1.0 - ((eta - 1.0) / (eta + 1.0)) ** 2
    entry = shading.entry_transmittance(Z, Z, eta=eta, light_absorbs=HORIZONTAL)
    leaving = shading.exit_stokes(Z, Z, eta=eta, image_right=RIGHT)
    np.testing.assert_allclose(entry, 0.5 * inside, rtol=1e-6)
    np.testing.assert_allclose(leaving, [[inside, 0.0, 0.0]], atol=1e-6)


def test_average_transmittance_equals_the_exact_external_fresnel_averages():
    # Exact averages to six digits for eta 1.3, 1.4, 1.5 (external diffuse reflectance).
    expected = [0.061132, 0.076812, 0.091778]
    got = [1.0 - shading.average_transmittance(eta) for eta in (1.3, 1.4, 1.5)]
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_p_polarized_light_enters_fully_at_brewster_angle():
    angle = math.atan(1.4)
    light = unit(math.sin(angle), 0.0, math.cos(angle))
    # The plane of incidence is y = 0: a film that absorbs along y passes only light in it.
    entry = shading.entry_transmittance(Z, light, eta=1.4, light_absorbs=VERTICAL)
    np.testing.assert_allclose(entry, 0.5, rtol=1e-6)


def test_reflection_at_brewster_angle_is_s_polarized():
    angle = math.atan(1.4)
    light = unit(math.sin(angle), 0.0, math.cos(angle))
    camera = unit(-math.sin(angle), 0.0, math.cos(angle))
    diagonal = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
    stokes = shading.specular_stokes(
        Z, light, camera, 0.1, eta=1.4, light_absorbs=diagonal, image_right=RIGHT
    )[0]
    np.testing.assert_allclose(stokes[1:] / stokes[0], [-1.0, 0.0], atol=1e-5)


def test_highlight_at_normal_incidence_keeps_closed_form_polarization():
    alpha, eta = 0.3, 1.4
    stokes = shading.specular_stokes(
        Z, Z, Z, alpha, eta=eta, light_absorbs=HORIZONTAL, image_right=RIGHT
    )[0]
    f0 = ((eta - 1.0) / (eta + 1.0)) ** 2
    # Vertical light in, vertical light out: S1 = -S0; D = 1 / (pi alpha^2), G = 1.
    expected = 0.5 * f0 / (4.0 * math.pi * alpha**2)
    np.testing.assert_allclose(stokes, [expected, -expected, 0.0], rtol=1e-5, atol=1e-9)


def test_highlight_behind_crossed_analyzer_is_only_polarizer_leak():
    stokes = shading.specular_stokes(
        Z, Z, Z, 0.3, eta=1.4, light_absorbs=HORIZONTAL, image_right=RIGHT, extinction=2000.0
    )
    passed = {
        deg: float(
            shading.apply_analyzer(
                stokes, Z, passes_deg=deg, image_right=RIGHT, image_up=UP, extinction=2000.0
            )[0]
        )
        for deg in (0.0, 90.0)
    }
    # Film to film: (1 + leak^2) parallel, 2 leak crossed.
    leak = 1.0 / 2000.0
    assert passed[0.0] / passed[90.0] == pytest.approx(2.0 * leak / (1.0 + leak**2), rel=1e-3)


def test_analyzer_follows_malus_law():
    stokes = np.array([[1.0, -1.0, 0.0]], np.float32)  # fully polarized along the vertical
    angles = np.linspace(0.0, 180.0, 13)
    got = [
        float(shading.apply_analyzer(stokes, Z, passes_deg=a, image_right=RIGHT, image_up=UP)[0])
        for a in angles
    ]
    np.testing.assert_allclose(got, np.sin(np.deg2rad(angles)) ** 2, atol=1e-6)


def test_mirrored_setup_gives_mirrored_stokes_vector():
    normal, light, camera = unit(0.1, 0.2, 1.0), unit(0.5, -0.1, 0.9), unit(-0.2, 0.3, 0.9)
    flip = np.array([-1.0, 1.0, 1.0], np.float32)
    kwargs = {"eta": 1.4, "light_absorbs": VERTICAL, "image_right": RIGHT}
    one = shading.specular_stokes(normal, light, camera, 0.3, **kwargs)
    other = shading.specular_stokes(normal * flip, light * flip, camera * flip, 0.3, **kwargs)
    np.testing.assert_allclose(other, one * [1.0, 1.0, -1.0], rtol=1e-5)


def test_polarization_never_exceeds_the_intensity(rng_directions):
    normal = np.broadcast_to(Z, rng_directions.shape)
    other = np.roll(rng_directions, 1, axis=0)
    kwargs = {"eta": 1.4, "image_right": RIGHT}
    for stokes in (
        shading.specular_stokes(normal, rng_directions, other, 0.2, light_absorbs=UP, **kwargs),
        shading.exit_stokes(normal, rng_directions, **kwargs),
    ):
        assert np.isfinite(stokes).all()
        assert (np.hypot(stokes[:, 1], stokes[:, 2]) <= stokes[:, 0] * (1.0 + 1e-5)).all()


@pytest.fixture
def rng_directions() -> np.ndarray:
    rng = np.random.default_rng(12345)
    v = rng.normal(size=(500, 3))
    v[:, 2] = np.abs(v[:, 2])
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.long
@pytest.mark.parametrize("alpha", [0.1, 0.3, 0.6])
def test_rough_surface_reflects_no_more_than_received(alpha):
    light = unit(0.6, 0.2, 0.7)
    camera = hemisphere(256)
    stokes = shading.specular_stokes(
        Z, light, camera, alpha, eta=1.4, light_absorbs=VERTICAL, image_right=RIGHT
    )
    reflected = float(np.mean(stokes[:, 0] * camera[:, 2]) * 2.0 * np.pi)
    received = 0.5 * float(light[0, 2])
    assert 0.005 * received < reflected < 0.2 * received


def test_white_interior_scaled_for_normal_incidence_returns_everything():
    """Furnace: kd = interior_scale gives total diffuse reflectance 1 for normal incidence."""
    camera = hemisphere(256)
    leaving = shading.exit_stokes(Z, camera, eta=1.4, image_right=RIGHT)[:, 0]
    entry = 2.0 * shading.entry_transmittance(Z, Z, eta=1.4, light_absorbs=UP)[0]
    kd = shading.interior_scale(1.4)
    returned = kd / np.pi * entry * np.mean(leaving * camera[:, 2]) * 2.0 * np.pi
    assert returned == pytest.approx(1.0, abs=1e-4)


def test_nothing_is_returned_from_below_the_surface():
    below = unit(0.3, 0.0, -0.5)
    kwargs = {"eta": 1.4, "light_absorbs": UP}
    assert not shading.specular_stokes(Z, below, Z, 0.3, image_right=RIGHT, **kwargs).any()
    assert not shading.specular_stokes(Z, Z, below, 0.3, image_right=RIGHT, **kwargs).any()
    assert not shading.entry_transmittance(Z, below, **kwargs).any()
    assert not shading.exit_stokes(Z, below, eta=1.4, image_right=RIGHT).any()


def test_inputs_are_not_modified_and_leading_vectors_broadcast():
    camera = hemisphere(4)
    before = camera.copy()
    one = shading.specular_stokes(Z, Z, camera, 0.3, eta=1.4, light_absorbs=UP, image_right=RIGHT)
    each = [
        shading.specular_stokes(
            Z, Z, camera[i : i + 1], 0.3, eta=1.4, light_absorbs=UP, image_right=RIGHT
        )[0]
        for i in range(len(camera))
    ]
    np.testing.assert_array_equal(one, each)
    np.testing.assert_array_equal(camera, before)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"eta": 0.9}, "eta"),
        ({"extinction": 0.5}, "extinction"),
        ({"light_absorbs": np.array([1.0, 1.0, 0.0])}, "unit vector"),
        ({"alpha": 0.0}, "alpha"),
    ],
)
def test_arguments_outside_their_domain_are_named(change, word):
    kwargs = {"alpha": 0.3, "eta": 1.4, "light_absorbs": UP, "image_right": RIGHT} | change
    alpha = kwargs.pop("alpha")
    with pytest.raises(shading.ShadingError, match=word):
        shading.specular_stokes(Z, Z, Z, alpha, **kwargs)
