"""Fit the first two harmonics over directions with weights, and compute exact p-values.

``y = b0 + b1 cos theta + b2 sin theta + b3 cos 2 theta + b4 sin 2 theta``. Directions run along
the first axis of arrays, independent series along the second.

For normal errors of known ratios, the weighted sum of squares explained by two coefficients
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
"""Fewest distinct directions: three coefficients are fitted, two give the errors."""
MIN_FIRST_HARMONIC_DIRECTIONS = 8
"""Fewest distinct directions for a fit of the first harmonic."""
MAX_CONDITION_NUMBER = 50.0
"""Limit of the design matrix for an axis; close directions do not determine a harmonic."""
MAX_FIRST_HARMONIC_CONDITION_NUMBER = 6.0
"""Limit for the first harmonic: beyond it directions do not cover a turn, and it adds noise."""
OUTLIER_FALSE_ALARM_RATE = 1e-3
"""Probability that a fit excludes a good direction; the same adds to false alarms at most."""
DIRECTIONS_PER_OUTLIER = 8
"""Directions per excluded outlier."""


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
    """Return the number of distinct used directions, (B,), to a millionth of a turn."""
    turns = np.round(np.mod(angle_rad / math.tau, 1.0) * 1e6).astype(np.int64) % 1_000_000
    same = turns == np.unique(turns)[:, None]
    return np.asarray((same.astype(np.int64) @ used.astype(np.int64) > 0).sum(axis=0))


@dataclass(frozen=True, slots=True)
class HarmonicFit:
    """Weighted least-squares fit of the harmonics, B series at once.

    Attributes
    ----------
    coefficients : ndarray, shape (B, 5)
        b0...b4; 0 where not fitted.
    determined, has_first_harmonic : ndarray of bool, shape (B,)
        Whether constant and second harmonic, and whether also the first one, are fitted.
    residual : ndarray, shape (B,)
        Weighted sum of squared residuals.
    axial_power, first_harmonic_power : ndarray, shape (B,)
        Weighted sums of squares explained by the second and the first harmonic.
    dof : ndarray of int, shape (B,)
        Degrees of freedom of the residuals; 0 where not determined.
    studentized : ndarray, shape (N, B)
        Deleted residuals over their standard errors: Student's t with one degree of freedom less
        than `dof`; 0 if fewer than 2 remain.
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
    """Fit the harmonics that the directions determine.

    Parameters
    ----------
    angle_rad : ndarray, shape (N,)
    values, weight : ndarray, shape (N, B)
        Relative inverse variances; a weight of 0 omits a direction.

    Returns
    -------
    HarmonicFit
    """
    x = design_matrix(angle_rad)
    n, count = values.shape
    used = weight > 0
    directions = count_distinct_directions(angle_rad, used)
    determined, odd = np.zeros(count, bool), np.zeros(count, bool)
    for chosen, least, most, flag in (
        ([0, 3, 4], MIN_DIRECTIONS, MAX_CONDITION_NUMBER, determined),
        ([0, 1, 2, 3, 4], MIN_FIRST_HARMONIC_DIRECTIONS, MAX_FIRST_HARMONIC_CONDITION_NUMBER, odd),
    ):
        # singular values of the design on used directions, with equal weights
        gram = np.einsum("ni,nb,nj->bij", x[:, chosen], used.astype(float), x[:, chosen])
        eigenvalues = np.linalg.eigvalsh(gram)
        flag[:] = (directions >= least) & (eigenvalues[:, -1] <= most**2 * eigenvalues[:, 0])
    odd &= determined
    coefficients = np.zeros((count, 5))
    leverage = np.zeros((n, count))
    axial, first, dof = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)
    root = np.sqrt(weight)
    for columns, series in (
        (np.array([0, 3, 4]), np.flatnonzero(determined & ~odd)),
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
            # two coefficients b of covariance C explain b' C^-1 b of the sum of squares
            solved = np.linalg.solve(spread, b[:, ODD_COLUMNS, None])[..., 0]
            first[series] = (b[:, ODD_COLUMNS] * solved).sum(axis=1)
        leverage[:, series] = (q * q).sum(axis=2).T
        dof[series] = used[:, series].sum(axis=0) - columns.size
    error = (values - x @ coefficients.T) * root
    error[:, ~determined] = 0.0
    residual = (error**2).sum(axis=0)
    # omitting direction i lowers the sum of squares by e_i^2 / (1 - h_i), h_i its leverage
    left = np.maximum(1.0 - leverage, 1e-12)
    deleted = residual - error**2 / left
    # residuals within rounding count as 0
    deleted = np.maximum(deleted, 1e-12 * residual)
    enough = determined & (dof >= 3) & (residual > 0)
    per_one = np.sqrt(np.where(enough, deleted / np.maximum(dof - 1, 1), 1.0) * left)
    per_one = np.maximum(per_one, np.finfo(np.float64).tiny)
    studentized = np.where(enough & used, error / per_one, 0.0)
    return HarmonicFit(coefficients, determined, odd, residual, axial, first, dof, studentized)


def exclude_outliers(
    angle_rad: Float64Array, values: Float64Array, weight: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return the weights with those of outliers set to 0, and which ones these are, (N, B).

    One at a time the direction of largest deleted residual is excluded, if it is less probable
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
    """Return the log p-value of two coefficients with errors estimated from the residuals.

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
