"""Compute the reflection of a surface element under a sphere of LEDs, as four moments of the light.

Every lighting condition of the sphere weights LED k by a linear combination of 1 and the
coordinates w_k of its direction. Four sums over the LEDs, with weights 1, x, y and z, therefore
serve all conditions: of the surface's reflection as Stokes vectors, which serve every analyzer
angle, and of the light that enters.

The sums are smooth functions of the normal and of the position in the field, and are interpolated
from a table; `sum_led_moments` is the exact sum.

Notes
-----
The table's axes are p = n_xy / (1 + n_z), the tangent of half the tilt. A facet's reflection
rotates with its half angle, so that the lobe has about the same width everywhere in p. Values
between nodes are interpolated with cubics in p (Catmull and Rom 1974) and linearly over the field.
Steeper normals than `MAX_TILT_DEG` are summed directly.

The LEDs are points here. Their spacing is about 17 degrees, so that facets that mirror neighbors
into the camera differ by 8.5 degrees. A narrower lobe resolves single LEDs, and the sum shows their
lattice as a function of the normal. `lattice_ripple` measures it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.as_built.sphere import REFERENCE_DISTANCE_MM, ActualSphere
from rigsim.light.led_light import lobe_exponent

MAX_TILT_DEG: Final = 70.0
"""Largest tilt of normals in the table, degrees."""

MOMENT_CHANNELS: Final = 16
"""Values per node of the table: 4 moments x 3 Stokes parameters, then 4 of entering light."""


class MomentError(ValueError):
    """An invalid request for a table or a sum of moments."""


@dataclass(frozen=True, slots=True)
class MicrofacetSurface:
    """Reflection of a surface element, with the viewing camera."""

    alpha: float
    """GGX roughness, 1e-3 to 1."""
    eta: float
    """Refractive index of the interior, > 1."""
    eye_mm: tuple[float, float, float]
    """Position of the camera, mm, rig frame."""
    image_right: tuple[float, float, float]
    """The image's x axis, unit vector."""
    extinction: float
    """Extinction ratio of the LEDs' polarizers, > 1."""


@dataclass(frozen=True, slots=True)
class LightMoments:
    """Sums over the LEDs for some surface elements."""

    specular: Float32Array
    """Stokes vectors of the surface's reflection, shape (N, 4, 3), radiance in 1/sr per unit of
    `irradiance_per_led`; the moments in the order of `rigsim.as_built.sphere.MOMENT_NAMES`."""
    entering: Float32Array
    """Light that enters, shape (N, 4), cosine included."""

    def packed(self) -> Float32Array:
        """Return both as shape (N, `MOMENT_CHANNELS`)."""
        count = len(self.entering)
        return np.concatenate([self.specular.reshape(count, 12), self.entering], axis=1)


def irradiance_per_led(
    sphere: ActualSphere, positions_mm: ArrayLike, led: int
) -> tuple[Float64Array, Float64Array]:
    """Return the direction of an LED and its irradiance across the beam, without its polarizer.

    Parameters
    ----------
    sphere
        The LEDs; their lobes point at the origin.
    positions_mm
        Points, shape (N, 3).
    led
        Index of the LED.

    Returns
    -------
    to_light : ndarray
        Unit vectors, shape (N, 3).
    share : ndarray
        Intensity times the square of 600 mm over distance squared, shape (N,).
    """
    place = sphere.position_mm[led]
    way = place - np.asarray(positions_mm, np.float64)
    square = np.einsum("ni,ni->n", way, way)
    to_light = way / np.sqrt(square)[:, None]
    off = np.clip(to_light @ (place / np.linalg.norm(place)), 0.0, 1.0)
    lobe = off ** lobe_exponent(sphere.nominal.lights[led])
    return to_light, sphere.intensity[led] * lobe * REFERENCE_DISTANCE_MM**2 / square


