"""The homogeneous medium whose profile is nearest to that of layered tissue, and how sure it is.

Tissue of layers has no sigma_tr of its own. What stands for it is a definition: of all half spaces
of asymmetry `G` the one whose profile is nearest up to a factor, by the mean square of the
logarithms of the ratios over all fibres that take `FAINTEST_PER_MM2` or more, each of one weight.
What is left of the profile then is no error of that medium: residuals that are there without any
noise move it as little as they move the mean of a sample. So they must not widen its interval, and
no fibre may be left out for the sake of its residual, or weighed by its noise where that is less
than the misfit: any other weights tell of another medium.

With residuals r0 of the noiseless profile of deviation tau, noise e of relative deviation s, and
weights k = tau^2 / (tau^2 + s^2), the medium found is off by::

    A^-1 J' (k e - (1 - k) r0),   A = J' k J - sum k r J2,   J' r0 = 0

J and J2 the first and second derivatives of log R. The first term is noise, as far as it counts.
The second is what the definition's medium owes to fibres that hardly show: known only as far as
neighbours are alike, of which the residuals tell.

References
----------
White 1982, doi:10.2307/1912526: errors of what is nearest in a family that does not hold the truth.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reconstruction.profile_batch import LEAST_DEVIATION, START_ERROR, ProfileBatch
from reconstruction.subsurface_models import ProfileModel

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

G: Final = 0.8
"""Asymmetry of the media, of the definition."""
FAINTEST_PER_MM2: Final = 1e-7
"""Of the definition's fibres: what 23 exposures up to 30 s still tell to about a tenth."""
MOST_NOISE: Final = 0.3
"""Relative deviation of a reading up to which its logarithm is used."""
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
ROUNDS: Final = 3
"""Times the misfit and the fibres that count are taken anew."""
MOMENTS: Final = 8
"""Times the misfit's own weights are taken anew."""
STEP: Final = 1e-3
"""Of parameters, for second derivatives."""
MOST_ALIKE: Final = 0.95
"""Correlation of the misfit of neighbours."""
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
    own = np.where(told, noise**2 + model.error[0] ** 2, np.inf)
    counts = told & (y >= FAINTEST_PER_MM2)
    spread = np.full(len(chosen), START_ERROR)
    starts = _starts(batch, model, logs, counts)
    doubt = np.zeros((len(chosen), 4, 4))
    for round_ in range(ROUNDS):
        wide = np.where(counts, own + spread[:, None] ** 2, np.inf)
        if round_ == 0:
            doubt = _nearest_of(batch, model, chosen, logs, wide, starts)
        else:
            batch.run(model, chosen, logs, wide, batch.theta[chosen], logarithmic=True)
        off = np.where(counts, logs - np.log(np.maximum(batch.predicted[chosen], 1e-290)), 0.0)
        spread = _misfit(off, own, counts)
        counts = told & (batch.predicted[chosen] >= FAINTEST_PER_MM2)
    owed = batch.predicted[chosen] >= FAINTEST_PER_MM2
    m = batch.predicted[chosen]
    batch.covariance[chosen] = doubt + _covariance(
        model, batch.theta[chosen], off, np.where(counts, own, np.inf), spread, owed
    )
    stated = variance + model.relative_variance(batch.theta[chosen]) * m**2
    square = np.where(counts, (y - m) ** 2, 0.0)
    batch.chi2[chosen] = (square / np.where(counts, stated, 1.0)).sum(axis=1)
    batch.total[chosen] = np.where(counts, wide * m**2, np.inf)
    batch.used[chosen] = counts
    batch.seen[chosen] &= counts
    batch.spread[chosen] = spread


def _starts(
    batch: ProfileBatch, model: ProfileModel, logs: Floats, counts: Bools
) -> tuple[Floats, ...]:
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
    batch: ProfileBatch, model: ProfileModel, chosen: NDArray[np.intp], logs: Floats,
    wide: Floats, starts: tuple[Floats, ...],
) -> Floats:  # fmt: skip
    """Fit from every start, keep the nearest medium; return what the others leave in doubt.

    Media may be as near as each other and far apart. Which one is nearest, a table that is off by
    `TABLE_ERROR` at many fibres alike then decides by chance: its mean square misfit of deviation d
    has the error 2 d `TABLE_ERROR`. The others' distances join the covariance, each with its odds.
    """
    square, theta = [], []
    for number, start in enumerate(starts):
        batch.run(model, chosen, logs, wide, start.copy(), better=number > 0, logarithmic=True)
        alone = ProfileBatch.of(batch.y[chosen], batch.variance[chosen], batch.used[chosen],
                                batch.prior)  # fmt: skip
        alone.run(model, np.arange(len(chosen)), logs, wide, start.copy(), logarithmic=True)
        known: Bools = np.isfinite(wide)
        off = np.where(known, logs - np.log(np.maximum(alone.predicted, 1e-290)), 0.0)
        prior = (START_ERROR * alone.theta[:, 2] / DIMMING) ** 2
        square.append(((off**2).sum(axis=1) + prior) / np.maximum(known.sum(axis=1), 1))
        theta.append(alone.theta)
    misfit, places = np.stack(square), np.stack(theta)
    least = misfit.min(axis=0)
    sure = np.maximum(2.0 * np.sqrt(least) * TABLE_ERROR, 1e-12)
    odds = ndtr(-(misfit - least) / sure)
    away = places - batch.theta[chosen]
    away[..., FREE:] = 0.0
    return np.asarray(np.einsum("kn,knp,knq->npq", odds, away, away))


