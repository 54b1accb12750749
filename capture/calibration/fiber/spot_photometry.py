"""Photometry of small bright spots: merged exposures, centroids, and sums over apertures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.arrays import BoolArray, Float32Array, Float64Array
from capture.raw import RawFrame

# background pixels that deviate more than this belong to something else
BACKGROUND_CLIP_SIGMAS = 3.0
MIN_RING_PIXELS = 8
# largest deviation of the background, the wings of bright spots, from a plane
BACKGROUND_PLANE_MISFIT = 0.02
MAX_CENTERING_STEPS = 12
CENTERING_TOL_PX = 0.01
RING_RADII = (1.3, 1.8)  # inner and outer radius of the background ring, relative to the disc's


@dataclass(frozen=True, slots=True, eq=False)
class SpotImage:
    """One linear exposure of spots.

    Attributes
    ----------
    signal : ndarray of float32, shape (H, W)
        Fraction of full scale, dark subtracted; negative values are kept.
    variance : ndarray of float32, shape (H, W)
    valid : ndarray of bool, shape (H, W)
        False where saturated.
    amount_s : float
        Exposure time x level of the lights, s, > 0.
    reading_deg : float
        Reading of the analyzer, degrees.
    """

    signal: Float32Array
    variance: Float32Array
    valid: BoolArray
    amount_s: float
    reading_deg: float

    def __post_init__(self) -> None:
        """Check the fields against each other."""
        shape = self.signal.shape
        if len(shape) != 2 or self.variance.shape != shape or self.valid.shape != shape:
            raise ValueError(
                f"Shot: got signal {shape}, variance {self.variance.shape} and valid"
                f" {self.valid.shape}, expected one shape (H, W)"
            )
        if not (0 < self.amount_s < np.inf and np.isfinite(self.reading_deg)):
            raise ValueError(
                f"Shot: got amount {self.amount_s} s and reading {self.reading_deg} degrees,"
                " expected an amount > 0 and a finite angle"
            )


@dataclass(frozen=True, slots=True, eq=False)
class RateImage:
    """Several exposures of one scene as one image.

    Attributes
    ----------
    rate, variance : ndarray of float32, shape (H, W)
        Signal per second at level 1; a lower bound where every exposure is saturated.
    valid : ndarray of bool, shape (H, W)
        False where every exposure is saturated.
    """

    rate: Float32Array
    variance: Float32Array
    valid: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Flux:
    """Sums over the spots of one exposure.

    Attributes
    ----------
    value, variance : ndarray of float64, shape (L,)
        Signal x px^2 above the local background; 0 and 0 where not `whole`.
    saturated : ndarray of bool, shape (L,)
        A pixel of the aperture is saturated: `value` is a lower bound.
    whole : ndarray of bool, shape (L,)
        Aperture and background are inside the image.
    """

    value: Float64Array
    variance: Float64Array
    saturated: BoolArray
    whole: BoolArray


def make_spot_image(
    frame: RawFrame,
    *,
    amount_s: float,
    reading_deg: float,
    dark: Float32Array | float = 0.0,
    dark_variance: float = 0.0,
    flat: NDArray | float = 1.0,
) -> SpotImage:
    """Return a linear exposure of a monochrome camera, dark-subtracted and flat-fielded.

    Parameters
    ----------
    frame : RawFrame
        "MONO", with a noise profile.
    amount_s, reading_deg
        As in `SpotImage`.
    dark : ndarray of float32, shape (H, W), or float
        Signal of a frame without light above black, fraction of full scale.
    dark_variance : float
        Variance of `dark` per pixel.
    flat : ndarray, shape (H, W), or float
        Relative response of the pixels, 1 in the middle: signals are divided by it.

    Raises
    ------
    ValueError
        If the frame is not monochrome or has no noise profile.
    """
    if frame.pattern != "MONO" or frame.noise_profile is None:
        raise ValueError(
            f"frame: got pattern {frame.pattern!r} and noise profile {frame.noise_profile}, "
            "expected a monochrome frame with a noise profile"
        )
    span = np.float32(1.0 / (frame.white - frame.black[0]))
    x = (frame.cfa.astype(np.float32) - np.float32(frame.black[0])) * span
    scale, offset = frame.noise_profile
    response = np.asarray(flat, np.float32)
    variance = np.float32(scale) * np.maximum(x, 0) + np.float32(offset + dark_variance)
    return SpotImage(
        np.asarray((x - np.asarray(dark, np.float32)) / response, np.float32),
        np.asarray(variance / response**2, np.float32),
        frame.cfa < frame.white,
        amount_s,
        reading_deg,
    )


def merge_spot_images(shots: Sequence[SpotImage]) -> RateImage:
    """Merge exposures of one scene, each pixel from those in which it is not saturated.

    Parameters
    ----------
    shots : sequence of Shot
        Exposures at one reading of the analyzer.

    Examples
    --------
    >>> dim = SpotImage(np.full((1, 1), 0.2, np.float32), np.ones((1, 1), np.float32),
    ...            np.ones((1, 1), bool), 0.1, 0.0)
    >>> bright = SpotImage(np.ones((1, 1), np.float32), np.ones((1, 1), np.float32),
    ...               np.zeros((1, 1), bool), 1.0, 0.0)
    >>> round(float(merge_spot_images([dim, bright]).rate[0, 0]), 6)
    2.0
    """
    if not shots:
        raise ValueError("shots: got none, expected at least one")
    signal = np.zeros(shots[0].signal.shape, np.float32)
    variance, amount = np.zeros_like(signal), np.zeros_like(signal)
    for part in shots:
        signal += np.where(part.valid, part.signal, 0)
        variance += np.where(part.valid, part.variance, 0)
        amount += np.float32(part.amount_s) * part.valid
    valid = amount > 0
    if not valid.all():
        # where all are saturated the shortest exposure gives the highest lower bound
        short = min(shots, key=lambda part: part.amount_s)
        signal[~valid], variance[~valid] = short.signal[~valid], short.variance[~valid]
        amount[~valid] = short.amount_s
    return RateImage(signal / amount, variance / amount**2, valid)


def measure_centroids(
    image: RateImage, pixels: Float64Array, *, aperture_px: Float64Array
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return the intensity-weighted centroids of spots.

    Parameters
    ----------
    image : RateImage
    pixels : ndarray of float64, shape (L, 2)
        Approximate positions; NaN: none.
    aperture_px : ndarray of float64, shape (L,)
        Radius of the disc that contains each spot, px.

    Returns
    -------
    middle : ndarray of float64, shape (L, 2)
        NaN where a spot is cut by the image's border or has no light.
    stderr : ndarray of float64, shape (L,)
        Standard error of a coordinate by the noise, px; NaN likewise.
    saturated : ndarray of bool, shape (L,)
    """
    middle = np.full(pixels.shape, np.nan)
    stderr = np.full(len(pixels), np.nan)
    saturated = np.zeros(len(pixels), bool)
    for k, start in enumerate(pixels):
        at = start
        for _step in range(MAX_CENTERING_STEPS):
            window = _window(at, image.rate.shape, float(aperture_px[k]), pixels)
            if window is None:
                break
            rows, columns, weight, around, dx, dy = window
            noise = image.variance[rows, columns].astype(np.float64)
            values = image.rate[rows, columns].astype(np.float64)
            level, _ = _background(values, noise, around, dx, dy)
            light = weight * (values - level)
            total = light.sum()
            if not total > BACKGROUND_CLIP_SIGMAS * np.sqrt(np.sum(weight**2 * noise)):
                break
            step = np.array([np.sum(light * dx), np.sum(light * dy)]) / total
            at = at + step
            if not np.hypot(*(at - start)) <= aperture_px[k]:
                break
            if np.hypot(*step) < CENTERING_TOL_PX:
                middle[k] = at
                square = 0.5 * (dx**2 + dy**2)
                bent = BACKGROUND_PLANE_MISFIT * np.abs(np.sum(weight * level)) * aperture_px[k] / 4
                stderr[k] = np.hypot(np.sqrt(np.sum(weight**2 * noise * square)), bent) / total
                saturated[k] = not image.valid[rows, columns][weight > 0].all()
                break
    return middle, stderr, saturated


