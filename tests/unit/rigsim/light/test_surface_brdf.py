"""The skin's reflection: energy, reciprocity, limits, and what R_d means."""

import math

import numpy as np
import pytest

from rigsim import shading
from rigsim.light import surface_brdf
from rigsim.subject.person import make_subject

UP = np.array([0.0, 0.0, 1.0])


def hemisphere(polar: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions and weights of solid angle times cosine; Gauss in cosine squared."""
    node, weight = np.polynomial.legendre.leggauss(polar)
    sine2 = 0.5 * (node + 1.0)
    phi = 2.0 * np.pi * (np.arange(around) + 0.5) / around
    sine, cosine = np.sqrt(sine2)[:, None], np.sqrt(1.0 - sine2)[:, None]
    way = np.stack(
        [sine * np.cos(phi), sine * np.sin(phi), cosine * np.ones_like(phi)], axis=-1
    ).reshape(-1, 3)
    return way, np.repeat(weight * 0.5 * math.pi / around, around)


def slanted(angle_deg: float) -> np.ndarray:
    angle = math.radians(angle_deg)
    return np.array([math.sin(angle), 0.0, math.cos(angle)])


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0, 80.0, 88.0])
@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5])
def test_white_skin_reflects_less_light_than_received(angle_deg, roughness):
    """R_d of 1, the most oil and the densest fuzz: the worst case of all."""
    way, weight = hemisphere(200, 256)
    packed = [1.0, 1.0, 1.0, roughness, 0.6, surface_brdf.FUZZ_DEPTH, 1.0]
    total, specular = surface_brdf.evaluate_brdf(packed, UP, slanted(angle_deg), way)
    assert 0.0 < weight @ specular < 0.75
    assert weight @ total[:, 0] < 1.0


def test_skin_brdf_is_reciprocal(rng):
    way = rng.standard_normal((500, 2, 3))
    way[..., 2] = np.abs(way[..., 2]) + 1e-3
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    packed = rng.uniform(size=(500, 7)) * [1, 1, 1, 0.4, 0.6, 0.003, 1] + [0, 0, 0, 0.1, 0, 0, 0]
    there = surface_brdf.evaluate_brdf(packed, UP, way[:, 0], way[:, 1])
    back = surface_brdf.evaluate_brdf(packed, UP, way[:, 1], way[:, 0])
    for a, b in zip(there, back, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-7)


def test_smooth_white_metal_facets_reflect_almost_everything():
    """Without Fresnel only shadowing loses light; GGX has wide tails, so it loses more."""
    way, weight = hemisphere(240, 120)
    light = slanted(30.0)
    nh = (way + light)[:, 2] / np.linalg.norm(way + light, axis=-1)
    for lobe, lost in ((surface_brdf.beckmann_brdf, 0.004), (surface_brdf.ggx_brdf, 0.04)):
        f = [lobe(light[2], w[2], h, 0.15) for w, h in zip(way, nh, strict=True)]
        assert 1.0 - lost < weight @ np.array(f) < 1.0 + 1e-6


def test_r_d_without_surface_terms_matches_eq_6():
    """Without surface terms pi f / (T T) is R_d in every direction."""
    way, _ = hemisphere(12, 16)
    packed = [0.6, 0.3, 0.05, 0.3, 0.0, 0.0, 0.0]
    light = slanted(40.0)
    total, specular = surface_brdf.evaluate_brdf(packed, UP, light, way)
    passed = [surface_brdf.boundary_transmittance(light[2], w[2]) for w in way]
    np.testing.assert_allclose(
        math.pi * total / np.array(passed)[:, None],
        np.tile([0.6, 0.3, 0.05], (len(way), 1)),
        rtol=1e-5,
    )
    assert not specular.any()


def test_subsurface_reflectance_at_normal_incidence_matches_table():
    """R_d is larger than the reflectance by 1 / (T(0) T_average)."""
    way, weight = hemisphere(64, 4)
    r = 0.5
    packed = [r * shading.interior_scale(1.4)] * 3 + [0.3, 0.0, 0.0, 0.0]
    total, _ = surface_brdf.evaluate_brdf(packed, UP, UP, way)
    assert weight @ total[:, 1] == pytest.approx(r, rel=1e-4)


def test_boundary_transmittance_matches_flash_rig_closed_form():
    cosine = np.linspace(0.05, 1.0, 20)
    rs, rp = shading.fresnel_amplitudes(cosine, 1.4)
    ours = [surface_brdf.boundary_transmittance(c, 1.0) for c in cosine]
    np.testing.assert_allclose(ours, (1.0 - 0.5 * (rs**2 + rp**2)) * (1.0 - 1.0 / 36.0), rtol=1e-12)


@pytest.mark.parametrize(("preset", "part"), [("II", 0.003), ("VI", 0.015)])
def test_eq_6_error_without_specular_free_direction_small(preset, part):
    """Where the surface shines least, within 70 degrees, it adds this part of blue's R_d."""
    face = make_subject(preset, size=64)
    surface = surface_brdf.skin_surface(face, "Nikon 5100 (NPL)", "LED-B3")
    bare = face.hair == 0.0
    floor = surface_brdf.min_surface_reflection(surface.packed()[bare])
    assert floor.min() >= 0.0
    assert 0.0 < np.median(floor / surface.r_d[bare][:, 2]) < part


def test_single_lobe_does_not_fit_surface_terms():
    """Best multiple of a single lobe, over its roughness, misses by several percent."""
    way, weight = hemisphere(40, 32)
    light = slanted(50.0)
    skin = surface_brdf.evaluate_brdf([0, 0, 0, 0.32, 0.3, 0.002, 1.0], UP, light, way)[1]
    errors = []
    for roughness in np.linspace(0.1, 0.5, 41):
        one = surface_brdf.evaluate_brdf([0, 0, 0, roughness, 0.0, 0.0, 1.0], UP, light, way)[1]
        gain = (weight * one) @ skin / ((weight * one) @ one)
        errors.append(math.sqrt(weight @ (skin - gain * one) ** 2 / (weight @ skin**2)))
    assert min(errors) > 0.05


def test_face_specular_varies_and_stays_in_range():
    surface = surface_brdf.skin_surface(
        make_subject("V", seed=3, size=64), "Nikon 5100 (NPL)", "LED-B3"
    )
    assert surface.packed().shape == (64, 64, 7)
    assert np.ptp(surface.oil) > 0.2
    assert np.ptp(surface.fuzz) > 0.5 * surface_brdf.FUZZ_DEPTH
    assert 0.0 < surface.r_d.min() < surface.r_d.max() < 1.0


def test_directions_below_the_surface_reflect_nothing():
    packed = [0.5, 0.5, 0.5, 0.3, 0.2, 0.001, 1.0]
    for light, camera in ((-UP, UP), (UP, -UP), (slanted(90.1), UP)):
        total, _ = surface_brdf.evaluate_brdf(packed, UP, light, camera)
        assert not total.any()
    with pytest.raises(surface_brdf.SurfaceError, match="packed"):
        surface_brdf.evaluate_brdf([0.5], UP, UP, UP)
