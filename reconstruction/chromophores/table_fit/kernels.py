"""Inner loop of the chromophore fit: one damped Newton fit per pixel, all pixels in parallel.

Call it through `reconstruction.chromophores`; its tests repeat it in plain NumPy.
"""

import math

import numpy as np
from numba import boolean, float32, float64, int64, njit, void

from reconstruction.chromophores.start import MIN_AXIS_FRACTION
from reconstruction.chromophores.weight_kernels import color_weights, quadratic_form
from reconstruction.compiled import BLOCK_KERNEL_OPTIONS, FASTMATH_CONTRACT, readonly_array_type

MAX_FIT_STEPS = 20
MAX_AXIS_STEP = 0.12
"""Longest step along an axis, as a fraction of it."""
RELATIVE_STEP_TOL = 4e-3
"""Step, relative to the value, after which the next one would be below 5e-5."""
AXIS_STEP_TOL = 1e-3
"""The same as a fraction of the axis."""
GAIN_TOL = 1e-3
"""The same as the square of the step in standard errors."""
MISFIT_GAIN_TOL = 1e-2
"""Addition to it per squared residual: with a misfit more digits are within the noise."""
NOISY_STEP_TOL = 3e-2
"""Step, relative to the value, that is the last one where the remaining misfit exceeds the gain."""
CONVERGED_STEP = 2e-2
"""Step, relative to the value, up to which the last one counts as converged."""
REWEIGHT_STEP = 0.012
"""Fraction of an axis from the weights' position above which the weights are computed again."""
MAX_REWEIGHTS = 8
"""Maximum number of times that the weights are computed again."""
OUTSIDE_SIGMAS = 4.0
"""Minimum residual, in standard errors, of a color outside the table ..."""
OUTSIDE_DISTANCE = 0.02
"""... together with this minimum distance, as a relative difference of color."""
INVERSION_MAPS = (
    "melanin",
    "hemoglobin",
    "shading",
    "stderr_melanin",
    "stderr_hemoglobin",
    "residual",
    "gamut_distance",
)
INVERSION_MASKS = (
    "valid",
    "outside",
    "melanin_identifiable",
    "hemoglobin_identifiable",
    "ambiguous",
)
MAX_FINITE = 1e30
"""Colors and variances from this value on count as infinite."""

