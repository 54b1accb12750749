"""Estimate what one person's skin has in common from the signals of several rigs.

Unknown in common are the properties of skin (`PROPERTY_NAMES`), one offset for each signal, and the
face's mean log melanin and log blood. The offset is a rig's calibration error plus what the model
leaves unexplained of real skin; its covariance is known beforehand. Each region of the face has a
melanin and a blood of its own. Gauss-Newton steps eliminate the regions by the Schur complement.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from model.tissue_optics.constants import SKIN_CONSTANTS
from reconstruction.arrays import Float64Array
from reconstruction.chromophores.table_fit.fitting import (
    POPULATION_BLOOD,
    POPULATION_LOG_SD,
    POPULATION_MELANIN,
)
from reconstruction.fusion.signals import (
    MAX_PROPERTY_SD,
    N_PROPERTIES,
    FusionError,
    RigBands,
    SignalTable,
    clip_to_range,
    evaluate_signals,
)

UNKNOWN_VARIANCE: Final = 1e6
"""Variance of a signal that was not measured."""
PERSON_ITERATIONS: Final = 8
"""Gauss-Newton steps; the last ones change the properties by little."""
START_SPREAD: Final = (0.3, 0.4)
"""Standard deviations of log melanin and log blood over a face, as a start."""
MIN_SPREAD: Final = 0.05
"""Least of these standard deviations."""
SPREAD_WEIGHT: Final = 2.0
"""Regions that the start of the spread counts as."""
POPULATION_MEAN: Final = np.log(
    [POPULATION_MELANIN * SKIN_CONSTANTS.melanin_depth_factor, POPULATION_BLOOD]
)
"""Mean log melanin optical depth and log blood over people."""


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Mean signals of regions of a face.

    Attributes
    ----------
    values
        (K, S): mean log signals; ignored where the variance is `UNKNOWN_VARIANCE`.
    covariance
        (K, S, S): covariance of errors that a region does not share with the others.
    """

    values: Float64Array
    covariance: Float64Array

    def without(self, columns: slice) -> "Regions":
        """Return the same without some signals.

        Parameters
        ----------
        columns
            Signals to leave out.
        """
        covariance = self.covariance.copy()
        covariance[:, columns, :] = covariance[:, :, columns] = 0.0
        at = np.arange(covariance.shape[-1])[columns]
        covariance[:, at, at] = UNKNOWN_VARIANCE
        return Regions(self.values, covariance)


@dataclass(frozen=True, eq=False)
class PersonSkin:
    """Estimates of what one person's skin has in common.

    Attributes
    ----------
    rigs
        Rigs of the signals.
    properties_sd
        (6,): properties, in standard deviations of their priors.
    offset
        (S,): common error of each log signal.
    mean
        (2,): mean log melanin optical depth and log blood of the face.
    covariance
        (8 + S, 8 + S): posterior covariance of properties, offset and mean, in this order.
    spread
        (2, 2): covariance of log melanin and log blood over the face.
    regions
        (K, 2): log melanin and log blood of the regions.
    log_evidence
        Logarithm of the marginal likelihood by Laplace's approximation, up to a constant of the
        measurements.
    """

    rigs: tuple[RigBands, ...]
    properties_sd: Float64Array
    offset: Float64Array
    mean: Float64Array
    covariance: Float64Array
    spread: Float64Array
    regions: Float64Array
    log_evidence: float

    @cached_property
    def table(self) -> SignalTable:
        """Signals over melanin and blood at the estimated properties."""
        return SignalTable.build(self.rigs, self.properties_sd)

    @property
    def offset_columns(self) -> slice:
        """Columns of the offset in `covariance`."""
        return slice(N_PROPERTIES, N_PROPERTIES + 3 * len(self.rigs))


