"""Weights of a pixel's relative color errors, for the chromophore fit's inner loop."""

import numpy as np
from numba import float64, njit

from reconstruction.compiled import FASTMATH_CONTRACT

_ONE = np.float32(1.0)


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def quadratic_form(w, p0, p1, p2, q0, q1, q2):  # type: ignore[no-untyped-def]
    """Return p' W q."""
    return (
        w[0] * p0 * q0
        + w[3] * p1 * q1
        + w[5] * p2 * q2
        + w[1] * (p0 * q1 + p1 * q0)
        + w[2] * (p0 * q2 + p2 * q0)
        + w[4] * (p1 * q2 + p2 * q1)
    )


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def invert_covariance(a00, a11, a22, a01, a02, a12):  # type: ignore[no-untyped-def]
    """Invert a symmetric 3 x 3 covariance; return w00, w01, w02, w11, w12, w22."""
    c00 = a11 * a22 - a12 * a12
    c01 = a02 * a12 - a01 * a22
    c02 = a01 * a12 - a02 * a11
    scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
    return (
        c00 * scale,
        c01 * scale,
        c02 * scale,
        (a00 * a22 - a02 * a02) * scale,
        (a01 * a02 - a00 * a12) * scale,
        (a00 * a11 - a01 * a01) * scale,
    )


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def covariance_at(nodes, a, b):  # type: ignore[no-untyped-def]
    """Interpolate the upper triangle of a covariance bilinearly between its nodes."""
    last = nodes.shape[0] - 1
    y0, y1 = a * np.float32(last), b * np.float32(last)
    i, j = min(int(y0), last - 1), min(int(y1), last - 1)
    x, y = y0 - np.float32(i), y1 - np.float32(j)
    w11 = x * y
    w10, w01 = x - w11, y - w11
    w00 = _ONE - x - w01
    n00, n01, n10, n11 = nodes[i, j], nodes[i, j + 1], nodes[i + 1, j], nodes[i + 1, j + 1]
    return (
        w00 * n00[0] + w01 * n01[0] + w10 * n10[0] + w11 * n11[0],
        w00 * n00[1] + w01 * n01[1] + w10 * n10[1] + w11 * n11[1],
        w00 * n00[2] + w01 * n01[2] + w10 * n10[2] + w11 * n11[2],
        w00 * n00[3] + w01 * n01[3] + w10 * n10[3] + w11 * n11[3],
        w00 * n00[4] + w01 * n01[4] + w10 * n10[4] + w11 * n11[4],
        w00 * n00[5] + w01 * n01[5] + w10 * n10[5] + w11 * n11[5],
    )


@njit(fastmath=FASTMATH_CONTRACT)
def color_weights(noise, model, optics, a, b, free):  # type: ignore[no-untyped-def]
    """Return the weights of relative errors (6), those of brightness (3), and the latter's sum.

    A free shading is projected out: W - W 1 1' W / (1' W 1), with t = W 1 / (1' W 1).
    """
    m01, m02, m12 = model[0, 1], model[0, 2], model[1, 2]
    a00, a11, a22 = noise[0] + model[0, 0], noise[1] + model[1, 1], noise[2] + model[2, 2]
    if optics.shape[0] > 1:
        c00, c01, c02, c11, c12, c22 = covariance_at(optics, a, b)
        a00, a11, a22 = a00 + c00, a11 + c11, a22 + c22
        m01, m02, m12 = m01 + c01, m02 + c02, m12 + c12
    if m01 == 0.0 and m02 == 0.0 and m12 == 0.0:
        x0, x3, x5 = 1.0 / float64(a00), 1.0 / float64(a11), 1.0 / float64(a22)
        x1 = x2 = x4 = 0.0
    else:
        x0, x1, x2, x3, x4, x5 = invert_covariance(
            float64(a00), float64(a11), float64(a22), float64(m01), float64(m02), float64(m12)
        )
    t0, t1, t2 = x0 + x1 + x2, x1 + x3 + x4, x2 + x4 + x5
    total = t0 + t1 + t2
    whole = 1.0 / total
    t0, t1, t2 = t0 * whole, t1 * whole, t2 * whole
    if free:
        x0, x1, x2 = x0 - t0 * t0 * total, x1 - t0 * t1 * total, x2 - t0 * t2 * total
        x3, x4, x5 = x3 - t1 * t1 * total, x4 - t1 * t2 * total, x5 - t2 * t2 * total
    return (
        np.float32(x0),
        np.float32(x1),
        np.float32(x2),
        np.float32(x3),
        np.float32(x4),
        np.float32(x5),
        np.float32(t0),
        np.float32(t1),
        np.float32(t2),
        np.float32(total),
    )
