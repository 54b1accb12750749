"""Add wrinkle maps to a base map, compiled (see `model.wrinkles`).

Textures are resampled to the base's columns beforehand, so that the inner loop only blends two rows
of each, without look-ups. Kernels are parallel over rows and called from one thread.
"""

# mypy: allow-untyped-defs

from collections.abc import Iterator
from contextlib import contextmanager
from math import sqrt

import numba
import numpy as np
from numba import njit, prange

MIN_PARALLEL_PIXELS = 500_000
"""Pixels below which one thread is faster than several."""


@contextmanager
def choose_thread_count(pixels: int) -> Iterator[None]:
    """Return the number of threads: one for few pixels."""
    before = numba.get_num_threads()
    if pixels < MIN_PARALLEL_PIXELS:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@njit(cache=True, parallel=True, error_model="numpy")
def add(total, wx, wy, w_rows, w_part, a, a_rows, a_part):
    """Add a wrinkle map times its strength to derivatives in place.

    Parameters
    ----------
    total : (H, W, 2) real
        Derivatives; changed.
    wx, wy : (h, W) real
        Wrinkle derivatives, widened to W columns.
    w_rows, w_part : (H,) int64 and real
        Upper texel row of each row, and the weight of the row below it.
    a, a_rows, a_part
        Likewise for the zones' summed strength.
    """
    rows, columns = total.shape[0], total.shape[1]
    for y in prange(rows):
        w0, a0 = w_rows[y], a_rows[y]
        w1, a1 = min(w0 + 1, wx.shape[0] - 1), min(a0 + 1, a.shape[0] - 1)
        f, g = w_part[y], a_part[y]
        for x in range(columns):
            s = a[a0, x] + g * (a[a1, x] - a[a0, x])
            total[y, x, 0] += s * (wx[w0, x] + f * (wx[w1, x] - wx[w0, x]))
            total[y, x, 1] += s * (wy[w0, x] + f * (wy[w1, x] - wy[w0, x]))


@njit(cache=True, parallel=True, error_model="numpy")
def add_and_normalize(base, wx, wy, w_rows, w_part, a, a_rows, a_part, normals):
    """Write unit normals of the base's derivatives plus a wrinkle map times its strength.

    Parameters as of :func:`add`; `normals` (H, W, 3) is written, 0 where a derivative is not
    finite.
    """
    rows, columns = base.shape[0], base.shape[1]
    one = np.ones(1, base.dtype)[0]
    zero = one - one
    for y in prange(rows):
        w0, a0 = w_rows[y], a_rows[y]
        w1, a1 = min(w0 + 1, wx.shape[0] - 1), min(a0 + 1, a.shape[0] - 1)
        f, g = w_part[y], a_part[y]
        for x in range(columns):
            s = a[a0, x] + g * (a[a1, x] - a[a0, x])
            p = base[y, x, 0] + s * (wx[w0, x] + f * (wx[w1, x] - wx[w0, x]))
            q = base[y, x, 1] + s * (wy[w0, x] + f * (wy[w1, x] - wy[w0, x]))
            z = one / sqrt(p * p + q * q + one)
            good = z > zero  # False for NaN and infinity
            normals[y, x, 0] = p * z if good else zero
            normals[y, x, 1] = q * z if good else zero
            normals[y, x, 2] = z if good else zero


@njit(cache=True, parallel=True, error_model="numpy")
def add_difference(base, dx, dy, dz, d_rows, d_part, a, a_rows, a_part, renormalize, normals):
    """Write normals of a base (H, W, 3) plus a difference of normals times its strength.

    Parameters as of :func:`add`, with three planes of the difference; `renormalize` is 0 or 1.
    """
    rows, columns = base.shape[0], base.shape[1]
    one = np.ones(1, base.dtype)[0]
    zero = one - one
    for y in prange(rows):
        d0, a0 = d_rows[y], a_rows[y]
        d1, a1 = min(d0 + 1, dx.shape[0] - 1), min(a0 + 1, a.shape[0] - 1)
        f, g = d_part[y], a_part[y]
        for x in range(columns):
            s = a[a0, x] + g * (a[a1, x] - a[a0, x])
            p = base[y, x, 0] + s * (dx[d0, x] + f * (dx[d1, x] - dx[d0, x]))
            q = base[y, x, 1] + s * (dy[d0, x] + f * (dy[d1, x] - dy[d0, x]))
            r = base[y, x, 2] + s * (dz[d0, x] + f * (dz[d1, x] - dz[d0, x]))
            length = p * p + q * q + r * r
            good = length > zero
            scale = one / sqrt(length) if renormalize and good else one
            normals[y, x, 0] = p * scale if good else zero
            normals[y, x, 1] = q * scale if good else zero
            normals[y, x, 2] = r * scale if good else zero