def measure_flux(part: SpotImage, pixels: Float64Array, *, aperture_px: Float64Array) -> Flux:
    """Sum the light of spots over discs, above the median of rings around them.

    Parameters
    ----------
    part : Shot
    pixels : ndarray of float64, shape (L, 2)
        Centers of the spots, px; NaN: none.
    aperture_px : ndarray of float64, shape (L,)
        Radius of the discs; the rings extend from 1.3 to 1.8 of it.
    """
    count = len(pixels)
    value, variance = np.zeros(count), np.zeros(count)
    saturated, whole = np.zeros(count, bool), np.zeros(count, bool)
    for k, at in enumerate(pixels):
        window = _window(at, part.signal.shape, float(aperture_px[k]), pixels)
        if window is None:
            continue
        rows, columns, weight, around, dx, dy = window
        values = part.signal[rows, columns].astype(np.float64)
        noise = part.variance[rows, columns].astype(np.float64)
        level, level_variance = _background(values, noise, around, dx, dy)
        value[k] = np.sum(weight * (values - level))
        variance[k] = np.sum(weight**2 * noise) + weight.sum() ** 2 * level_variance
        variance[k] += (BACKGROUND_PLANE_MISFIT * np.sum(weight * level)) ** 2
        saturated[k] = not part.valid[rows, columns][weight > 0].all()
        whole[k] = True
    return Flux(value, variance, saturated, whole)


