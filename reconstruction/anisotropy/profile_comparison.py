"""How much more or less tissue scatters along each of several directions: profiles compared.

Where scattering depends on the direction and absorption does not, the profile along direction i is
the mean one times what a model of tissue says that other scattering does to it::

    R_i(r_k) = exp(b_i) m_k T(r_k; sigma_a, sigma_s' exp(d_i)) / T(r_k; sigma_a, sigma_s')

``d_i`` is the log of sigma_s' over the mean, ``b_i`` the log of how well the head couples and
``m_k`` the mean reading of fibre k. T, `model.photon_table`, serves for differences alone: what is
wrong with a fibre in all directions alike (its gain, its distance, stray light) or with the model
is in m_k. Near the source more scattering is more light, far away it is less, so that neither is
mistaken for coupling. Readings are compared as they are, not as logarithms: those lost in noise,
even negative ones, count without bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from reconstruction.arrays import BoolArray, Float64Array

Table: TypeAlias = Callable[[Float64Array, Float64Array], tuple[Float64Array, Float64Array]]
"""sigma_a (B, 1, 1) and sigma_s' (B, N, 1) to T and dT / d sigma_s', (B, N, F)."""

MIN_COMPARED_FIBERS = 6
"""A direction has two numbers of its own; fewer fibres tell little beside them."""
MIN_FIBER_SIGNAL_SIGMAS = 3.0
"""Readings of a fibre, averaged over directions, that stand out of their errors so many times
count; a rule on each reading by itself would keep those that noise made large."""
LOG_RATIO_MODEL_ERROR = 0.05
"""Relative error of logs of ratios of sigma_tr, from a model whose scattering is the same in all
directions: against fits of each direction, and Monte Carlo of directed scattering."""
N_COMPARISON_ROUNDS = 10
MAX_COMPARISON_STEP = 0.3
"""Of b and d in a round."""
MIN_ROUND_RATIO = 1e-3
"""A mean reading stays above so much of what it was in the round before."""
MIN_READING_ERROR = 1e-4
"""Relative error of readings, where none is stated and a variance is 0."""


@dataclass(frozen=True, slots=True)
class ProfileComparison:
    """Relative sigma_s' by direction, from N profiles of each of B series.

    Attributes
    ----------
    log_scattering, stderr : ndarray, shape (N, B)
        d, about a mean of 0, and its standard error from the variances; 0 and infinity where not
        valid.
    coupling : ndarray, shape (N, B)
        b, about a mean of 0.
    valid : ndarray of bool, shape (N, B)
    used : ndarray of bool, shape (B, F)
        Fibres that count.
    """

    log_scattering: Float64Array
    stderr: Float64Array
    coupling: Float64Array
    valid: BoolArray
    used: BoolArray


def compare(
    readings: Float64Array,
    variance: Float64Array,
    valid: BoolArray,
    sigma_a_per_mm: Float64Array,
    sigma_s_prime_per_mm: Float64Array,
    table: Table,
    *,
    floor: float,
) -> ProfileComparison:
    """Compare profiles of several directions.

    Parameters
    ----------
    readings, variance, valid : ndarray, shape (N, B, F)
        Readings, 1/mm^2, their variances, and which count; the others may be anything.
    sigma_a_per_mm, sigma_s_prime_per_mm : ndarray, shape (B,)
        Of the mean profile, 1/mm; a series where one is not finite and above 0 is not valid.
    table : callable
        Model of tissue at the fibres' distances.
    floor : float
        Relative error of each reading that variances do not know of, 0 or more.

    Returns
    -------
    ProfileComparison
    """
    known = np.isfinite(sigma_a_per_mm) & np.isfinite(sigma_s_prime_per_mm)
    known &= (sigma_a_per_mm > 0) & (sigma_s_prime_per_mm > 0)
    a = np.where(known, sigma_a_per_mm, 1.0)[:, None, None]
    s = np.where(known, sigma_s_prime_per_mm, 1.0)[:, None, None]
    good = valid.transpose(1, 0, 2)
    y: Float64Array = np.where(good, readings.transpose(1, 0, 2), 0.0)
    v: Float64Array = np.where(good, variance.transpose(1, 0, 2), 0.0)
    series, n, _ = y.shape
    count = np.maximum(good.sum(axis=1), 1)
    m = y.sum(axis=1) / count
    noise = np.sqrt(v.sum(axis=1) / count)
    used = (2 * good.sum(axis=1) > n) & (m > MIN_FIBER_SIGNAL_SIGMAS * noise)
    used &= table(a, s)[0][:, 0] > 0
    told = ((good & used[:, None]).sum(axis=2) >= MIN_COMPARED_FIBERS) & known[:, None]
    keep = good & used[:, None] & told[..., None]
    m = np.asarray(np.where(used, m, 1.0)[:, None], np.float64)
    relative = np.where((keep & (v == 0)).any(axis=(1, 2)), max(floor, MIN_READING_ERROR), floor)
    relative = relative[:, None, None]
    at_mean = np.where(used[:, None], table(a, s)[0], 1.0)
    d, b = np.zeros((series, n)), np.zeros((series, n))
    inverse = np.zeros((series, n, 2, 2))
    members = np.maximum(told.sum(axis=1), 1)[:, None]
    for _ in range(N_COMPARISON_ROUNDS):
        scattering = s * np.exp(d)[..., None]
        light, slope = table(a, scattering)
        shape = light / at_mean * np.exp(b)[..., None]
        model = m * shape
        weight = np.where(keep, 1.0 / np.where(keep, v + (relative * model) ** 2, 1.0), 0.0)
        by_d = model * scattering * slope / np.where(light > 0, light, 1.0)
        off = y - model
        entries = [(weight * p * q).sum(axis=2) for p, q in ((model, model), (model, by_d))]
        entries.append((weight * by_d * by_d).sum(axis=2))
        bb, bd, dd = (
            np.where(told, e, fill) for e, fill in zip(entries, (1.0, 0.0, 1.0), strict=True)
        )
        normal = np.stack([np.stack([bb, bd], -1), np.stack([bd, dd], -1)], -2)
        inverse = np.linalg.inv(normal)
        right = np.stack(
            [(weight * model * off).sum(axis=2), (weight * by_d * off).sum(axis=2)], -1
        )
        step = np.clip(
            (inverse @ right[..., None])[..., 0], -MAX_COMPARISON_STEP, MAX_COMPARISON_STEP
        )
        b, d = (np.where(told, x + step[..., k], 0.0) for k, x in enumerate((b, d)))
        b, d = (np.where(told, x - x.sum(axis=1, keepdims=True) / members, 0.0) for x in (b, d))
        shape = table(a, s * np.exp(d)[..., None])[0] / at_mean * np.exp(b)[..., None]
        below = (weight * shape**2).sum(axis=1, keepdims=True)
        fresh = (weight * shape * y).sum(axis=1, keepdims=True) / np.where(below > 0, below, 1.0)
        m = np.where(below > 0, np.maximum(fresh, MIN_ROUND_RATIO * m), m)
    stderr = np.where(told, np.sqrt(inverse[..., 1, 1]), np.inf)
    return ProfileComparison(d.T, stderr.T, b.T, told.T, used & told.any(axis=1)[:, None])
