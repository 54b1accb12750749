"""Restore slopes that a lens has blurred, by a Wiener filter.

A macro lens at a small aperture passes waves of some tens of micrometers with half their height,
and none shorter than its cutoff. Between the cutoff and the sampling limit of the pixels there is
noise alone, which estimates the noise from the images. Waves above the noise are divided by the
lens's transfer, the others omitted (Wiener 1949; Gonzalez and Woods 2018, section 5.8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from model.checks import Checks
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray

MAX_GAIN = 4.0
"""Largest gain: waves that the lens weakens more are lost."""
SMOOTH_BINS = 2.0
"""Standard deviation by which the spectrum is smoothed, in bins of its own grid."""
PAD_PX = 32
MIN_COSINE = 0.1
"""Least cosine between normal and view of a usable slope."""
NOISE_CUTOFF_RATIO = 1.03
"""Frequency over the cutoff from which there is noise alone."""


class RestorationError(ValueError):
    """Normals or lenses that slopes cannot be restored with."""


@dataclass(frozen=True, slots=True)
class Aperture:
    """A lens without aberrations and the pixels behind it, both as sizes on the subject.

    Attributes
    ----------
    cutoff_um : float
        Shortest period that passes, um: wavelength times working f-number over magnification.
    pixel_um : float
        Side of a pixel, um.
    """

    cutoff_um: float
    pixel_um: float

    def __post_init__(self) -> None:
        """Refuse sizes that are not positive."""
        Checks(RestorationError).settings(self, cutoff_um="(0, inf)", pixel_um="(0, inf)")

    @staticmethod
    def of(
        *, f_number: float, magnification: float, wavelength_um: float, pixel_um: float
    ) -> Aperture:
        """Return the aperture of a lens from f-number, magnification and wavelength.

        Parameters
        ----------
        f_number
            As engraved, for a distant subject; the working one is (1 + magnification) times it.
        magnification
            Size of the image over that of the subject, > 0.
        wavelength_um
            Mean wavelength, um.
        pixel_um
            Side of a pixel on the subject, um.

        Examples
        --------
        >>> lens = Aperture.of(f_number=16, magnification=11 / 12, wavelength_um=0.535, pixel_um=6)
        >>> round(lens.cutoff_um, 2)
        17.9
        """
        working = f_number * (1.0 + magnification)
        return Aperture(wavelength_um * working / magnification, pixel_um)

    def transfer(self, per_um_x: FloatArray, per_um_y: FloatArray) -> Float64Array:
        """Return the modulation transfer of lens and pixel (Goodman 2005, eq. (6-31)).

        Parameters
        ----------
        per_um_x, per_um_y
            Spatial frequencies on the subject, 1/um, which broadcast.

        Examples
        --------
        >>> lens = Aperture(18.0, 6.0)
        >>> lens.transfer(np.array([0.0, 1 / 36.0, 1 / 18.0]), np.zeros(3)).round(3).tolist()
        [1.0, 0.373, 0.0]
        """
        radius = np.minimum(np.hypot(per_um_x, per_um_y) * self.cutoff_um, 1.0)
        lens = 2 / np.pi * (np.arccos(radius) - radius * np.sqrt(1.0 - radius**2))
        return lens * np.sinc(per_um_x * self.pixel_um) * np.sinc(per_um_y * self.pixel_um)

    def restore(self, per_px_x: FloatArray, per_px_y: FloatArray) -> Float64Array:
        """Return the inverse transfer by cycles per pixel, up to `MAX_GAIN`; 0 beyond the cutoff.

        Examples
        --------
        >>> lens = Aperture(18.0, 6.0)
        >>> lens.restore(np.array([0.0, 1 / 6, 1 / 3 + 0.02]), np.zeros(3)).round(3).tolist()
        [1.0, 2.678, 0.0]
        """
        x, y = np.asarray(per_px_x) / self.pixel_um, np.asarray(per_px_y) / self.pixel_um
        gain = np.minimum(1.0 / np.maximum(self.transfer(x, y), 1e-6), MAX_GAIN)
        return np.where(np.hypot(x, y) * self.cutoff_um > NOISE_CUTOFF_RATIO, 0.0, gain)


@dataclass(frozen=True, slots=True)
class RestoredNormals:
    """Restored normals with their noise.

    Attributes
    ----------
    normals : ndarray, shape (H, W, 3)
        Unit vectors; (0, 0, 1) where not valid.
    noise : float
        Standard deviation of one slope's noise in a pixel, before the filter.
    kept_noise : float
        The same after it.
    filter : ndarray, shape (H + 64, W + 64)
        Factor of each wave, on the grid of `scipy.fft.fftfreq`.
    error_filter : ndarray, shape (H + 64, W + 64)
        Factor by which a wave of white noise gets the variance of the restored slopes' error: of
        noise that passes the filter, and of relief below the noise that does not.
    """

    normals: FloatArray
    noise: float
    kept_noise: float
    filter: Float64Array
    error_filter: Float64Array

    def sample_errors(self, rng: np.random.Generator) -> tuple[Float64Array, Float64Array]:
        """Draw errors of both slopes by noise and lost relief, each of shape (H, W)."""
        shape = self.normals.shape[:2]
        x, y = (
            filter_by_transfer(self.noise * rng.standard_normal(shape), self.error_filter)
            for _ in range(2)
        )
        return x, y


def restore_normals(
    normals: FloatArray, *, lens: Aperture, valid: BoolArray, smooth_px: float = 0.0
) -> RestoredNormals:
    """Undo the blur of the lens for waves above the noise.

    Parameters
    ----------
    normals : ndarray, shape (H, W, 3)
        Unit vectors towards +z, blurred by the lens.
    lens : Aperture
    valid : ndarray of bool, shape (H, W)
        Pixels with known normals.
    smooth_px : float
        Standard deviation of a Gaussian that also smoothed them, px.

    Returns
    -------
    RestoredNormals

    Raises
    ------
    RestorationError
        Where no normal is valid, or pixels are so large that no frequency is beyond the lens.
    """
    known = valid & (normals[..., 2] > MIN_COSINE) & np.isfinite(normals).all(axis=-1)
    if not known.any():
        raise RestorationError(
            "valid: got no pixel with a normal towards the view, expected some; "
            "check the mask and the sign of n_z"
        )
    z = np.where(known, normals[..., 2], 1.0)
    slopes = [np.where(known, -normals[..., i] / z, 0.0).astype(np.float64) for i in (0, 1)]
    means = [float(s[known].mean()) for s in slopes]
    slopes = [np.where(known, s - m, 0.0) for s, m in zip(slopes, means, strict=True)]
    spectra = [fft.fft2(_padded(s), workers=-1) for s in slopes]
    shape = spectra[0].shape
    per_um_y = fft.fftfreq(shape[0], lens.pixel_um)[:, None]
    per_um_x = fft.fftfreq(shape[1], lens.pixel_um)[None, :]
    through = lens.transfer(per_um_x, per_um_y)
    smoothing = np.exp(
        -2.0 * (np.pi * smooth_px * lens.pixel_um) ** 2 * (per_um_x**2 + per_um_y**2)
    )
    power = sum(np.abs(s) ** 2 for s in spectra) / 2.0
    beyond = np.hypot(per_um_x, per_um_y) * lens.cutoff_um > NOISE_CUTOFF_RATIO
    if np.count_nonzero(beyond) < 16:
        raise RestorationError(
            f"pixel_um: got {lens.pixel_um:g}, expected below half of the lens's cutoff period "
            f"{lens.cutoff_um:g}, so that some frequencies are noise alone; use a larger f-number "
            "or smaller pixels"
        )
    # divide by the smoothing's power; where that is weakest only rounding errors are left
    noise_band = beyond & (smoothing > 0.05)
    noise_band = noise_band if np.count_nonzero(noise_band) >= 16 else beyond
    noise_power = float(np.mean(power[noise_band]) / np.mean(smoothing[noise_band] ** 2))
    # Wiener filter S / (S + N) over the blur, with S + N the smoothed power spectrum
    even = ndimage.gaussian_filter(power, SMOOTH_BINS, mode="wrap")
    signal = np.maximum(even - noise_power * smoothing**2, 0.0)
    share = np.where(even > 0, signal / np.where(even > 0, even, 1.0), 0.0)
    blur = through * smoothing
    gain = np.minimum(1.0 / np.maximum(blur, 1e-6), MAX_GAIN)
    wiener = np.where(beyond, 0.0, share * gain)
    restored = [
        np.where(known, filter_by_transfer(s, wiener) + m, 0.0)
        for s, m in zip(slopes, means, strict=True)
    ]
    found = unit_vectors(np.stack([-restored[0], -restored[1], np.ones_like(restored[0])], axis=-1))
    found[~known] = (0.0, 0.0, 1.0)
    noise = math.sqrt(noise_power / power.size)
    applied = wiener * smoothing
    kept = noise * math.sqrt(float(np.mean(applied**2)))
    # of S = share (S + N) the filter keeps the share, and of N as much: the error is share N
    error = np.where(beyond, 0.0, np.sqrt(share) * gain) * smoothing
    return RestoredNormals(found.astype(normals.dtype), noise, kept, applied, error)


def _padded(values: Float64Array) -> Float64Array:
    return np.pad(values, PAD_PX, mode="symmetric")


def filter_by_transfer(values: Float64Array, transfer: Float64Array) -> Float64Array:
    """Multiply the waves of values by a transfer on a grid 64 pixels larger."""
    whole = fft.ifft2(fft.fft2(_padded(values), workers=-1) * transfer, workers=-1).real
    return whole[PAD_PX:-PAD_PX, PAD_PX:-PAD_PX]
