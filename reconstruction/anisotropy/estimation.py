"""Estimate anisotropy of light diffusion in skin: ratio, axis and p-value.

A probe's head turned about its source reads sigma_tr along several directions. Where diffusion is
described by a tensor, light decays as ``exp(-sqrt(sigma_a r' D^-1 r))``: sigma_tr^2 is a quadratic
form of the direction, and 1/sigma_tr drawn over it is an ellipse (`diffusion_ellipse`).

theta and theta + 180 degrees are one axis. A first harmonic, in theta itself, is not a property of
such tissue: the head was tilted or badly coupled, or the skin changes from one side to the
other. It is fitted in addition and reported separately, if the directions cover a turn.

The p-value is that of the harmonic in 2 theta of a linear weighted fit of sigma_tr, exact for
normal errors in known ratios (`direction_harmonics`), at any size.

References
----------
Nickell et al. 2000, Anisotropy of light propagation in human skin, Phys. Med. Biol. 45, 2873.
doi:10.1088/0031-9155/45/10/310
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

from model.checks import Checks
from reconstruction.anisotropy import diffusion_ellipse, direction_harmonics
from reconstruction.anisotropy.direction_harmonics import MIN_DIRECTIONS, HarmonicFit
from reconstruction.anisotropy.plane_vectors import (
    UNKNOWN_AXIS_RAD,
    axis_stderr,
    estimate_length,
    quadratic_form,
    wrap_angle,
)
from reconstruction.arrays import BoolArray, Float64Array, Int64Array

Errors: TypeAlias = Literal["relative", "absolute"]

MAX_EXPONENT = 300
"""Powers of two from 1 beyond which values are rescaled, to keep their squares in range."""
MIN_DIRECTION_ERROR, MAX_DIRECTION_ERROR = 1e-307, 1e150
"""Range of relative standard errors of one direction: below it 0 is divided by 0, above it a
value is not a reading."""
MAX_ERROR_RATIO = 1e12
"""Standard error over the least one above which a direction is omitted, as rounding exceeds its
information."""


class AnisotropyError(ValueError):
    """Directions, values or errors from which anisotropy cannot be estimated."""


@dataclass(frozen=True, slots=True)
class Anisotropy:
    """Dependence of sigma_tr on the direction.

    Arrays have the shape (...) of one direction's values, such as (3,) for channels. Where not
    `valid`, ratios and p-values are 1 and standard errors infinite.

    Attributes
    ----------
    ratio, ratio_stderr : ndarray
        Greatest over least 1/sigma_tr, 1 or more, and its standard error. Errors bias it upwards:
        isotropic tissue yields some 1 + ratio_stderr.
    axis_rad, axis_stderr_rad : ndarray
        Direction of greatest 1/sigma_tr in [0, pi), in the convention of the angles, and its
        standard error; up to `plane_vectors.UNKNOWN_AXIS_RAD` for a ratio that may be 1.
    p_value, log10_p : ndarray
        Probability of such a harmonic in 2 theta in isotropic tissue, and its decimal logarithm.
    mean_per_mm, mean_stderr_per_mm : ndarray
        sigma_tr averaged over all directions, 1/mm.
    tilt, tilt_stderr, tilt_rad, tilt_p_value : ndarray
        The first harmonic over the mean, with the direction of greatest sigma_tr in [0, 2 pi), and
        its p-value. 0, infinity, 0 and 1 where it is not fitted.
    chi2 : ndarray
        Sum of squared residuals of the ellipse over the standard errors given; without any, `dof`.
    dof : ndarray of int
        Degrees of freedom of the residuals.
    used, outlier : ndarray of bool, shape (N, ...)
        Directions that the fit uses; those omitted as outliers.
    valid : ndarray of bool
    reason : ndarray of str
        Why not valid; empty otherwise.
    parameters, covariance : ndarray, shapes (..., 3), (..., 3, 3)
        l, u, v of `diffusion_ellipse`, sigma_tr in 1/mm, and their covariance.
    errors : str
        See :func:`estimate`.
    """

    ratio: Float64Array
    ratio_stderr: Float64Array
    axis_rad: Float64Array
    axis_stderr_rad: Float64Array
    p_value: Float64Array
    log10_p: Float64Array
    mean_per_mm: Float64Array
    mean_stderr_per_mm: Float64Array
    tilt: Float64Array
    tilt_stderr: Float64Array
    tilt_rad: Float64Array
    tilt_p_value: Float64Array
    chi2: Float64Array
    dof: Int64Array
    used: BoolArray
    outlier: BoolArray
    valid: BoolArray
    reason: NDArray[np.str_]
    parameters: Float64Array
    covariance: Float64Array
    errors: Errors


def estimate(
    angle_rad: ArrayLike,
    sigma_tr_per_mm: ArrayLike,
    stderr_per_mm: ArrayLike | None = None,
    *,
    valid: ArrayLike | None = None,
    errors: Errors = "relative",
    outliers: bool = True,
    log_ratio_error: float = 0.0,
) -> Anisotropy:
    """Estimate ratio and axis of anisotropy from sigma_tr along several directions.

    Parameters
    ----------
    angle_rad : array_like, shape (N,)
        Direction from the source to the detectors, rad; any turn, repeats allowed.
    sigma_tr_per_mm : array_like, shape (N, ...)
        sigma_tr along each direction, 1/mm. Values that are not finite and above 0 are omitted.
    stderr_per_mm : array_like, shape (N, ...), optional
        Standard errors, 1/mm. None, or zeros throughout a channel: equal ones, of unknown size.
        A direction with one that is not finite is omitted.
    valid : array_like of bool, shape (N, ...), optional
        Directions to use; values of the others are ignored.
    errors : {"relative", "absolute"}
        "relative": standard errors in ratios as given, scaled by the residuals (F test);
        "absolute": as given (chi-square test). Use the first if contact differs from turn to turn,
        which errors of fits do not include.
    outliers : bool
        Omit outlier directions, one of eight at most: t test of deleted residuals. The probability
        of omitting a good one is `direction_harmonics.OUTLIER_FALSE_ALARM_RATE`.
    log_ratio_error : float
        Relative error of the log of the ratio that is common to all directions; it widens
        the ratio's standard error.

    Returns
    -------
    Anisotropy

    Raises
    ------
    AnisotropyError
        For fewer than `MIN_DIRECTIONS` different directions, shapes that do not fit, a standard
        error below 0, some but not all 0, or none with "absolute".

    Examples
    --------
    >>> angle = np.deg2rad(np.arange(16) * 22.5)
    >>> sigma_tr = 0.6 * np.hypot(np.cos(angle - 0.3) / 1.5, np.sin(angle - 0.3))
    >>> found = estimate(angle, sigma_tr)
    >>> round(float(found.ratio), 6), round(float(found.axis_rad), 6), bool(found.p_value < 1e-9)
    (1.5, 0.3, True)
    """
    angle, values, stderr, good, shape = _checked(
        angle_rad, sigma_tr_per_mm, stderr_per_mm, valid, errors
    )
    # rescale: sums and squares of extreme values would overflow
    y, weight, outlier, least, scale, exponent = _normalize_values(
        angle, values, stderr, good, outliers
    )
    linear = direction_harmonics.fit_harmonics(angle, y, weight)
    p, inverse, residual = diffusion_ellipse.fit_ellipses(angle, y, weight, linear)
    # residuals and harmonics are at least those of rounding
    rounding = (16 * np.finfo(np.float64).eps) ** 2 * (weight * y * y).sum(axis=0)
    residual = np.maximum(residual, rounding)
    factor, log_p, log_odd = _error_scale_and_p_values(linear, residual, least, rounding, errors)
    covariance = inverse * (factor**2)[:, None, None]
    covariance[:, 1:3, 1:3] += log_ratio_error**2 * p[:, 1:3, None] * p[:, None, 1:3]
    with np.errstate(over="ignore"):
        given_chi2 = residual / least / least
    chi2 = linear.dof.astype(np.float64) if stderr_per_mm is None else given_chi2

    h, h_stderr, h_across = estimate_length(p[:, 1:3], covariance[:, 1:3, 1:3])
    mean, by_parameter = diffusion_ellipse.mean_over_directions(p[:, :3])
    mean_error = np.sqrt(quadratic_form(by_parameter, covariance[:, :3, :3]))
    with np.errstate(over="ignore"):
        mean, mean_error = (np.ldexp(one * scale, exponent) for one in (mean, mean_error))
    tilt, tilt_stderr, _ = estimate_length(p[:, 3:], covariance[:, 3:, 3:])
    ellipse = p[:, :3].copy()
    ellipse[:, 0] += 2.0 * (np.log(scale) + exponent * math.log(2.0))
    determined, odd = linear.determined, linear.has_first_harmonic

    def shaped(
        found: NDArray[Any], otherwise: float, where: BoolArray = determined
    ) -> NDArray[Any]:
        kept = where.reshape(-1, *[1] * (found.ndim - 1))
        return np.where(kept, found, otherwise).reshape((*shape, *found.shape[1:]))

    return Anisotropy(
        ratio=shaped(np.exp(h), 1.0),
        ratio_stderr=shaped(np.exp(h) * h_stderr, math.inf),
        axis_rad=shaped(wrap_angle(0.5 * np.arctan2(p[:, 2], p[:, 1]), math.pi), 0.0),
        axis_stderr_rad=shaped(axis_stderr(h, h_across), UNKNOWN_AXIS_RAD),
        p_value=shaped(np.exp(log_p), 1.0),
        log10_p=shaped(log_p / math.log(10.0), 0.0),
        mean_per_mm=shaped(mean, 0.0),
        mean_stderr_per_mm=shaped(mean_error, math.inf),
        tilt=shaped(tilt, 0.0, odd),
        tilt_stderr=shaped(tilt_stderr, math.inf, odd),
        tilt_rad=shaped(wrap_angle(np.arctan2(p[:, 4], p[:, 3]), math.tau), 0.0, odd),
        tilt_p_value=shaped(np.exp(log_odd), 1.0, odd),
        chi2=shaped(chi2, 0.0),
        dof=linear.dof.reshape(shape),
        used=(weight > 0).reshape((-1, *shape)),
        outlier=outlier.reshape((-1, *shape)),
        valid=determined.reshape(shape),
        reason=_reasons(angle, weight > 0, determined).reshape(shape),
        parameters=shaped(ellipse, 0.0),
        covariance=shaped(covariance[:, :3, :3], math.inf),
        errors=errors,
    )


def _normalize_values(
    angle: Float64Array, values: Float64Array, stderr: Float64Array, good: BoolArray, outliers: bool
) -> tuple[Float64Array, Float64Array, BoolArray, Float64Array, Float64Array, Int64Array]:
    """Return values scaled to about 1, weights, outliers, least errors, scale, power of two."""
    exponent = _scaling_exponent(np.where(good, values, 0.0).max(axis=0, initial=0.0))
    with np.errstate(over="ignore"):
        values, stderr = np.ldexp(values, -exponent), np.ldexp(stderr, -exponent)
    scale = np.where(good, values, 0.0).sum(axis=0) / np.maximum(good.sum(axis=0), 1)
    scale = np.where(scale > 0, scale, 1.0)
    y = np.where(good, values / scale, 0.0)
    with np.errstate(over="ignore"):
        relative = np.clip(stderr / scale, MIN_DIRECTION_ERROR, MAX_DIRECTION_ERROR)
    relative = np.where(good, relative, math.inf)
    least = relative.min(axis=0, initial=math.inf)
    least = np.where(np.isfinite(least), least, 1.0)
    # weights of 1 at most keep errors of any size in range
    weight = np.where(good & (relative <= MAX_ERROR_RATIO * least), (least / relative) ** 2, 0.0)
    outlier = np.zeros(weight.shape, bool)
    if outliers:
        weight, outlier = direction_harmonics.exclude_outliers(angle, y, weight)
        # one value far above the others would make these vanish in the mean
        kept = np.where(weight > 0, y, 0.0)
        closer = _scaling_exponent(kept.max(axis=0, initial=0.0))
        y = np.ldexp(np.where(closer == 0, y, kept), -closer)
        least, exponent = np.ldexp(least, -closer), exponent + closer
    return y, weight, outlier, least, scale, exponent


def _error_scale_and_p_values(
    linear: HarmonicFit,
    residual: Float64Array,
    min_errors: Float64Array,
    rounding: Any,
    errors: Errors,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the factor of the standard errors, and log p-values of both harmonics."""
    dof = np.maximum(linear.dof, 1)
    if errors == "relative":
        # Student's t keeps the coverage at 68 % with few degrees of freedom
        factor = np.sqrt(residual / dof) * stats.t.ppf(special.ndtr(1.0), dof)
        linear_residual = np.maximum(linear.residual, rounding)
        log_p = direction_harmonics.log_p_value(linear.axial_power, linear_residual, linear.dof)
        log_odd = direction_harmonics.log_p_value(
            linear.first_harmonic_power, linear_residual, linear.dof
        )
    else:
        factor = min_errors
        with np.errstate(over="ignore"):
            log_p, log_odd = (
                -0.5 * power / min_errors / min_errors
                for power in (linear.axial_power, linear.first_harmonic_power)
            )
    return factor, log_p, log_odd


