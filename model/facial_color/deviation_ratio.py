"""Estimate the ratio of two standard deviations under a prior that bounds it near 0/0.

Where the neutral map is nearly constant its deviation sigma_n carries little information, and
sigma_i/sigma_n of Jimenez 2010, eq. (5), is unbounded. Here the prior of the local ratio s is
Normal(rho, rho^2), with rho the ratio over the whole map, and the observation is sigma_i = s
sigma_n + error with the variance delta^2. The posterior mean

    s = rho + rho^2 sigma_n (sigma_i - rho sigma_n) / (rho^2 sigma_n^2 + delta^2)

tends to rho as sigma_n tends to 0. For given sigma_i and delta its distance from rho is at most
|sigma_i - rho sigma_n|/delta times rho/2, and delta is at least the disc's sampling error.

The prior is as wide as the ratio itself: vessels may shut or double. It weighs as much as about one
independent piece of texture (a unit-information prior, Kass and Wasserman 1995,
doi:10.1080/01621459.1995.10476592): in a disc with n of them it moves the ratio by a fraction 1/n,
so that eq. (5) is nearly unchanged.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import BoolArray, Float64Array

ROUNDING_ERROR = float(np.finfo(np.float32).eps)
"""Smallest relative error of a map: the rounding of its float32 storage."""


@dataclass(frozen=True, slots=True, eq=False)
class RatioEstimate:
    """Estimated ratios, arrays of the shape of what they were estimated from."""

    value: Float64Array
    """Posterior mean, finite everywhere."""
    stderr: Float64Array
    """Posterior standard deviation, at most ``prior``."""
    prior: float
    """rho: mean and standard deviation of the prior."""


def estimate_ratio(
    numerator: Float64Array, denominator: Float64Array, variance: Float64Array, valid: BoolArray
) -> RatioEstimate:
    """Estimate numerator / denominator under the prior that the map itself gives.

    Parameters
    ----------
    numerator, denominator
        Any shape, any common unit, >= 0.
    variance
        Variance of the numerator given the ratio, same shape, unit squared, >= 0.
    valid
        Same shape: mask of known values. Elsewhere the result is the prior.

    Returns
    -------
    RatioEstimate

    Examples
    --------
    >>> seen = np.array([0.0, 1e-9, 1.0, 2.0])
    >>> found = estimate_ratio(1.5 * seen + [0.1, 0.1, 0, 0], seen, np.full(4, 1e-6), seen >= 0)
    >>> found.value.round(2).tolist()
    [1.5, 1.5, 1.5, 1.5]
    """
    # values that are not finite or have no variance would corrupt the common prior
    known_of = [np.isfinite(x) for x in (numerator, denominator, variance)]
    valid = valid & np.logical_and.reduce(known_of) & (np.nan_to_num(variance) >= 0.0)
    a, b, v = (np.where(valid, x, 0.0) for x in (numerator, denominator, variance))
    prior = global_ratio(a, b)
    # a = s b + noise of variance v, s ~ N(rho, rho^2): the conjugate posterior has the mean
    # rho + rho^2 b (a - rho b) / (rho^2 b^2 + v) and the variance rho^2 v / (rho^2 b^2 + v).
    gain, error = prior**2 * b, prior**2 * b**2 + v
    there = error > 0.0
    value = prior + np.where(there, gain * (a - prior * b) / np.where(there, error, 1.0), 0.0)
    known = np.where(there, v / np.where(there, error, 1.0), 1.0)
    return RatioEstimate(value, np.where(valid, prior * np.sqrt(known), prior), prior)


def global_ratio(numerator: Float64Array, denominator: Float64Array) -> float:
    """Return the least-squares ratio over a map.

    1 where the denominator is 0 everywhere: without information nothing changes.
    """
    known = float(np.sum(denominator**2))
    return float(np.sum(numerator * denominator)) / known if known > 0.0 else 1.0
