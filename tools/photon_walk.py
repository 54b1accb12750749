"""Trace photons in semi-infinite media for `tools/make_photon_table.py`.

The sampler (the generator sfc64, the walk, the scoring) is written for that table alone; the
simulated rigs have another one.
"""

from __future__ import annotations

from math import cos, exp, log, pi, sin, sqrt

import numpy as np
from numba import njit

ETAS = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6])
NUMERICAL_APERTURE = 0.22
LOG_RADIUS_START, LOG_RADIUS_STEP, RADIUS_BINS = log(0.005), 0.1, 94  # 0.005 to 60
LOG_PATH_START, LOG_PATH_STEP, PATH_BINS = log(0.005), 0.04, 333  # 0.005 to 3050
PATH_END = 3000.0
LATE_BIN = 316  # paths of 1541 and longer give the constant of the L^(-5/2) law
SHORT_BIN = 167  # up to 4 transport lengths
SPLIT_POWER, SPLIT_LIMIT = 0.6, 15.0
NARROW = 1.0 / 1.4**2  # fraction of the sine squared that the cone of eta = 1.4 fills
NARROW_SHARE = 0.75  # directions drawn in the cone of eta = 1.4, the others in that of eta = 1
STACK = 4096
_UNIT = 2.0**-53
_ELEVEN, _24, _3, _40, _ONE = (np.uint64(n) for n in (11, 24, 3, 40, 1))


@njit(inline="always")
def _draw(state):
    """Step sfc64 (C. Doty-Humphrey, PractRand); uniform in (0, 1]."""
    word = state[0] + state[1] + state[3]
    state[3] += _ONE
    state[0] = state[1] ^ (state[1] >> _ELEVEN)
    state[1] = state[2] + (state[2] << _3)
    state[2] = ((state[2] << _24) | (state[2] >> _40)) + word
    return (np.float64(word >> _ELEVEN) + 1.0) * _UNIT


@njit(inline="always")
def _reflected(mu, eta):
    """Return the Fresnel reflectance from inside at the cosine mu."""
    sin2 = eta * eta * (1.0 - mu * mu)
    if eta == 1.0:
        return 0.0
    if sin2 >= 1.0:
        return 1.0
    out = sqrt(1.0 - sin2)
    a = (eta * mu - out) / (eta * mu + out)
    b = (mu - eta * out) / (mu + eta * out)
    return 0.5 * (a * a + b * b)


@njit(inline="always")
def _cone_sine2(state, aperture2):
    """Draw a squared sine inside the cone of eta = 1; also its density over the uniform one."""
    if _draw(state) <= NARROW_SHARE:
        s = NARROW * aperture2 * _draw(state)
    else:
        s = aperture2 * _draw(state)
    density = 1.0 - NARROW_SHARE
    if s <= NARROW * aperture2:
        density += NARROW_SHARE / NARROW
    return s, density


@njit(inline="always")
def _score(hist, e, radius2, path, weight):
    i = int((0.5 * log(radius2 + 1e-300) - LOG_RADIUS_START) / LOG_RADIUS_STEP + 1.0)
    j = int((log(path) - LOG_PATH_START) / LOG_PATH_STEP)
    if i < 1 or i > RADIUS_BINS or j < 0 or j >= PATH_BINS:
        return
    hist[e, i - 1, j, 0] += weight
    hist[e, i - 1, j, 1] += weight * path


