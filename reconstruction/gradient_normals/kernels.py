"""Invert moments of the lights to normals, per pixel (Numba).

Every kernel is serial and releases the interpreter, for tiles of rows on threads.
"""

import math

import numpy as np
from numba import njit

from reconstruction.gradient_normals.moment_kernels import (
    C_0,
    C_X,
    V_0,
    V_XX,
    V_XY,
    V_XZ,
    V_YY,
    V_YZ,
    V_ZZ,
)

# Columns of the normals.
N_X, N_Y, N_Z, ALBEDO, STDERR, STDERR_ALBEDO, CONCENTRATION, CONCENTRATION_SEEN, STATUS = range(9)
NORMAL_COLUMNS = 9
GOOD, DIM, LOST, HORIZON = 0.0, 1.0, 2.0, 3.0
"""Status: a normal; signal within its noise; too few samples; no normal has the observed vector."""

_MAX_PASSES = 24
_STEPS_BACK = 8
_MAX_POSITION_ERROR = 2e-3  # distance between the observed position and that of the normal found
_COARSE_TOL = 2e-3
_MAX_MOMENT_CHANGE = (
    1e-2  # relative changes of the moment vector by the polarization of diffuse light
)
_N_EXACT_ROTATIONS = 8
_STEEP, _UNLIKE = 0.866, 0.03
_MIN_FACING = 0.1  # cosine to the view, which tables end at


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _cell(min_coordinate, step, size, u):  # type: ignore[no-untyped-def]
    """Return the first of the four grid lines about a position, and the position between them."""
    q = (u - min_coordinate) / step
    i = min(max(math.floor(q), 1), size - 3)
    return i - 1, q - i


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _weights(f):  # type: ignore[no-untyped-def]
    """Return the weights of four cubic B-splines."""
    e = 1.0 - f
    a, d = e * e * e / 6.0, f * f * f / 6.0
    b = (4.0 - 6.0 * f * f + 3.0 * f * f * f) / 6.0
    return a, b, 1.0 - a - b - d, d


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _slopes(f):  # type: ignore[no-untyped-def]
    """Return the derivatives of :func:`_weights`."""
    e = 1.0 - f
    a, d = -0.5 * e * e, 0.5 * f * f
    b = 1.5 * f * f - 2.0 * f
    return a, b, -a - b - d, d


@njit(cache=True, nogil=True, error_model="numpy")
def lookup(table, min_coordinate, step, u0, u1, x, y):  # type: ignore[no-untyped-def]
    """Return the observed position of a normal at (u0, u1), from (x, y), and its derivatives.

    In the order v0, v1, dv0/du0, dv0/du1, dv1/du0, dv1/du1.
    """
    i0, f = _cell(min_coordinate, step, table.shape[0], u0)
    i1, g = _cell(min_coordinate, step, table.shape[0], u1)
    a0, a1, a2, a3 = _weights(f)
    d0, d1, d2, d3 = _slopes(f)
    wy, dy = _weights(g), _slopes(g)
    near = table.shape[2] > 7
    v0, v1, j00, j01, j10, j11 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(4):
        row = table[i1 + m]
        p0, p1, p2, p3 = row[i0, 0], row[i0 + 1, 0], row[i0 + 2, 0], row[i0 + 3, 0]
        q0, q1, q2, q3 = row[i0, 1], row[i0 + 1, 1], row[i0 + 2, 1], row[i0 + 3, 1]
        if near:
            p0 += x * row[i0, 7] + y * row[i0, 9]
            p1 += x * row[i0 + 1, 7] + y * row[i0 + 1, 9]
            p2 += x * row[i0 + 2, 7] + y * row[i0 + 2, 9]
            p3 += x * row[i0 + 3, 7] + y * row[i0 + 3, 9]
            q0 += x * row[i0, 8] + y * row[i0, 10]
            q1 += x * row[i0 + 1, 8] + y * row[i0 + 1, 10]
            q2 += x * row[i0 + 2, 8] + y * row[i0 + 2, 10]
            q3 += x * row[i0 + 3, 8] + y * row[i0 + 3, 10]
        along = a0 * p0 + a1 * p1 + a2 * p2 + a3 * p3
        w, d = wy[m], dy[m]
        v0 += w * along
        j01 += d * along
        j00 += w * (d0 * p0 + d1 * p1 + d2 * p2 + d3 * p3)
        along = a0 * q0 + a1 * q1 + a2 * q2 + a3 * q3
        v1 += w * along
        j11 += d * along
        j10 += w * (d0 * q0 + d1 * q1 + d2 * q2 + d3 * q3)
    return u0 + v0, u1 + v1, 1.0 + j00 / step, j01 / step, j10 / step, 1.0 + j11 / step


