"""Decode projected stripes: Gray code and phase steps to a projector coordinate in each pixel.

A sinusoid of N phase steps gives the coordinate modulo its period. A Gray code with two cells per
period gives the number of the period. A wrong bit next to a cell's edge moves the cell by one,
which the phase repairs. The mean of the sinusoid is the threshold of the bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, Int64Array

MAX_PHASE_STDERR_RAD: Final = 0.25
"""Standard error of the phase, rad, above which a pixel is masked."""
MIN_CONTRAST: Final = 0.1
"""Amplitude of the sinusoid, relative to its mean, below which a pixel is masked."""
MAX_MISFIT: Final = 0.15
"""RMS residual of the sinusoid, relative to its amplitude, above which a pixel is masked."""
UNSURE_BIT: Final = 0.3
"""Distance of a bit's signal from the threshold, relative to the amplitude, that leaves it open."""
MAX_CELL_OFFSET: Final = 0.375
"""Distance of a coordinate from its Gray cell's center, in periods; in the cell it is 0.25."""
MAX_PERIOD_PER_PIXEL: Final = 0.25
"""Part of a period per pixel above which the sinusoid is sampled too coarsely."""
MISFIT_WINDOW_PX: Final = 5
"""Window over which residuals are averaged, px."""


class StripeError(ValueError):
    """Frames of stripes that do not match their code."""


