"""Forecast of sigma_tr from a series of exposures of the fiber probe.

The forecast uses the inversion itself: Fisher information from the derivatives of the photon table,
the misfit of layered skin to a homogeneous medium, and the phantom's certificate. The last two do
not decrease with exposure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capture.calibration.fiber.crosstalk import DISTANCE_EDGES, CrossTalk
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

CROSSTALK_ERROR = (8.6e-6, 6.3e-6, 1.03e-6, 7.6e-7, 3.6e-7, 2.2e-7, 2.9e-7, 6.0e-7)
"""Standard uncertainty of cross-talk by group of distances, see
`capture.calibration.fiber.crosstalk.DISTANCE_EDGES`.

Cross-talk is the fraction of a fiber's light in another spot. Medians of two simulated
calibrations of the shipped rig, seeds 9200 and 9201.
"""
STRAY_LIGHT_ERROR_PER_MM2 = (1.6e-9, 9.7e-10, 1.8e-9)
"""Standard uncertainty of stray light, common to all fibers, as reflectance, red, green and blue.

Medians of the same calibrations.
"""
FORECAST_RELATIVE_SD = 0.2
"""Relative standard deviation of a session's reported from its forecast uncertainties.

Those of three sessions were 0.7 to 1.5 times as large, about two standard deviations either way.
"""
INTERVAL_DRAWS = 40_000
"""Random draws of calibrations and readings for the interval of a median."""
MAP_PX = 32


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """Settings of a plan that determine sigma_tr."""

    sites: tuple[str, ...]
    exposures_s: tuple[float, ...]
    repeats: int
    darks: int
    """Dark frames per exposure time that has any."""
    level: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ProbePrediction:
    """Predicted relative errors of sigma_tr for S sites and 3 colors."""

    sites: tuple[str, ...]
    sigma: Float64Array
    """(S, 3) standard uncertainty by readings, misfit and certificate.

    At sites without a measurement: that of the prediction from the other sites and the population.
    """
    bias: Float64Array
    """(S, 3) relative error of the fit to this skin without noise, 0 where it is unknown."""
    shared: Float64Array
    """(T, S, 3) errors by the calibration: effect of each of T error sources (certificate, far
    cross-talk) on all sites and colors. They are correlated, so that a median does not average
    them out."""
    misfit: Float64Array
    """(S, 3) relative error without noise."""
    valid: BoolArray
    """(S, 3) valid fits."""
    measured: BoolArray
    """(S,) sites that the plan measures."""

    @property
    def total(self) -> Float64Array:
        """Standard deviation of the errors of measured, valid fits."""
        return np.asarray(self.sigma[self.valid & self.measured[:, None]])

    @property
    def median(self) -> float:
        """Predicted median relative error over measured sites and colors."""
        return median_magnitude(self.total, self.bias[self.valid & self.measured[:, None]])

    @property
    def common(self) -> Float64Array:
        """Standard uncertainty by the calibration, (S, 3)."""
        return np.asarray(np.sqrt(np.square(self.shared).sum(axis=0)))

    def interval(self) -> tuple[float, float]:
        """Return the 68 % interval of the median error of a session.

        Errors by the calibration are common to all fits and shift the median as a whole: nine fits
        of one calibration have hardly more information than one.
        """
        good = self.valid & self.measured[:, None]
        if not good.any():
            return math.inf, math.inf
        shared = self.shared[:, good]
        own = np.sqrt(np.maximum(self.sigma[good] ** 2 - np.square(shared).sum(axis=0), 0.0))
        rng = np.random.default_rng(0)
        off = rng.standard_normal((INTERVAL_DRAWS, len(shared))) @ shared
        off += self.bias[good] + own * rng.standard_normal((INTERVAL_DRAWS, own.size))
        ends = np.quantile(np.median(np.abs(off), axis=1), (0.16, 0.84))
        # combined in logarithms with the relative deviation of a session's stated uncertainties
        low, high = np.hypot(np.log(ends / self.median), math.log(1.0 + FORECAST_RELATIVE_SD))
        return self.median * math.exp(-low), self.median * math.exp(high)

    @property
    def valid_share(self) -> float:
        """Fraction of the fits at measured sites that are valid."""
        return float(self.valid[self.measured].mean()) if self.measured.any() else 0.0


Memory = dict[tuple[Any, ...], Sequence[Any]]
"""Cache of fits of one `ProbeObservation`, keyed by everything that they depend on.

Plans that differ only in placements share fits; without noise, nearly all plans do.
"""


def predict(
    observation: ProbeObservation, setting: ProbeSettings, *, memory: Memory | None = None
) -> ProbePrediction:
    """Predict the errors of sigma_tr of a plan.

    Repeated placements reduce the noise of the readings, but neither the misfit of layers nor the
    errors by the calibration.

    Parameters
    ----------
    observation
        See `simulate_observation`.
    setting
        Sites, exposures, placements and dark frames.
    memory
        Cache of fits of earlier plans of the same observation, extended in place; None: no cache.
    """
    memory = {} if memory is None else memory
    shape = (len(observation.sites), 3)
    sigma, shared = np.full(shape, np.inf), np.zeros((0, *shape))
    still, found, bias = np.full(shape, np.inf), np.ones(shape), np.zeros(shape)
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
        bias[k] = np.nan_to_num(found[k] / observation.sigma_tr[k] - 1.0)
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
    return ProbePrediction(observation.sites, sigma, bias, shared, still, valid, measured)


def _fits(
    observation: ProbeObservation,
    setting: ProbeSettings,
    sites: Sequence[int],
    *,
    noise: bool,
    memory: Memory,
) -> Sequence[Any]:
    """Fit the profile of each site, with the weights of the plan's noise or without noise."""
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
    """Fit profiles whose readings have the given variances."""
    names = tuple(fiber.name for fiber in observation.probe.fibers)
    radius = np.array(observation.probe.radius_mm)
    # gains come from a full exposure series on the phantom, up to the error of its reflectance
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
        ratio = value / observation.phantom
        optics = (value, observation.phantom, ratio)
        doubt, shared = mixed.matrix_variance(*optics), mixed.shared_changes(*optics)
        # the phantom's light has the same error of stray light, which cancels in part
        stray = -np.array(STRAY_LIGHT_ERROR_PER_MM2) * (1.0 - ratio)
        common = np.concatenate([value * observation.common, stray[None], shared])
        variance += gain * value**2 + doubt
        reflectance = FiberReflectance(names, radius, value, variance, common, valid, ~valid)
        head = Measurement(
            HeadPlacement(observation.sites[k], 0.0, 0), exposures, 1.0, math.nan, 5.0
        )
        profiles.append(MeasuredProfile(head, reflectance))
    return fit_profiles(profiles, observation.probe) if profiles else []


def _crosstalk(count: int) -> Any:
    """Return zero cross-talk with the standard uncertainty of a calibration.

    The nearest fibers are a million times brighter than the farthest on skin, and a thousand times
    on the phantom. A calibration's error of their light in far spots thus cancels only in part
    between skin and phantom.
    """
    place = np.arange(count)
    group = np.searchsorted(DISTANCE_EDGES, np.abs(place[:, None] - place), side="right")
    nothing = np.zeros((count, 3))
    error = np.array((0.0, *CROSSTALK_ERROR))[group]
    return CrossTalk(np.eye(count), error, nothing, nothing, nothing, True)


def _interpolation_error(
    observation: ProbeObservation, found: Float64Array, sigma: Float64Array, valid: BoolArray
) -> Float64Array:
    """Return the relative error of sigma_tr at each site, interpolated from the others, (S, 3)."""
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
