"""Weighs all pairs of chromophores that a color allows, one pixel after the other, in parallel.

For every melanin of a grid the blood that fits best is followed along the ridge of the
likelihood, over the fold where dark skin takes the colors of lighter skin; between the grid's
lines the cost is interpolated by its values and slopes. Where it is known how blood and melanin
are distributed over the face, the ridge is that of the product, and each line is looked at from
the face's blood too. `reconstruction.chromophores.posterior` is the door;
its tests sum the same over a dense plane.

A pixel goes through `_weights`, `_follow`, `_lowest`, `_look_across` and `_sum_up`. These hand on:

- `seen`: natural logarithms of the pixel's color;
- `w`, `s`: of `_weights`;
- `light`: -2 log probability of log shading at even nodes, the first of them, and their step;
- `k`: a line of equal melanin; `a`, `b`: fractions of the melanin and the blood axis, cube roots of
  volume fractions over the largest;
- `between`: the lowest cost between each line and the next, of `_lowest`.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, int64, njit, prange, void

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.chromophores.lines import N_LINE_NODES, N_LINES, NODES_PER_LINE
from reconstruction.chromophores.start import MIN_AXIS_FRACTION
from reconstruction.compiled import CONTRACT, OVER_PIXELS, given

N_NEWTON_STEPS = 4
MAX_RIDGE_STEP = 0.12
"""Longest step in blood, as a fraction of its axis."""
STEP_TOL = 0.02
"""Step, in standard errors of blood, after which the next one would not matter."""
ACCEPT_TOL = 1.0
"""The same up to which the last step is taken for granted."""
RIDGE_JUMP_COST = 2.0
"""Cost below the ridge's from which on a place beside it is taken for the ridge."""
N_PROBES = 8
"""Places between two lines where the cost is looked at first."""
N_FINE = 160
"""Places that the probability is summed at, along melanin, spread over where there is any."""
MIN_NODES = 5
"""Fewest of them between two lines."""
N_ACROSS = 8
"""Places in blood, across the ridge, at each of them."""
SHAPE_EXTENT = 0.25
"""Extent across the ridge, as a fraction of the axis, from which on its shape is looked at."""
N_COARSE = 24
"""Places that it is looked at, over the whole axis."""
TAIL_COST = 8.0
"""Cost above the lowest where the ends are set."""
NEGLIGIBLE_COST = 18.0
"""Cost above the lowest from which on probability is left out: 1e-4 of the greatest."""
N_BINS = 128
"""Bins of blood's probability."""
N_HALVINGS = 20
"""Halvings of the distance that holds one sigma's probability."""
ONE_SIGMA_PROBABILITY = 0.682689492137086
"""Probability within one standard error of a normal distribution."""
POSTERIOR_MAPS = (
    "melanin",
    "hemoglobin",
    "shading",
    "stderr_melanin",
    "stderr_hemoglobin",
    "residual",
)

_MIN_AXIS_FRACTION = float(MIN_AXIS_FRACTION)
_STEP_A = (1.0 - _MIN_AXIS_FRACTION) / (N_LINES - 1)
_STEP_B = (1.0 - _MIN_AXIS_FRACTION) / (N_LINE_NODES - 1)
_MAX_NODES = (N_LINES - 1) * MIN_NODES + N_FINE


class _Ridge(NamedTuple):
    """What is found on each line, (LINES,) each: the ridge, where blood fits the color best."""

    cost: Float64Array
    """-2 log of the likelihood and of the face's blood there."""
    slope: Float64Array
    """Its derivative by the fraction of the melanin axis, along the ridge."""
    shade: Float64Array
    """Log shading."""
    face_cost: Float64Array
    """The face's part of the cost."""
    blood: Float64Array
    blood_slope: Float64Array
    second: Float64Array
    """Blood of another place on the line that matters, else that of the ridge."""
    spread: Float64Array
    """Standard deviation of blood by the curvature."""
    pull: Float64Array
    """Step that would be left where an end of the axis holds the ridge; else 0."""


class _Beside(NamedTuple):
    """How probability spreads over blood on each line, across the ridge."""

    across: Float64Array
    """(LINES, ACROSS): probability of each place, relative to the ridge's."""
    low: Float64Array
    """(LINES,): where the first place begins."""
    width: Float64Array
    """(LINES,): of a place."""
    wide: BoolArray
    """(LINES,): the curvature says little, see `SHAPE_EXTENT`."""
    coarse: Float64Array
    """(COARSE,): costs on one wide line."""


