"""Blur images by a perfect lens: diffraction, defocus and the pixel aperture, as an OTF.

The pupil is a circle, light of each wavelength is incoherent, and the spectrum combines lamp and
camera. Aberrations are not modeled: a real macro lens at f/16 is nearly free of them in the center.

References
----------
Hopkins 1955, doi:10.1098/rspa.1955.0158 (OTF of a defocused circular pupil).
Goodman, Introduction to Fourier Optics, section 7.4.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from capture.rig import View
from model import spectra
from rigsim.arrays import Float32Array, Float64Array

SPECTRUM_NODES: Final = 9
"""Number of wavelengths that sample the spectrum."""

DEPTH_SLICE_MM: Final = 0.25
"""Distance of the depths with an exact OTF; images in between are interpolated."""

MAX_FLAT_DEPTH_RANGE_MM: Final = 0.15
"""Largest range of depths that one slice represents."""

OTF_NODES: Final = 513
"""Nodes of the radial OTF."""

FFT_WORKERS: Final = 2


class BlurError(ValueError):
    """An unusable lens or image."""


@dataclass(frozen=True, slots=True)
class Lens:
    """A perfect lens with its sensor, and the spectrum of its light."""

    working_f_number: float
    """Image distance over the diameter of the pupil, > 0."""
    distance_mm: float
    """From the pupil to the plane in focus, mm, > 0."""
    magnification: float
    """Size of the image over that of the subject, > 0."""
    pixel_um: float
    """Side of a pixel with full fill factor, um, > 0."""
    wavelengths_nm: tuple[float, ...]
    """Wavelengths that sample the spectrum."""
    weights: tuple[float, ...]
    """Their weights in the signal, sum 1."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("working_f_number", "distance_mm", "magnification", "pixel_um"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise BlurError(f"{name}: got {value}, expected > 0")
        if len(self.wavelengths_nm) != len(self.weights) or not self.weights:
            raise BlurError(
                f"weights: got {len(self.weights)}, expected {len(self.wavelengths_nm)}, not none"
            )
        if not math.isclose(sum(self.weights), 1.0, rel_tol=1e-9) or min(self.weights) < 0.0:
            raise BlurError(f"weights: got {self.weights}, expected >= 0 with sum 1")

    @property
    def pixel_on_subject_um(self) -> float:
        """Side of a pixel on the subject, um."""
        return self.pixel_um / self.magnification

    @property
    def mean_wavelength_nm(self) -> float:
        """Mean wavelength of the signal, nm."""
        return float(np.dot(self.wavelengths_nm, self.weights))

    @property
    def cutoff_period_um(self) -> float:
        """Cutoff period of the lens on the subject at the mean wavelength, um."""
        return self.mean_wavelength_nm * 1e-3 * self.working_f_number / self.magnification

    def aberration_um(self, depth_mm: float) -> float:
        """Return the wavefront error at the pupil's rim for a subject off focus, um."""
        aperture = self.working_f_number / self.magnification
        return 1e3 * depth_mm / (8.0 * aperture**2)

    def otf(self, per_mm: ArrayLike, *, depth_mm: float = 0.0) -> Float64Array:
        """Return the lens's OTF, without pixels.

        Parameters
        ----------
        per_mm
            Spatial frequencies on the subject, cycles per mm, any shape.
        depth_mm
            Distance of the subject from the plane in focus, mm, either sign.

        Returns
        -------
        ndarray
            Same shape, 1 at frequency 0; negative where defocus reverses the contrast.
        """
        frequency = np.abs(np.asarray(per_mm, np.float64))
        total = np.zeros(frequency.shape)
        reach = self.working_f_number / self.magnification * 1e-6  # nm to mm
        nodes = np.linspace(0.0, 2.0, OTF_NODES)
        for wavelength, weight in zip(self.wavelengths_nm, self.weights, strict=True):
            waves = 1e3 * self.aberration_um(depth_mm) / wavelength
            curve = _defocused_circle(nodes, waves)
            total += weight * np.interp(2.0 * frequency * reach * wavelength, nodes, curve)
        return total


