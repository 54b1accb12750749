"""Evaluate the photon table, compiled (see `model.photon_table`)."""

# mypy: allow-untyped-defs

from math import exp, log, log1p, sqrt

from numba import njit, types

RADIUS_START, RADIUS_STEP, RADIUS_COUNT = log(0.005), 0.25, 41
"""Cubic B-splines over ln(r sigma_s'): first knot, distance of knots, coefficients."""
ROOT_SCALE, ROOT_STEP, ROOT_COUNT = 0.1, log(41.0) / 24.0, 27
"""Likewise over ln(1 + u/0.1) with u = sqrt(sigma_a/sigma_s') in [0, 4]."""
ROOT_END = 4.0
_READ_1, _READ_2 = (types.Array(types.float64, n, "C", readonly=True) for n in (1, 2))
_COEFFICIENT_TYPES = (_READ_1, _READ_1, _READ_2, _READ_1)
_RULE_TYPES = (
    *(types.Array(types.int64, n, "C", readonly=True) for n in (2, 1)),
    *(_READ_1, _READ_1),
)
_MAX_ROOT = 1e6  # upper clamp of u: exp(-u^2) has underflowed, u^4 is still finite
_ROOT_FLOOR = 1e-6  # lower clamp of u: slopes by sigma_a at 0 are limits, reached here to 1e-12


@njit(inline="always")
def _basis(t):
    """Return the four uniform cubic B-splines at t in [0, 1] of their interval, and slopes."""
    s = 1.0 - t
    t2, s2 = t * t, s * s
    return (
        s2 * s / 6.0,
        (3.0 * t2 * t - 6.0 * t2 + 4.0) / 6.0,
        (3.0 * s2 * s - 6.0 * s2 + 4.0) / 6.0,
        t2 * t / 6.0,
        -0.5 * s2,
        1.5 * t2 - 2.0 * t,
        2.0 * s - 1.5 * s2,
        0.5 * t2,
    )


@njit(
    types.void(*_COEFFICIENT_TYPES, *_RULE_TYPES, types.float64[:, :, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def evaluate(
    sigma_a, sigma_s_prime, coefficients, decay, groups, starts, log_distance, weight, out
):
    """Evaluate profiles and their derivatives by both coefficients.

    Parameters
    ----------
    sigma_a, sigma_s_prime
        1/mm, shape (N,); sigma_s_prime > 0.
    coefficients
        Splines of ln of the reduced reflectance, shape (RADIUS_COUNT, ROOT_COUNT).
    decay
        B-spline coefficients of kappa/u, shape (ROOT_COUNT,).
    groups
        Index of each column's radius, shape (1, F) for all rows or (N, F).
    starts, log_distance, weight
        Radius k is averaged over the distances starts[k] to starts[k + 1]: logarithms of mm, and
        weights.
    out
        1/mm^2, 1/mm, 1/mm, shape (3, N, F), written.
    """
    _, n_rows, n_columns = out.shape
    row = coefficients.shape[0]
    along = [0.0] * row
    along_slope = [0.0] * row
    last = ROOT_COUNT - 4
    for n in range(n_rows):
        s = sigma_s_prime[n]
        u = max(sqrt(sigma_a[n] / s), _ROOT_FLOOR)
        if u > _MAX_ROOT:
            for f in range(n_columns):
                out[0, n, f] = out[1, n, f] = out[2, n, f] = 0.0
            continue
        inside = u <= ROOT_END
        u_in = u if inside else ROOT_END
        place = log1p(u_in / ROOT_SCALE) / ROOT_STEP
        j = min(int(place), last)
        b0, b1, b2, b3, c0, c1, c2, c3 = _basis(place - j)
        place_slope = 1.0 / ((ROOT_SCALE + u_in) * ROOT_STEP)
        k = b0 * decay[j] + b1 * decay[j + 1] + b2 * decay[j + 2] + b3 * decay[j + 3]
        k_slope = c0 * decay[j] + c1 * decay[j + 1] + c2 * decay[j + 2] + c3 * decay[j + 3]
        kappa = u_in * k
        if inside:  # derivatives by sigma_a/sigma_s' = u^2
            kappa_kappa_slope = kappa * (k + u * k_slope * place_slope) / (2.0 * u)
            root_slope = place_slope / (2.0 * u)
        else:  # strong absorption: light decays like exp(-sigma_t s), whatever the scattering
            kappa += u * u - ROOT_END * ROOT_END
            kappa_kappa_slope = kappa
            root_slope = 0.0
        group = groups[n if groups.shape[0] > 1 else 0]
        log_s = log(s)
        low, high = row, 0
        for f in range(n_columns):
            for m in range(starts[group[f]], starts[group[f] + 1]):
                p = (log_distance[m] + log_s - RADIUS_START) / RADIUS_STEP
                i = max(0, min(int(p), row - 4))
                low, high = min(low, i), max(high, i)
        for i in range(low, high + 4):
            q0, q1 = coefficients[i, j], coefficients[i, j + 1]
            q2, q3 = coefficients[i, j + 2], coefficients[i, j + 3]
            along[i] = b0 * q0 + b1 * q1 + b2 * q2 + b3 * q3
            along_slope[i] = c0 * q0 + c1 * q1 + c2 * q2 + c3 * q3
        a = u * u
        for f in range(n_columns):
            total = by_a = by_s = 0.0
            for m in range(starts[group[f]], starts[group[f] + 1]):
                x = log_distance[m] + log_s
                p = (x - RADIUS_START) / RADIUS_STEP
                rho2 = exp(2.0 * x)
                beyond = 0.0
                if p < 0.0:  # near the source single scattering dominates: 1/r
                    beyond, p = p, 0.0
                elif p > row - 3.0:  # far from the source: diffusion
                    p = row - 3.0
                    beyond = 1.0
                i = min(int(p), row - 4)
                e0, e1, e2, e3, f0, f1, f2, f3 = _basis(p - i)
                value = e0 * along[i] + e1 * along[i + 1] + e2 * along[i + 2] + e3 * along[i + 3]
                slope = f0 * along[i] + f1 * along[i + 1] + f2 * along[i + 2] + f3 * along[i + 3]
                value_by_root = (
                    e0 * along_slope[i]
                    + e1 * along_slope[i + 1]
                    + e2 * along_slope[i + 2]
                    + e3 * along_slope[i + 3]
                )
                if beyond < 0.0:
                    value -= RADIUS_STEP * beyond
                    slope = -RADIUS_STEP
                elif beyond > 0.0:
                    slope = 0.0
                d2 = rho2 + 1.0
                d = sqrt(d2)
                reach = 1.0 + kappa * d
                reduced = weight[m] * reach / (d2 * d) * exp(value - kappa * d)
                by_log_a = value_by_root * root_slope - kappa_kappa_slope * d2 / reach
                by_log_rho = slope / RADIUS_STEP - rho2 * (kappa * kappa / reach + 3.0 / d2)
                total += reduced
                by_a += reduced * by_log_a
                by_s += reduced * by_log_rho
            out[0, n, f] = s * s * total
            out[1, n, f] = s * by_a
            out[2, n, f] = s * (2.0 * total + by_s - a * by_a)
