"""The homogeneous medium whose profile is nearest to that of layered tissue, and how sure it is.

Tissue of layers has no sigma_tr of its own. What stands for it is a definition: of all half spaces
of asymmetry `G` the one whose profile is nearest up to a factor, by the mean square of the
logarithms of the ratios over all fibres that take `FAINTEST_PER_MM2` or more, each of one weight.
What is left of the profile then is no error of that medium: residuals that are there without any
noise move it as little as they move the mean of a sample. So they must not widen its interval, and
no fibre may be left out for the sake of its residual, or weighed by its noise: any other weights
tell of another medium, its sigma_tr off by as much as a tenth where the misfit is a tenth.

So two things are told apart. First what the profile is without noise, at all of the definition's
fibres: readings, and that what layers do to a profile is smooth
(`reconstruction.subsurface.smooth_misfit`). Then the medium nearest to that, all fibres alike. A
profile that is off by e, of covariance V, moves the medium by::

    A^-1 J' e,   A = J' J - sum r J2

with J and J2 the first and second derivatives of log R and r what is left.

References
----------
White 1982, doi:10.2307/1912526: errors of what is nearest in a family that does not hold the truth.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.subsurface.models import LEAST_LOG, ProfileModel
from reconstruction.subsurface.profile_batch import (
    LEAST_DEVIATION,
    START_ERROR,
    ProfileBatch,
    fits_from,
)
from reconstruction.subsurface.smooth_misfit import smooth_misfit

G: Final = 0.8
"""Asymmetry of the media, of the definition."""
FAINTEST_PER_MM2: Final = 1e-7
"""Of the definition's fibres: what 23 exposures up to 30 s still tell to about a tenth."""
MOST_NOISE: Final = 0.3
"""Relative deviation of a reading up to which it counts as used, and fits begin with it."""
BY_LOGARITHM: Final = 0.1
"""Likewise up to which its logarithm is compared. Of fainter ones that would leave out the low
readings; they are compared as they are, with the profile found so far."""
MOST_STEP: Final = 3.0
"""Logarithms by which such a reading may move the profile in a round: noise of no light does not
lift it by orders of magnitude."""
DIMMING: Final = 1.0
"""Standard deviation of the log of the factor: a layer on top dims, and does not do so by a hundred
or brighten, as media of next to no scattering would ask for."""
TABLE_ERROR: Final = 0.004
"""Relative error of the photon table that fibres at like reduced distances share, as
`model.photon_table.relative_error` has it at 10 to 40 / sigma_s'."""
TABLE_RISE: Final = (5.0, 30.0)
"""Reduced distances between which it comes in."""
DENSE: Final = 0.1
"""Below the logarithm of the most scattering: a start there."""
ROUNDS: Final = 4
"""Times the profile without noise and the fibres that count are taken anew."""
VALLEYS_AFTER: Final = 1
"""Of them, those before all valleys of the misfit are looked at again, by the profile found."""
STEP: Final = 1e-3
"""Of parameters, for second derivatives."""
FREE: Final = 3
"""Parameters that are fitted: log sigma_a, log sigma_s', log of the factor."""


