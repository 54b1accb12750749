"""What noisy readings along a row of fibres tell of something smooth, at all fibres.

The second derivative by the root of the distance is white noise of one strength: near the source
profiles bend within less than a millimetre, far away over several. That is the cubic smoothing
spline, and its errors are those of the Bayesian to whom straight lines cost nothing. The strength
is the likeliest by the readings, level and slope integrated out, and by what layers of skin are
like: readings whose noise hides all bends do not say that there are none.

References
----------
Wahba 1983, doi:10.1111/j.2517-6161.1983.tb01239.x: intervals of smoothing splines. Green and
Silverman 1994, Nonparametric Regression and Generalized Linear Models, section 2.1: the penalty.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

STRENGTHS: Final = np.geomspace(1e-3, 1e3, 31)
"""Of the second derivative by the root of mm, variance over a root of mm: from next to straight
lines to those that follow every fibre."""
USUAL, SPREAD = 1.0, 1.5
"""Of strengths: the median of simulated skin of two layers (presets I to VI, three sites, seeds 0
to 19), and a standard deviation of the logarithm half as large again as theirs, 0.9."""
WEAKEST: Final = 1e-6
"""Information of a reading that is none, so that even without any the rest is finite."""


def smooth_misfit(radius_mm: Floats, value: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return smooth curves through noisy values, and their covariances.

    Parameters
    ----------
    radius_mm
        Distances of the fibres, mm, at least three, no two alike, any order, (F,).
    value, variance
        At each fibre, independent errors, (N, F); infinite variance where nothing was read.

    Returns
    -------
    curve : ndarray, shape (N, F)
        Also where nothing was read: straight on.
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
    penalty = np.empty((order.size, order.size))
    penalty[np.ix_(order, order)] = _penalty(np.sqrt(radius_mm[order]))
    weight = np.full(variance.shape, WEAKEST)
    np.divide(1.0, variance, out=weight, where=variance < 1.0 / WEAKEST)
    weighed = np.where(weight > WEAKEST, weight * value, 0.0)
    best = np.full(len(value), -np.inf)
    strength = np.full(len(value), STRENGTHS[0])
    for each in STRENGTHS:
        whole = _whole(weight, penalty, np.full(len(value), each))
        curve = np.linalg.solve(whole, weighed[..., None])[..., 0]
        likely = (weighed * curve).sum(axis=1) - np.linalg.slogdet(whole)[1]
        likely -= (order.size - 2) * np.log(each) + (np.log(each / USUAL) / SPREAD) ** 2
        strength = np.where(likely > best, each, strength)
        best = np.maximum(likely, best)
    covariance = np.linalg.inv(_whole(weight, penalty, strength))
    return np.asarray((covariance @ weighed[..., None])[..., 0]), np.asarray(covariance)


def _whole(weight: Floats, penalty: Floats, strength: Floats) -> Floats:
    """Return the information of readings and smoothness, (N, F, F)."""
    whole = penalty / strength[:, None, None]
    fibres = np.arange(penalty.shape[0])
    whole[:, fibres, fibres] += weight
    return np.asarray(whole)


def _penalty(place: Floats) -> Floats:
    """Return the integral of the squared second derivative of natural cubic splines, (F, F)."""
    step = np.diff(place)
    inner = np.arange(place.size - 2)
    bend = np.zeros((place.size, place.size - 2))
    bend[inner, inner] = 1.0 / step[:-1]
    bend[inner + 1, inner] = -1.0 / step[:-1] - 1.0 / step[1:]
    bend[inner + 2, inner] = 1.0 / step[1:]
    mass = np.diag((step[:-1] + step[1:]) / 3.0)
    mass[inner[:-1], inner[1:]] = mass[inner[1:], inner[:-1]] = step[1:-1] / 6.0
    return np.asarray(bend @ np.linalg.solve(mass, bend.T))