def _misfit(off: Floats, own: Floats, counts: Bools) -> Floats:
    """Return the deviation of noiseless profiles from the media, (N,): residuals less the noise.

    By moments of weights that are those of the fit, else a single noisy fibre would hide all misfit
    (Paule and Mandel 1982, doi:10.6028/jres.087.022).
    """
    kept = counts.sum(axis=1)
    spared = kept / np.maximum(kept - FREE, 1)  # residuals of a fit are smaller than errors
    square = off**2 * spared[:, None]
    variance = np.full(len(off), START_ERROR**2)
    noise = np.where(counts, own, 1.0)
    for _ in range(MOMENTS):
        weight = np.where(counts, 1.0 / (noise + variance[:, None]) ** 2, 0.0)
        excess = (weight * (square - noise)).sum(axis=1)
        total = np.maximum(weight.sum(axis=1), 1e-290)
        variance = np.maximum(excess / total, LEAST_DEVIATION**2)
    return np.asarray(np.sqrt(variance))


def _covariance(
    model: ProfileModel, theta: Floats, off: Floats, own: Floats, spread: Floats, owed: Bools
) -> Floats:
    """Return the covariance of the parameters, (N, 4, 4); see the module."""
    count, fibres = off.shape
    share = spread[:, None] ** 2 / (spread[:, None] ** 2 + own)  # k
    first = _slopes(model, theta)
    bread = np.einsum("npf,nf,nqf->npq", first, share, first)
    for q in range(FREE):
        shift = np.zeros(theta.shape[1])
        shift[q] = STEP
        second = (_slopes(model, theta + shift) - _slopes(model, theta - shift)) / (2.0 * STEP)
        bread[:, :, q] -= np.einsum("nf,nf,npf->np", share, off, second)
    noise = np.where(np.isfinite(own), share**2 * np.where(np.isfinite(own), own, 0.0), 0.0)
    missing = np.where(owed, (1.0 - share) * spread[:, None], 0.0)
    apart = np.abs(np.arange(fibres)[:, None] - np.arange(fibres))
    alike = _alike(off, np.asarray(np.isfinite(own)))[:, None, None] ** apart
    meat = np.einsum("npf,nf,nqf->npq", first, noise, first)
    meat += np.einsum("npf,nf,nfh,nh,nqh->npq", first, missing, alike, missing, first)
    covariance = np.full((count, 4, 4), 0.0)
    reduced = model.radius_mm * np.exp(theta[:, 1:2])
    rise = np.log(reduced / TABLE_RISE[0]) / np.log(TABLE_RISE[1] / TABLE_RISE[0])
    table = np.einsum("npf,nf->np", first, share * TABLE_ERROR * np.clip(rise, 0.0, 1.0))
    meat += table[:, :, None] * table[:, None, :]
    definite = np.all(np.linalg.eigvalsh(0.5 * (bread + bread.transpose(0, 2, 1))) > 0.0, axis=1)
    inverse = np.linalg.inv(np.where(definite[:, None, None], bread, np.eye(FREE)))
    covariance[:, :FREE, :FREE] = inverse @ meat @ inverse.transpose(0, 2, 1)
    covariance[~definite] = np.inf
    return covariance


def _slopes(model: ProfileModel, theta: Floats) -> Floats:
    """Return the derivatives of log R by the free parameters, (N, 3, F)."""
    value, slope = model.profiles(np.ascontiguousarray(theta))
    return np.asarray(slope[:, :FREE] / np.maximum(value, 1e-290)[:, None])


def _alike(off: Floats, counts: Bools) -> Floats:
    """Return the correlation of residuals of neighbours, (N,)."""
    both = counts[:, 1:] & counts[:, :-1]
    pairs = np.where(both, off[:, 1:] * off[:, :-1], 0.0).sum(axis=1)
    squares = np.maximum((np.where(counts, off, 0.0) ** 2).sum(axis=1), 1e-290)
    return np.asarray(np.clip(pairs / squares, 0.0, MOST_ALIKE))