def focused_lens(view: View, illuminant: str) -> Lens:
    """Return the lens of a view, focused at the view's distance.

    Parameters
    ----------
    view
        The camera; its f-number is that of the lens focused at infinity.
    illuminant
        Name of the light's spectrum.

    Returns
    -------
    Lens
        A monochrome sensor's signal is the mean of the three channels.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> lens = focused_lens(load_rig("gradient").view("cam"), "LED-B3")
    >>> round(lens.working_f_number, 2), round(lens.cutoff_period_um, 1)
    (30.67, 17.9)
    """
    magnification = view.focal_mm / view.focus_distance_mm
    wavelength = spectra.WAVELENGTH_NM
    signal = spectra.camera_sensitivity(view.spectral_sensitivity).mean(axis=1)
    signal = np.maximum(signal * spectra.illuminant(illuminant), 0.0)
    share = np.cumsum(signal) / signal.sum()
    # wavelengths at the centers of equal parts of the signal
    nodes = np.interp((np.arange(SPECTRUM_NODES) + 0.5) / SPECTRUM_NODES, share, wavelength)
    return Lens(
        view.f_number * (1.0 + magnification),
        view.focus_distance_mm,
        magnification,
        view.pixel_um,
        tuple(float(node) for node in nodes),
        (1.0 / SPECTRUM_NODES,) * SPECTRUM_NODES,
    )


