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
from reconstruction.arrays import Float64Array, FloatArray, Int64Array
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
BLOCK_COLUMNS: Final = 256
"""Pixels of a row whose horizons are found together."""
FAST_MATH: Final = {"reassoc", "contract", "nsz", "arcp"}
"""Reordered sums, which run in whole vectors; NaN keeps its meaning."""
FINITE_MATH: Final = FAST_MATH | {"nnan", "ninf"}
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
    samples = _horizon_samples(pixel_um, mask.shape)
    table = _light_table(lights, eta)
    found = _solve(np.pad(relief, samples[2], "edge"), places, samples, table, float(alpha))
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


def _horizon_samples(
    pixel_um: float, size: tuple[int, ...]
) -> tuple[Int64Array, Float64Array, int]:
    """Return where each direction samples a relief of a size about a pixel, and how far.

    Rows and columns of the upper left neighbor, shape (2, K, S); fractions down and right of it,
    and the inverse distance in 1/um, shape (3, K, S). Beyond the relief its edge is repeated, so
    that a sample as far away as the relief is wide has the height of any farther one.
    """
    steps = _steps(pixel_um)
    turn = 2.0 * math.pi * np.arange(HORIZON_DIRECTIONS) / HORIZON_DIRECTIONS
    place = np.stack([-np.outer(np.sin(turn), steps), np.outer(np.cos(turn), steps)])
    side = np.array(size, np.float64)[:, None, None]
    place = np.clip(place, -side, side)
    corner = np.floor(place)
    per_um = np.broadcast_to(1.0 / (steps * pixel_um), place.shape[1:])
    shift = np.ascontiguousarray(corner, np.int64)
    margin = min(int(steps.max()), max(size)) + 1
    return shift, np.concatenate([place - corner, per_um[None]]), margin


def _light_table(lights: SphereLights, eta: float) -> tuple[Float64Array, Int64Array]:
    """Return numbers of the lights, shape (12, N), and adjacent horizons, shape (2, N).

    Rows: direction, facet and axis of the moments, 3 each; weight; elevation; position between the
    adjacent horizons. Each row is contiguous, so that sums over lights run in whole vectors.
    """
    view = np.array([0.0, 0.0, 1.0])
    way = np.asarray(lights.directions, np.float64)
    facet = way + view
    facet = facet / np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1e-9)
    weight = lights.intensities * facet_reflectance(lights, view, eta) * (1.0 - lights.leakage)
    axes = lights.programmed if len(lights.programmed) else way
    elevation = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))
    turn = np.arctan2(way[:, 1], way[:, 0]) / (2.0 * math.pi) * HORIZON_DIRECTIONS
    first = np.floor(turn)
    adjacent = (np.stack([first, first + 1.0]).astype(np.int64)) % HORIZON_DIRECTIONS
    numbers = np.vstack([way.T, facet.T, axes.T, weight, elevation, turn - first])
    return np.ascontiguousarray(numbers, np.float64), np.ascontiguousarray(adjacent)


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


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _observed(u, v, lights, horizon, alpha, hidden):  # type: ignore[no-untyped-def]
    """Return the disc position that the lights give of a normal, with or without hidden ones."""
    numbers, adjacent = lights
    n_x, n_y, n_z = _to_normal(u, v)
    a2 = alpha * alpha
    to_view = max(n_z, MIN_COSINE)
    of_view = 0.5 * (math.sqrt(1.0 + a2 * (1.0 / to_view**2 - 1.0)) - 1.0)
    x = y = z = 0.0
    for light in range(numbers.shape[1]):
        way_x, way_y, way_z = numbers[0, light], numbers[1, light], numbers[2, light]
        mu = n_x * way_x + n_y * way_y + n_z * way_z
        half = n_x * numbers[3, light] + n_y * numbers[4, light] + n_z * numbers[5, light]
        half = min(max(half, 0.0), 1.0)
        width = half * half * (a2 - 1.0) + 1.0
        to_light = max(mu, MIN_COSINE)
        of_light = 0.5 * (math.sqrt(1.0 + a2 * (1.0 / (to_light * to_light) - 1.0)) - 1.0)
        part = numbers[9, light] * a2 * max(mu, 0.0)
        part /= width * width * (1.0 + of_light + of_view) * to_light
        if hidden:
            rest = numbers[11, light]
            edge = (1.0 - rest) * horizon[adjacent[0, light]] + rest * horizon[adjacent[1, light]]
            free = 0.5 + (0.5 / HORIZON_SOFTNESS_RAD) * (numbers[10, light] - edge)
            part *= min(max(free, 0.0), 1.0)
        x += part * numbers[6, light]
        y += part * numbers[7, light]
        z += part * numbers[8, light]
    return _place(x, y, z)


