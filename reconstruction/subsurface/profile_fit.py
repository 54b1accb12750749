"""Fit radial profiles: select fibers, weight them, choose starts and model a misfit."""

import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincc

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.subsurface.models import ProfileModel
from reconstruction.subsurface.profile_batch import MIN_REFLECTANCE, Fits, ProfileBatch, fit_from

MIN_OBSERVED_FIBERS = 3
"""Fewest fibers that must read above their noise."""
NEIGHBOR_FIBERS = 7
"""Fibers to either side whose residuals give the noise of one, without a variance."""
MIN_DEVIATION = 1e-3
"""Relative deviation of a reading, without a variance."""
START_DEVIATION = 0.1
"""Relative error added for the comparison with starts."""
MISFIT_P_VALUE = 1e-3
"""Probability of a larger chi2 below which a profile is a misfit."""
FIBER_OUTLIER_SIGMAS = 6.0
MAX_FIBER_OUTLIER_FRACTION = 0.1
"""Standard deviations that make a fiber an outlier, and the fraction of fibers that may be such."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation over the median of absolute deviations."""
MIN_LOG_DEVIATION = 0.1
"""Median relative residual from which a profile is compared by its logarithms."""
MAX_VALLEY_RISE = 50.0
"""Excess misfit up to which a second valley is tried."""


def fit_profiles(batch: ProfileBatch, model: ProfileModel) -> Fits:
    """Fit profiles starting from the best points of a grid."""
    y, variance, observed = batch.y, batch.variance, batch.observed
    if batch.logarithmic:
        logs, weight = y, observed / START_DEVIATION**2
    else:
        safe = np.where(observed, y, 1.0)
        logs = np.log(safe)
        weight = np.zeros(y.shape)
        np.divide(1.0, variance / safe**2 + START_DEVIATION**2, out=weight, where=observed)
    g = float(batch.prior[3, 0])
    best, second, rise = model.starts(logs, weight, g, float(batch.prior[2, 1]))
    fits = fit_from(model, batch, best)
    first = fits.theta
    doubt = np.flatnonzero(np.isfinite(rise) & ((rise < MAX_VALLEY_RISE) | _is_misfit(fits)))
    if doubt.size:
        fits = fits.with_likelier(doubt, fit_from(model, batch.select(doubt), second[doubt]))
    if batch.logarithmic:
        for _ in range(2):
            off = np.where(observed, y - fits.log_predicted, 0.0)
            variance = _local_variance(model.radius_mm, off, observed)
            fits = fit_from(model, batch, fits.theta, variance=variance)
        return fits
    used = batch.used.sum(axis=1)
    p_value = gammaincc(np.maximum(used - 2, 1) / 2.0, fits.chi2 / 2.0)
    enough = observed.sum(axis=1) >= MIN_OBSERVED_FIBERS
    bad = np.flatnonzero((p_value < MISFIT_P_VALUE) & enough)
    if bad.size:
        fits = fits.with_rows(bad, _with_model_error(model, batch.select(bad), first[bad]))
    unlike = np.flatnonzero((_median_residual(batch, fits) > MIN_LOG_DEVIATION) & enough)
    if unlike.size:
        some = replace(batch.select(unlike), observed=fits.observed[unlike])
        by_logs = _by_logarithms(model, some, logs[unlike], first[unlike], second[unlike])
        fits = fits.with_rows(unlike, by_logs)
    return fits


def _with_model_error(model: ProfileModel, batch: ProfileBatch, start: Float64Array) -> Fits:
    """Fit misfitting profiles again, with a model error from the residuals.

    The relative error is equal at all fibers, so that the fit is the best in relative terms, as
    are the starts; a few fibers far off all others are omitted. chi2 becomes that of the stated
    errors.
    """
    y, variance, used = batch.y, batch.variance, batch.used
    wide = variance + (START_DEVIATION * np.abs(y)) ** 2
    fits = fit_from(model, batch, start, variance=wide)
    most = np.floor(MAX_FIBER_OUTLIER_FRACTION * used.sum(axis=1))
    for _ in range(2):
        m = np.maximum(fits.predicted, MIN_REFLECTANCE)
        off = np.abs(y - m)
        relative = np.nanmedian(np.where(batch.observed, off / m, math.nan), axis=1)
        deviation = MAD_TO_SIGMA * relative[:, None] * m
        stated = variance + model.relative_variance(fits.theta) * m**2
        outlier = used & (off > FIBER_OUTLIER_SIGMAS * np.sqrt(stated + deviation**2))
        outlier &= (outlier.sum(axis=1) <= most)[:, None]
        wide = np.where(outlier, math.inf, variance + deviation**2)
        fits = fit_from(model, batch, fits.theta, variance=wide)
    m = fits.predicted
    kept = used & ~outlier
    stated = variance + model.relative_variance(fits.theta) * m**2
    rest = fits.chi2 - _sum_over(kept, (y - m) ** 2, fits.total)
    return replace(
        fits,
        chi2=rest + _sum_over(kept, (y - m) ** 2, stated),
        outlier=outlier,
        used=kept,
        observed=batch.observed & kept,
        model_error=np.median(deviation / np.maximum(m, MIN_REFLECTANCE), axis=1),
    )


