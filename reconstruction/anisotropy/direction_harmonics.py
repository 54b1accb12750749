"""Weighted fits of the first two harmonics over directions, and their exact p-values.

``y = b0 + b1 cos theta + b2 sin theta + b3 cos 2 theta + b4 sin 2 theta``. Directions run along
the first axis of arrays, independent series along the second.

For normal errors whose ratios are known, the weighted sum of squares that two coefficients explain
over that of the residuals is F's with 2 degrees of freedom above, whose tail has a closed form:
``P(F > f) = (1 + 2 f / d)^(-d/2)``; for known errors, ``P(chi2 > x) = exp(-x/2)``.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from reconstruction.arrays import BoolArray, Float64Array, Int64Array

CONSTANT_COLUMNS, ODD_COLUMNS, AXIAL_COLUMNS = slice(0, 1), slice(1, 3), slice(3, 5)
"""Columns of `design_matrix`."""
MIN_DIRECTIONS = 5
"""Different directions without which nothing is said: three are fitted, two show the errors."""
MIN_FIRST_HARMONIC_DIRECTIONS = 8
"""Different directions from which the first harmonic is fitted, too."""
MAX_CONDITION_NUMBER = 50.0
"""Of the design matrix for an axis; directions close together do not tell a harmonic."""
MAX_FIRST_HARMONIC_CONDITION_NUMBER = 6.0
"""Beyond, directions do not go around: the first harmonic would cost more than it tells."""
OUTLIER_FALSE_ALARM_RATE = 1e-3
"""Chance that a fit loses a good direction as an outlier; no more is added to false alarms."""
DIRECTIONS_PER_OUTLIER = 8
"""One of so many directions may be left out as an outlier."""


def design_matrix(angle_rad: Float64Array) -> Float64Array:
    """Return the columns ``1, cos theta, sin theta, cos 2 theta, sin 2 theta``, (N, 5)."""
    return np.stack(
        [
            np.ones_like(angle_rad),
            np.cos(angle_rad),
            np.sin(angle_rad),
            np.cos(2 * angle_rad),
            np.sin(2 * angle_rad),
        ],
        axis=1,
    )


def count_distinct_directions(angle_rad: Float64Array, used: BoolArray) -> Int64Array:
    """Return how many different directions of a turn are used, (B,); to a millionth of a turn."""
    turns = np.round(np.mod(angle_rad / math.tau, 1.0) * 1e6).astype(np.int64) % 1_000_000
    same = turns == np.unique(turns)[:, None]
    return np.asarray((same.astype(np.int64) @ used.astype(np.int64) > 0).sum(axis=0))


@dataclass(frozen=True, slots=True)
class HarmonicFit:
    """Weighted least squares of the harmonics, B series at once.

    Attributes
    ----------
    coefficients : ndarray, shape (B, 5)
        b0...b4; 0 where not fitted.
    determined, has_first_harmonic : ndarray of bool, shape (B,)
        Constant and second harmonic are fitted; the first one is, too.
    residual : ndarray, shape (B,)
        Weighted sum of squared residuals.
    axial_power, first_harmonic_power : ndarray, shape (B,)
        Weighted sums of squares that the second and the first harmonic explain.
    dof : ndarray of int, shape (B,)
        Degrees of freedom of the residuals; 0 where not told.
    studentized : ndarray, shape (N, B)
        Deleted residuals over their standard errors: Student's t with one degree of freedom less
        than `dof`; 0 where that leaves fewer than 2.
    """

    coefficients: Float64Array
    determined: BoolArray
    has_first_harmonic: BoolArray
    residual: Float64Array
    axial_power: Float64Array
    first_harmonic_power: Float64Array
    dof: Int64Array
    studentized: Float64Array


def fit_harmonics(
    angle_rad: Float64Array, values: Float64Array, weight: Float64Array
) -> HarmonicFit:
    """Fit the harmonics that the directions tell.

    Parameters
    ----------
    angle_rad : ndarray, shape (N,)
    values, weight : ndarray, shape (N, B)
        A weight of 0 leaves a direction out. Weights in ratios of inverse variances.

    Returns
    -------
    HarmonicFit
    """
    x = design_matrix(angle_rad)
    n, count = values.shape
    used = weight > 0
    directions = count_distinct_directions(angle_rad, used)
    told, odd = np.zeros(count, bool), np.zeros(count, bool)
    for chosen, least, most, flag in (
        ([0, 3, 4], MIN_DIRECTIONS, MAX_CONDITION_NUMBER, told),
        ([0, 1, 2, 3, 4], MIN_FIRST_HARMONIC_DIRECTIONS, MAX_FIRST_HARMONIC_CONDITION_NUMBER, odd),
    ):
        # singular values of the design on used directions, whatever their weights
        gram = np.einsum("ni,nb,nj->bij", x[:, chosen], used.astype(float), x[:, chosen])
        eigenvalues = np.linalg.eigvalsh(gram)
        flag[:] = (directions >= least) & (eigenvalues[:, -1] <= most**2 * eigenvalues[:, 0])
    odd &= told
    coefficients = np.zeros((count, 5))
    leverage = np.zeros((n, count))
    axial, first, dof = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)
    root = np.sqrt(weight)
    for columns, series in (
        (np.array([0, 3, 4]), np.flatnonzero(told & ~odd)),
        (np.arange(5), np.flatnonzero(odd)),
    ):
        if not series.size:
            continue
        w = root[:, series].T[..., None]
        q, r = np.linalg.qr(w * x[:, columns])
        turned = np.einsum("bnp,nb,bn->bp", q, values[:, series], w[..., 0])
        inverse = np.linalg.inv(r)
        b = np.einsum("bij,bj->bi", inverse, turned)
        coefficients[np.ix_(series, columns)] = b
        # the last two columns of an orthogonal decomposition are what the others leave over
        axial[series] = (turned[:, -2:] ** 2).sum(axis=1)
        if columns.size == 5:
            spread = np.einsum("bij,bkj->bik", inverse[:, ODD_COLUMNS], inverse[:, ODD_COLUMNS])
            solved = np.linalg.solve(spread, b[:, ODD_COLUMNS, None])[..., 0]
            first[series] = (b[:, ODD_COLUMNS] * solved).sum(axis=1)
        leverage[:, series] = (q * q).sum(axis=2).T
        dof[series] = used[:, series].sum(axis=0) - columns.size
    error = (values - x @ coefficients.T) * root
    error[:, ~told] = 0.0
    residual = (error**2).sum(axis=0)
    left = np.maximum(1.0 - leverage, 1e-12)
    deleted = residual - error**2 / left
    # what rounding leaves of a residual is none
    deleted = np.maximum(deleted, 1e-12 * residual)
    enough = told & (dof >= 3) & (residual > 0)
    per_one = np.sqrt(np.where(enough, deleted / np.maximum(dof - 1, 1), 1.0) * left)
    per_one = np.maximum(per_one, np.finfo(np.float64).tiny)
    studentized = np.where(enough & used, error / per_one, 0.0)
    return HarmonicFit(coefficients, told, odd, residual, axial, first, dof, studentized)


def exclude_outliers(
    angle_rad: Float64Array, values: Float64Array, weight: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return the weights with those of outliers set to 0, and which ones these are, (N, B).

    One at a time the direction of largest deleted residual is left out, while that is less likely
    than `OUTLIER_FALSE_ALARM_RATE` over the number of directions, and at most one of
    `DIRECTIONS_PER_OUTLIER`.
    """
    kept = weight.copy()
    outlier = np.zeros(weight.shape, bool)
    most = (weight > 0).sum(axis=0) // DIRECTIONS_PER_OUTLIER
    active = np.arange(values.shape[1])
    for number in range(int(most.max(initial=0))):
        found = fit_harmonics(angle_rad, values[:, active], kept[:, active])
        size = np.abs(found.studentized)
        worst = size.argmax(axis=0)
        here = np.arange(active.size)
        n = np.maximum((kept[:, active] > 0).sum(axis=0), 1)
        chance = 2 * n * stats.t.sf(size[worst, here], np.maximum(found.dof - 1, 1))
        bad = (chance < OUTLIER_FALSE_ALARM_RATE / np.maximum(most[active], 1)) & (
            number < most[active]
        )
        outlier[worst[bad], active[bad]] = True
        kept[worst[bad], active[bad]] = 0.0
        active = active[bad]
        if not active.size:
            break
    return kept, outlier


def log_p_value(power: Float64Array, residual: Float64Array, dof: Int64Array) -> Float64Array:
    """Return log P that two coefficients explain so much, in errors that the residuals tell.

    Examples
    --------
    >>> from scipy import stats
    >>> p = np.exp(log_p_value(np.array([6.0]), np.array([11.0]), np.array([11])))
    >>> bool(np.isclose(p[0], stats.f.sf(3.0, 2, 11)))
    True
    """
    with np.errstate(divide="ignore"):
        share = np.where(power > 0, power / np.where(residual > 0, residual, 1.0), 0.0)
        share = np.where((power > 0) & (residual <= 0), math.inf, share)
    return np.asarray(-0.5 * dof * np.log1p(share))
