"""Trace photons through plane layers, compiled (see `rigsim.tissue.tissue_mc`)."""

from math import copysign, log, sqrt

import numpy as np
from numba import njit

TALLY_COUNT = 5
"""Scores ahead of the layers and rings: diffuse and unscattered reflectance, diffuse and
unscattered transmittance, weight removed minus weight added by the roulette."""

ROULETTE_MAX_WEIGHT = 1e-2  # weight below which a photon plays Russian roulette
ROULETTE_SURVIVAL = 0.1  # survival probability; survivors' weights are divided by it

_UNIFORM_STEP = 2.0**-53
_UINT64_TWO = np.uint64(2)
_RNG_SHIFTS = tuple(np.uint64(n) for n in (11, 17, 45, 19))


@njit(inline="always")
def draw_uniform(s0, s1, s2, s3):  # type: ignore[no-untyped-def]
    """Step xoshiro256+ (Blackman, Vigna 2021, doi:10.1145/3460772); uniform in (0, 1]."""
    word = s0 + s3
    t = s1 << _RNG_SHIFTS[1]
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= t
    s3 = (s3 << _RNG_SHIFTS[2]) | (s3 >> _RNG_SHIFTS[3])
    return s0, s1, s2, s3, (np.float64(word >> _RNG_SHIFTS[0]) + 1.0) * _UNIFORM_STEP


@njit(inline="always")
def draw_disc_point(s0, s1, s2, s3):  # type: ignore[no-untyped-def]
    """Draw a uniform point in the unit disc."""
    while True:
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        p = 2.0 * u - 1.0
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        q = 2.0 * u - 1.0
        if p * p + q * q <= 1.0:
            return s0, s1, s2, s3, p, q


@njit(inline="always")
def fresnel(mu_i, eta_i, eta_t):  # type: ignore[no-untyped-def]
    """Return unpolarized reflectance and the refracted ray's cosine; (1, 0) at total reflection."""
    ratio = eta_i / eta_t
    sin2_t = ratio * ratio * (1.0 - mu_i * mu_i)
    if sin2_t >= 1.0:
        return 1.0, 0.0
    mu_t = sqrt(1.0 - sin2_t)
    r_s = (eta_i * mu_i - eta_t * mu_t) / (eta_i * mu_i + eta_t * mu_t)
    r_p = (eta_t * mu_i - eta_i * mu_t) / (eta_t * mu_i + eta_i * mu_t)
    return 0.5 * (r_s * r_s + r_p * r_p), mu_t


@njit(inline="always")
def scatter_direction(s0, s1, s2, s3, ux, uy, uz, g):  # type: ignore[no-untyped-def]
    """Scatter a direction by the Henyey-Greenstein phase function of mean cosine g."""
    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
    if g == 0.0:
        cos_theta = 2.0 * u - 1.0
    else:
        part = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cos_theta = (1.0 + g * g - part * part) / (2.0 * g)
    # Azimuth from a point in the unit disc: cos 2a = (p^2 - q^2)/(p^2 + q^2).
    while True:
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        p = 2.0 * u - 1.0
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        q = 2.0 * u - 1.0
        pp = p * p
        qq = q * q
        norm = pp + qq
        if 0.0 < norm <= 1.0:
            break
    cos_phi = (pp - qq) / norm
    sin_phi = 2.0 * p * q / norm
    sin2_theta = max(0.0, 1.0 - cos_theta * cos_theta)
    sin2_z = 1.0 - uz * uz
    if sin2_z > 1e-10:
        bend = sqrt(sin2_theta / sin2_z)
        vx = bend * (ux * uz * cos_phi - uy * sin_phi) + ux * cos_theta
        vy = bend * (uy * uz * cos_phi + ux * sin_phi) + uy * cos_theta
        uz = uz * cos_theta - bend * sin2_z * cos_phi
        ux = vx
        uy = vy
    else:
        # Along the axis the origin of the azimuth is arbitrary.
        bend = sqrt(sin2_theta)
        ux = bend * cos_phi
        uy = bend * sin_phi
        uz = copysign(cos_theta, cos_theta * uz)
    return s0, s1, s2, s3, ux, uy, uz


