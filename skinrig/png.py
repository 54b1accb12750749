"""PNG images and color scales without an imaging library."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray


def encode(image: NDArray[np.generic]) -> bytes:
    r"""Encode an image as PNG.

    Parameters
    ----------
    image
        (H, W) gray or (H, W, 3) RGB, uint8 or uint16, row 0 at the top.

    Returns
    -------
    bytes
        The same bytes for the same image, on every machine with the same zlib.

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
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise ValueError(f"image: got shape {pixels.shape}, expected (H, W) or (H, W, 3)")
    height, width = pixels.shape[:2]
    if not height or not width:
        raise ValueError(f"image: got shape {pixels.shape}, expected at least one pixel")
    depth = 8 * pixels.dtype.itemsize
    color_type = 0 if pixels.ndim == 2 else 2
    big_endian = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">")))
    row_bytes = big_endian.reshape(height, -1).view(np.uint8).reshape(height, -1)
    rows = np.zeros((height, row_bytes.shape[1] + 1), np.uint8)  # column 0: no filter
    rows[:, 1:] = row_bytes

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
        + chunk(b"IEND", b"")
    )


def data_uri(image: NDArray[np.generic]) -> str:
    """Return the image as a ``data:`` address for a self-contained page."""
    return "data:image/png;base64," + base64.b64encode(encode(image)).decode("ascii")


def srgb8(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
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
    curved = np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055
    )
    return np.round(255.0 * curved).astype(np.uint8)


def colorize(
    values: NDArray[np.floating],
    low: float,
    high: float,
    *,
    scale: str = "viridis",
    valid: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
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
    from matplotlib import colormaps

    table = np.round(255 * colormaps[scale](np.arange(256))[:, :3]).astype(np.uint8)
    values = np.asarray(values, np.float64)
    span = high - low if high > low else 1.0
    finite = np.isfinite(values)
    position = np.clip((np.where(finite, values, low) - low) / span, 0.0, 1.0)
    image = table[np.round(255 * position).astype(np.intp)]
    shown = finite if valid is None else finite & np.asarray(valid, bool)
    image[~shown] = 128
    return image
