"""Polarized shading, in closed form and by `skincoat`, against Mitsuba's polarized plastic."""

import math
from typing import Any

import numpy as np
import pytest

from rigsim import shading
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant

pytestmark = pytest.mark.render

ETA = 1.4
DIFFUSE = 0.6


@pytest.fixture(scope="module")
def mitsuba() -> Any:
    choice = choose_variant("mono_polarized")
    if not choice.is_vectorized:
        pytest.skip(f"no vectorized polarized variant: {choice.why}")
    return load_mitsuba(choice)


@pytest.fixture(autouse=True)
def active_variant(mitsuba):
    """Restore the variant, which is a state of the process."""
    load_mitsuba(choose_variant("mono_polarized"))


def directions_around_the_normal(count: int, rng: np.random.Generator) -> np.ndarray:
    z = rng.uniform(0.05, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).astype(np.float32)


def plastic(alpha: float) -> dict[str, Any]:
    return {
        "type": "pplastic",
        "diffuse_reflectance": {"type": "uniform", "value": DIFFUSE},
        "int_ior": ETA,
        "ext_ior": 1.0,
        "alpha": alpha,
        "distribution": "ggx",
    }


def surface_points(mi: Any, camera: np.ndarray) -> Any:
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, len(camera))
    si.n = mi.Normal3f(0.0, 0.0, 1.0)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(*camera.T)
    return si


def entries(matrix: Any, count: int) -> np.ndarray:
    rows = [[np.array(matrix[i, j]).ravel() for j in range(4)] for i in range(4)]
    full = [[np.broadcast_to(entry, count) for entry in row] for row in rows]
    return np.moveaxis(np.array(full), -1, 0)


def mueller_of(
    mi: Any, description: dict[str, Any], light: np.ndarray, camera: np.ndarray, mode: str = ""
) -> np.ndarray:
    """Evaluate a BSDF's Mueller matrices, shape (N, 4, 4)."""
    context = mi.BSDFContext(getattr(mi.TransportMode, mode or "Radiance"))
    matrix = mi.load_dict(description).eval(
        context, surface_points(mi, camera), mi.Vector3f(*light.T)
    )
    return entries(matrix, len(light))


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

    mueller = mueller_of(mitsuba, plastic(alpha), light, camera)
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


# the BSDF `skincoat` ----------------------------------------------------------------------------

SKIN = {"type": "skincoat", "r_d": DIFFUSE, "alpha": 0.3, "oil": 0.3, "vellus": 1e-3, "bare": 0.9}
COATING = {"film": 0.5, "film_alpha": 0.2, "film_ior": 1.5, "powder": 0.2}


def light_and_camera(count: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    return directions_around_the_normal(count, rng), directions_around_the_normal(count, rng)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
@pytest.mark.parametrize("alpha", [0.1, 0.3])
def test_skin_of_one_lobe_is_polarized_plastic(mitsuba, alpha, mode):
    """Rationale: two codes. Tolerance: float32, digits cancel near grazing directions."""
    light, camera = light_and_camera()
    expected = mueller_of(mitsuba, plastic(alpha), light, camera, mode)
    skin = {"type": "skincoat", "r_d": DIFFUSE, "alpha": alpha, "distribution": "ggx"}
    scale = expected[:, :1, :1]
    found = mueller_of(mitsuba, skin, light, camera, mode)
    assert np.abs((found - expected) / scale).max() < 2e-4
    other = mueller_of(mitsuba, skin | {"distribution": "beckmann"}, light, camera, mode)
    assert np.abs((other - expected) / scale).max() > 0.01


@pytest.mark.parametrize("coating", [{}, COATING], ids=["bare", "coated"])
def test_unpolarized_part_is_the_rgb_variants(mitsuba, coating):
    light, camera = light_and_camera()
    polarized = mueller_of(mitsuba, SKIN | coating, light, camera)
    mi = load_mitsuba(choose_variant("rgb"))
    points, way = surface_points(mi, camera), mi.Vector3f(*light.T)
    plain = np.array(mi.load_dict(SKIN | coating).eval(mi.BSDFContext(), points, way))[0]
    np.testing.assert_allclose(polarized[:, 0, 0], plain, rtol=1e-4)
    assert np.abs(polarized[:, 1:, 0]).max() > 0.01


@pytest.mark.parametrize("coating", [{}, COATING], ids=["bare", "coated"])
def test_polarized_light_stays_physical(mitsuba, coating):
    """No light is polarized by more than all of it, from any linear polarization."""
    matrix = mueller_of(mitsuba, SKIN | coating, *light_and_camera())
    for angle in np.radians([0.0, 30.0, 45.0, 90.0, 120.0]):
        out = matrix @ np.array([1.0, np.cos(2 * angle), np.sin(2 * angle), 0.0])
        degree = np.linalg.norm(out[:, 1:], axis=1) / out[:, 0]
        assert 0.3 < degree.max() < 1.0 + 1e-4


def test_polarized_samples_gain_no_light(mitsuba):
    """Rationale: white furnace for polarized light. Tolerance: four standard errors."""
    import drjit as dr

    mi, count = mitsuba, 1 << 18
    white = mi.load_dict(SKIN | {"r_d": 1.0, "vellus": 0.0, "bare": 1.0})
    for theta in np.radians([0.0, 60.0, 80.0]):
        camera = np.tile([[np.sin(theta), 0.0, np.cos(theta)]], (count, 1)).astype(np.float32)
        numbers = mi.PCG32(size=count)
        one, two, three = (numbers.next_float32() for _ in range(3))
        points = surface_points(mi, camera)
        sample, weight = white.sample(mi.BSDFContext(), points, one, mi.Point2f(two, three))
        dr.eval(sample, weight)
        matrix = entries(weight, count)
        spread = matrix[:, 0, 0].std() / np.sqrt(count)
        assert 0.6 < matrix[:, 0, 0].mean() < 1.0 + 4.0 * spread
        assert np.isfinite(matrix).all()
        density = np.array(white.pdf(mi.BSDFContext(), points, sample.wo))
        np.testing.assert_allclose(density, np.array(sample.pdf), rtol=1e-4)
