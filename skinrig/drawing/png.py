"""Encode PNG and JPEG images, and apply color scales."""

import base64
import io
import struct
import zlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from skinrig.arrays import BoolArray, Float64Array, FloatArray, UInt8Array

SCALE_CLASSES = {"viridis": "viridis", "magma": "magma", "RdBu_r": "diverging", "gray": "grays"}
"""Color maps of matplotlib in use, with their names in style sheets."""
INVALID_GRAY = 128
"""Gray level of pixels without a value."""
HEADER_BYTES = 33
"""Length of a PNG file's signature and first chunk, IHDR."""
MIN_SPAN = 1e-200
"""Minimum span of a color scale; below it division overflows, and all values get the first
color."""


def encode(image: NDArray[np.generic], *, quick: bool = False) -> bytes:
    r"""Encode an image as PNG.

    Parameters
    ----------
    image
        (H, W) gray, (H, W, 3) RGB or (H, W, 4) RGB and opacity, uint8 or uint16, row 0 at the top.
    quick
        Compress less, in a third of the time, for large textures.

    Returns
    -------
    bytes
        Without color chunks or other metadata; the same bytes for the same image and OpenCV.

    Raises
    ------
    ValueError
        If shape or dtype is another.

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


def insert_text(file: bytes, keyword: str, text: str) -> bytes:
    """Insert a tEXt chunk (PNG specification, 11.3.3) behind the header of a PNG file.

    Parameters
    ----------
    file
        PNG file.
    keyword, text
        1 to 79 characters, and any number; Latin-1.

    Examples
    --------
    >>> from PIL import Image
    >>> file = insert_text(encode(np.zeros((2, 2), np.uint8)), "Source", "dome")
    >>> Image.open(io.BytesIO(file)).info
    {'Source': 'dome'}
    """
    chunk = b"tEXt" + keyword.encode("latin-1") + bytes(1) + text.encode("latin-1")
    size, checksum = (struct.pack(">I", n) for n in (len(chunk) - 4, zlib.crc32(chunk)))
    return file[:HEADER_BYTES] + size + chunk + checksum + file[HEADER_BYTES:]


def to_data_url(file: bytes, kind: str = "png") -> str:
    """Encode an image file, of the type image/``kind``, as a ``data:`` URL."""
    return f"data:image/{kind};base64," + base64.b64encode(file).decode("ascii")


@lru_cache(maxsize=64)  # a report repeats images of its first screen, and of earlier ones
def to_webp_url(file: bytes) -> str:
    """Encode an image file without loss as WebP, a fifth smaller than PNG, in a ``data:`` URL."""
    from PIL import Image

    out = io.BytesIO()
    image = Image.open(io.BytesIO(file)).convert("RGB")
    image.save(out, "WEBP", lossless=True, quality=75, method=5)
    return to_data_url(out.getvalue(), "webp")


def encode_jpeg_url(image: UInt8Array, *, quality: int = 88) -> str:
    """Encode an image, (H, W, 3), as a JPEG file in a ``data:`` URL, for small previews."""
    import cv2

    stored = np.ascontiguousarray(image[..., ::-1])  # OpenCV has blue first
    file = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    return to_data_url(file, "jpeg")


def encode_srgb8(linear: FloatArray) -> UInt8Array:
    """Apply the sRGB curve (IEC 61966-2-1) and round to 8 bits.

    Parameters
    ----------
    linear
        Linear values of any shape, clipped to [0, 1], for display only.

    Returns
    -------
    ndarray of uint8
        The same shape.
    """
    value = np.clip(np.nan_to_num(np.asarray(linear, np.float64)), 0.0, 1.0)
    return np.round(255.0 * srgb_curve(value)).astype(np.uint8)


def srgb_curve(linear: FloatArray) -> Float64Array:
    """Apply the sRGB transfer curve (IEC 61966-2-1) to values in [0, 1].

    Examples
    --------
    >>> srgb_curve(np.array([0.0, 0.0031308, 1.0])).round(4).tolist()
    [0.0, 0.0404, 1.0]
    """
    value = np.asarray(linear, np.float64)
    power = 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055
    return np.where(value <= 0.0031308, 12.92 * value, power)


@dataclass(frozen=True, slots=True)
class Scale:
    """A perceptually uniform color scale.

    Attributes
    ----------
    low, high
        Ends of the scale in the unit of the values; values beyond them are clipped.
    name
        A matplotlib color map, such as "viridis" or the diverging "RdBu_r".
    """

    low: float
    high: float
    name: str = "viridis"

    def colors(self, values: FloatArray, valid: BoolArray | None = None) -> UInt8Array:
        """Return the colors of values, (H, W, 3); NaN and invalid pixels are mid gray."""
        position, shown = self._position(values, valid)
        image = sample_palette(self.name, 256)[np.round(255 * position).astype(np.intp)]
        image[~shown] = INVALID_GRAY
        return image

    def encode(
        self, values: FloatArray, valid: BoolArray | None = None, *, levels: int = 128
    ) -> bytes:
        """Encode a map as a PNG file with a palette.

        Parameters
        ----------
        values, valid
            (H, W); see `colors`.
        levels
            Number of colors, 2 to 255, to which values are quantized; pixels without a value have
            an extra color.
        """
        from PIL import Image

        position, shown = self._position(values, valid)
        index = np.round((levels - 1) * position).astype(np.uint8)
        index[~shown] = levels
        gray = np.full((1, 3), INVALID_GRAY, np.uint8)
        image = Image.frombytes("P", index.shape[::-1], index.tobytes())
        image.putpalette(np.concatenate([sample_palette(self.name, levels), gray]).tobytes())
        file = io.BytesIO()
        image.save(file, "PNG", optimize=True)
        return file.getvalue()

    def _position(
        self, values: FloatArray, valid: BoolArray | None
    ) -> tuple[Float64Array, BoolArray]:
        """Return the positions of values on the scale, in [0, 1], and the valid ones."""
        values = np.asarray(values, np.float64)
        span = self.high - self.low
        span = span if span > MIN_SPAN else 1.0
        finite = np.isfinite(values)
        # clipped first: a difference of huge values overflows
        clipped = np.clip(np.where(finite, values, self.low), self.low, self.low + span)
        position = (clipped - self.low) / span
        return position, finite if valid is None else finite & np.asarray(valid, bool)


def sample_palette(scale: str, colors: int) -> UInt8Array:
    """Sample a matplotlib color map at equal steps, (colors, 3), uint8."""
    from matplotlib import colormaps

    return np.round(255 * colormaps[scale](np.linspace(0.0, 1.0, colors))[:, :3]).astype(np.uint8)