@dataclass(frozen=True, slots=True)
class StripeCode:
    """Stripes along one axis of a projector."""

    length_px: int
    """Number of projector columns, or rows, >= 2."""
    period_px: float
    """Period of the sinusoid, projector pixels, > 0, at most ``length_px``."""
    steps: int
    """Number of phase steps, >= 3."""

    def __post_init__(self) -> None:
        check = Checks(StripeError)
        check.within("length_px", self.length_px, "[2, inf)")
        check.within("period_px", self.period_px, "(0, inf)")
        check.require(self.period_px <= self.length_px, "period_px", self.period_px, "<= length_px")
        check.within("steps", self.steps, "[3, inf)")

    @property
    def bits(self) -> int:
        """Number of Gray-code frames, two cells per period.

        Examples
        --------
        >>> StripeCode(length_px=1024, period_px=32.0, steps=6).bits
        6
        """
        return max(1, math.ceil(math.log2(2.0 * self.length_px / self.period_px) - 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class StripeMap:
    """Projector coordinate in each pixel of a camera."""

    position_px: Float64Array
    """Column or row of the projector, shape (H, W); pixel 0's center is 0; NaN where masked."""
    stderr_px: Float64Array
    """Standard error, projector pixels, shape (H, W); NaN where masked."""
    amplitude: Float64Array
    """Amplitude of the sinusoid in the unit of the frames, shape (H, W)."""
    valid: BoolArray
    """Pixels whose coordinate is decoded, shape (H, W)."""


def decode_stripes(
    gray: ArrayLike,
    phase: ArrayLike,
    code: StripeCode,
    *,
    variance: ArrayLike,
    usable: ArrayLike | None = None,
) -> StripeMap:
    """Decode the frames of one code to a projector coordinate in each pixel.

    Parameters
    ----------
    gray : array_like
        Frames of the bits of the reflected Gray code, the most significant first, shape
        (B, H, W), in any linear unit.
    phase : array_like
        Frames n = 0 to N - 1 of the sinusoid ``A + B cos(2 pi (x / period - n / N))``, shape
        (N, H, W).
    code : StripeCode
        B is its number of bits, N its number of steps.
    variance : array_like
        Variance of the samples of ``phase``, shape (N, H, W) or one that broadcasts.
    usable : array_like of bool, optional
        Pixels without saturated samples, shape (H, W); all by default.

    Returns
    -------
    StripeMap
        Masked: pixels that are not usable, too dark for the noise, of low contrast, not
        sinusoidal, of contradictory bits, or sampled too coarsely.

    Notes
    -----
    The phase is that of the first Fourier coefficient; its variance is that of N samples with
    independent noise, ``2 v / (N B^2)`` for equal variances v. Where the residuals of the sinusoid
    exceed the noise, on the mean of a neighborhood, the variance grows in proportion.

    References
    ----------
    Sansoni, Carocci and Rodella 1999, Three-dimensional vision based on a combination of Gray-code
    and phase-shift light projection, doi:10.1364/AO.38.006565.
    """
    check = Checks(StripeError)
    steps = check.numbers("phase", phase, ("N", "H", "W"))
    bits = check.numbers("gray", gray, ("B", "H", "W"))
    size = steps.shape[1:]
    check.shape("phase", steps, (code.steps, *size))
    check.shape("gray", bits, (code.bits, *size))
    noise = np.asarray(np.broadcast_to(np.asarray(variance, np.float64), steps.shape))
    check.within("variance", noise, "[0, inf)")
    good = np.ones(size, np.bool_) if usable is None else np.array(usable, np.bool_)
    check.shape("usable", good, size)
    mean, amplitude, angle, fit = _fit_sinusoid(steps)
    turn = 2.0 * np.pi * np.arange(code.steps)[:, None, None] / code.steps
    floor = np.maximum(amplitude, np.finfo(np.float32).tiny)
    angle_variance = np.sum(
        (np.sin(turn - angle) * 2.0 / (code.steps * floor)) ** 2 * noise, axis=0
    )
    good &= (amplitude > 0) & (amplitude > MIN_CONTRAST * np.abs(mean))
    if code.steps > 3:
        misfit = np.sum((steps - fit) ** 2, axis=0) / (code.steps - 3)
        excess = np.maximum(misfit - noise.mean(axis=0), 0.0)
        good &= excess < (MAX_MISFIT * amplitude) ** 2
        angle_variance = angle_variance * _misfit_ratio(misfit, noise.mean(axis=0), good)
    good &= angle_variance < MAX_PHASE_STDERR_RAD**2
    signal = (bits - mean) / floor
    good &= np.count_nonzero(np.abs(signal) < UNSURE_BIT, axis=0) <= 1
    center = 0.5 * code.period_px * (_gray_to_number(signal > 0) + 0.5) - 0.5
    part = angle / (2.0 * np.pi)
    position = code.period_px * (part + np.round(center / code.period_px - part))
    good &= np.abs(position - center) <= MAX_CELL_OFFSET * code.period_px
    good &= (position >= -0.5) & (position <= code.length_px - 0.5)
    good = _without_coarse(position, good, MAX_PERIOD_PER_PIXEL * code.period_px)
    stderr = np.sqrt(angle_variance) * code.period_px / (2.0 * np.pi)
    return StripeMap(
        np.where(good, position, np.nan), np.where(good, stderr, np.nan), amplitude, good
    )


def _fit_sinusoid(
    steps: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Return mean, amplitude and phase of the sinusoid through the steps, and its samples."""
    count = len(steps)
    turn = 2.0 * np.pi * np.arange(count) / count
    mean = steps.mean(axis=0)
    cosine = np.tensordot(np.cos(turn), steps, 1) * 2.0 / count
    sine = np.tensordot(np.sin(turn), steps, 1) * 2.0 / count
    turns = turn[:, None, None]
    fit = mean + cosine * np.cos(turns) + sine * np.sin(turns)
    return mean, np.hypot(cosine, sine), np.arctan2(sine, cosine), fit


def _misfit_ratio(misfit: Float64Array, noise: Float64Array, good: BoolArray) -> Float64Array:
    """Return the squared residual over the variance of the noise around each pixel, >= 1."""
    around = [
        ndimage.uniform_filter(np.where(good, values, 0.0), MISFIT_WINDOW_PX, mode="constant")
        for values in (misfit, noise)
    ]
    if not noise.any():
        return np.ones(noise.shape)
    return np.where(good, np.maximum(around[0] / np.maximum(around[1], 1e-30), 1.0), 1.0)


def _gray_to_number(bits: BoolArray) -> Int64Array:
    """Return the numbers of reflected Gray codes, most significant bit first, shape (H, W)."""
    number = np.zeros(bits.shape[1:], np.int64)
    last = np.zeros(bits.shape[1:], np.bool_)
    for bit in bits:
        last = last ^ bit
        number = 2 * number + last
    return number


def _without_coarse(position: Float64Array, good: BoolArray, most_px: float) -> BoolArray:
    """Omit pixels that differ from a decoded neighbor on either side by more than ``most_px``."""
    held = np.where(good, position, np.nan)
    keep = good.copy()
    for axis in (0, 1):
        gap = np.abs(np.diff(held, axis=axis)) > most_px  # False at masked neighbors
        first = [slice(None)] * 2
        second = [slice(None)] * 2
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        keep[tuple(first)] &= ~gap
        keep[tuple(second)] &= ~gap
    return keep