def _checked(
    angle_rad: ArrayLike,
    sigma_tr_per_mm: ArrayLike,
    stderr_per_mm: ArrayLike | None,
    valid: ArrayLike | None,
    errors: Errors,
) -> tuple[Float64Array, Float64Array, Float64Array, BoolArray, tuple[int, ...]]:
    """Return angles (N,), values, standard errors and validity (N, B), and the shape of B."""
    check = Checks(AnisotropyError)
    angle = check.numbers("angle_rad", angle_rad, ("N",))
    given = np.asarray(sigma_tr_per_mm, np.float64)
    check.shape("sigma_tr_per_mm", given, (angle.size, *given.shape[1:]))
    check.choice("errors", errors, ("relative", "absolute"))
    several = direction_harmonics.count_distinct_directions(angle, np.ones((angle.size, 1), bool))[
        0
    ]
    check.within("different directions of angle_rad", several, f"[{MIN_DIRECTIONS}, inf)")
    stderr: Float64Array = np.zeros_like(given)
    if stderr_per_mm is not None:
        stderr = np.asarray(stderr_per_mm, np.float64)
    good = np.ones(given.shape, bool) if valid is None else np.array(valid, bool)
    check.shape("stderr_per_mm", stderr, given.shape)
    check.shape("valid", good, given.shape)
    shape = given.shape[1:]
    values, stderr, good = (a.reshape(angle.size, -1) for a in (given, stderr, good))
    good = good & np.isfinite(values) & (values > 0) & np.isfinite(stderr)
    check.within("stderr_per_mm", stderr[good], "[0, inf)")
    zero = good & (stderr == 0)
    whole = (zero == good).all(axis=0)
    if (zero.any(axis=0) & ~whole).any():
        raise AnisotropyError(
            "stderr_per_mm: got 0 for some values, expected all above 0 or all 0; correct them"
        )
    if errors == "absolute" and zero.any():
        raise AnisotropyError(
            'stderr_per_mm: got none or 0, expected above 0 for "absolute"; use errors="relative"'
        )
    return angle, values, np.where(whole, 1.0, stderr), good, shape


