"""Convert fits of radial profiles into estimates with errors, intervals and validity flags."""

import math
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from scipy.special import gammaincc, stdtrit

from reconstruction.arrays import BoolArray, Float64Array, Int64Array, UInt8Array, UInt16Array
from reconstruction.subsurface.asymmetry import MAX_ASYMMETRY_GAIN
from reconstruction.subsurface.models import Method
from reconstruction.subsurface.profile_batch import Fits, OmissionReason, ProfileBatch
from reconstruction.subsurface.profile_fit import MIN_OBSERVED_FIBERS, MISFIT_P_VALUE

MIN_FIBERS = 4
MAX_LOG_STDERR = 0.5
"""Standard error of log sigma_tr above which sigma_tr counts as not identified."""
MAX_PAIR_LOG_STDERR = 0.3
"""Likewise of log sigma_a and log sigma_s', for a remark of their own."""
MAX_LOG_RMS = 0.7
"""Root mean square of log(reading / model) above which no homogeneous medium fits the profile."""
MAX_MODEL_ERROR = 0.5
"""Relative model error found from the residuals, likewise."""
MAX_CORRELATION = 0.9
"""Largest correlation assumed between residuals of neighboring fibers."""
MAX_SYMMETRIC_LOG_STDERR = 0.2
"""Standard error of log sigma_tr up to which its interval is symmetric in the logarithm."""
ONE_SIGMA_LEVEL = 0.6827
"""Coverage of the interval of sigma_tr."""
CHANCE_SIGMAS = 2.0
"""Standard deviations of the correlation of independent neighbors that it must exceed."""
MAX_RELATIVE_MISFIT = 2.0
"""Largest residual of a fiber in that correlation, in misfits: one fiber must not dominate."""


class FitOutcome(IntFlag):
    """Outcome of a fit; the first eight bits make it invalid, the others are remarks."""

    GOOD = 0
    TOO_FEW_FIBERS = 1
    NO_SIGNAL = 2
    NOT_CONVERGED = 4
    AT_BOUND = 8
    OUTSIDE_DOMAIN = 16
    NOT_IDENTIFIED = 32
    WRONG_PROFILE = 64
    ASYMMETRY_OUTSIDE_PRIOR = 128
    MISFIT = 256
    COEFFICIENTS_NOT_IDENTIFIED = 512


_INVALID_CODE = 255
_REASON_BY_CODE = {
    FitOutcome.TOO_FEW_FIBERS: f"fewer than {MIN_FIBERS} usable fibers",
    FitOutcome.NO_SIGNAL: f"fewer than {MIN_OBSERVED_FIBERS} fibers read above their noise",
    FitOutcome.NOT_CONVERGED: "the fit did not converge",
    FitOutcome.AT_BOUND: "sigma_a or sigma_s' is at its limit",
    FitOutcome.OUTSIDE_DOMAIN: "sigma_a / sigma_s' is outside the model's domain",
    FitOutcome.NOT_IDENTIFIED: "the profile does not determine sigma_tr",
    FitOutcome.WRONG_PROFILE: "no medium of this kind has such a profile, or its scale is wrong",
    FitOutcome.ASYMMETRY_OUTSIDE_PRIOR: (
        "the medium's asymmetry g is outside its prior; give g and g_error of this medium"
    ),
    FitOutcome.MISFIT: "residuals exceed their errors; a model error accounts for the excess",
    FitOutcome.COEFFICIENTS_NOT_IDENTIFIED: "sigma_a and sigma_s' are not identified separately",
}