def fit_nearest(batch: ProfileBatch, model: ProfileModel, chosen: NDArray[np.intp]) -> None:
    """Fit the nearest medium to some of a batch's profiles, with its errors.

    Parameters
    ----------
    batch
        Laid out with variances and a factor that is free; takes the results. Its covariances are
        of the medium by the definition, its spread is the deviation of the profile from it.
    model
        A table at the fibres' radii.
    chosen
        Profiles of the batch, (N,).
    """
    y, variance = batch.y[chosen], batch.variance[chosen]
    safe = np.where(batch.seen[chosen], y, 1.0)
    noise = np.where(batch.seen[chosen], np.sqrt(variance) / safe, np.inf)
    told = batch.seen[chosen] & (noise < MOST_NOISE)
    # the mean of a logarithm is below the logarithm of the mean
    logs = np.where(told, np.log(safe) + 0.5 * np.where(told, noise, 0.0) ** 2, 0.0)
    counts = told & (y >= FAINTEST_PER_MM2)
    wide = np.where(counts, noise**2 + model.error[0] ** 2 + START_ERROR**2, np.inf)
    _nearest_of(batch, model, chosen, logs, wide, _starts(batch, model, logs, counts))
    profile = np.log(np.maximum(batch.predicted[chosen], 1e-290))
    spread = np.full(len(chosen), START_ERROR)
    doubt = np.zeros((len(chosen), 4, 4))
    for round_ in range(ROUNDS):
        medium = np.log(np.maximum(batch.predicted[chosen], 1e-290))
        reading, own = _readings(batch, model, chosen, profile)
        misfit, error = smooth_misfit(model.radius_mm, reading - medium, own)
        profile = medium + misfit
        owed = profile >= np.log(FAINTEST_PER_MM2)
        alike = np.where(owed, np.maximum(spread, LEAST_DEVIATION)[:, None] ** 2, np.inf)
        if round_ == VALLEYS_AFTER:
            starts = _starts(batch, model, profile, owed)
            doubt = _nearest_of(batch, model, chosen, profile, alike, starts, error)
        else:
            batch.run(model, chosen, profile, alike, batch.theta[chosen], logarithmic=True)
        m = batch.predicted[chosen]
        off = np.where(owed, profile - np.log(np.maximum(m, 1e-290)), 0.0)
        spread = np.sqrt((off**2).sum(axis=1) / np.maximum(owed.sum(axis=1), 1))
    batch.covariance[chosen] = doubt + _covariance(
        model, batch.theta[chosen], off, owed, error, spread
    )
    counts = told & owed
    stated = variance + model.relative_variance(batch.theta[chosen]) * m**2
    square = np.where(counts, (y - m) ** 2, 0.0)
    batch.chi2[chosen] = (square / np.where(counts, stated, 1.0)).sum(axis=1)
    wide = np.where(counts, own + spread[:, None] ** 2, np.inf)
    batch.total[chosen] = np.where(counts, wide * m**2, np.inf)
    batch.used[chosen] = counts
    batch.seen[chosen] &= counts
    batch.spread[chosen] = spread


