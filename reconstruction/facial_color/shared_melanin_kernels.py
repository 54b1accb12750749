"""Kernels for the blood of several states of one pixel given one melanin, parallel over pixels.

`reconstruction.facial_color.shared_melanin` calls them and documents the method; its tests contain
a plain NumPy equivalent.
"""

import math

import numpy as np
from numba import boolean, float32, float64, int64, njit, void

from reconstruction.chromophores.start import MIN_AXIS_FRACTION
from reconstruction.compiled import BLOCK_KERNEL_OPTIONS, FASTMATH_CONTRACT, readonly_array_type

MAX_SHARED_STEPS = 12
MAX_BLOOD_STEP = 0.15
"""Longest step in blood, as a fraction of its axis."""
SHARED_STEP_TOL = 1e-5
PIXEL_MAPS = ("noise_stderr_melanin",)
STATE_MAPS = (
    "hemoglobin",
    "stderr_hemoglobin",
    "noise_stderr_hemoglobin",
    "change",
    "stderr_change",
    "residual",
    "log_shading",
    "log_shading_variance",
)

_MIN_AXIS_FRACTION = float(MIN_AXIS_FRACTION)


@njit(fastmath=FASTMATH_CONTRACT)
def _color(cells, a, b, out):  # type: ignore[no-untyped-def]
    """Write log color and its derivatives by the axes' fractions: out (3 of value, a, b; 3)."""
    last = cells.shape[0]
    i, j = a * last, b * last
    row, column = min(int(i), last - 1), min(int(j), last - 1)
    x, y = i - row, j - column
    for c in range(3):
        q = cells[row, column, c]
        v = v_x = v_y = 0.0
        for p in range(3, -1, -1):
            c0, c1, c2, c3 = q[p, 0], q[p, 1], q[p, 2], q[p, 3]
            v_x = v_x * x + v
            v = v * x + (((c3 * y + c2) * y + c1) * y + c0)
            v_y = v_y * x + ((3.0 * c3 * y + 2.0 * c2) * y + c1)
        out[0, c] = math.log(v)
        out[1, c] = v_x * last / v
        out[2, c] = v_y * last / v


@njit(fastmath=FASTMATH_CONTRACT)
def _weights(each, model, stiffness, w):  # type: ignore[no-untyped-def]
    """Write the inverse of each + model + brightness / stiffness, (3, 3), to `w`.

    `each` and `model` are covariances of log color; 1 / stiffness is the variance of an error
    common to the channels. At 0 the brightness is free, and `w` has rank 2. Returns the channels'
    weights in the brightness.
    """
    a00, a11, a22 = each[0, 0] + model[0, 0], each[1, 1] + model[1, 1], each[2, 2] + model[2, 2]
    a01, a02, a12 = each[0, 1] + model[0, 1], each[0, 2] + model[0, 2], each[1, 2] + model[1, 2]
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    scale = 1.0 / (a00 * c00 + a01 * c01 + a02 * c02)
    w[0, 0], w[0, 1], w[0, 2] = c00 * scale, c01 * scale, c02 * scale
    w[1, 1] = (a00 * a22 - a02 * a02) * scale
    w[1, 2] = (a01 * a02 - a00 * a12) * scale
    w[2, 2] = (a00 * a11 - a01 * a01) * scale
    w[1, 0], w[2, 0], w[2, 1] = w[0, 1], w[0, 2], w[1, 2]
    t0 = w[0, 0] + w[0, 1] + w[0, 2]
    t1 = w[1, 0] + w[1, 1] + w[1, 2]
    t2 = w[2, 0] + w[2, 1] + w[2, 2]
    total = t0 + t1 + t2
    t = (t0, t1, t2)
    for i in range(3):
        for j in range(3):
            w[i, j] -= t[i] * t[j] / (total + stiffness)
    return t0 / total, t1 / total, t2 / total


@njit(fastmath=FASTMATH_CONTRACT)
def _times(w, g):  # type: ignore[no-untyped-def]
    """Return W g."""
    return (
        w[0, 0] * g[0] + w[0, 1] * g[1] + w[0, 2] * g[2],
        w[1, 0] * g[0] + w[1, 1] * g[1] + w[1, 2] * g[2],
        w[2, 0] * g[0] + w[2, 1] * g[1] + w[2, 2] * g[2],
    )


