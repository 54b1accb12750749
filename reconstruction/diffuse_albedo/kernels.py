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
_ROUGHNESS_SQUARED = np.array(BECKMANN_ROUGHNESS + GGX_ROUGHNESS) ** 2


@njit(inline="always")
def _fresnel(c, eta):  # type: ignore[no-untyped-def]
    t = math.sqrt(max(1.0 - (1.0 - c * c) / (eta * eta), 0.0))
    r_s = (c - eta * t) / max(c + eta * t, 1e-12)
    r_p = (eta * c - t) / max(eta * c + t, 1e-12)
    return 0.5 * (r_s * r_s + r_p * r_p)


@njit(nogil=True)
def _shapes(light, view, normal, eta, transmittance, slope, lobe):  # type: ignore[no-untyped-def]
    """Fill the unit diffuse BRDF, its relative change with the normal, and the lobes.

    Returns False for a light or view too near to the horizon.
    """
    mu_l = mu_v = between = 0.0
    for a in range(3):
        mu_l += float64(light[a]) * normal[a]
        mu_v += float64(view[a]) * normal[a]
        between += float64(light[a]) * view[a]
    if not (mu_l >= MIN_FACTOR_COSINE and mu_v >= MIN_FACTOR_COSINE):
        return False
    mu_l, mu_v = min(mu_l, 1.0), min(mu_v, 1.0)
    between = max(min(between, 1.0), -1.0)
    transmittance[0] = (
        (1.0 - _fresnel(mu_l, eta)) * (1.0 - _fresnel(mu_v, eta)) / math.pi
    )  # eq. (6)
    slope[0] = math.sqrt(1.0 / (mu_l * mu_l) - 1.0)
    cos_d = math.sqrt(0.5 * (1.0 + between))
    cos_h = min((mu_l + mu_v) / max(2.0 * cos_d, 1e-9), 1.0)
    f_r = _fresnel(cos_d, eta)
    for k in range(_N_LOBES):
        a2 = _ROUGHNESS_SQUARED[k]
        tail = cos_h * cos_h * (a2 - 1.0) + 1.0
        hidden = mu_v * math.sqrt(a2 + (1.0 - a2) * mu_l * mu_l) + mu_l * math.sqrt(
            a2 + (1.0 - a2) * mu_v * mu_v
        )
        density = a2 / (math.pi * tail * tail)
        if k < _N_BECKMANN:
            c2 = max(cos_h * cos_h, 1e-4)
            density = math.exp(max((c2 - 1.0) / (c2 * a2), -80.0)) / (math.pi * a2 * c2 * c2)
        lobe[k] = density * f_r / (2.0 * hidden)
    return True


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
        through = np.empty(samples)  # unit diffuse BRDF, F_t F_t / pi
        slope = np.empty(samples)  # its relative error per rad of the normal
        lobe = np.empty((samples, _N_LOBES))
        good = np.zeros(samples, dtype=np.bool_)
        h = np.empty((n, n))
        rhs = np.empty(n)
        x = np.zeros(n)
        b = np.empty(n)
        low = np.empty((n, n))
        free = np.empty(n, dtype=np.int64)
        scale2 = np.ones(channels)  # of the given variances
        seen = np.zeros(channels, dtype=np.int64)
        for i in range(samples):
            some = False
            for c in range(channels):
                some |= valid[point, i, c]
            if some:
                good[i] = _shapes(
                    light[point, i],
                    view[point, i],
                    normal[point],
                    eta,
                    through[i : i + 1],
                    slope[i : i + 1],
                    lobe[i],
                )
            if good[i]:
                for c in range(channels):
                    seen[c] += valid[point, i, c]
        for c in range(channels):
            x[c] = start[point, c]
            r_d[point, c] = stderr[point, c] = np.nan
        counts[point, 0] = counts[point, 1] = 0
        enough = True
        for c in range(channels):
            enough &= seen[c] > 0
        if not enough:
            continue
        size = 0
        for step in range(N_FIT_STEPS):
            h[:] = 0.0
            rhs[:] = 0.0
            used = 0
            dropped = 0
            clipped = np.zeros(channels)
            for i in range(samples):
                if not good[i]:
                    continue
                shine = 0.0
                for k in range(_N_LOBES):
                    shine += x[channels + k] * lobe[i, k]
                weight = 0.0  # of all channels, which share the lobes
                for c in range(channels):
                    if not valid[point, i, c]:
                        continue
                    dull = x[c] * through[i]
                    extra = (tilt_rad * slope[i] * dull) ** 2 + (LOBE_SHAPE_ERROR * shine) ** 2
                    spread = float64(variance[point, i, c]) * scale2[c] + extra
                    z2 = (f[point, i, c] - dull - shine) ** 2 / spread
                    clipped[c] += min(z2, CLIP_SIGMAS * CLIP_SIGMAS)
                    # The first steps only refine the start: a wider cutoff
                    cut = TUKEY_SIGMAS if step > 3 else TUKEY_SIGMAS * (2.0 ** (4 - step))
                    share = max(1.0 - z2 / (cut * cut), 0.0)
                    if share == 0.0:
                        dropped += 1
                        continue
                    used += 1
                    w = share * share / spread
                    t = through[i]
                    h[c, c] += w * t * t
                    rhs[c] += w * t * f[point, i, c]
                    weight += w
                    for k in range(_N_LOBES):
                        wide = w * lobe[i, k]
                        h[channels + k, c] += wide * t
                        rhs[channels + k] += wide * f[point, i, c]
                if weight > 0.0:
                    for k in range(_N_LOBES):
                        for j in range(k + 1):
                            h[channels + k, channels + j] += weight * lobe[i, k] * lobe[i, j]
            for i in range(n):
                for j in range(i):
                    h[j, i] = h[i, j]
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
            counts[point, 0], counts[point, 1] = used, dropped
        if size == 0:
            continue
        for c in range(channels):
            b[:] = 0.0
            b[c] = 1.0
            _substitute(low, size, b)
            r_d[point, c] = x[c]
            if has_variance or seen[c] > 3:
                stderr[point, c] = math.sqrt(max(b[c], 0.0))
