"""Patches of even voxel skin in the dome: facets, angular fit, images and estimates."""

from math import pi

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim import shading
from rigsim.light.led_light import white_intensity
from rigsim.light.surface_brdf import evaluate_brdf
from rigsim.mitsuba.variant import choose_variant
from rigsim.population.files import load_subject
from rigsim.scenes.reference import directions
from rigsim.scenes.reference.directions import (
    DirectionalReflectance,
    normal_reflectance,
    render_directions,
)
from rigsim.scenes.reference.facets import SkinFacets
from rigsim.scenes.reference.plane import render_plane
from skinrig.benchmarks.simulation.reference_dome import (
    NORMAL_QUANTITY,
    dome_of_patches,
    estimate_patch,
)

render = pytest.mark.render
needs_vectors = pytest.mark.skipif(
    not choose_variant("mono").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
)
UP = np.array([0.0, 0.0, 1.0])
R_D = np.array([0.4, 0.25, 0.18])


def hemisphere(count, *, seed=0, max_deg=75.0):
    """Unit vectors within an angle of +z."""
    rng = np.random.default_rng(seed)
    cosine = rng.uniform(np.cos(np.radians(max_deg)), 1.0, count)
    turn = rng.uniform(0.0, 2.0 * pi, count)
    flat = np.sqrt(1.0 - cosine**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), cosine])


def lambertian(r_d=R_D):
    """Interior of the model: the same light in all directions."""
    coefficients = np.zeros((11, 3))
    coefficients[0] = r_d
    return DirectionalReflectance(coefficients, np.ones(3), np.zeros(3))


def test_constant_fit_is_lambertian_interior():
    """Expected: R_d T T / pi by Fresnel's equations; tolerance: rounding."""
    light, camera = hemisphere(50), hemisphere(50, seed=1)
    passed = [
        1.0 - 0.5 * sum(a**2 for a in shading.fresnel_amplitudes(way[:, 2], 1.4))
        for way in (light, camera)
    ]
    found = lambertian().evaluate(UP, light, camera)
    np.testing.assert_allclose(found, (passed[0] * passed[1] / pi)[:, None] * R_D, rtol=1e-12)
    np.testing.assert_allclose(lambertian().beam_reflectance(), R_D, rtol=1e-4)
    assert not lambertian().evaluate(UP, -light, camera).any()


def test_angular_fit_recovers_smooth_law_and_rejects_peak():
    """Rationale: chi2 is 1 within 6 standard errors (277 free values) for a law of the basis.

    A peak toward the mirror direction is outside the basis: chi2 then exceeds 3.
    """
    rng = np.random.default_rng(4)
    light = np.array([[np.sin(a), 0.0, np.cos(a)] for a in np.radians(directions.LIGHT_DEG)])
    camera = directions._cameras()[1]
    between = light @ camera.T
    cosines = np.broadcast_arrays(light[:, 2:], camera[:, 2][None])
    terms = directions._terms(*cosines, between)
    law = terms @ np.linspace(0.3, -0.02, 33).reshape(11, 3)
    noise = 0.02 * law.mean() * rng.standard_normal((2, *law.shape))
    found = directions._fit(terms, law + noise)
    assert np.abs(found.chi2 - 1.0).max() < 6.0 * np.sqrt(2.0 / 277.0)
    refit = terms @ found.coefficients
    assert np.sqrt(np.mean(np.square(refit / law - 1.0))) < 0.02
    mirror = light * [-1.0, -1.0, 1.0] @ camera.T
    peak = law * (1.0 + 0.5 * np.exp(80.0 * (mirror - 1.0)))[..., None]
    assert directions._fit(terms, peak + noise).chi2.min() > 3.0


def test_fit_beyond_steepest_view_keeps_azimuth():
    """Expected: below the least angle of the fit only transmittances change, also off the plane.

    Rationale: a frontal camera has no azimuth, so that its light's is 0 / 0 and without effect.
    """
    coefficients = np.random.default_rng(5).uniform(0.5, 1.5, (11, 3))
    interior = DirectionalReflectance(coefficients, np.ones(3), np.zeros(3))
    zenith = np.radians([75.0, 80.0, 89.0])
    light = np.column_stack([np.sin(zenith), 0.0 * zenith, np.cos(zenith)])
    passed = lambertian(np.ones(3)).evaluate
    for camera in (UP, np.array([0.3, 0.5, np.sqrt(0.66)])):
        less, least, beyond = interior.evaluate(UP, light, camera) / passed(UP, light, camera)
        np.testing.assert_allclose(beyond, least, rtol=1e-9)
        assert np.abs(less / least - 1.0).max() > 1e-3


