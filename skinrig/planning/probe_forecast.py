"""Forecast of sigma_tr from a series of exposures of the fiber probe.

The forecast uses the inversion itself: Fisher information by the derivatives of the photon table,
the misfit of layers, and the certificate of the phantom, which no exposure removes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.calibration.fiber.crosstalk import CrossTalk
from capture.calibration.fiber.probe_calibration import FiberReflectance
from capture.plan.probe import exposure_series_s
from capture.plan.suction import HeadPlacement
from reconstruction.pipeline.probe.images import Measurement
from reconstruction.pipeline.probe.profile_fits import MeasuredProfile, fit_profiles
from reconstruction.subsurface import translucency
from reconstruction.subsurface.probe_sites import SITE_UV
from skinrig.arrays import BoolArray, Float64Array
from skinrig.planning.plans import median_magnitude
from skinrig.planning.probe_observation import ProbeObservation, reading_variance

CROSSTALK_ERROR = (0.0, 8.5e-6, 6.3e-6, 9.3e-7, 2.5e-7)
"""Standard error of the share of a fiber's light in a spot so many places away, the last of all
farther ones: medians of twenty simulated calibrations of the shipped rig, seeds 0 to 19."""
FORECAST_RELATIVE_SD = 0.2
"""Relative deviation of standard errors that sessions state from those that were forecast: those
of three sessions were 0.7 to 1.5 times as large, about two of it either way."""
INTERVAL_DRAWS = 40_000
"""Of calibrations and readings, for the interval of a median."""
MAP_PX = 32


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """Settings of a plan that determine sigma_tr."""

    sites: tuple[str, ...]
    exposures_s: tuple[float, ...]
    repeats: int
    darks: int
    """Frames without light of each exposure time that has some."""
    level: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ProbePrediction:
    """Relative errors of sigma_tr by site and color."""

    sites: tuple[str, ...]
    sigma: Float64Array
    """(S, 3) standard error: readings, misfit, certificate; of sites that are not measured what
    the others and people in general leave open. What a fit without noise is off on this skin is
    one sample of the misfit that this states, and not counted again."""
    shared: Float64Array
    """(T, S, 3) the calibration's part, certificate and far cross-talk: what each of its errors
    does to all sites and colors together, which no median averages out."""
    misfit: Float64Array
    """(S, 3) what stays without any noise."""
    valid: BoolArray
    """(S, 3)."""
    measured: BoolArray
    """(S,)."""

    @property
    def total(self) -> Float64Array:
        """Standard deviation of the error of what is measured and valid."""
        return np.asarray(self.sigma[self.valid & self.measured[:, None]])

    @property
    def median(self) -> float:
        """Predicted median relative error over measured sites and colors."""
        return median_magnitude(self.total)

    @property
    def common(self) -> Float64Array:
        """Standard error of the calibration's part, (S, 3)."""
        return np.asarray(np.sqrt(np.square(self.shared).sum(axis=0)))

    def interval(self) -> tuple[float, float]:
        """Return the interval that holds 68 % of the medians of a session's errors.

        Errors that all fits share move the median as a whole: nine fits of one calibration are
        hardly more than one.
        """
        good = self.valid & self.measured[:, None]
        if not good.any():
            return math.inf, math.inf
        shared = self.shared[:, good]
        own = np.sqrt(np.maximum(self.sigma[good] ** 2 - np.square(shared).sum(axis=0), 0.0))
        rng = np.random.default_rng(0)
        off = rng.standard_normal((INTERVAL_DRAWS, len(shared))) @ shared
        off += own * rng.standard_normal((INTERVAL_DRAWS, own.size))
        ends = np.quantile(np.median(np.abs(off), axis=1), (0.16, 0.84))
        # that, and how well a session's standard errors are known beforehand, as logarithms
        low, high = np.hypot(np.log(ends / self.median), math.log(1.0 + FORECAST_RELATIVE_SD))
        return self.median * math.exp(-low), self.median * math.exp(high)

    @property
    def valid_share(self) -> float:
        """Share of the fits at measured sites that will be valid."""
        return float(self.valid[self.measured].mean()) if self.measured.any() else 0.0


Memory = dict[tuple[Any, ...], Sequence[Any]]
"""Cache of fits of one `ProbeObservation`, keyed by all that they depend on: plans that differ in
placements only share them, and without noise nearly all plans do."""


