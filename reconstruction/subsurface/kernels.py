"""Evaluate radial profiles of the forward models, and find starts of fits on a grid (Numba).

Parameters of a profile are log sigma_a, log sigma_s', log of a common factor, and the asymmetry g.
Models are the dipole and Kienle and Patterson's diffusion, which differ in constants only, and a
table of log reflectance per fiber.

References
----------
Jensen et al. 2001, doi:10.1145/383259.383319. Kienle and Patterson 1997,
doi:10.1364/JOSAA.14.000246.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from reconstruction.arrays import Float64Array

N_PARAMETERS = 4
TABLE_MODEL = 1
"""The model is a table; anything else is a closed form."""
_FAST_MATH = {"contract", "nsz"}
_FOUR_PI = 4.0 * math.pi


class ForwardModel(NamedTuple):
    """Forward model at fixed radii, as arrays for the kernels."""

    kind: int
    """`TABLE_MODEL` or a closed form."""
    radius_mm: Float64Array
    """(F,)"""
    constants: Float64Array
    """(4,) of the closed form."""
    axes: Float64Array
    """(3, 2) of the table: first node and spacing of each axis."""
    grid: Float64Array
    """(S, U, G, F) of the table."""


@njit(inline="always")
def decay(x):  # type: ignore[no-untyped-def]
    """Return exp(-x) for x >= 0 within 2e-13 up to x = 100: (exp(-x/1024))^1024, no table.

    The polynomial is the Taylor series of exp(t) to t^9 by Horner's rule, squared ten times.
    """
    t = -min(x, 660.0) * (1.0 / 1024.0)
    p = 1.0 + t * (1.0 / 9.0)
    p = 1.0 + t * 0.125 * p
    p = 1.0 + t * (1.0 / 7.0) * p
    p = 1.0 + t * (1.0 / 6.0) * p
    p = 1.0 + t * 0.2 * p
    p = 1.0 + t * 0.25 * p
    p = 1.0 + t * (1.0 / 3.0) * p
    p = 1.0 + t * 0.5 * p
    p = 1.0 + t * p
    for _ in range(10):
        p = p * p
    return p


@njit(fastmath=_FAST_MATH, error_model="numpy")
def _closed(theta, radius, constants, m, jac):  # type: ignore[no-untyped-def]
    """Fill reflectance and its derivatives by log sigma_a and log sigma_s'.

    With P = exp(-kd)/d and T = -dP/dz of the source at depth z and its image,
    R = albedo^n (3 t c_phi (P - P') + c_j (T + T')) / (4 pi); constants = b, c_phi, c_j, n.
    """
    a, s = math.exp(theta[0]), math.exp(theta[1])
    t = a + s
    k = math.sqrt(3.0 * a * t)
    stretch, c_phi, c_j, power = constants[0], constants[1], constants[2], constants[3]
    z0 = 1.0 / t
    z1 = stretch / t
    factor = math.exp(theta[2]) / _FOUR_PI * (s / t) ** power
    # k = sqrt(3 a t), t = a + s: derivatives of k and of log t by log a and by log s
    k_a, k_s = k * (a + t) / (2.0 * t), k * s / (2.0 * t)
    t_a, t_s = a / t, s / t
    lean = power * a / t  # n d(log albedo)/d(log s) = -n d(log albedo)/d(log a), albedo = s / t
    phi = 3.0 * t * c_phi
    for f in range(radius.size):
        r2 = radius[f] * radius[f]
        i0 = 1.0 / math.sqrt(r2 + z0 * z0)
        i1 = 1.0 / math.sqrt(r2 + z1 * z1)
        d0, d1 = (r2 + z0 * z0) * i0, (r2 + z1 * z1) * i1
        e0, e1 = decay(k * d0), decay(k * d1)
        u0, u1 = 1.0 + k * d0, 1.0 + k * d1
        q0, q1 = e0 * i0 * i0 * i0, e1 * i1 * i1 * i1
        T0, T1 = z0 * u0 * q0, z1 * u1 * q1
        P = e0 * i0 - e1 * i1
        value = phi * P + c_j * (T0 + T1)
        by_k = -phi * (e0 - e1) - c_j * k * (z0 * e0 * i0 + z1 * e1 * i1)
        # both depths are proportional to 1 / t: one derivative by log z serves for -d/d(log t)
        by_z = -phi * (z0 * T0 - z1 * T1) + c_j * (
            z0 * q0 * (u0 - z0 * z0 * (k * k + 3.0 * u0 * i0 * i0))
            + z1 * q1 * (u1 - z1 * z1 * (k * k + 3.0 * u1 * i1 * i1))
        )
        by_t = phi * P - by_z
        m[f] = factor * value
        jac[0, f] = factor * (by_k * k_a + by_t * t_a - lean * value)
        jac[1, f] = factor * (by_k * k_s + by_t * t_s + lean * value)


@njit(inline="always")
def _cubic(x, count, w, d):  # type: ignore[no-untyped-def]
    """Fill Lagrange's weights on four of `count` nodes 0, 1, ... around x; their derivatives."""
    i = min(max(math.floor(x) - 1, 0), count - 4)
    u = x - i
    w[0] = -(u - 1.0) * (u - 2.0) * (u - 3.0) / 6.0
    w[1] = u * (u - 2.0) * (u - 3.0) / 2.0
    w[2] = -u * (u - 1.0) * (u - 3.0) / 2.0
    w[3] = u * (u - 1.0) * (u - 2.0) / 6.0
    d[0] = -(3.0 * u * u - 12.0 * u + 11.0) / 6.0
    d[1] = (3.0 * u * u - 10.0 * u + 6.0) / 2.0
    d[2] = -(3.0 * u * u - 8.0 * u + 3.0) / 2.0
    d[3] = (3.0 * u * u - 6.0 * u + 2.0) / 6.0
    return i