@render
@needs_vectors
def test_mitsuba_facets_equal_closed_form():
    """Tolerance: float32. Another roughness differs by more than a tenth."""
    light, camera = hemisphere(200), hemisphere(200, seed=1)
    normal = hemisphere(1, seed=2, max_deg=15.0)[0]
    lit = (light @ normal > 0.1) & (camera @ normal > 0.1)
    light, camera = light[lit], camera[lit]
    packed = [0.0, 0.0, 0.0, 0.3, 0.1, 0.0, 1.0]
    expected = evaluate_brdf(packed, normal, light, camera)[1]
    found = SkinFacets(0.3, 0.1).evaluate(normal, light, camera)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-6)
    wider = SkinFacets(0.35, 0.1).evaluate(normal, light, camera)
    assert np.abs(wider / expected - 1.0).max() > 0.1


def test_plane_of_known_reflection_has_its_light():
    """Expected: the dome's equation at the center, and more light on the side of the LED."""
    rig = dome_of_patches()
    view = max(rig.views, key=lambda one: one.position_mm[2])
    light = max(rig.lights, key=lambda one: one.position_mm[0] + 0.5 * one.position_mm[2])
    image = render_plane(view, [light], UP, lambda way, _: np.full(way.shape, 0.2))[0]
    place = np.array(light.position_mm)
    distance = np.linalg.norm(place)
    expected = pi * 0.2 * white_intensity(light, view) * place[2] / distance**3
    middle = view.width_px // 2
    center = image[middle - 1 : middle + 1, middle - 1 : middle + 1].mean(axis=(0, 1))
    np.testing.assert_allclose(center, expected, rtol=1e-3)
    right = np.array(view.axes[0]) @ place > 0.0
    near, far = (image[:, -1], image[:, 0]) if right else (image[:, 0], image[:, -1])
    assert near.mean() > far.mean()


@render
@needs_vectors
def test_stated_intervals_contain_lambertian_patch_alone():
    """Rationale: facets by Mitsuba over the model's interior; R_d of a tenth more is excluded."""
    rig = dome_of_patches()
    options = {"tilt_deg": 20.0, "seed": [1]}
    right = estimate_patch(rig, "voxels", lambertian(), R_D, **options)
    assert right.valid == 1.0
    assert np.median(right.error[NORMAL_QUANTITY]) < np.radians(0.5)
    wrong = estimate_patch(rig, "voxels", lambertian(1.1 * R_D), R_D, **options)
    for color in ("red", "green", "blue"):
        assert np.all(np.abs(right.error[color]) < 2.0 * right.stderr[color])
        assert np.all(np.abs(wrong.error[color]) > 2.0 * wrong.stderr[color])


@pytest.mark.long
@render
@needs_vectors
def test_voxel_skin_reflects_more_forward_than_backward():
    """Expected: R_d of a beam as by the photon walk; 5 % contain 4 standard errors of the fit.

    Dark skin at 60 degrees reflects a tenth more forward, in all channels, and backward less.
    """
    skin = load_subject("VI").skin(seed=11).at("cheek")
    rig = load_rig("dome")
    colors = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    truth = normal_reflectance(skin, *colors)
    found = render_directions(skin, *colors, samples=64, seed=1)
    np.testing.assert_allclose(found.beam_reflectance(), truth, rtol=0.05)
    assert found.chi2.max() < 1.0 + 6.0 * np.sqrt(2.0 / 277.0)
    light = np.array([np.sqrt(0.75), 0.0, 0.5])
    forward, backward = (
        found.evaluate(UP, light, light * [side, 1.0, 1.0])
        / lambertian(truth).evaluate(UP, light, light)
        for side in (-1.0, 1.0)
    )
    assert forward.min() > 1.1
    assert np.all(forward > backward + 0.1)
