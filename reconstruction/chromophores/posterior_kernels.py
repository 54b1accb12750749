"""Integrate the posterior over all pairs of chromophores, one pixel at a time.

For every melanin of a grid, the integration follows the best blood along the ridge of the
likelihood, over the fold where dark skin takes the colors of lighter skin. Between the grid's lines
the cost is interpolated by its values and slopes. With a face distribution, the ridge is that of
the product, and each line is also searched from the face's blood. Call it through
`reconstruction.chromophores.posterior`; its tests sum the same over a dense plane.

A pixel goes through `color_weights`, `follow_ridge`, `_min_ridge_cost`, `_evaluate_across_ridge`
and `_integrate_ridge`. Their common arguments are:

- `seen`: natural logarithms of the pixel's color;
- `w`, `s`: results of `color_weights`;
- `light`: -2 log probability of log shading at even nodes, the first of them, and their step;
- `k`: a line of equal melanin; `a`, `b`: fractions of the melanin and the blood axis, cube roots of
  volume fractions over the largest;
- `between`: the lowest cost between each line and the next, of `_min_ridge_cost`.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float32, float64, int64, njit, void

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.chromophores.ridge_kernels import (
    AXIS_START,
    MELANIN_STEP,
    RIDGE_JUMP_COST,
    TAIL_COST,
    Ridge,
    blood_cost,
    color_at,
    color_weights,
    follow_ridge,
    hermite,
    melanin_cost,
    prior_cost,
)
from reconstruction.chromophores.start import N_LINES
from reconstruction.chromophores.weight_kernels import quadratic_form
from reconstruction.compiled import BLOCK_KERNEL_OPTIONS, FASTMATH_CONTRACT, readonly_array_type

N_PROBES = 8
"""Positions between two lines at which the cost is first evaluated."""
N_FINE = 160
"""Positions along melanin at which the probability is summed, where it is not negligible."""
MIN_NODES = 5
"""Minimum number of them between two lines."""
N_ACROSS = 8
"""Positions in blood, across the ridge, at each of them."""
SHAPE_EXTENT = 0.25
"""Extent across the ridge, as a fraction of the axis, above which its shape is sampled."""
N_COARSE = 24
"""Number of these samples, over the whole axis."""
NEGLIGIBLE_COST = 18.0
"""Cost above the minimum beyond which probability is neglected: 1e-4 of the maximum."""
N_BINS = 128
"""Bins of blood's probability."""
N_HALVINGS = 20
"""Bisections of the distance that contains one sigma's probability."""
ONE_SIGMA_PROBABILITY = 0.682689492137086
"""Probability within one standard error of a normal distribution."""
POSTERIOR_MAPS = (
    "melanin",
    "hemoglobin",
    "shading",
    "stderr_melanin",
    "stderr_hemoglobin",
    "residual",
    "log_shading_sd",
)

_MAX_NODES = (N_LINES - 1) * MIN_NODES + N_FINE


class _CrossRidge(NamedTuple):
    """Distribution of probability over blood on each line, across the ridge."""

    across: Float64Array
    """(LINES, ACROSS): probability of each position, relative to the ridge's."""
    low: Float64Array
    """(LINES,): start of the first position's interval."""
    width: Float64Array
    """(LINES,): width of the intervals."""
    wide: BoolArray
    """(LINES,): too wide for the curvature at the ridge, see `SHAPE_EXTENT`."""
    coarse: Float64Array
    """(COARSE,): costs on one wide line."""


@njit(fastmath=FASTMATH_CONTRACT)
def _volume(k, x, end):  # type: ignore[no-untyped-def]
    """Return the volume fraction of melanin at the fraction x of the way past line k."""
    a = AXIS_START + (k + x) * MELANIN_STEP
    return end * a * a * a


@njit(fastmath=FASTMATH_CONTRACT)
def _interpolate_inverse(values, at, count, wanted):  # type: ignore[no-untyped-def]
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