@njit(fastmath=CONTRACT)
def _form(w, p0, p1, p2, q0, q1, q2):  # type: ignore[no-untyped-def]
    """Return p' W q."""
    return (
        w[0] * p0 * q0
        + w[3] * p1 * q1
        + w[5] * p2 * q2
        + w[1] * (p0 * q1 + p1 * q0)
        + w[2] * (p0 * q2 + p2 * q0)
        + w[4] * (p1 * q2 + p2 * q1)
    )


@njit(fastmath=CONTRACT)
def _hermite(v0, v1, d0, d1, x, step):  # type: ignore[no-untyped-def]
    """Return the cubic with these values and derivatives at the ends, and its derivative."""
    rise = v1 - v0
    p, q = d0 * step - rise, rise - d1 * step
    y = 1.0 - x
    value = v0 + x * (rise + y * (p * y + q * x))
    slope = (rise + (y - x) * (p * y + q * x) + x * y * (q - p)) / step
    return value, slope


@njit(fastmath=CONTRACT)
def _color(log_rgb, by_b, k, b):  # type: ignore[no-untyped-def]
    """Return the log color and its derivative by blood on line k, the node and the way past it."""
    y = (b - _MIN_AXIS_FRACTION) / _STEP_B
    j = min(int(y), N_LINE_NODES - 2)
    x = y - j
    v, w, d, e = log_rgb[k, j], log_rgb[k, j + 1], by_b[k, j], by_b[k, j + 1]
    f0, g0 = _hermite(v[0], w[0], d[0], e[0], x, _STEP_B)
    f1, g1 = _hermite(v[1], w[1], d[1], e[1], x, _STEP_B)
    f2, g2 = _hermite(v[2], w[2], d[2], e[2], x, _STEP_B)
    return f0, f1, f2, g0, g1, g2, j, x


@njit(fastmath=CONTRACT)
def _prior_cost(light, t):  # type: ignore[no-untyped-def]
    """Return -2 log p of a log shading; beyond the table its ends go on straight."""
    prior, low, step = light
    y = (t - low) / step
    i = min(max(math.floor(y), 0), prior.shape[0] - 2)
    return prior[i] + (y - i) * (prior[i + 1] - prior[i])


@njit(fastmath=CONTRACT)
def _blood_cost(of_face, b):  # type: ignore[no-untyped-def]
    """Return -2 log p of blood over the greatest p, its force on b, and its stiffness, >= 0.

    `of_face`: mean, spread, height of the bell over that of any blood, part of the skin with any;
    1 if there is no face.
    """
    away = (b - of_face[0]) / of_face[1]
    bell = (1.0 - of_face[3]) * of_face[2] * math.exp(-0.5 * away * away)
    whole = bell + of_face[3]
    share = bell / whole
    cost = 2.0 * math.log(((1.0 - of_face[3]) * of_face[2] + of_face[3]) / whole)
    return cost, -share * away / of_face[1], share / (of_face[1] * of_face[1])


@njit(fastmath=CONTRACT)
def _melanin_cost(of_face, k, x):  # type: ignore[no-untyped-def]
    """Return -2 log p of melanin over the greatest p, a part x of the way past line k."""
    y = x * NODES_PER_LINE
    i = min(int(y), NODES_PER_LINE - 1)
    i0 = k * NODES_PER_LINE + i
    return of_face[i0] + (y - i) * (of_face[i0 + 1] - of_face[i0])


@njit(fastmath=CONTRACT)
def _descend(log_rgb, by_b, k, b, seen, w, of_face):  # type: ignore[no-untyped-def]
    """Return the blood on line k near which color and face are the most probable.

    Also the last step that would be left, by how much blood is stiff there by the color and in
    all, the residuals' products with the color's derivative and themselves, and residuals.
    """
    for turn in range(N_NEWTON_STEPS + 1):
        f0, f1, f2, g0, g1, g2, j, x = _color(log_rgb, by_b, k, b)
        e0, e1, e2 = seen[0] - f0, seen[1] - f1, seen[2] - f2
        by_color = _form(w, g0, g1, g2, g0, g1, g2) + 1e-9
        pushed = _form(w, g0, g1, g2, e0, e1, e2)
        _, force, stiff = _blood_cost(of_face, b)
        step = (pushed + force) / (by_color + stiff)
        moved = (
            min(max(b + min(max(step, -MAX_RIDGE_STEP), MAX_RIDGE_STEP), _MIN_AXIS_FRACTION), 1.0)
            - b
        )
        if turn == N_NEWTON_STEPS or moved * moved * (by_color + stiff) < STEP_TOL * STEP_TOL:
            break
        b += moved
    if step * step * (by_color + stiff) > ACCEPT_TOL * ACCEPT_TOL:
        step = 0.0  # not found: what a parabola says of places that far off is worth nothing
    return b, step, by_color, by_color + stiff, pushed, e0, e1, e2, g0, g1, g2, j, x


