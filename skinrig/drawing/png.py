"""PNG images and color scales without an imaging library."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import BoolArray, Float64Array, FloatArray, UInt8Array

SCALES = {"viridis": "viridis", "magma": "magma", "RdBu_r": "diverging", "gray": "grays"}
"""matplotlib's color maps that maps are shown by, and what a style sheet calls them."""
GRAY = 128
"""Of pixels without a value."""


def encode(image: NDArray[np.generic], *, quick: bool = False) -> bytes:
    r"""Encode an image as PNG.

    Parameters
    ----------
    image
        (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGB and opacity, uint8 or uint16, row 0 at the top.
    quick
        Take the first filter that is good enough instead of the smallest file: for large textures,
        a tenth of the time and a few percent more bytes.

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
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)):
        raise ValueError(
            f"image: got shape {pixels.shape}, expected (H, W), (H, W, 3) or (H, W, 4)"
        )
    height, width = pixels.shape[:2]
    if not height or not width:
        raise ValueError(f"image: got shape {pixels.shape}, expected at least one pixel")
    depth = 8 * pixels.dtype.itemsize
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    color_type = {1: 0, 3: 2, 4: 6}[channels]
    big_endian = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">")))
    row_bytes = big_endian.reshape(height, -1).view(np.uint8).reshape(height, -1)
    step = pixels.dtype.itemsize * channels
    packed = _quick(row_bytes, step) if quick else _smallest(row_bytes, step)
    return _file(width, height, depth, color_type, packed)


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
    height, width = index.shape
    return _file(width, height, 8, 3, _smallest(index, 1), palette.tobytes())


def _file(
    width: int, height: int, depth: int, color_type: int, data: bytes, palette: bytes = b""
) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        body = kind + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + (chunk(b"PLTE", palette) if palette else b"")
        + chunk(b"IDAT", data)
        + chunk(b"IEND", b"")
    )


def _quick(rows: UInt8Array, step: int) -> bytes:
    """Compress rows of bytes by the differences to the left."""
    filtered = np.empty((rows.shape[0], rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 1
    filtered[:, 1 : step + 1] = rows[:, :step]
    np.subtract(rows[:, step:], rows[:, :-step], out=filtered[:, step + 1 :])  # modulo 256
    return zlib.compress(filtered.tobytes(), 4)


def _smallest(rows: UInt8Array, step: int) -> bytes:
    """Compress rows of bytes, shape (H, B), by one filter for all, whichever leaves least.

    Smooth pictures gain from the differences that filters store, flat and noisy ones lose.
    """
    left = np.zeros_like(rows)
    left[:, step:] = rows[:, :-step]
    above = np.zeros_like(rows)
    above[1:] = rows[:-1]
    mean = ((left.astype(np.uint16) + above) >> 1).astype(np.uint8)
    corner = np.zeros_like(rows)
    corner[1:, step:] = rows[:-1, :-step]
    candidates = []
    for kind, predicted in enumerate((None, left, above, mean, _paeth(left, above, corner))):
        filtered = np.empty((rows.shape[0], rows.shape[1] + 1), np.uint8)
        filtered[:, 0] = kind
        np.copyto(filtered[:, 1:], rows)
        if predicted is not None:
            filtered[:, 1:] -= predicted  # modulo 256, as the format has it
        candidates.append(filtered.tobytes())
    # a quick look ranks them as a thorough one would, in a third of the time
    best = min(candidates, key=lambda data: len(zlib.compress(data, 1)))
    return zlib.compress(best, 9)


def _paeth(left: UInt8Array, above: UInt8Array, corner: UInt8Array) -> UInt8Array:
    """Return whichever neighbor is nearest to left + above - corner (PNG specification 9.4)."""
    a, b, c = (one.astype(np.int16) for one in (left, above, corner))
    to_a, to_b, to_c = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
    upper = np.where(to_b <= to_c, above, corner)
    return np.where((to_a <= to_b) & (to_a <= to_c), left, upper)


def data_uri(image: NDArray[np.generic]) -> str:
    """Return the image as a ``data:`` address for a self-contained page."""
    return address(encode(image))


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
    curved = np.where(
        value <= 0.0031308, 12.92 * value, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055
    )
    return np.round(255.0 * curved).astype(np.uint8)


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
    image[~shown] = GRAY
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
    gray = np.full((1, 3), GRAY, np.uint8)
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