def estimate_person(
    rigs: Sequence[RigBands],
    regions: Regions,
    offset_covariance: Float64Array,
    *,
    start: PersonSkin | None = None,
    known: Sequence[int] = (),
) -> PersonSkin:
    """Estimate properties, offsets and mean of a face from the signals of its regions.

    Parameters
    ----------
    rigs
        Rigs, three signals each.
    regions
        Signals of K regions.
    offset_covariance
        (S, S): prior covariance of the offsets, positive definite.
    start
        Earlier estimate of the same rigs to start from; None: typical skin.
    known
        Numbers of the properties that are taken as known from the start.

    Returns
    -------
    PersonSkin

    Raises
    ------
    FusionError
        If shapes do not fit or no signal is known.

    Examples
    --------
    >>> rigs = (RigBands("dome", "Nikon 5100 (NPL)", "LED-B3"),)
    >>> seen = np.log([[0.37, 0.27, 0.22], [0.35, 0.24, 0.19]])
    >>> found = estimate_person(rigs, Regions(seen, np.tile(1e-4 * np.eye(3), (2, 1, 1))),
    ...                         1e-4 * np.eye(3))
    >>> found.regions.shape, found.covariance.shape
    ((2, 2), (11, 11))
    """
    size = 3 * len(rigs)
    count = len(regions.values)
    if regions.values.shape != (count, size) or regions.covariance.shape != (count, size, size):
        raise FusionError(
            f"regions: got {regions.values.shape} and {regions.covariance.shape}, expected "
            f"(K, {size}) and (K, {size}, {size})"
        )
    variances = np.einsum("kss->ks", regions.covariance)
    if not (variances < UNKNOWN_VARIANCE).any():
        raise FusionError("regions: got no known signal, expected one or more")
    weight = np.asarray(np.linalg.inv(regions.covariance), np.float64)
    seen = np.where(variances < UNKNOWN_VARIANCE, regions.values, 0.0)
    scale = np.where(np.isin(np.arange(N_PROPERTIES), known), 1e-6, 1.0)
    prior = np.zeros((size + 8, size + 8))
    prior[:6, :6] = np.diag(scale**-2.0)
    prior[6:-2, 6:-2] = np.linalg.inv(offset_covariance)
    prior[-2:, -2:] = np.diag(np.array(POPULATION_LOG_SD) ** -2.0)
    if start is None:
        common = np.concatenate([np.zeros(6 + size), POPULATION_MEAN])
        spread = np.diag(np.square(START_SPREAD))
        x = np.tile(POPULATION_MEAN, (count, 1))
    else:
        common = np.concatenate([start.properties_sd, start.offset, start.mean])
        spread, x = start.spread, start.regions.copy()
    usual = np.concatenate([np.zeros(6 + size), POPULATION_MEAN])
    for _ in range(PERSON_ITERATIONS):
        step = _normal_equations(rigs, x, common, spread, seen, weight)
        by_common = step.common + prior
        gradient = step.gradient - prior @ (common - usual)
        change = np.linalg.solve(by_common, gradient)
        change *= min(1.0, 1.5 / max(float(np.abs(change[:6]).max()), 1e-9))
        moved = step.own_change(change)
        x = clip_to_range(x + np.clip(moved, -1.0, 1.0))
        common = common + change
        common[:6] = np.clip(common[:6], -MAX_PROPERTY_SD, MAX_PROPERTY_SD)
        covariance = np.asarray(np.linalg.inv(by_common), np.float64)
        spread = _spread(x - common[-2:], step, covariance)
    evidence = _log_evidence(rigs, x, common, usual, prior, spread, seen, weight)
    return PersonSkin(
        tuple(rigs), common[:6], common[6:-2], common[-2:], covariance, spread, x, evidence
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """Normal equations after elimination of the regions."""

    common: Float64Array
    """(P, P)."""
    gradient: Float64Array
    """(P,)."""
    own_inverse: Float64Array
    """(K, 2, 2)."""
    cross: Float64Array
    """(K, 2, P)."""
    own_gradient: Float64Array
    """(K, 2)."""

    def own_change(self, change: Float64Array) -> Float64Array:
        """Return the change of the regions for a change of the common unknowns."""
        rest = self.own_gradient - self.cross @ change
        return np.einsum("kij,kj->ki", self.own_inverse, rest)


def _normal_equations(
    rigs: Sequence[RigBands],
    x: Float64Array,
    common: Float64Array,
    spread: Float64Array,
    seen: Float64Array,
    weight: Float64Array,
) -> _Step:
    count, size = seen.shape
    values, slopes, by_property = evaluate_signals(rigs, x, common[:6])
    rest = seen - values - common[6:-2]
    by_common = np.concatenate(
        [by_property, np.broadcast_to(np.eye(size), (count, size, size))], axis=-1
    )
    tight = np.linalg.inv(spread)
    slopes_w = np.einsum("ksa,kst->kat", slopes, weight)
    own = slopes_w @ slopes + tight
    cross = np.zeros((count, 2, size + 8))
    cross[..., :-2] = slopes_w @ by_common
    cross[..., -2:] = -tight
    off = x - common[-2:]
    own_gradient = np.einsum("kas,ks->ka", slopes_w, rest) - off @ tight
    common_w = np.einsum("ksp,kst->kpt", by_common, weight)
    whole = np.zeros((size + 8, size + 8))
    whole[:-2, :-2] = (common_w @ by_common).sum(axis=0)
    whole[-2:, -2:] = count * tight
    gradient = np.zeros(size + 8)
    gradient[:-2] = np.einsum("kps,ks->p", common_w, rest)
    gradient[-2:] = (off @ tight).sum(axis=0)
    inverse = np.linalg.inv(own)
    carried = np.einsum("kap,kab->kpb", cross, inverse)
    whole -= (carried @ cross).sum(axis=0)
    gradient -= np.einsum("kpb,kb->p", carried, own_gradient)
    return _Step(whole, gradient, inverse, cross, own_gradient)


def _spread(off: Float64Array, step: _Step, covariance: Float64Array) -> Float64Array:
    """Return the covariance of the regions about their mean: one step of expectation maximization.

    A region's posterior covariance also has the part by the common unknowns.
    """
    moved = -step.own_inverse @ step.cross
    moved[..., -2:] -= np.eye(2)
    left = step.own_inverse + moved @ covariance @ np.swapaxes(moved, -1, -2)
    total = np.einsum("ka,kb->ab", off, off) + left.sum(axis=0)
    total += SPREAD_WEIGHT * np.diag(np.square(START_SPREAD))
    found = total / (len(off) + SPREAD_WEIGHT)
    return np.asarray(found + MIN_SPREAD**2 * np.eye(2))


def _log_evidence(
    rigs: Sequence[RigBands],
    x: Float64Array,
    common: Float64Array,
    usual: Float64Array,
    prior: Float64Array,
    spread: Float64Array,
    seen: Float64Array,
    weight: Float64Array,
) -> float:
    """Return the log marginal likelihood by Laplace's approximation, up to a constant."""
    values = evaluate_signals(rigs, x, common[:6])[0]
    rest = seen - values - common[6:-2]
    off = x - common[-2:]
    tight = np.linalg.inv(spread)
    cost = np.einsum("ks,kst,kt->", rest, weight, rest) + np.einsum("ka,ab,kb->", off, tight, off)
    away = common - usual
    cost += away @ prior @ away
    step = _normal_equations(rigs, x, common, spread, seen, weight)
    curved = np.linalg.slogdet(step.common + prior)[1]
    curved -= np.linalg.slogdet(step.own_inverse)[1].sum()
    known = np.linalg.slogdet(prior)[1] + len(x) * np.linalg.slogdet(tight)[1]
    return float(-0.5 * (cost + curved - known))
