"""Fit the homogeneous medium whose profile is nearest to that of layered tissue, with its errors.

Layered tissue has no sigma_tr of its own, so it is defined: of all half spaces of asymmetry
`NEAREST_MEDIUM_G`, the one whose profile is nearest up to a factor. Distance is the mean square of
the logarithms of the ratios, with equal weights, over all fibers that collect
`MIN_REFLECTANCE_PER_MM2` or more.

The remaining residuals are not an error of that medium: as they exist without any noise, they move
it as little as they move the mean of a sample. So they must not widen its interval. No fiber may be
omitted for its residual or weighted by its noise: other weights define another medium, whose
sigma_tr differs by as much as a tenth where the misfit is a tenth.

There are two steps. First, estimate the profile without noise at all of the definition's fibers,
from the readings and the smoothness of what layers do to a profile
(`reconstruction.subsurface.smooth_misfit`). Second, fit the medium nearest to that, all fibers
alike. An error e of the profile, of covariance V, moves the medium by::

with J and J2 the first and second derivatives of log R and r the remaining residuals.

References
----------
White 1982, doi:10.2307/1912526: errors of the nearest member of a family without the true one.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import ndtr

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.subsurface.models import MIN_LOG_REFLECTANCE, ProfileModel
from reconstruction.subsurface.profile_batch import Fits, ProfileBatch, fit_from
from reconstruction.subsurface.profile_fit import MIN_DEVIATION, START_DEVIATION
from reconstruction.subsurface.smooth_misfit import smooth_misfit

NEAREST_MEDIUM_G: Final = 0.8
"""Asymmetry of the media, by definition."""
MIN_REFLECTANCE_PER_MM2: Final = 1e-7
"""Least reflectance of the definition's fibers: 23 exposures up to 30 s measure it to a tenth."""
MAX_RELATIVE_NOISE: Final = 0.3
"""Relative deviation of a reading up to which it counts as used and starts the fit."""
MAX_LOG_NOISE: Final = 0.1
"""Relative deviation up to which a reading's logarithm is compared. Logarithms of fainter ones
would omit low readings; these are compared linearly, about the profile found so far."""
MAX_FAINT_LOG_STEP: Final = 3.0
"""Logarithms by which such a reading may move the profile in a round: noise without light must not
raise it by orders of magnitude."""
LOG_FACTOR_SIGMA: Final = 1.0
"""Standard deviation of the log of the factor: a layer on top dims, but neither by a hundred nor
does it brighten, as media of almost no scattering would require."""
SHARED_TABLE_ERROR: Final = 0.004
"""Relative error of the photon table that fibers at like reduced distances share, as
`model.photon_table.relative_error` has it at 10 to 40 / sigma_s'."""
TABLE_ERROR_RANGE: Final = (5.0, 30.0)
"""Reduced distances between which that error sets in."""
DENSE_LOG_OFFSET: Final = 0.1
"""Offset of a start below the logarithm of the largest scattering."""
N_ROUNDS: Final = 4
"""Times the profile without noise and its fibers are recomputed."""
VALLEY_ROUND: Final = 1
"""Rounds before all valleys of the misfit are searched again with the profile found."""
DIFFERENCE_STEP: Final = 1e-3
"""Step of the parameters for second derivatives."""
N_FREE: Final = 3
"""Parameters that are fitted: log sigma_a, log sigma_s', log of the factor."""