@njit(fastmath=CONTRACT)
def _cost_after(w, s, found, of_face):  # type: ignore[no-untyped-def]
    """Return blood, cost, the face's part of it and shading after the last step of `_descend`.

    Also whether it is held: a place at an end of the axis that would go on stays there.
    """
    b, step, by_color, _, pushed, e0, e1, e2, g0, g1, g2 = found[:11]
    held = (b <= _MIN_AXIS_FRACTION and step < 0.0) or (b >= 1.0 and step > 0.0)
    square = _form(w, e0, e1, e2, e0, e1, e2)
    after = b
    if not held:
        after = min(max(b + step, _MIN_AXIS_FRACTION), 1.0)
        square += step * (step * by_color - 2.0 * pushed)
    more, _, _ = _blood_cost(of_face, after)
    shade = s[0] * e0 + s[1] * e1 + s[2] * e2
    shade -= (s[0] * g0 + s[1] * g1 + s[2] * g2) * (after - b)
    return after, max(square, 0.0) + more, more, shade, held


@njit(fastmath=CONTRACT)
def _volume(k, x, end):  # type: ignore[no-untyped-def]
    """Return the volume fraction of melanin a part x of the way past line k."""
    a = _MIN_AXIS_FRACTION + (k + x) * _STEP_A
    return end * a * a * a


@njit(fastmath=CONTRACT)
def _place(values, at, count, wanted):  # type: ignore[no-untyped-def]
    """Interpolate `at` where the ascending `values`, count + 1 of them, reach `wanted`."""
    if wanted <= values[0]:
        return at[0]
    if wanted >= values[count]:
        return at[count]
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) // 2
        if values[middle] <= wanted:
            low = middle
        else:
            high = middle
    part = (wanted - values[low]) / max(values[high] - values[low], 1e-300)
    return at[low] + part * (at[high] - at[low])


@njit(fastmath=CONTRACT)
def _center_and_reach(edges, total, count):  # type: ignore[no-untyped-def]
    """Return the median, and the distance from it within which one sigma's probability lies.

    `total` is the cumulative probability at each of the `edges`, 0 at the first one.
    """
    center = _place(total, edges, count, 0.5 * total[count])
    low, high = 0.0, max(edges[count] - center, center - edges[0])
    for _ in range(N_HALVINGS):
        middle = 0.5 * (low + high)
        above = _place(edges, total, count, center + middle)
        below = _place(edges, total, count, center - middle)
        if above - below < ONE_SIGMA_PROBABILITY * total[count]:
            low = middle
        else:
            high = middle
    return center, 0.5 * (low + high)


