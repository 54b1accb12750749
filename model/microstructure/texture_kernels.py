"""Rasterize the strain of vertices into a texture, compiled."""

# mypy: allow-untyped-defs

import math

import numpy as np
from numba import njit, prange

from model.microstructure.strain_kernels import ISOTROPY_TOL, principal_values

BAND_ROWS = 32
"""Rows of the texture per thread at a time."""

EMPTY, COVERED, PADDED = range(3)


@njit(cache=True, parallel=True, error_model="numpy")
def fill_texture(faces, places, values, valid, window, size, found):
    """Fill a window of a texture: interpolate tensors and decompose them at each pixel.

    A pixel in several triangles belongs to the one of the lowest number. The result at a pixel does
    not depend on the window.

    Parameters
    ----------
    faces : (F, 3) int64
    places : two (V,) float64
        x and y of the vertices in pixels of the whole texture, y down.
    values : (V, 6) float64
        T - 1 and the metric, texture per length.
    valid : (V,) bool
    window : Window
    size : (float, float)
        Pixels per unit of the texture's u and v.
    found
        Written: state, (m, n) uint8, of 0; r_s and r_t, (m, n, 2) float32; unit vectors (right,
        down) of s and t, (m, n, 2, 2) float32; pixels per length along s and t, (m, n, 2) float32.
    """
    x, y = places
    top, left = window.top, window.left
    width, height = size
    state, stretch, axes, scale = found
    rows, columns = state.shape
    bands = (rows + BAND_ROWS - 1) // BAND_ROWS
    for band in prange(bands):
        first, last = top + band * BAND_ROWS, top + min(rows, (band + 1) * BAND_ROWS) - 1
        for f in range(faces.shape[0]):
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            low, high = min(y[i], min(y[j], y[k])), max(y[i], max(y[j], y[k]))
            if high < first or low > last:
                continue
            if max(x[i], max(x[j], x[k])) < left or min(x[i], min(x[j], x[k])) > left + columns - 1:
                continue
            if not (valid[i] and valid[j] and valid[k]):
                continue
            det = (x[j] - x[i]) * (y[k] - y[i]) - (x[k] - x[i]) * (y[j] - y[i])
            if det == 0.0:
                continue
            # weights of corners j and k, linear in x and y from corner i
            jx, jy = (y[k] - y[i]) / det, -(x[k] - x[i]) / det
            kx, ky = -(y[j] - y[i]) / det, (x[j] - x[i]) / det
            for row in range(max(first, math.ceil(low)), min(last, math.floor(high)) + 1):
                dy = row - y[i]
                a, b = -np.inf, np.inf
                for part in range(3):
                    if part == 0:
                        slope, at = jx, jy * dy
                    elif part == 1:
                        slope, at = kx, ky * dy
                    else:
                        slope, at = -jx - kx, 1.0 - (jy + ky) * dy
                    if slope > 0.0:
                        a = max(a, -at / slope)
                    elif slope < 0.0:
                        b = min(b, -at / slope)
                    elif at < -1e-9:
                        b = -np.inf
                # pixels on an edge are in both triangles: the first one keeps them
                begin = max(math.ceil(a + x[i] - 1e-6), left) if b >= a - 2e-6 else left
                end = min(math.floor(b + x[i] + 1e-6), left + columns - 1) if b >= a - 2e-6 else -1
                for column in range(begin, end + 1):
                    r, c = row - top, column - left
                    if state[r, c] != EMPTY:
                        continue
                    dx = column - x[i]
                    wj, wk = jx * dx + jy * dy, kx * dx + ky * dy
                    p = values[i, 0] + wj * (values[j, 0] - values[i, 0])
                    p += wk * (values[k, 0] - values[i, 0])
                    q = values[i, 1] + wj * (values[j, 1] - values[i, 1])
                    q += wk * (values[k, 1] - values[i, 1])
                    s = values[i, 2] + wj * (values[j, 2] - values[i, 2])
                    s += wk * (values[k, 2] - values[i, 2])
                    mean, h, vx, vy = principal_values(p, q, s)
                    if 2.0 * h <= ISOTROPY_TOL * (1.0 + mean + h):
                        vx, vy = 1.0, 0.0
                    p = values[i, 3] + wj * (values[j, 3] - values[i, 3])
                    p += wk * (values[k, 3] - values[i, 3])
                    q = values[i, 4] + wj * (values[j, 4] - values[i, 4])
                    q += wk * (values[k, 4] - values[i, 4])
                    s = values[i, 5] + wj * (values[j, 5] - values[i, 5])
                    s += wk * (values[k, 5] - values[i, 5])
                    sx, sy = width * (p * vx + q * vy), -height * (q * vx + s * vy)
                    tx, ty = width * (q * vx - p * vy), -height * (s * vx - q * vy)
                    ls, lt = math.sqrt(sx * sx + sy * sy), math.sqrt(tx * tx + ty * ty)
                    if not (ls > 0.0 and lt > 0.0):
                        continue
                    state[r, c] = COVERED
                    stretch[r, c, 0] = max(1.0 + mean + h, 0.0)
                    stretch[r, c, 1] = max(1.0 + mean - h, 0.0)
                    axes[r, c, 0, 0], axes[r, c, 0, 1] = sx / ls, sy / ls
                    axes[r, c, 1, 0], axes[r, c, 1, 1] = tx / lt, ty / lt
                    scale[r, c, 0], scale[r, c, 1] = ls, lt