_MIN_AXIS_FRACTION = np.float32(MIN_AXIS_FRACTION)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)
_THREE = np.float32(3.0)
_FOUR = np.float32(4.0)
_HALF = np.float32(0.5)
_ZERO = np.float32(0.0)


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _cell(q, x, y):  # type: ignore[no-untyped-def]
    """Return one channel's value and derivatives v, v_x, v_y in its cell."""
    v = v_x = v_y = _ZERO
    for p in range(3, -1, -1):
        c0, c1, c2, c3 = q[p, 0], q[p, 1], q[p, 2], q[p, 3]
        v_x = v_x * x + v
        v = v * x + (((c3 * y + c2) * y + c1) * y + c0)
        v_y = v_y * x + ((_THREE * c3 * y + _TWO * c2) * y + c1)
    return v, v_x, v_y


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _cell_bend(q, x, y):  # type: ignore[no-untyped-def]
    """Return one channel's second derivatives v_xx, v_xy, v_yy in its cell."""
    v = v_x = v_y = v_xx = v_xy = v_yy = _ZERO
    for p in range(3, -1, -1):
        c0, c1, c2, c3 = q[p, 0], q[p, 1], q[p, 2], q[p, 3]
        v_xx = v_xx * x + v_x
        v_xy = v_xy * x + v_y
        v_x = v_x * x + v
        v = v * x + (((c3 * y + c2) * y + c1) * y + c0)
        v_y = v_y * x + ((_THREE * c3 * y + _TWO * c2) * y + c1)
        v_yy = v_yy * x + (_THREE * c3 * y + c2)
    return _TWO * v_xx, v_xy, _TWO * v_yy


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _solve(haa, hab, hbb, ra, rb):  # type: ignore[no-untyped-def]
    """Solve the 2 x 2 normal equations; a singular matrix gets a ridge."""
    det = float64(haa) * hbb - float64(hab) * hab
    det = 1.0 / (max(det, 1e-9 * float64(haa) * hbb) + 1e-300)
    step_a = np.float32((float64(hbb) * ra - float64(hab) * rb) * det)
    step_b = np.float32((float64(haa) * rb - float64(hab) * ra) * det)
    return step_a, step_b


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _project(rows, l0, l1, l2):  # type: ignore[no-untyped-def]
    """Transform log RGB to the coordinates of a start grid."""
    return (
        rows[0, 0] * l0 + rows[0, 1] * l1 + rows[0, 2] * l2 + rows[0, 3],
        rows[1, 0] * l0 + rows[1, 1] * l1 + rows[1, 2] * l2 + rows[1, 3],
    )


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _between_nodes(pairs, y0, y1):  # type: ignore[no-untyped-def]
    """Interpolate a grid (g, g, 2) bilinearly at fractional indices within it."""
    last = pairs.shape[0] - 1
    i, j = min(int(y0), last - 1), min(int(y1), last - 1)
    x, y = y0 - np.float32(i), y1 - np.float32(j)
    n00, n01, n10, n11 = pairs[i, j], pairs[i, j + 1], pairs[i + 1, j], pairs[i + 1, j + 1]
    w11 = x * y
    w10, w01 = x - w11, y - w11
    w00 = _ONE - x - w01
    return (
        w00 * n00[0] + w01 * n01[0] + w10 * n10[0] + w11 * n11[0],
        w00 * n00[1] + w01 * n01[1] + w10 * n10[1] + w11 * n11[1],
    )


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _guess(axes, slopes, y0, y1, height):  # type: ignore[no-untyped-def]
    """Interpolate the start grid bilinearly, clamped to it.

    A color at another height than the surface moves the guess by the grid's slopes, if it has any.
    """
    last = np.float32(axes.shape[0] - 1)
    y0 = min(max(y0, _ZERO), last)
    y1 = min(max(y1, _ZERO), last)
    a, b = _between_nodes(axes, y0, y1)
    if slopes.shape[0] > 1:
        node = slopes[int(y0 + _HALF), int(y1 + _HALF)]
        above = height - node[0]
        a += node[1] * above
        b += node[2] * above
    return min(max(a, _MIN_AXIS_FRACTION), _ONE), min(max(b, _MIN_AXIS_FRACTION), _ONE)


@njit(inline="always", fastmath=FASTMATH_CONTRACT)
def _bounded(a, b, step_a, step_b, aa, ab, bb, ra, rb):  # type: ignore[no-untyped-def]
    """Limit a step to the table's edge, where the other chromophore is fitted alone."""
    if a + step_a < _MIN_AXIS_FRACTION or a + step_a > _ONE:
        step_a = (_MIN_AXIS_FRACTION if a + step_a < _MIN_AXIS_FRACTION else _ONE) - a
        step_b = (rb - ab * step_a) / bb
        if b + step_b < _MIN_AXIS_FRACTION or b + step_b > _ONE:
            step_b = (_MIN_AXIS_FRACTION if b + step_b < _MIN_AXIS_FRACTION else _ONE) - b
            step_a = (ra - ab * step_b) / aa
    elif b + step_b < _MIN_AXIS_FRACTION or b + step_b > _ONE:
        step_b = (_MIN_AXIS_FRACTION if b + step_b < _MIN_AXIS_FRACTION else _ONE) - b
        step_a = (ra - ab * step_b) / aa
    step_a = min(max(step_a, _MIN_AXIS_FRACTION - a), _ONE - a)
    step_b = min(max(step_b, _MIN_AXIS_FRACTION - b), _ONE - b)
    longest = max(abs(step_a), abs(step_b))
    if longest > MAX_AXIS_STEP:
        shorter = np.float32(MAX_AXIS_STEP) / np.float32(longest)
        step_a *= shorter
        step_b *= shorter
    return np.float32(step_a), np.float32(step_b)


