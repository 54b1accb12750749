"""Fit moments of the lights to the patterns of a pixel (Numba)."""

import numpy as np
from numba import njit

# Rows of the samples, in the order of the patterns.
FULL, DARK = 0, 7  # between them x, y, z, -x, -y, -z

# Rows of the moments: values, (co)variances, squared residuals, their number, samples used.
C_0, C_X, C_Y, C_Z = 0, 1, 2, 3

V_0, V_XX, V_YY, V_ZZ, V_XY, V_XZ, V_YZ = 4, 5, 6, 7, 8, 9, 10

CHI, FREE, USED, MISFIT = 11, 12, 13, 14

MOMENT_ROWS = 15


PIXEL_LANES = 64
"""Pixels without missing samples that are fitted together, in whole vectors."""
_VARIANCE, _FIT, _TOP = 8 * PIXEL_LANES, 16 * PIXEL_LANES, (16 + MOMENT_ROWS) * PIXEL_LANES
_LANE_NUMBERS = _TOP + PIXEL_LANES


@njit(fastmath={"contract", "nsz"}, error_model="numpy", forceinline=True)
def _fit_lanes(s, noise_source, gain, read, dark, turn):  # type: ignore[no-untyped-def]
    """Fit `PIXEL_LANES` pixels without missing samples, one round of :func:`_fit_pixel`.

    ``s`` has rows of `PIXEL_LANES` numbers: samples, variances, moments, largest sample. As one
    array with constant offsets it needs no test whether rows overlap.
    """
    for j in range(PIXEL_LANES):
        full = s[FULL * PIXEL_LANES + j]
        if noise_source == 2:
            top = s[_TOP + j]
            before = s[_FIT + C_0 * PIXEL_LANES + j]
            base = max(before, 0.0) if turn else top
            floor = 1e-6 * (read + gain * top) if top > 0.0 else max(read, 1e-30)
            s[_VARIANCE + FULL * PIXEL_LANES + j] = max(read + gain * base, floor)
            s[_VARIANCE + DARK * PIXEL_LANES + j] = max(read, floor)
            for axis in range(3):
                along = s[_FIT + (C_X + axis) * PIXEL_LANES + j] if turn else 0.0
                plus, minus = 0.5 * (base + along), 0.5 * (base - along)
                s[_VARIANCE + (1 + axis) * PIXEL_LANES + j] = max(read + gain * plus, floor)
                s[_VARIANCE + (4 + axis) * PIXEL_LANES + j] = max(read + gain * minus, floor)
        w = 1.0 / s[_VARIANCE + FULL * PIXEL_LANES + j]
        a00, a0b, abb = w, w, w
        g0, gb = w * full, w * full
        for axis in range(3):
            both = s[(1 + axis) * PIXEL_LANES + j] + s[(4 + axis) * PIXEL_LANES + j]
            vp, vm = (
                s[_VARIANCE + (1 + axis) * PIXEL_LANES + j],
                s[_VARIANCE + (4 + axis) * PIXEL_LANES + j],
            )
            w = 1.0 / (vp + vm)
            a00 += w
            a0b += 2.0 * w
            abb += 4.0 * w
            g0 += w * both
            gb += 2.0 * w * both
        v00, v0b, vbb = 1.0 / a00, 0.0, 0.0
        good = True
        below = s[DARK * PIXEL_LANES + j]
        per_dark = 1.0 / s[_VARIANCE + DARK * PIXEL_LANES + j]
        if dark:
            abb += per_dark
            gb += below * per_dark
            det = a00 * abb - a0b * a0b
            good = det > 1e-12 * a00 * abb
            v00, v0b, vbb = abb / det, -a0b / det, a00 / det
        c0 = v00 * g0 + v0b * gb
        b = v0b * g0 + vbb * gb
        r = full - b - c0
        misfit, chi = r * r, r * r / s[_VARIANCE + FULL * PIXEL_LANES + j]
        if dark:
            r = below - b
            misfit += r * r
            chi += r * r * per_dark
        if turn:  # what failed in the first round stays NaN
            good &= s[_FIT + C_0 * PIXEL_LANES + j] == s[_FIT + C_0 * PIXEL_LANES + j]
        qq = v00 + 4.0 * v0b + 4.0 * vbb
        t0 = t1 = t2 = 0.0
        for axis in range(3):
            plus, minus = s[(1 + axis) * PIXEL_LANES + j], s[(4 + axis) * PIXEL_LANES + j]
            vp, vm = (
                s[_VARIANCE + (1 + axis) * PIXEL_LANES + j],
                s[_VARIANCE + (4 + axis) * PIXEL_LANES + j],
            )
            per = 1.0 / (vp + vm)
            share = vm * per
            t = 2.0 * share - 1.0
            c = share * (2.0 * (plus - b) - c0) + (1.0 - share) * (c0 - 2.0 * (minus - b))
            r = plus + minus - 2.0 * b - c0
            misfit += 0.5 * r * r
            chi += r * r * per
            s[_FIT + (C_X + axis) * PIXEL_LANES + j] = c if good else np.nan
            s[_FIT + (V_XX + axis) * PIXEL_LANES + j] = 4.0 * vp * share + t * t * qq
            t0, t1, t2 = t1, t2, t
        s[_FIT + C_0 * PIXEL_LANES + j] = c0 if good else np.nan
        s[_FIT + V_0 * PIXEL_LANES + j] = v00
        s[_FIT + V_XY * PIXEL_LANES + j] = t0 * t1 * qq
        s[_FIT + V_XZ * PIXEL_LANES + j] = t0 * t2 * qq
        s[_FIT + V_YZ * PIXEL_LANES + j] = t1 * t2 * qq
        s[_FIT + CHI * PIXEL_LANES + j] = chi
        s[_FIT + MISFIT * PIXEL_LANES + j] = misfit


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_pixel(y, noise, gain, read, noise_source, dark, v, p, out):  # type: ignore[no-untyped-def]
    """Fit one pixel, any of whose samples may be missing; ``v`` (8,) is scratch."""
    for row in range(MOMENT_ROWS):
        out[row, p] = np.nan
    used = 0
    top = 0.0
    for k in range(8):
        if y[k, p] == y[k, p]:
            used += 1
            top = max(top, float(y[k, p]))
    out[USED, p] = used
    if noise_source == 1:
        for k in range(8):
            v[k] = noise[k, p]
    else:
        for k in range(8):
            v[k] = 1.0
    rounds = 2 if noise_source == 2 else 1
    for turn in range(rounds):
        if noise_source == 2:
            # signals of the previous fit: weights from the samples' own noise would be biased
            base = max(out[C_0, p], 0.0) if turn else top
            floor = 1e-6 * (read + gain * top) if top > 0.0 else max(read, 1e-30)
            for k in range(8):
                signal = base
                if k == DARK:
                    signal = 0.0
                elif k != FULL:
                    signal = 0.5 * base
                    if turn:
                        along = out[1 + (k - 1) % 3, p]
                        signal = 0.5 * (base + (along if k < 4 else -along))
                # no light and no read noise: still a variance
                v[k] = max(read + gain * signal, floor)
        # normal equations of (c_0, b)
        a00, a0b, abb, g0, gb = 0.0, 0.0, 0.0, 0.0, 0.0
        level = 0
        if y[FULL, p] == y[FULL, p]:
            w = 1.0 / v[FULL]
            a00 += w
            a0b += w
            abb += w
            g0 += w * y[FULL, p]
            gb += w * y[FULL, p]
            level += 1
        single = 0
        for axis in range(3):
            plus, minus = y[1 + axis, p], y[4 + axis, p]
            if plus == plus and minus == minus:
                w = 1.0 / (v[1 + axis] + v[4 + axis])
                a00 += w
                a0b += 2.0 * w
                abb += 4.0 * w
                g0 += w * (plus + minus)
                gb += 2.0 * w * (plus + minus)
                level += 1
            elif plus != plus and minus != minus:
                single = 9
        if dark and y[DARK, p] == y[DARK, p]:
            abb += 1.0 / v[DARK]
            gb += y[DARK, p] / v[DARK]
            level += 1
        if single or level < (2 if dark else 1):
            break
        if dark:
            det = a00 * abb - a0b * a0b
            if not det > 1e-12 * a00 * abb:
                break
            v00, v0b, vbb = abb / det, -a0b / det, a00 / det
        else:
            v00, v0b, vbb = 1.0 / a00, 0.0, 0.0
        c0 = v00 * g0 + v0b * gb
        b = v0b * g0 + vbb * gb
        # the gradients, given the light: slope t by it, conditional variance s
        misfit, chi = 0.0, 0.0
        if y[FULL, p] == y[FULL, p]:
            r = y[FULL, p] - b - c0
            misfit += r * r
            chi += r * r / v[FULL]
        if dark and y[DARK, p] == y[DARK, p]:
            r = y[DARK, p] - b
            misfit += r * r
            chi += r * r / v[DARK]
        qq = v00 + 4.0 * v0b + 4.0 * vbb
        t0, t1, t2 = 0.0, 0.0, 0.0
        for axis in range(3):
            plus, minus = y[1 + axis, p], y[4 + axis, p]
            vp, vm = v[1 + axis], v[4 + axis]
            if plus == plus and minus == minus:
                share = vm / (vp + vm)  # weight of the pattern, one less it the complement's
                t = 2.0 * share - 1.0
                s = 4.0 * vp * share
                c = share * (2.0 * (plus - b) - c0) + (1.0 - share) * (c0 - 2.0 * (minus - b))
                r = plus + minus - 2.0 * b - c0
                misfit += 0.5 * r * r
                chi += r * r / (vp + vm)
            elif plus == plus:
                t, s, c = 1.0, 4.0 * vp, 2.0 * (plus - b) - c0
            else:
                t, s, c = -1.0, 4.0 * vm, c0 - 2.0 * (minus - b)
            out[C_X + axis, p] = c
            out[V_XX + axis, p] = s + t * t * qq
            if axis == 0:
                t0 = t
            elif axis == 1:
                t1 = t
            else:
                t2 = t
        out[C_0, p] = c0
        out[V_0, p] = v00
        out[V_XY, p] = t0 * t1 * qq
        out[V_XZ, p] = t0 * t2 * qq
        out[V_YZ, p] = t1 * t2 * qq
        out[CHI, p] = chi
        out[MISFIT, p] = misfit
        out[FREE, p] = level - (2 if dark else 1)


