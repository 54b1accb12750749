"""Light from each detection fiber: a series of brackets summed over the fibers' spots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.darks import CameraNoise, DarkModel
from capture.calibration.fiber.merge import MergedSeries, color_masks, merge_series
from capture.calibration.fiber.spots import FiberSpots

APERTURE_GUARD_PX: Final = 6.0
"""Gap between the row's apertures and the pixels of the local background."""
BACKGROUND_HALF_WIDTH_PITCH: Final = 2.0
"""Extent of the background to both sides of a spot, in distances of neighbors."""
MIN_BACKGROUND_PIXELS: Final = 200
"""Smallest number of background pixels of a color."""
FILLED_PIXEL_STDERR: Final = 0.1
"""Relative error of a pixel that is filled from its neighbors."""
MAX_FILLED_FRACTION: Final = 0.2
"""Largest fraction of an aperture's pixels of one color that may be filled."""


@dataclass(frozen=True, slots=True, eq=False)
class FiberReadings:
    """Light from each fiber in each color.

    Attributes
    ----------
    names : tuple of str
        Names of the F fibers.
    signal : ndarray of float64, shape (F, C)
        Full scales per second, summed over the pixels of a color in the fiber's aperture, above the
        dark signal and the local background; may be negative; 0 where not valid. C = 3 (R, G, B),
        or 1 (MONO).
    variance : ndarray of float64, shape (F, C)
        Variance of `signal`: shot, read and dark noise, rounding, errors of dark frames and
        background; 0 where not valid.
    valid : ndarray of bool, shape (F, C)
        False where saturated, or where too many pixels are hot.
    saturated : ndarray of bool, shape (F, C)
        A pixel of the spot is at the white level even in the shortest frame.
    around : ndarray of float64, shape (F, C)
        Subtracted background around the spot, full scales per second and pixel.
    exposures_s : tuple of float
        Exposure times of the frames, ascending.
    noise_origin : str
        Source of gain and read noise: "nominal" or "calibrated".
    """

    names: tuple[str, ...]
    signal: Float64Array
    variance: Float64Array
    valid: BoolArray
    saturated: BoolArray
    around: Float64Array
    exposures_s: tuple[float, ...]
    noise_origin: str = "nominal"

    def __post_init__(self) -> None:
        """Check the arrays against each other."""
        shape = np.shape(self.signal)
        if len(shape) != 2 or shape[0] != len(self.names):
            raise ValueError(
                f"FiberReadings.signal: got shape {shape}, expected ({len(self.names)}, colors)"
            )
        for name in ("variance", "valid", "saturated", "around"):
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(
                    f"FiberReadings.{name}: got shape {np.shape(getattr(self, name))}, expected"
                    f" {shape}"
                )
        if not np.isfinite(self.signal).all() or not (np.asarray(self.variance) >= 0).all():
            raise ValueError("FiberReadings: got a signal that is not finite or a variance < 0")

    @property
    def stderr(self) -> Float64Array:
        """Standard error of `signal`, shape (F, C)."""
        return np.sqrt(self.variance)

    @property
    def detected(self) -> BoolArray:
        """Whether a valid signal exceeds three standard errors, shape (F, C)."""
        return np.asarray(self.valid & (self.signal > 3.0 * self.stderr))


def read_fibers(
    frames: Sequence[NDArray[np.integer]],
    exposures_s: ArrayLike,
    *,
    spots: FiberSpots,
    darks: DarkModel,
    noise: CameraNoise,
    temperature_c: float | None = None,
    light_s: ArrayLike | None = None,
) -> FiberReadings:
    """Read the fibers from a series of exposures.

    Parameters
    ----------
    frames : sequence of N arrays of integers, shape (H, W)
        Raw DN of one series, nothing subtracted; at least one frame.
    exposures_s : array_like, shape (N,)
        s, > 0, any order.
    spots : FiberSpots
        Positions of the fibers' ends in these frames.
    darks : DarkModel
        See `fiber_darks.measure_darks`.
    noise : CameraNoise
    temperature_c : float, optional
        Temperature of the camera during the series, to which the dark current is extrapolated.
    light_s : array_like, shape (N,), optional
        Duration of the light in each frame, s, > 0; None: as long as the exposure.

    Returns
    -------
    FiberReadings

    Raises
    ------
    BracketError, DarkError
        When shapes, times or temperatures do not match.
    """
    merged = merge_series(
        frames, exposures_s, darks=darks.at(temperature_c), noise=noise, light_s=light_s
    )
    return sum_spots(merged, spots, noise=noise)


