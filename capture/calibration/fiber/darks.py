"""Fit bias and dark current of each pixel to frames with a closed shutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import CalibrationError
from capture.calibration.robust import SIGMA_PER_MAD, mad_sigma
from capture.calibration.sensor import SensorCalibration
from capture.documents import FaultCollector
from capture.rig import CFA_PATTERNS, View

HOT_FIT_SIGMAS: Final = 6.0
MIN_HOT_DN: Final = 1.0
"""Dark signal that every hot pixel exceeds at the longest exposure."""
DARK_CURRENT_DOUBLING_K: Final = 7.0
DARK_CURRENT_DOUBLING_STDERR_K: Final = 1.0
"""Warming that doubles the dark current, K; Widenhorn et al. 2002, doi 10.1117/12.463446, find 6 to
8 K for silicon near 0 C.
"""
MAX_TEMPERATURE_GAP_K: Final = 10.0
"""Largest temperature difference over which a dark current is extrapolated, K."""
TEMPERATURE_TOL_K: Final = 0.5


class DarkError(CalibrationError):
    """Raised for missing dark frames, or ones that do not fit the exposures to be corrected."""


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Levels and temporal noise of a camera.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> noise = CameraNoise.from_view(load_rig("probe").view("cam"))
    >>> round(noise.gain_e_per_dn, 3), noise.span_dn, noise.origin
    (4.465, 4031.0, 'nominal')
    """

    gain_e_per_dn: float
    """Electrons per DN, > 0."""
    read_noise_e: float
    """Read noise of one frame, electrons rms, >= 0."""
    black_dn: float
    """DN without light, >= 0."""
    white_dn: float
    """DN of saturation, > black."""
    pattern: str
    """Colors of the 2 x 2 cell read row by row, or MONO."""
    origin: str
    """Source of the values: "nominal" (rig file) or "calibrated"."""

    def __post_init__(self) -> None:
        checks = FaultCollector("CameraNoise", DarkError)
        checks.check_positive(gain_e_per_dn=self.gain_e_per_dn)
        checks.check("read_noise_e", self.read_noise_e, 0 <= self.read_noise_e < np.inf, ">= 0")
        checks.check("black_dn", self.black_dn, 0 <= self.black_dn < self.white_dn, "0 to white")
        checks.check(
            "pattern", self.pattern, self.pattern in CFA_PATTERNS, f"one of {CFA_PATTERNS}"
        )
        checks.close()

    @classmethod
    def from_view(cls, view: View) -> CameraNoise:
        """Return the nominal values of a camera from the rig file."""
        levels = float(view.black_level), float(view.white_level)
        return cls(view.gain_e_per_dn, view.read_noise_e, *levels, view.cfa, "nominal")

    @classmethod
    def from_sensor(cls, sensor: SensorCalibration) -> CameraNoise:
        """Return the values of a sensor calibration, averaged over its colors."""
        means = sensor.mean_gain_e_per_dn(), sensor.mean_read_noise_e()
        gain, read_noise = (float(mean.value) for mean in means)
        levels = float(sensor.black_dn.value.mean()), float(sensor.white_dn)
        return cls(gain, read_noise, *levels, sensor.pattern, "calibrated")

    @property
    def span_dn(self) -> float:
        """Full scale: DN from black to white."""
        return self.white_dn - self.black_dn

    @property
    def floor_dn2(self) -> float:
        """Variance of a pixel without light and dark current, DN^2: read noise and rounding."""
        return (self.read_noise_e / self.gain_e_per_dn) ** 2 + 1.0 / 12.0


