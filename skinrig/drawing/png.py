"""PNG images and color scales."""

import base64
import io

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import BoolArray, Float64Array, FloatArray, UInt8Array

SCALE_CLASSES = {"viridis": "viridis", "magma": "magma", "RdBu_r": "diverging", "gray": "grays"}
"""matplotlib's color maps that maps are shown by, and what a style sheet calls them."""
INVALID_GRAY = 128
"""Of pixels without a value."""


def encode(image: NDArray[np.generic], *, quick: bool = False) -> bytes:
    r"""Encode an image as PNG.

    Parameters
    ----------
    image
        (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGB and opacity, uint8 or uint16, row 0 at the top.
    quick
        Compress less: for large textures, in a third of the time.

    Returns
    -------
    bytes
        Without color chunks or other metadata; the same bytes for the same image and OpenCV.

    Raises
    ------
    ValueError
        When shape or dtype is another.

    Examples
    --------
    >>> encode(np.zeros((2, 2), np.uint8))[:8]
    b'\x89PNG\r\n\x1a\n'
    """
    pixels = np.asarray(image)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image: got dtype {pixels.dtype}, expected uint8 or uint16")
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise ValueError(
            f"image: got shape {pixels.shape}, expected (H, W), (H, W, 3) or (H, W, 4)"
        )
    if not pixels.size:
        raise ValueError(f"image: got shape {pixels.shape}, expected at least one pixel")
    import cv2

    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]  # OpenCV has blue first
    level = 4 if quick else 9
    stored = np.ascontiguousarray(pixels)
    return cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()


def encode_indexed(index: UInt8Array, palette: UInt8Array) -> bytes:
    r"""Encode an image of a color scale as PNG with a palette.

    Parameters
    ----------
    index
        (H, W), uint8: which color each pixel has.
    palette
        (N, 3), uint8, at most 256 colors.

    Returns
    -------
    bytes
        A third of what the same picture takes as RGB, before compression.

    Raises
    ------
    ValueError
        When a shape or dtype is another, or an index has no color.

    Examples
    --------
    >>> black_and_white = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
    >>> encode_indexed(np.eye(4, dtype=np.uint8), black_and_white)[:8]
    b'\x89PNG\r\n\x1a\n'
    """
    index, palette = np.asarray(index), np.asarray(palette)
    if index.dtype != np.uint8 or index.ndim != 2 or not index.size:
        raise ValueError(
            f"index: got dtype {index.dtype}, shape {index.shape}, expected uint8 (H, W) of at "
            "least one pixel"
        )
    if palette.dtype != np.uint8 or palette.ndim != 2 or palette.shape[1] != 3:
        raise ValueError(
            f"palette: got dtype {palette.dtype}, shape {palette.shape}, expected uint8 (N, 3)"
        )
    if len(palette) > 256 or int(index.max()) >= len(palette):
        raise ValueError(
            f"palette: got {len(palette)} colors for indices up to {int(index.max())}, expected "
            "one for each index and at most 256"
        )
    from PIL import Image

    image = Image.frombytes("P", index.shape[::-1], index.tobytes())
    image.putpalette(palette.tobytes())
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True)
    return file.getvalue()


def address(file: bytes) -> str:
    """Return a PNG file's bytes as a ``data:`` address."""
    return "data:image/png;base64," + base64.b64encode(file).decode("ascii")


def srgb8(linear: FloatArray) -> UInt8Array:
    """Apply the sRGB curve (IEC 61966-2-1) and round to 8 bits.

    Parameters
    ----------
    linear
        Linear values of any shape; outside [0, 1] and NaN are shown at the nearest end,
        for display only.

    Returns
    -------
    ndarray of uint8
        The same shape.
    """
    value = np.clip(np.nan_to_num(np.asarray(linear, np.float64)), 0.0, 1.0)
    return np.round(255.0 * srgb_curve(value)).astype(np.uint8)


def srgb_curve(linear: FloatArray) -> Float64Array:
    """Return sRGB's curve of values in [0, 1], IEC 61966-2-1.

    Examples
    --------
    >>> srgb_curve(np.array([0.0, 0.0031308, 1.0])).round(4).tolist()
    [0.0, 0.0404, 1.0]
    """
    value = np.asarray(linear, np.float64)
    power = 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055
    return np.where(value <= 0.0031308, 12.92 * value, power)


def colorize(
    values: FloatArray,
    low: float,
    high: float,
    *,
    scale: str = "viridis",
    valid: BoolArray | None = None,
) -> UInt8Array:
    """Map values to a perceptually uniform color scale.

    Parameters
    ----------
    values
        (H, W).
    low, high
        The ends of the scale, in the unit of ``values``; beyond them the end's color shows.
    scale
        A matplotlib color map, such as "viridis" or the diverging "RdBu_r".
    valid
        (H, W); other pixels, and NaN, become mid gray.

    Returns
    -------
    ndarray of uint8
        (H, W, 3).
    """
    table = palette(scale, 256)
    position, shown = _position(values, low, high, valid)
    image = table[np.round(255 * position).astype(np.intp)]
    image[~shown] = INVALID_GRAY
    return image


def palette(scale: str, colors: int) -> UInt8Array:
    """Return colors spread evenly over a matplotlib color map, (colors, 3), uint8."""
    from matplotlib import colormaps

    return np.round(255 * colormaps[scale](np.linspace(0.0, 1.0, colors))[:, :3]).astype(np.uint8)


def encode_scalar(
    values: FloatArray,
    low: float,
    high: float,
    *,
    scale: str = "viridis",
    valid: BoolArray | None = None,
    levels: int = 128,
) -> bytes:
    """Encode a map by a color scale of few colors as PNG with a palette.

    Parameters
    ----------
    values, low, high, scale, valid
        As for `colorize`.
    levels
        Colors of the scale, 2 to 255: the picture tells values to one part in so many of the
        scale; its own color is for pixels without a value.

    Returns
    -------
    bytes
        A PNG file.
    """
    position, shown = _position(values, low, high, valid)
    index = np.round((levels - 1) * position).astype(np.uint8)
    index[~shown] = levels
    gray = np.full((1, 3), INVALID_GRAY, np.uint8)
    return encode_indexed(index, np.concatenate([palette(scale, levels), gray]))


def _position(
    values: FloatArray, low: float, high: float, valid: BoolArray | None
) -> tuple[Float64Array, BoolArray]:
    """Return where values lie on a scale, in [0, 1], and which are shown."""
    values = np.asarray(values, np.float64)
    span = high - low if high > low else 1.0
    finite = np.isfinite(values)
    position = np.clip((np.where(finite, values, low) - low) / span, 0.0, 1.0)
    return position, finite if valid is None else finite & np.asarray(valid, bool)