@njit(
    void(
        readonly_array_type(float32, 2),  # rgb (n, 3)
        readonly_array_type(float32, 2),  # variance (n, 3) or (1, 3)
        readonly_array_type(float32, 1),  # shading (n,) or (1,)
        readonly_array_type(boolean, 1),  # usable (n,) or (1,)
        boolean,  # shading is free
        readonly_array_type(float32, 2),  # covariance of the model's relative error (3, 3)
        readonly_array_type(float32, 3),  # covariance by optics on the axes (k, k, 6); k = 1: none
        readonly_array_type(float32, 1),  # prior of axis fractions: means and precisions (4,)
        readonly_array_type(float32, 3),  # factors of standard errors on the axes (m, m, 2)
        readonly_array_type(float32, 5),  # cells of the color table
        readonly_array_type(float32, 1),  # ends of the axes as volume fractions (2,)
        readonly_array_type(float32, 2),  # projection of log rgb, and offset (2, 4)
        readonly_array_type(float32, 3),  # start grid on it (g, g, 2)
        readonly_array_type(float32, 3),  # its heights and slopes (g, g, 3); g = 1: none
        readonly_array_type(float32, 1),  # direction of the height in log rgb (3,)
        readonly_array_type(float32, 2),  # mean log color of second solutions (g, g)
        float32,  # largest plausible log shading
        float32,  # sign of the surface's side on which light skin lies
        float32,  # largest relative standard error of an identifiable chromophore
        float32[:, ::1],  # maps (7, n): see MAPS
        boolean[:, ::1],  # masks (5, n): see MASKS
        int64,  # first pixel
        int64,  # pixel after the last
    ),
    **BLOCK_KERNEL_OPTIONS,
)
def fit_pixels(  # type: ignore[no-untyped-def]
    rgb,
    variance,
    shading,
    usable,
    free,
    model,
    optics,
    prior,
    factors,
    cells,
    ends,
    projection,
    start_axes,
    start_slopes,
    normal,
    twin_log,
    log_shading_max,
    light_side,
    limit,
    maps,
    masks,
    first,
    last,
):
    """Fit every pixel; the arguments' shapes are in the signature above."""
    intervals = cells.shape[0]
    length = np.float32(intervals)
    grid = twin_log.shape[0]
    has_optics = optics.shape[0] > 1
    has_factors = factors.shape[0] > 1
    gain_tol = np.float32(GAIN_TOL)
    common_variance = max(min(model[0, 1], model[0, 2], model[1, 2]), _ZERO)
    each_variance = variance.shape[0] > 1
    each_shading = shading.shape[0] > 1
    each_usable = usable.shape[0] > 1
    for n in range(first, last):
        k = n if each_variance else 0
        known = _ONE if free else shading[n if each_shading else 0]
        d0, d1, d2 = rgb[n, 0], rgb[n, 1], rgb[n, 2]
        v0, v1, v2 = variance[k, 0], variance[k, 1], variance[k, 2]
        good = (
            usable[n if each_usable else 0]
            and known > _ZERO
            and known < MAX_FINITE
            and d0 > _ZERO
            and d1 > _ZERO
            and d2 > _ZERO
            and d0 + d1 + d2 < MAX_FINITE
            and v0 >= _ZERO
            and v1 >= _ZERO
            and v2 >= _ZERO
            and v0 + v1 + v2 < MAX_FINITE
        )
        if not good:
            for m in range(7):
                maps[m, n] = np.nan
            for m in range(5):
                masks[m, n] = False
            continue
        # Relative variances by noise, before the color is divided by its shading
        i0, i1, i2 = _ONE / d0, _ONE / d1, _ONE / d2
        v0, v1, v2 = v0 * i0 * i0, v1 * i1 * i1, v2 * i2 * i2
        if not free:
            unshaded = _ONE / known
            d0, d1, d2 = d0 * unshaded, d1 * unshaded, d2 * unshaded
        l0, l1, l2 = math.log(d0), math.log(d1), math.log(d2)
        y0, y1 = _project(projection, l0, l1, l2)
        height = normal[0] * l0 + normal[1] * l1 + normal[2] * l2
        a, b = _guess(start_axes, start_slopes, y0, y1, height)
        noise = v0, v1, v2
        w = color_weights(noise, model, optics, a, b, free)
        a_of_weights, b_of_weights = a, b
        twin_brightness = -np.float32(np.inf)
        if free:
            g0 = min(max(int(y0 + _HALF), 0), grid - 1)
            g1 = min(max(int(y1 + _HALF), 0), grid - 1)
            twin_brightness = twin_log[g0, g1]
        a_before, b_before, cost_before = a, b, np.float32(np.inf)
        step_a = step_b = _ZERO
        s = _ONE
        aa = bb = _ONE
        ab = ra = rb = _ZERO
        e0 = e1 = e2 = _ZERO
        ga0 = ga1 = ga2 = gb0 = gb1 = gb2 = _ZERO
        done = False
        reweights = 0
        for step in range(MAX_FIT_STEPS):
            if has_optics and step > 0:
                moved = max(abs(a - a_of_weights), abs(b - b_of_weights))
                if moved > REWEIGHT_STEP and reweights < MAX_REWEIGHTS:
                    reweights += 1
                    w = color_weights(noise, model, optics, a, b, free)
                    a_of_weights, b_of_weights = a, b
                    # of other weights, but the fold's guard stays on
                    cost_before = np.float32(0.9 * MAX_FINITE)
                elif done:
                    break
            done = False
            i, j = a * length, b * length
            row, column = min(int(i), intervals - 1), min(int(j), intervals - 1)
            x, y = i - np.float32(row), j - np.float32(column)
            here = cells[row, column]
            f0, x0, y0_ = _cell(here[0], x, y)
            f1, x1, y1_ = _cell(here[1], x, y)
            f2, x2, y2_ = _cell(here[2], x, y)
            r0, r1, r2 = _ONE / f0, _ONE / f1, _ONE / f2
            q0, q1, q2 = d0 * r0, d1 * r1, d2 * r2
            if free:
                s = w[6] * q0 + w[7] * q1 + w[8] * q2
                t = _ONE / s
                e0, e1, e2 = q0 * t - _ONE, q1 * t - _ONE, q2 * t - _ONE
            else:
                # log(q) = log(mean) + log(q / mean), the second term to first order around the
                # mean: a shading known to 50 percent leaves factors q far from 1.
                mean = (q0 + q1 + q2) / _THREE
                t = _ONE / mean
                common = math.log(mean) - _ONE
                e0, e1, e2 = q0 * t + common, q1 * t + common, q2 * t + common
            off_a, off_b = prior[0] - a, prior[1] - b
            cost = quadratic_form(w, e0, e1, e2, e0, e1, e2)
            cost += prior[2] * off_a * off_a + prior[3] * off_b * off_b
            r0, r1, r2 = r0 * length, r1 * length, r2 * length
            ga0, ga1, ga2 = x0 * r0, x1 * r1, x2 * r2
            gb0, gb1, gb2 = y0_ * r0, y1_ * r1, y2_ * r2
            facing = (ga1 * gb2 - ga2 * gb1) + (ga2 * gb0 - ga0 * gb2) + (ga0 * gb1 - ga1 * gb0)
            # Beyond the fold, where the gray axis meets the surface's other side, is the
            # second solution.
            beyond = free and cost_before < MAX_FINITE and facing * light_side < _ZERO
            if beyond or cost > cost_before * np.float32(1.01) + np.float32(1e-9):
                # Overshot: return half of the way to the last accepted point.
                a, b = _HALF * (a + a_before), _HALF * (b + b_before)
                step_a, step_b = a - a_before, b - b_before
                if max(abs(step_a), abs(step_b)) < 1e-5:
                    a, b = a_before, b_before
                    break
                continue
            cost_before, a_before, b_before = cost, a, b
            aa = quadratic_form(w, ga0, ga1, ga2, ga0, ga1, ga2) + prior[2]
            ab = quadratic_form(w, ga0, ga1, ga2, gb0, gb1, gb2)
            bb = quadratic_form(w, gb0, gb1, gb2, gb0, gb1, gb2) + prior[3]
            ra = quadratic_form(w, ga0, ga1, ga2, e0, e1, e2) + prior[2] * off_a
            rb = quadratic_form(w, gb0, gb1, gb2, e0, e1, e2) + prior[3] * off_b
            haa, hab, hbb = aa, ab, bb
            step_a, step_b = _solve(aa, ab, bb, ra, rb)
            if step > 1 and not free:
                # Off the surface Gauss-Newton converges slowly. Newton's Hessian subtracts the
                # second derivatives of log f, f''/f - (f'/f)^2, weighted by the residual that
                # the linear step leaves.
                o0 = e0 - ga0 * step_a - gb0 * step_b
                o1 = e1 - ga1 * step_a - gb1 * step_b
                o2 = e2 - ga2 * step_a - gb2 * step_b
                z0 = w[0] * o0 + w[1] * o1 + w[2] * o2
                z1 = w[1] * o0 + w[3] * o1 + w[4] * o2
                z2 = w[2] * o0 + w[4] * o1 + w[5] * o2
                r0, r1, r2 = r0 * length, r1 * length, r2 * length
                xx0, xy0, yy0 = _cell_bend(here[0], x, y)
                xx1, xy1, yy1 = _cell_bend(here[1], x, y)
                xx2, xy2, yy2 = _cell_bend(here[2], x, y)
                haa -= (
                    z0 * (xx0 * r0 - ga0 * ga0)
                    + z1 * (xx1 * r1 - ga1 * ga1)
                    + z2 * (xx2 * r2 - ga2 * ga2)
                )
                hab -= (
                    z0 * (xy0 * r0 - ga0 * gb0)
                    + z1 * (xy1 * r1 - ga1 * gb1)
                    + z2 * (xy2 * r2 - ga2 * gb2)
                )
                hbb -= (
                    z0 * (yy0 * r0 - gb0 * gb0)
                    + z1 * (yy1 * r1 - gb1 * gb1)
                    + z2 * (yy2 * r2 - gb2 * gb2)
                )
                straight = float64(aa) * bb - float64(ab) * ab
                bent = float64(haa) * hbb - float64(hab) * hab
                if haa > _ZERO and hbb > _ZERO and bent > 0.25 * straight:
                    step_a, step_b = _solve(haa, hab, hbb, ra, rb)
                else:
                    haa, hab, hbb = aa, ab, bb
            step_a, step_b = _bounded(a, b, step_a, step_b, haa, hab, hbb, ra, rb)
            a += step_a
            b += step_b
            gain = abs(step_a * ra + step_b * rb)
            longest = max(abs(step_a) / a, abs(step_b) / b)
            misfit = cost - gain
            if (
                gain < gain_tol + MISFIT_GAIN_TOL * misfit
                or (longest < RELATIVE_STEP_TOL and max(abs(step_a), abs(step_b)) < AXIS_STEP_TOL)
                or (longest < NOISY_STEP_TOL and gain < misfit)
            ):
                done = True
                if not has_optics:
                    break
        # The linear model gives the change of the residual by the last step.
        e0 -= ga0 * step_a + gb0 * step_b
        e1 -= ga1 * step_a + gb1 * step_b
        e2 -= ga2 * step_a + gb2 * step_b
        residual = math.sqrt(max(quadratic_form(w, e0, e1, e2, e0, e1, e2), _ZERO))
        # The part of the residual that shading explains: all of the mean when free, else its
        # most probable part given the shading's variance.
        shift = w[6] * e0 + w[7] * e1 + w[8] * e2
        if free:
            s *= _ONE + shift
        else:
            shift *= common_variance * w[9]
            s = np.float32(math.exp(shift))
        e0, e1, e2 = e0 - shift, e1 - shift, e2 - shift
        a = min(max(a, _MIN_AXIS_FRACTION), _ONE)
        b = min(max(b, _MIN_AXIS_FRACTION), _ONE)
        wide = float64(aa) * bb
        det = max(wide - float64(ab) * ab, 1e-12 * wide) + 1e-300
        inverse = np.float32(1.0 / det)
        relative_a = _THREE * math.sqrt(bb * inverse) / a
        relative_b = _THREE * math.sqrt(aa * inverse) / b
        if has_factors:
            nodes = np.float32(factors.shape[0] - 1)
            factor_a, factor_b = _between_nodes(factors, a * nodes, b * nodes)
            relative_a *= factor_a
            relative_b *= factor_b
        distance = math.sqrt((e0 * e0 + e1 * e1 + e2 * e2) / _THREE)
        maps[0, n] = ends[0] * a * a * a
        maps[1, n] = ends[1] * b * b * b
        maps[2, n] = s * known
        maps[3, n] = relative_a * maps[0, n]
        maps[4, n] = relative_b * maps[1, n]
        maps[5, n] = residual
        maps[6, n] = distance
        twin = free and (l0 + l1 + l2) / _THREE <= twin_brightness + log_shading_max
        outside = residual > OUTSIDE_SIGMAS and distance > OUTSIDE_DISTANCE
        close = max(abs(step_a) / a, abs(step_b) / b) < CONVERGED_STEP
        masks[0, n] = (done or close) and not outside
        masks[1, n] = outside
        masks[2, n] = relative_a <= limit and a < _ONE and not twin
        masks[3, n] = relative_b <= limit and b < _ONE and not twin
        masks[4, n] = twin