@njit(error_model="numpy", forceinline=True)
def _copy_row(source, target):  # type: ignore[no-untyped-def]
    for j in range(source.size):
        target[j] = source[j]


@njit(error_model="numpy", forceinline=True)
def _note_sample(sample, needed, top, missing):  # type: ignore[no-untyped-def]
    """Raise the largest sample, and count the missing ones that are needed."""
    for j in range(sample.size):
        there = sample[j] == sample[j]
        top[j] = max(top[j], sample[j] if there else 0.0)
        missing[j] += 0.0 if there else needed


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_lanes(y, noise, noise_source, dark, start, count, s, missing):  # type: ignore[no-untyped-def]
    """Copy pixels to lanes, and count the missing samples of each."""
    missing[:] = 0.0
    top = s[_TOP : _TOP + count]
    top[:] = 0.0
    for k in range(8):
        row = s[k * PIXEL_LANES : k * PIXEL_LANES + count]
        _copy_row(y[k, start : start + count], row)
        _note_sample(row, 1.0 if dark or k != DARK else 0.0, top, missing)
        if noise_source == 1:
            first = _VARIANCE + k * PIXEL_LANES
            _copy_row(noise[k, start : start + count], s[first : first + count])


@njit(error_model="numpy", forceinline=True)
def _copy_known(source, known, target):  # type: ignore[no-untyped-def]
    for j in range(target.size):
        target[j] = source[j] if known[j] == known[j] else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def fit_moments(y, noise, gain, read, noise_source, dark, out):  # type: ignore[no-untyped-def]
    """Fit light, gradient and dark level to the patterns of one polarization, per pixel.

    Parameters
    ----------
    y : ndarray, shape (8, P)
        Samples; NaN where missing.
    noise : ndarray, shape (8, P)
        Variances; read only where `noise_source` is 1.
    gain, read : float
        Variance as ``read + gain * signal``; read only where `noise_source` is 2. With
        `noise_source` 0 all samples have equal weights, and variances are for a variance of 1.
    noise_source : int
    dark : bool
        Whether the dark level is unknown; else it is 0.
    out : ndarray, shape (MOMENT_ROWS, P)

    Notes
    -----
    With a dark level ``b``, the full light gives ``b + c_0``, a pattern and its complement
    ``b + (c_0 +- c_w) / 2``. Their sum is ``2 b + c_0`` and does not depend on ``c_w``; so two
    unknowns are fitted to at most five numbers, and each ``c_w`` then to at most two samples.
    Together this is the generalized least squares of all samples in closed form.
    """
    v, s = np.empty(8), np.ones(_LANE_NUMBERS)
    missing = np.empty(PIXEL_LANES)
    for start in range(0, y.shape[1], PIXEL_LANES):
        count = min(PIXEL_LANES, y.shape[1] - start)
        end = start + count
        _gather_lanes(y, noise, noise_source, dark, start, count, s, missing[:count])
        _fit_lanes(s, noise_source, gain, read, dark, False)
        if noise_source == 2:
            _fit_lanes(s, noise_source, gain, read, dark, True)
        first = _FIT + FREE * PIXEL_LANES
        s[first : first + count] = 3.0  # five sums and two unknowns, or without the dark 4 and 1
        known = s[_FIT + C_0 * PIXEL_LANES : _FIT + C_0 * PIXEL_LANES + count]
        for row in range(MOMENT_ROWS):
            first = _FIT + row * PIXEL_LANES
            _copy_known(s[first : first + count], known, out[row, start:end])
        for p in range(start, end):
            if missing[p - start] > 0.0:
                _fit_pixel(y, noise, gain, read, noise_source, dark, v, p, out)
            else:
                out[USED, p] = 8.0 if y[DARK, p] == y[DARK, p] else 7.0


@njit(cache=True, nogil=True, error_model="numpy")
def convolve_separable(image, taps, mask, out, line):  # type: ignore[no-untyped-def]
    """Convolve rows and columns of ``image * mask`` (H, W) by symmetric taps; 0 outside.

    `line` (H, W) is scratch; `taps` has the middle first.
    """
    height, width = image.shape
    reach = taps.size - 1
    for i in range(height):
        for j in range(width):
            line[i, j] = taps[0] * image[i, j] if mask[i, j] else image.dtype.type(0.0)
        for k in range(1, reach + 1):
            tap = taps[k]
            if i >= k:
                for j in range(width):
                    if mask[i - k, j]:
                        line[i, j] += tap * image[i - k, j]
            if i + k < height:
                for j in range(width):
                    if mask[i + k, j]:
                        line[i, j] += tap * image[i + k, j]
    for i in range(height):
        for j in range(width):
            out[i, j] = taps[0] * line[i, j]
        for k in range(1, reach + 1):
            tap = taps[k]
            for j in range(k, width):
                out[i, j] += tap * line[i, j - k]
            for j in range(width - k):
                out[i, j] += tap * line[i, j + k]