@njit(cache=True, parallel=True, error_model="numpy")
def pad_once(state, before, stretch, axes, scale):
    """Copy values of a filled neighbor to empty pixels; `before` is a copy of `state`."""
    rows, columns = state.shape
    for r in prange(rows):
        for c in range(columns):
            if before[r, c] != EMPTY:
                continue
            found = False
            for straight in (True, False):  # edge neighbors before corner neighbors
                for dr in range(-1, 2):
                    for dc in range(-1, 2):
                        y, x = r + dr, c + dc
                        if found or (dr == 0 or dc == 0) != straight:
                            continue
                        if 0 <= y < rows and 0 <= x < columns and before[y, x] != EMPTY:
                            found = True
                            state[r, c] = PADDED
                            stretch[r, c] = stretch[y, x]
                            axes[r, c] = axes[y, x]
                            scale[r, c] = scale[y, x]


@njit(cache=True, parallel=True, error_model="numpy")
def look_up_kernels(
    stretch, state, breaks, alpha_lines, sigma_lines, ends, limits, scale, alpha, sigma
):
    """Write strength and sigma in pixels for each pixel's two stretch ratios (eqs. 8 and 9).

    Parameters
    ----------
    stretch, scale : (m, n, 2) float32
        Ratios, and pixels per length.
    state : (m, n) uint8
        Nothing is convolved where `EMPTY`.
    breaks, alpha_lines : (L - 1,), (L, 2) float64
        Slope and intercept of alpha's lines.
    sigma_lines : (2, 2) float64
        Of sigma, in the length of `scale`, below and above a ratio of 1.
    ends, limits : (2,) float64
        Ratios are clamped to the first, alpha to the second.
    alpha, sigma : (2, m, n) float32, written
    """
    for r in prange(state.shape[0]):
        for c in range(state.shape[1]):
            for axis in range(2):
                alpha[axis, r, c] = 0.0
                sigma[axis, r, c] = 0.0
                if state[r, c] == EMPTY:
                    continue
                ratio = min(max(float(stretch[r, c, axis]), ends[0]), ends[1])
                line = 0
                while line < breaks.size and ratio > breaks[line]:
                    line += 1
                a = alpha_lines[line, 0] * ratio + alpha_lines[line, 1]
                a = min(max(a, limits[0]), limits[1])
                side = 0 if ratio < 1.0 else 1
                s = sigma_lines[side, 0] * ratio + sigma_lines[side, 1]
                alpha[axis, r, c] = 0.0 if ratio == 1.0 else a
                sigma[axis, r, c] = max(s, 0.0) * scale[r, c, axis]
