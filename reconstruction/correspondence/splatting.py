"""Texels at scattered places of a map: added to the pixels around them, covered by others."""

import math
from typing import Final

import numpy as np
from scipy.ndimage import binary_closing, maximum_filter

from reconstruction.arrays import BoolArray, Float64Array

SHADOW_DEPTH_MM: Final = 10.0
"""Texels this far under the outermost at their place lie in its shadow (under ear or chin)."""


def splat(at: Float64Array, values: Float64Array, size: int) -> tuple[Float64Array, Float64Array]:
    """Add values to the four pixels around each place; return sums (N, N, C) and weights."""
    total = np.zeros((size * size, values.shape[1]))
    weight = np.zeros(size * size)
    low = np.floor(at).astype(np.int64)
    part = at - low
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            x, y = low[:, 0] + dx, low[:, 1] + dy
            use = (x >= 0) & (x < size) & (y >= 0) & (y < size) & (share > 1e-6)
            index = y[use] * size + x[use]
            weight += np.bincount(index, share[use], minlength=size * size)
            for c, layer in enumerate(values[use].T):
                total[:, c] += np.bincount(index, share[use] * layer, minlength=size * size)
    return total.reshape(size, size, -1), weight.reshape(size, size)


def closed(known: BoolArray) -> BoolArray:
    """Close gaps of up to two pixels, as between texels that lie wider than the map's pixels."""
    padded = np.pad(known, 3, mode="edge")
    closed = binary_closing(padded, structure=np.ones((3, 3)), iterations=2)
    return np.asarray(closed[3:-3, 3:-3] | known, np.bool_)


def outermost(
    place: Float64Array, reach: Float64Array, shown: BoolArray, side_mm: float, size: int
) -> BoolArray:
    """Return the texels that lie about as far out as any near their place, on cells of 2 mm.

    Parameters
    ----------
    place
        (H, W, 2): column and row in a map of ``size`` pixels and ``side_mm`` a side.
    reach
        (H, W): how far out texels lie, mm.
    shown
        (H, W): those that there are.
    """
    cells = max(1, math.ceil(side_mm / 2.0))
    at = np.floor((place + 0.5) * (cells / size)).astype(np.int64)
    inside = shown & np.all((at >= 0) & (at < cells), axis=2)
    index = at[..., 1] * cells + at[..., 0]
    highest = np.zeros(cells * cells)
    np.maximum.at(highest, index[inside], reach[inside])
    highest = maximum_filter(highest.reshape(cells, cells), size=3, mode="nearest").ravel()
    out = shown & ~inside
    out[inside] = reach[inside] >= highest[index[inside]] - SHADOW_DEPTH_MM
    return np.asarray(out, np.bool_)
