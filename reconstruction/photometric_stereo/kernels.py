"""Fit one robust linear model per point, vectorized over its lights (Numba).

`reconstruction.photometric_stereo` is the entry point. A kernel is serial and releases the lock:
of points are mapped over threads. All reals have the type of the data (float32 or float64).
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, njit, types, void

from reconstruction.photometric_stereo.solver_kernels import (
    FAST_MATH,
    RobustFitLimits,
    fill_residuals,
    fit_intensity_weighted,
    kth_largest,
    residual_scale,
    step_biweight,
    step_l1,
    step_squares,
)

BLOCK_POINTS = 32
"""Points gathered at once: rows of a stack are read in whole cache lines."""
LIGHT_LANES = 32
"""Lights are padded to a multiple with samples of weight 0, for vector loops without remainder."""
SHARED, PER_POINT, NEAR = 0, 1, 2
"""Forms of light vectors: one per light, one per light and point, or positions."""

# Rows of the table of results.
NX, NY, NZ, ALBEDO, RESIDUAL, STDERR, STDERR_ALBEDO, USED, SCALE = range(9)
RESULT_ROWS = 9

TUKEY_EFFICIENCY = 0.95  # of the biweight with c = 4.685 at the normal distribution
MAX_STDERR_RAD = 0.5
"""Relative standard error above which a signal is lost in its noise."""


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _moments(x, y, z, v, s, e, m, b0, b1, b2, per_reach2, least, sums):  # type: ignore[no-untyped-def]
    """Sum the moments for standard errors over weighted samples; return their number."""
    zero, one, five = x.dtype.type(0.0), x.dtype.type(1.0), x.dtype.type(5.0)
    xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero
    dxx, dxy, dxz, dyy, dyz, dzz = zero, zero, zero, zero, zero, zero
    txx, txy, txz, tyy, tyz, tzz = zero, zero, zero, zero, zero, zero
    used, bright, agrees = zero, zero, zero
    psi2, slope, slope2, raw2, e2 = zero, zero, zero, zero, zero
    for k in range(x.size):
        xk, yk, zk, sk = x[k], y[k], z[k], s[k]
        fit = xk * b0 + yk * b1 + zk * b2
        r = v[k] - fit
        t = one - r * r * per_reach2
        lit = (sk > zero) & (fit > least * sk) & (t > zero)
        w = one if lit else zero
        bright += m[k]
        agrees += m[k] * w
        # unit directions, without strength
        per = w / (sk * sk if lit else one)
        wx, wy, wz = w * xk, w * yk, w * zk
        xx += wx * xk
        xy += wx * yk
        xz += wx * zk
        yy += wy * yk
        yz += wy * zk
        zz += wz * zk
        t2 = e[k] * e[k]
        txx += t2 * wx * xk
        txy += t2 * wx * yk
        txz += t2 * wx * zk
        tyy += t2 * wy * yk
        tyz += t2 * wy * zk
        tzz += t2 * wz * zk
        e2 += t2 * w
        px, py, pz = per * xk, per * yk, per * zk
        dxx += px * xk
        dxy += px * yk
        dxz += px * zk
        dyy += py * yk
        dyz += py * zk
        dzz += pz * zk
        used += w
        psi = w * r * t * t
        bend = w * t * (five * t - (five - one))
        psi2 += psi * psi
        slope += bend
        slope2 += bend * bend
        raw2 += per * r * r
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = xx, xy, xz, yy, yz, zz
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = dxx, dxy, dxz, dyy, dyz, dzz
    sums[12], sums[13], sums[14], sums[15], sums[16] = psi2, slope, slope2, raw2, e2
    sums[23], sums[24] = bright, agrees
    sums[17], sums[18], sums[19], sums[20], sums[21], sums[22] = txx, txy, txz, tyy, tyz, tzz
    return int(used)


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(  # type: ignore[no-untyped-def]
    x, y, z, v, s, e, m, b0, b1, b2, scale, above, known, robust, settings, sums, out
):
    """Write normal, albedo, residual and standard errors of one point; False without a fit."""
    kind = x.dtype.type
    length = math.sqrt(float(b0) * b0 + float(b1) * b1 + float(b2) * b2)
    if not (length > 0.0 and length < math.inf):
        return False
    least = max(settings.grazing * kind(length), above) if robust else -kind(math.inf)
    reach = settings.tuning * scale
    per_reach2 = kind(1.0) / (reach * reach) if robust and reach > kind(0.0) else kind(0.0)
    used = _moments(x, y, z, v, s, e, m, b0, b1, b2, per_reach2, least, sums)
    if used < 3 or (robust and sums[24] < float(settings.min_agreeing) * sums[23]):
        return False
    xx, xy, xz, yy, yz, zz = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    dxx, dxy, dxz, dyy, dyz, dzz = sums[6], sums[7], sums[8], sums[9], sums[10], sums[11]
    psi2, slope, slope2, raw2, e2 = sums[12], sums[13], sums[14], sums[15], sums[16]
    txx, txy, txz, tyy, tyz, tzz = sums[17], sums[18], sums[19], sums[20], sums[21], sums[22]
    # the least eigenvalue of the directions used, over their trace (which is their number)
    minors = dxx * dyy - dxy * dxy + dxx * dzz - dxz * dxz + dyy * dzz - dyz * dyz
    det = (
        dxx * (dyy * dzz - dyz * dyz)
        - dxy * (dxy * dzz - dyz * dxz)
        + dxz * (dxy * dyz - dyy * dxz)
    )
    if not det > float(settings.min_spread) * minors * used:
        return False
    nx, ny, nz = b0 / length, b1 / length, b2 / length
    free = used - 3
    # Huber (1981), section 7.6: covariance of an M-estimate of regression, K^2 E psi^2 / (E psi')^2
    # times (X'X)^-1, with K = 1 + (p / n) var(psi') / (E psi')^2 and p = 3 parameters
    variance = math.inf
    if free > 0 and slope > 0.0:
        mean = slope / used
        spread = max(slope2 / used - mean * mean, 0.0)
        correction = 1.0 + 3.0 / used * spread / (mean * mean)
        variance = psi2 * used / (e2 * free) / (mean * mean) * correction * correction
    if known:
        least_variance = 1.0 / TUKEY_EFFICIENCY if robust else 1.0
        # misfit beyond chance (3 sigma of a chi square) widens the errors
        beyond = least_variance * (1.0 + 3.0 * math.sqrt(2.0 / max(free, 1)))
        if free == 0 or not variance > beyond:
            variance = least_variance
    cxx, cyy, czz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    cxy, cxz, cyz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    full = xx * cxx + xy * cxy + xz * cxz
    if not full > 0.0:
        return False
    # sandwich C T C, as the weights are not the samples' inverse variances
    hxx, hxy, hxz = (
        cxx * txx + cxy * txy + cxz * txz,
        cxx * txy + cxy * tyy + cxz * tyz,
        cxx * txz + cxy * tyz + cxz * tzz,
    )
    hyx, hyy, hyz = (
        cxy * txx + cyy * txy + cyz * txz,
        cxy * txy + cyy * tyy + cyz * tyz,
        cxy * txz + cyy * tyz + cyz * tzz,
    )
    hzx, hzy, hzz = (
        cxz * txx + cyz * txy + czz * txz,
        cxz * txy + cyz * tyy + czz * tyz,
        cxz * txz + cyz * tyz + czz * tzz,
    )
    vxx = hxx * cxx + hxy * cxy + hxz * cxz
    vxy = hxx * cxy + hxy * cyy + hxz * cyz
    vxz = hxx * cxz + hxy * cyz + hxz * czz
    vyy = hyx * cxy + hyy * cyy + hyz * cyz
    vyz = hyx * cxz + hyy * cyz + hyz * czz
    vzz = hzx * cxz + hzy * cyz + hzz * czz
    along = (
        nx * (vxx * nx + 2.0 * (vxy * ny + vxz * nz))
        + ny * (vyy * ny + 2.0 * vyz * nz)
        + nz * vzz * nz
    ) / (full * full)
    across = max((vxx + vyy + vzz) / (full * full) - along, 0.0)
    angle, error = math.pi, math.inf
    if variance < math.inf:
        angle = math.sqrt(variance * across) / length
        error = math.sqrt(variance * max(along, 0.0))
        if angle > MAX_STDERR_RAD:
            return False
    elif free > 0:
        return False
    out[NX], out[NY], out[NZ] = nx, ny, nz
    out[ALBEDO] = length
    out[RESIDUAL] = math.sqrt(raw2 / used)
    out[STDERR] = angle
    out[STDERR_ALBEDO] = error
    out[USED] = used
    out[SCALE] = scale
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _count_outliers(x, y, z, s, q, b0, b1, b2, bright, clear):  # type: ignore[no-untyped-def]
    """Count samples off a fit by more than a part of a bright one; less counts as its square.

    Dark samples, which shadows are, count by their brightness.
    """
    zero, one = x.dtype.type(0.0), x.dtype.type(1.0)
    total = zero
    for k in range(x.size):
        if s[k] > zero:
            fit = max((x[k] * b0 + y[k] * b1 + z[k] * b2) / s[k], zero)
            r = min(max(q[k] / bright, zero), one) * (q[k] - fit) / (clear * bright)
            total += min(r * r, one)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_point(  # type: ignore[no-untyped-def]
    x, y, z, v, s, e, q, m, robust, known, l1_steps, steps, settings, sums, out
):
    """Fit one point: v = x b0 + y b1 + z b2 on samples with s > 0."""
    kind = x.dtype.type
    zero, one = kind(0.0), kind(1.0)
    b0 = b1 = b2 = zero
    n = 0
    for k in range(x.size):
        usable = s[k] > zero
        m[k] = one if usable else zero
        n += 1 if usable else 0
    if n < 3:
        return False
    # lit samples: those above a part of a bright one, which is not the brightest for highlights
    total = zero
    for k in range(x.size):
        q[k] = v[k] / s[k] if m[k] > zero else -one
        e[k] = one
    rank = min(n, max(4, int(n * settings.bright_part))) if robust else 1
    bright = kth_largest(q, rank)
    if not bright > zero:
        return False
    if not known and not robust:
        # neither variances nor a robust fit: intensity is the only measure of a sample's quality
        for k in range(x.size):
            e[k] = min(max(q[k], zero) / bright, one)
            x[k], y[k], z[k] = x[k] * e[k], y[k] * e[k], z[k] * e[k]
            v[k], s[k] = v[k] * e[k], s[k] * e[k]
    if not robust:
        for _ in range(2):  # the second step refines the digits of the first
            d0, d1, d2 = step_squares(x, y, z, v, m, b0, b1, b2)
            b0, b1, b2 = kind(b0 + d0), kind(b1 + d1), kind(b2 + d2)
        return _finish(
            x, y, z, v, s, e, m, b0, b1, b2, one, zero, known, False, settings, sums, out
        )
    dark = settings.shadow * bright
    # samples below zero are noise around a shadow, with an equal part above zero
    below, negative = 0, zero
    for k in range(x.size):
        if m[k] > zero and q[k] < zero:
            below += 1
            negative += q[k] * q[k]
    if below > 0:
        dark = max(dark, settings.dark_sigmas * kind(math.sqrt(negative / kind(below))))
    lit = 0
    for k in range(x.size):
        m[k] = one if q[k] > dark else zero
        total += s[k] * m[k]
        lit += 1 if q[k] > dark else 0
    if lit < 3:
        return False
    soft = settings.l1_soft * bright * total / kind(lit)
    if known:
        soft = max(soft, one)
    d0, d1, d2 = step_squares(x, y, z, v, m, b0, b1, b2)
    b0, b1, b2 = kind(d0), kind(d1), kind(d2)
    near = settings.tolerance * settings.tolerance
    for _ in range(l1_steps):
        d0, d1, d2 = step_l1(x, y, z, v, m, b0, b1, b2, soft)
        b0, b1, b2 = kind(b0 + d0), kind(b1 + d1), kind(b2 + d2)
        if d0 * d0 + d1 * d1 + d2 * d2 < near * (b0 * b0 + b1 * b1 + b2 * b2):
            break
    floor = settings.floor * bright * total / kind(lit)
    if known:
        floor = max(floor, one)
    # samples near the dark that face away from the fitted normal may be shadows as well
    above = settings.dark_fit * dark
    scale = one
    for step in range(steps):
        length = kind(math.sqrt(b0 * b0 + b1 * b1 + b2 * b2))
        least = max(settings.grazing * length, above)
        if step % 2 == 0 and step < 4:
            count = fill_residuals(x, y, z, v, s, m, b0, b1, b2, least, q)
            scale = max(residual_scale(q, count), floor)
        per_reach = one / (settings.tuning * scale)
        d0, d1, d2 = step_biweight(x, y, z, v, s, b0, b1, b2, per_reach * per_reach, least)
        b0, b1, b2 = kind(b0 + d0), kind(b1 + d1), kind(b2 + d2)
        if step > 2 and d0 * d0 + d1 * d1 + d2 * d2 < near * (b0 * b0 + b1 * b1 + b2 * b2):
            break
    done = _finish(x, y, z, v, s, e, m, b0, b1, b2, scale, above, known, True, settings, sums, out)
    loose = scale * kind(lit) / (bright * total)
    if known or not done or n >= settings.few or loose <= settings.tight:
        return done
    # few samples, and the residuals exceed the deviations of real surfaces from Lambert's law: an
    # apparent outlier may be chance, unless it is a clear one; more so the larger the residuals
    p0, p1, p2 = fit_intensity_weighted(x, y, z, v, s, e, q, m)
    clear = settings.clear
    gained = _count_outliers(x, y, z, s, q, p0, p1, p2, bright, clear)
    gained -= _count_outliers(x, y, z, s, q, b0, b1, b2, bright, clear)
    if gained > one + loose / settings.loose:
        return done
    for k in range(x.size):
        m[k] = one if s[k] > zero else zero
        x[k], y[k], z[k] = x[k] * e[k], y[k] * e[k], z[k] * e[k]
        v[k], s[k] = v[k] * e[k], s[k] * e[k]
    return _finish(x, y, z, v, s, e, m, p0, p1, p2, one, zero, known, False, settings, sums, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(samples, start, size, known, v, s):  # type: ignore[no-untyped-def]
    """Write samples and strengths of a block of points in units of noise; 0 for unusable ones."""
    intensity, variance, usable, strength = samples
    kind = v.dtype.type
    zero, one = kind(0.0), kind(1.0)
    for k in range(intensity.shape[0]):
        for p in range(size):
            value = kind(intensity[k, start + p])
            power = kind(strength[k, start + p])
            good = usable[k, start + p] and value - value == zero
            good = good and power > zero and power - power == zero
            weight = one
            if known:
                noise = kind(variance[k, start + p])
                good = good and noise > zero and noise - noise == zero
                if good:
                    weight = one / math.sqrt(noise)
            v[p, k] = value * weight if good else zero
            s[p, k] = power * weight if good else zero


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_light_vectors(geometry, way, lights, position, v, s, x, y, z):  # type: ignore[no-untyped-def]
    """Write one point's light vectors, as long as their strength; drop lights without one."""
    directions, per_point, positions, points = geometry
    kind = v.dtype.type
    zero = kind(0.0)
    for k in range(lights):
        if way == SHARED:
            x[k] = directions[k, 0] * s[k]
            y[k] = directions[k, 1] * s[k]
            z[k] = directions[k, 2] * s[k]
            continue
        if way == PER_POINT:
            x[k] = kind(per_point[k, position, 0])
            y[k] = kind(per_point[k, position, 1])
            z[k] = kind(per_point[k, position, 2])
            length = x[k] * x[k] + y[k] * y[k] + z[k] * z[k]
            there = length > kind(0.25) and length < kind(4.0)
        else:
            x[k] = positions[k, 0] - points[position, 0]
            y[k] = positions[k, 1] - points[position, 1]
            z[k] = positions[k, 2] - points[position, 2]
            length = x[k] * x[k] + y[k] * y[k] + z[k] * z[k]
            there = length > zero and length - length == zero
            if there:
                s[k] = s[k] / length
        if there:
            scale = s[k] / kind(math.sqrt(length))
            x[k], y[k], z[k] = x[k] * scale, y[k] * scale, z[k] * scale
        else:  # no direction: an occluded light
            x[k], y[k], z[k], v[k], s[k] = zero, zero, zero, zero, zero