@njit(fastmath=FASTMATH_CONTRACT)
def _median_and_half_width(edges, total, count):  # type: ignore[no-untyped-def]
    """Return the median, and the distance from it that contains one sigma's probability.

    `total` is the cumulative probability at each of the `edges`, 0 at the first one.
    """
    center = _interpolate_inverse(total, edges, count, 0.5 * total[count])
    low, high = 0.0, max(edges[count] - center, center - edges[0])
    for _ in range(N_HALVINGS):
        middle = 0.5 * (low + high)
        above = _interpolate_inverse(edges, total, count, center + middle)
        below = _interpolate_inverse(edges, total, count, center - middle)
        if above - below < ONE_SIGMA_PROBABILITY * total[count]:
            low = middle
        else:
            high = middle
    return center, 0.5 * (low + high)


@njit(fastmath=FASTMATH_CONTRACT, error_model="numpy")
def _min_ridge_cost(ridge, light, melanin_of_face, between):  # type: ignore[no-untyped-def]
    """Return the lowest cost along the ridge, and of colors alone; write it between the lines."""
    cost, slope, shade, face_cost = ridge.cost, ridge.slope, ridge.log_shading, ridge.face_cost
    lowest, color_lowest = np.inf, np.inf
    for k in range(N_LINES - 1):
        least = np.inf
        for i in range(N_PROBES + 1):
            x = float64(i) / N_PROBES
            value, _ = hermite(cost[k], cost[k + 1], slope[k], slope[k + 1], x, MELANIN_STEP)
            value = max(value, 0.0)
            more = face_cost[k] + x * (face_cost[k + 1] - face_cost[k])
            color_lowest = min(color_lowest, max(value - more, 0.0))
            t = shade[k] + x * (shade[k + 1] - shade[k])
            value += prior_cost(light, t)
            value += melanin_cost(melanin_of_face, k, x)
            least = min(least, value)
        between[k] = least
        lowest = min(lowest, least)
    return lowest, color_lowest


@njit(fastmath=FASTMATH_CONTRACT, error_model="numpy")
def _evaluate_across_ridge(  # type: ignore[no-untyped-def]
    log_rgb, by_b, log_color, w, s, light, blood_of_face, between, lowest, ridge, cross_ridge
):
    """Write the distribution of blood on each relevant line; return the range of blood."""
    cost, shade, blood, second = ridge.cost, ridge.log_shading, ridge.blood, ridge.second_blood
    spread, pull = ridge.blood_sd, ridge.clipped_step
    across, coarse, wide = cross_ridge.across, cross_ridge.coarse, cross_ridge.wide
    across_low, across_width = cross_ridge.low, cross_ridge.width
    l0, l1, l2 = log_color
    s0, s1, s2 = s
    b_low, b_high = 1.0, AXIS_START
    for k in range(N_LINES):
        local_lowest = min(between[max(k - 1, 0)], between[min(k, N_LINES - 2)])
        if not local_lowest < lowest + NEGLIGIBLE_COST:
            continue
        b = blood[k]
        # A Gaussian of this standard deviation is sampled to 2.6 sigma; at an end of the axis its
        # slope decays the density faster, on the scale sigma^2 / step.
        reach = 2.6 * spread[k]
        if pull[k] != 0.0:
            reach = min(reach, 5.0 * spread[k] * spread[k] / abs(pull[k]))
        low = max(min(b, second[k]) - reach, AXIS_START)
        high = min(max(b, second[k]) + reach, 1.0)
        wide[k] = high - low > SHAPE_EXTENT
        if wide[k]:
            # The curvature at the ridge does not predict the far ends: sample the whole line.
            width = (1.0 - AXIS_START) / N_COARSE
            least = np.inf
            for i in range(N_COARSE):
                f0, f1, f2 = color_at(log_rgb, by_b, k, AXIS_START + (i + 0.5) * width)[:3]
                e0, e1, e2 = l0 - f0, l1 - f1, l2 - f2
                t = s0 * e0 + s1 * e1 + s2 * e2
                value = quadratic_form(w, e0, e1, e2, e0, e1, e2)
                value += prior_cost(light, t)
                more, _, _ = blood_cost(blood_of_face, AXIS_START + (i + 0.5) * width)
                value += more
                coarse[i] = value
                least = min(least, value)
            low, high = 1.0, AXIS_START
            for i in range(N_COARSE):
                if coarse[i] < least + TAIL_COST:
                    low = min(low, AXIS_START + max(i - 0.5, 0.0) * width)
                    high = max(high, AXIS_START + min(i + 1.5, N_COARSE + 0.0) * width)
        width = (high - low) / N_ACROSS
        across_low[k], across_width[k] = low, width
        if local_lowest < lowest + 10.0:
            b_low, b_high = min(b_low, low), max(b_high, high)
        here = cost[k] + prior_cost(light, shade[k])
        deepest = 0.0
        for i in range(N_ACROSS):
            f0, f1, f2 = color_at(log_rgb, by_b, k, low + (i + 0.5) * width)[:3]
            e0, e1, e2 = l0 - f0, l1 - f1, l2 - f2
            t = s0 * e0 + s1 * e1 + s2 * e2
            more, _, _ = blood_cost(blood_of_face, low + (i + 0.5) * width)
            more += quadratic_form(w, e0, e1, e2, e0, e1, e2) - here
            more += prior_cost(light, t)
            across[k, i] = width * math.exp(-0.5 * max(more, -NEGLIGIBLE_COST))
            deepest = min(deepest, max(more, -NEGLIGIBLE_COST))
        if deepest < -RIDGE_JUMP_COST:
            # The probability's maximum is off the ridge. Move the common factor to the line's cost,
            # because the interpolation needs similar relative values on neighboring lines.
            cost[k] += deepest
            for i in range(N_ACROSS):
                across[k, i] *= math.exp(0.5 * deepest)
    return b_low, b_high


