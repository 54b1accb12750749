"""Inner loops of histograms of normals and of the search for kernels.

Kernels are parallel and called from one thread. None uses fast-math and every sum is of integers,
so that a result depends neither on the number of threads nor on where a sample stands in a block.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from numba import njit, prange

BLOCK = 4096
"""Samples whose slopes stay in the cache while all alphas pass over them."""
MOST_THREADS = 8
"""Each thread holds a histogram of every alpha (5 MB at 301 and 64 x 64)."""


def threads() -> int:
    """Return into how many parts the samples are cut."""
    return min(int(numba.get_num_threads()), MOST_THREADS)


@njit(cache=True, parallel=True, error_model="numpy")
def slopes(height: Any, code: Any, right: Any, down: Any) -> Any:
    """Return dh/dx and dh/dy: central or one-sided differences as `code` says, 0 without.

    Parameters
    ----------
    height : (H, W) real
    code : (H, W) uint8, of `normal_histogram.stencil`
    right, down : float
        Distance to the next column and row along x and y, signed.
    """
    rows, columns = height.shape
    a = np.zeros_like(height)
    b = np.zeros_like(height)
    for y in prange(rows):
        for x in range(columns):
            c = code[y, x]
            if c != 0:
                x0, x1 = x - (c & 1), x + ((c >> 1) & 1)
                y0, y1 = y - ((c >> 2) & 1), y + ((c >> 3) & 1)
                a[y, x] = (height[y, x1] - height[y, x0]) / ((x1 - x0) * right)
                b[y, x] = (height[y1, x] - height[y0, x]) / ((y1 - y0) * down)
    return a, b


@njit(cache=True, parallel=True, error_model="numpy")
def count_slopes(p: Any, q: Any, bins: Any, limit: Any, parts: Any) -> Any:
    """Return the counts of normals (-p, -q, 1) / length, (parts, bins^2 + 1); last: outside."""
    n = p.size
    cells = bins * bins
    counts = np.zeros((parts, cells + 1), np.int64)
    scale = bins / (2.0 * limit)
    for part in prange(parts):
        own = counts[part]
        for i in range(part * n // parts, (part + 1) * n // parts):
            w = 1.0 / math.sqrt(1.0 + p[i] * p[i] + q[i] * q[i])
            u = (limit - p[i] * w) * scale
            v = (limit - q[i] * w) * scale
            if u >= 0.0 and u <= bins and v >= 0.0 and v <= bins:
                own[min(int(v), bins - 1) * bins + min(int(u), bins - 1)] += 1
            else:
                own[cells] += 1
    return counts