def led_moments(
    normals: ArrayLike,
    positions_mm: ArrayLike,
    sphere: ActualSphere,
    led: int,
    surface: MicrofacetSurface,
    *,
    alpha: ArrayLike | None = None,
) -> tuple[Float32Array, Float32Array]:
    """Return one LED's unweighted Stokes vectors (N, 3) and entering light (N,).

    Parameters
    ----------
    normals, positions_mm
        Unit normals, and points in mm, shape (N, 3).
    sphere, led
        The LED.
    surface
        Reflection of the surface.
    alpha
        Roughness of each point, shape (N,); None takes the surface's.
    """
    points = np.asarray(positions_mm, np.float64)
    to_light, share = irradiance_per_led(sphere, points, led)
    to_camera = np.asarray(surface.eye_mm) - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    specular = shading.specular_stokes(
        normals,
        to_light,
        to_camera,
        surface.alpha if alpha is None else alpha,
        eta=surface.eta,
        light_absorbs=sphere.absorbs[led],
        image_right=surface.image_right,
        extinction=surface.extinction,
    )
    entry = shading.entry_transmittance(
        normals,
        to_light,
        eta=surface.eta,
        light_absorbs=sphere.absorbs[led],
        extinction=surface.extinction,
    )
    cosine = np.einsum("ni,ni->n", np.asarray(normals, np.float32), to_light.astype(np.float32))
    entry = entry * np.maximum(cosine, np.float32(0.0))
    scale = share.astype(np.float32)
    return specular * scale[:, None], np.asarray(entry * scale, np.float32)


