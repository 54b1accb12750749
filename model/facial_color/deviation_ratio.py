"""The ratio of two deviations, where one may be lost: an estimate under a stated prior.

Where the neutral map is nearly constant its deviation sigma_n tells little, and sigma_i/sigma_n
of Jimenez 2010, eq. (5), has no bound. Here the ratio s of a place is drawn beforehand from
Normal(rho, rho^2) with rho the ratio over the whole map, and what is seen is
sigma_i = s sigma_n + error with the variance delta^2. The posterior mean

    s = rho + rho^2 sigma_n (sigma_i - rho sigma_n) / (rho^2 sigma_n^2 + delta^2)

goes to rho as sigma_n goes to 0. For given sigma_i and delta it is nowhere farther from rho than
|sigma_i - rho sigma_n|/delta times rho/2, and delta is at least the sampling error of the disc.

The prior is as wide as the ratio itself: vessels may shut or double. It weighs as much as about
one independent piece of texture (a unit-information prior, Kass and Wasserman 1995,
doi:10.1080/01621459.1995.10476592): in a disc that holds n of them it moves the ratio by a share
of 1/n, and eq. (5) holds as it stands.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import BoolArray, Float64Array

ROUNDING_ERROR = float(np.finfo(np.float32).eps)
"""Relative error below which no map is trusted: that of the float32 it is stored in."""


@dataclass(frozen=True, slots=True, eq=False)
class RatioEstimate:
    """Estimated ratios, arrays of the shape of what they were estimated from."""

    value: Float64Array
    """Posterior mean, finite everywhere."""
    stderr: Float64Array
    """Posterior standard deviation, at most ``prior``."""
    prior: float
    """rho: what was expected before a place was looked at, and its standard deviation."""


def estimate_ratio(
    numerator: Float64Array, denominator: Float64Array, variance: Float64Array, valid: BoolArray
) -> RatioEstimate:
    """Estimate numerator / denominator under the prior that the map itself gives.

    Parameters
    ----------
    numerator, denominator
        Any shape, any common unit, >= 0.
    variance
        Of the numerator given the ratio, same shape, unit squared, >= 0.
    held
        Same shape: where they are known. Elsewhere the ratio is the prior's.

    Returns
    -------
    Ratio

    Examples
    --------
    >>> seen = np.array([0.0, 1e-9, 1.0, 2.0])
    >>> found = estimate_ratio(1.5 * seen + [0.1, 0.1, 0, 0], seen, np.full(4, 1e-6), seen >= 0)
    >>> found.value.round(2).tolist()
    [1.5, 1.5, 1.5, 1.5]
    """
    # one that is no number, or has no variance, would be in the prior of all
    known_of = [np.isfinite(x) for x in (numerator, denominator, variance)]
    valid = valid & np.logical_and.reduce(known_of) & (np.nan_to_num(variance) >= 0.0)
    a, b, v = (np.where(valid, x, 0.0) for x in (numerator, denominator, variance))
    prior = global_ratio(a, b)
    gain, error = prior**2 * b, prior**2 * b**2 + v
    there = error > 0.0
    value = prior + np.where(there, gain * (a - prior * b) / np.where(there, error, 1.0), 0.0)
    known = np.where(there, v / np.where(there, error, 1.0), 1.0)
    return RatioEstimate(value, np.where(valid, prior * np.sqrt(known), prior), prior)


def global_ratio(numerator: Float64Array, denominator: Float64Array) -> float:
    """Return the least-squares ratio over a map.

    1 where the denominator is 0 everywhere: nothing says that anything should change.
    """
    known = float(np.sum(denominator**2))
    return float(np.sum(numerator * denominator)) / known if known > 0.0 else 1.0
