"""Subtract light that a relief hides from its own points from the sum over all LEDs."""

import math
from typing import Protocol

import numpy as np
from numba import njit, prange

from rigsim.arrays import BoolArray, Float32Array
from rigsim.as_built.sphere import REFERENCE_DISTANCE_MM, ActualSphere
from rigsim.light.led_light import lobe_exponent
from rigsim.light.lobe_moments import MicrofacetSurface
from rigsim.shading_kernels import entry_transmittance_element, specular_stokes_element


class SurfaceElements(Protocol):
    """Surface elements of an image."""

    @property
    def x_mm(self) -> Float32Array:
        """Position, shape (H, W)."""

    @property
    def y_mm(self) -> Float32Array:
        """Position, shape (H, W)."""

    @property
    def normals(self) -> Float32Array:
        """Unit normals, shape (H, W, 3)."""

    @property
    def alpha(self) -> Float32Array:
        """Roughness, shape (H, W)."""

    @property
    def skin(self) -> BoolArray:
        """Where light is subtracted, shape (H, W)."""


def subtract_hidden_led(
    packed: Float32Array,
    elements: SurfaceElements,
    horizon: tuple[Float32Array, Float32Array, float],
    sphere: ActualSphere,
    led: int,
    surface: MicrofacetSurface,
) -> None:
    """Subtract an LED, in place, where the horizon hides it.

    The part of its disc below the horizon is modeled as linear in the horizon's elevation.

    Parameters
    ----------
    packed
        Moments, planar, shape (16, H, W): as `rigsim.light.lobe_moments.LightMoments.packed`.
    elements
        The surface.
    horizon
        Tangents of the horizon's elevation in the two directions adjacent to the LED's, shape
        (H, W), and the LED's fractional position from the first to the second.
    sphere, led
        The LED, above the plane of the patch.
    surface
        Reflection of the surface.
    """
    place = sphere.position_mm[led]
    distance = float(np.linalg.norm(place))
    elevation = math.asin(min(max(float(place[2]) / distance, -1.0), 1.0))
    radius = float(sphere.radius_mm[led]) / distance
    first, second, between = horizon
    flat = (elements.x_mm, elements.y_mm, elements.alpha, elements.skin, first, second)
    low = np.float32(math.tan(max(elevation - radius, 0.0)))
    intensity = float(sphere.intensity[led]) * REFERENCE_DISTANCE_MM**2
    lobe = (intensity, lobe_exponent(sphere.nominal.lights[led]), sphere.weights[led])
    look = (np.array(surface.eye_mm, np.float64), np.array(surface.image_right, np.float64))
    _remove(
        packed.reshape(len(packed), -1),
        (elements.normals.reshape(-1, 3), *(part.reshape(-1) for part in flat)),
        (np.float32(between), low, elevation, radius),
        (place, sphere.absorbs[led], *lobe),
        (*look, surface.eta, 1.0 / surface.extinction),
    )


@njit(parallel=True, cache=True)
def _remove(packed, elements, edge, led, look):  # type: ignore[no-untyped-def]
    normals, x, y, alpha, skin, first, second = elements
    between, low, elevation, radius = edge
    place, absorbs, intensity, exponent, weights = led
    eye, right, eta, leak = look
    distance = math.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
    for i in prange(normals.shape[0]):
        tangent = first[i] + between * (second[i] - first[i])
        if tangent <= low or not skin[i]:
            continue
        # Linear in elevation: 0 where the horizon touches the disc's lower edge, 1 at its upper
        # edge.
        part = min(0.5 + 0.5 * (math.atan(tangent) - elevation) / radius, 1.0)
        n0, n1, n2 = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        l0, l1, l2 = place[0] - x[i], place[1] - y[i], place[2]
        square = l0 * l0 + l1 * l1 + l2 * l2
        length = math.sqrt(square)
        l0, l1, l2 = l0 / length, l1 / length, l2 / length
        nl = n0 * l0 + n1 * l1 + n2 * l2
        if nl <= 0.0 or part <= 0.0:
            continue
        off = (l0 * place[0] + l1 * place[1] + l2 * place[2]) / distance
        share = part * intensity * off**exponent / square
        v0, v1, v2 = eye[0] - x[i], eye[1] - y[i], eye[2]
        length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 / length, v1 / length, v2 / length
        s0, s1, s2 = specular_stokes_element(
            n0, n1, n2, l0, l1, l2, v0, v1, v2, float(alpha[i]), eta, absorbs, right, leak, 0.0
        )
        entered = (
            share * nl * entry_transmittance_element(n0, n1, n2, l0, l1, l2, eta, absorbs, leak)
        )
        for m in range(4):
            weight = weights[m] * share
            packed[3 * m, i] -= weight * s0
            packed[3 * m + 1, i] -= weight * s1
            packed[3 * m + 2, i] -= weight * s2
            packed[12 + m, i] -= weights[m] * entered