@dataclass(frozen=True, slots=True)
class SubsurfaceFit:
    """Coefficients of homogeneous media fitted to profiles; leading axes are the profiles'.

    Attributes
    ----------
    sigma_a_per_mm, sigma_s_prime_per_mm, sigma_tr_per_mm : ndarray, shape (...)
        Absorption, reduced scattering, and sqrt(3 sigma_a (sigma_a + sigma_s')), 1/mm; NaN where
        the fibers do not suffice (`FitOutcome.TOO_FEW_FIBERS`, `FitOutcome.NO_SIGNAL`).
    covariance : ndarray, shape (..., 2, 2)
        Of (sigma_a, sigma_s'), 1/mm^2, nuisances included; infinite where not identified.
    valid : ndarray of bool, shape (...)
        sigma_tr can be used. False with a reason in `outcome`.
    sigma_tr_stderr : ndarray, shape (...)
        By propagation of `covariance`, and for closed forms with their systematic error, 1/mm.
    interval_per_mm : ndarray, shape (..., 2)
        68 % interval of sigma_tr, 1/mm.
    chi2, p_value : ndarray, shape (...)
        Squared residuals over their stated variances, with the nuisances' priors; and the
        probability of a larger value. Without a variance the weights come from the residuals, so
        that chi2 equals `dof` but for its smoothing and does not test the fit.
    dof : ndarray of int, shape (...)
        Fibers used less two.
    inflation : ndarray, shape (...)
        Factor by which residuals exceed their stated errors, sqrt(chi2/dof); 1 without a misfit.
    model_error : ndarray, shape (...)
        Relative error of the model at all fibers that explains a misfit; the fit and its standard
        errors are made with it. 0 without.
    bent : ndarray of bool, shape (...)
        The misfit is one of the profile: residuals of neighboring fibers correlate by more than
        chance. Tissue outside the model bends a profile smoothly, while independent faults of
        fibers, such as dirt, do not correlate. False without a misfit.
    used : ndarray of bool, shape (..., F)
    left_out : ndarray of uint8, shape (..., F)
        Values of `OmissionReason`.
    outcome : ndarray of uint16, shape (...)
        Bits of `FitOutcome`.
    predicted_per_mm2 : ndarray, shape (..., F)
        The fitted profile with the common factor, 1/mm^2, at every fiber.
    residual : ndarray, shape (..., F)
        (reflectance - predicted) over its standard deviation, model error included; without a
        variance of logarithms; 0 where not used.
    scale : ndarray, shape (...)
        Common factor of the readings, 1 without ``common_error``.
    asymmetry : ndarray, shape (...)
        g as fitted, or as given.
    evaluations : ndarray of int, shape (...)
        Profiles computed by the fit.
    method : str
    """

    sigma_a_per_mm: Float64Array
    sigma_s_prime_per_mm: Float64Array
    sigma_tr_per_mm: Float64Array
    covariance: Float64Array
    valid: BoolArray
    sigma_tr_stderr: Float64Array
    interval_per_mm: Float64Array
    chi2: Float64Array
    dof: Int64Array
    p_value: Float64Array
    inflation: Float64Array
    model_error: Float64Array
    bent: BoolArray
    used: BoolArray
    left_out: UInt8Array
    outcome: UInt16Array
    predicted_per_mm2: Float64Array
    residual: Float64Array
    scale: Float64Array
    asymmetry: Float64Array
    evaluations: Int64Array
    method: Method

    @property
    def sigma_a_stderr(self) -> Float64Array:
        """Standard error of sigma_a, 1/mm, shape (...)."""
        return np.asarray(np.sqrt(self.covariance[..., 0, 0]))

    @property
    def sigma_s_prime_stderr(self) -> Float64Array:
        """Standard error of sigma_s', 1/mm, shape (...)."""
        return np.asarray(np.sqrt(self.covariance[..., 1, 1]))

    @property
    def correlation(self) -> Float64Array:
        """Correlation of sigma_a and sigma_s', shape (...); NaN where not identified."""
        spread = self.sigma_a_stderr * self.sigma_s_prime_stderr
        known = np.isfinite(spread) & (spread > 0.0)
        ratio = np.full(spread.shape, np.nan)
        return np.divide(self.covariance[..., 0, 1], spread, out=ratio, where=known)

    @property
    def coefficients_identified(self) -> BoolArray:
        """Whether sigma_a and sigma_s' are identified separately; `valid` is of sigma_tr alone."""
        unclear = (
            FitOutcome.COEFFICIENTS_NOT_IDENTIFIED
            | FitOutcome.TOO_FEW_FIBERS
            | FitOutcome.NO_SIGNAL
        )
        return np.asarray((self.outcome & np.uint16(unclear)) == 0)

    def reason(self, index: int | tuple[int, ...] = ()) -> str:
        """Describe the outcome of one fit; empty for a good one.

        Parameters
        ----------
        index
            Index on the leading axes; () for a single profile.
        """
        code = int(self.outcome[index])
        return "; ".join(text for bit, text in _REASON_BY_CODE.items() if code & bit)