@njit(fastmath=FASTMATH_CONTRACT, error_model="numpy")
def _integrate_ridge(  # type: ignore[no-untyped-def]
    ridge, cross_ridge, between, lowest, light, melanin_of_face, end, blood_ends, sums
):
    """Sum over melanin along the ridge, and over blood across it.

    Returns the number of edges along melanin, the sums of log shadings and of their squares, and
    bins per unit of blood.
    """
    cost, slope, shade = ridge.cost, ridge.slope, ridge.log_shading
    blood, blood_slope = ridge.blood, ridge.blood_slope
    across, wide = cross_ridge.across, cross_ridge.wide
    across_low, across_width = cross_ridge.low, cross_ridge.width
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
    mean_shade = square_shade = 0.0
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
            value, _ = hermite(cost[k], cost[k + 1], slope[k], slope[k + 1], x, MELANIN_STEP)
            t = shade[k] + x * (shade[k + 1] - shade[k])
            value = max(value, min(0.0, cost[k], cost[k + 1]))
            value += prior_cost(light, t) - lowest
            value += melanin_cost(melanin_of_face, k, x)
            mass = 0.0
            if value < NEGLIGIBLE_COST:
                # The log-uniform prior in volume fraction c = c_max a^3 is dc/c = 3 da/a on the
                # axis fraction a, hence the division by a.
                weight = math.exp(-0.5 * value) / (each * (AXIS_START + (k + x) * MELANIN_STEP))
                b = (1.0 - x) * across_low[k] + x * across_low[k + 1]
                if not (wide[k] or wide[k + 1]):
                    bent, _ = hermite(
                        blood[k], blood[k + 1], blood_slope[k], blood_slope[k + 1], x, MELANIN_STEP
                    )
                    b += bent - (1.0 - x) * blood[k] - x * blood[k + 1]
                width = across_width[k] + x * (across_width[k + 1] - across_width[k])
                place, size = (b - b_low) * per_b, width * per_b
                for i in range(N_ACROSS):
                    part = weight * (across[k, i] + x * (across[k + 1, i] - across[k, i]))
                    mass += part
                    # spread the position's mass evenly over the bins that its interval covers
                    start = min(max(place + i * size, 0.0), N_BINS - 0.001)
                    stop = min(max(place + (i + 1) * size, start + 0.001), float64(N_BINS))
                    density = part / (stop - start)
                    m = int(start)
                    while m < stop:
                        bins[m] += density * (min(stop, m + 1.0) - max(start, float64(m)))
                        m += 1
                mean_shade += mass * t
                square_shade += mass * t * t
            count += 1
            edges_a[count] = _volume(k, (f + 1.0) / each, end)
            total_a[count] = total_a[count - 1] + mass
    return count, mean_shade, square_shade, per_b


