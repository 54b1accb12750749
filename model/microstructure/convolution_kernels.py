"""Inner loops of convolution along lines whose direction varies per pixel.

Kernels are parallel over rows and called from one thread. None uses fast-math, and a pixel's result
depends neither on the number of threads nor on the window.
"""

# mypy: allow-untyped-defs

import math

import numpy as np
from numba import njit, prange

TRUNCATE_SIGMAS = 4.0
"""The discrete Gaussian is truncated at the pixel nearest to this many sigmas."""
MIN_WEIGHT = 1e-8
"""Smallest weight of a neighbor; below it the Gaussian is the delta in single precision."""
MAX_DISTANCE_PX = 255
"""Distances to invalid pixels are clamped to this many pixels."""
LINEAR, CUBIC = 1, 2
"""Pixels to each side that the interpolation uses."""
MIRROR, OPEN = 0, 1
"""Beyond the border the map is mirrored about the edges of its outermost pixels, or nothing."""
FINE, NOT_FINITE, ALPHA, SIGMA, AXIS = range(5)
"""Error codes of a row's parameters."""


@njit(cache=True, nogil=True, error_model="numpy")
def distance_to_invalid(valid):
    """Return each pixel's chessboard distance to the nearest one that is not valid.

    Parameters
    ----------
    valid : (H, W) bool

    Returns
    -------
    (H, W) uint8
        0 where not valid, at most `MAX_DISTANCE_PX`. The map's border does not count.
    """
    rows, columns = valid.shape
    out = np.empty((rows, columns), np.uint8)
    for y in range(rows):
        for x in range(columns):
            d = MAX_DISTANCE_PX
            if not valid[y, x]:
                d = 0
            else:
                if x > 0:
                    d = min(d, out[y, x - 1] + 1)
                if y > 0:
                    d = min(d, out[y - 1, x] + 1)
                    if x > 0:
                        d = min(d, out[y - 1, x - 1] + 1)
                    if x < columns - 1:
                        d = min(d, out[y - 1, x + 1] + 1)
            out[y, x] = d
    for y in range(rows - 1, -1, -1):
        for x in range(columns - 1, -1, -1):
            d = int(out[y, x])
            if x < columns - 1:
                d = min(d, out[y, x + 1] + 1)
            if y < rows - 1:
                d = min(d, out[y + 1, x] + 1)
                if x < columns - 1:
                    d = min(d, out[y + 1, x + 1] + 1)
                if x > 0:
                    d = min(d, out[y + 1, x - 1] + 1)
            out[y, x] = d
    return out


@njit(cache=True, parallel=True, error_model="numpy")
def check_rows(lines, rows, max_sigma):
    """Return an error code of each row's parameters, and the largest sigma used there.

    Parameters
    ----------
    lines : LineKernels
    rows : int
        Of the window.
    max_sigma : float
        Largest sigma allowed, px.

    Returns
    -------
    code : (rows,) int64
    largest : (rows,) float64
        0 in rows where nothing is convolved.
    """
    axis, alpha, sigma = lines
    columns = max(alpha.shape[1], sigma.shape[1], axis.shape[1])
    code = np.zeros(rows, np.int64)
    largest = np.zeros(rows)
    ah, aw = alpha.shape[0] > 1, alpha.shape[1] > 1
    sh, sw = sigma.shape[0] > 1, sigma.shape[1] > 1
    xh, xw = axis.shape[0] > 1, axis.shape[1] > 1
    for y in prange(rows):
        wrong = FINE
        top = 0.0
        for x in range(columns):
            a = alpha[y * ah, x * aw]
            s = sigma[y * sh, x * sw]
            if not (math.isfinite(a) and math.isfinite(s)):
                wrong = NOT_FINITE
            elif a < -2.0 or a > 1.0:
                wrong = ALPHA
            elif s < 0.0 or s > max_sigma:
                wrong = SIGMA
            elif a != 0.0 and s > 0.0:
                u = axis[y * xh, x * xw, 0]
                v = axis[y * xh, x * xw, 1]
                if not abs(u * u + v * v - 1.0) < 2e-3:
                    wrong = AXIS
                top = max(top, s)
        code[y] = wrong
        largest[y] = top
    return code, largest


