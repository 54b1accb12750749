"""Kernels of `rigsim.shading`: reflection, entry and exit of polarized light, per element."""

import math

import numpy as np
from numba import njit, prange


@njit(cache=True, inline="always")
def _transmitted(cosine, eta):  # type: ignore[no-untyped-def]
    """Return the transmittances perpendicular (s) and parallel (p) to the plane of incidence."""
    inside = math.sqrt(max(0.0, 1.0 - (1.0 - cosine * cosine) / (eta * eta)))
    rs = (cosine - eta * inside) / (cosine + eta * inside)
    rp = (eta * cosine - inside) / (eta * cosine + inside)
    return 1.0 - rs * rs, 1.0 - rp * rp


@njit(cache=True, inline="always")
def _smith(cosine, alpha):  # type: ignore[no-untyped-def]
    tangent2 = max(0.0, 1.0 - cosine * cosine) / (cosine * cosine)
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * tangent2))


@njit(cache=True, inline="always")
def specular_stokes_element(  # type: ignore[no-untyped-def]
    n0, n1, n2, l0, l1, l2, v0, v1, v2, alpha, eta, absorbs, right, leak, metal
):
    """Return the Stokes vector of `specular_stokes` for one element, for compiled callers.

    All numbers are float64; ``leak`` is 1 over the extinction, ``metal`` the root of its argument.
    """
    s0_sum, s1_sum, s2_sum = 0.0, 0.0, 0.0
    nl = n0 * l0 + n1 * l1 + n2 * l2
    nv = n0 * v0 + n1 * v1 + n2 * v2
    if nl > 0.0 and nv > 0.0:
        h0, h1, h2 = l0 + v0, l1 + v1, l2 + v2
        length = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        h0, h1, h2 = h0 / length, h1 / length, h2 / length
        hn = min(1.0, n0 * h0 + n1 * h1 + n2 * h2)
        hl = min(1.0, h0 * l0 + h1 * l1 + h2 * l2)
        a2 = alpha * alpha
        d = hn * hn * (a2 - 1.0) + 1.0
        lobe = a2 / (math.pi * d * d) * _smith(nl, alpha) * _smith(nv, alpha) / (4.0 * nv)
        inside = math.sqrt(max(0.0, 1.0 - (1.0 - hl * hl) / (eta * eta)))
        rs = (hl - eta * inside) / (hl + eta * inside)
        rp = (eta * hl - inside) / (eta * hl + inside)
        if metal > 0.0:
            rs, rp = -metal, metal
        # s = h x l across the plane of incidence; it is arbitrary at normal incidence.
        s0, s1, s2 = h1 * l2 - h2 * l1, h2 * l0 - h0 * l2, h0 * l1 - h1 * l0
        length = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        if length < 1e-7:
            s0, s1 = right[1] * l2 - right[2] * l1, right[2] * l0 - right[0] * l2
            s2 = right[0] * l1 - right[1] * l0
            length = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
        s0, s1, s2 = s0 / length, s1 / length, s2 / length
        # The p axes complete the frames of both rays: incident -l x s, reflected v x s.
        i0, i1, i2 = s1 * l2 - s2 * l1, s2 * l0 - s0 * l2, s0 * l1 - s1 * l0
        o0, o1, o2 = v1 * s2 - v2 * s1, v2 * s0 - v0 * s2, v0 * s1 - v1 * s0
        # Field transmitted by the polarizer: perpendicular to its absorbing axis and the ray.
        e0 = absorbs[1] * l2 - absorbs[2] * l1
        e1 = absorbs[2] * l0 - absorbs[0] * l2
        e2 = absorbs[0] * l1 - absorbs[1] * l0
        length = math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
        e0, e1, e2 = e0 / length, e1 / length, e2 / length
        f0, f1, f2 = l1 * e2 - l2 * e1, l2 * e0 - l0 * e2, l0 * e1 - l1 * e0  # leaked field
        # Frame of the camera ray.
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        length = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        x0, x1, x2 = x0 / length, x1 / length, x2 / length
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        sx, sy = s0 * x0 + s1 * x1 + s2 * x2, s0 * y0 + s1 * y1 + s2 * y2
        ox, oy = o0 * x0 + o1 * x1 + o2 * x2, o0 * y0 + o1 * y1 + o2 * y2
        for k in range(2):
            if k == 0:
                es = rs * (e0 * s0 + e1 * s1 + e2 * s2)
                ep = rp * (e0 * i0 + e1 * i1 + e2 * i2)
                weight = 0.5 * lobe
            else:
                es = rs * (f0 * s0 + f1 * s1 + f2 * s2)
                ep = rp * (f0 * i0 + f1 * i1 + f2 * i2)
                weight = 0.5 * lobe * leak
            fx, fy = es * sx + ep * ox, es * sy + ep * oy
            s0_sum += weight * (fx * fx + fy * fy)
            s1_sum += weight * (fx * fx - fy * fy)
            s2_sum += weight * 2.0 * fx * fy
    return s0_sum, s1_sum, s2_sum