@njit(
    void(
        readonly_array_type(float32, 2),  # rgb (n, 3)
        readonly_array_type(float32, 2),  # variance (n, 3)
        readonly_array_type(boolean, 1),  # usable (n,)
        readonly_array_type(float32, 2),  # where to begin: fractions of the axes (n, 2)
        readonly_array_type(
            float64, 2
        ),  # upper triangles of the model error's covariances (n, 6) or (1, 6)
        readonly_array_type(float64, 3),  # log color of the lines (LINES, NODES, 3)
        readonly_array_type(float64, 3),  # its derivative by melanin
        readonly_array_type(float64, 3),  # its derivative by blood
        readonly_array_type(float64, 1),  # ends of the axes as volume fractions (2,)
        readonly_array_type(float64, 1),  # -2 log probability of log shading
        float64,  # log shading at the first node of it
        float64,  # and its step
        readonly_array_type(
            float64, 1
        ),  # -2 log probability of melanin at MELANIN_AXIS, 0 at the greatest
        readonly_array_type(float64, 1),  # of blood: see blood_cost
        float32[:, ::1],  # maps (7, n): see POSTERIOR_MAPS
        int64,  # first pixel
        int64,  # pixel after the last
    ),
    **BLOCK_KERNEL_OPTIONS,
)
def integrate_posteriors(  # type: ignore[no-untyped-def]
    rgb,
    variance,
    usable,
    start,
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
    first,
    last,
):
    """Integrate the posterior of every pixel; the shapes are in the signature above."""
    each_model = model.shape[0] > 1
    light = prior, prior_low, prior_step
    r = np.empty((9, N_LINES))
    ridge = Ridge(r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8])
    cross_ridge = _CrossRidge(
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
    for n in range(first, last):
        if not usable[n]:
            for m in range(len(POSTERIOR_MAPS)):
                maps[m, n] = np.nan
            continue
        d0, d1, d2 = float64(rgb[n, 0]), float64(rgb[n, 1]), float64(rgb[n, 2])
        seen = math.log(d0), math.log(d1), math.log(d2)
        w, s = color_weights(d0, d1, d2, variance[n], model[n if each_model else 0])
        follow_ridge(log_rgb, by_a, by_b, seen, w, s, light, blood_of_face, start[n], ridge)
        lowest, color_lowest = _min_ridge_cost(ridge, light, melanin_of_face, between)
        b_low, b_high = _evaluate_across_ridge(
            log_rgb, by_b, seen, w, s, light, blood_of_face, between, lowest, ridge, cross_ridge
        )
        sums = edges_a, total_a, bins
        blood_ends = b_low, b_high
        count, mean_shade, square_shade, per_b = _integrate_ridge(
            ridge, cross_ridge, between, lowest, light, melanin_of_face, ends[0], blood_ends, sums
        )
        edges_b[0], total_b[0] = ends[1] * b_low**3, 0.0
        for m in range(N_BINS):
            edges_b[m + 1] = ends[1] * (b_low + (m + 1) / per_b) ** 3
            total_b[m + 1] = total_b[m] + bins[m]
        if not total_a[count] > 0.0:  # the posterior is 0 along the whole ridge
            for m in range(len(POSTERIOR_MAPS)):
                maps[m, n] = np.nan
            continue
        center, reach = _median_and_half_width(edges_a, total_a, count)
        maps[0, n], maps[3, n] = center, reach
        center, reach = _median_and_half_width(edges_b, total_b, N_BINS)
        maps[1, n], maps[4, n] = center, reach
        mean_shade /= total_a[count]
        maps[2, n] = math.exp(mean_shade)
        maps[5, n] = math.sqrt(color_lowest)
        variance_shade = square_shade / total_a[count] - mean_shade * mean_shade
        maps[6, n] = math.sqrt(max(variance_shade, 0.0))