@njit(inline="always")
def _cubic(f):
    """Return Keys' weights (a = -1/2) of the pixels at -1, 0, 1, 2 for a sample at f."""
    f2 = f * f
    f3 = f2 * f
    half = np.float32(0.5)
    a = f2 - half * (f + f3)
    b = np.float32(1.0) - np.float32(2.5) * f2 + np.float32(1.5) * f3
    c = half * f + np.float32(2.0) * f2 - np.float32(1.5) * f3
    d = half * (f3 - f2)
    return a, b, c, d


@njit(inline="always")
def _mirrored(i, n):
    """Return index i mirrored into 0...n - 1 about the edges of the end pixels."""
    j = i % (2 * n)
    return j if j < n else 2 * n - 1 - j


@njit
def _slow_sample(source, clear, frame, y, x, fy, fx, reach):
    """Return a sample between the pixels y, y + 1 and x, x + 1, and whether its taps are valid.

    `reach` pixels to each side are weighted; taps of weight 0 need not be valid.
    """
    top, left, rows, columns, border = frame
    nothing = source.dtype.type(0.0)
    total = nothing
    for l in range(1 - reach, reach + 1):  # noqa: E741
        wy = _tap(fy, l, reach)
        if wy == 0.0:
            continue
        gy = y + l
        if gy < 0 or gy >= rows:
            if border == OPEN:
                return nothing, False
            gy = _mirrored(gy, rows)
        for k in range(1 - reach, reach + 1):
            wx = _tap(fx, k, reach)
            if wx == 0.0:
                continue
            gx = x + k
            if gx < 0 or gx >= columns:
                if border == OPEN:
                    return nothing, False
                gx = _mirrored(gx, columns)
            if clear.size > 0 and clear[gy - top, gx - left] == 0:
                return nothing, False
            total += wy * wx * source[gy - top, gx - left]
    return total, True


@njit
def _tap(f, k, reach):
    if reach == LINEAR:
        return f if k == 1 else np.float32(1.0) - f
    a, b, c, d = _cubic(f)
    if k == -1:
        return a
    if k == 0:
        return b
    return c if k == 1 else d