def evaluate_fits(
    batch: ProfileBatch,
    fits: Fits,
    shape: tuple[int, ...],
    method: Method,
    *,
    by_definition: bool = False,
) -> SubsurfaceFit:
    """Compute estimates with errors from fits, and which of them can be used.

    Parameters
    ----------
    shape
        Leading axes of the estimates.
    by_definition
        Leave the model's error out of the errors, since the estimate is defined by the model.
    """
    a, s = np.exp(fits.theta[:, 0]), np.exp(fits.theta[:, 1])
    sigma_tr = np.sqrt(3.0 * a * (a + s))
    fibers = fits.used.sum(axis=1)
    dof = np.maximum(fibers - 2, 0)
    p_value = np.where(dof > 0, gammaincc(np.maximum(dof, 1) / 2.0, fits.chi2 / 2.0), 1.0)
    reduced = fits.chi2 / np.maximum(dof, 1)
    misfit: BoolArray = np.less(p_value, 0.0 if batch.logarithmic else MISFIT_P_VALUE)
    inflation = np.where(
        (reduced > 1.0) & np.logical_or(misfit, batch.logarithmic), np.sqrt(reduced), 1.0
    )
    residual = _residuals(batch, fits)
    widening = np.ones(a.shape)
    if batch.logarithmic:
        widening = inflation**2
    elif not by_definition:
        widening = np.where(fits.model_error > 0.0, _repeats(residual), 1.0)
    logs = fits.covariance[:, :2, :2] * widening[:, None, None]
    # log sigma_tr = (log 3 + log a + log(a + s)) / 2: its derivatives by log a and log s
    slope = 0.5 * np.stack([1.0 + a / (a + s), s / (a + s)], axis=1)
    known = np.asarray(np.isfinite(logs).all(axis=(1, 2)))
    safe = np.where(known[:, None, None], logs, 0.0)
    log_variance = np.einsum("ni,nij,nj->n", slope, safe, slope)
    log_stderr = np.where(known, np.sqrt(np.maximum(log_variance, 0.0) + fits.bias**2), math.inf)
    pair_stderr = np.where(known, np.sqrt(np.maximum(safe[:, 0, 0], safe[:, 1, 1])), math.inf)
    scales = np.stack([a, s], axis=1)
    covariance = safe * scales[:, :, None] * scales[:, None, :]
    covariance[~known] = math.inf

    outcome = _outcomes(batch, fits, misfit, log_stderr, pair_stderr)
    nothing = (outcome & np.uint16(FitOutcome.TOO_FEW_FIBERS | FitOutcome.NO_SIGNAL)) != 0
    for estimate in (a, s, sigma_tr, p_value):
        estimate[nothing] = math.nan
    covariance[nothing] = math.inf
    log_stderr[nothing] = math.inf
    reach = np.full(a.shape, 1.0)
    if batch.logarithmic:  # the noise itself is known from few residuals
        reach = stdtrit(np.maximum(dof, 1), 0.5 + 0.5 * ONE_SIGMA_LEVEL)
    arrays = {
        "sigma_a_per_mm": a,
        "sigma_s_prime_per_mm": s,
        "sigma_tr_per_mm": sigma_tr,
        "covariance": covariance,
        "valid": (outcome & np.uint16(_INVALID_CODE)) == 0,
        "sigma_tr_stderr": _deviation(sigma_tr, log_stderr),
        "interval_per_mm": np.stack(_interval(sigma_tr, log_stderr * reach), axis=-1),
        "chi2": fits.chi2,
        "dof": dof,
        "p_value": p_value,
        "inflation": inflation,
        "model_error": fits.model_error,
        "bent": _bent(batch, fits),
        "used": fits.used,
        "left_out": np.where(fits.outlier, np.uint8(OmissionReason.OUTLIER), batch.omission),
        "outcome": outcome,
        "predicted_per_mm2": np.where(nothing[:, None], math.nan, fits.predicted),
        "residual": residual,
        "scale": np.exp(fits.theta[:, 2]),
        "asymmetry": fits.theta[:, 3],
        "evaluations": np.abs(fits.steps),
    }
    rows = {name: array.reshape((*shape, *array.shape[1:])) for name, array in arrays.items()}
    return SubsurfaceFit(**rows, method=method)


def _outcomes(
    batch: ProfileBatch,
    fits: Fits,
    misfit: BoolArray,
    log_stderr: Float64Array,
    pair_stderr: Float64Array,
) -> UInt16Array:
    """Return bits of `FitOutcome`, (N,), by the errors of log sigma_tr and of the coefficients."""
    fibers, observed = fits.used.sum(axis=1), fits.observed.sum(axis=1)
    y = batch.y if batch.logarithmic else np.log(np.where(fits.observed, batch.y, 1.0))
    square = np.where(fits.observed, (y - fits.log_predicted) ** 2, 0.0)
    off = np.sqrt(square.sum(axis=1) / np.maximum(observed, 1))
    outcome = np.zeros(fibers.shape, np.uint16)
    for bit, where in (
        (FitOutcome.TOO_FEW_FIBERS, fibers < MIN_FIBERS),
        (FitOutcome.NO_SIGNAL, (fibers >= MIN_FIBERS) & (observed < MIN_OBSERVED_FIBERS)),
        (FitOutcome.NOT_CONVERGED, fits.steps < 0),
        (FitOutcome.AT_BOUND, fits.at_bound),
        (FitOutcome.OUTSIDE_DOMAIN, ~fits.in_domain),
        (FitOutcome.NOT_IDENTIFIED, log_stderr > MAX_LOG_STDERR),
        (FitOutcome.WRONG_PROFILE, (off > MAX_LOG_RMS) | (fits.model_error > MAX_MODEL_ERROR)),
        (FitOutcome.ASYMMETRY_OUTSIDE_PRIOR, fits.asymmetry_gain > MAX_ASYMMETRY_GAIN),
        (FitOutcome.MISFIT, misfit),
        (FitOutcome.COEFFICIENTS_NOT_IDENTIFIED, pair_stderr > MAX_PAIR_LOG_STDERR),
    ):
        outcome[where] |= np.uint16(bit)
    alone = np.uint16(FitOutcome.TOO_FEW_FIBERS | FitOutcome.NO_SIGNAL)
    outcome[(outcome & alone) != 0] &= alone
    return outcome


