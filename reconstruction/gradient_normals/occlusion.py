"""Correct normals by gradient light for the lights that a relief hides from its grooves.

The opposite wall of a groove occludes the lights that the mirror direction of a steep wall needs.
The moments then point to the lights that are left, and the slope is estimated too small. Images
alone do not determine this. The estimated relief does: its horizons give each light's visibility.
The normal is the one whose visible lights give the moments that were observed.
"""

import math
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike
from scipy import ndimage

from model.checks import Checks
from model.fresnel import ETA_SKIN
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals.lobe_response import facet_reflectance
from reconstruction.gradient_normals.patterns import GradientError
from reconstruction.gradient_normals.sphere_lights import (
    SphereLights,
    disc_from_normal,
    normal_from_disc,
)

HORIZON_DIRECTIONS: Final = 24
HORIZON_STEP_RATIO: Final = 1.25
HORIZON_REACH_UM: Final = 600.0
"""Distances of a horizon grow by the ratio from one pixel to the reach: grooves are narrower."""
HORIZON_SOFTNESS_RAD: Final = 0.03
"""Half width of a shadow's edge in elevation: the lens blurs it over some pixels."""
SOLVER_STEPS: Final = 3
"""Steps of the fixed-point iteration per pixel. More would make walls that hide nearly all of their
lights steeper without end: the visible lights no longer depend on their slope."""
SOLVER_TOLERANCE: Final = 5e-4
"""Step at which the iteration ends, a tilt of 0.03 degrees: most pixels hide hardly any light."""
MAX_PLACE: Final = 1.2
"""Largest disc position: a tilt of 74 degrees."""
MIN_COSINE: Final = 1e-3
"""Smallest cosine of light or view, as in `model.brdf.microfacet`."""


def correct_occlusion(
    normals: FloatArray,
    height: FloatArray,
    valid: ArrayLike,
    *,
    pixel_um: float,
    lights: SphereLights,
    alpha: float,
    eta: float = ETA_SKIN,
) -> FloatArray:
    """Return normals as they would be if their own relief hid no light.

    Parameters
    ----------
    normals : ndarray, shape (H, W, 3)
        Unit vectors, z towards the camera; finite where valid.
    height : ndarray, shape (H, W)
        The relief that they give, um; finite where valid. Row 0 is the top.
    valid : array_like of bool, shape (H, W)
        Elsewhere the nearest valid height counts, and the normals are returned as they are.
    pixel_um : float
        Side of a pixel.
    lights : SphereLights
    alpha : float
        GGX roughness of the facets within a pixel, 0.02 to 1.
    eta : float
        Refractive index of the surface.

    Returns
    -------
    ndarray, shape (H, W, 3)
        Light between walls is not included. A pixel that no light reaches keeps its normal.

    Raises
    ------
    GradientError
        Without a valid pixel, and for shapes and numbers out of range.
    SphereLightsError
        For a refractive index outside 1 to 4, and normals that are not finite.

    Examples
    --------
    A plane hides no light:

    >>> flat, up = np.zeros((4, 5)), np.zeros((4, 5, 3)) + [0.0, 0.0, 1.0]
    >>> lights = SphereLights([[0, 0, 1], [0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8]])
    >>> settings = {"pixel_um": 6.0, "lights": lights, "alpha": 0.25}
    >>> bool((correct_occlusion(up, flat, flat == 0.0, **settings) == up).all())
    True
    """
    mask = np.asarray(valid, bool)
    checks = Checks(GradientError)
    checks.shape("height", height, mask.shape)
    checks.shape("normals", normals, (*mask.shape, 3))
    checks.within("pixel_um", pixel_um, "(0, inf)")
    checks.within("alpha", alpha, "[0.02, 1]")
    if not mask.any():
        raise GradientError("valid: got no valid pixel, expected some; check the mask")
    relief = _filled(height, mask)
    checks.within("height", relief)
    out, places = np.array(normals), np.zeros((*mask.shape, 2))
    places[mask] = disc_from_normal(np.asarray(normals[mask], np.float64))
    tables = _light_table(lights, eta)
    found = _solve(relief, places, _steps(pixel_um), float(pixel_um), tables, float(alpha))
    out[mask] = normal_from_disc(found[mask])
    return out


def _filled(height: FloatArray, mask: np.ndarray) -> Float64Array:
    if mask.all():
        return np.ascontiguousarray(height, np.float64)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return np.ascontiguousarray(height[tuple(nearest)], np.float64)


def _steps(pixel_um: float) -> Float64Array:
    """Return the distances at which horizons are sampled, px."""
    count = max(1, math.ceil(math.log(max(HORIZON_REACH_UM / pixel_um, 1.0), HORIZON_STEP_RATIO)))
    return np.unique(np.round(HORIZON_STEP_RATIO ** np.arange(count + 1)))


def _light_table(lights: SphereLights, eta: float) -> tuple[Float64Array, ...]:
    """Return directions, facets, axes of the moments, weights, elevations and turns of lights."""
    view = np.array([0.0, 0.0, 1.0])
    way = np.asarray(lights.directions, np.float64)
    facet = way + view
    facet = facet / np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1e-9)
    weight = lights.intensities * facet_reflectance(lights, view, eta) * (1.0 - lights.leakage)
    axes = lights.programmed if len(lights.programmed) else way
    elevation = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))
    turn = np.arctan2(way[:, 1], way[:, 0]) / (2.0 * math.pi) * HORIZON_DIRECTIONS
    tables = (way, facet, np.asarray(axes, np.float64), weight, elevation, turn)
    return tuple(np.ascontiguousarray(table, np.float64) for table in tables)


