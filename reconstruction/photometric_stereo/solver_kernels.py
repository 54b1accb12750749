"""Compute steps of one point's robust least squares (Numba)."""

from typing import Any, NamedTuple

from numba import njit


class RobustFitLimits(NamedTuple):
    """Limits of a robust fit, all in the data's type; see `estimation.Robustness`."""

    shadow: Any
    grazing: Any
    tuning: Any
    tolerance: Any
    floor: Any
    l1_soft: Any
    min_spread: Any
    bright_part: Any
    dark_sigmas: Any
    dark_fit: Any
    min_agreeing: Any
    few: Any
    tight: Any
    clear: Any
    loose: Any


# Reordered sums, but NaN and infinity keep their meaning.
FAST_MATH = {"reassoc", "contract", "nsz", "arcp"}

FINITE_MATH = FAST_MATH | {"nnan", "ninf"}  # where nothing but finite numbers can come

NORMAL_MAD = 0.6744897501960817  # median of |x| of the unit normal distribution

_N_BISECTIONS = 10


@njit(fastmath=FAST_MATH, error_model="numpy", inline="always")
def _solve(a, g):  # type: ignore[no-untyped-def]
    """Solve the symmetric system a = (xx, xy, xz, yy, yz, zz), g, in float64; singular gives 0."""
    xx, xy, xz, yy, yz, zz = a
    cxx = yy * zz - yz * yz
    cxy = xz * yz - xy * zz
    cxz = xy * yz - xz * yy
    det = xx * cxx + xy * cxy + xz * cxz
    trace = xx + yy + zz
    if not det > 1e-18 * trace * trace * trace:
        return 0.0, 0.0, 0.0
    cyy = xx * zz - xz * xz
    cyz = xy * xz - xx * yz
    czz = xx * yy - xy * xy
    one = 1.0 / det
    return (
        one * (cxx * g[0] + cxy * g[1] + cxz * g[2]),
        one * (cxy * g[0] + cyy * g[1] + cyz * g[2]),
        one * (cxz * g[0] + cyz * g[1] + czz * g[2]),
    )


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def step_l1(x, y, z, v, m, b0, b1, b2, soft):  # type: ignore[no-untyped-def]
    """Return the Newton step of sum m |r| with |r| smoothed below ``soft``."""
    zero = x.dtype.type(0.0)
    xx, xy, xz, yy, yz, zz, gx, gy, gz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(x.size):
        xk, yk, zk = x[k], y[k], z[k]
        r = v[k] - (xk * b0 + yk * b1 + zk * b2)
        w = m[k] / max(abs(r), soft)
        wx, wy, wz = w * xk, w * yk, w * zk
        xx += wx * xk
        xy += wx * yk
        xz += wx * zk
        yy += wy * yk
        yz += wy * zk
        zz += wz * zk
        gx += wx * r
        gy += wy * r
        gz += wz * r
    a = (float(xx), float(xy), float(xz), float(yy), float(yz), float(zz))
    return _solve(a, (float(gx), float(gy), float(gz)))


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def step_squares(x, y, z, v, m, b0, b1, b2):  # type: ignore[no-untyped-def]
    """Return the step to the least squares of the samples chosen by m."""
    zero = x.dtype.type(0.0)
    xx, xy, xz, yy, yz, zz, gx, gy, gz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(x.size):
        xk, yk, zk = x[k], y[k], z[k]
        r = v[k] - (xk * b0 + yk * b1 + zk * b2)
        wx, wy, wz = m[k] * xk, m[k] * yk, m[k] * zk
        xx += wx * xk
        xy += wx * yk
        xz += wx * zk
        yy += wy * yk
        yz += wy * zk
        zz += wz * zk
        gx += wx * r
        gy += wy * r
        gz += wz * r
    a = (float(xx), float(xy), float(xz), float(yy), float(yz), float(zz))
    return _solve(a, (float(gx), float(gy), float(gz)))


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def step_biweight(x, y, z, v, s, b0, b1, b2, per_reach2, min_shading):  # type: ignore[no-untyped-def]
    """Return the step of Tukey's biweight over the samples that the fitted normal faces."""
    zero, one = x.dtype.type(0.0), x.dtype.type(1.0)
    xx, xy, xz, yy, yz, zz, gx, gy, gz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(x.size):
        xk, yk, zk = x[k], y[k], z[k]
        fit = xk * b0 + yk * b1 + zk * b2
        r = v[k] - fit
        t = max(one - r * r * per_reach2, zero)
        w = t * t if fit > min_shading * s[k] else zero
        wx, wy, wz = w * xk, w * yk, w * zk
        xx += wx * xk
        xy += wx * yk
        xz += wx * zk
        yy += wy * yk
        yz += wy * zk
        zz += wz * zk
        gx += wx * r
        gy += wy * r
        gz += wz * r
    a = (float(xx), float(xy), float(xz), float(yy), float(yz), float(zz))
    return _solve(a, (float(gx), float(gy), float(gz)))


