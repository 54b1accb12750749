"""Fill rows of a point's matrix: reflection of each basis BRDF for each sample (Numba)."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import float32, float64, int64, njit, uint64

NODES_D, NODES_PHI, NODES_H = 32, 12, 90  # of model.brdf.tables; its tests hold them equal
_HALF_PI = 0.5 * math.pi
FAST_MATH = {"contract", "reassoc", "nsz"}


@njit(inline="always")
def _angle(c):  # type: ignore[no-untyped-def]
    """Return acos(c) / (pi/2) for c in [0, 1] within 2e-8 rad (Abramowitz and Stegun 4.4.46)."""
    p = -0.0012624911
    p = p * c + 0.0066700901
    p = p * c - 0.0170881256
    p = p * c + 0.0308918810
    p = p * c - 0.0501743046
    p = p * c + 0.0889789874
    p = p * c - 0.2145988016
    p = p * c + 1.5707963050
    return math.sqrt(max(1.0 - c, 0.0)) * p / _HALF_PI


@njit(fastmath={"contract", "reassoc", "nsz", "arcp", "nnan"}, forceinline=True)
def find_nodes(light, view, normal, picked, count, cos_l, node_position):  # type: ignore[no-untyped-def]
    """Fill the cosine of the light and the position on the table's axes of the picked samples."""
    n0, n1, n2 = float64(normal[0]), float64(normal[1]), float64(normal[2])
    on_d, on_phi, on_h = node_position[0], node_position[1], node_position[2]
    for j in range(count):
        i = picked[j]
        l0, l1, l2 = float64(light[i, 0]), float64(light[i, 1]), float64(light[i, 2])
        v0, v1, v2 = float64(view[i, 0]), float64(view[i, 1]), float64(view[i, 2])
        cos_l[j] = l0 * n0 + l1 * n1 + l2 * n2
        on_d[j] = l0 * v0 + l1 * v1 + l2 * v2
        on_phi[j] = v0 * n0 + v1 * n1 + v2 * n2
    for j in range(count):  # apart from the first loop, this one runs in whole vectors
        mu_l, mu_v = cos_l[j], on_phi[j]
        between = max(min(on_d[j], 1.0), -1.0)
        cos_d = math.sqrt(0.5 * (1.0 + between))
        sin_d = math.sqrt(0.5 * (1.0 - between))
        cos_h = max(min((mu_l + mu_v) / max(2.0 * cos_d, 1e-9), 1.0), 0.0)
        sin_h = math.sqrt(1.0 - cos_h * cos_h)
        cos_phi = min(abs(mu_v - mu_l) / max(2.0 * sin_d * sin_h, 1e-9), 1.0)
        on_d[j] = _angle(min(cos_d, 1.0)) * (NODES_D - 1)
        on_phi[j] = _angle(cos_phi) * (NODES_PHI - 1)
        on_h[j] = math.sqrt(_angle(cos_h)) * (NODES_H - 1)


def _row_filler(fixed: int) -> Callable[..., Any]:
    """Return the kernel that fills a matrix; one of fixed width is unrolled to vectors."""

    @njit(fastmath=FAST_MATH, forceinline=True)
    def fill(flat, cos_l, place, weight, count, rows, square):  # type: ignore[no-untyped-def]
        """Fill the matrix and the weighted squares of its columns."""
        lanes = uint64(fixed) if fixed > 0 else uint64(rows.shape[1])
        out = rows.reshape(-1)
        block = np.zeros(rows.shape[1], dtype=np.float32)
        square[:] = 0.0
        for i in range(count):
            d, h = place[0, i], place[2, i]
            i_d = min(int64(d), NODES_D - 2)
            i_phi = int64(place[1, i] + 0.5)
            i_h = min(int64(h), NODES_H - 2)
            d, h = d - i_d, h - i_h
            # Unsigned offsets into a flat table: no test for negative ones keeps the loop whole.
            a = uint64((i_d * NODES_PHI + i_phi) * NODES_H + i_h) * lanes
            b = a + uint64(NODES_H * NODES_PHI) * lanes
            w_a = float32(cos_l[i] * (1.0 - d) * (1.0 - h))
            w_b = float32(cos_l[i] * (1.0 - d) * h)
            w_e = float32(cos_l[i] * d * (1.0 - h))
            w_f = float32(cos_l[i] * d * h)
            w = weight[i]
            o = uint64(i) * lanes
            for k in range(lanes):
                element = (w_a * flat[a + k] + w_b * flat[a + lanes + k]) + (
                    w_e * flat[b + k] + w_f * flat[b + lanes + k]
                )
                out[o + k] = element
                block[k] += (w * element) * element
            if i % 64 == 63 or i == count - 1:
                for k in range(lanes):
                    square[k] += block[k]
                    block[k] = float32(0.0)

    return fill


fill_64 = _row_filler(64)
fill_16 = _row_filler(16)
fill_any = _row_filler(0)


@njit(fastmath=FAST_MATH, forceinline=True)
def multiply_transpose(rows, force, count, total):  # type: ignore[no-untyped-def]
    """Fill the matrix' transpose times ``force``, in blocks of float32 summed in float64."""
    lanes = rows.shape[1]
    block = np.empty(lanes, dtype=np.float32)
    total[:] = 0.0
    for begin in range(0, count, 64):
        block[:] = float32(0.0)
        i = begin
        while i + 4 <= min(begin + 64, count):
            f0, f1, f2, f3 = force[i], force[i + 1], force[i + 2], force[i + 3]
            r0, r1, r2, r3 = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
            for k in range(lanes):
                block[k] += (f0 * r0[k] + f1 * r1[k]) + (f2 * r2[k] + f3 * r3[k])
            i += 4
        while i < min(begin + 64, count):
            f0, r0 = force[i], rows[i]
            for k in range(lanes):
                block[k] += f0 * r0[k]
            i += 1
        for k in range(lanes):
            total[k] += block[k]


@njit(fastmath=FAST_MATH, forceinline=True)
def weighted_column_norms(rows, weight, count, total):  # type: ignore[no-untyped-def]
    """Fill the weighted square of each column."""
    lanes = rows.shape[1]
    block = np.empty(lanes, dtype=np.float32)
    total[:] = 0.0
    for begin in range(0, count, 64):
        block[:] = float32(0.0)
        for i in range(begin, min(begin + 64, count)):
            w, row = weight[i], rows[i]
            for k in range(lanes):
                block[k] += (w * row[k]) * row[k]
        for k in range(lanes):
            total[k] += block[k]


@njit(fastmath=FAST_MATH, forceinline=True)
def dot(a, b, count):  # type: ignore[no-untyped-def]
    """Return the inner product of the first `count` elements."""
    total = float32(0.0)
    for i in range(count):
        total += a[i] * b[i]
    return float64(total)


@njit(fastmath=FAST_MATH, forceinline=True)
def gather_column(rows, root, material, count, column):  # type: ignore[no-untyped-def]
    """Copy a column of the matrix, times the roots of the weights."""
    for i in range(count):
        column[i] = root[i] * rows[i, material]
