"""Count normals in histograms, also of many convolution kernels at once (Numba).

Kernels are parallel and called from one thread. None uses fast-math and every sum is of integers,
so that a result depends neither on the number of threads nor on a sample's position in a block.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba
import numpy as np
from numba import njit, prange

BLOCK_SAMPLES = 4096
"""Samples whose slopes stay in the cache while all alphas pass over them."""
SUM_LANES = 64
"""Buckets that are summed in parallel vector lanes."""
MAX_THREADS = 8
"""Limit, as each thread keeps a histogram of every alpha (5 MB at 301 and 64 x 64)."""


MIN_PARALLEL_NORMALS = 100_000_000
"""Total number of normals below which one thread is faster than several."""


def thread_count() -> int:
    """Return the number of parts that the samples are divided into."""
    return min(int(numba.get_num_threads()), MAX_THREADS)


@contextmanager
def limit_threads(work: int) -> Iterator[None]:
    """Limit the kernels to one thread while ``work`` normals are computed, if these are few."""
    before = numba.get_num_threads()
    if work < MIN_PARALLEL_NORMALS:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@njit(cache=True, parallel=True, error_model="numpy")
def slopes(height: Any, code: Any, right: Any, down: Any) -> Any:
    """Return dh/dx and dh/dy: central or one-sided differences by `code`, 0 without.

    Parameters
    ----------
    height : (H, W) real
    code : (H, W) uint8, of `relief_slopes.stencil`
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


@njit(inline="always")
def _bucket(p, q, bins, limit, scale):  # type: ignore[no-untyped-def]
    """Return the bucket of the normal (-p, -q, 1) / length; bins^2 beyond the limit."""
    w = 1.0 / math.sqrt(1.0 + p * p + q * q)
    u = (limit - p * w) * scale
    v = (limit - q * w) * scale
    if u >= 0.0 and u <= bins and v >= 0.0 and v <= bins:
        return min(int(v), bins - 1) * bins + min(int(u), bins - 1)
    return bins * bins