def _median_residual(batch: ProfileBatch, fits: Fits) -> Float64Array:
    """Return the median relative residual of the observed fibers, (N,)."""
    off = np.abs(batch.y / np.maximum(fits.predicted, MIN_REFLECTANCE) - 1.0)
    known = np.asarray(fits.observed.any(axis=1))
    shown = np.where(fits.observed | ~known[:, None], off, math.nan)
    return np.asarray(np.where(known, np.nanmedian(shown, axis=1), 0.0))


def _by_logarithms(
    model: ProfileModel,
    batch: ProfileBatch,
    logs: Float64Array,
    best: Float64Array,
    second: Float64Array,
) -> Fits:
    """Fit profiles outside the model by their logarithms, starting from the best grid points.

    A linear residual over a fraction of the model is small where the model is far too bright. A
    profile that is off by tens of percent everywhere, as of layered tissue, is then drawn to
    media that it does not resemble. Logarithms are symmetric in the two. Fibers within their noise
    are omitted.
    """
    y, variance, observed = batch.y, batch.variance, batch.observed
    own = np.full(y.shape, math.inf)
    np.divide(variance, np.where(observed, y, 1.0) ** 2, out=own, where=observed)
    wide = own + MIN_LOG_DEVIATION**2
    fits = fit_from(model, batch, best, y=logs, variance=wide)
    rows = np.flatnonzero(np.isfinite(second).all(axis=1))
    other = fit_from(model, batch.select(rows), second[rows], y=logs[rows], variance=wide[rows])
    fits = fits.with_likelier(rows, other)
    for _ in range(2):
        off = np.where(observed, logs - fits.log_predicted, 0.0)
        # two degrees of freedom go to the two coefficients
        kept = np.maximum(observed.sum(axis=1), 3)
        deviation = np.sqrt(np.maximum((off**2).sum(axis=1) / (kept - 2), MIN_DEVIATION**2))
        wide = own + deviation[:, None] ** 2
        fits = fit_from(model, batch, fits.theta, y=logs, variance=wide)
    m = fits.predicted
    stated = variance + model.relative_variance(fits.theta) * m**2
    return replace(
        fits,
        total=np.where(observed, wide * m**2, math.inf),
        chi2=_sum_over(observed, (y - m) ** 2, stated),
        used=observed,
        model_error=deviation,
    )


def _is_misfit(fits: Fits) -> BoolArray:
    """Return which fits are so bad that another valley may be better, (N,)."""
    observed = fits.observed.sum(axis=1)
    dof = np.maximum(observed - 2, 1)
    return np.asarray(
        (observed >= MIN_OBSERVED_FIBERS)
        & ((fits.chi2 > dof + 4.0 * np.sqrt(2.0 * dof)) | (fits.steps < 0))
    )


def _sum_over(kept: BoolArray, squares: Float64Array, variance: Float64Array) -> Float64Array:
    """Return sums of squares over variances of the fibers kept, (N,)."""
    ratio = np.zeros(squares.shape)
    np.divide(squares, variance, out=ratio, where=kept)
    return np.asarray(ratio.sum(axis=1))


def _local_variance(
    radius_mm: Float64Array, residual: Float64Array, observed: BoolArray
) -> Float64Array:
    """Return each fiber's variance from the squared residuals around it; infinite where unknown."""
    order = np.argsort(radius_mm, kind="stable")
    width = 2 * NEIGHBOR_FIBERS + 1
    squares = uniform_filter1d(residual[:, order] ** 2, width, axis=1, mode="constant")
    count = uniform_filter1d(observed[:, order].astype(np.float64), width, axis=1, mode="constant")
    out = np.full(residual.shape, math.inf)
    total = observed.sum(axis=1, keepdims=True)
    spared = total / np.maximum(total - 2, 1)  # residuals of a fit are smaller than errors
    mean = squares / np.maximum(count, 0.5 / width) * spared
    out[:, order] = np.where(observed[:, order], np.maximum(mean, MIN_DEVIATION**2), math.inf)
    return out
