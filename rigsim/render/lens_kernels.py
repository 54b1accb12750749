"""Kernels of `rigsim.render.depth_of_field`: layers of depth, and sums of samples by pixel."""

from typing import Final

import numpy as np
from numba import njit, prange

DEPTH_GAP_BINS: Final = 64
"""Number of depth bins in the search for a gap."""

MOSAIC_LIGHTS: Final = 8
"""Lights whose samples `gather_mosaics` sums at once: a pixel's weights serve them all.
`gather_mosaic` sums those of one."""


@njit(parallel=True, cache=True)
def find_layers(  # type: ignore[no-untyped-def]
    lookup, first, slot, slices, toward, table, radius, gap, cut, far
):
    """Find each pixel's far depths and the factors of the weights of both layers."""
    height, width = lookup.shape
    wide = 2 * radius + 1
    per_pixel = table.shape[2]
    for y in prange(height):
        depth = np.empty(wide * wide * per_pixel, np.float32)
        share = np.empty(wide * wide * per_pixel, np.float32)
        filled = np.empty(DEPTH_GAP_BINS, np.uint8)
        for x in range(width):
            count, missing = 0, np.float32(0.0)
            total, inside = np.float32(0.0), np.float32(0.0)
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for b in range(wide * wide):
                v, u = y + b // wide - radius, x + b % wide - radius
                if v < 0 or v >= height or u < 0 or u >= width:
                    continue  # beyond its border the image is extrapolated
                for s in range(per_pixel):
                    inside += table[0, b, s]
                q = lookup[v, u]
                if q < 0:
                    missing += np.float32(1.0)
                    continue
                missing += np.float32(per_pixel - first[q + 1] + first[q])
                for i in range(first[q], first[q + 1]):
                    w = table[slices[i], b, slot[i]]
                    depth[count], share[count] = toward[i], w
                    low, high = min(low, toward[i]), max(high, toward[i])
                    total += w
                    count += 1
            if count == 0 or total <= 0.0:
                continue
            near = np.float32(0.0)
            if high - low > gap:
                # the widest run of empty bins is the gap, up to the width of a bin
                filled[:] = 0
                per_mm = np.float32(DEPTH_GAP_BINS - 1) / (high - low)
                for k in range(count):
                    filled[int((depth[k] - low) * per_mm)] = 1
                run, widest, end = 0, 0, 0
                for k in range(DEPTH_GAP_BINS):
                    run = 0 if filled[k] else run + 1
                    if run > widest:
                        widest, end = run, k
                if widest > gap * per_mm:
                    middle = np.float32(end + 1) - np.float32(0.5) * np.float32(widest)
                    cut[y, x] = low + middle / per_mm
                    for k in range(count):
                        if depth[k] >= cut[y, x]:
                            near += share[k]
                    if near > inside:  # one steep slope: no second layer
                        cut[y, x], near = np.float32(np.inf), np.float32(0.0)
            rest = total - near
            free = max(inside - near, np.float32(0.0))
            if rest <= np.float32(1e-9):
                far[y, x] = np.float32(0.0)
            elif missing > 0:  # no light there
                far[y, x] = min(np.float32(1.0), free / rest) / inside
            else:
                far[y, x] = free / rest / inside


@njit(parallel=True, cache=True)
def gather(  # type: ignore[no-untyped-def]
    lookup, first, slot, slices, toward, table, radius, cut, far, rows, out
):
    """Sum the samples around each pixel. Unsigned indices are not wrapped, which saves time."""
    height, width = lookup.shape
    wide = 2 * radius + 1
    channels = rows.shape[1]
    for y in prange(height):
        for x in range(width):
            edge, behind = cut[y, x], far[y, x]
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                line = lookup[v]
                row = (v - y + radius) * wide + radius - x
                for u in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if line[u] < 0:
                        continue
                    q, b = np.uint64(line[u]), np.uint64(row + u)
                    for sample in range(first[q], first[q + np.uint64(1)]):
                        i = np.uint64(sample)
                        w = table[np.uint64(slices[i]), b, np.uint64(slot[i])]
                        w *= behind if toward[i] < edge else np.float32(1.0)
                        for c in range(channels):
                            out[y, x, c] += w * rows[i, c]


@njit(parallel=True, cache=True, nogil=True)
def gather_mosaics(  # type: ignore[no-untyped-def]
    starts, weight_index, toward, weights, per_pixel, radius, cut, far, light, cell, out
):
    """Do as `gather` for the channel of each pixel's filter, for `MOSAIC_LIGHTS` lights.

    A row's samples follow one another from `starts` of its first pixel to that of its last. The
    order of each sum is that of `gather`.
    """
    height, width = cut.shape
    wide = 2 * radius + 1
    for y in prange(height):
        for x in range(width):
            column = light[cell[y % 2, x % 2]]
            edge, behind = cut[y, x], far[y, x]
            # eight numbers instead of an array, which would be memory
            a = b = c = d = e = f = g = h = np.float32(0.0)
            left, right = max(x - radius, 0), min(x + radius + 1, width)
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                shift = per_pixel * ((v - y + radius) * wide + radius - x)
                for sample in range(starts[v * width + left], starts[v * width + right]):
                    i = np.uint64(sample)
                    w = weights[np.uint64(weight_index[i] + shift)]
                    w *= behind if toward[i] < edge else np.float32(1.0)
                    row = column[i]
                    a += w * row[0]
                    b += w * row[1]
                    c += w * row[2]
                    d += w * row[3]
                    e += w * row[4]
                    f += w * row[5]
                    g += w * row[6]
                    h += w * row[7]
            found = out[y, x]
            found[0], found[1], found[2], found[3] = a, b, c, d
            found[4], found[5], found[6], found[7] = e, f, g, h


@njit(parallel=True, cache=True, nogil=True)
def gather_mosaic(  # type: ignore[no-untyped-def]
    starts, weight_index, toward, weights, per_pixel, radius, cut, far, light, cell, out
):
    """Do as `gather_mosaics` for one light, which takes less time than eight."""
    height, width = cut.shape
    wide = 2 * radius + 1
    for y in prange(height):
        for x in range(width):
            column = light[cell[y % 2, x % 2]]
            edge, behind = cut[y, x], far[y, x]
            total = np.float32(0.0)
            left, right = max(x - radius, 0), min(x + radius + 1, width)
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                shift = per_pixel * ((v - y + radius) * wide + radius - x)
                for sample in range(starts[v * width + left], starts[v * width + right]):
                    i = np.uint64(sample)
                    w = weights[np.uint64(weight_index[i] + shift)]
                    w *= behind if toward[i] < edge else np.float32(1.0)
                    total += w * column[i, 0]
            out[y, x, 0] = total