def encircled_energy(aperture_px: ArrayLike, airy_px: float) -> Float64Array:
    """Return the fraction of a spot's light that `measure_flux` collects for a perfect lens.

    Parameters
    ----------
    aperture_px : array_like
        Radius of the disc, px, large compared with the spot and with `airy_px`.
    airy_px : float
        Wavelength times the working f-number, px.

    Notes
    -----
    Far out, the light beyond r decreases as 0.2026 airy_px / r, the mean over the Airy rings (Born
    and Wolf, Principles of Optics, section 8.5.2). Part of it is beyond the disc, part in the ring
    from which the background is taken.

    Examples
    --------
    >>> encircled_energy([20.0, 40.0], 3.0).round(4).tolist()
    [0.9654, 0.9827]
    """
    beyond = 2 / np.pi**2 * airy_px / np.asarray(aperture_px, np.float64)
    near, far = RING_RADII
    in_ring = (1 / near - 1 / far) / (far**2 - near**2)
    return 1.0 - (1.0 + in_ring) * beyond


def _window(
    at: Float64Array, shape: tuple[int, ...], aperture_px: float, every: Float64Array
) -> tuple[slice, slice, Float64Array, BoolArray, Float64Array, Float64Array] | None:
    """Return slices, weights of the disc, the ring, and offsets; None for a cut spot."""
    if not np.isfinite(at).all():
        return None
    near, outer = RING_RADII[0] * aperture_px, RING_RADII[1] * aperture_px
    low = np.floor(at - outer).astype(int)
    high = np.ceil(at + outer).astype(int) + 1
    if (low < 0).any() or high[0] > shape[1] or high[1] > shape[0]:
        return None
    dx, dy = np.meshgrid(np.arange(low[0], high[0]) - at[0], np.arange(low[1], high[1]) - at[1])
    distance = np.hypot(dx, dy)
    weight = np.clip(aperture_px + 0.5 - distance, 0.0, 1.0)
    around = (distance > near) & (distance < outer)
    gaps = np.hypot(*(every - at).T)
    for other in every[(gaps > aperture_px) & (gaps < outer + near)] - at:
        around &= np.hypot(dx - other[0], dy - other[1]) > near
    if around.sum() < MIN_RING_PIXELS:
        return None
    rows, columns = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    return rows, columns, weight, around, dx, dy


def _background(
    values: Float64Array, noise: Float64Array, around: BoolArray, dx: Float64Array, dy: Float64Array
) -> tuple[Float64Array, float]:
    """Fit a plane through a ring without outliers; return it and the variance at its center."""
    basis = np.stack([np.ones(int(around.sum())), dx[around], dy[around]], axis=1)
    ring, sigma = values[around], np.sqrt(noise[around])
    near = np.abs(ring - np.median(ring)) <= BACKGROUND_CLIP_SIGMAS * sigma
    plane = np.array([float(np.median(ring)), 0.0, 0.0])
    for _ in range(2):
        if near.sum() < MIN_RING_PIXELS:
            break
        plane = np.linalg.lstsq(basis[near], ring[near], rcond=None)[0]
        near = np.abs(ring - basis @ plane) <= BACKGROUND_CLIP_SIGMAS * sigma
    level = plane[0] + plane[1] * dx + plane[2] * dy
    return level, float(noise[around].mean() / max(near.sum(), 1))
