"""Kernels that follow, for one pixel, the best blood along the grid of melanin.

The arguments are those of `reconstruction.chromophores.posterior_kernels`.
"""

import math
from typing import NamedTuple

from numba import float64, njit

from reconstruction.arrays import Float64Array
from reconstruction.chromophores.start import (
    MIN_AXIS_FRACTION,
    N_LINE_NODES,
    N_LINES,
    NODES_PER_LINE,
)
from reconstruction.chromophores.weight_kernels import quadratic_form
from reconstruction.compiled import FASTMATH_CONTRACT

N_NEWTON_STEPS = 4
MAX_RIDGE_STEP = 0.12
"""Longest step in blood, as a fraction of its axis."""
STEP_TOL = 0.02
"""Step, in standard errors of blood, after which the next one is negligible."""
ACCEPT_TOL = 1.0
"""Step, in standard errors of blood, up to which the last one is accepted."""
RIDGE_JUMP_COST = 2.0
"""Cost below the ridge's from which on another position on the line replaces it."""
TAIL_COST = 8.0
"""Cost above the minimum that defines the ends."""
AXIS_START = float(MIN_AXIS_FRACTION)
MELANIN_STEP = (1.0 - AXIS_START) / (N_LINES - 1)
BLOOD_STEP = (1.0 - AXIS_START) / (N_LINE_NODES - 1)


class Ridge(NamedTuple):
    """Ridge of the likelihood, (LINES,) each: the best blood on each line."""

    cost: Float64Array
    """-2 log of the product of the likelihood and the face's prior of blood."""
    slope: Float64Array
    """Derivative of the cost by the fraction of the melanin axis, along the ridge."""
    log_shading: Float64Array
    """Log shading."""
    face_cost: Float64Array
    """The face's part of the cost."""
    blood: Float64Array
    blood_slope: Float64Array
    second_blood: Float64Array
    """Blood at the line's second relevant position, else that at the ridge."""
    blood_sd: Float64Array
    """Standard deviation of blood by the curvature."""
    clipped_step: Float64Array
    """Remaining step where an end of the axis limits the ridge; else 0."""


@njit(fastmath=FASTMATH_CONTRACT)
def hermite(v0, v1, d0, d1, x, step):  # type: ignore[no-untyped-def]
    """Return the cubic with these values and derivatives at the ends, and its derivative."""
    rise = v1 - v0
    p, q = d0 * step - rise, rise - d1 * step
    y = 1.0 - x
    value = v0 + x * (rise + y * (p * y + q * x))
    slope = (rise + (y - x) * (p * y + q * x) + x * y * (q - p)) / step
    return value, slope


@njit(fastmath=FASTMATH_CONTRACT)
def color_at(log_rgb, by_b, k, b):  # type: ignore[no-untyped-def]
    """Return line k's log color, its derivative by blood, the node, and the fraction past it."""
    y = (b - AXIS_START) / BLOOD_STEP
    j = min(int(y), N_LINE_NODES - 2)
    x = y - j
    v, w, d, e = log_rgb[k, j], log_rgb[k, j + 1], by_b[k, j], by_b[k, j + 1]
    f0, g0 = hermite(v[0], w[0], d[0], e[0], x, BLOOD_STEP)
    f1, g1 = hermite(v[1], w[1], d[1], e[1], x, BLOOD_STEP)
    f2, g2 = hermite(v[2], w[2], d[2], e[2], x, BLOOD_STEP)
    return f0, f1, f2, g0, g1, g2, j, x


@njit(fastmath=FASTMATH_CONTRACT)
def prior_cost(light, t):  # type: ignore[no-untyped-def]
    """Return -2 log p of a log shading, extrapolated linearly beyond the table."""
    prior, low, step = light
    y = (t - low) / step
    i = min(max(math.floor(y), 0), prior.shape[0] - 2)
    return prior[i] + (y - i) * (prior[i + 1] - prior[i])