def fit_nearest(batch: ProfileBatch, model: ProfileModel) -> Fits:
    """Fit the nearest medium to the profiles of a batch, with its errors.

    Parameters
    ----------
    batch
        Laid out with variances and a factor that is free.
    model
        Table at the fibers' radii.

    Returns
    -------
    Fits
        Covariances are of the medium by the definition, the model's error is the deviation of
        the profile from it.
    """
    y, variance, observed = batch.y, batch.variance, batch.observed
    safe = np.where(observed, y, 1.0)
    noise = np.where(observed, np.sqrt(variance) / safe, np.inf)
    known = observed & (noise < MAX_RELATIVE_NOISE)
    # E[log y] is about log E[y] - variance / (2 E[y]^2): add that bias back
    logs = np.where(known, np.log(safe) + 0.5 * np.where(known, noise, 0.0) ** 2, 0.0)
    counts = known & (y >= MIN_REFLECTANCE_PER_MM2)
    wide = np.where(counts, noise**2 + model.error[0] ** 2 + START_DEVIATION**2, np.inf)
    fits, _ = _nearest_of(batch, model, logs, wide, _starts(batch, model, logs, counts))
    profile = fits.log_predicted
    deviation = np.full(len(y), START_DEVIATION)
    doubt = np.zeros((len(y), 4, 4))
    for round_ in range(N_ROUNDS):
        medium = fits.log_predicted
        reading, own = _readings(batch, model, profile)
        misfit, error = smooth_misfit(model.radius_mm, reading - medium, own)
        profile = medium + misfit
        bright = profile >= np.log(MIN_REFLECTANCE_PER_MM2)
        alike = np.where(bright, np.maximum(deviation, MIN_DEVIATION)[:, None] ** 2, np.inf)
        if round_ == VALLEY_ROUND:
            starts = _starts(batch, model, profile, bright)
            fits, doubt = _nearest_of(batch, model, profile, alike, starts, error)
        else:
            fits = fit_from(model, batch, fits.theta, y=profile, variance=alike)
        off = np.where(bright, profile - fits.log_predicted, 0.0)
        deviation = np.sqrt((off**2).sum(axis=1) / np.maximum(bright.sum(axis=1), 1))
    m, counts = fits.predicted, known & bright
    stated = variance + model.relative_variance(fits.theta) * m**2
    square = np.where(counts, (y - m) ** 2, 0.0)
    wide = np.where(counts, own + deviation[:, None] ** 2, np.inf)
    return replace(
        fits,
        covariance=doubt + _covariance(model, fits.theta, off, bright, error, deviation),
        chi2=(square / np.where(counts, stated, 1.0)).sum(axis=1),
        total=np.where(counts, wide * m**2, np.inf),
        used=counts,
        observed=observed & counts,
        model_error=deviation,
    )