@njit(cache=True, inline="always")
def entry_transmittance_element(n0, n1, n2, l0, l1, l2, eta, absorbs, leak):  # type: ignore[no-untyped-def]
    """Return `entry_transmittance` for one element, for compiled callers; float64."""
    entered = 0.0
    nl = min(1.0, n0 * l0 + n1 * l1 + n2 * l2)
    if nl > 0.0:
        ts, tp = _transmitted(nl, eta)
        s0, s1, s2 = n1 * l2 - n2 * l1, n2 * l0 - n0 * l2, n0 * l1 - n1 * l0
        e0 = absorbs[1] * l2 - absorbs[2] * l1
        e1 = absorbs[2] * l0 - absorbs[0] * l2
        e2 = absorbs[0] * l1 - absorbs[1] * l0
        both = (s0 * s0 + s1 * s1 + s2 * s2) * (e0 * e0 + e1 * e1 + e2 * e2)
        dot = e0 * s0 + e1 * s1 + e2 * s2
        c2 = min(1.0, dot * dot / both) if both > 1e-20 else 0.5  # ts = tp at normal incidence
        passed = ts * c2 + tp * (1.0 - c2)
        leaked = ts * (1.0 - c2) + tp * c2
        entered = 0.5 * (passed + leak * leaked)
    return entered


@njit(parallel=True, cache=True)
def specular_stokes(normal, light, camera, alpha, eta, absorbs, right, leak, metal):  # type: ignore[no-untyped-def]
    """Return `rigsim.shading.specular_stokes` of elements, shape (N, 3)."""
    out = np.zeros((normal.shape[0], 3), np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        l0, l1, l2 = float(light[i, 0]), float(light[i, 1]), float(light[i, 2])
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = specular_stokes_element(
            n0, n1, n2, l0, l1, l2, v0, v1, v2, float(alpha[i]), eta, absorbs, right, leak, metal
        )
    return out


@njit(parallel=True, cache=True)
def entry_transmittance(normal, light, eta, absorbs, leak):  # type: ignore[no-untyped-def]
    """Return `rigsim.shading.entry_transmittance` of elements, shape (N,)."""
    out = np.zeros(normal.shape[0], np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        l0, l1, l2 = float(light[i, 0]), float(light[i, 1]), float(light[i, 2])
        out[i] = entry_transmittance_element(n0, n1, n2, l0, l1, l2, eta, absorbs, leak)
    return out


@njit(parallel=True, cache=True)
def exit_stokes(normal, camera, eta, right):  # type: ignore[no-untyped-def]
    """Return `rigsim.shading.exit_stokes` of elements, shape (N, 3)."""
    out = np.zeros((normal.shape[0], 3), np.float32)
    for i in prange(normal.shape[0]):
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        nv = min(1.0, n0 * v0 + n1 * v1 + n2 * v2)
        if nv <= 0.0:
            continue
        ts, tp = _transmitted(nv, eta)
        out[i, 0] = 0.5 * (ts + tp)
        s0, s1, s2 = n1 * v2 - n2 * v1, n2 * v0 - n0 * v2, n0 * v1 - n1 * v0
        squared = s0 * s0 + s1 * s1 + s2 * s2
        if squared < 1e-16:
            continue
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        length2 = x0 * x0 + x1 * x1 + x2 * x2
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        sx = s0 * x0 + s1 * x1 + s2 * x2
        sy = s0 * y0 + s1 * y1 + s2 * y2
        half = 0.5 * (ts - tp) / (squared * length2)
        out[i, 1] = half * (sx * sx - sy * sy)
        out[i, 2] = half * 2.0 * sx * sy
    return out


@njit(parallel=True, cache=True)
def analyzer_frame(camera, right, absorbs):  # type: ignore[no-untyped-def]
    """Return `rigsim.shading.analyzer_frame` of rays, shape (N,) twice."""
    cos2 = np.empty(camera.shape[0], np.float32)
    sin2 = np.empty(camera.shape[0], np.float32)
    for i in prange(camera.shape[0]):
        v0, v1, v2 = float(camera[i, 0]), float(camera[i, 1]), float(camera[i, 2])
        along = right[0] * v0 + right[1] * v1 + right[2] * v2
        x0, x1, x2 = right[0] - along * v0, right[1] - along * v1, right[2] - along * v2
        y0, y1, y2 = v1 * x2 - v2 * x1, v2 * x0 - v0 * x2, v0 * x1 - v1 * x0
        # Transmitted light is polarized perpendicular to the ray and to the absorbing axis.
        p0 = absorbs[1] * v2 - absorbs[2] * v1
        p1 = absorbs[2] * v0 - absorbs[0] * v2
        p2 = absorbs[0] * v1 - absorbs[1] * v0
        px, py = p0 * x0 + p1 * x1 + p2 * x2, p0 * y0 + p1 * y1 + p2 * y2
        squared = px * px + py * py
        cos2[i], sin2[i] = (px * px - py * py) / squared, 2.0 * px * py / squared
    return cos2, sin2
