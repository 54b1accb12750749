"""Merge brackets of exposures to the rate of light on each pixel, dark signal subtracted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import uniform_filter

from capture.arrays import BoolArray, Float64Array, Int64Array
from capture.calibration.fiber.darks import CameraNoise, DarkModel
from capture.calibration.sensor.transfer_curve import cfa_offsets
from capture.documents import FaultCollector
from capture.hdr import BracketError

NOISE_WINDOW_PX: Final = 3
"""Side of the square of one color's pixels from which their noise is estimated."""
SATURATION_MARGIN_SIGMAS: Final = 4.0
MIN_RIPPLE_SIGMAS: Final = 20.0
"""Smallest light of a pixel, in standard errors, for the estimate of the source's variation."""
MAX_RIPPLE: Final = 0.1
"""Largest relative standard deviation of the source's light from frame to frame."""
MIN_RIPPLE_LOG_EVIDENCE: Final = 3.0
"""Smallest gain in log evidence that accepts a variation of the source."""


@dataclass(frozen=True, slots=True, eq=False)
class MergedSeries:
    """Light on each pixel, from all exposures of a series.

    Attributes
    ----------
    rate : ndarray of float64, shape (H, W)
        Full scales per second above the dark signal, raw mosaic; may be negative; 0 where not
        valid.
    variance : ndarray of float64, shape (H, W)
        Variance of `rate`; 0 where not valid.
    smooth : ndarray of float64, shape (H, W)
        `rate` averaged over the nearest valid pixels of the same color.
    valid : ndarray of bool, shape (H, W)
        False where a pixel is hot or saturated in every frame.
    saturated : ndarray of bool, shape (H, W)
        Saturated in every frame, but not hot.
    exposures_s : tuple of float
        Exposure times, ascending.
    scale, scale_stderr : tuple of float
        Light of each frame per second over the mean of all, estimated from the frames themselves,
        and its standard error: it corrects an unsteady source and an inexact shutter.
    """

    rate: Float64Array
    variance: Float64Array
    smooth: Float64Array
    valid: BoolArray
    saturated: BoolArray
    exposures_s: tuple[float, ...]
    scale: tuple[float, ...]
    scale_stderr: tuple[float, ...]


def merge_series(
    frames: Sequence[NDArray[np.integer]],
    exposures_s: ArrayLike,
    *,
    darks: DarkModel,
    noise: CameraNoise,
    light_s: ArrayLike | None = None,
) -> MergedSeries:
    """Merge raw frames of one scene at several exposure times and subtract the dark signal.

    Parameters
    ----------
    frames : sequence of N arrays of integers, shape (H, W)
        Raw DN, nothing subtracted; the light does not change between them.
    exposures_s : array_like, shape (N,)
        s, > 0, any order.
    darks : DarkModel
        Dark model at the frames' temperature.
    noise : CameraNoise
    light_s : array_like, shape (N,), optional
        Duration of the light in each frame, s, > 0; None: as long as the exposure.

    Returns
    -------
    MergedSeries

    Raises
    ------
    BracketError, DarkError
        When shapes or times do not match.

    Notes
    -----
    As `capture.hdr.merge`, with weights ``t / variance``, but for light below the dark signal and
    below the noise of a pixel:

    - bias and dark current are each pixel's own, and their shot noise and errors count; - a weight
    also uses the light on the pixel's neighbors. From the pixel's own noisy
      value alone it would favor low readings, by a tenth of an electron each, which sums up over a
      spot to more than the farthest fibers give;
    - pixels that are unsaturated in two exposures or more determine the source's brightness in each
      frame, if it was not steady: see `MergedSeries.scale`;
    - the neighbors of a pixel decide whether it is near saturation, not its own value, which
      would omit its high readings.
    """
    stack = [np.asarray(frame) for frame in frames]
    times = np.asarray(exposures_s, np.float64)
    _check(stack, times, darks)
    lit = times if light_s is None else np.asarray(light_s, np.float64)
    _check(stack, lit, darks, "light_s")
    darks.require(times)
    order = np.argsort(times, kind="stable")
    stack, times, lit = [stack[k] for k in order], times[order], lit[order]
    # the dark signal of each frame does not change in the iterations below
    base = [noise.black_dn + darks.bias_dn + darks.rate_dn_per_s * t for t in times]
    series = _Series(stack, times, base, _usable(stack, noise), darks, noise)
    hot = darks.hot
    # first with read noise alone, then with the shot noise of the light found
    guess, seen, _ = series.estimate_rate(lit, np.zeros(stack[0].shape))
    smooth = _smooth(guess, seen & ~hot, noise.pattern)
    light = np.maximum(smooth, 0.0)
    rate, seen, variance = series.estimate_rate(lit, light)
    clear = np.flatnonzero(seen & ~hot & (rate > MIN_RIPPLE_SIGMAS * np.sqrt(variance)))
    scale, scale_stderr = np.ones(len(times)), np.zeros(len(times))
    if len(times) > 1 and clear.size:
        scale, scale_stderr = series.estimate_scales(lit, rate, light, clear)
        if (scale != 1.0).any():
            rate, seen, variance = series.estimate_rate(lit * scale, light)
    valid = seen & ~hot
    rate, variance = np.where(valid, rate, 0.0), np.where(valid, variance, 0.0)
    span = noise.span_dn
    light = _smooth(rate, valid, noise.pattern) / span
    of_frames = (tuple(row.tolist()) for row in (times, scale, scale_stderr))
    return MergedSeries(rate / span, variance / span**2, light, valid, ~seen & ~hot, *of_frames)


