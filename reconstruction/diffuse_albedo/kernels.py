"""Fit R_d and a few white lobes together, point by point (Numba)."""

import math

import numpy as np
from numba import boolean, float32, float64, int64, njit, types, void

BECKMANN_ROUGHNESS = (0.13, 0.2, 0.3, 0.45)
"""Beckmann roughness of the lobes above the diffuse part; no tails."""
GGX_ROUGHNESS = (0.2, 0.35)
"""GGX roughness of those with tails. Wider ones of either resemble the diffuse part."""
N_FIT_STEPS = 8
LOBE_SHAPE_ERROR = 0.3
"""Relative error of a lobe's shape; lowers the weight of samples that a lobe covers."""
LOBE_ENTRY_SIGMAS = 1.5
"""Standard errors above which a lobe enters the fit."""
TUKEY_SIGMAS = 4.0
"""Standard deviations beyond which a residual has weight 0 (Tukey's biweight)."""
CLIP_SIGMAS = 1.5
CLIPPED_MEAN = 0.7784655
"""Mean of min(z^2, 1.5^2) over normal z: turns a clipped mean square into a variance."""
MIN_FACTOR_COSINE = 0.05

_N_LOBES = len(BECKMANN_ROUGHNESS) + len(GGX_ROUGHNESS)
_N_BECKMANN = len(BECKMANN_ROUGHNESS)
if _N_LOBES % 3:  # `_fill_lobe_equations` reads lobes in threes
    raise ImportError(f"lobes: got {_N_LOBES}, expected a multiple of 3; add or remove a roughness")
_ROUGHNESS_SQUARED = np.array(BECKMANN_ROUGHNESS + GGX_ROUGHNESS) ** 2


FAST_MATH = {"reassoc", "contract", "nsz", "arcp", "nnan", "ninf"}
"""Reordered sums of finite numbers, which run in whole vectors."""


@njit(inline="always")
def _fresnel(c, eta):  # type: ignore[no-untyped-def]
    t = math.sqrt(max(1.0 - (1.0 - c * c) / (eta * eta), 0.0))
    r_s = (c - eta * t) / max(c + eta * t, 1e-12)
    r_p = (eta * c - t) / max(eta * c + t, 1e-12)
    return 0.5 * (r_s * r_s + r_p * r_p)


@njit(inline="always")
def _exp(y):  # type: ignore[no-untyped-def]
    """Return exp(y) for y from -80 to 0 within 1e-10 of it: a series of y / 128, squared 7 times.

    Unlike that of the C library it is computed for whole vectors.
    """
    x = y * (1.0 / 128.0)
    e = 1.0 / 479001600.0
    for n in (39916800.0, 3628800.0, 362880.0, 40320.0, 5040.0, 720.0, 120.0, 24.0, 6.0, 2.0, 1.0):
        e = 1.0 / n + x * e
    e = 1.0 + x * e
    for _ in range(7):
        e = e * e
    return e


