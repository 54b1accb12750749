"""Many radial profiles laid out for the fit: what is used, how it is weighed, where it begins."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincc

from reconstruction.arrays import BoolArray, Float64Array, Int64Array
from reconstruction.subsurface import levenberg_marquardt
from reconstruction.subsurface.models import ProfileModel

FEWEST_READINGS = 3
"""Fibres that must stand out of the noise by `SIGNAL` standard deviations."""
SIGNAL = 3.0
ROUNDS, STEPS = 4, 60
"""Times the model's error is weighed anew, and steps of a round at most."""
NEIGHBOURS = 7
"""Fibres to either side whose residuals tell the noise of one, without a variance."""
LEAST_DEVIATION = 1e-3
"""Relative deviation of a reading at least, without a variance."""
INITIAL_DEVIATION = 0.05
"""Likewise, for the first of the fits without a variance."""
START_ERROR = 0.1
"""Relative error added for the comparison with starts."""
MISFIT_CHANCE = 1e-3
"""A chi2 that chance exceeds so rarely is a misfit."""
OUTLIER = 6.0
MOST_OUTLIERS = 0.1
"""Standard deviations that make a fibre an outlier, and the share of fibres that may be such."""
NORMAL_MEDIAN = 1.4826
"""Standard deviation over the median of absolute deviations."""
UNLIKE = 0.1
"""Median relative residual from which a profile is compared by its logarithms."""
RISE = 50.0
"""A second valley of the misfit is tried when it begins no higher above the deepest."""