def color_masks(shape: tuple[int, ...], pattern: str) -> list[BoolArray]:
    """Return the mask of each color's pixels in a raw frame, in the order R, G, B (or MONO).

    Examples
    --------
    >>> [int(mask.sum()) for mask in color_masks((4, 6), "RGGB")]
    [6, 12, 6]
    """
    planes = cfa_offsets(pattern)
    step = 1 if pattern == "MONO" else 2
    masks = []
    for color in ("R", "G", "B") if step == 2 else tuple(planes):
        mask = np.zeros(shape, np.bool_)
        for row, column in planes[color]:
            mask[row::step, column::step] = True
        masks.append(mask)
    return masks


def _check(
    stack: list[NDArray[np.integer]],
    times: Float64Array,
    darks: DarkModel,
    name: str = "exposures_s",
) -> None:
    checks = FaultCollector("Series of a probe", BracketError)
    checks.check("frames", len(stack), len(stack) > 0, "at least one frame")
    shapes = sorted({frame.shape for frame in stack})
    expected = darks.bias_dn.shape
    checks.check("frames", shapes, shapes in ([], [expected]), f"the dark frames' shape {expected}")
    whole = all(np.issubdtype(frame.dtype, np.integer) for frame in stack)
    checks.check("frames", [str(f.dtype) for f in stack][:3], whole, "raw DN, whole numbers")
    checks.check(name, times.shape, times.shape == (len(stack),), f"{len(stack)} times")
    positive = bool(np.isfinite(times).all() and (times > 0).all())
    checks.check(name, times.tolist(), positive, "finite seconds > 0")
    checks.close()