def _fit_points(  # type: ignore[no-untyped-def]
    samples, geometry, way, robust, known, l1_steps, steps, settings, out, valid
):
    """Fit many points.

    Parameters
    ----------
    samples
        Intensity, variance, usable and strength, (N, P); any layout, broadcast views too.
    geometry
        Directions (N, 3), unit vectors, read when ``way`` is `SHARED`; directions (N, P, 3), unit
        vectors, read when it is `PER_POINT`; positions (N, 3) and points (P, 3), mm, read when it
        is `NEAR`, where strength falls as 1 / d^2.
    settings
        Numbers in the data's type.
    out, valid
        (P, RESULT_ROWS) and (P,), written.
    """
    lights, count = samples[0].shape
    lanes = (lights + LIGHT_LANES - 1) // LIGHT_LANES * LIGHT_LANES
    v = np.zeros((BLOCK_POINTS, lanes), out.dtype)
    s = np.zeros((BLOCK_POINTS, lanes), out.dtype)
    x, y, z = np.zeros(lanes, out.dtype), np.zeros(lanes, out.dtype), np.zeros(lanes, out.dtype)
    q, m, e = np.zeros(lanes, out.dtype), np.zeros(lanes, out.dtype), np.zeros(lanes, out.dtype)
    sums = np.empty(25, np.float64)
    for start in range(0, count, BLOCK_POINTS):
        size = min(BLOCK_POINTS, count - start)
        _gather(samples, start, size, known, v, s)
        for p in range(size):
            place = start + p
            _fill_light_vectors(geometry, way, lights, place, v[p], s[p], x, y, z)
            out[place] = out.dtype.type(0.0)
            valid[place] = _fit_point(
                x,
                y,
                z,
                v[p],
                s[p],
                e,
                q,
                m,
                robust,
                known,
                l1_steps,
                steps,
                settings,
                sums,
                out[place],
            )


@cache
def fit_points(kind: type[np.floating]) -> Any:
    """Return the kernel for float32 or float64: compiled once, whatever the arrays' layouts."""
    real = float32 if kind is np.float32 else float64

    def given(dtype: Any, axes: int) -> Any:
        return types.Array(dtype, axes, "A", readonly=True)

    samples = types.Tuple([given(real, 2), given(real, 2), given(boolean, 2), given(real, 2)])
    geometry = types.Tuple([real[:, ::1], given(real, 3), real[:, ::1], given(real, 2)])
    limits = types.NamedUniTuple(real, len(RobustFitLimits._fields), RobustFitLimits)
    counts = (int64, boolean, boolean, int64, int64)
    signature = void(samples, geometry, *counts, limits, real[:, ::1], boolean[::1])
    return njit(signature, cache=True, nogil=True, error_model="numpy")(_fit_points)
