"""Close-ups: strain of the plane by closed form, and kernels against skin in equilibrium."""

import dataclasses

import numpy as np
import pytest

from model.microstructure import FOREHEAD
from model.microstructure.strain_fields import TextureStrain
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.applying import strained_closeup as closeups
from skinrig.applying.face_photograph import FlashCamera
from skinrig.applying.strained_closeup import PlaneStrain, photograph_closeup

CAMERA = FlashCamera(field_mm=0.6, size_px=60)


def uniform_field(r_s, r_t, angle_rad):
    c, d = np.cos(angle_rad), np.sin(angle_rad)
    ones = np.ones((4, 4), bool)
    stretch = np.broadcast_to(np.array([r_s, r_t], np.float32), (4, 4, 2))
    axes = np.broadcast_to(np.array([[c, -d], [d, c]], np.float32), (4, 4, 2, 2))
    return TextureStrain(stretch, axes, stretch, ones, ones)


@pytest.mark.parametrize(("r_s", "r_t"), [(1.1, 0.8), (1.25, 0.9), (1.0, 0.8), (1.2, 1.0)])
def test_gradient_has_stretches_and_axis_of_field(r_s, r_t):
    by = PlaneStrain.of(uniform_field(r_s, r_t, 0.4))
    squares, axes = np.linalg.eigh(by.gradient.T @ by.gradient)
    np.testing.assert_allclose(np.sqrt(squares), [r_t, r_s], rtol=1e-6)
    assert abs(axes[:, 1] @ [np.cos(0.4), np.sin(0.4)]) == pytest.approx(1.0, abs=1e-6)


def test_milder_of_two_extensions_is_lost():
    by = PlaneStrain.of(uniform_field(1.2, 1.1, 0.0))
    assert (by.stretch, by.across) == (pytest.approx(1.2), 1.0)


def test_skin_at_rest_is_equal_in_images():
    skin = make_micro_skin("cheek", seed=3, size_mm=1.0)
    made = photograph_closeup(skin, PlaneStrain(1.0, 0.0, 0.0), table=FOREHEAD, camera=CAMERA)
    for name in ("static", "dynamic", "equilibrium"):
        np.testing.assert_allclose(made.images[name].specular, made.images["neutral"].specular)
    assert made.figures["histogram_distance"] == {"static": 0.0, "dynamic": 0.0}


@pytest.mark.parametrize("angle_rad", [0.0, 0.5 * np.pi])
def test_slopes_follow_strain_of_plane(angle_rad):
    """A ramp of 1 um per texel of 10 um along x, on a plane stretched by 1.25 along x."""
    ramp = np.broadcast_to(np.arange(16.0, dtype=np.float32), (16, 16))
    gradient = np.diag([1.25, 0.9])
    turn = np.array(
        [[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]]
    )
    slopes = closeups._slopes(ramp, 10.0, gradient, turn)
    np.testing.assert_allclose(slopes[8, 8], np.array([0.1 / 1.25, 0.0]) @ turn, atol=1e-7)


@pytest.mark.long
@pytest.mark.parametrize(("stretch", "seed"), [(0.8, 31), (1.2, 32)])
def test_kernels_approach_skin_in_equilibrium(stretch, seed):
    skin = make_micro_skin("forehead", seed=seed, size_mm=2.0)
    by = PlaneStrain(stretch, 0.3, 0.3)
    made = photograph_closeup(skin, by, table=FOREHEAD, camera=CAMERA)
    distance = made.figures["histogram_distance"]
    assert distance["dynamic"] < 0.9 * distance["static"]
    reverse = dataclasses.replace(
        FOREHEAD, alpha_lines=tuple((-a, -b) for a, b in FOREHEAD.alpha_lines)
    )
    other = photograph_closeup(skin, by, table=reverse, camera=CAMERA)
    assert other.figures["histogram_distance"]["dynamic"] > distance["static"]