@njit(nogil=True)
def _pick_samples(f, variance, light, view, normal, valid, cosines, value, noise, used):  # type: ignore[no-untyped-def]
    """Write samples with light and view above the horizon one after another; return their number.

    ``cosines``: of light and view to the normal, and between them. ``value``, ``noise`` and
    ``used`` have a row per channel; ``used`` is 1 where the channel is valid, else 0.
    """
    count = 0
    for i in range(f.shape[0]):
        some = False
        for c in range(f.shape[1]):
            some |= valid[i, c]
        if not some:
            continue
        mu_l = mu_v = between = 0.0
        for a in range(3):
            mu_l += float64(light[i, a]) * normal[a]
            mu_v += float64(view[i, a]) * normal[a]
            between += float64(light[i, a]) * view[i, a]
        if not (mu_l >= MIN_FACTOR_COSINE and mu_v >= MIN_FACTOR_COSINE):
            continue
        cosines[0, count], cosines[1, count] = min(mu_l, 1.0), min(mu_v, 1.0)
        cosines[2, count] = max(min(between, 1.0), -1.0)
        for c in range(f.shape[1]):
            good = valid[i, c]
            used[c, count] = 1.0 if good else 0.0
            value[c, count] = f[i, c] if good else 0.0
            noise[c, count] = variance[i, c] if good else 1.0
        count += 1
    return count


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _fill_factors(mu_l, mu_v, between, eta, through, slope, squared_cos_h, facets):  # type: ignore[no-untyped-def]
    """Fill the unit diffuse BRDF, its relative change with the normal, and what lobes share."""
    for i in range(mu_l.size):
        to_light, to_view = mu_l[i], mu_v[i]
        passed = (1.0 - _fresnel(to_light, eta)) * (1.0 - _fresnel(to_view, eta))
        through[i] = passed / math.pi  # eq. (6)
        slope[i] = math.sqrt(max(1.0 / (to_light * to_light) - 1.0, 0.0))
        cos_d = math.sqrt(0.5 * (1.0 + between[i]))
        cos_h = min((to_light + to_view) / max(2.0 * cos_d, 1e-9), 1.0)
        squared_cos_h[i] = cos_h * cos_h
        facets[i] = _fresnel(cos_d, eta)


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _fill_lobe(mu_l, mu_v, squared_cos_h, facets, a2, has_tail, lobe):  # type: ignore[no-untyped-def]
    """Fill a lobe of roughness squared ``a2``, GGX with a tail or else Beckmann."""
    for i in range(mu_l.size):
        mu, nu, c2 = mu_l[i], mu_v[i], squared_cos_h[i]
        hidden = nu * math.sqrt(a2 + (1.0 - a2) * mu * mu)
        hidden += mu * math.sqrt(a2 + (1.0 - a2) * nu * nu)
        if has_tail:
            tail = c2 * (a2 - 1.0) + 1.0
            density = a2 / (tail * tail)
        else:
            c2 = max(c2, 1e-4)
            per = 1.0 / c2
            density = _exp(max((c2 - 1.0) * per / a2, -80.0)) / a2 * per * per
        lobe[i] = density * facets[i] / (2.0 * math.pi * hidden)


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _weigh(  # type: ignore[no-untyped-def]
    value, noise, used, factors, x, scale2, tilt_rad, cut, total, pulled, weighted
):
    """Weight one channel's samples, and add its sums.

    ``factors``: diffuse part, its slope, and the sum of the lobes. ``total`` adds the weights,
    ``pulled`` the weighted samples; ``weighted`` is the weight times the diffuse part. Returns the
    clipped squares, the number of samples with a weight, and both sums of the diffuse part.
    """
    through, slope, shine = factors
    clipped = kept = own = against = 0.0
    for i in range(value.size):
        t, bright = through[i], shine[i]
        dull = x * t
        tilted, shaped = tilt_rad * slope[i] * dull, LOBE_SHAPE_ERROR * bright
        per = 1.0 / (noise[i] * scale2 + (tilted * tilted + shaped * shaped))
        r = value[i] - dull - bright
        z2 = r * r * per
        clipped += used[i] * min(z2, CLIP_SIGMAS * CLIP_SIGMAS)
        share = max(1.0 - z2 * (1.0 / (cut * cut)), 0.0)
        kept += used[i] if share > 0.0 else 0.0
        w = used[i] * share * share * per
        wt, wf = w * t, w * value[i]
        weighted[i] = wt
        total[i] += w
        pulled[i] += wf
        own += wt * t
        against += wf * t
    return clipped, kept, own, against


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _add_scaled(share, one, total):  # type: ignore[no-untyped-def]
    for i in range(total.size):
        total[i] += share * one[i]


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _multiply(a, b, out):  # type: ignore[no-untyped-def]
    for i in range(out.size):
        out[i] = a[i] * b[i]


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@njit(fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def _dot_three(a, b0, b1, b2):  # type: ignore[no-untyped-def]
    """Do three dot products at once: a is read from memory once."""
    s0 = s1 = s2 = 0.0
    for i in range(a.size):
        s0 += a[i] * b0[i]
        s1 += a[i] * b1[i]
        s2 += a[i] * b2[i]
    return s0, s1, s2


@njit(nogil=True)
def _fill_lobe_equations(lobe, total, pulled, weighted, scaled, h, rhs):  # type: ignore[no-untyped-def]
    """Fill the lobes' part of the normal equations, and mirror all of them."""
    channels = weighted.shape[0]
    for k in range(_N_LOBES):
        p = channels + k
        rhs[p] = _dot(lobe[k], pulled)
        if channels == 3:
            h[p, 0], h[p, 1], h[p, 2] = _dot_three(lobe[k], weighted[0], weighted[1], weighted[2])
        else:
            for c in range(channels):
                h[p, c] = _dot(lobe[k], weighted[c])
        _multiply(lobe[k], total, scaled)
        for j in range(0, k + 1, 3):  # in threes, of which some are not needed
            q = channels + j
            h[p, q], h[p, q + 1], h[p, q + 2] = _dot_three(
                scaled, lobe[j], lobe[j + 1], lobe[j + 2]
            )
    for i in range(h.shape[0]):
        for j in range(i):
            h[j, i] = h[i, j]


@njit(nogil=True)
def _factor(h, free, size, low):  # type: ignore[no-untyped-def]
    """Cholesky of the free unknowns; False where one is nearly dependent."""
    for i in range(size):
        for j in range(i + 1):
            s = h[free[i], free[j]]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            if i == j:
                if s <= 1e-9 * h[free[i], free[i]] or s <= 0.0:
                    return False
                low[i, i] = math.sqrt(s)
            else:
                low[i, j] = s / low[j, j]
    return True


@njit(nogil=True)
def _substitute(low, size, b):  # type: ignore[no-untyped-def]
    for i in range(size):
        for k in range(i):
            b[i] -= low[i, k] * b[k]
        b[i] /= low[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            b[i] -= low[k, i] * b[k]
        b[i] /= low[i, i]


@njit(nogil=True)
def _bounded(h, rhs, channels, free, low, b, x):  # type: ignore[no-untyped-def]
    """Solve h x = rhs with the lobes' shares at least 0; return the number of free unknowns."""
    size = channels
    for c in range(channels):
        free[c] = c
    barred = np.zeros(_N_LOBES, dtype=np.bool_)
    for _ in range(3 * _N_LOBES + 1):
        solved = _factor(h, free, size, low)
        worst = -1
        if solved:
            for i in range(size):
                b[i] = rhs[free[i]]
            _substitute(low, size, b)
            for i in range(channels, size):
                if b[i] <= 0.0 and (worst < 0 or b[i] < b[worst]):
                    worst = i
        elif size > channels:
            worst = size - 1
        else:
            return 0
        if worst >= 0:
            barred[free[worst] - channels] = True
            size -= 1
            for i in range(worst, size):
                free[i] = free[i + 1]
            continue
        x[:] = 0.0
        for i in range(size):
            x[free[i]] = b[i]
        best, entering = LOBE_ENTRY_SIGMAS, -1
        for k in range(_N_LOBES):
            p = channels + k
            if x[p] == 0.0 and not barred[k] and h[p, p] > 0.0:
                pull = rhs[p]
                for i in range(size):
                    pull -= h[p, free[i]] * x[free[i]]
                # the part of this lobe that the free unknowns cannot imitate
                for i in range(size):
                    b[i] = h[p, free[i]]
                _substitute(low, size, b)
                alone = h[p, p]
                for i in range(size):
                    alone -= h[p, free[i]] * b[i]
                if alone > 1e-9 * h[p, p] and pull / math.sqrt(alone) > best:
                    best, entering = pull / math.sqrt(alone), p
        if entering < 0:
            break
        free[size] = entering
        size += 1
    return size


@njit(
    void(
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 2, "C", readonly=True),
        types.Array(boolean, 3, "C", readonly=True),
        types.Array(float64, 2, "C", readonly=True),
        float64,
        float64,
        boolean,
        types.Array(float64, 2, "C"),
        types.Array(float64, 2, "C"),
        types.Array(int64, 2, "C"),
        int64,
        int64,
    ),
    cache=True,
    nogil=True,
)
def fit_envelope(  # type: ignore[no-untyped-def]
    f,
    variance,
    light,
    view,
    normal,
    valid,
    start,
    eta,
    tilt_rad,
    has_variance,
    r_d,
    stderr,
    counts,
    first,
    last,
):
    """Fill R_d (P, C), its standard error, and samples used and dropped (P, 2) of points.

    ``start`` is an initial R_d; ``tilt_rad`` the normals' standard error; ``has_variance`` whether
    the variances are known, rather than only their ratios.
    """
    _, samples, channels = f.shape
    for point in range(first, last):
        n = channels + _N_LOBES
        cosines = np.empty((3, samples))
        value = np.empty((channels, samples))
        noise = np.empty((channels, samples))
        used = np.empty((channels, samples))
        count = _pick_samples(
            f[point],
            variance[point],
            light[point],
            view[point],
            normal[point],
            valid[point],
            cosines,
            value,
            noise,
            used,
        )
        x = np.zeros(n)
        seen = np.empty(channels)
        for c in range(channels):
            seen[c] = used[c, :count].sum()
            x[c] = start[point, c]
            r_d[point, c] = stderr[point, c] = np.nan
        counts[point, 0] = counts[point, 1] = 0
        if count == 0 or seen.min() == 0.0:
            continue
        mu_l, mu_v = cosines[0, :count], cosines[1, :count]
        through = np.empty(count)  # unit diffuse BRDF, F_t F_t / pi
        slope = np.empty(count)  # its relative error per rad of the normal
        squared_cos_h = np.empty(count)
        facets = np.empty(count)  # Fresnel reflectance
        _fill_factors(mu_l, mu_v, cosines[2, :count], eta, through, slope, squared_cos_h, facets)
        lobe = np.empty((_N_LOBES, count))
        for k in range(_N_BECKMANN):
            a2 = _ROUGHNESS_SQUARED[k]
            _fill_lobe(mu_l, mu_v, squared_cos_h, facets, a2, False, lobe[k])
        for k in range(_N_BECKMANN, _N_LOBES):
            a2 = _ROUGHNESS_SQUARED[k]
            _fill_lobe(mu_l, mu_v, squared_cos_h, facets, a2, True, lobe[k])
        shine = np.empty(count)  # sum of the lobes
        total = np.empty(count)  # weight of all channels, which share the lobes
        pulled = np.empty(count)  # weighted samples of all channels
        weighted = np.empty((channels, count))  # weight times diffuse part
        scaled = np.empty(count)
        h = np.empty((n, n))
        rhs = np.empty(n)
        b = np.empty(n)
        low = np.empty((n, n))
        free = np.empty(n, dtype=np.int64)
        scale2 = np.ones(channels)  # of the given variances
        clipped = np.empty(channels)
        size = 0
        for step in range(N_FIT_STEPS):
            shine[:] = 0.0
            for k in range(_N_LOBES):
                if x[channels + k] != 0.0:
                    _add_scaled(x[channels + k], lobe[k], shine)
            total[:] = 0.0
            pulled[:] = 0.0
            h[:] = 0.0
            kept = 0.0
            # The first steps only refine the start: a wider cutoff
            cut = TUKEY_SIGMAS if step > 3 else TUKEY_SIGMAS * (2.0 ** (4 - step))
            for c in range(channels):
                clipped[c], own, h[c, c], rhs[c] = _weigh(
                    value[c, :count],
                    noise[c, :count],
                    used[c, :count],
                    (through, slope, shine),
                    x[c],
                    scale2[c],
                    tilt_rad,
                    cut,
                    total,
                    pulled,
                    weighted[c],
                )
                kept += own
            _fill_lobe_equations(lobe, total, pulled, weighted, scaled, h, rhs)
            if seen.min() < 3:  # too few samples to determine lobes
                for k in range(_N_LOBES):
                    h[channels + k, channels + k] = 0.0
            size = _bounded(h, rhs, channels, free, low, b, x)
            if size == 0:
                break
            for c in range(channels):
                grown = scale2[c] * clipped[c] / seen[c] / CLIPPED_MEAN
                if seen[c] > 3:
                    scale2[c] = max(grown, 1.0) if has_variance else max(grown, 1e-12)
            counts[point, 0] = int(kept)
            counts[point, 1] = int(seen.sum() - kept)
        if size == 0:
            continue
        for c in range(channels):
            b[:] = 0.0
            b[c] = 1.0
            _substitute(low, size, b)
            r_d[point, c] = x[c]
            if has_variance or seen[c] > 3:
                stderr[point, c] = math.sqrt(max(b[c], 0.0))