def _scaling_exponent(largest: Float64Array) -> Int64Array:
    """Return the power of two of values (B,) far from 1; 0 for other values."""
    exponent = np.frexp(largest)[1].astype(np.int64)
    return np.where((largest > 0) & (np.abs(exponent) > MAX_EXPONENT), exponent, 0)


def _reasons(angle: Float64Array, used: BoolArray, determined: BoolArray) -> NDArray[np.str_]:
    several = direction_harmonics.count_distinct_directions(angle, used)
    return np.array(
        [
            ""
            if ok
            else f"{n} usable directions, expected {MIN_DIRECTIONS} or more"
            if n < MIN_DIRECTIONS
            else "directions are too close together to determine an axis"
            for ok, n in zip(determined, several, strict=True)
        ],
        dtype=np.str_,
    )


@dataclass(frozen=True, slots=True)
class SingleDirectionBias:
    """Bias of sigma_tr along one direction of anisotropic tissue from the mean over directions.

    Attributes
    ----------
    bias, stderr : ndarray, shape (K, ...)
        sigma_tr along each given direction over its mean, minus 1; and its standard error.
    lowest, highest : ndarray, shape (...)
        Least and greatest bias of any direction.
    rms : ndarray, shape (...)
        Root mean square bias over all directions, as of a head at a random angle.
    """

    bias: Float64Array
    stderr: Float64Array
    lowest: Float64Array
    highest: Float64Array
    rms: Float64Array