@njit(fastmath=FINITE_MATH, error_model="numpy", forceinline=True)
def kth_largest(q, rank):  # type: ignore[no-untyped-def]
    """Return an upper approximation of the rank-th largest of the values above 0."""
    zero, one = q.dtype.type(0.0), q.dtype.type(1.0)
    top = total = zero
    for k in range(q.size):
        top = max(top, q[k])
        total += max(q[k], zero)
    low, high = zero, min(top, total / q.dtype.type(rank))
    half = q.dtype.type(0.5)
    for _ in range(_N_BISECTIONS):
        middle = half * (low + high)
        count = zero
        for k in range(q.size):
            count += one if q[k] > middle else zero
        if count >= rank:
            low = middle
        else:
            high = middle
    return high


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def fill_residuals(x, y, z, v, s, m, b0, b1, b2, min_shading, q):  # type: ignore[no-untyped-def]
    """Write |r| of lit samples to q, -1 for others; return their number.

    Lit are samples that are not dark and that the fitted normal faces.
    """
    zero, one = x.dtype.type(0.0), x.dtype.type(1.0)
    count = zero
    for k in range(x.size):
        fit = x[k] * b0 + y[k] * b1 + z[k] * b2
        lit = (fit > min_shading * s[k]) & (m[k] > zero)
        q[k] = abs(v[k] - fit) if lit else -one
        count += one if lit else zero
    return int(count)


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def residual_scale(q, count):  # type: ignore[no-untyped-def]
    """Return the scale of residuals: their median without the three that any fit makes 0."""
    if count < 4:
        return q.dtype.type(0.0)
    rank = count - (3 + (count - 3 + 1) // 2) + 1  # from the largest
    # few residuals: Rousseeuw and Leroy (1987), chapter 5, eq. (1.3)
    return kth_largest(q, rank) / q.dtype.type(NORMAL_MAD) * q.dtype.type(1.0 + 5.0 / (count - 3))


@njit(error_model="numpy", forceinline=True)
def fit_intensity_weighted(x, y, z, v, s, e, q, m):  # type: ignore[no-untyped-def]
    """Return least squares with each sample weighted by the square of its intensity.

    Leaves the weights' roots in e, intensities in q and the weights in m.
    """
    zero, one = x.dtype.type(0.0), x.dtype.type(1.0)
    top = zero
    for k in range(x.size):
        q[k] = v[k] / s[k] if s[k] > zero else zero
        top = max(top, q[k])
    for k in range(x.size):
        e[k] = min(max(q[k], zero) / top, one)
        m[k] = e[k] * e[k]
    b0, b1, b2 = zero, zero, zero
    for _ in range(2):  # the second step refines the digits of the first
        d0, d1, d2 = step_squares(x, y, z, v, m, b0, b1, b2)
        b0, b1, b2 = x.dtype.type(b0 + d0), x.dtype.type(b1 + d1), x.dtype.type(b2 + d2)
    return b0, b1, b2