def _usable(stack: list[NDArray[np.integer]], noise: CameraNoise) -> list[BoolArray]:
    """Return the pixels of each frame that are below saturation by a safe margin."""
    spread = np.sqrt(noise.span_dn / noise.gain_e_per_dn + noise.floor_dn2)
    highest = noise.white_dn - SATURATION_MARGIN_SIGMAS * spread
    result = []
    for frame in stack:
        use = frame < noise.white_dn
        if int(frame.max()) > highest:
            everywhere = np.ones(frame.shape, np.bool_)
            use &= _smooth(frame.astype(np.float64), everywhere, noise.pattern) < highest
        result.append(use)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Series:
    """Raw frames in order of their times, with their dark signal."""

    stack: list[NDArray[np.integer]]
    times: Float64Array
    base: list[Float64Array]
    usable: list[BoolArray]
    darks: DarkModel
    noise: CameraNoise

    def estimate_rate(
        self, lit: Float64Array, light: Float64Array
    ) -> tuple[Float64Array, BoolArray, Float64Array]:
        """Return rate, mask of valid pixels, and variance, DN/s, weighted for a rate of light."""
        darks, noise = self.darks, self.noise
        shape, gain = self.stack[0].shape, noise.gain_e_per_dn
        current = max(darks.mean_rate_dn_per_s, 0.0) / gain
        shot = light / gain
        # Weighted least squares of value = rate t: the rate is sum(t v / var) / sum(t^2 / var), its
        # variance 1 / sum(t^2 / var).
        signal, time = np.zeros(shape), np.zeros(shape)
        weights, dark_time = np.zeros(shape), np.zeros(shape)
        frames = zip(self.stack, self.times, lit, self.base, self.usable, strict=True)
        for frame, t, t_light, dark, use in frames:
            weight = np.where(use, t_light / (noise.floor_dn2 + current * t + shot * t_light), 0.0)
            signal += weight * (frame - dark)
            time += weight * t_light
            weights += weight
            dark_time += weight * t
        seen = time > 0
        below = np.where(seen, time, 1.0)
        # propagated errors of a pixel's bias and dark current
        by_bias, by_rate = weights / below, dark_time / below
        (bias2, both), (_, rate2) = darks.covariance
        variance = 1.0 / below + bias2 * by_bias**2 + 2.0 * both * by_bias * by_rate
        return signal / below, seen, variance + rate2 * by_rate**2

    def estimate_scales(
        self, lit: Float64Array, rate: Float64Array, light: Float64Array, clear: Int64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the light of each frame over the mean, and its standard error.

        Least squares of ``value = rate scale time`` over pixels (K, P) with free rates, and a
        normal prior of the scales about 1 whose width maximizes the evidence.
        """
        darks, noise = self.darks, self.noise
        rate, light = rate.ravel()[clear], light.ravel()[clear]
        shown = zip(self.stack, self.base, strict=True)
        value = np.stack([f.ravel()[clear] - b.ravel()[clear] for f, b in shown])
        usable = np.stack([use.ravel()[clear] for use in self.usable])
        variance = (
            noise.floor_dn2
            + (max(darks.mean_rate_dn_per_s, 0.0) * self.times[:, None] + light * lit[:, None])
            / noise.gain_e_per_dn
        )
        expected = rate * lit[:, None]
        information = np.where(usable, expected**2 / variance, 0.0)
        miss = np.where(usable, value / expected - 1.0, 0.0)
        total = information.sum(axis=0)
        mean = (information * miss).sum(axis=0) / total
        # The free rate of each pixel is eliminated (Schur complement of its 1 x 1 block), which
        # leaves normal equations of the frames' scales only.
        normal = np.diag(information.sum(axis=1)) - (information / total) @ information.T
        right = (information * (miss - mean)).sum(axis=1)
        # prior width of largest evidence; 0 where the frames hardly constrain each other
        values, vectors = np.linalg.eigh(0.5 * (normal + normal.T))
        values, along = np.maximum(values, 0.0), vectors.T @ right
        best, width2 = MIN_RIPPLE_LOG_EVIDENCE, 0.0
        for width in np.geomspace(1e-4, MAX_RIPPLE, 16):
            grown = 1.0 + width**2 * values
            evidence = 0.5 * float(width**2 * (along**2 / grown).sum() - np.log(grown).sum())
            if evidence > best:
                best, width2 = evidence, float(width**2)
        covariance = (vectors * (width2 / (1.0 + width2 * values))) @ vectors.T
        away = covariance @ right
        return 1.0 + away, np.sqrt(np.diag(covariance))


def _smooth(values: Float64Array, valid: BoolArray, pattern: str) -> Float64Array:
    """Return the mean over the neighbors at the same position in the cell; 0 without any."""
    result = np.zeros_like(values)
    step = 1 if pattern == "MONO" else 2
    for row in range(step):
        for column in range(step):
            place = (slice(row, None, step), slice(column, None, step))
            share = uniform_filter(valid[place].astype(np.float64), NOISE_WINDOW_PX, mode="nearest")
            total = uniform_filter(
                np.where(valid[place], values[place], 0.0), NOISE_WINDOW_PX, mode="nearest"
            )
            result[place] = np.where(share > 1e-6, total / np.maximum(share, 1e-6), 0.0)
    return result
