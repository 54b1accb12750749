"""Light of a stripe projector: displayed levels, emitted light, and its blur on skin.

Stripes vary along one axis of the display, so their blur is one-dimensional. Defocus blurs by a
normal distribution. Light that enters skin leaves it at a distance: the kernel exp(-r / l) / r in
the plane has the transfer function 1 / sqrt(1 + (w l)^2).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array, Int32Array

DISPLAY_LEVELS: Final = 255
"""Largest level of the display, 8 bits."""
BLACK_LEAKAGE: Final = 1.0 / 800.0
"""Emitted light of a black pixel over that of a white one; chosen, as of common displays."""
SAMPLES_PER_PIXEL: Final = 4
"""Samples per projector pixel of blurred stripes."""
DEFOCUS_PX: Final = tuple(0.5 * 1.15**k for k in range(20))
"""Standard deviations of defocus for which blurred stripes are tabulated, projector pixels."""
SCATTERING_PX: Final = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Mean free paths for which they are tabulated, projector pixels."""
LENS_BLUR_PX: Final = 0.6
"""Standard deviation of a projector's blur in focus, projector pixels; chosen."""


def stripe_levels(length_px: int, period_px: int, phase_steps: int, pattern: int) -> Float64Array:
    """Return the levels of a pattern along its axis, 0 to 255, shape (length_px,).

    Parameters
    ----------
    length_px
        Columns or rows of the display.
    period_px, phase_steps
        See `capture.rig.Scanner`.
    pattern
        Number of the pattern: bits of the Gray code, then steps of the sinusoid.

    Raises
    ------
    ValueError
        For a number beyond the last pattern.

    Examples
    --------
    >>> stripe_levels(8, 4, 3, 0).astype(int).tolist()
    [0, 0, 0, 0, 255, 255, 255, 255]
    >>> stripe_levels(8, 4, 3, 2).astype(int).tolist()[::2]
    [255, 0, 255, 0]
    """
    bits = math.ceil(math.log2(2 * length_px / period_px))
    if not 0 <= pattern < bits + phase_steps:
        raise ValueError(f"pattern: got {pattern}, expected 0 to {bits + phase_steps - 1}")
    place = np.arange(length_px)
    if pattern < bits:
        cell = place // (period_px // 2)
        code = cell ^ (cell >> 1)
        return np.asarray(DISPLAY_LEVELS * (code >> (bits - 1 - pattern) & 1), np.float64)
    angle = 2.0 * np.pi * (place / period_px - (pattern - bits) / phase_steps)
    return np.rint(0.5 * DISPLAY_LEVELS * (1.0 + np.cos(angle)))


def emitted_light(levels: ArrayLike, gamma: float) -> Float64Array:
    """Return the light of displayed levels relative to white, 0 to 1."""
    share = (np.asarray(levels, np.float64) / DISPLAY_LEVELS) ** gamma
    return np.asarray(BLACK_LEAKAGE + (1.0 - BLACK_LEAKAGE) * share)


@dataclass(frozen=True, slots=True, eq=False)
class BlurredStripes:
    """Light of one pattern for tabulated amounts of defocus and scattering."""

    table: Float32Array
    """Shape (defocus, scattering, samples); samples from half a pixel before pixel 0."""

    @classmethod
    def of(cls, light: Float64Array) -> "BlurredStripes":
        """Blur the light of a pattern along its axis, shape (length_px,), dark around it."""
        margin = len(light)
        fine = np.repeat(np.pad(light, margin), SAMPLES_PER_PIXEL)
        wave = 2.0 * np.pi * np.fft.rfftfreq(len(fine), 1.0 / SAMPLES_PER_PIXEL)
        spectrum = np.fft.rfft(fine)
        rows = [
            [
                np.fft.irfft(
                    spectrum
                    * np.exp(-0.5 * (wave * sigma) ** 2)
                    / np.sqrt(1.0 + (wave * length) ** 2),
                    len(fine),
                )[margin * SAMPLES_PER_PIXEL : (margin + len(light)) * SAMPLES_PER_PIXEL]
                for length in SCATTERING_PX
            ]
            for sigma in DEFOCUS_PX
        ]
        return cls(np.asarray(rows, np.float32))

    def at(self, places: "DisplayPlaces", *, scattered: bool) -> Float32Array:
        """Return the light at places on the display, with scattering or without, shape (n,)."""
        flat = self.table.reshape(-1)
        samples = self.table.shape[2]
        if not scattered:
            first = places.row * (len(SCATTERING_PX) * samples) + places.sample
            return _mixed(flat, first, places.beyond_sample)
        first = (places.row * len(SCATTERING_PX) + places.length) * samples + places.sample
        near = _mixed(flat, first, places.beyond_sample)
        far = _mixed(flat, first + samples, places.beyond_sample)
        return near + places.beyond_length * (far - near)


@dataclass(frozen=True, slots=True, eq=False)
class DisplayPlaces:
    """Places on a display with their blur, prepared for `BlurredStripes.at`; shape (n,) each."""

    row: Int32Array
    """Nearest tabulated defocus."""
    length: Int32Array
    """Tabulated mean free path below."""
    beyond_length: Float32Array
    """Fraction of the way to the next one."""
    sample: Int32Array
    """Sample before the place."""
    beyond_sample: Float32Array
    """Fraction of the way to the next one."""

    @classmethod
    def of(
        cls,
        place_px: Float64Array,
        length_px: int,
        defocus_px: Float64Array,
        scattering_px: Float64Array,
    ) -> "DisplayPlaces":
        """Prepare places along an axis of ``length_px`` pixels; they lie on the display."""
        rows = np.interp(np.log(defocus_px), np.log(DEFOCUS_PX), np.arange(len(DEFOCUS_PX)))
        lengths = np.interp(scattering_px, SCATTERING_PX, np.arange(len(SCATTERING_PX)))
        length = np.minimum(lengths.astype(np.int32), len(SCATTERING_PX) - 2)
        last = length_px * SAMPLES_PER_PIXEL - 2
        samples = np.clip((place_px + 0.5) * SAMPLES_PER_PIXEL - 0.5, 0.0, last + 1.0)
        sample = np.minimum(samples.astype(np.int32), last)
        return cls(
            np.rint(rows).astype(np.int32),
            length,
            (lengths - length).astype(np.float32),
            sample,
            (samples - sample).astype(np.float32),
        )


def _mixed(values: Float32Array, first: Int32Array, beyond: Float32Array) -> Float32Array:
    """Return values between an entry and the next."""
    low = values[first]
    return low + beyond * (values[first + 1] - low)


def defocus_blur_px(projector: View, distance_mm: Float64Array) -> Float64Array:
    """Return the blur's standard deviation at distances along the axis, projector pixels.

    The image of a point by a thin lens is a disc. Its diameter is
    ``A f |z - z_f| / (z (z_f - f))`` with A = f / N; the deviation of a disc along one axis is a
    quarter of its diameter.
    """
    focus_mm, f = projector.focus_distance_mm, projector.focal_mm
    z = np.maximum(distance_mm, 2.0 * f)
    disc_mm = f / projector.f_number * f * np.abs(z - focus_mm) / (z * (focus_mm - f))
    return np.hypot(LENS_BLUR_PX, 0.25 * disc_mm / (1e-3 * projector.pixel_um))