@njit(cache=True, nogil=True, error_model="numpy")
def walk(table, ring_edges2, photons, seed, tally, events):  # type: ignore[no-untyped-def]
    """Trace photons that enter at the origin along +z and add their weights to `tally`.

    Parameters
    ----------
    table
        Row 0 the medium above, rows 1 to n the layers, row n + 1 the medium below; columns top,
        bottom (mm), sigma_t (1/mm), albedo, g, eta. float64, shape (n + 2, 6).
    ring_edges2
        Squares of the radii of the scoring rings in mm^2, float64, shape (rings + 1,).
    photons
        Photons to trace.
    seed
        State of the generator, not all zero, uint64, shape (4,).
    tally
        Sums of weights: the five of `TALLY_COUNT`, absorbed per layer, diffuse reflectance per
        ring.
        float64, shape (5 + n + rings,), added to.
    events
        Rows to fill for photons that return scattered: weight, r^2 in mm^2, path in each layer in
        mm. float64, shape (capacity, 2 + n); capacity 0 for none.

    Returns
    -------
    int
        Rows of `events` filled; photons beyond the capacity are tallied but not listed.
    """
    s0, s1, s2, s3 = seed[0], seed[1], seed[2], seed[3]
    n_layers = table.shape[0] - 2
    n_rings = ring_edges2.shape[0] - 1
    list_paths = events.shape[0] > 0
    path = np.zeros(n_layers)
    listed = 0
    specular = ((table[1, 5] - table[0, 5]) / (table[1, 5] + table[0, 5])) ** 2

    for _ in range(photons):
        x, y, z = 0.0, 0.0, 0.0  # position, mm
        ux, uy, uz = 0.0, 0.0, 1.0  # direction
        weight = 1.0 - specular
        layer = 1  # row of the table
        scattered = False
        if list_paths:
            path[:] = 0.0
        top = table[layer, 0]
        bottom = table[layer, 1]
        sigma_t = table[layer, 2]
        albedo = table[layer, 3]
        g = table[layer, 4]
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        depth_left = -log(u)  # optical depth to the next collision

        while True:
            gap = bottom - z if uz > 0.0 else z - top
            if depth_left * abs(uz) < sigma_t * gap:
                # A collision inside this layer.
                step = depth_left / sigma_t
                x += step * ux
                y += step * uy
                z += step * uz
                path[layer - 1] += step
                tally[TALLY_COUNT + layer - 1] += weight * (1.0 - albedo)
                weight *= albedo
                if weight < ROULETTE_MAX_WEIGHT:
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    if u > ROULETTE_SURVIVAL:
                        tally[4] += weight
                        break
                    tally[4] += weight - weight / ROULETTE_SURVIVAL
                    weight /= ROULETTE_SURVIVAL
                scattered = True
                s0, s1, s2, s3, ux, uy, uz = scatter_direction(s0, s1, s2, s3, ux, uy, uz, g)
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                depth_left = -log(u)
                continue

            # The next boundary comes first.
            step = gap / abs(uz)
            x += step * ux
            y += step * uy
            path[layer - 1] += step
            depth_left = max(0.0, depth_left - sigma_t * step)
            beyond = layer + 1 if uz > 0.0 else layer - 1
            z = bottom if uz > 0.0 else top
            eta = table[layer, 5]
            eta_beyond = table[beyond, 5]
            if eta != eta_beyond:
                reflected, mu_t = fresnel(abs(uz), eta, eta_beyond)
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                if u <= reflected:
                    uz = -uz
                    continue
                ux *= eta / eta_beyond
                uy *= eta / eta_beyond
                uz = copysign(mu_t, uz)
            if beyond == 0:
                if not scattered:
                    tally[1] += weight
                    break
                tally[0] += weight
                r2 = x * x + y * y
                ring = np.searchsorted(ring_edges2, r2, side="right") - 1
                if 0 <= ring < n_rings:
                    tally[TALLY_COUNT + n_layers + ring] += weight
                if listed < events.shape[0]:
                    events[listed, 0] = weight
                    events[listed, 1] = r2
                    for k in range(n_layers):
                        events[listed, 2 + k] = path[k]
                    listed += 1
                break
            if beyond == n_layers + 1:
                tally[2 if scattered else 3] += weight
                break
            layer = beyond
            top = table[layer, 0]
            bottom = table[layer, 1]
            sigma_t = table[layer, 2]
            albedo = table[layer, 3]
            g = table[layer, 4]
    return listed
