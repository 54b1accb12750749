"""Smooth noisy values over a row of fibers with a cubic spline, and propagate their errors.

The second derivative over the root of the distance is white noise of one strength: near the source
profiles bend within less than a millimeter, far away over several. That is the cubic smoothing
spline; its errors are those of a Bayesian with a flat prior on straight lines. The strength is the
most probable one given the readings, with level and slope integrated out, and a prior from layered
skin: noise that hides all bends is not evidence that there are none.

References
----------
Wahba 1983, doi:10.1111/j.2517-6161.1983.tb01239.x: intervals of smoothing splines. Green and
Silverman 1994, Nonparametric Regression and Generalized Linear Models, section 2.1: the penalty.
"""

from typing import Final

import numpy as np

from reconstruction.arrays import Float64Array

BEND_STRENGTHS: Final = np.geomspace(1e-3, 1e3, 31)
"""Strengths of the second derivative by the root of mm, variance over a root of mm: from almost
straight lines to those that follow every fiber."""
PRIOR_STRENGTH, PRIOR_LOG_SIGMA = 1.0, 1.5
"""Prior of the strength: the median of simulated skin of two layers (presets I to VI, three sites,
seeds 0 to 19), and 1.5 times their standard deviation of the logarithm, 0.9."""
MIN_INFORMATION: Final = 1e-6
"""Information of a missing reading; keeps the system finite without any."""


def smooth_misfit(
    radius_mm: Float64Array, value: Float64Array, variance: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Smooth noisy values over the distance; return curves and their covariances.

    Parameters
    ----------
    radius_mm
        Distances of the fibers, mm, at least three, no two alike, any order, (F,).
    value, variance
        At each fiber, independent errors, (N, F); infinite variance where nothing was read.

    Returns
    -------
    curve : ndarray, shape (N, F)
        Also where nothing was read: continued as a straight line.
    covariance : ndarray, shape (N, F, F)

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radius = 0.3 + 0.25 * np.arange(28)
    >>> noisy = 0.1 * np.sin(radius) + 0.05 * rng.standard_normal((1, 28))
    >>> curve, covariance = smooth_misfit(radius, noisy, np.full((1, 28), 0.05**2))
    >>> bool(np.abs(curve - 0.1 * np.sin(radius)).max() < 0.06)
    True
    >>> bool(np.sqrt(covariance[0, 14, 14]) < 0.03)
    True
    """
    order = np.argsort(radius_mm)
    bend, mass = _bends(np.sqrt(radius_mm[order]))
    weight = np.full(variance.shape, MIN_INFORMATION)
    np.divide(1.0, variance, out=weight, where=variance < 1.0 / MIN_INFORMATION)
    known = np.where(weight > MIN_INFORMATION, value, 0.0)
    likely = log_posterior(bend, mass, known[:, order], weight[:, order])
    strength = BEND_STRENGTHS[likely.argmax(axis=1)]
    penalty = np.empty((order.size, order.size))
    penalty[np.ix_(order, order)] = bend @ np.linalg.solve(mass, bend.T)
    covariance = np.linalg.inv(_whole(weight, penalty, strength))
    return np.asarray((covariance @ (weight * known)[..., None])[..., 0]), np.asarray(covariance)


def log_posterior(
    bend: Float64Array, mass: Float64Array, value: Float64Array, weight: Float64Array
) -> Float64Array:
    """Return twice the log posterior of each of `BEND_STRENGTHS`, up to a constant.

    With Q and R of the penalty Q R^-1 Q' and W the weights, level and slope leave Q' y, of
    covariance s R + Q' W^-1 Q. It has five diagonals, so the steps are linear in the number of
    fibers.

    Parameters
    ----------
    bend, mass
        Q, (F, F - 2), and R, (F - 2, F - 2); fibers in the order of their positions.
    value, weight
        Readings, and one over their variances, > 0, (N, F).

    Returns
    -------
    ndarray, shape (N, S)
    """
    left = (value @ bend).T[..., None]
    # of s R + Q' W^-1 Q the diagonal and the two below it, each (F - 2, N, S)
    whole = [_below(bend, mass, 1.0 / weight, k) for k in range(3)]
    # Green and Silverman 1994, section 2.6.2: it is L D L', L with ones and two diagonals below
    pivot, lower, lowest, rest = (np.zeros_like(whole[0]) for _ in range(4))
    for k in range(mass.shape[0]):
        pivot[k], rest[k] = whole[0][k], left[k]
        if k > 0:
            pivot[k] -= lower[k - 1] ** 2 * pivot[k - 1]
            rest[k] -= lower[k - 1] * rest[k - 1]
            whole[1][k] -= lowest[k - 1] * lower[k - 1] * pivot[k - 1]
        if k > 1:
            pivot[k] -= lowest[k - 2] ** 2 * pivot[k - 2]
            rest[k] -= lowest[k - 2] * rest[k - 2]
        lower[k] = whole[1][k] / pivot[k]
        lowest[k] = whole[2][k] / pivot[k]
    usual = (np.log(BEND_STRENGTHS / PRIOR_STRENGTH) / PRIOR_LOG_SIGMA) ** 2
    return np.asarray(-(rest**2 / pivot + np.log(pivot)).sum(axis=0) - usual)


def _below(bend: Float64Array, mass: Float64Array, variance: Float64Array, by: int) -> Float64Array:
    """Return a diagonal of s R + Q' V Q for each strength, (F - 2, N, S); 0 past its end."""
    inner = np.arange(mass.shape[0] - by)
    pairs = bend[:, inner] * bend[:, inner + by]
    out = np.zeros((mass.shape[0], len(variance), BEND_STRENGTHS.size))
    out[: inner.size] = (variance @ pairs).T[..., None]
    out[: inner.size] += (mass[inner, inner + by])[:, None, None] * BEND_STRENGTHS
    return out


def _whole(weight: Float64Array, penalty: Float64Array, strength: Float64Array) -> Float64Array:
    """Return the sum of the information of readings and smoothness, (N, F, F)."""
    whole = penalty / strength[:, None, None]
    fibers = np.arange(penalty.shape[0])
    whole[:, fibers, fibers] += weight
    return np.asarray(whole)


def _bends(place: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return Q, (F, F - 2), and R, (F - 2, F - 2).

    The integral of the squared second derivative of the natural cubic spline through y is
    y' Q R^-1 Q' y.
    """
    step = np.diff(place)
    inner = np.arange(place.size - 2)
    bend = np.zeros((place.size, place.size - 2))
    bend[inner, inner] = 1.0 / step[:-1]
    bend[inner + 1, inner] = -1.0 / step[:-1] - 1.0 / step[1:]
    bend[inner + 2, inner] = 1.0 / step[1:]
    mass = np.diag((step[:-1] + step[1:]) / 3.0)
    mass[inner[:-1], inner[1:]] = mass[inner[1:], inner[:-1]] = step[1:-1] / 6.0
    return bend, mass
