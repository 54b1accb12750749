"""Loops of the statistics in a disc: a square, two caps by row sums, two lobes by column sums."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_runs(t: Any, a: Any, b: Any, left: Any, right: Any) -> None:
    """Add what lies between entries `left` and `right` of two rows of prefix sums."""
    al, ar, bl, br = a[left:], a[right:], b[left:], b[right:]
    for i in range(t.size):
        t[i] += (ar[i] - al[i]) + (br[i] - bl[i])


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_two_runs(
    t: Any, a: Any, b: Any, c: Any, d: Any, left: Any, right: Any, left2: Any, right2: Any
) -> None:
    """Do the work of `_add_runs` for rows `a` and `b`, and for `c` and `d`."""
    al, ar, bl, br = a[left:], a[right:], b[left:], b[right:]
    cl, cr, dl, dr = c[left2:], c[right2:], d[left2:], d[right2:]
    for i in range(t.size):
        t[i] += ((ar[i] - al[i]) + (br[i] - bl[i])) + ((cr[i] - cl[i]) + (dr[i] - dl[i]))


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_run(t: Any, a: Any, left: Any, right: Any, sign: Any) -> None:
    """Add what lies between entries `left` and `right` of one row of prefix sums."""
    al, ar = a[left:], a[right:]
    for i in range(t.size):
        t[i] += sign * (ar[i] - al[i])


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_columns(t: Any, upper: Any, lower: Any, one: Any, other: Any) -> None:
    """Add the columns' sums between two rows of prefix sums, of columns on both sides."""
    ul, ur, ll, lr = upper[one:], upper[other:], lower[one:], lower[other:]
    for i in range(t.size):
        t[i] += (ll[i] - ul[i]) + (lr[i] - ur[i])


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_row(t: Any, box: Any, p: Any, q: Any, half: Any, high: Any, inner: Any, y: Any) -> None:
    """Write the sums over the discs about one row of a tile.

    Parameters
    ----------
    t : (n,), written
    box : (n,) float64
        Sum over the square of half-side `inner`.
    p, q : (K, L), (K + 1, L)
        Sums along rows and down columns, before each entry, of the K rows that the tile sees.
    half, high : (R + 1,), (C + 1,) int64
    inner : int
    y : int
        The row, counted within the K; rows before 0 and from K on hold nothing.
    """
    rows, reach, width = p.shape[0], half.size - 1, half[0]
    for i in range(t.size):
        t[i] = box[i]
    for a in range(inner + 1, width + 1):
        w = high[a]
        _add_columns(t, q[max(y - w, 0)], q[min(y + w + 1, rows)], width - a, width + a)
    a = inner + 1
    while a <= reach:
        w = half[a]
        if a < reach and y - a - 1 >= 0 and y + a + 1 < rows:
            v = half[a + 1]
            _add_two_runs(
                t, p[y - a], p[y + a], p[y - a - 1], p[y + a + 1],
                width - w, width + w + 1, width - v, width + v + 1,
            )  # fmt: skip
            a += 2
            continue
        if y - a >= 0:
            _add_run(t, p[y - a], width - w, width + w + 1, 1)
        if y + a < rows:
            _add_run(t, p[y + a], width - w, width + w + 1, 1)
        a += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _move_box(box: Any, p: Any, inner: Any, width: Any, y: Any, first: Any) -> None:
    """Move the square's sums to row `y`, or begin them there."""
    rows = p.shape[0]
    if first:
        box[:] = 0.0
        for k in range(max(y - inner, 0), min(y + inner + 1, rows)):
            _add_run(box, p[k], width - inner, width + inner + 1, 1)
        return
    if y + inner < rows:
        _add_run(box, p[y + inner], width - inner, width + inner + 1, 1)
    if y - inner - 1 >= 0:
        _add_run(box, p[y - inner - 1], width - inner, width + inner + 1, -1)