@dataclass(frozen=True, slots=True, eq=False)
class DarkModel:
    """Dark signal of each pixel: ``bias + rate t``.

    Attributes
    ----------
    bias_dn, rate_dn_per_s : ndarray of float64, shape (H, W)
    covariance : ndarray of float64, shape (2, 2)
        Covariance of a pixel's bias and rate: DN^2, DN^2/s, DN^2/s^2. Pixels are independent.
    hot : ndarray of bool, shape (H, W)
        Pixels whose dark current is an outlier.
    mean_rate_dn_per_s, mean_rate_stderr : float
        Mean over all pixels that are not hot.
    times_s : tuple of float
        Exposure times of the dark frames, ascending, each once.
    frames : int
    temperature_c : float or None
        Temperature of the camera; None: not known.
    """

    bias_dn: Float64Array
    rate_dn_per_s: Float64Array
    covariance: Float64Array
    hot: BoolArray
    mean_rate_dn_per_s: float
    mean_rate_stderr: float
    times_s: tuple[float, ...]
    frames: int
    temperature_c: float | None = None

    def require(self, exposures_s: ArrayLike) -> None:
        """Raise an error unless the model covers the dark signal of these exposures.

        Raises
        ------
        DarkError
            When the dark frames have a single exposure time, different from these.
        """
        times = np.asarray(exposures_s, np.float64)
        if len(self.times_s) == 1 and (np.abs(times / self.times_s[0] - 1) > 0.01).any():
            raise DarkError(
                f"dark frames: got exposures of {self.times_s[0]:g} s only, expected two times or"
                f" more, as the frames took {times.min():.3g} to {times.max():.3g} s; capture darks"
                " of a short and of the longest exposure"
            )

    def at(self, temperature_c: float | None) -> DarkModel:
        """Return the model of a camera at another temperature.

        The dark current doubles every 7 K (+- 1 K); the covariance includes this uncertainty.

        Raises
        ------
        DarkError
            When the temperatures are more than 10 K apart.
        """
        if temperature_c is None or self.temperature_c is None:
            return self
        apart = temperature_c - self.temperature_c
        if abs(apart) <= TEMPERATURE_TOL_K:
            return self
        if abs(apart) > MAX_TEMPERATURE_GAP_K:
            raise DarkError(
                f"dark frames: got a camera at {self.temperature_c:.1f} C, but the frames were"
                f" taken at {temperature_c:.1f} C, expected at most"
                f" {MAX_TEMPERATURE_GAP_K:g} K apart; capture darks at the frames' temperature"
            )
        factor = 2.0 ** (apart / DARK_CURRENT_DOUBLING_K)
        relative = abs(np.log(factor)) * DARK_CURRENT_DOUBLING_STDERR_K / DARK_CURRENT_DOUBLING_K
        covariance = self.covariance * np.array([[1.0, factor], [factor, factor**2]])
        covariance[1, 1] += (relative * factor * self.mean_rate_dn_per_s) ** 2
        return replace(
            self,
            rate_dn_per_s=self.rate_dn_per_s * factor,
            covariance=covariance,
            mean_rate_dn_per_s=self.mean_rate_dn_per_s * factor,
            mean_rate_stderr=float(
                factor * np.hypot(self.mean_rate_stderr, relative * self.mean_rate_dn_per_s)
            ),
            temperature_c=temperature_c,
        )


