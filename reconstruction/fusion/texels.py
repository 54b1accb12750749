"""Estimate melanin, blood and reflectance of each texel from the colors of several rigs.

The person's common properties, offsets and distribution of melanin and blood are given
(`reconstruction.fusion.person`). Each texel then has two unknowns and a closed 2 x 2 system per
Gauss-Newton step. Errors of the common unknowns move all texels together; they enter the standard
errors through the derivatives of a texel's estimate by them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from model import spectra
from model.tissue_optics.band_signals import NUISANCE_SD
from model.tissue_optics.constants import OPTICAL_DEPTH_NM, SKIN_CONSTANTS
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.signals import (
    LOG_RANGE,
    N_PROPERTIES,
    PROPERTY_NAMES,
    FusionError,
    clip_to_range,
    skin_of_person,
)

BLOCK_TEXELS: Final = 1 << 15
"""Texels computed at a time; memory is that of about 2 KB per texel of a block."""
TEXEL_ITERATIONS: Final = 5
"""Gauss-Newton steps of a texel."""
TAIL_DEGREES: Final = 6.0
"""Degrees of freedom of the t distribution of a rig's errors at a texel, as its tails are heavy."""
OWN_SKIN_CHI2: Final = 2.0
"""Chi-squared of a rig's residual at a texel above which part of it is the place's own skin.

The part grows with chi-squared as in the estimate of James and Stein 1961, which starts at 1. Lower
values keep nevi and more noise, see docs/validation/fusion.md."""
MAX_STEP: Final = 1.0
"""Longest step in log melanin and log blood."""
RANGE_MARGIN: Final = 0.02
"""Texels nearer to the end of `LOG_RANGE` are not valid, in log units."""
MAX_LOG_STDERR: Final = 1.0
"""Standard error of log melanin or log blood above which it counts as not determined."""


@dataclass(frozen=True, slots=True, eq=False)
class RigColors:
    """Colors of texels by one rig.

    Attributes
    ----------
    rig
        Number of the rig in the person's table.
    log_rgb
        (N, 3): logarithm of the diffuse reflectance at normal incidence, white-balanced.
    covariance
        (N, 3, 3): covariance of errors that texels do not share.
    valid
        (N,) bool.
    brightness_variance
        Variance of the unknown log light on a place, common to the channels; 0 for a known light.
    unresolved
        Fraction of the texels' variances by detail of the skin finer than the rig's pixels. No
        other rig's color of the texel removes it from the estimated signal.
    """

    rig: int
    log_rgb: Float64Array
    covariance: Float64Array
    valid: BoolArray
    brightness_variance: float = 0.0
    unresolved: float = 0.0

    def part(self, chosen: slice | BoolArray) -> "RigColors":
        """Return the colors of some texels.

        Parameters
        ----------
        chosen
            Texels.
        """
        parts = self.log_rgb[chosen], self.covariance[chosen], self.valid[chosen]
        return RigColors(self.rig, *parts, self.brightness_variance, self.unresolved)

    def without_covariance(self) -> "RigColors":
        """Return the same colors, whose channels' errors count as independent."""
        own = np.einsum("ncc->nc", self.covariance) + self.brightness_variance
        independent = own[..., None] * np.eye(3)
        return RigColors(
            self.rig, self.log_rgb, independent, self.valid, unresolved=self.unresolved
        )


@dataclass(frozen=True, slots=True, eq=False)
class TexelSkin:
    """Estimates of N texels; undefined where not valid.

    Attributes
    ----------
    log_skin
        (N, 2): log melanin optical depth at 550 nm and log blood volume fraction.
    covariance
        (N, 2, 2): their covariance by errors of the texel alone.
    common
        (N, 2, 2): their covariance by the common unknowns, which move all texels together.
    log_melanin_variance
        (N,): variance of log melanin volume fraction by all errors; it differs from that of the
        optical depth by the kind of melanin.
    log_signals
        (N, S): estimated log signals of all rigs without their calibration errors.
    signal_variance, signal_common
        (N, S): their variances by errors of the texel and by the common unknowns.
    misfit
        (N,): chi-squared of the colors over its degrees of freedom; 0 without any.
    valid
        (N,) bool: both unknowns are determined.
    """

    log_skin: Float64Array
    covariance: Float64Array
    common: Float64Array
    log_melanin_variance: Float64Array
    log_signals: Float64Array
    signal_variance: Float64Array
    signal_common: Float64Array
    misfit: Float64Array
    valid: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class OffsetModel:
    """Covariances of the signals' errors.

    Attributes
    ----------
    unexplained
        (S, S): of what the model leaves unexplained of the person's skin.
    calibration
        (S, S): of the rigs' calibrations.
    local
        (S, S): of what the model leaves unexplained and differs between places of a face.
    """

    unexplained: Float64Array
    calibration: Float64Array
    local: Float64Array

    @property
    def offset_covariance(self) -> Float64Array:
        """Prior covariance of a person's offsets."""
        return self.unexplained + self.calibration

    def without_covariance(self) -> "OffsetModel":
        """Return the same variances, without covariances."""
        parts = self.unexplained, self.calibration, self.local
        return OffsetModel(*(np.diag(np.diag(part)) for part in parts))