def _residuals(batch: ProfileBatch, fits: Fits) -> Float64Array:
    """Return residuals over their standard deviations, (N, F), 0 where a fiber is not used."""
    value = fits.log_predicted if batch.logarithmic else fits.predicted
    residual = np.zeros(batch.y.shape)
    np.divide(batch.y - value, np.sqrt(fits.total), out=residual, where=fits.used)
    return residual


def _bent(batch: ProfileBatch, fits: Fits) -> BoolArray:
    """Return where residuals of neighboring fibers correlate by more than chance, (N,).

    Fibers count as far as their noise is below the misfit. The correlation of n independent
    residuals has the standard deviation 1 / sqrt(n).
    """
    model_error = fits.model_error[:, None]
    there = fits.used & (model_error > 0.0)
    m, y = np.where(there, fits.predicted, 1.0), np.where(there, batch.y, 0.0)
    noise = np.where(there, batch.variance, 0.0) / (1.0 if batch.logarithmic else m**2)
    square = np.broadcast_to(model_error**2, y.shape)
    weight = np.divide(square, square + noise, out=np.zeros(y.shape), where=there)
    off = y - np.log(m) if batch.logarithmic else y / m - 1.0
    most = MAX_RELATIVE_MISFIT * model_error
    off = weight * np.clip(off, -most, most)
    pairs = np.maximum((weight[:, 1:] * weight[:, :-1]).sum(axis=1), 1e-290)
    alone = np.maximum((weight**2).sum(axis=1), 1e-290)
    alike = (off[:, 1:] * off[:, :-1]).sum(axis=1) / pairs
    return np.asarray(alike > CHANCE_SIGMAS / np.sqrt(pairs) * (off**2).sum(axis=1) / alone)


def _repeats(residual: Float64Array) -> Float64Array:
    """Return how many neighboring residuals carry one independent value, (N,).

    A medium outside the model leaves residuals that are smooth over the fibers. With correlation c
    of neighbors, (1 + c)/(1 - c) of them count as one, as in a first-order autoregression.
    """
    squares = np.maximum((residual**2).sum(axis=1), 1e-290)
    c = (residual[:, 1:] * residual[:, :-1]).sum(axis=1) / squares
    c = np.clip(c, 0.0, MAX_CORRELATION)
    return np.asarray((1.0 + c) / (1.0 - c))


def _interval(
    sigma_tr: Float64Array, log_stderr: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the ends of the 68 % interval of sigma_tr.

    Symmetric in the logarithm while its error is small; otherwise in sigma_tr^2, in which a
    profile is linear under vanishing absorption.
    """
    clear = log_stderr < MAX_SYMMETRIC_LOG_STDERR
    spread = np.where(clear, log_stderr, 0.0)
    low, high = sigma_tr * np.exp(-spread), sigma_tr * np.exp(spread)
    wide = np.where(np.isfinite(log_stderr), 2.0 * log_stderr, 0.0)
    low = np.where(clear, low, sigma_tr * np.sqrt(np.maximum(1.0 - wide, 0.0)))
    high = np.where(clear, high, sigma_tr * np.sqrt(1.0 + wide))
    nothing = ~np.isfinite(log_stderr)
    return np.where(nothing, 0.0, low), np.where(nothing, math.inf, high)


def _deviation(sigma_tr: Float64Array, log_stderr: Float64Array) -> Float64Array:
    """Return the standard error: half the interval where that is wide, infinite where unknown."""
    low, high = _interval(sigma_tr, log_stderr)
    half = np.full(sigma_tr.shape, math.inf)
    np.subtract(0.5 * high, 0.5 * low, out=half, where=np.isfinite(high) & np.isfinite(low))
    known = np.isfinite(sigma_tr) & (log_stderr < MAX_SYMMETRIC_LOG_STDERR)
    return np.where(known, np.where(known, sigma_tr, 0.0) * np.where(known, log_stderr, 0.0), half)