@njit(fastmath=FASTMATH_CONTRACT)
def blood_cost(of_face, b):  # type: ignore[no-untyped-def]
    """Return -2 log p of blood over the greatest p, its force on b, and its stiffness, >= 0.

    `of_face`: mean, standard deviation, peak density over the uniform density, and uniform
    fraction, which is 1 without a face.
    """
    away = (b - of_face[0]) / of_face[1]
    bell = (1.0 - of_face[3]) * of_face[2] * math.exp(-0.5 * away * away)
    whole = bell + of_face[3]
    share = bell / whole
    cost = 2.0 * math.log(((1.0 - of_face[3]) * of_face[2] + of_face[3]) / whole)
    return cost, -share * away / of_face[1], share / (of_face[1] * of_face[1])


@njit(fastmath=FASTMATH_CONTRACT)
def melanin_cost(of_face, k, x):  # type: ignore[no-untyped-def]
    """Return -2 log p of melanin over the greatest p, at the fraction x past line k."""
    y = x * NODES_PER_LINE
    i = min(int(y), NODES_PER_LINE - 1)
    i0 = k * NODES_PER_LINE + i
    return of_face[i0] + (y - i) * (of_face[i0 + 1] - of_face[i0])


@njit(fastmath=FASTMATH_CONTRACT)
def fit_blood(log_rgb, by_b, k, b, log_color, w, of_face):  # type: ignore[no-untyped-def]
    """Return the blood on line k that locally maximizes the product of likelihood and prior.

    Also returns the remaining step, the stiffness of blood by the color and in total, the
    residuals' products with the color's derivative and themselves, and the residuals.
    """
    for turn in range(N_NEWTON_STEPS + 1):
        f0, f1, f2, g0, g1, g2, j, x = color_at(log_rgb, by_b, k, b)
        e0, e1, e2 = log_color[0] - f0, log_color[1] - f1, log_color[2] - f2
        by_color = quadratic_form(w, g0, g1, g2, g0, g1, g2) + 1e-9
        pushed = quadratic_form(w, g0, g1, g2, e0, e1, e2)
        _, force, stiff = blood_cost(of_face, b)
        step = (pushed + force) / (by_color + stiff)
        moved = min(max(b + min(max(step, -MAX_RIDGE_STEP), MAX_RIDGE_STEP), AXIS_START), 1.0) - b
        if turn == N_NEWTON_STEPS or moved * moved * (by_color + stiff) < STEP_TOL * STEP_TOL:
            break
        b += moved
    if step * step * (by_color + stiff) > ACCEPT_TOL * ACCEPT_TOL:
        step = 0.0  # not converged: the parabola is not valid over such a distance
    return b, step, by_color, by_color + stiff, pushed, e0, e1, e2, g0, g1, g2, j, x


@njit(fastmath=FASTMATH_CONTRACT)
def final_cost(w, s, found, of_face):  # type: ignore[no-untyped-def]
    """Return blood, cost, the face's part of it and shading after the last step of `fit_blood`.

    Also returns whether an end of the axis limits blood.
    """
    b, step, by_color, _, pushed, e0, e1, e2, g0, g1, g2 = found[:11]
    held = (b <= AXIS_START and step < 0.0) or (b >= 1.0 and step > 0.0)
    square = quadratic_form(w, e0, e1, e2, e0, e1, e2)
    after = b
    if not held:
        after = min(max(b + step, AXIS_START), 1.0)
        square += step * (step * by_color - 2.0 * pushed)
    more, _, _ = blood_cost(of_face, after)
    shade = s[0] * e0 + s[1] * e1 + s[2] * e2
    shade -= (s[0] * g0 + s[1] * g1 + s[2] * g2) * (after - b)
    return after, max(square, 0.0) + more, more, shade, held