@njit(cache=True)
def _place(x, y, z):  # type: ignore[no-untyped-def]
    """Return the disc position of the normal that mirrors the view towards a vector."""
    size = math.sqrt(x * x + y * y + z * z)
    if size < 1e-300:
        return math.nan, math.nan
    x, y, z = x / size, y / size, z / size + 1.0
    size = max(math.sqrt(x * x + y * y + z * z), 1e-6)
    scale = math.sqrt(2.0 / (1.0 + z / size)) / size
    return x * scale, y * scale


@njit(cache=True)
def _to_normal(u, v):  # type: ignore[no-untyped-def]
    """Do as `normal_from_disc` for one position."""
    square = u * u + v * v
    scale = math.sqrt(max(1.0 - 0.25 * square, 0.0))
    return u * scale, v * scale, 1.0 - 0.5 * square


@njit(cache=True)
def _observed(u, v, tables, horizon, alpha, hidden):  # type: ignore[no-untyped-def]
    """Return the disc position that the lights give of a normal, with or without hidden ones."""
    way, facet, axes, weight, elevation, turn = tables
    n_x, n_y, n_z = _to_normal(u, v)
    a2 = alpha * alpha
    to_view = max(n_z, MIN_COSINE)
    of_view = 0.5 * (math.sqrt(1.0 + a2 * (1.0 / to_view**2 - 1.0)) - 1.0)
    x = y = z = 0.0
    for light in range(weight.shape[0]):
        mu = n_x * way[light, 0] + n_y * way[light, 1] + n_z * way[light, 2]
        if mu <= 0.0:
            continue
        half = n_x * facet[light, 0] + n_y * facet[light, 1] + n_z * facet[light, 2]
        half = min(max(half, 0.0), 1.0)
        lobe = a2 / (half * half * (a2 - 1.0) + 1.0) ** 2
        to_light = max(mu, MIN_COSINE)
        of_light = 0.5 * (math.sqrt(1.0 + a2 * (1.0 / to_light**2 - 1.0)) - 1.0)
        part = weight[light] * lobe * mu / ((1.0 + of_light + of_view) * to_light)
        if hidden:
            first = math.floor(turn[light])
            rest = turn[light] - first
            edge = (1.0 - rest) * horizon[int(first) % HORIZON_DIRECTIONS]
            edge += rest * horizon[int(first + 1) % HORIZON_DIRECTIONS]
            free = 0.5 + 0.5 * (elevation[light] - edge) / HORIZON_SOFTNESS_RAD
            part *= min(max(free, 0.0), 1.0)
        x += part * axes[light, 0]
        y += part * axes[light, 1]
        z += part * axes[light, 2]
    return _place(x, y, z)


@njit(cache=True)
def _fill_horizon(relief, row, column, steps, pixel_um, horizon):  # type: ignore[no-untyped-def]
    """Find the elevations of a pixel's horizon, rad; return the highest. 0 is the plane."""
    height, width = relief.shape
    highest = 0.0
    for k in range(HORIZON_DIRECTIONS):
        turn = 2.0 * math.pi * k / HORIZON_DIRECTIONS
        sine, cosine = math.sin(turn), math.cos(turn)
        tangent = 0.0
        for step in steps:
            y = min(max(row - step * sine, 0.0), height - 1.0)
            x = min(max(column + step * cosine, 0.0), width - 1.0)
            i, j = int(y), int(x)
            below, right = min(i + 1, height - 1), min(j + 1, width - 1)
            v, u = y - i, x - j
            upper = relief[i, j] + u * (relief[i, right] - relief[i, j])
            lower = relief[below, j] + u * (relief[below, right] - relief[below, j])
            there = upper + v * (lower - upper)
            tangent = max(tangent, (there - relief[row, column]) / (step * pixel_um))
        horizon[k] = math.atan(tangent)
        highest = max(highest, horizon[k])
    return highest


@njit(parallel=True, cache=True)
def _solve(relief, places, steps, pixel_um, tables, alpha):  # type: ignore[no-untyped-def]
    """Find the disc positions whose visible lights give what all lights give of `places`."""
    height, width = relief.shape
    out = places.copy()
    for row in prange(height):
        horizon = np.empty(HORIZON_DIRECTIONS)
        for column in range(width):
            if _fill_horizon(relief, row, column, steps, pixel_um, horizon) == 0.0:
                continue
            u, v = places[row, column, 0], places[row, column, 1]
            wanted_u, wanted_v = _observed(u, v, tables, horizon, alpha, False)
            for _ in range(SOLVER_STEPS):
                now_u, now_v = _observed(u, v, tables, horizon, alpha, True)
                step_u, step_v = wanted_u - now_u, wanted_v - now_v
                if math.isnan(step_u):  # no light is left
                    break
                u, v = u + step_u, v + step_v
                size = math.sqrt(u * u + v * v)
                if size > MAX_PLACE:
                    u, v = u * MAX_PLACE / size, v * MAX_PLACE / size
                if math.sqrt(step_u * step_u + step_v * step_v) < SOLVER_TOLERANCE:
                    break
            out[row, column, 0], out[row, column, 1] = u, v
    return out