def estimate_texels(
    person: PersonSkin,
    colors: Sequence[RigColors],
    errors: OffsetModel,
    *,
    iterations: int = TEXEL_ITERATIONS,
) -> Iterator[tuple[slice, TexelSkin]]:
    """Estimate melanin and blood of texels, block by block.

    Parameters
    ----------
    person
        What the person's skin has in common.
    colors
        Colors by one or more rigs, of the same N texels.
    errors
        Covariances of the signals' errors.
    iterations
        Gauss-Newton steps, at least 1.

    Yields
    ------
    slice, TexelSkin
        Texels of a block and their estimates. A texel without a valid color is not valid.

    Raises
    ------
    FusionError
        Without a color, or if rigs have different numbers of texels.
    """
    if not colors:
        raise FusionError("colors: got none, expected those of one rig or more")
    count = len(colors[0].valid)
    if iterations < 1:
        raise FusionError(f"iterations: got {iterations}, expected at least 1")
    if any(len(one.valid) != count for one in colors):
        raise FusionError("colors: got different numbers of texels, expected one number")
    for start in range(0, count, BLOCK_TEXELS):
        block = slice(start, min(start + BLOCK_TEXELS, count))
        yield block, _solve(person, [one.part(block) for one in colors], errors, iterations)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Estimates of a block's texels, and what they rest on."""

    x: Float64Array
    """(N, 2)."""
    hessian: Float64Array
    """(N, 2, 2)."""
    seen: list[Float64Array]
    """Colors by rig without the person's offsets, (N, 3)."""
    weights: list[Float64Array]
    """Inverse covariances by rig, lowered at outliers, (N, 3, 3)."""
    stated: list[Float64Array]
    """Inverse covariances by rig, as stated."""


def _iterate(
    person: PersonSkin, colors: Sequence[RigColors], errors: OffsetModel, iterations: int
) -> _Solution:
    """Take Gauss-Newton steps, with weights that follow a t distribution."""
    table = person.table
    count = len(colors[0].valid)
    by_noise, seen = [], []
    for one in colors:
        at = table.columns(one.rig)
        usable = one.valid & np.isfinite(one.log_rgb).all(axis=-1)
        held = np.where(usable[:, None, None], one.covariance, np.eye(3)) + errors.local[at, at]
        inverse = np.linalg.inv(held + one.brightness_variance)
        by_noise.append(np.where(usable[:, None, None], inverse, 0.0))
        seen.append(np.where(usable[:, None], one.log_rgb, 0.0) - person.offset[at])
    tight = np.linalg.inv(person.spread)
    x = np.tile(person.mean, (count, 1))
    for _ in range(iterations):
        values, slopes = table.evaluate(x)
        hessian = np.tile(tight, (count, 1, 1))
        gradient = -(x - person.mean) @ tight
        weights = []
        for one, full, y in zip(colors, by_noise, seen, strict=True):
            at = table.columns(one.rig)
            off = y - values[:, at]
            far = np.einsum("nc,ncd,nd->n", off, full, off)
            weight = full * ((TAIL_DEGREES + 3.0) / (TAIL_DEGREES + far))[:, None, None]
            weights.append(weight)
            scaled = np.swapaxes(slopes[:, at], -1, -2) @ weight
            hessian += scaled @ slopes[:, at]
            gradient += np.einsum("nac,nc->na", scaled, off)
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        x = clip_to_range(x + np.clip(step, -MAX_STEP, MAX_STEP))
    return _Solution(x, hessian, seen, weights, by_noise)


def _solve(
    person: PersonSkin, colors: Sequence[RigColors], errors: OffsetModel, iterations: int
) -> TexelSkin:
    """Estimate the texels of a block with their errors."""
    table = person.table
    count = len(colors[0].valid)
    solved = _iterate(person, colors, errors, iterations)
    x, hessian, seen, weights = solved.x, solved.hessian, solved.seen, solved.weights
    tight = np.linalg.inv(person.spread)
    values, slopes = table.evaluate(x)
    covariance = np.asarray(np.linalg.inv(hessian), np.float64)
    by_property = table.evaluate_properties(x)
    # a texel's estimate by the common unknowns: properties, offsets, mean
    by_common = np.zeros((count, 2, len(person.covariance)))
    by_common[..., -2:] = covariance @ tight
    chi2, known = np.zeros(count), np.zeros(count)
    for one, weight, full, y in zip(colors, weights, solved.stated, seen, strict=True):
        at = table.columns(one.rig)
        scaled = covariance @ np.swapaxes(slopes[:, at], -1, -2) @ weight
        by_common[..., :N_PROPERTIES] -= scaled @ by_property[:, at]
        by_common[..., N_PROPERTIES + at.start : N_PROPERTIES + at.stop] -= scaled
        off = y - values[:, at]
        chi2 += np.einsum("nc,ncd,nd->n", off, full, off)
        known += 3.0 * (weight[:, 0, 0] > 0.0)
    spread = by_common @ person.covariance @ np.swapaxes(by_common, -1, -2)
    kind = by_common[:, 0].copy()
    kind[:, PROPERTY_NAMES.index("eumelanin_fraction")] -= eumelanin_slope()
    melanin = covariance[:, 0, 0] + np.einsum("np,pq,nq->n", kind, person.covariance, kind)
    low, high = np.array(LOG_RANGE).T
    inside = ((x > low + RANGE_MARGIN) & (x < high - RANGE_MARGIN)).all(axis=-1)
    both = np.einsum("naa->na", covariance + spread)
    inside &= (known > 0) & (both < MAX_LOG_STDERR**2).all(axis=-1)
    estimate, own, common = _estimate_signals(person, colors, errors, solved, by_common)
    return TexelSkin(
        x,
        covariance,
        spread,
        melanin,
        estimate,
        own,
        common,
        np.where(known > 2, chi2 / np.maximum(known - 2, 1), 0.0),
        inside,
    )


