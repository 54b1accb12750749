"""Kernels of `rigsim.light.relief_shadow.hidden_sky_fraction`: sums over one sector of the sky."""

import math
from typing import Final

import numpy as np
from numba import njit, prange

from rigsim.tissue.skin_layers import ETA

ELEVATION_NODES: Final = 6
"""Number of elevations for the quadrature with two boundaries: three pairs about the middle."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(ELEVATION_NODES)
_NODE_1, _NODE_2, _NODE_3 = map(float, _NODES[3:])
_WEIGHT_1, _WEIGHT_2, _WEIGHT_3 = map(float, _WEIGHTS[3:])

_VECTOR_MATH: Final = {"contract", "nnan", "ninf", "nsz"}


@njit(parallel=True, cache=True)
def add_sector(out, normals, tangent, angle, share):  # type: ignore[no-untyped-def]
    """Add one sector's hidden fraction; ``share`` is its width over pi."""
    right, up = math.cos(angle), math.sin(angle)
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            along = normals[i, j, 0] * right + normals[i, j, 1] * up
            upward = normals[i, j, 2]
            low = math.atan2(-along, upward)
            high = math.atan(tangent[i, j])
            if high <= low:
                continue
            ends = (high - low) / 2.0 + (math.sin(2.0 * high) - math.sin(2.0 * low)) / 4.0
            rise = (math.sin(high) ** 2 - math.sin(low) ** 2) / 2.0
            out[i, j] += share * (along * ends + upward * rise)


@njit(inline="always")
def _squared_transmittance(cosine):  # type: ignore[no-untyped-def]
    """Return the square of `transmittance`, with one division instead of three."""
    c = min(cosine, 1.0)
    inside = math.sqrt(1.0 - (1.0 - c * c) * (1.0 / (ETA * ETA)))
    s_minus, s_plus = c - ETA * inside, c + ETA * inside
    p_minus, p_plus = ETA * c - inside, ETA * c + inside
    s, p, whole = s_minus * p_plus, p_minus * s_plus, s_plus * p_plus
    passed = 1.0 - 0.5 * (s * s + p * p) / (whole * whole)
    return passed * passed


@njit(inline="always")
def _sin_cos(x):  # type: ignore[no-untyped-def]
    """Return sine and cosine of 0 to pi / 2 within 1e-11, by their series.

    Unlike those of the C library they are computed for whole vectors.
    """
    q = x * x
    sine = -1.0 / 1307674368000.0
    for n in (6227020800.0, -39916800.0, 362880.0, -5040.0, 120.0, -6.0):
        sine = 1.0 / n + q * sine
    cosine = 1.0 / 20922789888000.0
    for n in (-87178291200.0, 479001600.0, -3628800.0, 40320.0, -720.0, 24.0, -2.0):
        cosine = 1.0 / n + q * cosine
    return x * (1.0 + q * sine), 1.0 + q * cosine


@njit(inline="always")
def _pair_of_nodes(x, angles, reach):  # type: ignore[no-untyped-def]
    """Return the sum of the integrand at ``x`` above and below the middle elevation.

    ``angles``: sine and cosine of the half angle, and of the middle elevation. The cosine to the
    normal is the reach times the sine of the angle above the tangent plane.
    """
    sin_half, cos_half, sin_middle, cos_middle = angles
    s, c = _sin_cos(x)
    upper = reach * (sin_half * c + cos_half * s)
    lower = max(reach * (sin_half * c - cos_half * s), 0.0)
    total = upper * (cos_middle * c - sin_middle * s) * _squared_transmittance(upper)
    return total + lower * (cos_middle * c + sin_middle * s) * _squared_transmittance(lower)


@njit(fastmath=_VECTOR_MATH, error_model="numpy", forceinline=True)
def _add_row_through(out, nx, ny, nz, tangent, right, up, share):  # type: ignore[no-untyped-def]
    for j in range(out.size):
        along, upward = nx[j] * right + ny[j] * up, np.float64(nz[j])
        # above 0, so that a normal across the sector, or one of length 0, adds 0 and not NaN
        reach = max(math.sqrt(along * along + upward * upward), 1e-30)
        sin_low, cos_low = -along / reach, upward / reach
        t = np.float64(tangent[j])
        cos_high = 1.0 / math.sqrt(1.0 + t * t)
        sin_high = t * cos_high
        # half the angle between tangent plane and horizon; 0 below the plane
        cos_width = cos_high * cos_low + sin_high * sin_low
        cos_half = math.sqrt(max(0.5 * (1.0 + cos_width), 1e-30))
        sin_half = max(0.5 * (sin_high * cos_low - cos_high * sin_low) / cos_half, 0.0)
        x = sin_half / (1.0 + cos_half)
        x = x / (1.0 + math.sqrt(1.0 + x * x))  # tangent of a fourth of it, below 0.42
        q, arc = x * x, -1.0 / 23.0
        for n in (21.0, -19.0, 17.0, -15.0, 13.0, -11.0, 9.0, -7.0, 5.0, -3.0, 1.0):
            arc = 1.0 / n + q * arc
        half = 4.0 * x * arc
        sin_middle = sin_low * cos_half + cos_low * sin_half
        cos_middle = cos_low * cos_half - sin_low * sin_half
        angles = (sin_half, cos_half, sin_middle, cos_middle)
        total = _WEIGHT_1 * _pair_of_nodes(half * _NODE_1, angles, reach)
        total += _WEIGHT_2 * _pair_of_nodes(half * _NODE_2, angles, reach)
        total += _WEIGHT_3 * _pair_of_nodes(half * _NODE_3, angles, reach)
        out[j] += share * half * total


@njit(parallel=True, cache=True)
def add_sector_through(out, normals, tangent, angle, share):  # type: ignore[no-untyped-def]
    """Add one sector's hidden fraction with the transmittance of two boundaries.

    ``normals`` (3, H, W) are planes: rows of single numbers are computed in whole vectors. Their z
    is at least 0: the sky below a wall that faces down is not between tangent plane and horizon.
    """
    right, up = math.cos(angle), math.sin(angle)
    for i in prange(out.shape[0]):
        n = normals[0, i], normals[1, i], normals[2, i]
        _add_row_through(out[i], n[0], n[1], n[2], tangent[i], right, up, share)
