"""Fit optical coefficients to the profiles of a fiber probe, per site."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.calibration.fiber.probe_calibration import FiberReflectance
from capture.rig import Probe
from reconstruction import subsurface
from reconstruction.anisotropy.direction_harmonics import MIN_DIRECTIONS
from reconstruction.arrays import BoolArray, Float64Array, Int64Array
from reconstruction.pipeline.probe.images import Measurement
from reconstruction.subsurface import FitOutcome, SubsurfaceFit
from reconstruction.subsurface import nearest as nearest_medium

METHOD_NAMES = ("photon_table", "diffusion", "dipole")
"""The first is the recommended one; the others serve for comparison."""

MAX_HOMOGENEOUS_MISFIT = 0.03
"""Relative misfit above which a bent profile is attributed to layered tissue. Errors of single
fibers, such as dirt, do not bend a profile."""


@dataclass(frozen=True, slots=True)
class MeasuredProfile:
    """Profile measured at one placement."""

    measurement: Measurement
    reflectance: FiberReflectance


@dataclass(frozen=True, slots=True)
class ProfileFit:
    """Coefficients of one profile by one method, in every channel.

    Attributes
    ----------
    profile : Profile
    fit : SubsurfaceFit
        Leading axis the channels.
    log_stderr : ndarray, shape (C,)
        Standard error of log sigma_tr by the readings, the single fibers and the model.
    log_common : ndarray, shape (T, C)
        Change of log sigma_tr per standard uncertainty of each error that all fibers and all
        measurements share, namely those of the phantom's certificate.
    log_coefficients : ndarray, shape (2, C)
        Root sum square of such changes of log sigma_a and log sigma_s'.
    """

    profile: MeasuredProfile
    fit: SubsurfaceFit
    log_stderr: Float64Array
    log_common: Float64Array
    log_coefficients: Float64Array

    @property
    def log_total(self) -> Float64Array:
        """Standard error of log sigma_tr, readings and common errors combined, shape (C,)."""
        return np.asarray(np.sqrt(self.log_stderr**2 + (self.log_common**2).sum(axis=0)))


@dataclass(frozen=True, slots=True)
class SiteValue:
    """sigma_tr of a site, averaged over its placements, by the recommended method.

    Attributes
    ----------
    site : str
    measurements : ndarray of int, shape (C,)
        Number of fits in the mean.
    sigma_tr_per_mm, stderr_per_mm : ndarray, shape (C,)
        From the mean of the logarithms; NaN and infinite where no fit is valid.
    """

    site: str
    measurements: Int64Array
    sigma_tr_per_mm: Float64Array
    stderr_per_mm: Float64Array


def fit_profiles(
    profiles: Sequence[MeasuredProfile], probe: Probe, method: Any = METHOD_NAMES[0]
) -> list[ProfileFit]:
    """Fit all profiles and channels; repeat with each common error at its standard uncertainty."""
    first = profiles[0].reflectance
    causes = len(first.common_per_mm2)
    # (1 + T, M, C, F): as measured, then with one standard uncertainty of each cause
    value = np.stack([p.reflectance.reflectance_per_mm2.T for p in profiles])
    common = np.stack([p.reflectance.common_per_mm2.transpose(0, 2, 1) for p in profiles], axis=1)
    every = np.concatenate([value[None], value[None] + common])

    setup: dict[str, Any] = {
        "variance": np.stack([p.reflectance.variance.T for p in profiles]),
        "valid": np.stack([p.reflectance.valid.T for p in profiles]),
        "collection": "fiber",
        "core_mm": probe.fibers[0].core_mm,
        "source_core_mm": probe.source_core_mm,
    }
    fit = subsurface.invert(first.radius_mm, every, method=method, **setup)
    other_g = (fit.outcome[0] & np.uint16(FitOutcome.ASYMMETRY_OUTSIDE_PRIOR)) != 0
    bent = fit.bent[0] & ~other_g
    if np.any(unlike := bent & (fit.model_error[0] > MAX_HOMOGENEOUS_MISFIT)):
        if method == METHOD_NAMES[0]:
            other = subsurface.nearest_medium(first.radius_mm, every, **setup)
        else:
            setup |= {"method": method, "common_error": nearest_medium.LOG_FACTOR_SIGMA}
            other = subsurface.invert(first.radius_mm, every, **setup)
        unlike &= _is_closer(value, setup["variance"], other, fit, unlike)
        unlike = _layered(profiles, unlike, other.scale[0])
        fit = _merge_fits(fit, other, np.broadcast_to(unlike, fit.valid.shape))

    def change_of(coefficient: Float64Array) -> Float64Array:
        logs = np.log(coefficient)
        return np.asarray(np.nan_to_num(logs[1:] - logs[0]))

    change = change_of(fit.sigma_tr_per_mm)
    pair = [change_of(fit.sigma_a_per_mm), change_of(fit.sigma_s_prime_per_mm)]
    shared = np.sqrt(np.square(pair).sum(axis=1))  # (2, M, C)
    log_stderr = fit.sigma_tr_stderr[0] / fit.sigma_tr_per_mm[0]
    found = []
    for number, profile in enumerate(profiles):
        changes = change[:, number].reshape(causes, -1), shared[:, number]
        found.append(
            ProfileFit(profile, _select_fits(fit, (0, number)), log_stderr[number], *changes)
        )
    return found


def _is_closer(
    value: Float64Array,
    variance: Float64Array,
    other: SubsurfaceFit,
    fit: SubsurfaceFit,
    unlike: BoolArray,
) -> BoolArray:
    """Return where another fit is closer to the bright fibers, over the colors in doubt, (M, 1).

    Errors that far fibers share, as of stray light, bend the profile of a homogeneous medium, too.
    A medium up to a factor then follows the far fibers and leaves the bright ones. Layers are a
    property of the tissue, so that the colors decide together.
    """
    bright = fit.used[0] & (value > 0.0) & (variance < (nearest_medium.MAX_LOG_NOISE * value) ** 2)
    bright &= unlike[..., None]
    safe = np.where(bright, value, 1.0)
    weight = np.where(bright, 1.0 / (variance / safe**2 + MAX_HOMOGENEOUS_MISFIT**2), 0.0)

    def misfit(of: SubsurfaceFit) -> Float64Array:
        ratio = np.where(bright, of.predicted_per_mm2[0] / safe, 1.0)
        return np.asarray((weight * np.log(ratio) ** 2).sum(axis=(1, 2)))

    return np.asarray(misfit(other) < misfit(fit))[:, None]


def _layered(
    profiles: Sequence[MeasuredProfile], unlike: BoolArray, factor: Float64Array
) -> BoolArray:
    """Return which profiles are fitted as layered tissue, (M, C), the same for all directions.

    An upper layer attenuates all directions. Tissue with directional scattering also differs from
    every homogeneous medium, but the factors of its directions are on both sides of 1. A factor in
    some directions only would make sigma_tr jump between directions.
    """
    found = np.array(unlike)
    for group in profile_groups(profiles).values():
        if len({profiles[k].measurement.placement.angle_deg for k in group}) >= MIN_DIRECTIONS:
            dims = (factor[group] < 1.0).all(axis=0)
            found[group] = dims & (2 * unlike[group].sum(axis=0) > len(group))
    return found


def profile_groups(profiles: Sequence[MeasuredProfile]) -> dict[tuple[str, int], list[int]]:
    """Return the indices of profiles by site and repeat, over all directions of the head."""
    groups: dict[tuple[str, int], list[int]] = {}
    for number, profile in enumerate(profiles):
        placement = profile.measurement.placement
        groups.setdefault((placement.site, placement.repeat), []).append(number)
    return groups


def _merge_fits(fit: SubsurfaceFit, other: SubsurfaceFit, there: BoolArray) -> SubsurfaceFit:
    """Return one batch's fits, replaced by another's where ``there`` is True."""
    merged = {}
    for name in (field.name for field in dataclasses.fields(fit) if field.name != "method"):
        own = getattr(fit, name)
        mask = there.reshape(there.shape + (1,) * (own.ndim - there.ndim))
        merged[name] = np.where(mask, getattr(other, name), own)
    return dataclasses.replace(fit, **merged)


def _select_fits(fit: SubsurfaceFit, index: tuple[int, ...]) -> SubsurfaceFit:
    """Select fits of a batch by index."""
    names = [field.name for field in dataclasses.fields(fit) if field.name != "method"]
    return dataclasses.replace(fit, **{name: getattr(fit, name)[index] for name in names})


def site_values(fits: Sequence[ProfileFit]) -> list[SiteValue]:
    """Average the placements of each site; common errors are added after the average.

    Contact varies between placements, which single fits do not include. Where the scatter exceeds
    the standard errors, the scatter is used.
    """
    found = []
    for site in dict.fromkeys(fit.profile.measurement.placement.site for fit in fits):
        own = [fit for fit in fits if fit.profile.measurement.placement.site == site]
        valid = np.stack([fit.fit.valid for fit in own])  # (M, C)
        log_tr = np.stack([np.log(fit.fit.sigma_tr_per_mm) for fit in own])
        spread = np.stack([fit.log_stderr for fit in own])
        weight = np.where(valid, 1.0 / np.where(valid, spread, 1.0) ** 2, 0.0)
        total, count = weight.sum(axis=0), valid.sum(axis=0)
        known = count > 0
        mean = (weight * np.where(valid, log_tr, 0.0)).sum(axis=0) / np.where(known, total, 1.0)
        scatter = (weight * np.where(valid, log_tr - mean, 0.0) ** 2).sum(axis=0)
        # inverse-variance mean of the logarithms; its variance 1 / sum(w) is multiplied by the
        # reduced chi-square where that exceeds 1 (Birge ratio)
        inflation = np.maximum(scatter / np.maximum(count - 1, 1), 1.0)
        shared = np.mean([fit.log_common for fit in own], axis=0)
        with np.errstate(divide="ignore"):
            variance = inflation / total + (shared**2).sum(axis=0)
        sigma_tr = np.where(known, np.exp(mean), np.nan)
        found.append(
            SiteValue(site, count, sigma_tr, np.where(known, sigma_tr * np.sqrt(variance), np.inf))
        )
    return found
