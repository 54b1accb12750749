"""Evaluate mixtures of a tabulated basis at many samples of many points (Numba).

`reconstruction.brdf_basis.evaluate` is the plain counterpart; tests compare both.
"""

import numpy as np
from numba import float64, int64, njit, prange, uint64

from model.checks import Checks
from reconstruction.arrays import Float32Array, Float64Array
from reconstruction.brdf_basis.row_kernels import FAST_MATH, NODES_D, NODES_H, NODES_PHI, find_nodes


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

    Raises
    ------
    ValueError
        Arrays have other shapes: the loops read the table without a test of its limits.
    """
    points, samples = light_dir.shape[:2]
    nodes = (NODES_D, NODES_PHI, NODES_H)
    if table.ndim != 4 or table.shape[:3] != nodes or table.shape[3] < weights.shape[1]:
        raise ValueError(
            f"table: got shape {table.shape}, expected {nodes} and at least {weights.shape[1]} "
            "BRDFs; use a basis of model.brdf.tables"
        )
    checks = Checks(ValueError)
    checks.shape("weights", weights, (points, weights.shape[1]))
    checks.shape("light_dir", light_dir, (points, samples, 3))
    checks.shape("view_dir", view_dir, (points, samples, 3))
    checks.shape("normals", normals, (points, 3))
    out = np.zeros((points, samples), np.float32)
    _mixtures(
        np.ascontiguousarray(table, np.float32),
        np.ascontiguousarray(weights, np.float64),
        np.ascontiguousarray(light_dir, np.float32),
        np.ascontiguousarray(view_dir, np.float32),
        np.ascontiguousarray(normals, np.float64),
        out,
    )
    return out


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _find_lit(light, view, normal, lit):  # type: ignore[no-untyped-def]
    n0, n1, n2 = float64(normal[0]), float64(normal[1]), float64(normal[2])
    for m in range(lit.size):
        mu_l = float64(light[m, 0]) * n0 + float64(light[m, 1]) * n1 + float64(light[m, 2]) * n2
        mu_v = float64(view[m, 0]) * n0 + float64(view[m, 1]) * n1 + float64(view[m, 2]) * n2
        lit[m] = (mu_l > 0.0) & (mu_v > 0.0)


@njit(parallel=True, cache=True)
def _mixtures(table, weights, light, view, normals, out):  # type: ignore[no-untyped-def]
    lanes = uint64(table.shape[3])
    flat = table.reshape(-1)
    samples = out.shape[1]
    for p in prange(out.shape[0]):
        every, lit = np.arange(samples), np.empty(samples, np.bool_)
        cos_l, place = np.empty(samples), np.empty((3, samples))
        _find_lit(light[p], view[p], normals[p], lit)
        find_nodes(light[p], view[p], normals[p], every, samples, cos_l, place)
        share = weights[p]
        for m in range(samples):
            if not lit[m]:
                continue
            d, h = place[0, m], place[2, m]
            i_d, i_h = min(int64(d), NODES_D - 2), min(int64(h), NODES_H - 2)
            i_phi = int64(place[1, m] + 0.5)
            d, h = d - i_d, h - i_h
            # unsigned offsets into a flat table, without a test for negative ones
            a = uint64((i_d * NODES_PHI + i_phi) * NODES_H + i_h) * lanes
            b = a + uint64(NODES_H * NODES_PHI) * lanes
            w_a, w_b = (1.0 - d) * (1.0 - h), (1.0 - d) * h
            w_e, w_f = d * (1.0 - h), d * h
            total = 0.0
            for lane in range(share.size):
                k = uint64(lane)
                near = w_a * flat[a + k] + w_b * flat[a + lanes + k]
                total += share[lane] * (near + w_e * flat[b + k] + w_f * flat[b + lanes + k])
            out[p, m] = total