@njit(cache=True, parallel=True, error_model="numpy")
def convolve_lines(source, clear, source_window, size, lines, window, reach, border, out):
    """Write ``h + alpha (G * h - h)`` with the Gaussian along each pixel's own line (eqs. 3 and 6).

    Two samples at the same distance to both sides are one pair; a pair with an invalid sample
    counts as the pixel itself.

    Parameters
    ----------
    source : (h, w) float32 or float64
        A window of the map.
    clear : (h, w) uint8 or (0, 0)
        Result of `distance_to_invalid`; empty: all is valid.
    source_window, window : Window
        Where source and output are in the map.
    size : (int, int)
        Of the map.
    lines : LineKernels
        Where the output is.
    reach, border : int
        `LINEAR` or `CUBIC`; `MIRROR` or `OPEN`.
    out : (m, n) of the source's type, written
        Pixels that are not valid keep their value.
    """
    rows, columns = size
    top, left = source_window.top, source_window.left
    axis, alpha, sigma = lines
    ah, aw = alpha.shape[0] > 1, alpha.shape[1] > 1
    sh, sw = sigma.shape[0] > 1, sigma.shape[1] > 1
    xh, xw = axis.shape[0] > 1, axis.shape[1] > 1
    masked = clear.size > 0
    frame = (top, left, rows, columns, border)
    kind = source.dtype.type
    zero, one, two = kind(0.0), kind(1.0), kind(2.0)
    for row in prange(out.shape[0]):
        gy = row + window.top
        y = gy - top
        for column in range(out.shape[1]):
            gx = column + window.left
            x = gx - left
            own = source[y, x]
            out[row, column] = own
            a = alpha[row * ah, column * aw]
            s = sigma[row * sh, column * sw]
            radius = int(TRUNCATE_SIGMAS * s + 0.5)
            if a == zero or radius == 0 or (masked and clear[y, x] == 0):
                continue
            ax = axis[row * xh, column * xw, 0]
            ay = axis[row * xh, column * xw, 1]
            # squares without powers: e^((i + 1)^2) = e^(i^2) e^(2 i + 1)
            e = math.exp(-0.5 / (kind(s) * kind(s)))
            if e < MIN_WEIGHT:
                continue
            w, grow, grow_by = e, e * e * e, e * e
            norm = 1.0
            total = zero
            need = radius + reach
            quick = gy >= need and gx >= need and gy + need < rows and gx + need < columns
            if masked:
                quick = quick and clear[y, x] > need
            if quick and abs(ax) == one and ay == zero:
                for i in range(1, radius + 1):
                    total += kind(w) * (source[y, x + i] + source[y, x - i] - two * own)
                    norm += 2.0 * w
                    w *= grow
                    grow *= grow_by
            elif quick and abs(ay) == one and ax == zero:
                for i in range(1, radius + 1):
                    total += kind(w) * (source[y + i, x] + source[y - i, x] - two * own)
                    norm += 2.0 * w
                    w *= grow
                    grow *= grow_by
            elif quick and reach == CUBIC:
                for i in range(1, radius + 1):
                    dx, dy = i * ax, i * ay
                    bx, by = math.floor(dx), math.floor(dy)
                    cx = _cubic(kind(dx - bx))
                    cy = _cubic(kind(dy - by))
                    jx, jy = int(bx), int(by)
                    sample = zero
                    for m in range(4):
                        above = source[y + jy - 1 + m]
                        below = source[y - jy + 1 - m]
                        p, q = x + jx - 1, x - jx + 1
                        part = cx[0] * (above[p] + below[q])
                        part += cx[1] * (above[p + 1] + below[q - 1])
                        part += cx[2] * (above[p + 2] + below[q - 2])
                        part += cx[3] * (above[p + 3] + below[q - 3])
                        sample += cy[m] * part
                    total += kind(w) * (sample - two * own)
                    norm += 2.0 * w
                    w *= grow
                    grow *= grow_by
            elif quick:
                for i in range(1, radius + 1):
                    dx, dy = i * ax, i * ay
                    bx, by = math.floor(dx), math.floor(dy)
                    fx, fy = kind(dx - bx), kind(dy - by)
                    jx, jy = int(bx), int(by)
                    p, q = x + jx, x - jx
                    above, below = source[y + jy], source[y - jy]
                    sample = (one - fy) * (
                        (one - fx) * (above[p] + below[q]) + fx * (above[p + 1] + below[q - 1])
                    )
                    above, below = source[y + jy + 1], source[y - jy - 1]
                    sample += fy * (
                        (one - fx) * (above[p] + below[q]) + fx * (above[p + 1] + below[q - 1])
                    )
                    total += kind(w) * (sample - two * own)
                    norm += 2.0 * w
                    w *= grow
                    grow *= grow_by
            else:
                for i in range(1, radius + 1):
                    good = False
                    pair = zero
                    for finer in range(reach, 0, -1):  # cubic, or linear where a hole is near
                        pair = zero
                        good = True
                        for side in (1, -1):
                            dx, dy = side * i * ax, side * i * ay
                            bx, by = math.floor(dx), math.floor(dy)
                            fy, fx = kind(dy - by), kind(dx - bx)
                            at_y, at_x = gy + int(by), gx + int(bx)
                            value, there = _slow_sample(
                                source, clear, frame, at_y, at_x, fy, fx, finer
                            )
                            pair += value
                            good = good and there
                        if good:
                            break
                    if good:
                        total += kind(w) * (pair - two * own)
                    norm += 2.0 * w
                    w *= grow
                    grow *= grow_by
            out[row, column] = own + a * total / kind(norm)