@njit(fastmath=CONTRACT, error_model="numpy")
def _weights(d0, d1, d2, noise, model):  # type: ignore[no-untyped-def]
    """Return the weights of relative errors of a color, brightness projected out, and its own.

    The first is the upper triangle of a matrix of rank 2; the second tells a log brightness from
    log residuals.
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


@njit(fastmath=CONTRACT, error_model="numpy")
def _follow(log_rgb, by_a, by_b, seen, w, s, light, blood_of_face, begin, ridge):  # type: ignore[no-untyped-def]
    """Write the ridge, followed to both sides of where the fit ended."""
    cost, slope, shade, face_cost = ridge.cost, ridge.slope, ridge.shade, ridge.face_cost
    blood, blood_slope, second = ridge.blood, ridge.blood_slope, ridge.second
    spread, pull = ridge.spread, ridge.pull
    first = min(max(int((begin[0] - _MIN_AXIS_FRACTION) / _STEP_A + 0.5), 0), N_LINES - 1)
    for side in range(2):
        b = float64(begin[1])
        if side == 1:
            b = blood[first]
        count = N_LINES - first if side == 0 else first
        for index in range(count):
            k = first + index if side == 0 else first - 1 - index
            found = _descend(log_rgb, by_b, k, b, seen, w, blood_of_face)
            after, least, more, t, held = _cost_after(w, s, found, blood_of_face)
            b, second[k] = found[0], after
            if abs(after - blood_of_face[0]) > 2.0 * blood_of_face[1]:
                # the same melanin may have the color with blood that the face has
                other = _descend(log_rgb, by_b, k, blood_of_face[0], seen, w, blood_of_face)
                o_after, o_least, o_more, o_t, o_held = _cost_after(w, s, other, blood_of_face)
                better = least + _prior_cost(light, t)
                better -= o_least + _prior_cost(light, o_t)
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
            blood_slope[k] = 0.0 if held else -_form(w, h0, h1, h2, g0, g1, g2) / stiff
            spread[k] = 1.0 / math.sqrt(stiff)
            pull[k] = step if held else 0.0
            cost[k], face_cost[k], blood[k] = least, more, after
            o0, o1, o2 = e0, e1, e2
            if not held:
                o0, o1, o2 = e0 - g0 * step, e1 - g1 * step, e2 - g2 * step
            slope[k] = -2.0 * _form(w, h0, h1, h2, o0, o1, o2)
            shade[k] = t


@njit(fastmath=CONTRACT, error_model="numpy")
def _lowest(ridge, light, melanin_of_face, between):  # type: ignore[no-untyped-def]
    """Return the lowest cost along the ridge, and of colors alone; write it between the lines."""
    cost, slope, shade, face_cost = ridge.cost, ridge.slope, ridge.shade, ridge.face_cost
    lowest, color_lowest = np.inf, np.inf
    for k in range(N_LINES - 1):
        least = np.inf
        for i in range(N_PROBES + 1):
            x = float64(i) / N_PROBES
            value, _ = _hermite(cost[k], cost[k + 1], slope[k], slope[k + 1], x, _STEP_A)
            value = max(value, 0.0)
            more = face_cost[k] + x * (face_cost[k + 1] - face_cost[k])
            color_lowest = min(color_lowest, max(value - more, 0.0))
            t = shade[k] + x * (shade[k + 1] - shade[k])
            value += _prior_cost(light, t)
            value += _melanin_cost(melanin_of_face, k, x)
            least = min(least, value)
        between[k] = least
        lowest = min(lowest, least)
    return lowest, color_lowest


@njit(fastmath=CONTRACT, error_model="numpy")
def _look_across(  # type: ignore[no-untyped-def]
    log_rgb, by_b, seen, w, s, light, blood_of_face, between, lowest, ridge, beside_ridge
):
    """Write how probability spreads over blood on each line that matters; return ends of blood."""
    cost, shade, blood, second = ridge.cost, ridge.shade, ridge.blood, ridge.second
    spread, pull = ridge.spread, ridge.pull
    across, coarse, wide = beside_ridge.across, beside_ridge.coarse, beside_ridge.wide
    across_low, across_width = beside_ridge.low, beside_ridge.width
    l0, l1, l2 = seen
    s0, s1, s2 = s
    b_low, b_high = 1.0, _MIN_AXIS_FRACTION
    for k in range(N_LINES):
        beside = min(between[max(k - 1, 0)], between[min(k, N_LINES - 2)])
        if not beside < lowest + NEGLIGIBLE_COST:
            continue
        b = blood[k]
        reach = 2.6 * spread[k]
        if pull[k] != 0.0:
            reach = min(reach, 5.0 * spread[k] * spread[k] / abs(pull[k]))
        low = max(min(b, second[k]) - reach, _MIN_AXIS_FRACTION)
        high = min(max(b, second[k]) + reach, 1.0)
        wide[k] = high - low > SHAPE_EXTENT
        if wide[k]:
            # The curvature says little of the far ends: look where probability ends.
            width = (1.0 - _MIN_AXIS_FRACTION) / N_COARSE
            least = np.inf
            for i in range(N_COARSE):
                f0, f1, f2 = _color(log_rgb, by_b, k, _MIN_AXIS_FRACTION + (i + 0.5) * width)[:3]
                e0, e1, e2 = l0 - f0, l1 - f1, l2 - f2
                t = s0 * e0 + s1 * e1 + s2 * e2
                value = _form(w, e0, e1, e2, e0, e1, e2)
                value += _prior_cost(light, t)
                more, _, _ = _blood_cost(blood_of_face, _MIN_AXIS_FRACTION + (i + 0.5) * width)
                value += more
                coarse[i] = value
                least = min(least, value)
            low, high = 1.0, _MIN_AXIS_FRACTION
            for i in range(N_COARSE):
                if coarse[i] < least + TAIL_COST:
                    low = min(low, _MIN_AXIS_FRACTION + max(i - 0.5, 0.0) * width)
                    high = max(high, _MIN_AXIS_FRACTION + min(i + 1.5, N_COARSE + 0.0) * width)
        width = (high - low) / N_ACROSS
        across_low[k], across_width[k] = low, width
        if beside < lowest + 10.0:
            b_low, b_high = min(b_low, low), max(b_high, high)
        here = cost[k] + _prior_cost(light, shade[k])
        deepest = 0.0
        for i in range(N_ACROSS):
            f0, f1, f2 = _color(log_rgb, by_b, k, low + (i + 0.5) * width)[:3]
            e0, e1, e2 = l0 - f0, l1 - f1, l2 - f2
            t = s0 * e0 + s1 * e1 + s2 * e2
            more, _, _ = _blood_cost(blood_of_face, low + (i + 0.5) * width)
            more += _form(w, e0, e1, e2, e0, e1, e2) - here
            more += _prior_cost(light, t)
            across[k, i] = width * math.exp(-0.5 * max(more, -NEGLIGIBLE_COST))
            deepest = min(deepest, max(more, -NEGLIGIBLE_COST))
        if deepest < -RIDGE_JUMP_COST:
            # The ridge is not where the probability is; what lines have must not differ by
            # much more than their neighbors', or the sum between them is of neither.
            cost[k] += deepest
            for i in range(N_ACROSS):
                across[k, i] *= math.exp(0.5 * deepest)
    return b_low, b_high


@njit(fastmath=CONTRACT, error_model="numpy")
def _sum_up(  # type: ignore[no-untyped-def]
    ridge, beside_ridge, between, lowest, light, melanin_of_face, end, blood_ends, sums
):
    """Sum over melanin along the ridge, and over blood across it.

    Returns how many edges there are along melanin, the sum of log shadings, and bins a blood.
    """
    cost, slope, shade = ridge.cost, ridge.slope, ridge.shade
    blood, blood_slope = ridge.blood, ridge.blood_slope
    across, wide = beside_ridge.across, beside_ridge.wide
    across_low, across_width = beside_ridge.low, beside_ridge.width
    edges_a, total_a, bins = sums
    b_low, b_high = blood_ends
    live = 0
    for k in range(N_LINES - 1):
        live += between[k] < lowest + NEGLIGIBLE_COST
    per_b = N_BINS / max(b_high - b_low, 1e-9)
    bins[:] = 0.0
    each = max(MIN_NODES, N_FINE // live)
    count = 0
    total_a[0] = 0.0
    mean_shade = 0.0
    for k in range(N_LINES - 1):
        if not between[k] < lowest + NEGLIGIBLE_COST:
            continue
        if count > 0 and not between[k - 1] < lowest + NEGLIGIBLE_COST:
            # a gap without probability
            count += 1
            total_a[count] = total_a[count - 1]
        edges_a[count] = _volume(k, 0.0, end)
        for f in range(each):
            x = (f + 0.5) / each
            value, _ = _hermite(cost[k], cost[k + 1], slope[k], slope[k + 1], x, _STEP_A)
            t = shade[k] + x * (shade[k + 1] - shade[k])
            value = max(value, min(0.0, cost[k], cost[k + 1]))
            value += _prior_cost(light, t) - lowest
            value += _melanin_cost(melanin_of_face, k, x)
            mass = 0.0
            if value < NEGLIGIBLE_COST:
                # every ratio of melanin is as likely as any other
                weight = math.exp(-0.5 * value) / (each * (_MIN_AXIS_FRACTION + (k + x) * _STEP_A))
                b = (1.0 - x) * across_low[k] + x * across_low[k + 1]
                if not (wide[k] or wide[k + 1]):
                    bent, _ = _hermite(
                        blood[k], blood[k + 1], blood_slope[k], blood_slope[k + 1], x, _STEP_A
                    )
                    b += bent - (1.0 - x) * blood[k] - x * blood[k + 1]
                width = across_width[k] + x * (across_width[k + 1] - across_width[k])
                place, size = (b - b_low) * per_b, width * per_b
                for i in range(N_ACROSS):
                    part = weight * (across[k, i] + x * (across[k + 1, i] - across[k, i]))
                    mass += part
                    # one of the places fills as many bins as it is wide
                    start = min(max(place + i * size, 0.0), N_BINS - 0.001)
                    stop = min(max(place + (i + 1) * size, start + 0.001), float64(N_BINS))
                    density = part / (stop - start)
                    m = int(start)
                    while m < stop:
                        bins[m] += density * (min(stop, m + 1.0) - max(start, float64(m)))
                        m += 1
                mean_shade += mass * t
            count += 1
            edges_a[count] = _volume(k, (f + 1.0) / each, end)
            total_a[count] = total_a[count - 1] + mass
    return count, mean_shade, per_b


@njit(
    void(
        given(float32, 2),  # rgb (n, 3)
        given(float32, 2),  # variance (n, 3)
        given(boolean, 1),  # usable (n,)
        given(float32, 2),  # where to begin: fractions of the axes (n, 2)
        given(float64, 2),  # upper triangles of the model error's covariances (n, 6) or (1, 6)
        given(float64, 3),  # log color of the lines (LINES, NODES, 3)
        given(float64, 3),  # its derivative by melanin
        given(float64, 3),  # its derivative by blood
        given(float64, 1),  # ends of the axes as volume fractions (2,)
        given(float64, 1),  # -2 log probability of log shading
        float64,  # log shading at the first node of it
        float64,  # and its step
        given(float64, 1),  # -2 log probability of melanin at MELANIN_AXIS, 0 at the greatest
        given(float64, 1),  # of blood: see _blood_cost
        float32[:, ::1],  # maps (6, n): see MAPS
        int64,  # pixels a task
    ),
    **OVER_PIXELS,
)
def weigh_pixels(  # type: ignore[no-untyped-def]
    rgb,
    variance,
    usable,
    begin,
    model,
    log_rgb,
    by_a,
    by_b,
    ends,
    prior,
    prior_low,
    prior_step,
    melanin_of_face,
    blood_of_face,
    maps,
    block,
):
    """Weigh the chromophores of every pixel; the shapes are in the signature above."""
    pixels = rgb.shape[0]
    each_model = model.shape[0] > 1
    light = prior, prior_low, prior_step
    for task in prange((pixels + block - 1) // block):
        r = np.empty((9, N_LINES))
        ridge = _Ridge(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8])
        beside = _Beside(
            np.empty((N_LINES, N_ACROSS)),
            np.empty(N_LINES),
            np.empty(N_LINES),
            np.empty(N_LINES, dtype=np.bool_),
            np.empty(N_COARSE),
        )
        between = np.empty(N_LINES - 1)
        edges_a, total_a = np.empty(_MAX_NODES + N_LINES), np.empty(_MAX_NODES + N_LINES)
        edges_b, total_b = np.empty(N_BINS + 1), np.empty(N_BINS + 1)
        bins = np.empty(N_BINS)
        for n in range(task * block, min(pixels, (task + 1) * block)):
            if not usable[n]:
                for m in range(6):
                    maps[m, n] = np.nan
                continue
            d0, d1, d2 = float64(rgb[n, 0]), float64(rgb[n, 1]), float64(rgb[n, 2])
            seen = math.log(d0), math.log(d1), math.log(d2)
            w, s = _weights(d0, d1, d2, variance[n], model[n if each_model else 0])
            _follow(log_rgb, by_a, by_b, seen, w, s, light, blood_of_face, begin[n], ridge)
            lowest, color_lowest = _lowest(ridge, light, melanin_of_face, between)
            b_low, b_high = _look_across(
                log_rgb, by_b, seen, w, s, light, blood_of_face, between, lowest, ridge, beside
            )
            sums = edges_a, total_a, bins
            blood_ends = b_low, b_high
            count, mean_shade, per_b = _sum_up(
                ridge, beside, between, lowest, light, melanin_of_face, ends[0], blood_ends, sums
            )
            edges_b[0], total_b[0] = ends[1] * b_low**3, 0.0
            for m in range(N_BINS):
                edges_b[m + 1] = ends[1] * (b_low + (m + 1) / per_b) ** 3
                total_b[m + 1] = total_b[m] + bins[m]
            if not total_a[count] > 0.0:  # no place along the ridge has any probability
                for m in range(6):
                    maps[m, n] = np.nan
                continue
            center, reach = _center_and_reach(edges_a, total_a, count)
            maps[0, n], maps[3, n] = center, reach
            center, reach = _center_and_reach(edges_b, total_b, N_BINS)
            maps[1, n], maps[4, n] = center, reach
            maps[2, n] = math.exp(mean_shade / total_a[count])
            maps[5, n] = math.sqrt(color_lowest)