def measure_darks(
    frames: Sequence[NDArray[np.integer]],
    exposures_s: ArrayLike,
    *,
    noise: CameraNoise,
    temperature_c: float | None = None,
) -> DarkModel:
    """Fit bias and dark current of every pixel to frames with the shutter closed.

    Parameters
    ----------
    frames : sequence of N arrays of integers, shape (H, W)
        Raw DN, at two exposure times or more (or all at the one time of the frames to correct).
    exposures_s : array_like, shape (N,)
        s, > 0.
    noise : CameraNoise
    temperature_c : float, optional
        Temperature of the camera, mean over the frames, degrees Celsius.

    Returns
    -------
    DarkModel

    Raises
    ------
    DarkError
        When frames are missing, or do not fit each other.

    Notes
    -----
    Bias and rate of each pixel are shrunk to the mean of all pixels by their scatter, estimated
    from the same frames (best linear unbiased prediction; Robinson 1991, doi
    10.1214/ss/1177011926). With few dark frames this has less noise than each pixel's own fit, and
    less bias than one value for all pixels.
    """
    times = np.asarray(exposures_s, np.float64)
    stack = [np.asarray(frame) for frame in frames]
    checks = FaultCollector("Dark frames", DarkError)
    checks.check("frames", len(stack), len(stack) > 0, "at least one; capture darks first")
    shapes = sorted({frame.shape for frame in stack})
    checks.check("frames", shapes, len(shapes) <= 1 and all(len(s) == 2 for s in shapes), "(H, W)")
    checks.check("exposures_s", times.shape, times.shape == (len(stack),), f"{len(stack)} times")
    good = bool(np.isfinite(times).all() and (times > 0).all())
    checks.check("exposures_s", times.tolist(), good, "finite seconds > 0")
    checks.close()
    distinct = tuple(float(t) for t in np.unique(times))
    longest = distinct[-1]
    if len(distinct) == 1:
        times = np.zeros_like(times)  # then all of it is bias
    level = np.array([_clipped_mean(frame) for frame in stack]) - noise.black_dn
    bright = [frame >= noise.white_dn for frame in stack]
    bias, rate, slope_error = _fit_dark_line(times, level, noise.floor_dn2 / stack[0].size)
    variance = noise.floor_dn2 + max(rate, 0.0) * times / noise.gain_e_per_dn
    # sums of each pixel's residuals, and of residuals times time
    z0, z1 = np.zeros(stack[0].shape), np.zeros(stack[0].shape)
    for frame, t, v in zip(stack, times, variance, strict=True):
        residual = (frame.astype(np.float64) - (noise.black_dn + bias + rate * t)) / v
        z0 += residual
        z1 += residual * t
    one, many = 1.0 / variance, len(distinct) > 1
    normal = np.array(
        [[one.sum(), (one * times).sum()], [(one * times).sum(), (one * times**2).sum()]]
    )
    if not many:
        normal[1, 1] = 1.0  # without exposure time the rate keeps its prior, zero
    error = np.linalg.inv(normal)
    own_bias, own_rate = error[0, 0] * z0 + error[0, 1] * z1, error[1, 0] * z0 + error[1, 1] * z1
    hot = np.logical_or.reduce(bright)
    hot |= _find_outliers(own_bias, MIN_HOT_DN)
    if many:
        hot |= _find_outliers(own_rate, MIN_HOT_DN / longest)
    # The observed variance over pixels is the true variance plus that of the errors.
    spread = np.zeros((2, 2))
    kept = ~hot
    for i, own in enumerate((own_bias, own_rate)):
        spread[i, i] = max(float(np.var(own[kept])) - error[i, i], 0.0) if kept.any() else 0.0
    if not many:
        spread[1, 1] = 0.0
    # posterior of a pixel's own part: prior N(0, spread), data z with information `normal`
    shrink = spread @ np.linalg.inv(np.eye(2) + normal @ spread)
    covariance = 0.5 * (shrink + shrink.T)
    return DarkModel(
        bias_dn=bias + shrink[0, 0] * z0 + shrink[0, 1] * z1,
        rate_dn_per_s=rate + shrink[1, 0] * z0 + shrink[1, 1] * z1,
        covariance=covariance,
        hot=hot,
        mean_rate_dn_per_s=rate,
        mean_rate_stderr=slope_error,
        times_s=distinct,
        frames=len(stack),
        temperature_c=temperature_c,
    )


def _clipped_mean(frame: NDArray[np.integer]) -> float:
    """Return the mean of a frame without its outliers."""
    values = frame.astype(np.float64)
    center = float(np.median(values))
    scale = max(mad_sigma(values - center), 0.5)
    return float(values[np.abs(values - center) <= 5.0 * scale].mean())


def _fit_dark_line(
    times: Float64Array, level: Float64Array, variance: float
) -> tuple[float, float, float]:
    """Return bias, rate, and the rate's standard error including the scatter between frames."""
    centered = times - times.mean()
    square = float(centered @ centered)
    if square <= 0:
        return float(level.mean()), 0.0, 0.0
    rate = float(centered @ level) / square
    bias = float(level.mean()) - rate * float(times.mean())
    misfit = level - bias - rate * times
    scatter = float(misfit @ misfit) / max(len(times) - 2, 1)
    return bias, rate, float(np.sqrt(max(scatter, variance) / square))


def _find_outliers(values: Float64Array, min_deviation: float) -> BoolArray:
    center = float(np.median(values))
    away = np.abs(values - center)
    limit = HOT_FIT_SIGMAS * SIGMA_PER_MAD * float(np.median(away))
    return np.asarray(away > np.maximum(limit, min_deviation))