def blur_images(
    images: Float32Array,
    lens: Lens,
    *,
    depth_mm: Float32Array | None = None,
    subpixels: int = 1,
    averaged: bool = False,
) -> Float32Array:
    """Blur images by the lens and the pixel aperture.

    Parameters
    ----------
    images
        Point samples on the subject, shape (K, H s, W s): s per pixel's row and column, evenly
        spaced about its center. The image is mirrored at its border.
    lens
        The lens.
    depth_mm
        Height of each sample above the plane in focus, mm, shape (H s, W s); None: in focus.
    subpixels
        The s above.
    averaged
        Whether the samples are means over pixels already, so that only the lens blurs.

    Returns
    -------
    ndarray of float32
        Shape (K, H, W).
    """
    if images.ndim != 3 or images.shape[1] % subpixels or images.shape[2] % subpixels:
        raise BlurError(
            f"images: got shape {images.shape}, expected (K, H s, W s) with s = {subpixels}"
        )
    count, rows, columns = images.shape
    pixel_mm = 1e-3 * lens.pixel_on_subject_um
    border = subpixels * BORDER_PX
    full = tuple(
        subpixels * scipy.fft.next_fast_len(-(-(n + 2 * border) // subpixels), real=True)
        for n in (rows, columns)
    )
    pad = [(border, full[0] - rows - border), (border, full[1] - columns - border)]
    coarse = (full[0] // subpixels, full[1] // subpixels)
    out = np.empty((count, rows // subpixels, columns // subpixels), np.float32)
    slices = _slices(depth_mm)
    fy = np.fft.fftfreq(coarse[0], pixel_mm)
    fx = np.fft.rfftfreq(coarse[1], pixel_mm)
    radius = np.hypot(fy[:, None], fx[None, :])
    pixel = np.sinc(fy * pixel_mm)[:, None] * np.sinc(fx * pixel_mm)[None, :]
    if averaged:
        pixel = np.ones_like(pixel)
    # offset of the samples' grid before the pixels' centers, in pixels
    offset = 0.5 * (1.0 - 1.0 / subpixels)
    turn = np.exp(2j * np.pi * offset * pixel_mm * fy)[:, None] * np.exp(
        2j * np.pi * offset * pixel_mm * fx
    )
    filters = [
        (lens.otf(radius, depth_mm=depth) * pixel * (turn if subpixels > 1 else 1.0)).astype(
            np.complex64 if subpixels > 1 else np.float32
        )
        for depth, _ in slices
    ]
    for k in range(count):
        spectrum = np.zeros((coarse[0], coarse[1] // 2 + 1), np.complex64)
        for factor, (_, share) in zip(filters, slices, strict=True):
            part = images[k] if share is None else images[k] * share
            found = scipy.fft.rfft2(np.pad(part, pad, mode="reflect"), workers=FFT_WORKERS)
            spectrum += factor * _fold_spectrum(found, coarse)
        picture = scipy.fft.irfft2(spectrum, coarse, workers=FFT_WORKERS)
        out[k] = picture[BORDER_PX : BORDER_PX + out.shape[1], BORDER_PX : BORDER_PX + out.shape[2]]
    if subpixels > 1:
        out /= np.float32(subpixels**2)
    return out


BORDER_PX: Final = 12
"""Mirrored pixels around an image while it is blurred; the lens's reach is shorter."""


def _fold_spectrum(
    spectrum: NDArray[np.complex64], shape: tuple[int, int]
) -> NDArray[np.complex64]:
    """Return the frequencies that pixels can represent; the lens transmits no others."""
    rows, columns = shape
    if spectrum.shape == (rows, columns // 2 + 1):
        return spectrum
    out = np.empty((rows, columns // 2 + 1), np.complex64)
    top = (rows + 1) // 2
    out[:top] = spectrum[:top, : columns // 2 + 1]
    out[top:] = spectrum[spectrum.shape[0] - (rows - top) :, : columns // 2 + 1]
    return out


def _slices(depth_mm: Float32Array | None) -> list[tuple[float, Float32Array | None]]:
    """Return depths with each sample's weight in them; None is a weight of 1."""
    if depth_mm is None:
        return [(0.0, None)]
    low, high = float(depth_mm.min()), float(depth_mm.max())
    if not math.isfinite(high - low):
        raise BlurError("depth_mm: got values that are not finite, expected finite ones")
    if high - low <= MAX_FLAT_DEPTH_RANGE_MM:
        return [(0.5 * (low + high), None)]
    count = math.ceil((high - low) / DEPTH_SLICE_MM) + 1
    nodes = np.linspace(low, high, count)
    place = (depth_mm - np.float32(low)) * np.float32((count - 1) / (high - low))
    return [
        (float(node), np.maximum(np.float32(1.0) - np.abs(place - np.float32(k)), 0.0))
        for k, node in enumerate(nodes)
    ]


@cache
def _pupil_quadrature() -> tuple[Float64Array, Float64Array]:
    """Return nodes and weights over the pupil's height; their eigenvalues take 10 ms."""
    return np.polynomial.legendre.leggauss(96)


def _defocused_circle(nodes: Float64Array, waves: float) -> Float64Array:
    """Return the OTF of a circle at frequencies 0 to 2 (cutoff) with a defocus in waves."""
    # Hopkins 1955: the OTF is the integral of the phase difference cos(b x) over the overlap of two
    # unit pupils whose centers are one frequency apart. Over x from 0 to the overlap's half width
    # at
    # height y it is sin(b width) / b = width sinc(b width / pi).
    x, w = _pupil_quadrature()
    half = 0.5 * nodes
    edge = np.sqrt(np.maximum(1.0 - half**2, 0.0))
    # the substitution y = edge sin(t) removes the square-root endpoint singularity
    t = 0.25 * np.pi * (x + 1.0)
    y = edge[:, None] * np.sin(t)
    width = np.maximum(np.sqrt(np.maximum(1.0 - y**2, 0.0)) - half[:, None], 0.0)
    b = 4.0 * np.pi * waves * nodes[:, None]
    part = width * np.sinc(b * width / np.pi)
    value = (4.0 / np.pi) * edge * ((part * np.cos(t)) @ w) * 0.25 * np.pi
    return np.asarray(value / value[0])