@njit(fastmath=_FAST_MATH, error_model="numpy")
def _tabled(theta, radius, axes, grid, w, m, jac):  # type: ignore[no-untyped-def]
    """Fill reflectance and derivatives by all parameters from a grid (sigma_s', root, g, fiber).

    The grid is of log R + sigma_tr r. The second axis is log(1 + 10 sqrt(sigma_a/sigma_s')); axes =
    first node and spacing of each.
    """
    n_s, n_u, n_g, fibers = grid.shape
    root = 10.0 * math.exp(0.5 * (theta[0] - theta[1]))
    slope = 0.5 * root / (1.0 + root) / axes[1, 1]
    x = (theta[1] - axes[0, 0]) / axes[0, 1]
    y = (math.log1p(root) - axes[1, 0]) / axes[1, 1]
    i = _cubic(x, n_s, w[0], w[1])
    j = _cubic(y, n_u, w[2], w[3])
    h = 0
    if n_g > 1:
        h = _cubic((theta[3] - axes[2, 0]) / axes[2, 1], n_g, w[4], w[5])
    else:
        w[4, :] = 0.0
        w[5, :] = 0.0
        w[4, 0] = 1.0
    m[:] = 0.0
    jac[:] = 0.0
    depth = min(4, n_g)
    for p in range(4):
        for q in range(4):
            both = w[0, p] * w[2, q]
            by_s, by_u = w[1, p] * w[2, q], w[0, p] * w[3, q]
            for o in range(depth):
                row = grid[i + p, j + q, h + o]
                v, g_s, g_u, g_g = both * w[4, o], by_s * w[4, o], by_u * w[4, o], both * w[5, o]
                for f in range(fibers):
                    m[f] += v * row[f]
                    jac[0, f] += g_u * row[f]
                    jac[1, f] += g_s * row[f]
                    jac[3, f] += g_g * row[f]
    a, s = math.exp(theta[0]), math.exp(theta[1])
    t = a + s
    k = math.sqrt(3.0 * a * t)
    k_a, k_s = k * (a + t) / (2.0 * t), k * s / (2.0 * t)
    for f in range(fibers):
        value = math.exp(max(m[f] + theta[2] - k * radius[f], -660.0))
        by_a = jac[0, f] * slope
        m[f] = value
        jac[0, f] = value * (by_a - k_a * radius[f])
        jac[1, f] = value * (jac[1, f] / axes[0, 1] - by_a - k_s * radius[f])
        jac[3, f] = value * jac[3, f] / axes[2, 1]


@njit(error_model="numpy")
def evaluate_one(curves, theta, w, m, jac):  # type: ignore[no-untyped-def]
    """Fill one profile and its derivatives by all parameters."""
    if curves.kind == TABLE_MODEL:
        _tabled(theta, curves.radius_mm, curves.axes, curves.grid, w, m, jac)
    else:
        _closed(theta, curves.radius_mm, curves.constants, m, jac)
    jac[2, :] = m


@njit(cache=True, error_model="numpy")
def find_valleys(score: Any, valley: Any, position: Any, depth: Any) -> None:
    """Find the deepest two valleys of a misfit along its first axis.

    Parameters
    ----------
    score : (N, S, K) float32
        Infinite outside the model's domain.
    valley : (2, N) int64
        Index on the first axis, the deepest valley first.
    position, depth : (2, N) float64
        Index on the second axis of the least misfit there, and that misfit, from the parabola
        through three nodes; the depth is infinite without a second valley.
    """
    profiles, n_s, n_k = score.shape
    at, low = np.empty(n_s), np.empty(n_s + 2)
    for n in range(profiles):
        low[:] = np.inf
        for i in range(n_s):
            row = score[n, i]
            k = 0
            for j in range(1, n_k):
                if row[j] < row[k]:
                    k = j
            at[i], low[i + 1] = k, row[k]
            # vertex of the parabola through three nodes: -lean / (2 bend), lower by lean^2/(8 bend)
            if 0 < k < n_k - 1 and row[k - 1] < np.inf and row[k + 1] < np.inf:
                lean = float(row[k + 1]) - row[k - 1]
                bend = float(row[k + 1]) + row[k - 1] - 2.0 * row[k]
                if bend > 0.0:
                    at[i] -= 0.5 * lean / bend
                    low[i + 1] -= 0.125 * lean * lean / bend
        for v in range(2):
            valley[v, n], position[v, n], depth[v, n] = 0, 0.0, np.inf
        for i in range(n_s):
            here = low[i + 1]
            if here < np.inf and here <= low[i] and here <= low[i + 2]:
                v = 0 if here < depth[0, n] else 1
                if v == 0:
                    valley[1, n], position[1, n], depth[1, n] = (
                        valley[0, n],
                        position[0, n],
                        depth[0, n],
                    )
                elif here >= depth[1, n]:
                    continue
                valley[v, n], position[v, n], depth[v, n] = i, at[i], here


@njit(cache=True, error_model="numpy")
def evaluate(curves: Any, theta: Any, out: Any, slopes: Any) -> None:
    """Fill profiles (N, F) of parameters (N, 4) and their derivatives (N, 4, F)."""
    w = np.zeros((6, 4))
    for n in range(theta.shape[0]):
        evaluate_one(curves, theta[n], w, out[n], slopes[n])