def estimate_single_direction_bias(
    anisotropy: Anisotropy, angle_rad: ArrayLike
) -> SingleDirectionBias:
    """Estimate the bias of sigma_tr along single directions from its mean over all directions.

    Parameters
    ----------
    anisotropy : Anisotropy
        Where it is not `valid`, biases are 0 with infinite standard errors.
    angle_rad : array_like, shape (K,)
        Directions of the head, rad.

    Returns
    -------
    OneDirectionBias

    Raises
    ------
    AnisotropyError
        For directions that are not finite.

    Examples
    --------
    >>> from reconstruction.anisotropy.estimation import estimate
    >>> angle = np.deg2rad(np.arange(16) * 22.5)
    >>> found = estimate(angle, np.hypot(np.cos(angle) / 1.2, np.sin(angle)))
    >>> bias = estimate_single_direction_bias(found, [0.0, np.pi / 2])
    >>> bias.bias.round(3).tolist(), round(float(bias.rms), 3)
    ([-0.093, 0.089], 0.064)
    """
    angle = np.atleast_1d(np.asarray(angle_rad, np.float64))
    Checks(AnisotropyError).numbers("angle_rad", angle, ("K",))
    shape = anisotropy.valid.shape
    valid = anisotropy.valid.reshape(-1)
    p = anisotropy.parameters.reshape(-1, 3)
    covariance = np.where(valid[:, None, None], anisotropy.covariance.reshape(-1, 3, 3), 0.0)
    flat = np.column_stack([np.zeros(len(p)), p[:, 1:]])
    mean, mean_by = diffusion_ellipse.mean_over_directions(flat)
    values, by_uv = diffusion_ellipse.relative_sigma_tr(angle, p[:, 1:])
    ratio = values / mean[:, None]
    by = (
        by_uv / mean[:, None, None]
        - (values / mean[:, None] ** 2)[..., None] * (mean_by[:, None, 1:])
    )
    variance = np.einsum("bki,bij,bkj->kb", by, covariance[:, 1:, 1:], by)
    h = np.hypot(p[:, 1], p[:, 2])
    every = diffusion_ellipse.uniform_axial_directions()
    around = diffusion_ellipse.relative_sigma_tr(every, p[:, 1:])[0] / mean[:, None]
    stderr = np.where(valid, np.sqrt(np.maximum(variance, 0.0)), math.inf)
    return SingleDirectionBias(
        bias=(ratio - 1.0).T.reshape((-1, *shape)),
        stderr=stderr.reshape((-1, *shape)),
        lowest=(np.exp(-0.5 * h) / mean - 1.0).reshape(shape),
        highest=(np.exp(0.5 * h) / mean - 1.0).reshape(shape),
        rms=np.sqrt(((around - 1.0) ** 2).mean(axis=1)).reshape(shape),
    )