@njit(cache=True, nogil=True, error_model="numpy")
def _interpolate_covariance(table, min_coordinate, step, u0, u1, covariance):  # type: ignore[no-untyped-def]
    """Write scale, concentration and systematic covariance (3) at a position to ``covariance``."""
    i0, f = _cell(min_coordinate, step, table.shape[0], u0)
    i1, g = _cell(min_coordinate, step, table.shape[0], u1)
    wx, wy = _weights(f), _weights(g)
    covariance[:] = 0.0
    for m in range(4):
        for n in range(4):
            w = wy[m] * wx[n]
            for k in range(5):
                covariance[k] += w * table[i1 + m, i0 + n, 2 + k]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_newton(table, min_coordinate, step, s0, s1, u0, u1, x, y, close):  # type: ignore[no-untyped-def]
    """Find the position whose normal is observed at (s0, s1), by Newton's method from (u0, u1).

    Return the position, the remaining residual, and the derivatives there.
    """
    v0, v1, j00, j01, j10, j11 = lookup(table, min_coordinate, step, u0, u1, x, y)
    e0, e1 = s0 - v0, s1 - v1
    off = math.sqrt(e0 * e0 + e1 * e1)
    for _ in range(_MAX_PASSES):
        if off < close:
            break
        det = j00 * j11 - j01 * j10
        # where the table folds, the Jacobian is near singular: take the identity for it
        d0 = (j11 * e0 - j01 * e1) / det if det > 0.02 else e0
        d1 = (j00 * e1 - j10 * e0) / det if det > 0.02 else e1
        stride = math.sqrt(d0 * d0 + d1 * d1)
        if stride > 0.3:
            d0, d1 = 0.3 * d0 / stride, 0.3 * d1 / stride
        part, better = 1.0, False
        for _ in range(_STEPS_BACK):
            t0, t1 = u0 + part * d0, u1 + part * d1
            if t0 * t0 + t1 * t1 < 2.0 * (1.0 - _MIN_FACING):
                v0, v1, k00, k01, k10, k11 = lookup(table, min_coordinate, step, t0, t1, x, y)
                f0, f1 = s0 - v0, s1 - v1
                now = math.sqrt(f0 * f0 + f1 * f1)
                if now < off:
                    u0, u1, e0, e1, off, better = t0, t1, f0, f1, now, True
                    j00, j01, j10, j11 = k00, k01, k10, k11
                    break
            part *= 0.5
        if not better:
            break
    return u0, u1, off, j00, j01, j10, j11


@njit(cache=True, nogil=True, error_model="numpy")
def fill_start_grid(table, min_coordinate, step, out):  # type: ignore[no-untyped-def]
    """Write the inverse of the table on a coarse grid to ``out`` (G, G, 2), as Newton's starts.

    The grid covers -sqrt(2) to sqrt(2); an observed position without a normal is its own start.
    """
    size = out.shape[0]
    reach = math.sqrt(2.0)
    for i in range(size):
        s1 = reach * (2.0 * i / (size - 1) - 1.0)
        for j in range(size):
            s0 = reach * (2.0 * j / (size - 1) - 1.0)
            out[i, j, 0], out[i, j, 1] = s0, s1
            if s0 * s0 + s1 * s1 < 2.0 * (1.0 - _MIN_FACING):
                u0, u1, off, _, _, _, _ = _solve_newton(
                    table, min_coordinate, step, s0, s1, s0, s1, 0.0, 0.0, 1e-6
                )
                if off < _MAX_POSITION_ERROR:
                    out[i, j, 0], out[i, j, 1] = u0, u1