def _estimate_signals(
    person: PersonSkin,
    colors: Sequence[RigColors],
    errors: OffsetModel,
    solved: _Solution,
    by_common: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the signals of the skin, and their own and common variances, (N, S) each.

    A signal is that of the model, of its unexplained part, and of the place's own skin.
    """
    table = person.table
    values, slopes = table.evaluate(solved.x)
    by_property = table.evaluate_properties(solved.x)
    covariance = np.linalg.inv(solved.hessian)
    count, size = values.shape
    # what a signal's residual states of the place's own skin
    gains = np.zeros((count, size, size))
    own_variance = np.tile(errors.local, (count, 1, 1))
    kept = errors.unexplained @ np.linalg.inv(errors.offset_covariance)
    estimate = values + kept @ person.offset
    for one, full, y in zip(colors, solved.stated, solved.seen, strict=True):
        at = table.columns(one.rig)
        local = errors.local[at, at]
        off = y - values[:, at]
        far = np.einsum("nc,ncd,nd->n", off, full, off)
        # skin unlike the face's, such as a nevus, keeps its measured color
        left = np.minimum(1.0, OWN_SKIN_CHI2 / np.maximum(far, 1e-9))[:, None, None]
        gains[:, at, at] = np.eye(3) - left * (np.eye(3) - local @ full)
        estimate[:, at] += np.einsum("ncd,nd->nc", gains[:, at, at], off)
        noise = one.covariance + one.brightness_variance
        own_variance[:, at, at] = np.where(full[:, :1, :1] > 0.0, gains[:, at, at] @ noise, local)
    whole = np.eye(size) - gains
    moved = slopes @ by_common
    moved[..., :N_PROPERTIES] += by_property
    moved = whole @ moved
    moved[..., person.offset_columns] += kept - gains
    slopes_left = whole @ slopes
    own = np.einsum("nsa,nab,nsb->ns", slopes_left, covariance, slopes_left)
    own += np.einsum("nss->ns", own_variance)
    for one in colors:
        detail = np.einsum("ncc->nc", one.covariance) * one.valid[:, None]
        own[:, table.columns(one.rig)] += one.unresolved * detail
    left = np.diag(errors.unexplained - kept @ errors.unexplained)
    common = np.einsum("nsp,pq,nsq->ns", moved, person.covariance, moved) + left
    return estimate, own, common


def eumelanin_slope() -> float:
    """Return the derivative of log absorption of melanin at 550 nm by its kind.

    It is per standard deviation of the fraction of eumelanin. An optical depth over this absorption
    and the thickness is a volume fraction.

    Examples
    --------
    >>> round(eumelanin_slope(), 3)
    0.084
    """
    eumelanin, pheomelanin = (
        float(kind(OPTICAL_DEPTH_NM))
        for kind in (spectra.eumelanin_absorption, spectra.pheomelanin_absorption)
    )
    sd = float(NUISANCE_SD[PROPERTY_NAMES.index("eumelanin_fraction")])
    mixed = SKIN_CONSTANTS.eumelanin_fraction * (eumelanin - pheomelanin) + pheomelanin
    return sd * (eumelanin - pheomelanin) / mixed


def melanin_depth_factor(properties_sd: Float64Array) -> float:
    """Return optical depth over volume fraction of melanin for a person's kind of melanin.

    The thickness of the epidermis is that of `SKIN_CONSTANTS`, as in all maps of melanin.

    Parameters
    ----------
    properties_sd
        (6,): see `reconstruction.fusion.signals.skin_of_person`.

    Examples
    --------
    >>> bool(np.isclose(melanin_depth_factor(np.zeros(6)), SKIN_CONSTANTS.melanin_depth_factor))
    True
    """
    fraction = float(skin_of_person(np.zeros(2), properties_sd)[-1])
    kinds = [
        float(kind(OPTICAL_DEPTH_NM))
        for kind in (spectra.eumelanin_absorption, spectra.pheomelanin_absorption)
    ]
    return SKIN_CONSTANTS.epidermis_mm * (fraction * kinds[0] + (1.0 - fraction) * kinds[1])