@njit(cache=True, parallel=True, error_model="numpy")
def count_slopes(p: Any, q: Any, bins: Any, limit: Any, parts: Any) -> Any:
    """Return the counts of normals (-p, -q, 1) / length, (parts, bins^2 + 1); last: outside."""
    n = p.size
    counts = np.zeros((parts, bins * bins + 1), np.int64)
    scale = bins / (2.0 * limit)
    for part in prange(parts):
        own = counts[part]
        for i in range(part * n // parts, (part + 1) * n // parts):
            own[_bucket(p[i], q[i], bins, limit, scale)] += 1
    return counts


@njit(cache=True, nogil=True, error_model="numpy")
def count_in_groups(p: Any, q: Any, group: Any, groups: Any, bins: Any, limit: Any) -> Any:
    """Return the counts of `count_slopes` for each group of samples: (groups, bins^2 + 1)."""
    counts = np.zeros((groups, bins * bins + 1), np.int64)
    scale = bins / (2.0 * limit)
    for i in range(p.size):
        counts[group[i], _bucket(p[i], q[i], bins, limit, scale)] += 1
    return counts


@njit(cache=True, parallel=True, error_model="numpy")
def negative_slopes(
    height: Any, code: Any, starts: Any, right: Any, down: Any, a: Any, b: Any
) -> None:
    """Write the negative slopes of the samples, row by row, to `a` and `b`.

    Parameters
    ----------
    height : (H, W) float32
    code : (H, W) uint8, of `relief_slopes.stencil`
    starts : (H,) int64, number of samples in the rows before
    right, down : float32
        Distance to the next column and row along the axes of the normal, signed.
    a, b : (N,) float32, written
    """
    rows, columns = height.shape
    two = np.float32(2.0)
    per_right, per_down = np.float32(1.0) / right, np.float32(1.0) / down
    for y in prange(rows):
        place = starts[y]
        for x in range(columns):
            c = code[y, x]
            if c != 0:
                rise = height[y, x - (c & 1)] - height[y, x + ((c >> 1) & 1)]
                a[place] = rise * per_right / (two if (c & 3) == 3 else np.float32(1.0))
                rise = height[y - ((c >> 2) & 1), x] - height[y + ((c >> 3) & 1), x]
                b[place] = rise * per_down / (two if (c & 12) == 12 else np.float32(1.0))
                place += 1


@njit(inline="always")
def _mirrored(i, n):  # type: ignore[no-untyped-def]
    """Return the index within n that i is mirrored to about the edges of the end pixels."""
    j = i % (2 * n)
    return j if j < n else 2 * n - 1 - j


@njit(cache=True, parallel=True, error_model="numpy")
def blur_difference(height: Any, weights: Any, out: Any) -> None:
    """Write G * h - h along the rows; `weights` as of `gaussian_weights`, float32, mirrored."""
    rows, columns = height.shape
    reach = weights.size - 1
    two = np.float32(2.0)
    for y in prange(rows):
        line = np.empty(columns + 2 * reach, np.float32)
        for i in range(line.size):
            line[i] = height[y, _mirrored(i - reach, columns)]
        total = np.zeros(columns, np.float32)
        middle = line[reach : reach + columns]
        for k in range(1, reach + 1):
            w = weights[k]
            before = line[reach - k : reach - k + columns]
            after = line[reach + k : reach + k + columns]
            for x in range(columns):
                total[x] += w * (before[x] + after[x] - two * middle[x])
        out[y] = total


@njit(cache=True, parallel=True, error_model="numpy")
def fill_windows(
    height: Any, code: Any, positions: Any, right: Any, down: Any, along: Any, across: Any
) -> None:
    """Write the second differences of the negative slopes around samples, k pixels to either side.

    Parameters
    ----------
    height, code, right, down
        As of `negative_slopes`.
    positions : (m,) int64
        Pixels, y * W + x.
    along, across : (blocks, R, B) float32, written
        ``lean(x + k) + lean(x - k) - 2 lean(x)`` for k = 1...R of sample ``block * B + i``.
    """
    columns = height.shape[1]
    blocks, reach, size = along.shape
    two = np.float32(2.0)
    for block in prange(blocks):
        for i in range(min(size, positions.size - block * size)):
            y, x = divmod(positions[block * size + i], columns)
            c = code[y, x]
            x0, x1 = x - (c & 1), x + ((c >> 1) & 1)
            above, below = height[y - ((c >> 2) & 1)], height[y + ((c >> 3) & 1)]
            own = height[y]
            per_right = np.float32(1.0) / (right * np.float32(x1 - x0))
            per_down = np.float32(1.0) / (down * (two if (c & 12) == 12 else np.float32(1.0)))
            a0 = own[x0] - own[x1]
            b0 = above[x] - below[x]
            inside = min(reach, x0, columns - 1 - x1)
            for k in range(1, inside + 1):
                a = (own[x0 + k] - own[x1 + k]) + (own[x0 - k] - own[x1 - k]) - two * a0
                b = (above[x + k] - below[x + k]) + (above[x - k] - below[x - k]) - two * b0
                along[block, k - 1, i] = a * per_right
                across[block, k - 1, i] = b * per_down
            for k in range(inside + 1, reach + 1):
                p0, m0 = _mirrored(x0 + k, columns), _mirrored(x0 - k, columns)
                p1, m1 = _mirrored(x1 + k, columns), _mirrored(x1 - k, columns)
                p, m = _mirrored(x + k, columns), _mirrored(x - k, columns)
                a = (own[p0] - own[p1]) + (own[m0] - own[m1]) - two * a0
                b = (above[p] - below[p]) + (above[m] - below[m]) - two * b0
                along[block, k - 1, i] = a * per_right
                across[block, k - 1, i] = b * per_down


@njit(cache=True, parallel=True, error_model="numpy")
def sum_weighted_windows(along: Any, across: Any, weights: Any, da: Any, db: Any) -> None:
    """Write the weighted sums of windows over k: `negative_slopes` of G * h - h at the samples."""
    blocks, _, size = along.shape
    for block in prange(blocks):
        count = min(size, da.size - block * size)
        a = np.zeros(size, np.float32)
        b = np.zeros(size, np.float32)
        for k in range(1, weights.size):
            w = weights[k]
            for i in range(size):
                a[i] += w * along[block, k - 1, i]
                b[i] += w * across[block, k - 1, i]
        da[block * size : block * size + count] = a[:count]
        db[block * size : block * size + count] = b[:count]


@njit(cache=True, parallel=True, error_model="numpy")
def count_kernels(
    a0: Any, b0: Any, da: Any, db: Any, alphas: Any, bins: Any, limit: Any, parts: Any
) -> Any:
    """Count normals ``(a, b, 1) / length``, a = a0 + alpha da, b = b0 + alpha db, of every alpha.

    Parameters
    ----------
    a0, b0, da, db : (N,) float32
        Minus the slopes along and across, and what the Gaussian alone changes them by.
    alphas : (A,) float32
    bins, limit, parts : int, float, int

    Returns
    -------
    (parts, A, bins^2 + 1) int32
        Axes of buckets (across, along); the last entry counts what is beyond the limit.
    """
    n = a0.size
    cells = np.int32(bins * bins)
    side, last = np.int32(bins), np.int32(bins - 1)
    zero, one, top = np.float32(0.0), np.float32(1.0), np.float32(bins)
    most, scale = np.float32(limit), np.float32(bins / (2.0 * limit))
    counts = np.zeros((parts, alphas.size, bins * bins + 1), np.int32)
    for part in prange(parts):
        bucket = np.empty(BLOCK_SAMPLES, np.int32)
        end = (part + 1) * n // parts
        for start in range(part * n // parts, end, BLOCK_SAMPLES):
            size = min(BLOCK_SAMPLES, end - start)
            A, B = a0[start : start + size], b0[start : start + size]
            dA, dB = da[start : start + size], db[start : start + size]
            for j in range(alphas.size):
                alpha = alphas[j]
                for i in range(size):
                    a = A[i] + alpha * dA[i]
                    b = B[i] + alpha * dB[i]
                    w = one / np.sqrt(one + a * a + b * b)
                    u = (a * w + most) * scale
                    v = (b * w + most) * scale
                    place = min(np.int32(v), last) * side + min(np.int32(u), last)
                    within = u >= zero and u <= top and v >= zero and v <= top
                    bucket[i] = place if within else cells
                own = counts[part, j]
                # neighbors on the skin share buckets: alternate distant ones to avoid stalls
                quarter = size // 4
                for i in range(quarter):
                    own[bucket[i]] += 1
                    own[bucket[i + quarter]] += 1
                    own[bucket[i + 2 * quarter]] += 1
                    own[bucket[i + 3 * quarter]] += 1
                for i in range(4 * quarter, size):
                    own[bucket[i]] += 1
    return counts


@njit(cache=True, parallel=True, error_model="numpy")
def distances(counts: Any, target: Any) -> Any:
    """Return ``sum |H - h|`` (eq. 7) of every alpha: counts as of `count_kernels`."""
    parts, kinds, cells = counts.shape
    out = np.empty(kinds)
    for j in prange(kinds):
        samples = 0
        for part in range(parts):
            for b in range(cells):
                samples += counts[part, j, b]
        total = 0.0
        for b in range(cells):
            c = 0
            for part in range(parts):
                c += counts[part, j, b]
            total += abs(target[b] - c / samples)
        out[j] = total
    return out


@njit(cache=True, parallel=True, error_model="numpy")
def distance_bounds(
    first: Any, second: Any, target: Any, before: Any, fresh: Any, pixels: Any, signs: Any
) -> Any:
    """Return distances on a sample, and estimates of lower bounds of all pixels' distances.

    Parameters
    ----------
    first, second : (parts, A, cells) int32
        Counts of the pixels drawn before and of the fresh ones, as of `count_kernels`.
    target : (cells,) float64
    before, fresh, pixels : int
        Pixels drawn before, drawn afresh, and there are in all.
    signs : (P, cells) float64
        Patterns s in [-1, 1] chosen without the fresh pixels; H - h on the old ones is another.

    Returns
    -------
    (A, 2) float64
    """
    parts, kinds, cells = first.shape
    out = np.empty((kinds, 2))
    grown = (pixels - before) / fresh
    for j in prange(kinds):
        # sums of every LANES-th bucket, so that neighbors are added at once; then the sums' sums
        total, own = np.zeros(SUM_LANES), np.zeros(SUM_LANES)
        lows = np.zeros((signs.shape[0], SUM_LANES))
        x, y, gap = np.empty(SUM_LANES), np.empty(SUM_LANES), np.empty(SUM_LANES)
        for begin in range(0, cells, SUM_LANES):
            size = min(SUM_LANES, cells - begin)
            x[:] = 0.0
            y[:] = 0.0
            for part in range(parts):
                old, new = first[part, j, begin:], second[part, j, begin:]
                for i in range(size):
                    x[i] += old[i]
                    y[i] += new[i]
            wanted = target[begin:]
            for i in range(size):
                h = wanted[i]
                total[i] += abs(h - (x[i] + y[i]) / (before + fresh))
                # exact over the pixels drawn before, extrapolated from the fresh ones
                g = h - (x[i] + y[i] * grown) / pixels
                gap[i] = g
                so_far = h - x[i] / before
                own[i] += g if so_far > 0.0 else (-g if so_far < 0.0 else 0.0)
            for s in range(signs.shape[0]):
                sign, low = signs[s, begin:], lows[s]
                for i in range(size):
                    low[i] += sign[i] * gap[i]
        best = own.sum()
        for s in range(signs.shape[0]):
            best = max(best, lows[s].sum())
        out[j, 0] = total.sum()
        out[j, 1] = best
    return out
