"""Convert DN to linear camera RGB with its variance from shot and read noise."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from capture.arrays import BoolArray, Float32Array
from capture.documents import Fault, FaultCollector
from capture.raw.frame import RawError, RawFrame, noise_profile

Demosaic = Literal["superpixel", "centered", "bilinear"]
LINEAR_UNIT = "fraction of full scale"

_COLOR_LETTERS = "RGB"
# bilinear interpolation of red and blue is separable; green is the mean of its four neighbors
_TRIANGLE_FILTER = (0.5, 1.0, 0.5)


@dataclass(frozen=True, slots=True)
class LinearImage:
    """Linear camera RGB: black-subtracted, not white-balanced."""

    rgb: Float32Array
    """(h, w, 3) fraction of full scale; negative values are kept."""
    variance: Float32Array
    """(h, w, 3) variance of ``rgb``."""
    valid: BoolArray
    """(h, w) False where a saturated pixel contributes."""
    unit: str = LINEAR_UNIT


def linear_rgb(
    frame: RawFrame,
    *,
    demosaic: Demosaic = "superpixel",
    gain: float | None = None,
    read_noise: float | None = None,
) -> LinearImage:
    """Return the linear camera RGB of a frame with its variance.

    Parameters
    ----------
    frame : RawFrame
        Frame of a sensor with a 2 x 2 color filter array.
    demosaic : {"superpixel", "centered", "bilinear"}
        "superpixel": one output pixel per 2 x 2 cell, (H/2, W/2), the two greens averaged, no
        correlation between pixels, but the colors of a pixel are up to one sensor pixel apart: a
        gradient of brightness appears as a tint. "centered": the same size, every color
        interpolated linearly to the middle of the cell, so that a gradient has no tint; the noise
        of neighboring pixels is slightly correlated. "bilinear": (H, W), missing colors from their
        neighbors, at the border from those that exist; the noise of neighboring pixels is
        correlated.
    gain : float, optional
        Calibrated conversion gain, electrons per DN; with ``read_noise`` instead of the file's
        own noise profile.
    read_noise : float, optional
        Calibrated read noise, electrons rms.

    Returns
    -------
    LinearImage
        (DN - black) / (white - black), camera RGB. The variance of one sensor pixel is
        scale * max(x, 0) + offset; with weights w the output has the variance sum(w**2 * var).

    Raises
    ------
    RawError
        For a MONO frame, and when neither the frame nor the caller gives a noise profile.

    Examples
    --------
    >>> cfa = np.full((4, 4), 612, np.uint16)
    >>> frame = RawFrame(cfa=cfa, pattern="RGGB", black=(512.0,) * 4, white=1512)
    >>> image = linear_rgb(frame, gain=2.0, read_noise=4.0)
    >>> image.rgb[0, 0].round(6).tolist(), (image.variance[0, 0] * 1e6).round(1).tolist()
    ([0.10000000149011612, 0.10000000149011612, 0.10000000149011612], [54.0, 27.0, 54.0])
    """
    checks = FaultCollector("linear_rgb", RawError)
    known = get_args(Demosaic)
    checks.check("demosaic", demosaic, demosaic in known, ", ".join(known))
    pair = (gain is None) == (read_noise is None)
    checks.check("gain, read_noise", (gain, read_noise), pair, "both or neither")
    checks.close()
    if frame.pattern == "MONO":
        fault = Fault("pattern", "MONO", "RGGB, BGGR, GRBG or GBRG")
        raise RawError("a monochrome frame has no color", where=frame.path, faults=[fault])
    x, variance = _pixels(frame, gain, read_noise)
    return interpolate(x, variance, frame.cfa < frame.white, frame.pattern, demosaic=demosaic)


def linear_mono(
    frame: RawFrame, *, gain: float | None = None, read_noise: float | None = None
) -> tuple[Float32Array, Float32Array, BoolArray]:
    """Return the linear values of a monochrome frame with their variance.

    Parameters
    ----------
    frame : RawFrame
        Frame of a sensor without color filters.
    gain, read_noise : float, optional
        As in `linear_rgb`.

    Returns
    -------
    values, variance : ndarray of float32, shape (H, W)
        (DN - black) / (white - black), negative values kept, and its variance.
    valid : ndarray of bool, shape (H, W)
        False where saturated.

    Raises
    ------
    RawError
        For a frame with color filters, and when the noise profile is missing.

    Examples
    --------
    >>> frame = RawFrame(cfa=np.full((2, 2), 612, np.uint16), pattern="MONO", black=(512.0,),
    ...                  white=1512)
    >>> linear_mono(frame, gain=2.0, read_noise=4.0)[0][0, 0].round(6).item()
    0.10000000149011612
    """
    checks = FaultCollector("linear_mono", RawError)
    pair = (gain is None) == (read_noise is None)
    checks.check("gain, read_noise", (gain, read_noise), pair, "both or neither")
    checks.check("pattern", frame.pattern, frame.pattern == "MONO", "MONO")
    checks.close()
    x, variance = _pixels(frame, gain, read_noise)
    return x, variance, frame.cfa < frame.white


def interpolate(
    values: Float32Array,
    variance: Float32Array,
    good: BoolArray,
    pattern: str,
    *,
    demosaic: Demosaic = "superpixel",
) -> LinearImage:
    """Interpolate the colors of a mosaic of linear values.

    Parameters
    ----------
    values, variance : ndarray of float32, shape (H, W)
        Linear values behind a 2 x 2 color filter array, and their variance; H and W are even.
    good : ndarray of bool, shape (H, W)
        False for values that must not be used; pixels to which they contribute are invalid.
    pattern : str
        "RGGB", "BGGR", "GRBG" or "GBRG".
    demosaic : {"superpixel", "centered", "bilinear"}
        As in `linear_rgb`.

    Returns
    -------
    LinearImage
        In the unit of `values`.
    """
    if demosaic == "superpixel":
        return _superpixel(pattern, values, variance, good)
    if demosaic == "centered":
        return _centered(pattern, values, variance, good)
    return _bilinear(pattern, values, variance, good)


def _pixels(
    frame: RawFrame, gain: float | None, read_noise: float | None
) -> tuple[Float32Array, Float32Array]:
    """Return value and variance of each sensor pixel, fractions of full scale."""
    x = np.empty(frame.cfa.shape, np.float32)
    variance = np.empty_like(x)
    for cell, black in enumerate(frame.black):
        step = 1 if frame.pattern == "MONO" else 2
        rows, columns = slice(cell // 2, None, step), slice(cell % 2, None, step)
        span = np.float32(1.0 / (frame.white - black))
        part = (frame.cfa[rows, columns].astype(np.float32) - np.float32(black)) * span
        if gain is not None and read_noise is not None:
            scale, offset = noise_profile(gain, read_noise, black=black, white=frame.white)
        elif frame.noise_profile is not None:
            scale, offset = frame.noise_profile
        else:
            fault = Fault("noise_profile", "none", "one in the file, or gain and read_noise")
            advice = "Calibrate the sensor and pass gain (electrons per DN) and read_noise."
            what = "the noise profile of this frame is missing"
            raise RawError(what, where=frame.path, faults=[fault], advice=advice)
        x[rows, columns] = part
        # below black the expected signal is zero, and shot noise is not negative
        variance[rows, columns] = np.float32(scale) * np.maximum(part, 0) + np.float32(offset)
    return x, variance


def _superpixel(
    pattern: str, x: Float32Array, variance: Float32Array, good: BoolArray
) -> LinearImage:
    height, width = x.shape[0] // 2, x.shape[1] // 2
    rgb = np.zeros((height, width, 3), np.float32)
    noise = np.zeros_like(rgb)
    valid = np.ones((height, width), bool)
    for cell, letter in enumerate(pattern):
        part = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        band = _COLOR_LETTERS.index(letter)
        weight = np.float32(1.0 / pattern.count(letter))
        rgb[..., band] += weight * x[part]
        noise[..., band] += weight**2 * variance[part]
        valid &= good[part]
    return LinearImage(rgb, noise, valid)


def _centered(
    pattern: str, x: Float32Array, variance: Float32Array, good: BoolArray
) -> LinearImage:
    """Interpolate every color to the middle of its 2 x 2 cell, linearly from its own sites."""
    height, width = x.shape[0] // 2, x.shape[1] // 2
    rgb = np.zeros((height, width, 3), np.float32)
    noise = np.zeros_like(rgb)
    bad = np.zeros((height, width), bool)
    for cell, letter in enumerate(pattern):
        part = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        ahead = (cell // 2 == 0, cell % 2 == 0)
        band = _COLOR_LETTERS.index(letter)
        weight = np.float32(1.0 / pattern.count(letter))
        rgb[..., band] += weight * _shift_to_cell_center(x[part], ahead, power=1)
        noise[..., band] += weight**2 * _shift_to_cell_center(variance[part], ahead, power=2)
        bad |= _shift_to_cell_center((~good[part]).astype(np.float32), ahead, power=1) > 0
    return LinearImage(rgb, noise, ~bad)


def _shift_to_cell_center(
    plane: Float32Array, ahead: tuple[bool, bool], *, power: int
) -> Float32Array:
    """Shift a plane by a quarter of its pitch along both axes, with weights to ``power``.

    At the border, where the neighbor is missing, the plane's own value is used.
    """
    # Sites of one color are two pixels apart and the cell's middle half a pixel away, a quarter of
    # the pitch: linear weights 3/4 and 1/4, squared for variances.
    near, far = np.float32(0.75**power), np.float32(0.25**power)
    for axis, forward in enumerate(ahead):
        lines = plane.T if axis else plane
        shifted = lines.copy()
        if forward:
            shifted[:-1] = near * lines[:-1] + far * lines[1:]
        else:
            shifted[1:] = near * lines[1:] + far * lines[:-1]
        plane = shifted.T if axis else shifted
    return plane


def _bilinear(
    pattern: str, x: Float32Array, variance: Float32Array, good: BoolArray
) -> LinearImage:
    rgb = np.empty((*x.shape, 3), np.float32)
    noise = np.empty_like(rgb)
    valid = np.ones(x.shape, bool)
    bad = ~good
    for band, letter in enumerate(_COLOR_LETTERS):
        mask = np.zeros(x.shape, np.float32)
        for cell in (c for c in range(4) if pattern[c] == letter):
            mask[cell // 2 :: 2, cell % 2 :: 2] = 1
        spread = _interpolate_green if letter == "G" else _interpolate_sparse
        # weights outside the image are redistributed to the others: a flat field stays flat
        total = spread(mask, power=1)
        rgb[..., band] = spread(x * mask, power=1) / total
        noise[..., band] = spread(variance * mask, power=2) / total**2
        valid &= spread(bad * mask, power=1) == 0
    return LinearImage(rgb, noise, valid)


def _interpolate_sparse(plane: Float32Array, *, power: int) -> Float32Array:
    """Convolve a red or blue plane (zero elsewhere) with the triangle's ``power``, separably."""
    side, center = (np.float32(w**power) for w in _TRIANGLE_FILTER[:2])
    rows = center * plane
    rows[1:] += side * plane[:-1]
    rows[:-1] += side * plane[1:]
    both = center * rows
    both[:, 1:] += side * rows[:, :-1]
    both[:, :-1] += side * rows[:, 1:]
    return both


def _interpolate_green(plane: Float32Array, *, power: int) -> Float32Array:
    """Convolve the green plane: itself at green sites, else a quarter of each neighbor."""
    weight = np.float32(0.25**power)
    spread = plane.copy()
    spread[1:] += weight * plane[:-1]
    spread[:-1] += weight * plane[1:]
    spread[:, 1:] += weight * plane[:, :-1]
    spread[:, :-1] += weight * plane[:, 1:]
    return spread