def predict(
    observation: ProbeObservation, setting: ProbeSettings, *, memory: Memory | None = None
) -> ProbePrediction:
    """Return the errors that a plan leaves.

    Placements lower what the readings' noise leaves, and neither the misfit of layers nor what the
    calibration leaves open.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting
        Sites, exposures, placements and darks.
    memory
        Fits of earlier plans of the same sight, which is added to; None: none are kept.
    """
    memory = {} if memory is None else memory
    shape = (len(observation.sites), 3)
    sigma, shared = np.full(shape, np.inf), np.zeros((0, *shape))
    still, found = np.full(shape, np.inf), np.ones(shape)
    valid = np.zeros(shape, np.bool_)
    measured = np.zeros(len(observation.sites), np.bool_)
    places = [k for k, site in enumerate(observation.sites) if site in setting.sites]
    with_noise, without = (
        _fits(observation, setting, places, noise=noise, memory=memory) for noise in (True, False)
    )
    for k, fit, quiet in zip(places, with_noise, without, strict=True):
        measured[k] = True
        valid[k] = fit.fit.valid
        found[k] = fit.fit.sigma_tr_per_mm
        if not len(shared):
            shared = np.zeros((len(fit.log_common), *shape))
        shared[:, k] = fit.log_common
        common = np.sqrt(np.square(fit.log_common).sum(axis=0))
        stays = np.minimum(quiet.log_stderr, fit.log_stderr)
        noise = np.where(np.isfinite(stays), fit.log_stderr**2, np.inf) / setting.repeats
        noise -= np.where(np.isfinite(stays), stays**2, 0.0) / setting.repeats
        still[k] = np.hypot(stays, common)
        sigma[k] = np.sqrt(still[k] ** 2 + noise)
    rest = _interpolation_error(observation, found, sigma, valid & measured[:, None])
    sigma[~measured] = rest[~measured]
    return ProbePrediction(observation.sites, sigma, shared, still, valid, measured)


def _fits(
    observation: ProbeObservation,
    setting: ProbeSettings,
    sites: Sequence[int],
    *,
    noise: bool,
    memory: Memory,
) -> Sequence[Any]:
    """Return the fits of each site's profile as a plan would read it, or without its noise."""
    how = (setting.exposures_s, setting.darks, setting.level)
    read = [reading_variance(observation, observation.reflectance[k], *how) for k in sites]
    # a noise-free fit depends on the readings' noise only by which fibers are read at all
    weights = np.array(read) if noise else np.isfinite(read)
    count = len(setting.exposures_s)
    key = (noise, tuple(sites), count, weights.tobytes())
    if key not in memory:
        memory[key] = _fit_noisy_profiles(observation, read, sites, count, noise=noise)
    return memory[key]


def _fit_noisy_profiles(
    observation: ProbeObservation,
    read: Sequence[Float64Array],
    sites: Sequence[int],
    exposures: int,
    *,
    noise: bool,
) -> Sequence[Any]:
    """Return the fits of profiles with these variances of their readings."""
    names = tuple(fiber.name for fiber in observation.probe.fibers)
    radius = np.array(observation.probe.radius_mm)
    # gains are known from a series of all exposures on the phantom, as far as its light is known
    gain = (
        reading_variance(observation, observation.phantom, exposure_series_s(), 4, 1.0)
        / observation.phantom**2
    )
    gain += observation.phantom_error**2
    mixed = _crosstalk(len(radius))
    profiles = []
    for k, own in zip(sites, read, strict=True):
        value = observation.reflectance[k]
        valid = np.isfinite(own)
        variance = np.where(valid, own, 0.0) if noise else np.zeros_like(own)
        optics = (value, observation.phantom, value / observation.phantom)
        doubt, shared = mixed.matrix_variance(*optics), mixed.shared_changes(*optics)
        common = np.concatenate([value * observation.common, shared])
        variance += gain * value**2 + doubt
        reflectance = FiberReflectance(names, radius, value, variance, common, valid, ~valid)
        head = Measurement(
            HeadPlacement(observation.sites[k], 0.0, 0), exposures, 1.0, math.nan, 5.0
        )
        profiles.append(MeasuredProfile(head, reflectance))
    return fit_profiles(profiles, observation.probe) if profiles else []


def _crosstalk(count: int) -> Any:
    """Return cross-talk of none, known as well as a calibration leaves it.

    The nearest fibers are brighter than the farthest by a million times on skin and by a thousand
    on the phantom; what a calibration has wrong of their light in far spots cancels only as far as
    the two are alike.
    """
    place = np.arange(count)
    apart = np.minimum(np.abs(place[:, None] - place), len(CROSSTALK_ERROR) - 1)
    nothing = np.zeros((count, 3))
    error = np.array(CROSSTALK_ERROR)[apart]
    return CrossTalk(np.eye(count), error, nothing, nothing, nothing, True)


def _interpolation_error(
    observation: ProbeObservation, found: Float64Array, sigma: Float64Array, valid: BoolArray
) -> Float64Array:
    """Return the relative error of sigma_tr at each site by the map between the others, (S, 3)."""
    known = [k for k, site in enumerate(observation.sites) if site in SITE_UV]
    measured = [k for k in known if valid[k].any()]
    out = np.full(found.shape, np.inf)
    if not measured:
        return out
    made = translucency.interpolate(
        [SITE_UV[observation.sites[k]] for k in measured],
        np.where(valid[measured], found[measured], 1.0),
        np.where(valid[measured], sigma[measured] * found[measured], np.inf),
        (MAP_PX, MAP_PX),
        valid=valid[measured],
    )
    for k in known:
        u, v = SITE_UV[observation.sites[k]]
        at = min(int((1.0 - v) * MAP_PX), MAP_PX - 1), min(int(u * MAP_PX), MAP_PX - 1)
        out[k] = np.where(made.valid[at], made.log_stderr[at], np.inf)
    return out