@dataclass(slots=True)
class ProfileBatch:
    """Profiles as the kernel takes them, and what it makes of them."""

    y: Float64Array
    """Reflectance, or its logarithm; 0 where not used."""
    variance: Float64Array
    """Of `y`, infinite where not used."""
    used: BoolArray
    logarithmic: bool
    prior: Float64Array
    seen: BoolArray
    """Readings that stand out of their noise."""
    theta: Float64Array
    covariance: Float64Array
    chi2: Float64Array
    predicted: Float64Array
    total: Float64Array
    """Variance of `y` with the model's error."""
    steps: Int64Array
    odd: BoolArray
    """Fibres left out as outliers."""
    spread: Float64Array
    """Relative model error found from the residuals, 0 without a misfit."""
    erring: bool = True
    """Whether `spread` is an error of what is estimated; not of what is nearest by definition."""

    @classmethod
    def of(
        cls, y: Float64Array, variance: Float64Array | None, used: BoolArray, prior: Float64Array
    ) -> ProfileBatch:
        """Lay out profiles (N, F)."""
        n, fibres = y.shape
        clean = np.where(used, y, 0.0)
        if variance is None:
            spread = np.where(used, INITIAL_DEVIATION**2, math.inf)
            seen = used
            clean = np.log(np.where(used, y, 1.0))
        else:
            spread = np.where(used, variance, math.inf)
            seen = used & (clean > SIGNAL * np.sqrt(spread))
        return cls(
            clean,
            spread,
            used.copy(),
            variance is None,
            prior,
            seen,
            np.zeros((n, 4)),
            np.zeros((n, 4, 4)),
            np.zeros(n),
            np.zeros((n, fibres)),
            np.zeros((n, fibres)),
            np.zeros(n, np.int64),
            np.zeros(y.shape, np.bool_),
            np.zeros(n),
        )

    def fit(self, model: ProfileModel, chosen: NDArray[np.intp]) -> None:
        """Fit some of the profiles from the best of the starts on."""
        y, variance, seen = self.y[chosen], self.variance[chosen], self.seen[chosen]
        if self.logarithmic:
            logs, weight = y, seen / START_ERROR**2
        else:
            safe = np.where(seen, y, 1.0)
            logs = np.log(safe)
            weight = np.zeros(y.shape)
            np.divide(1.0, variance / safe**2 + START_ERROR**2, out=weight, where=seen)
        g = float(self.prior[3, 0])
        best, second, rise = model.starts(logs, weight, g, float(self.prior[2, 1]))
        self.run(model, chosen, y, variance, best)
        doubt = np.flatnonzero(np.isfinite(rise) & ((rise < RISE) | self._misfits(chosen)))
        if doubt.size:
            self.run(model, chosen[doubt], y[doubt], variance[doubt], second[doubt], better=True)
        if self.logarithmic:
            for _ in range(2):
                off = np.where(seen, y - np.log(np.maximum(self.predicted[chosen], 1e-290)), 0.0)
                variance = _local_variance(model.radius_mm, off, seen)
                self.run(model, chosen, y, variance, self.theta[chosen])
        else:
            used = self.used[chosen].sum(axis=1)
            chance = gammaincc(np.maximum(used - 2, 1) / 2.0, self.chi2[chosen] / 2.0)
            told = seen.sum(axis=1) >= FEWEST_READINGS
            bad = np.flatnonzero((chance < MISFIT_CHANCE) & told)
            if bad.size:
                self._widen(model, chosen[bad], best[bad])
            far = np.flatnonzero((self._relative(chosen) > UNLIKE) & told)
            if far.size:
                self._compare_logarithms(model, chosen[far], logs[far], best[far], second[far])

    def _widen(self, model: ProfileModel, chosen: NDArray[np.intp], begin: Float64Array) -> None:
        """Fit profiles again that the model does not describe, with its error from the residuals.

        The same relative error at all fibres, so that the fit is the best in relative terms, as
        are the starts; a few fibres far off all others are left out. chi2 becomes that of the
        errors as they were.
        """
        y, variance, used = self.y[chosen], self.variance[chosen], self.used[chosen]
        wide = variance + (START_ERROR * np.abs(y)) ** 2
        self.run(model, chosen, y, wide, begin)
        most = np.floor(MOST_OUTLIERS * used.sum(axis=1))
        for _ in range(2):
            m = np.maximum(self.predicted[chosen], 1e-290)
            off = np.abs(y - m)
            relative = np.nanmedian(np.where(self.seen[chosen], off / m, math.nan), axis=1)
            spread = NORMAL_MEDIAN * relative[:, None] * m
            stated = variance + model.relative_variance(self.theta[chosen]) * m**2
            odd = used & (off > OUTLIER * np.sqrt(stated + spread**2))
            odd &= (odd.sum(axis=1) <= most)[:, None]
            wide = np.where(odd, math.inf, variance + spread**2)
            self.run(model, chosen, y, wide, self.theta[chosen])
        m = self.predicted[chosen]
        kept = used & ~odd
        stated = variance + model.relative_variance(self.theta[chosen]) * m**2
        fitted = self.chi2[chosen] - _sum_over(kept, (y - m) ** 2, self.total[chosen])
        self.chi2[chosen] = fitted + _sum_over(kept, (y - m) ** 2, stated)
        self.odd[chosen] = odd
        self.used[chosen] = kept
        self.seen[chosen] &= kept
        self.spread[chosen] = np.median(spread / np.maximum(m, 1e-290), axis=1)

    def _relative(self, chosen: NDArray[np.intp]) -> Float64Array:
        """Return the median of the relative residuals of what stands out of its noise."""
        off = np.abs(self.y[chosen] / np.maximum(self.predicted[chosen], 1e-290) - 1.0)
        seen = self.seen[chosen]
        told = np.asarray(seen.any(axis=1))
        shown = np.where(seen | ~told[:, None], off, math.nan)
        return np.asarray(np.where(told, np.nanmedian(shown, axis=1), 0.0))

    def _compare_logarithms(
        self,
        model: ProfileModel,
        chosen: NDArray[np.intp],
        logs: Float64Array,
        best: Float64Array,
        second: Float64Array,
    ) -> None:
        """Fit profiles of no such medium by their logarithms, from the best of the starts on.

        A linear residual over a share of the model is small where the model is far too bright, so
        that a profile that is off by tens of percent everywhere, as of layered tissue, is drawn to
        media that it does not look like. Logarithms do not care which of the two is larger. What
        does not stand out of its noise is left out.
        """
        y, variance = self.y[chosen], self.variance[chosen]
        seen = self.seen[chosen]
        own = np.full(y.shape, math.inf)
        np.divide(variance, np.where(seen, y, 1.0) ** 2, out=own, where=seen)
        wide = own + UNLIKE**2
        self.run(model, chosen, logs, wide, best, logarithmic=True)
        told = np.flatnonzero(np.isfinite(second).all(axis=1))
        self.run(
            model, chosen[told], logs[told], wide[told], second[told], better=True, logarithmic=True
        )
        for _ in range(2):
            off = np.where(seen, logs - np.log(np.maximum(self.predicted[chosen], 1e-290)), 0.0)
            # of scatter about a fit of two coefficients
            kept = np.maximum(seen.sum(axis=1), 3)
            spread = np.sqrt(np.maximum((off**2).sum(axis=1) / (kept - 2), LEAST_DEVIATION**2))
            wide = own + spread[:, None] ** 2
            self.run(model, chosen, logs, wide, self.theta[chosen], logarithmic=True)
        m = self.predicted[chosen]
        self.total[chosen] = np.where(seen, wide * m**2, math.inf)
        stated = variance + model.relative_variance(self.theta[chosen]) * m**2
        self.chi2[chosen] = _sum_over(seen, (y - m) ** 2, stated)
        self.odd[chosen] = False
        self.used[chosen] = seen
        self.spread[chosen] = spread

    def _misfits(self, chosen: NDArray[np.intp]) -> BoolArray:
        """Return which fits are so bad that another minimum may be better."""
        seen = self.seen[chosen].sum(axis=1)
        dof = np.maximum(seen - 2, 1)
        return (seen >= FEWEST_READINGS) & (
            (self.chi2[chosen] > dof + 4.0 * np.sqrt(2.0 * dof)) | (self.steps[chosen] < 0)
        )

    def run(
        self,
        model: ProfileModel,
        chosen: NDArray[np.intp],
        y: Float64Array,
        variance: Float64Array,
        theta: Float64Array,
        *,
        better: bool = False,
        logarithmic: bool | None = None,
    ) -> None:
        """Fit from `theta` on and keep the results; with `better` only the likelier ones."""
        by_logs = self.logarithmic if logarithmic is None else logarithmic
        self.keep(chosen, fits_from(model, y, variance, theta, self.prior, by_logs), better=better)

    def keep(self, chosen: NDArray[np.intp], fits: Fits, *, better: bool = False) -> None:
        """Take results of some profiles; with `better` only the likelier ones."""
        won = np.ones(len(chosen), np.bool_)
        if better:
            own = self.chi2[chosen] + _log_volume(self.total[chosen])
            won = fits.chi2 + _log_volume(fits.total) < own
        chosen = chosen[won]
        self.theta[chosen], self.covariance[chosen] = fits.theta[won], fits.covariance[won]
        self.chi2[chosen], self.predicted[chosen] = fits.chi2[won], fits.predicted[won]
        self.total[chosen], self.steps[chosen] = fits.total[won], fits.steps[won]