@njit(fastmath=FASTMATH_CONTRACT, error_model="numpy")
def color_weights(d0, d1, d2, noise, model):  # type: ignore[no-untyped-def]
    """Return color weights with brightness projected out, and the weights of brightness.

    The first is the upper triangle of a matrix of rank 2; the second gives log brightness from
    log residuals: W - W 1 1' W / (1' W 1) and s = W 1 / (1' W 1) for the inverse covariance W.
    """
    a00 = noise[0] / (d0 * d0) + model[0]
    a11 = noise[1] / (d1 * d1) + model[3]
    a22 = noise[2] / (d2 * d2) + model[5]
    a01, a02, a12 = model[1], model[2], model[4]
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
    w0, w1, w2 = c00 * scale, c01 * scale, c02 * scale
    w3 = (a00 * a22 - a02 * a02) * scale
    w4 = (a01 * a02 - a00 * a12) * scale
    w5 = (a00 * a11 - a01 * a01) * scale
    s0, s1, s2 = w0 + w1 + w2, w1 + w3 + w4, w2 + w4 + w5
    whole = s0 + s1 + s2
    s0, s1, s2 = s0 / whole, s1 / whole, s2 / whole
    w = (
        w0 - s0 * s0 * whole,
        w1 - s0 * s1 * whole,
        w2 - s0 * s2 * whole,
        w3 - s1 * s1 * whole,
        w4 - s1 * s2 * whole,
        w5 - s2 * s2 * whole,
    )
    return w, (s0, s1, s2)


@njit(fastmath=FASTMATH_CONTRACT, error_model="numpy")
def follow_ridge(log_rgb, by_a, by_b, log_color, w, s, light, blood_of_face, begin, ridge):  # type: ignore[no-untyped-def]
    """Follow the ridge from the start fit to both sides, and write it."""
    cost, slope, shade, face_cost = ridge.cost, ridge.slope, ridge.log_shading, ridge.face_cost
    blood, blood_slope, second = ridge.blood, ridge.blood_slope, ridge.second_blood
    spread, pull = ridge.blood_sd, ridge.clipped_step
    first = min(max(int((begin[0] - AXIS_START) / MELANIN_STEP + 0.5), 0), N_LINES - 1)
    for side in range(2):
        b = float64(begin[1])
        if side == 1:
            b = blood[first]
        count = N_LINES - first if side == 0 else first
        for index in range(count):
            k = first + index if side == 0 else first - 1 - index
            found = fit_blood(log_rgb, by_b, k, b, log_color, w, blood_of_face)
            after, least, more, t, held = final_cost(w, s, found, blood_of_face)
            b, second[k] = found[0], after
            if abs(after - blood_of_face[0]) > 2.0 * blood_of_face[1]:
                # the same melanin can also match the color with the face's blood
                other = fit_blood(log_rgb, by_b, k, blood_of_face[0], log_color, w, blood_of_face)
                o_after, o_least, o_more, o_t, o_held = final_cost(w, s, other, blood_of_face)
                better = least + prior_cost(light, t)
                better -= o_least + prior_cost(light, o_t)
                if better > 0.0:
                    second[k] = after if better < TAIL_COST else o_after
                    found, after, least = other, o_after, o_least
                    more, t, held = o_more, o_t, o_held
                elif better > -TAIL_COST:
                    second[k] = o_after
            _, step, _, stiff, _, e0, e1, e2, g0, g1, g2, j, x = found
            h0 = by_a[k, j, 0] + x * (by_a[k, j + 1, 0] - by_a[k, j, 0])
            h1 = by_a[k, j, 1] + x * (by_a[k, j + 1, 1] - by_a[k, j, 1])
            h2 = by_a[k, j, 2] + x * (by_a[k, j + 1, 2] - by_a[k, j, 2])
            blood_slope[k] = 0.0 if held else -quadratic_form(w, h0, h1, h2, g0, g1, g2) / stiff
            spread[k] = 1.0 / math.sqrt(stiff)
            pull[k] = step if held else 0.0
            cost[k], face_cost[k], blood[k] = least, more, after
            o0, o1, o2 = e0, e1, e2
            if not held:
                o0, o1, o2 = e0 - g0 * step, e1 - g1 * step, e2 - g2 * step
            slope[k] = -2.0 * quadratic_form(w, h0, h1, h2, o0, o1, o2)
            shade[k] = t