def sum_led_moments(
    normals: ArrayLike,
    positions_mm: ArrayLike,
    sphere: ActualSphere,
    surface: MicrofacetSurface,
    *,
    leds: Sequence[int] | None = None,
    alpha: ArrayLike | None = None,
) -> LightMoments:
    """Sum the moments over the LEDs directly.

    Parameters
    ----------
    normals
        Unit normals, shape (N, 3), rig frame.
    positions_mm
        Points, mm, shape (N, 3) or (3,).
    sphere
        The LEDs.
    surface
        Reflection of the surface.
    leds
        Indices of the LEDs; None takes all.
    alpha
        Roughness of each point, shape (N,); None takes the surface's.

    Returns
    -------
    LightMoments
    """
    n = np.asarray(normals, np.float32)
    points = np.broadcast_to(np.asarray(positions_mm, np.float64), n.shape)
    specular = np.zeros((len(n), 4, 3))
    entering = np.zeros((len(n), 4))
    weights = sphere.weights
    for led in range(len(weights)) if leds is None else leds:
        if sphere.intensity[led] == 0.0:
            continue
        stokes, entry = led_moments(n, points, sphere, led, surface, alpha=alpha)
        specular += weights[led][None, :, None] * stokes[:, None, :]
        entering += weights[led][None, :] * entry[:, None]
    return LightMoments(specular.astype(np.float32), entering.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class MomentTable:
    """Moments as a function of the normal and the position in the field."""

    values: Float32Array
    """Shape (alphas, fields, fields, size, size, `MOMENT_CHANNELS`): y, x, then p_y, p_x, all
    ascending."""
    alphas: Float64Array
    """Roughnesses, evenly spaced, 1 or 3 of them; interpolated by a parabola."""
    half_field_mm: float
    """The field's nodes range from minus to plus this, mm."""
    reach: float
    """The nodes of p range from minus to plus this."""

    def covers(self, normals: Float32Array) -> BoolArray:
        """Return which normals are within the table, shape (N,)."""
        return np.asarray(normals[:, 2] >= np.float32(math.cos(math.radians(MAX_TILT_DEG))))

    def lookup(
        self,
        normals: Float32Array,
        x_mm: Float32Array,
        y_mm: Float32Array,
        alpha: Float32Array | None = None,
    ) -> Float32Array:
        """Interpolate the moments of normals within `MAX_TILT_DEG`, shape (N, `MOMENT_CHANNELS`).

        Parameters
        ----------
        normals
            Unit normals, shape (N, 3); steeper ones yield zeros.
        x_mm, y_mm
            Positions, shape (N,); those beyond the field are clamped to its border.
        alpha
            Roughness, shape (N,), within the table's range; None takes the middle one.
        """
        nodes = len(self.alphas)
        share = np.zeros((len(normals), nodes), np.float32)
        share[:, nodes // 2] = 1.0
        if nodes > 1 and alpha is not None:
            t = (alpha - np.float32(self.alphas[1])) / np.float32(self.alphas[1] - self.alphas[0])
            share[:, 0], share[:, 1], share[:, 2] = 0.5 * t * (t - 1), 1 - t * t, 0.5 * t * (t + 1)
        out = np.zeros((len(normals), MOMENT_CHANNELS), np.float32)
        least_z = math.cos(math.radians(MAX_TILT_DEG))
        limits = (np.float32(part) for part in (self.half_field_mm, self.reach, least_z))
        at = (np.ascontiguousarray(part, np.float32) for part in (normals, x_mm, y_mm))
        _lookup(self.values, *limits, *at, share, out)
        return out


def tabulate_moments(
    sphere: ActualSphere,
    surface: MicrofacetSurface,
    *,
    half_field_mm: float,
    alpha_range: tuple[float, float] | None = None,
    size: int = 97,
    fields: int = 3,
    leds: Sequence[int] | None = None,
) -> MomentTable:
    """Tabulate the moments over normals, field and roughness.

    Parameters
    ----------
    sphere, surface, leds
        As for `sum_led_moments`.
    half_field_mm
        Half the side of the field, mm, > 0.
    alpha_range
        Smallest and largest roughness; None takes that of the surface only.
    size
        Nodes along each axis of the normals, >= 9.
    fields
        Nodes along each side of the field, >= 2.

    Returns
    -------
    MomentTable

    Raises
    ------
    MomentError
        Too few nodes, or no field.
    """
    if size < 9 or fields < 2:
        raise MomentError(f"size, fields: got {size}, {fields}, expected at least 9 and 2")
    if not half_field_mm > 0.0:
        raise MomentError(f"half_field_mm: got {half_field_mm}, expected > 0")
    # the cubic needs one node beyond the steepest normal
    edge = math.tan(0.5 * math.radians(MAX_TILT_DEG))
    reach = edge * (size - 1) / (size - 1 - 4)
    axis = np.linspace(-reach, reach, size)
    py, px = np.meshgrid(axis, axis, indexing="ij")
    # p is the stereographic projection of the normal, with the inverse n = (2 p, 1 - p^2) / (1 +
    # p^2).
    square = px**2 + py**2
    inside = square <= (edge + 2.1 * math.sqrt(2.0) * (axis[1] - axis[0])) ** 2
    normals = (np.stack([2 * px, 2 * py, 1 - square], axis=-1) / (1 + square)[..., None])[inside]
    nodes = np.linspace(-half_field_mm, half_field_mm, fields)
    low, high = alpha_range or (surface.alpha, surface.alpha)
    alphas = np.array([low]) if high <= low else np.linspace(low, high, 3)
    values = np.zeros((len(alphas), fields, fields, size, size, MOMENT_CHANNELS), np.float32)
    # few long sums: one per LED, over all nodes
    k, row, column, node = np.meshgrid(
        np.arange(len(alphas)),
        np.arange(fields),
        np.arange(fields),
        np.arange(len(normals)),
        indexing="ij",
    )
    places = np.stack([nodes[column], nodes[row], np.zeros(row.shape)], axis=-1).reshape(-1, 3)
    found = sum_led_moments(
        normals[node.ravel()], places, sphere, surface, leds=leds, alpha=alphas[k.ravel()]
    )
    values[:, :, :, inside] = found.packed().reshape(*row.shape, MOMENT_CHANNELS)
    return MomentTable(values, alphas, half_field_mm, reach)


def lattice_ripple(
    sphere: ActualSphere, surface: MicrofacetSurface, *, max_slope_deg: float = 25.0
) -> float:
    """Return the ripple of the LED lattice in the reflection under all LEDs.

    Parameters
    ----------
    sphere, surface
        As for `sum_led_moments`.
    max_slope_deg
        Largest tilt of the evaluated normals.

    Returns
    -------
    float
        Standard deviation of S0 under all LEDs about its smooth trend (a parabola), over its mean.
    """
    count = 2500
    k = np.arange(count) + 0.5
    height = 1.0 - (1.0 - math.cos(math.radians(max_slope_deg))) * k / count
    phi = math.pi * (1.0 + math.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    normals = np.column_stack([flat * np.cos(phi), flat * np.sin(phi), height])
    s0 = sum_led_moments(normals, (0.0, 0.0, 0.0), sphere, surface).specular[:, 0, 0]
    x, y = normals[:, 0], normals[:, 1]
    basis = np.column_stack([np.ones(count), x, y, x * x, x * y, y * y])
    rest = s0 - basis @ np.linalg.lstsq(basis, s0, rcond=None)[0]
    return float(rest.std() / s0.mean())


@njit(cache=True, inline="always")
def _cubic(t):  # type: ignore[no-untyped-def]
    """Return the four weights of Catmull and Rom's cubic."""
    a = np.float32(0.5) * t * (t * (np.float32(2.0) - t) - np.float32(1.0))
    d = np.float32(0.5) * t * t * (t - np.float32(1.0))
    b = np.float32(1.0) + np.float32(0.5) * t * t * (np.float32(3.0) * t - np.float32(5.0))
    return a, b, np.float32(1.0) - a - b - d, d


@njit(fastmath=True, forceinline=True)
def _add_four(a, b, c, d, p, q, r, s, out):  # type: ignore[no-untyped-def]
    """Add four weighted nodes: the sum is read and written once for them."""
    for k in range(out.size):
        out[k] += (a * p[k] + b * q[k]) + (c * r[k] + d * s[k])


@njit(parallel=True, cache=True, fastmath=True)
def _lookup(values, half_field, reach, least_z, normals, x, y, alphas, out):  # type: ignore[no-untyped-def]
    fields, size = values.shape[1], values.shape[3]
    per_p = np.float32((size - 1) / (2.0 * reach))
    per_mm = np.float32((fields - 1) / (2.0 * half_field))
    most = np.float32(fields - 1)
    for i in prange(normals.shape[0]):
        nz = normals[i, 2]
        if nz < least_z:
            continue
        u = (normals[i, 0] / (np.float32(1.0) + nz) + reach) * per_p
        v = (normals[i, 1] / (np.float32(1.0) + nz) + reach) * per_p
        column, row = int(u), int(v)
        a = _cubic(u - np.float32(column))
        b = _cubic(v - np.float32(row))
        fx = min(max((x[i] + half_field) * per_mm, np.float32(0.0)), most)
        fy = min(max((y[i] + half_field) * per_mm, np.float32(0.0)), most)
        left, low = min(int(fx), fields - 2), min(int(fy), fields - 2)
        fx -= np.float32(left)
        fy -= np.float32(low)
        for q in range(4 * values.shape[0]):
            level, n = q // 4, q % 4
            weight = (fx if n % 2 else np.float32(1.0) - fx) * (
                fy if n // 2 else np.float32(1.0) - fy
            )
            weight *= alphas[i, level]
            if weight == np.float32(0.0):
                continue
            for r in range(4):
                line = values[level, low + n // 2, left + n % 2, row + r - 1]
                share = weight * b[r]
                _add_four(
                    share * a[0],
                    share * a[1],
                    share * a[2],
                    share * a[3],
                    line[column - 1],
                    line[column],
                    line[column + 1],
                    line[column + 2],
                    out[i],
                )