@njit(fastmath=FASTMATH_CONTRACT)
def _form(each, common, p, q):  # type: ignore[no-untyped-def]
    """Return p' (each + common brightness) q; `each` is symmetric, (3, 3)."""
    return (
        each[0, 0] * p[0] * q[0]
        + each[1, 1] * p[1] * q[1]
        + each[2, 2] * p[2] * q[2]
        + each[0, 1] * (p[0] * q[1] + p[1] * q[0])
        + each[0, 2] * (p[0] * q[2] + p[2] * q[0])
        + each[1, 2] * (p[1] * q[2] + p[2] * q[1])
        + common * (p[0] + p[1] + p[2]) * (q[0] + q[1] + q[2])
    )


@njit(fastmath=FASTMATH_CONTRACT)
def _fill_state_covariance(variance, own, each):  # type: ignore[no-untyped-def]
    """Write a state's own covariance to `each`, (3, 3): noise and the triangle of its own error."""
    each[0, 0] = variance[0] + own[0]
    each[1, 1] = variance[1] + own[3]
    each[2, 2] = variance[2] + own[5]
    each[0, 1] = each[1, 0] = own[1]
    each[0, 2] = each[2, 0] = own[2]
    each[1, 2] = each[2, 1] = own[4]


@njit(fastmath=FASTMATH_CONTRACT)
def _dot(p, q):  # type: ignore[no-untyped-def]
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@njit(fastmath=FASTMATH_CONTRACT)
def _blood(cells, w, log_rgb, a, b, color):  # type: ignore[no-untyped-def]
    """Return the blood, as a fraction of its axis, that fits a log color at a given melanin.

    On return `color` holds value and derivatives there.
    """
    rest = np.empty(3)
    before, cost_before = b, np.inf
    step = 0.0
    for _ in range(MAX_SHARED_STEPS):
        _color(cells, a, b, color)
        for c in range(3):
            rest[c] = log_rgb[c] - color[0, c]
        weighted = _times(w, color[2])
        cost = _dot(rest, _times(w, rest))
        if cost > cost_before * (1.0 + 1e-9):
            # overshot: return half of the way
            b = 0.5 * (b + before)
            if abs(b - before) < SHARED_STEP_TOL:
                b = before
                _color(cells, a, b, color)
                break
            continue
        before, cost_before = b, cost
        curvature = _dot(weighted, color[2])
        step = _dot(weighted, rest) / (curvature + 1e-12)
        step = min(max(step, -MAX_BLOOD_STEP), MAX_BLOOD_STEP)
        b = min(max(b + step, _MIN_AXIS_FRACTION), 1.0)
        if abs(b - before) < SHARED_STEP_TOL:
            _color(cells, a, b, color)
            break
    return b


@njit(
    void(
        readonly_array_type(float32, 3),  # log rgb (s, n, 3)
        readonly_array_type(float32, 3),  # relative variance (s, n, 3)
        readonly_array_type(boolean, 2),  # usable (s, n)
        readonly_array_type(float32, 2),  # where to begin: fractions of the axes (n, 2)
        readonly_array_type(
            float64, 3
        ),  # upper triangle of each state's own covariance (s, n or 1, 6)
        readonly_array_type(float64, 5),  # cells of the color table
        float32[:, ::1],  # mean log color as of skin with the mean blood (n, 3)
        float32[:, ::1],  # its relative variance, noise alone (n, 3)
        int64,  # first pixel
        int64,  # pixel after the last
    ),
    **BLOCK_KERNEL_OPTIONS,
)
def average_state_colors(  # type: ignore[no-untyped-def]
    log_rgb, variance, usable, begin, owns, cells, mean, mean_variance, first, last
):
    """Average the states' colors at the mean blood; shapes are in the signature."""
    states = usable.shape[0]
    w = np.empty((3, 3))
    color = np.empty((3, 3))
    level = np.empty((3, 3))
    each = np.empty((3, 3))
    nothing = np.zeros((3, 3))
    here = np.empty(3)
    blood = np.empty(states)
    share = np.empty(states)
    for n in range(first, last):
        a, b = float64(begin[n, 0]), float64(begin[n, 1])
        total = 0.0
        middle = 0.0
        for s in range(states):
            share[s] = 0.0
            if not usable[s, n]:
                continue
            for c in range(3):
                here[c] = log_rgb[s, n, c]
            _fill_state_covariance(variance[s, n], owns[s, n if owns.shape[1] > 1 else 0], each)
            _weights(each, nothing, 0.0, w)
            blood[s] = _blood(cells, w, here, a, b, color)
            share[s] = 1.0 / (each[0, 0] + each[1, 1] + each[2, 2])
            total += share[s]
            middle += share[s] * blood[s]
        for c in range(3):
            mean[n, c] = np.nan if total == 0.0 else 0.0
            mean_variance[n, c] = 0.0
        if total == 0.0:
            continue
        middle /= total
        _color(cells, a, middle, level)
        for s in range(states):
            if share[s] == 0.0:
                continue
            part = share[s] / total
            _color(cells, a, blood[s], color)
            for c in range(3):
                mean[n, c] += part * (log_rgb[s, n, c] - color[0, c] + level[0, c])
                mean_variance[n, c] += part * part * variance[s, n, c]