@njit(cache=True, nogil=True, error_model="numpy")
def _counts(h: Any, valid: Any, masked: Any, y: Any, x: Any) -> Any:
    """Return whether a pixel counts."""
    return np.isfinite(h[y, x]) and (not masked or valid[y, x] != 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _directly(h: Any, valid: Any, masked: Any, half: Any, y: Any, x: Any) -> Any:
    """Return mean and variance of one disc by summing its pixels about one of them."""
    rows, columns = h.shape
    reach = half.size - 1
    n, s1, s2, about = 0, 0.0, 0.0, 0.0
    for k in range(max(0, y - reach), min(rows, y + reach + 1)):
        w = half[abs(k - y)]
        for c in range(max(0, x - w), min(columns, x + w + 1)):
            if _counts(h, valid, masked, k, c):
                if n == 0:
                    about = np.float64(h[k, c])
                d = h[k, c] - about
                n += 1
                s1 += d
                s2 += d * d
    m = s1 / n
    return about + m, max(s2 / n - m * m, 0.0)


_SIGNATURES = [
    f"void({kind}[:, ::1], uint8[:, ::1], boolean, int64[::1], int64[::1], int64, int64, int64, "
    "float64, float64[:, ::1], float64[:, ::1], int32[:, ::1])"
    for kind in ("float32", "float64")
]


@njit(_SIGNATURES, cache=True, parallel=True, error_model="numpy")
def disc_moments(
    h: Any, valid: Any, masked: Any, half: Any, high: Any, inner: Any, tall: Any, wide: Any,
    trusted: Any, mean: Any, deviation: Any, count: Any,
) -> None:  # fmt: skip
    """Write mean, deviation and number of valid pixels in a disc about each pixel.

    A tile takes the mean of all that its discs can see as the value to sum about, and sums in
    the type of `h`; a disc whose variance may be lost in the rounding of its tile's sums is
    summed again by itself in float64.

    Parameters
    ----------
    h : (H, W) float32 or float64
        What is not finite does not count.
    valid : (H, W) uint8, or any when not `masked`
    half, high : (R + 1,), (C + 1,) int64
        Half-width of the disc at each distance of a row from its centre, half-height at each
        distance of a column, px; half[0] = C and high[0] = R.
    inner : int
        Half-side of a square in the disc; no column farther out is taller than it.
    tall, wide : int
        Pixels of a tile.
    trusted : float
        Relative error of a variance that rounding may cause.
    mean, deviation : (H, W) float64, written
        NaN where no pixel of the disc counts.
    count : (H, W) int32, written
    """
    rows, columns = h.shape
    reach, width = half.size - 1, half[0]
    across = (columns + wide - 1) // wide
    down = (rows + tall - 1) // tall
    whole = np.int64(0)
    for a in range(reach + 1):
        whole += (2 * half[a] + 1) * (1 if a == 0 else 2)
    for tile in prange(across * down):
        y0 = (tile // across) * tall
        x0 = (tile % across) * wide
        y1, x1 = min(rows, y0 + tall), min(columns, x0 + wide)
        k0, k1 = max(0, y0 - reach), min(rows, y1 + reach)
        c0, c1 = max(0, x0 - width), min(columns, x1 + width)
        seen = 0
        first, total = 0.0, 0.0
        for k in range(k0, k1):
            for c in range(c0, c1):
                if _counts(h, valid, masked, k, c):
                    if seen == 0:
                        first = np.float64(h[k, c])
                    seen += 1
                    total += h[k, c] - first
        if seen == 0:
            for y in range(y0, y1):
                for x in range(x0, x1):
                    mean[y, x] = np.nan
                    deviation[y, x] = np.nan
                    count[y, x] = 0
            continue
        about = first + total / seen
        every = seen == (k1 - k0) * (c1 - c0)
        partial = seen < (y1 - y0 + 2 * reach) * (x1 - x0 + 2 * width)
        n = x1 - x0
        length = n + 2 * width + 1  # entry j: column x0 - width + j
        skip = c0 - (x0 - width)
        moments = 3 if partial else 2
        sums = np.empty((moments, y1 - y0, n))
        p = np.zeros((k1 - k0, length), h.dtype)
        q = np.zeros((k1 - k0 + 1, length), h.dtype)
        running = np.empty(length)
        box = np.empty(n)
        t = np.empty(n, h.dtype)
        largest = 0.0
        for moment in range(moments):
            running[:] = 0.0
            for k in range(k0, k1):
                total = 0.0
                r = p[k - k0]
                for c in range(c0, c1):
                    j = c - c0 + skip
                    r[j] = total
                    value = 0.0
                    if every or _counts(h, valid, masked, k, c):
                        d = h[k, c] - about
                        value = d if moment == 0 else (d * d if moment == 1 else 1.0)
                    total += value
                    running[j] += value
                for j in range(c1 - c0 + skip, length):
                    r[j] = total
                s = q[k - k0 + 1]
                for j in range(length):
                    s[j] = running[j]
                if moment == 1:
                    largest = max(largest, total)
            if moment == 1:
                for j in range(length):
                    largest = max(largest, running[j])
            for y in range(y0, y1):
                _move_box(box, p, inner, width, y - k0, y == y0)
                _disc_row(t, box, p, q, half, high, inner, y - k0)
                sums[moment, y - y0] = t
        # what rounding of the stored sums may have done to a disc's sum of squares and sum
        unit = np.finfo(h.dtype).eps
        chain = 0.5 * unit * np.sqrt(4.0 * (reach + width))
        blur2 = chain * largest
        blur1 = chain * np.sqrt(max(length, k1 - k0) * largest)
        for y in range(y0, y1):
            for i in range(n):
                held = np.int64(sums[2, y - y0, i]) if partial else whole
                count[y, x0 + i] = held
                if held == 0:
                    mean[y, x0 + i] = np.nan
                    deviation[y, x0 + i] = np.nan
                    continue
                m = sums[0, y - y0, i] / held
                squares = sums[1, y - y0, i] / held
                v = squares - m * m
                doubt = blur2 + 2.0 * abs(m) * blur1 + 4.0 * unit * held * squares
                if held * v * trusted < doubt:
                    mean[y, x0 + i], v = _directly(h, valid, masked, half, y, x0 + i)
                else:
                    mean[y, x0 + i] = about + m
                deviation[y, x0 + i] = np.sqrt(max(v, 0.0))