@njit(fastmath=FINITE_MATH, error_model="numpy", forceinline=True)
def _raise_tangents(upper, lower, own, down, right, per_um, tangent):  # type: ignore[no-untyped-def]
    """Raise the horizons of neighboring pixels by one sample of each, between four neighbors."""
    for c in range(own.size):
        above = upper[c] + right * (upper[c + 1] - upper[c])
        below = lower[c] + right * (lower[c + 1] - lower[c])
        there = above + down * (below - above)
        tangent[c] = max(tangent[c], (there - own[c]) * per_um)


@njit(fastmath=FINITE_MATH, error_model="numpy", forceinline=True)
def _convert_to_elevations(tangent):  # type: ignore[no-untyped-def]
    """Replace tangents >= 0 by elevations, within 4e-11 rad, in whole vectors."""
    for c in range(tangent.size):
        x = tangent[c]
        x = x / (1.0 + math.sqrt(1.0 + x * x))
        x = x / (1.0 + math.sqrt(1.0 + x * x))  # tangent of a fourth of the angle, below 0.42
        q, arc = x * x, -1.0 / 23.0
        for n in (21.0, -19.0, 17.0, -15.0, 13.0, -11.0, 9.0, -7.0, 5.0, -3.0, 1.0):
            arc = 1.0 / n + q * arc
        tangent[c] = 4.0 * x * arc


@njit(cache=True, nogil=True)
def _fill_horizons(relief, row, begin, samples, tangent, horizon):  # type: ignore[no-untyped-def]
    """Find the elevations of the horizons of a row's pixels, rad; 0 is the plane.

    ``relief`` has a margin that repeats its edge, so that a sample has the same neighbors and
    weights at each pixel.
    """
    shift, weight, margin = samples
    count = horizon.shape[0]
    left = begin + margin
    own = relief[row + margin, left : left + count]
    for k in range(HORIZON_DIRECTIONS):
        line = tangent[k, :count]
        line[:] = 0.0
        for s in range(shift.shape[2]):
            i, j = row + margin + shift[0, k, s], left + shift[1, k, s]
            upper, lower = relief[i, j : j + count + 1], relief[i + 1, j : j + count + 1]
            _raise_tangents(
                upper, lower, own, weight[0, k, s], weight[1, k, s], weight[2, k, s], line
            )
        _convert_to_elevations(line)
        for c in range(count):
            horizon[c, k] = line[c]


@njit(parallel=True, cache=True)
def _solve(relief, places, samples, lights, alpha):  # type: ignore[no-untyped-def]
    """Find the disc positions whose visible lights give what all lights give of `places`."""
    height, width = places.shape[:2]
    out = places.copy()
    for row in prange(height):
        tangent = np.empty((HORIZON_DIRECTIONS, BLOCK_COLUMNS))
        horizons = np.empty((BLOCK_COLUMNS, HORIZON_DIRECTIONS))
        for begin in range(0, width, BLOCK_COLUMNS):
            end = min(begin + BLOCK_COLUMNS, width)
            _fill_horizons(relief, row, begin, samples, tangent, horizons[: end - begin])
            for column in range(begin, end):
                horizon = horizons[column - begin]
                if horizon.max() == 0.0:
                    continue
                u, v = places[row, column, 0], places[row, column, 1]
                wanted_u, wanted_v = _observed(u, v, lights, horizon, alpha, False)
                for _ in range(SOLVER_STEPS):
                    now_u, now_v = _observed(u, v, lights, horizon, alpha, True)
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
