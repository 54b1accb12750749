"""The closed-form polarized shading against Mitsuba's polarized plastic."""

import math
from typing import Any

import numpy as np
import pytest

from rigsim import shading
from rigsim.render import load_mitsuba
from rigsim.render.variant import choose_variant

pytestmark = pytest.mark.render

ETA = 1.4
DIFFUSE = 0.6


@pytest.fixture(scope="module")
def mitsuba() -> Any:
    choice = choose_variant("mono_polarized")
    if not choice.is_vectorized:
        pytest.skip(f"no vectorized polarized variant: {choice.why}")
    return load_mitsuba(choice)


def directions_around_the_normal(count: int, rng: np.random.Generator) -> np.ndarray:
    z = rng.uniform(0.05, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)


def mueller_of_plastic(mi: Any, alpha: float, light: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Evaluate pplastic's Mueller matrices, shape (N, 4, 4)."""
    bsdf = mi.load_dict(
        {
            "type": "pplastic",
            "diffuse_reflectance": {"type": "uniform", "value": DIFFUSE},
            "int_ior": ETA,
            "ext_ior": 1.0,
            "alpha": alpha,
            "distribution": "ggx",
        }
    )
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*camera.T)
    matrix = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*light.T))
    entries = [[np.array(matrix[i, j]).ravel() for j in range(4)] for i in range(4)]
    full = [[np.broadcast_to(entry, len(light)) for entry in row] for row in entries]
    return np.moveaxis(np.array(full), -1, 0)


def stokes_basis(mi: Any, forward: np.ndarray) -> np.ndarray:
    return np.array(mi.mueller.stokes_basis(mi.Vector3f(*forward.T))).T


def twice_the_angle(
    vector: np.ndarray, basis: np.ndarray, forward: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    x = np.sum(vector * basis, axis=-1)
    y = np.sum(vector * np.cross(forward, basis), axis=-1)
    norm = x * x + y * y
    return (x * x - y * y) / norm, 2.0 * x * y / norm


@pytest.mark.parametrize("alpha", [0.1, 0.25, 0.5])
def test_closed_form_equals_mueller_matrices_of_polarized_plastic(mitsuba, alpha):
    """Rationale: two independent derivations of the same optics.

    Expected: equal Stokes vectors for light polarized along any axis. Tolerance: float32 on both
    sides, 40 steps (5e-6) rms; near grazing directions cancel digits, so 1e-4 at worst.
    """
    rng = np.random.default_rng(12345)
    light = directions_around_the_normal(4000, rng).astype(np.float64)
    camera = directions_around_the_normal(4000, rng).astype(np.float64)
    light /= np.linalg.norm(light, axis=-1, keepdims=True)
    camera /= np.linalg.norm(camera, axis=-1, keepdims=True)
    normal = np.broadcast_to([0.0, 0.0, 1.0], light.shape)
    absorbs = np.array([0.36, -0.48, 0.8])
    right = np.array([1.0, 0.0, 0.0])

    mueller = mueller_of_plastic(mitsuba, alpha, light, camera)
    passes = np.cross(absorbs, light)
    cos2, sin2 = twice_the_angle(passes, stokes_basis(mitsuba, -light), -light)
    incoming = 0.5 * np.stack([np.ones_like(cos2), cos2, sin2, np.zeros_like(cos2)], axis=-1)
    out = np.einsum("nij,nj->ni", mueller, incoming)
    h = right - np.sum(camera * right, axis=-1, keepdims=True) * camera
    turn_cos, turn_sin = twice_the_angle(h, stokes_basis(mitsuba, camera), camera)
    expected = np.stack(
        [
            out[:, 0],
            turn_cos * out[:, 1] + turn_sin * out[:, 2],
            -turn_sin * out[:, 1] + turn_cos * out[:, 2],
        ],
        axis=-1,
    )

    specular = shading.specular_stokes(
        normal, light, camera, alpha, eta=ETA, light_absorbs=absorbs, image_right=right
    )
    entry = shading.entry_transmittance(normal, light, eta=ETA, light_absorbs=absorbs)
    leaving = shading.exit_stokes(normal, camera, eta=ETA, image_right=right)
    diffuse = DIFFUSE / math.pi * (light[:, 2] * entry)[:, None] * leaving

    relative = np.abs(specular + diffuse - expected).max(axis=-1) / expected[:, 0]
    assert np.sqrt(np.mean(relative**2)) < 5e-6
    assert np.max(relative) < 1e-4

    # The same bound must catch the shortcut that calls the diffuse light unpolarized on exit.
    diffuse[:, 1:] = 0.0
    shortcut = np.abs(specular + diffuse - expected).max(axis=-1) / expected[:, 0]
    assert np.sqrt(np.mean(shortcut**2)) > 1e-2
