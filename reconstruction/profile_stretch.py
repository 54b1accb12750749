"""How much farther or less far light spreads along each of several directions: profiles compared.

Along a direction in which light decays faster, a profile is the mean one drawn in over distance:
``R_i(r_k) = exp(b_i) m_k exp(G(r_k exp(d_i)) - G(r_k))``. ``d_i`` is the log of sigma_tr over that
of the mean profile, ``b_i`` the log of how well the head couples, ``m_k`` the mean reading of
fibre k, and G a smooth curve through log m.

No model of tissue is in it, and what is wrong with a fibre in all directions alike (its gain, its
distance, stray light) is in m_k. Readings are compared as they are, not as logarithms, so that
those lost in noise, even negative ones, count without bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

LEAST_FIBRES = 8
"""Six numbers describe G and two each direction: fewer fibres tell no stretch."""
FIBRE_SIGNAL = 3.0
"""Readings of a fibre, averaged over directions, that stand out of their errors so many times
count; a rule on each reading by itself would keep those that noise made large."""
CURVE_ERROR = 0.01
"""Relative error of logs of ratios, from a curve G that is only nearly that of tissue."""
ROUNDS = 12
LARGEST_STEP = 0.3
"""Of b and d in a round."""
LEAST_CHANGE = 1e-3
"""A mean reading stays above so much of what it was in the round before."""
LEAST_FLOOR = 1e-4
"""Relative error of readings whose variance is 0."""


@dataclass(frozen=True, slots=True)
class ProfileStretch:
    """Relative sigma_tr by direction, from N profiles of each of (...) series.

    Attributes
    ----------
    log_scale, stderr : ndarray, shape (N, ...)
        d, about a mean of 0, and its standard error from the variances; 0 and infinity where not
        valid.
    coupling : ndarray, shape (N, ...)
        b, about a mean of 0.
    valid : ndarray of bool, shape (N, ...)
    used : ndarray of bool, shape (..., F)
        Fibres that count.
    """

    log_scale: Floats
    stderr: Floats
    coupling: Floats
    valid: Bools
    used: Bools


def compare(
    radius_mm: Floats,
    reflectance_per_mm2: Floats,
    variance: Floats,
    valid: Bools,
    *,
    floor: float,
) -> ProfileStretch:
    """Compare profiles of several directions.

    Parameters
    ----------
    radius_mm : ndarray, shape (F,)
        Distances of the fibres, mm, above 0.
    reflectance_per_mm2, variance, valid : ndarray, shape (N, ..., F)
        Readings, 1/mm^2, their variances, and which count; the others may be anything.
    floor : float
        Relative error of each reading that variances do not know of, 0 or more.

    Returns
    -------
    ProfileStretch
    """
    n, fibres = reflectance_per_mm2.shape[0], radius_mm.size
    shape = reflectance_per_mm2.shape[1:-1]
    readings = reflectance_per_mm2.reshape(n, -1, fibres).transpose(1, 0, 2)
    variances = variance.reshape(n, -1, fibres).transpose(1, 0, 2)
    good = valid.reshape(n, -1, fibres).transpose(1, 0, 2)
    series = len(readings)
    d, stderr, b = np.zeros((series, n)), np.full((series, n), np.inf), np.zeros((series, n))
    told, used = np.zeros((series, n), bool), np.zeros((series, fibres), bool)
    for s in range(series):
        found = _series(radius_mm, readings[s], variances[s], good[s], floor)
        if found is not None:
            d[s], stderr[s], b[s], told[s], used[s] = found
    return ProfileStretch(
        d.T.reshape((n, *shape)),
        stderr.T.reshape((n, *shape)),
        b.T.reshape((n, *shape)),
        told.T.reshape((n, *shape)),
        used.reshape((*shape, fibres)),
    )


def _series(
    radius: Floats, readings: Floats, variances: Floats, good: Bools, floor: float
) -> tuple[Floats, Floats, Floats, Bools, Bools] | None:
    """Return d, its error, b, valid directions and used fibres of one series (N, F)."""
    n = len(readings)
    count = np.maximum(good.sum(axis=0), 1)
    mean = np.where(good, readings, 0.0).sum(axis=0) / count
    noise = np.sqrt(np.where(good, variances, 0.0).sum(axis=0) / count)
    used = (2 * good.sum(axis=0) > n) & (mean > FIBRE_SIGNAL * noise)
    told = (good & used).sum(axis=1) >= LEAST_FIBRES
    if not told.any():
        return None
    keep = (good & told[:, None])[:, used]
    y = np.where(keep, readings[:, used], 0.0)
    v = np.where(keep, variances[:, used], 0.0)
    r, m = radius[used], mean[used]
    # near fibres are not to decide alone about a curve that is only nearly theirs
    signal = np.minimum(m / np.maximum(noise[used], 1e-300), 1.0 / max(floor, LEAST_FLOOR))
    d, b = np.zeros(n), np.zeros(n)
    inverse = np.zeros((n, 2, 2))
    at_rest = _basis(r)
    for _ in range(ROUNDS):
        curve = np.linalg.lstsq(signal[:, None] * at_rest, signal * np.log(m), rcond=None)[0]
        scaled = r * np.exp(d)[:, None]
        shape = np.exp((_basis(scaled) - at_rest) @ curve + b[:, None])
        model = m * shape
        total = v + (max(floor, LEAST_FLOOR * (v == 0).any()) * model) ** 2
        weight = np.where(keep, 1.0 / total, 0.0)
        jacobian = np.stack([model, model * (_slopes(scaled) @ curve)], axis=-1)
        normal = np.einsum("nka,nk,nkb->nab", jacobian, weight, jacobian)
        normal[~told] = np.eye(2)
        inverse = np.linalg.inv(normal)
        step = np.einsum("nab,nkb,nk,nk->na", inverse, jacobian, weight, y - model)
        b[told] += np.clip(step[told, 0], -LARGEST_STEP, LARGEST_STEP)
        d[told] += np.clip(step[told, 1], -LARGEST_STEP, LARGEST_STEP)
        b[told] -= b[told].mean()
        d[told] -= d[told].mean()
        shape = np.exp((_basis(r * np.exp(d)[:, None]) - at_rest) @ curve + b[:, None])
        m = np.maximum(
            (weight * shape * y).sum(axis=0) / (weight * shape**2).sum(axis=0), LEAST_CHANGE * m
        )
    error = np.where(told, np.sqrt(inverse[:, 1, 1]), np.inf)
    return np.where(told, d, 0.0), error, np.where(told, b, 0.0), told, used


def _basis(r: Floats) -> Floats:
    """Return the functions that G is made of, r in mm.

    Of diffusion's and Monte Carlo profiles, 0.3...7 mm, they tell the log of a ratio to 1 %.
    """
    near = 1.0 / (1.0 + r)
    return np.stack([np.ones_like(r), np.log(r), r, np.sqrt(r), near, near**2], axis=-1)


def _slopes(r: Floats) -> Floats:
    """Return their derivatives by log r."""
    zero, near = np.zeros_like(r), 1.0 / (1.0 + r)
    return np.stack(
        [zero, zero + 1.0, r, 0.5 * np.sqrt(r), -r * near**2, -2.0 * r * near**3], axis=-1
    )