@dataclass(frozen=True, slots=True)
class Fits:
    """What the kernel makes of profiles from one start of each."""

    theta: Float64Array
    """(N, 4)."""
    covariance: Float64Array
    """(N, 4, 4)."""
    chi2: Float64Array
    """(N,)."""
    predicted: Float64Array
    """(N, F)."""
    total: Float64Array
    """(N, F) variance with the model's error."""
    steps: Int64Array
    """(N,) evaluations, negative where it did not converge."""


def fits_from(
    model: ProfileModel,
    y: Float64Array,
    variance: Float64Array,
    theta: Float64Array,
    prior: Float64Array,
    logarithmic: bool,
) -> Fits:
    """Fit profiles from `theta` on, see `levenberg_marquardt.fit`; `theta` becomes the result."""
    n = y.shape[0]
    fits = Fits(
        theta,
        np.empty((n, 4, 4)),
        np.empty(n),
        np.empty(y.shape),
        np.empty(y.shape),
        np.empty(n, np.int64),
    )
    parts = min(get_num_threads(), max(1, n // 64))
    levenberg_marquardt.fit(
        model.kind,
        model.radius_mm,
        model.constants,
        model.axes,
        model.grid,
        y,
        variance,
        model.error,
        logarithmic,
        prior,
        model.bounds,
        theta,
        ROUNDS,
        STEPS,
        parts,
        fits.covariance,
        fits.chi2,
        fits.predicted,
        fits.total,
        fits.steps,
    )
    return fits


def _sum_over(kept: BoolArray, squares: Float64Array, variance: Float64Array) -> Float64Array:
    """Return sums of squares over variances of the fibres kept, (N,)."""
    ratio = np.zeros(squares.shape)
    np.divide(squares, variance, out=ratio, where=kept)
    return np.asarray(ratio.sum(axis=1))


def _log_volume(total: Float64Array) -> Float64Array:
    """Return the sum of the logarithms of the variances of what is used."""
    return np.asarray(np.log(np.where(np.isfinite(total), total, 1.0) + 1e-300).sum(axis=1))


def _local_variance(
    radius_mm: Float64Array, residual: Float64Array, seen: BoolArray
) -> Float64Array:
    """Return each fibre's variance from the squared residuals around it, infinite where unseen."""
    order = np.argsort(radius_mm, kind="stable")
    width = 2 * NEIGHBOURS + 1
    squares = uniform_filter1d(residual[:, order] ** 2, width, axis=1, mode="constant")
    count = uniform_filter1d(seen[:, order].astype(np.float64), width, axis=1, mode="constant")
    out = np.full(residual.shape, math.inf)
    total = seen.sum(axis=1, keepdims=True)
    spared = total / np.maximum(total - 2, 1)  # residuals of a fit are smaller than errors
    mean = squares / np.maximum(count, 0.5 / width) * spared
    out[:, order] = np.where(seen[:, order], np.maximum(mean, LEAST_DEVIATION**2), math.inf)
    return out
