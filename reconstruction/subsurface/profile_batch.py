"""Lay out radial profiles for fits, one per row, and keep the results of fits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from reconstruction.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from reconstruction.subsurface import levenberg_marquardt
from reconstruction.subsurface.models import ProfileModel

SIGNAL_SIGMAS = 3.0
"""Standard deviations by which an observed reading exceeds 0."""
INITIAL_DEVIATION = 0.05
"""Relative deviation of a reading in the first of the fits without a variance."""
MAX_WEIGHT_ROUNDS, MAX_ROUND_STEPS = 4, 60
"""Times the model's error is recomputed, and steps per round."""
MIN_REFLECTANCE = 1e-290
"""Smallest prediction that has a logarithm."""


class OmissionReason(IntEnum):
    """Why a fiber is not used in a fit; the values of `SubsurfaceFit.left_out`."""

    USED = 0
    MASKED = 1
    NOT_FINITE = 2
    NO_VARIANCE = 3
    NOT_ABOVE_ZERO = 4
    OUTLIER = 5


@dataclass(frozen=True, slots=True, eq=False)
class ProfileBatch:
    """Profiles laid out for fits; no fit changes them."""

    y: Float64Array
    """(N, F) reflectance, or its logarithm; 0 where not used."""
    variance: Float64Array
    """(N, F), of `y`, infinite where not used."""
    omission: UInt8Array
    """(N, F), values of `OmissionReason`."""
    observed: BoolArray
    """(N, F): readings above their noise."""
    logarithmic: bool
    """Whether `y` are logarithms, because no variance was given."""
    prior: Float64Array
    """(4, 2): mean and standard deviation of each parameter; 0: fixed, infinite: free."""

    @classmethod
    def lay_out(
        cls,
        y: Float64Array,
        variance: Float64Array | None,
        omission: UInt8Array,
        prior: Float64Array,
    ) -> ProfileBatch:
        """Lay out profiles (N, F)."""
        used = omission == OmissionReason.USED
        if variance is None:
            logs = np.log(np.where(used, y, 1.0))
            deviation = np.where(used, INITIAL_DEVIATION**2, math.inf)
            return cls(logs, deviation, omission, used, True, prior)
        clean, noise = np.where(used, y, 0.0), np.where(used, variance, math.inf)
        observed = used & (clean > SIGNAL_SIGMAS * np.sqrt(noise))
        return cls(clean, noise, omission, observed, False, prior)

    @property
    def used(self) -> BoolArray:
        """Fibers that are used, (N, F)."""
        return np.asarray(self.omission == OmissionReason.USED)

    def select(self, rows: NDArray[np.intp]) -> ProfileBatch:
        """Return some of the profiles."""
        return replace(
            self,
            y=self.y[rows],
            variance=self.variance[rows],
            omission=self.omission[rows],
            observed=self.observed[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fits:
    """Results of fits of a batch, one row per profile."""

    theta: Float64Array
    """(N, 4), see `reconstruction.subsurface.kernels`."""
    covariance: Float64Array
    """(N, 4, 4), of `theta`."""
    chi2: Float64Array
    """(N,), with the priors' part."""
    predicted: Float64Array
    """(N, F) profile, 1/mm^2."""
    total: Float64Array
    """(N, F) variance of `y` with the model's error."""
    steps: Int64Array
    """(N,) evaluations, negative where the fit did not converge."""
    used: BoolArray
    """(N, F): fibers that the fit uses."""
    observed: BoolArray
    """(N, F): those of them that read above their noise."""
    outlier: BoolArray
    """(N, F): fibers omitted for their residuals."""
    model_error: Float64Array
    """(N,) relative error of the model found from the residuals, 0 without a misfit."""
    in_domain: BoolArray
    """(N,): whether `theta` is in the model's domain."""
    at_bound: BoolArray
    """(N,): whether a coefficient is at its limit."""
    bias: Float64Array
    """(N,) systematic error of log sigma_tr due to the model."""
    asymmetry_gain: Float64Array
    """(N,) chi2 less that of a fit with any asymmetry, where that fits; 0 where not compared."""

    @classmethod
    def join(cls, parts: Sequence[tuple[NDArray[np.intp], Fits]]) -> Fits:
        """Join the fits of parts of a batch, each with its rows, in the batch's order."""
        order = np.argsort(np.concatenate([rows for rows, _ in parts]))
        return cls(
            *(
                np.concatenate([getattr(fits, field.name) for _, fits in parts])[order]
                for field in fields(cls)
            )
        )

    @property
    def log_predicted(self) -> Float64Array:
        """Logarithm of the predicted profile, (N, F)."""
        return np.asarray(np.log(np.maximum(self.predicted, MIN_REFLECTANCE)))

    def select(self, rows: NDArray[np.intp] | BoolArray) -> Fits:
        """Return the fits of some profiles."""
        return Fits(*(getattr(self, field.name)[rows] for field in fields(self)))

    def with_rows(self, rows: NDArray[np.intp], other: Fits) -> Fits:
        """Return fits with those of some profiles replaced."""
        arrays = {field.name: getattr(self, field.name).copy() for field in fields(self)}
        for name, array in arrays.items():
            array[rows] = getattr(other, name)
        return Fits(**arrays)

    def with_likelier(self, rows: NDArray[np.intp], other: Fits) -> Fits:
        """Return fits with those of some profiles replaced where the other is more likely."""
        won = other.misfit < self.select(rows).misfit
        return self.with_rows(rows[won], other.select(won))

    @property
    def misfit(self) -> Float64Array:
        """Minus twice the log likelihood, up to a constant, (N,)."""
        volume = np.log(np.where(np.isfinite(self.total), self.total, 1.0) + 1e-300)
        return np.asarray(self.chi2 + volume.sum(axis=1))


def fit_from(
    model: ProfileModel,
    batch: ProfileBatch,
    start: Float64Array,
    *,
    y: Float64Array | None = None,
    variance: Float64Array | None = None,
) -> Fits:
    """Fit the profiles of a batch starting from `start` (N, 4), see `levenberg_marquardt.fit`.

    Parameters
    ----------
    y
        Logarithms to fit in place of the batch's readings, (N, F).
    variance
        To weight by in place of the batch's, (N, F).
    """
    given = batch.y if y is None else y
    n, shape = len(given), given.shape
    found = levenberg_marquardt.FitBuffers(
        start.copy(),
        np.empty((n, 4, 4)),
        np.empty(n),
        np.empty(shape),
        np.empty(shape),
        np.empty(n, np.int64),
    )
    problem = levenberg_marquardt.FitProblem(
        given,
        batch.variance if variance is None else variance,
        batch.logarithmic or y is not None,
        batch.prior,
        model.error,
        model.bounds,
        MAX_WEIGHT_ROUNDS,
        MAX_ROUND_STEPS,
    )
    parts = min(get_num_threads(), max(1, n // 64))
    levenberg_marquardt.fit(model.curves, problem, found, parts)
    return Fits(
        **found._asdict(),
        used=batch.used,
        observed=batch.observed,
        outlier=np.zeros(shape, np.bool_),
        model_error=np.zeros(n),
        in_domain=model.contains(found.theta),
        at_bound=model.at_bound(found.theta),
        bias=model.systematic(found.theta),
        asymmetry_gain=np.zeros(n),
    )