@njit(cache=True, nogil=True, error_model="numpy")
def _start(grid, s0, s1):  # type: ignore[no-untyped-def]
    """Return the start of the search, by the bilinear grid of :func:`fill_start_grid`."""
    size = grid.shape[0]
    scale = (size - 1) / (2.0 * math.sqrt(2.0))
    q0, q1 = (s0 + math.sqrt(2.0)) * scale, (s1 + math.sqrt(2.0)) * scale
    i0, i1 = min(max(math.floor(q0), 0), size - 2), min(max(math.floor(q1), 0), size - 2)
    f, g = q0 - i0, q1 - i1
    a, b = (1.0 - f) * (1.0 - g), f * (1.0 - g)
    c, d = (1.0 - f) * g, f * g
    u0 = a * grid[i1, i0, 0] + b * grid[i1, i0 + 1, 0]
    u0 += c * grid[i1 + 1, i0, 0] + d * grid[i1 + 1, i0 + 1, 0]
    u1 = a * grid[i1, i0, 1] + b * grid[i1, i0 + 1, 1]
    u1 += c * grid[i1 + 1, i0, 1] + d * grid[i1 + 1, i0 + 1, 1]
    return u0, u1


@njit(cache=True, nogil=True, error_model="numpy")
def _exit_ratio(nx, ny, nz, a0, a1, eta):  # type: ignore[no-untyped-def]
    """Return the excess of diffuse light through the parallel over the crossed analyzer.

    Unpolarized inside, refracted on its way out; the normal and the analyzer's axis (a0, a1) are
    in the frame of the view.
    """
    flat = nx * nx + ny * ny
    if flat < 1e-12:
        return 1.0
    inside = math.sqrt(1.0 - flat / (eta * eta))
    r_s = (nz - eta * inside) / (nz + eta * inside)
    r_p = (eta * nz - inside) / (eta * nz + inside)
    t_s, t_p = 1.0 - r_s * r_s, 1.0 - r_p * r_p
    # s lies across the normal's azimuth
    across = (a1 * nx - a0 * ny) ** 2 / (flat * (a0 * a0 + a1 * a1))
    return (t_s * across + t_p * (1.0 - across)) / (t_s * (1.0 - across) + t_p * across)