@njit(cache=True, nogil=True, error_model="numpy")
def walk(photons, seed, g, fiber, etas, path_end, hist):
    """Trace photons into `hist`, (etas, radii, paths, 2): weights and weights times path."""
    state = np.empty(4, np.uint64)
    for k in range(3):
        state[k] = seed[k]
    state[3] = _ONE
    for _ in range(16):
        _draw(state)
    n_eta = etas.size
    top = n_eta - 1
    sigma = 1.0 / (1.0 - g)
    aperture2 = NUMERICAL_APERTURE**2
    stack = np.empty((STACK, 9 + n_eta))
    v = np.empty(n_eta)
    collisions = 0
    for _photon in range(photons):
        x = y = z = path = 0.0
        ux = uy = 0.0
        uz = 1.0
        weight = 1.0
        for e in range(n_eta):
            v[e] = 1.0 - _reflected(1.0, etas[e])
        if fiber:
            s2, density = _cone_sine2(state, aperture2)
            uz = sqrt(1.0 - s2)
            ux = sqrt(s2)
            for e in range(n_eta):
                inside = s2 * etas[e] ** 2 <= aperture2
                v[e] = etas[e] ** 2 / density * (1.0 - _reflected(uz, etas[e])) if inside else 0.0
        check = 0.25
        depth = 0
        alive = True
        while True:
            if not alive:
                if depth == 0:
                    break
                depth -= 1
                x, y, z = stack[depth, 0], stack[depth, 1], stack[depth, 2]
                ux, uy, uz = stack[depth, 3], stack[depth, 4], stack[depth, 5]
                path, weight, check = stack[depth, 6], stack[depth, 7], stack[depth, 8]
                for e in range(n_eta):
                    v[e] = stack[depth, 9 + e]
                alive = True
            step = -log(_draw(state)) / sigma
            if z + uz * step < 0.0:  # up to the surface
                step = -z / uz
                x += ux * step
                y += uy * step
                z = 0.0
                path += step
                mu = -uz
                uz = mu
                reflected_top = _reflected(mu, etas[top])
                radius2 = x * x + y * y
                for e in range(n_eta):
                    if v[e] > 0.0:
                        reflected = _reflected(mu, etas[e])
                        if reflected < 1.0 and not fiber:
                            _score(hist, e, radius2, path, weight * v[e] * (1.0 - reflected))
                        v[e] *= reflected / reflected_top
                if _draw(state) > reflected_top:
                    alive = False
                continue
            x += ux * step
            y += uy * step
            z += uz * step
            path += step
            if path > path_end:
                alive = False
                continue
            collisions += 1
            if fiber and z * sigma < 14.0:
                s2, density = _cone_sine2(state, aperture2)
                mu = sqrt(1.0 - s2)
                tau = z * sigma / mu
                kept = exp(-tau)
                if tau > 3.0:
                    kept = 0.049787068367863944 if _draw(state) <= kept * exp(3.0) else 0.0
                if kept > 0.0:
                    sine = sqrt(s2)
                    phi = 2.0 * pi * _draw(state)
                    dx, dy = sine * cos(phi), sine * sin(phi)
                    c = ux * dx + uy * dy - uz * mu
                    h = 1.0 + g * g - 2.0 * g * c
                    phase = (1.0 - g * g) / (4.0 * pi * h * sqrt(h))
                    part = weight * kept * phase * pi / (mu * density)
                    px, py = x + dx * z / mu, y + dy * z / mu
                    radius2 = px * px + py * py
                    for e in range(n_eta):
                        if v[e] > 0.0 and s2 * etas[e] ** 2 <= aperture2:
                            through = 1.0 - _reflected(mu, etas[e])
                            _score(hist, e, radius2, path + z / mu, part * v[e] * through)
            # scatter
            if g == 0.0:
                c = 2.0 * _draw(state) - 1.0
            else:
                q = (1.0 - g * g) / (1.0 + g - 2.0 * g * _draw(state))
                c = (1.0 + g * g - q * q) / (2.0 * g)
                c = min(1.0, max(-1.0, c))
            a, b, h = 1.0, 1.0, 2.0
            while h > 1.0:  # von Neumann's azimuth: the doubled angle of a point in a disc
                a, b = 2.0 * _draw(state) - 1.0, 2.0 * _draw(state) - 1.0
                h = a * a + b * b
            sine = sqrt(1.0 - c * c) / h
            a, b = sine * (a * a - b * b), 2.0 * sine * a * b
            # frame about u by Duff et al. 2017 (JCGT 6:1)
            sign = 1.0 if uz >= 0.0 else -1.0
            m = -1.0 / (sign + uz)
            n = ux * uy * m
            tx, ty, tz = 1.0 + sign * ux * ux * m, sign * n, -sign * ux
            bx, by, bz = n, sign + uy * uy * m, -uy
            nx = a * tx + b * bx + c * ux
            ny = a * ty + b * by + c * uy
            nz = a * tz + b * bz + c * uz
            norm = 1.5 - 0.5 * (nx * nx + ny * ny + nz * nz)
            ux, uy, uz = nx * norm, ny * norm, nz * norm
            if path >= check:
                check = path + max(0.25, 0.05 * path)
                distance = 0.75 * (x * x + y * y) / path
                wanted = exp(-SPLIT_POWER * min(distance, SPLIT_LIMIT)) * sqrt(
                    max(1.0, 0.25 * path)
                )
                ratio = weight / wanted
                if ratio > 2.0 or ratio < 0.5:
                    ratio = min(ratio, 8.0)
                    copies = int(ratio + _draw(state) - 1e-16)
                    weight /= ratio
                    if copies == 0:
                        alive = False
                    for _ in range(min(copies - 1, STACK - depth)):
                        stack[depth, 0], stack[depth, 1], stack[depth, 2] = x, y, z
                        stack[depth, 3], stack[depth, 4], stack[depth, 5] = ux, uy, uz
                        stack[depth, 6], stack[depth, 7], stack[depth, 8] = path, weight, check
                        for e in range(n_eta):
                            stack[depth, 9 + e] = v[e]
                        depth += 1
    return collisions


def radius_edges():
    return np.exp(LOG_RADIUS_START + LOG_RADIUS_STEP * np.arange(RADIUS_BINS + 1))


def absorb(hist, absorptions):
    """Reweight one batch's histogram to absorptions: (etas, radii, absorptions)."""
    weight, moment = hist[..., 0], hist[..., 1]
    low = np.exp(LOG_PATH_START + LOG_PATH_STEP * np.arange(PATH_BINS))
    spread2 = (low * np.expm1(LOG_PATH_STEP)) ** 2 / 12.0
    path = np.where(weight > 0.0, moment / np.where(weight > 0.0, weight, 1.0), low)
    out = np.empty((*weight.shape[:2], absorptions.size))
    for k, a in enumerate(absorptions):
        out[..., k] = np.sum(weight * np.exp(-a * path) * (1.0 + 0.5 * a * a * spread2), axis=2)
    return out