def sum_spots(merged: MergedSeries, spots: FiberSpots, *, noise: CameraNoise) -> FiberReadings:
    """Sum a merged series over the apertures of the spots.

    Parameters
    ----------
    merged : MergedSeries
    spots : FiberSpots
    noise : CameraNoise
        Gives the color filter pattern.

    Returns
    -------
    FiberReadings

    Notes
    -----
    The background of a spot is the mean over pixels above and below the row, up to two neighbors
    away: stray light, veiling glare, and the common error of the dark frames, as after a warm-up of
    the camera. Hot pixels are filled from their neighbors, with a standard error of 10 %.
    """
    shape = merged.rate.shape
    colors = color_masks(shape, noise.pattern)
    count = len(spots.names)
    signal, variance = np.zeros((count, len(colors))), np.zeros((count, len(colors)))
    around = np.zeros((count, len(colors)))
    valid = np.zeros((count, len(colors)), np.bool_)
    saturated = np.zeros_like(valid)
    hot = ~merged.valid & ~merged.saturated
    for i in range(count):
        inside = spots.mask(i, shape)
        background = _background_pixels(spots, i, shape) & merged.valid
        for c, color in enumerate(colors):
            pixels = inside & color
            number = int(pixels.sum())
            full = pixels & merged.saturated
            filled = pixels & hot
            saturated[i, c] = bool(full.any())
            gaps = int(filled.sum())
            valid[i, c] = (
                number > 0 and not saturated[i, c] and gaps <= MAX_FILLED_FRACTION * number
            )
            if not valid[i, c]:
                continue
            measured = pixels & ~filled
            signal[i, c] = merged.rate[measured].sum() + merged.smooth[filled].sum()
            # noise of the neighbor that replaces a pixel, and the difference of neighbors
            spread = merged.variance[measured]
            variance[i, c] = spread.sum() + gaps * spread.mean()
            variance[i, c] += FILLED_PIXEL_STDERR**2 * float((merged.smooth[filled] ** 2).sum())
            level = background & color
            if (seen := int(level.sum())) >= MIN_BACKGROUND_PIXELS:
                around[i, c] = merged.rate[level].mean()
                signal[i, c] -= number * around[i, c]
                variance[i, c] += number**2 * float(merged.variance[level].sum()) / seen**2
    return FiberReadings(
        spots.names, signal, variance, valid, saturated, around, merged.exposures_s, noise.origin
    )


def _background_pixels(spots: FiberSpots, fiber: int, shape: tuple[int, ...]) -> BoolArray:
    """Return the pixels above and below the row, near one spot."""
    height, width = shape[:2]
    center = spots.center_px[fiber]
    gaps = np.linalg.norm(np.diff(spots.center_px, axis=0), axis=1)
    reach = BACKGROUND_HALF_WIDTH_PITCH * (float(np.median(gaps)) if len(gaps) else 40.0)
    mask = np.zeros((height, width), np.bool_)
    left, right = max(int(center[0] - reach), 0), min(int(center[0] + reach) + 1, width)
    near = np.abs(spots.center_px[:, 0] - center[0]) <= reach + spots.aperture_px
    clear = spots.aperture_px + APERTURE_GUARD_PX
    top = int(np.floor(spots.center_px[near, 1].min() - clear))
    bottom = int(np.ceil(spots.center_px[near, 1].max() + clear)) + 1
    mask[: max(top, 0), left:right] = True
    mask[bottom:, left:right] = True
    return mask