@njit(cache=True, nogil=True, error_model="numpy")
def invert(  # type: ignore[no-untyped-def]
    parallel,
    crossed,
    frame,
    mirror,
    table,
    min_coordinate,
    step,
    grid,
    analyzer,
    eta,
    view,
    position,
    has_noise,
    needed,
    close,
    out,
):
    """Invert moments to normals, per pixel.

    Parameters
    ----------
    parallel, crossed : ndarray, shape (MOMENT_ROWS, P)
        `parallel` less `crossed` is inverted; a `crossed` without pixels is 0.
    frame : ndarray, shape (3, 3)
        Rows right, up, view.
    mirror : bool
        Whether the vector is of a specular reflection, not a diffuse one.
    table, least, step
        See :class:`reconstruction.gradient_normals.lobe_response.LobeResponseTable`; with a table
        of size 0 the vector is used uncorrected.
    grid : ndarray, shape (G, G, 2)
        See :func:`fill_start_grid`; not read without a table.
    analyzer : ndarray, shape (2,)
        Passing axis in the frame; zeros: diffuse light is taken to be unpolarized.
    eta : float
    view : ndarray, shape (P, 3), or (0, 3)
        Each pixel's view, rig frame, if it differs from the frame's.
    position : ndarray, shape (P, 2), or (0, 2)
        Each pixel's position in the field, along the frame's first two axes, mm.
    has_noise : bool
        Whether variances are known.
    needed : float
        Length of the vector over its standard error below which it is noise.
    close : float
        Distance to the observed position at which the search ends.
    out : ndarray, shape (P, NORMAL_COLUMNS)
    """
    two = crossed.shape[1] > 0
    tabled = table.size > 0
    straight = frame[0, 0] == 1.0 and frame[1, 1] == 1.0 and frame[2, 2] == 1.0
    polarized = two and tabled and (analyzer[0] != 0.0 or analyzer[1] != 0.0)
    last = 16 if polarized else 0
    spread = np.empty(5)
    c, cov, turned = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    half, slope = np.empty((3, 3)), np.empty((2, 3))
    rows = ((V_XX, V_XY, V_XZ), (V_XY, V_YY, V_YZ), (V_XZ, V_YZ, V_ZZ))
    for p in range(parallel.shape[1]):
        for k in range(NORMAL_COLUMNS):
            out[p, k] = 0.0
        c0 = float(parallel[C_0, p])
        if two:
            c0 -= crossed[C_0, p]
        if not (c0 == c0):
            out[p, STATUS] = LOST
            continue
        var0 = float(parallel[V_0, p])
        if two:
            var0 += crossed[V_0, p]
        for i in range(3):
            for j in range(3):
                s = float(parallel[rows[i][j], p])
                if two:
                    s += crossed[rows[i][j], p]
                half[i, j] = s
        if straight:
            cov[:] = half
        else:
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for k in range(3):
                        s += frame[i, k] * half[k, j]
                    turned[i, j] = s
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for k in range(3):
                        s += turned[i, k] * frame[j, k]
                    cov[i, j] = s
        ratio = 1.0
        u0, u1 = 0.0, 0.0
        status = GOOD
        x, y = (position[p, 0], position[p, 1]) if position.shape[0] else (0.0, 0.0)
        j00, j01, j10, j11 = 1.0, 0.0, 0.0, 1.0
        rough = polarized  # normals from the start grid, until the polarization converges
        for turn in range(last + 1):
            for i in range(3):
                s = 0.0
                for k in range(3):
                    m = float(parallel[C_X + k, p])
                    if two:
                        m -= ratio * crossed[C_X + k, p]
                    s += frame[i, k] * m
                c[i] = s
            if two:
                c0 = parallel[C_0, p] - ratio * crossed[C_0, p]
            length = math.sqrt(c[0] * c[0] + c[1] * c[1] + c[2] * c[2])
            wide = 0.0
            for i in range(3):
                for j in range(3):
                    wide += c[i] * cov[i, j] * c[j]
            wide = math.sqrt(max(wide, 0.0)) / length if length > 0.0 else 0.0
            if not (length > 0.0 and c0 > 0.0) or (has_noise and length < needed * wide):
                status = DIM
                break
            # position that the vector points to, and its derivative by the vector
            n0, n1, n2 = c[0] / length, c[1] / length, c[2] / length
            for i in range(3):
                for j in range(3):
                    ni = n0 if i == 0 else (n1 if i == 1 else n2)
                    nj = n0 if j == 0 else (n1 if j == 1 else n2)
                    half[i, j] = ((1.0 if i == j else 0.0) - ni * nj) / length
            if mirror:
                h2 = n2 + 1.0
                size = math.sqrt(n0 * n0 + n1 * n1 + h2 * h2)
                if size < 1e-3:
                    status = HORIZON
                    break
                n0, n1, n2 = n0 / size, n1 / size, h2 / size
                for j in range(3):
                    s = n0 * half[0, j] + n1 * half[1, j] + n2 * half[2, j]
                    turned[0, j] = (half[0, j] - n0 * s) / size
                    turned[1, j] = (half[1, j] - n1 * s) / size
                    turned[2, j] = (half[2, j] - n2 * s) / size
            else:
                turned[:] = half
            if n2 < _MIN_FACING:
                status = HORIZON
                break
            scale = math.sqrt(2.0 / (1.0 + n2))
            for j in range(3):
                fall = 0.5 * scale / (1.0 + n2) * turned[2, j]
                slope[0, j] = scale * turned[0, j] - n0 * fall
                slope[1, j] = scale * turned[1, j] - n1 * fall
            s0, s1 = n0 * scale, n1 * scale
            if not tabled:
                u0, u1 = s0, s1
                break
            if rough or not polarized:
                u0, u1 = _start(grid, s0, s1)
            if not rough:
                u0, u1, off, j00, j01, j10, j11 = _solve_newton(
                    table, min_coordinate, step, s0, s1, u0, u1, x, y, close
                )
                if off > _MAX_POSITION_ERROR:
                    status = HORIZON
                    break
            if not polarized:
                break
            square = min(u0 * u0 + u1 * u1, 1.9)
            m = math.sqrt(1.0 - 0.25 * square)
            fresh = _exit_ratio(u0 * m, u1 * m, 1.0 - 0.5 * square, analyzer[0], analyzer[1], eta)
            # relative change of the vector by the polarization's change
            change = abs(fresh - ratio) * abs(crossed[C_0, p]) / c0
            ratio = fresh
            if rough:
                rough = change > _COARSE_TOL and turn < last - _N_EXACT_ROTATIONS
            elif change < max(10.0 * close, 1e-7):
                break
            elif turn == last and change > _MAX_MOMENT_CHANGE:
                status = HORIZON
        if status != GOOD:
            out[p, STATUS] = status
            continue
        # noise: covariance of the observed position, through the inverse of the table's derivative
        e00, e01, e11 = 0.0, 0.0, 0.0
        if has_noise:
            for i in range(3):
                for j in range(3):
                    e00 += slope[0, i] * cov[i, j] * slope[0, j]
                    e01 += slope[0, i] * cov[i, j] * slope[1, j]
                    e11 += slope[1, i] * cov[i, j] * slope[1, j]
        if tabled:
            _interpolate_covariance(table, min_coordinate, step, u0, u1, spread)
        else:
            spread[:] = 0.0
            spread[0] = 1.0
        e00, e01, e11 = e00 + spread[2], e01 + spread[3], e11 + spread[4]
        det = j00 * j11 - j01 * j10
        square = u0 * u0 + u1 * u1
        m = math.sqrt(1.0 - 0.25 * square)
        error = math.pi
        if has_noise and abs(det) > 1e-6:
            i00, i01, i10, i11 = j11 / det, -j01 / det, -j10 / det, j00 / det
            a00 = i00 * i00 * e00 + 2.0 * i00 * i01 * e01 + i01 * i01 * e11
            a11 = i10 * i10 * e00 + 2.0 * i10 * i11 * e01 + i11 * i11 * e11
            a01 = i00 * i10 * e00 + (i00 * i11 + i01 * i10) * e01 + i01 * i11 * e11
            # angle^2 = m^2 |du|^2 + (u.du)^2 (1/2 + |u|^2/16/m^2)
            radial = u0 * u0 * a00 + 2.0 * u0 * u1 * a01 + u1 * u1 * a11
            bend = 0.5 + square / (16.0 * m * m)
            error = min(math.sqrt(max(m * m * (a00 + a11) + bend * radial, 0.0)), math.pi)
        n0, n1, n2 = u0 * m, u1 * m, 1.0 - 0.5 * square
        g0 = frame[0, 0] * n0 + frame[1, 0] * n1 + frame[2, 0] * n2
        g1 = frame[0, 1] * n0 + frame[1, 1] * n1 + frame[2, 1] * n2
        g2 = frame[0, 2] * n0 + frame[1, 2] * n1 + frame[2, 2] * n2
        if mirror and view.shape[0]:
            # the lobe's axis is measured; the normal is half way between it and the pixel's view
            r0 = 2.0 * n2 * g0 - frame[2, 0] + view[p, 0]
            r1 = 2.0 * n2 * g1 - frame[2, 1] + view[p, 1]
            r2 = 2.0 * n2 * g2 - frame[2, 2] + view[p, 2]
            size = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
            if size < 1e-3:
                out[p, STATUS] = HORIZON
                continue
            g0, g1, g2 = r0 / size, r1 / size, r2 / size
        longer = length
        if has_noise:
            # noise across the vector makes it longer: E|v| = |v| + trace across / (2 |v|)
            longer -= 0.5 * (cov[0, 0] + cov[1, 1] + cov[2, 2] - wide * wide) / length
        if mirror and tabled and n2 < _STEEP:
            # near Brewster's angle a second normal has this direction, but another vector length
            doubt = 3.0 * math.sqrt(max(var0, 0.0) + wide * wide) / c0 if has_noise else 0.0
            if abs(longer / c0 - spread[1]) > _UNLIKE + doubt:
                out[p, STATUS] = HORIZON
                continue
        out[p, N_X], out[p, N_Y], out[p, N_Z] = g0, g1, g2
        out[p, ALBEDO] = c0 / spread[0] if spread[0] > 0.0 else 0.0
        out[p, STDERR] = error
        out[p, STDERR_ALBEDO] = (
            math.sqrt(max(var0, 0.0)) / spread[0] if has_noise and spread[0] > 0.0 else np.inf
        )
        out[p, CONCENTRATION] = spread[1]
        out[p, CONCENTRATION_SEEN] = longer / c0