def _readings(
    batch: ProfileBatch, model: ProfileModel, chosen: NDArray[np.intp], profile: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return logarithms of readings about a profile's, and their variances, each (N, F).

    Parameters
    ----------
    profile
        Logarithms of what they are without noise, as far as it is known, (N, F).
    """
    m, y = np.exp(np.maximum(profile, LEAST_LOG)), batch.y[chosen]
    known = batch.used[chosen] & np.isfinite(batch.variance[chosen])
    relative = np.where(known, batch.variance[chosen], 0.0) / m**2
    bright = known & (y > 0.0) & (relative < BY_LOGARITHM**2)
    reading = profile + np.clip(y / m - 1.0, -MOST_STEP, MOST_STEP)
    reading = np.where(bright, np.log(np.where(bright, y, 1.0)) + 0.5 * relative, reading)
    own = np.where(known, relative + model.error[0] ** 2, np.inf)
    return np.where(known, reading, profile), own


def _starts(
    batch: ProfileBatch, model: ProfileModel, logs: Float64Array, counts: BoolArray
) -> tuple[Float64Array, ...]:
    """Return where fits begin, each (N, 4): two valleys, and the most scattering there is."""
    best, second, _ = model.starts(
        logs, counts / START_ERROR**2, float(batch.prior[3, 0]), float(batch.prior[2, 1])
    )
    told = np.asarray(np.isfinite(second).all(axis=1))
    second = np.where(told[:, None], second, best)
    dense = best.copy()
    dense[:, 1] = model.bounds[1, 1] - DENSE
    dense[:, 0] += best[:, 1] - dense[:, 1]  # sigma_tr as it was
    return best, second, dense


def _nearest_of(
    batch: ProfileBatch,
    model: ProfileModel,
    chosen: NDArray[np.intp],
    logs: Float64Array,
    wide: Float64Array,
    starts: tuple[Float64Array, ...],
    error: Float64Array | None = None,
) -> Float64Array:
    """Fit from every start, keep the nearest medium; return what the others leave in doubt.

    Media may be as near as each other and far apart. Which one is nearest, a table that is off by
    `TABLE_ERROR` at many fibres alike then decides by chance: its mean square misfit of deviation d
    has the error 2 d `TABLE_ERROR`, to which that of the profile adds (``error``, (N, F, F)). The
    others' distances join the covariance, each with its odds.
    """
    square, theta, offs = [], [], []
    for number, start in enumerate(starts):
        alone = fits_from(model, logs, wide, start.copy(), batch.prior, logarithmic=True)
        batch.keep(chosen, alone, better=number > 0)
        known: BoolArray = np.isfinite(wide)
        off = np.where(known, logs - np.log(np.maximum(alone.predicted, 1e-290)), 0.0)
        prior = (START_ERROR * alone.theta[:, 2] / DIMMING) ** 2
        square.append(((off**2).sum(axis=1) + prior) / np.maximum(known.sum(axis=1), 1))
        theta.append(alone.theta)
        offs.append(off)
    misfit, places = np.stack(square), np.stack(theta)
    least = misfit.min(axis=0)
    sure = np.broadcast_to(np.maximum(2.0 * np.sqrt(least) * TABLE_ERROR, 1e-12), misfit.shape)
    if error is not None:
        residual = np.stack(offs)
        best = np.take_along_axis(residual, misfit.argmin(axis=0)[None, :, None], axis=0)
        count = np.maximum(np.isfinite(wide).sum(axis=1), 1)
        moved = 2.0 * (residual - best) / count[:, None]
        sure = np.sqrt(sure**2 + np.einsum("knf,nfh,knh->kn", moved, error, moved))
    odds = ndtr(-(misfit - least) / sure)
    away = places - batch.theta[chosen]
    away[..., FREE:] = 0.0
    return np.asarray(np.einsum("kn,knp,knq->npq", odds, away, away))


def _covariance(
    model: ProfileModel,
    theta: Float64Array,
    off: Float64Array,
    owed: BoolArray,
    error: Float64Array,
    spread: Float64Array,
) -> Float64Array:
    """Return the covariance of the parameters, (N, 4, 4), by that of profiles; see the module."""
    share = owed.astype(np.float64)
    first = _slopes(model, theta)
    bread = np.einsum("npf,nf,nqf->npq", first, share, first)
    bread[:, 2, 2] += np.maximum(spread, LEAST_DEVIATION) ** 2 / DIMMING**2
    for q in range(FREE):
        shift = np.zeros(theta.shape[1])
        shift[q] = STEP
        second = (_slopes(model, theta + shift) - _slopes(model, theta - shift)) / (2.0 * STEP)
        bread[:, :, q] -= np.einsum("nf,nf,npf->np", share, off, second)
    along = first * share[:, None]
    meat = along @ error @ along.transpose(0, 2, 1)
    reduced = model.radius_mm * np.exp(theta[:, 1:2])
    rise = np.log(reduced / TABLE_RISE[0]) / np.log(TABLE_RISE[1] / TABLE_RISE[0])
    table = np.einsum("npf,nf->np", first, share * TABLE_ERROR * np.clip(rise, 0.0, 1.0))
    meat += table[:, :, None] * table[:, None, :]
    definite = np.all(np.linalg.eigvalsh(0.5 * (bread + bread.transpose(0, 2, 1))) > 0.0, axis=1)
    inverse = np.linalg.inv(np.where(definite[:, None, None], bread, np.eye(FREE)))
    covariance = np.zeros((len(theta), 4, 4))
    covariance[:, :FREE, :FREE] = inverse @ meat @ inverse.transpose(0, 2, 1)
    covariance[~definite] = np.inf
    return covariance


def _slopes(model: ProfileModel, theta: Float64Array) -> Float64Array:
    """Return the derivatives of log R by the free parameters, (N, 3, F)."""
    value, slope = model.profiles(np.ascontiguousarray(theta))
    return np.asarray(slope[:, :FREE] / np.maximum(value, 1e-290)[:, None])