def _readings(
    batch: ProfileBatch, model: ProfileModel, profile: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return logarithms of readings near a profile's, and their variances, each (N, F).

    Parameters
    ----------
    profile
        Logarithms of the noise-free profile found so far, (N, F).
    """
    m, y = np.exp(np.maximum(profile, MIN_LOG_REFLECTANCE)), batch.y
    known = batch.used & np.isfinite(batch.variance)
    relative = np.where(known, batch.variance, 0.0) / m**2
    bright = known & (y > 0.0) & (relative < MAX_LOG_NOISE**2)
    reading = profile + np.clip(y / m - 1.0, -MAX_FAINT_LOG_STEP, MAX_FAINT_LOG_STEP)
    reading = np.where(bright, np.log(np.where(bright, y, 1.0)) + 0.5 * relative, reading)
    own = np.where(known, relative + model.error[0] ** 2, np.inf)
    return np.where(known, reading, profile), own


def _starts(
    batch: ProfileBatch, model: ProfileModel, logs: Float64Array, counts: BoolArray
) -> tuple[Float64Array, ...]:
    """Return starts of the fits, each (N, 4): two valleys, and the largest scattering."""
    best, second, _ = model.starts(
        logs, counts / START_DEVIATION**2, float(batch.prior[3, 0]), float(batch.prior[2, 1])
    )
    known = np.asarray(np.isfinite(second).all(axis=1))
    second = np.where(known[:, None], second, best)
    dense = best.copy()
    dense[:, 1] = model.bounds[1, 1] - DENSE_LOG_OFFSET
    dense[:, 0] += best[:, 1] - dense[:, 1]  # sigma_tr as it was
    return best, second, dense


def _nearest_of(
    batch: ProfileBatch,
    model: ProfileModel,
    logs: Float64Array,
    wide: Float64Array,
    starts: tuple[Float64Array, ...],
    error: Float64Array | None = None,
) -> tuple[Fits, Float64Array]:
    """Fit from every start; return the nearest medium and the covariance between candidates.

    Distant media may be almost equally near. A table that is off by `SHARED_TABLE_ERROR` at many
    fibers alike then decides between them by chance: its mean square misfit of deviation d has the
    error 2 d `SHARED_TABLE_ERROR`, to which that of the profile adds (``error``, (N, F, F)). The
    others' distances join the covariance, each with its odds.
    """
    each = [fit_from(model, batch, start, y=logs, variance=wide) for start in starts]
    nearest = each[0]
    for other in each[1:]:
        nearest = nearest.with_likelier(np.arange(len(logs)), other)
    known: BoolArray = np.isfinite(wide)
    count = np.maximum(known.sum(axis=1), 1)
    residual = np.stack([np.where(known, logs - fits.log_predicted, 0.0) for fits in each])
    positions = np.stack([fits.theta for fits in each])
    prior = (START_DEVIATION * positions[:, :, 2] / LOG_FACTOR_SIGMA) ** 2
    misfit = ((residual**2).sum(axis=2) + prior) / count
    least = misfit.min(axis=0)
    table_error = 2.0 * np.sqrt(least) * SHARED_TABLE_ERROR
    sigma = np.broadcast_to(np.maximum(table_error, 1e-12), misfit.shape)
    if error is not None:
        best = np.take_along_axis(residual, misfit.argmin(axis=0)[None, :, None], axis=0)
        moved = 2.0 * (residual - best) / count[:, None]
        sigma = np.sqrt(sigma**2 + np.einsum("knf,nfh,knh->kn", moved, error, moved))
    odds = ndtr(-(misfit - least) / sigma)
    away = positions - nearest.theta
    away[..., N_FREE:] = 0.0
    return nearest, np.asarray(np.einsum("kn,knp,knq->npq", odds, away, away))


def _covariance(
    model: ProfileModel,
    theta: Float64Array,
    off: Float64Array,
    bright: BoolArray,
    error: Float64Array,
    deviation: Float64Array,
) -> Float64Array:
    """Return the covariance of the parameters, (N, 4, 4), by that of profiles.

    The sandwich A^-1 M A^-T of White 1982: A = J'J - sum r J2 is `bread`; M = J'VJ and the part
    that the table's shared error adds is `meat`.
    """
    share = bright.astype(np.float64)
    first = _slopes(model, theta)
    bread = np.einsum("npf,nf,nqf->npq", first, share, first)
    bread[:, 2, 2] += np.maximum(deviation, MIN_DEVIATION) ** 2 / LOG_FACTOR_SIGMA**2
    for q in range(N_FREE):
        shift = np.zeros(theta.shape[1])
        shift[q] = DIFFERENCE_STEP
        second = _slopes(model, theta + shift) - _slopes(model, theta - shift)
        second /= 2.0 * DIFFERENCE_STEP
        bread[:, :, q] -= np.einsum("nf,nf,npf->np", share, off, second)
    along = first * share[:, None]
    meat = along @ error @ along.transpose(0, 2, 1)
    reduced = model.radius_mm * np.exp(theta[:, 1:2])
    near, far = TABLE_ERROR_RANGE
    rise = np.log(reduced / near) / np.log(far / near)
    table = np.einsum("npf,nf->np", first, share * SHARED_TABLE_ERROR * np.clip(rise, 0.0, 1.0))
    meat += table[:, :, None] * table[:, None, :]
    definite = np.all(np.linalg.eigvalsh(0.5 * (bread + bread.transpose(0, 2, 1))) > 0.0, axis=1)
    inverse = np.linalg.inv(np.where(definite[:, None, None], bread, np.eye(N_FREE)))
    covariance = np.zeros((len(theta), 4, 4))
    covariance[:, :N_FREE, :N_FREE] = inverse @ meat @ inverse.transpose(0, 2, 1)
    covariance[~definite] = np.inf
    return covariance


def _slopes(model: ProfileModel, theta: Float64Array) -> Float64Array:
    """Return the derivatives of log R by the free parameters, (N, 3, F)."""
    value, slope = model.profiles(np.ascontiguousarray(theta))
    return np.asarray(slope[:, :N_FREE] / np.maximum(value, 1e-290)[:, None])