@njit(
    void(
        readonly_array_type(float32, 3),  # log rgb (s, n, 3)
        readonly_array_type(float32, 3),  # relative variance (s, n, 3)
        readonly_array_type(boolean, 2),  # usable (s, n)
        readonly_array_type(float32, 2),  # mean log color (n, 3), as of `average_state_colors`
        readonly_array_type(float32, 2),  # log shading of each state, up to a factor (s, n)
        readonly_array_type(float32, 2),  # one over its variance (s, n); 0 everywhere: free
        readonly_array_type(
            float32, 2
        ),  # melanin and where blood begins: fractions of the axes (n, 2)
        readonly_array_type(
            float32, 1
        ),  # standard error of melanin, as a fraction of its axis (n,)
        readonly_array_type(
            float64, 3
        ),  # covariance of the model error common to the states (n or 1, 3, 3)
        readonly_array_type(
            float64, 3
        ),  # upper triangle of each state's own covariance (s, n or 1, 6)
        readonly_array_type(float64, 5),  # cells of the color table
        float64,  # end of the axis of melanin as a volume fraction
        float64,  # end of the axis of blood as a volume fraction
        int64,  # state that changes are taken from
        float32[:, ::1],  # maps of the pixels (1, n): see PIXEL_MAPS
        float32[:, :, ::1],  # maps of the states (8, s, n): see STATE_MAPS
        int64,  # first pixel
        int64,  # pixel after the last
    ),
    **BLOCK_KERNEL_OPTIONS,
)
def fit_state_blood(  # type: ignore[no-untyped-def]
    log_rgb,
    variance,
    usable,
    mean,
    log_change,
    stiffness,
    begin,
    melanin_stderr,
    commons,
    owns,
    cells,
    melanin_end,
    end,
    reference,
    pixel_maps,
    state_maps,
    first,
    last,
):
    """Fit the blood of every state given the shared melanin; shapes are in the signature.

    Errors are linear in the noise n_s of each state, in their mean n, and in the model error e that
    all states share. For the mean color: melanin B (n + e), and brightness T (n + e) given melanin.
    For a state: blood A_s (n_s + e - errors of melanin and brightness).
    """
    states = usable.shape[0]
    w = np.empty((3, 3))
    color = np.empty((3, 3))
    noise = np.empty((3, 3))
    nothing = np.zeros((3, 3))
    here = np.empty(3)
    rest = np.empty(3)
    each = np.empty((states, 3, 3))  # E_s: own covariance of a state, without brightness
    level = np.empty(states)  # variance of its brightness
    share = np.empty(states)  # weight in the mean
    own_row = np.empty((states, 3))  # derivative of blood by the state's own color
    mean_row = np.empty((states, 3))  # derivative by the mean color
    extra_row = np.empty(states)  # derivative by the further error of melanin
    by_melanin = np.empty(3)  # B
    by_blood = np.empty(3)  # derivative of the mean blood at fixed melanin
    by_brightness = np.empty(3)  # T
    one = np.empty(3)
    two = np.empty(3)
    for n in range(first, last):
        a = float64(begin[n, 0])
        common = commons[n if len(commons) > 1 else 0]
        pixel_maps[0, n] = np.nan
        total = 0.0
        for s in range(states):
            for m in range(8):
                state_maps[m, s, n] = np.nan
            share[s] = 0.0
            if not (usable[s, n] and a == a):
                continue
            _fill_state_covariance(variance[s, n], owns[s, n if owns.shape[1] > 1 else 0], each[s])
            level[s] = 1.0 / stiffness[s, n] if stiffness[s, n] > 0.0 else 0.0
            share[s] = 1.0 / (each[s, 0, 0] + each[s, 1, 1] + each[s, 2, 2])
            total += share[s]
        if total == 0.0:
            continue
        noise[:, :] = 0.0
        noise_level = 0.0
        usual_change = 0.0
        for s in range(states):
            share[s] /= total
            if share[s] > 0.0:
                for c in range(3):
                    for k in range(3):
                        noise[c, k] += share[s] * share[s] * each[s, c, k]
                noise_level += share[s] * share[s] * level[s]
                usual_change += share[s] * log_change[s, n]
        # the mean color: blood and brightness given the melanin, and their linear errors
        for c in range(3):
            here[c] = mean[n, c]
        bright = _weights(noise, common, 0.0, w)
        middle = _blood(cells, w, here, a, float64(begin[n, 1]), color)
        u, v = _times(w, color[1]), _times(w, color[2])
        aa, ab, bb = _dot(u, color[1]), _dot(u, color[2]), max(_dot(v, color[2]), 1e-12)
        determinant = max(aa * bb - ab * ab, 1e-9 * aa * bb) + 1e-300
        for c in range(3):
            rest[c] = here[c] - color[0, c]
            by_melanin[c] = (bb * u[c] - ab * v[c]) / determinant
            by_blood[c] = v[c] / bb
        brightness = _dot(bright, rest)
        reddening = _dot(bright, color[2])
        for c in range(3):
            by_brightness[c] = bright[c] - reddening * by_blood[c]
        darkening = _dot(by_brightness, color[1])
        # the posterior's half-width replaces the linear estimate: a prior shrinks it, a second
        # solution adds `extra` to it
        linear = _dot(by_melanin, _times(common, by_melanin))
        linear += _form(noise, noise_level, by_melanin, by_melanin)
        wanted = float64(melanin_stderr[n]) ** 2
        shrink = min(1.0, math.sqrt(wanted / max(linear, 1e-300)))
        extra = max(wanted - linear, 0.0)
        for c in range(3):
            by_melanin[c] *= shrink
            by_brightness[c] -= darkening * by_melanin[c]
        noise_alone = _form(noise, noise_level, by_melanin, by_melanin)
        pixel_maps[0, n] = math.sqrt(max(noise_alone, 0.0)) * 3.0 * melanin_end * a * a
        for s in range(states):
            if share[s] == 0.0:
                continue
            moved = brightness + log_change[s, n] - usual_change
            for c in range(3):
                here[c] = log_rgb[s, n, c] - moved
            bright = _weights(each[s], nothing, float64(stiffness[s, n]), w)
            b = _blood(cells, w, here, a, middle, color)
            weighted = _times(w, color[2])
            information = max(_dot(weighted, color[2]), 1e-12)
            for c in range(3):
                rest[c] = here[c] - color[0, c]
            misfit = _dot(rest, _times(w, rest))
            axis = 3.0 * end * b * b
            gray = (weighted[0] + weighted[1] + weighted[2]) / information
            dark = _dot(weighted, color[1]) / information
            for c in range(3):
                own_row[s, c] = axis * weighted[c] / information
                mean_row[s, c] = -axis * (dark * by_melanin[c] + gray * by_brightness[c])
            extra_row[s] = -axis * (dark - gray * darkening)
            state_maps[0, s, n] = end * b * b * b
            state_maps[5, s, n] = math.sqrt(max(misfit, 0.0))
            state_maps[6, s, n] = moved + _dot(bright, rest)
            # variance of the brightness by this state's color alone
            reddening = _dot(bright, color[2])
            for c in range(3):
                one[c] = bright[c] - reddening * weighted[c] / information
            state_maps[7, s, n] = _form(each[s], 0.0, one, one)
        for s in range(states):
            if share[s] == 0.0:
                continue
            by_noise = _form(each[s], level[s], own_row[s], own_row[s])
            by_noise += 2.0 * share[s] * _form(each[s], level[s], own_row[s], mean_row[s])
            by_noise += _form(noise, noise_level, mean_row[s], mean_row[s])
            by_noise = max(by_noise, 0.0)
            for c in range(3):
                one[c] = own_row[s, c] + mean_row[s, c]
            whole = by_noise + _dot(one, _times(common, one)) + extra_row[s] ** 2 * extra
            state_maps[1, s, n] = math.sqrt(max(whole, 0.0))
            state_maps[2, s, n] = math.sqrt(by_noise)
            r = reference
            if share[r] == 0.0:
                continue
            state_maps[3, s, n] = state_maps[0, s, n] - state_maps[0, r, n]
            state_maps[4, s, n] = 0.0
            if s == r:
                continue
            for c in range(3):
                two[c] = mean_row[s, c] - mean_row[r, c]
                one[c] = two[c] + own_row[s, c] - own_row[r, c]
            changed = _form(each[s], level[s], own_row[s], own_row[s])
            changed += _form(each[r], level[r], own_row[r], own_row[r])
            changed += _form(noise, noise_level, two, two)
            changed += 2.0 * share[s] * _form(each[s], level[s], own_row[s], two)
            changed -= 2.0 * share[r] * _form(each[r], level[r], own_row[r], two)
            changed += _dot(one, _times(common, one))
            changed += (extra_row[s] - extra_row[r]) ** 2 * extra
            state_maps[4, s, n] = math.sqrt(max(changed, 0.0))
