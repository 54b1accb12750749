"""Reflection of polarized light by smooth glass: closed forms, and another implementation."""

import numpy as np
import pytest

from capture.calibration.geometry.intrinsics import CameraPose
from capture.calibration.lights.reflection import mirror_lights
from capture.calibration.polarization import polarized_reflection
from capture.calibration.polarization.malus import PolarizationError
from capture.calibration.polarization.polarized_reflection import (
    FacetReflection,
    fresnel_amplitudes,
)
from capture.rig import load_rig
from rigsim import shading
from rigsim.as_built.polarizers import absorbing_axis

RIG = load_rig("gradient")
VIEW = RIG.view("cam")
CAMERA = CameraPose.nominal(VIEW)
PLACE = np.array([light.position_mm for light in RIG.lights])
BALL = np.array([0.3, -0.2, -2.8])


def by_ball(eta=1.52, lights=RIG.lights):
    place = np.array([light.position_mm for light in lights])
    shown = mirror_lights(CAMERA, BALL, 6.0, place)
    return FacetReflection.of(
        lights,
        CAMERA,
        VIEW.analyzer_axis_deg,
        eta,
        to_light=shown.to_light,
        to_camera=shown.to_camera,
    )


def by_skin(eta=1.4):
    to_light = PLACE / np.linalg.norm(PLACE, axis=1, keepdims=True)
    to_camera = np.tile([0.0, 0.0, 1.0], (len(PLACE), 1))
    return FacetReflection.of(
        RIG.lights, CAMERA, VIEW.analyzer_axis_deg, eta, to_light=to_light, to_camera=to_camera
    )


@pytest.mark.parametrize("eta", [1.33, 1.52, 2.4])
def test_amplitudes_match_textbook_at_normal_brewster_and_grazing(eta):
    rs, rp = fresnel_amplitudes([1.0, np.cos(np.arctan(eta)), 1e-9], eta)
    normal = (eta - 1) / (eta + 1)
    np.testing.assert_allclose([rs[0], rp[0]], [-normal, normal], rtol=1e-12)
    assert abs(rp[1]) < 1e-12
    np.testing.assert_allclose(rs[1], (1 - eta**2) / (1 + eta**2), rtol=1e-12)
    np.testing.assert_allclose([rs[2] ** 2, rp[2] ** 2], 1.0, atol=1e-6)


def test_rig_extinguishes_skin_mirror_reflection_but_not_glass():
    parallel, crossed = by_skin().transmit_through_analyzer([0.0, np.pi / 2])
    assert (crossed / parallel).max() < 1e-5  # axes in the file are rounded to 0.01 degrees
    parallel, crossed = by_ball().transmit_through_analyzer([0.0, np.pi / 2])
    assert np.median(crossed / parallel) > 1e-5
    assert (crossed / parallel).max() > 0.1


def test_parallel_and_crossed_transmission_sum_to_reflectance():
    reflection = by_ball()
    leak, turn = 1e-3, np.radians(np.linspace(-3, 3, len(PLACE)))
    both = reflection.transmit_through_analyzer([0.4, 0.4 + np.pi / 2], turn, 0.1, 0.0, leak).sum(
        axis=0
    )
    whole = (reflection.reflected_fields(turn)[:, 0] ** 2).sum(axis=-1)
    # rays meet the camera up to 1.2 degrees off its axis, where a film's axes are not quite at
    # right angles any more: by the square of that angle
    np.testing.assert_allclose(both, (1 + leak) * whole, rtol=np.radians(1.2) ** 2)


def test_reading_and_analyzer_zero_add():
    reflection = by_ball()
    np.testing.assert_allclose(
        reflection.transmit_through_analyzer([0.5], 0.0, 0.2),
        reflection.transmit_through_analyzer([0.7], 0.0, 0.0),
        rtol=1e-12,
    )


def test_the_simulators_own_reflection_agrees():
    reflection = by_ball()
    alpha, readings = 0.5, np.array([0.0, 80.0, 90.0, 100.0])
    ours = reflection.transmit_through_analyzer(
        np.radians(readings), 0.0, np.radians(0.7), 1 / 2000, 1 / 3000
    )
    theirs = np.empty_like(ours)
    for k, light in enumerate(RIG.lights):
        facet = reflection.normal[k]
        cosine = facet @ reflection.to_light[k]
        shadowed = 2 / (1 + np.sqrt(1 + alpha**2 * (1 - cosine**2) / cosine**2))
        lobe = shadowed**2 / (np.pi * alpha**2) / (4 * cosine)
        stokes = shading.specular_stokes(
            facet[None],
            reflection.to_light[k][None],
            reflection.to_camera[k][None],
            alpha,
            eta=1.52,
            light_absorbs=absorbing_axis(light),
            image_right=[1.0, 0.0, 0.0],
            extinction=2000.0,
        )
        for e, reading in enumerate(readings):
            behind = shading.apply_analyzer(
                stokes,
                reflection.to_camera[k][None],
                passes_deg=VIEW.analyzer_axis_deg + reading + 0.7,
                image_right=[1.0, 0.0, 0.0],
                image_up=[0.0, 1.0, 0.0],
                extinction=3000.0,
            )
            theirs[e, k] = 2 * behind[0] / lobe  # a film passes half of unpolarized light
    # the simulator works in single precision
    np.testing.assert_allclose(ours, theirs, atol=1e-6 * theirs.max(), rtol=3e-4)


def test_lights_without_polarizers_are_named():
    bare = (*RIG.lights[:2], load_rig("dome").lights[0])
    with pytest.raises(PolarizationError, match=load_rig("dome").lights[0].name):
        by_ball(lights=bare)


def test_cross_products_are_numpy_s_bit_by_bit(rng):
    first, second = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    np.testing.assert_array_equal(
        polarized_reflection._cross(first, second), np.cross(first, second)
    )
    np.testing.assert_array_equal(
        polarized_reflection._cross(first, second[0]), np.cross(first, second[0])
    )
