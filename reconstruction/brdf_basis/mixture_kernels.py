"""Evaluate mixtures of a tabulated basis at many samples of many points (Numba).

`reconstruction.brdf_basis.evaluate` is the plain counterpart; tests compare both.
"""

import math

import numpy as np
from numba import njit, prange

from reconstruction.arrays import Float32Array, Float64Array

_HALF_PI = 0.5 * math.pi


def evaluate_mixtures(
    table: Float32Array,
    weights: Float64Array,
    light_dir: Float32Array,
    view_dir: Float32Array,
    normals: Float64Array,
) -> Float32Array:
    """Return each point's mixture for each of its samples.

    Parameters
    ----------
    table : ndarray of float32, shape (N_d, N_phi, N_h, L)
        Of a `brdf_tables.BrdfBasis`; L >= K.
    weights : ndarray, shape (P, K)
        Weights of the basis.
    light_dir, view_dir : ndarray, shape (P, M, 3)
        Unit vectors away from the surface.
    normals : ndarray, shape (P, 3)
        Unit vectors in the same frame.

    Returns
    -------
    ndarray of float32, shape (P, M)
        f_r, 1/sr; 0 where light or view are below the horizon.
    """
    out = np.zeros(light_dir.shape[:2], np.float32)
    _mixtures(
        table,
        np.ascontiguousarray(weights, np.float64),
        np.ascontiguousarray(light_dir, np.float32),
        np.ascontiguousarray(view_dir, np.float32),
        np.ascontiguousarray(normals, np.float64),
        out,
    )
    return out


@njit(parallel=True, cache=True)
def _mixtures(table, weights, light, view, normals, out):  # type: ignore[no-untyped-def]
    last_d, last_phi, last_h = table.shape[0] - 1, table.shape[1] - 1, table.shape[2] - 1
    for p in prange(out.shape[0]):
        n0, n1, n2 = normals[p, 0], normals[p, 1], normals[p, 2]
        for m in range(out.shape[1]):
            l0, l1, l2 = float(light[p, m, 0]), float(light[p, m, 1]), float(light[p, m, 2])
            v0, v1, v2 = float(view[p, m, 0]), float(view[p, m, 1]), float(view[p, m, 2])
            mu_l = l0 * n0 + l1 * n1 + l2 * n2
            mu_v = v0 * n0 + v1 * n1 + v2 * n2
            if not (mu_l > 0.0 and mu_v > 0.0):
                continue
            between = l0 * v0 + l1 * v1 + l2 * v2
            cos_d = math.sqrt(min(max(0.5 * (1.0 + between), 0.0), 1.0))
            sin_d = math.sqrt(min(max(0.5 * (1.0 - between), 0.0), 1.0))
            cos_h = min((mu_l + mu_v) / max(2.0 * cos_d, 1e-9), 1.0)
            sin_h = math.sqrt(1.0 - cos_h * cos_h)
            cos_phi = min(abs(mu_v - mu_l) / max(2.0 * sin_d * sin_h, 1e-9), 1.0)
            d = math.atan2(sin_d, cos_d) / _HALF_PI * last_d
            h = math.sqrt(math.acos(cos_h) / _HALF_PI) * last_h
            phi = int(math.acos(cos_phi) / _HALF_PI * last_phi + 0.5)
            i_d, i_h = min(int(d), last_d - 1), min(int(h), last_h - 1)
            a, b = d - i_d, h - i_h
            total = 0.0
            for k in range(weights.shape[1]):
                near = (1.0 - b) * table[i_d, phi, i_h, k] + b * table[i_d, phi, i_h + 1, k]
                far = (1.0 - b) * table[i_d + 1, phi, i_h, k] + b * table[i_d + 1, phi, i_h + 1, k]
                total += weights[p, k] * ((1.0 - a) * near + a * far)
            out[p, m] = total
