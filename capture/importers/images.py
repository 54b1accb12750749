"""Read a photograph of any format as a raw frame of linear values without its metadata."""

import contextlib
import io
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capture import raw
from capture.arrays import FloatArray, UInt16Array
from capture.documents import Fault, InputError

Encoding = Literal["raw", "linear", "sRGB"]

MAX_IMAGE_BYTES = 2**30
MAX_IMAGE_PIXELS = 2**26  # four raw cells each: the largest frame a session takes
MAX_IMAGE_SIDE_PX = 32_767
MAX_EXR_EXPANSION = 1100
"""Pixels per stored byte; the largest ratio of deflate is 1032 (RFC 1951)."""
WHITE_DN = 65_535
FLOAT_BLACK_DN = 1_024  # room for the negative values of floating-point images
FLOAT_HEADROOM = 1.02  # floating-point images do not saturate, so their maximum stays below white

# Assumed noise of a small camera sensor, which image files do not record: electrons at full scale
# and read noise.
ASSUMED_FULL_WELL_E = 20_000.0
ASSUMED_READ_NOISE_E = 10.0

_JPEG_MAGIC, _PNG_MAGIC, _EXR_MAGIC = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"\x76\x2f\x31\x01"
_TIFF_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TIFF_SUFFIXES = (".tif", ".tiff")
_FORMAT_NAMES = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG", ".exr": "OpenEXR"}
"""Kinds of files by suffix, for the message about a file that cannot be decoded."""
_IMAGE_ADVICE = "Give the photograph as the camera or the raw converter wrote it."


class PhotoError(InputError):
    """Raised for a photograph, or a folder of them, that cannot be imported."""


@dataclass(frozen=True, slots=True)
class Photo:
    """A decoded photograph."""

    frame: raw.RawFrame
    """Linear values; an image's pixel is one 2 x 2 cell, which "superpixel" restores exactly.
    Contains no time, location, serial number or owner.
    """
    encoding: Encoding
    """Encoding of the file: raw sensor values, linear light, or display values that were decoded.
    """
    notes: tuple[str, ...] = ()
    """Assumptions and losses, one sentence each."""
    white_value: float | None = None
    """Value of a floating-point file that is stored as white, 0 for a black one; None: the file
    contains integers."""


def read_photo(path: str | Path, *, white_value: float | None = None) -> Photo:
    """Read a RAW, TIFF, OpenEXR, PNG or JPEG file; its content decides, not its name.

    Parameters
    ----------
    path : str or Path
        The file.
    white_value : float, optional
        Value of floating-point files that is stored as white, so that several files keep their
        ratios; default: a little above the file's own maximum.

    Returns
    -------
    Photo
        Camera RGB of a RAW file; linear sRGB of the others, where 8-bit TIFF, PNG and JPEG are
        decoded by the curve of IEC 61966-2-1 and 16-bit or float TIFF and EXR are linear already.

    Raises
    ------
    PhotoError
        When the file is missing, empty, truncated, too large, or not a photograph.
    """
    file = Path(path)
    where = str(file)
    head = _head(file, where)
    if head.startswith(_JPEG_MAGIC):
        return _display(file, where, *_check_jpeg(file.read_bytes(), where))
    if head.startswith(_PNG_MAGIC):
        return _display(file, where, *_check_png(file.read_bytes(), where))
    if head.startswith(_EXR_MAGIC):
        return _exr(file, where, white_value)
    if head.startswith(_TIFF_MAGICS) and file.suffix.lower() in _TIFF_SUFFIXES:
        return _tiff(file, where, white_value)
    return _raw(file, where)


def _decode_srgb(values: FloatArray) -> FloatArray:
    """Decode display values in [0, 1] to linear light, IEC 61966-2-1.

    Examples
    --------
    >>> _decode_srgb(np.array([0.0, 0.5, 1.0])).round(6).tolist()
    [0.0, 0.214041, 1.0]
    """
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _rgb_to_mosaic(rgb: UInt16Array) -> UInt16Array:
    """Return an RGGB frame, (2H, 2W), each of whose 2 x 2 cells is one pixel of an RGB image.

    Examples
    --------
    >>> _rgb_to_mosaic(np.array([[[1, 2, 3]]], np.uint16)).tolist()
    [[1, 2], [2, 3]]
    """
    height, width, _ = rgb.shape
    cfa = np.empty((2 * height, 2 * width), np.uint16)
    cfa[0::2, 0::2] = rgb[..., 0]
    cfa[0::2, 1::2] = rgb[..., 1]
    cfa[1::2, 0::2] = rgb[..., 1]
    cfa[1::2, 1::2] = rgb[..., 2]
    return cfa


def _error(what: str, where: str, path: str, got: str, expected: str) -> PhotoError:
    return _photo_error(what, where, [Fault(path, got, expected)])


def _photo_error(what: str, where: str, faults: Sequence[Fault]) -> PhotoError:
    return PhotoError(what, where=where, faults=faults, advice=_IMAGE_ADVICE, code="SR-IMP-014")


def _head(file: Path, where: str) -> bytes:
    try:
        if not file.is_file():
            raise _error("is not a file", where, "file", "nothing or a folder", "a photograph")
        size = file.stat().st_size
        if size == 0:
            raise _error("is empty", where, "size", "0 bytes", "a photograph")
        if size > MAX_IMAGE_BYTES:
            raise _error(
                "is too large", where, "size", f"{size} bytes", f"at most {MAX_IMAGE_BYTES}"
            )
        with file.open("rb") as stream:
            return stream.read(16)
    except OSError as exc:
        raise _error("cannot be read", where, "file", str(exc.strerror), "a photograph") from exc


def _check_size(width: int, height: int, where: str) -> None:
    if (
        min(width, height) < 1
        or max(width, height) > MAX_IMAGE_SIDE_PX
        or (width * height > MAX_IMAGE_PIXELS)
    ):
        raise _error(
            "is implausible in size",
            where,
            "size",
            f"{width} x {height} pixels",
            f"sides of 1 to {MAX_IMAGE_SIDE_PX}, at most {MAX_IMAGE_PIXELS} pixels",
        )


def _assumed_noise(black: float, white: float) -> tuple[float, float]:
    gain = ASSUMED_FULL_WELL_E / (white - black)
    return raw.noise_profile(gain, ASSUMED_READ_NOISE_E, black=black, white=white)


NOISE_NOTE = (
    f"the noise is that of {ASSUMED_FULL_WELL_E:.0f} electrons at full scale and"
    f" {ASSUMED_READ_NOISE_E:.0f} electrons read noise"
)


def _raw(file: Path, where: str) -> Photo:
    try:
        frame = raw.read(file)
    except raw.RawError as exc:
        if (kind := _FORMAT_NAMES.get(file.suffix.lower())) is not None:
            begins = repr(file.read_bytes()[:4])
            expected = f"those of a {kind}"
            raise _error(f"is not a {kind}", where, "first bytes", begins, expected) from exc
        raise _photo_error(exc.what, where, exc.faults) from exc
    except NotImplementedError as exc:  # LibRaw's code for a filter array that it cannot describe
        raise _error("has an unknown filter array", where, "cell", str(exc), "2 x 2") from exc
    notes = []
    if frame.noise_profile is None:
        black = float(np.mean(frame.black))
        frame = replace(frame, noise_profile=_assumed_noise(black, frame.white))
        notes.append(NOISE_NOTE)
    if frame.neutral is None and frame.pattern != "MONO":
        notes.append("the file names no white balance, so its channels count as balanced")
    # metadata that identify people, places and owners are dropped
    frame = replace(
        frame, camera_serial="", captured_at=None, step_id="", session_id="", light={}, path=""
    )
    return Photo(frame, "raw", tuple(notes))


def _frame(values: UInt16Array, black: int) -> raw.RawFrame:
    color = values.ndim == 3
    return raw.RawFrame(
        cfa=_rgb_to_mosaic(values) if color else np.ascontiguousarray(values),
        pattern="RGGB" if color else "MONO",
        black=(float(black),) * (4 if color else 1),
        white=WHITE_DN,
        neutral=(1.0, 1.0, 1.0) if color else None,
        noise_profile=_assumed_noise(black, WHITE_DN),
    )


def _display(file: Path, where: str, what: str, notes: list[str]) -> Photo:
    import cv2

    try:
        pixels = cv2.imdecode(
            np.fromfile(file, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH
        )
    except (cv2.error, MemoryError, ValueError) as exc:
        raise _error("is damaged", where, what, "data that cannot be decoded", "a picture") from exc
    if pixels is None:
        raise _error("is damaged", where, what, "data that cannot be decoded", "a picture")
    return _from_display(np.asarray(pixels), where, notes)


def _from_display(pixels: NDArray[Any], where: str, notes: list[str]) -> Photo:
    """Decode 8- or 16-bit display values, (H, W) or (H, W, 3)."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise _error("has an unknown depth", where, "samples", str(pixels.dtype), "8 or 16 bit")
    codes = 256 if pixels.dtype == np.uint8 else 65_536
    table = np.rint(WHITE_DN * _decode_srgb(np.arange(codes) / (codes - 1))).astype(np.uint16)
    if pixels.ndim == 3 and (pixels == pixels[..., :1]).all():
        pixels = pixels[..., 0]
        notes = [*notes, "the image is gray and contains no color to estimate from"]
    depth = "8" if codes == 256 else "16"
    notes = [
        f"{depth}-bit display values were decoded by the sRGB curve; the camera's tone and "
        "color processing before is not undone",
        *notes,
        NOISE_NOTE,
    ]
    return Photo(_frame(table[pixels], 0), "sRGB", tuple(notes))


def _check_png(data: bytes, where: str) -> tuple[str, list[str]]:
    """Check the chunks of a PNG: sizes, checksums, end."""
    at = 8
    kinds: set[bytes] = set()
    notes: list[str] = []
    while True:
        if at + 12 > len(data):
            raise _error("is cut short", where, "PNG", f"{len(data)} bytes", "a whole file")
        length, kind = struct.unpack_from(">I4s", data, at)
        if at + 12 + length > len(data):
            raise _error("is cut short", where, "PNG", f"{len(data)} bytes", "a whole file")
        (found,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(data[at + 4 : at + 8 + length]) != found:
            name = kind.decode("ascii", "replace")
            raise _error("is damaged", where, f"PNG chunk {name}", "a wrong checksum", "its own")
        if not kinds:
            if kind != b"IHDR" or length != 13:
                raise _error("is damaged", where, "PNG", "no header", "a header first")
            width, height, _, color = struct.unpack_from(">IIBB", data, at + 8)
            _check_size(width, height, where)
            if color in (4, 6):
                notes.append("transparency was dropped")
        kinds.add(kind)
        at += 12 + length
        if kind == b"IEND":
            break
    if kinds & {b"iCCP", b"cICP"}:
        notes.append("its color profile was not applied; the colors count as sRGB")
    return "PNG", notes


_EXIF_POINTER, _COLOR_SPACE_TAG, _UNCALIBRATED = 0x8769, 0xA001, 0xFFFF
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def _check_jpeg(data: bytes, where: str) -> tuple[str, list[str]]:
    """Check the segments of a JPEG up to its scan, and the end of the scan."""
    at, notes, sized = 2, [], False
    cut = _error("is cut short", where, "JPEG", f"{len(data)} bytes", "a whole file")
    while True:
        if at + 4 > len(data):
            raise cut
        if data[at] != 0xFF:
            raise _error("is damaged", where, "JPEG", f"no marker at byte {at}", "a marker")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:  # markers without a length
            at += 2
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if length < 2 or at + 2 + length > len(data):
            raise cut
        body = data[at + 4 : at + 2 + length]
        if marker in _JPEG_SIZE_MARKERS and len(body) >= 5:
            height, width = struct.unpack_from(">HH", body, 1)
            _check_size(width, height, where)
            sized = True
        if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0") and b"sRGB" not in body:
            notes.append("its color profile was not applied; the colors count as sRGB")
        if marker == 0xE1 and body.startswith(b"Exif\0\0") and _is_uncalibrated(body[6:]):
            notes.append("its EXIF names no sRGB (uncalibrated color); the colors count as sRGB")
        at += 2 + length
        if marker == 0xDA:
            break
    # the scan escapes 0xFF, so that this can only be the end of the image
    if not sized or data.find(b"\xff\xd9", at) < 0:
        raise cut
    return "JPEG", list(dict.fromkeys(notes))


def _is_uncalibrated(tiff: bytes) -> bool:
    """Return whether EXIF data state a color space that is not sRGB (Exif 2.32, tag 0xA001)."""
    from PIL.Image import Exif

    found = Exif()
    try:
        found.load(b"Exif\0\0" + tiff)
        return found.get_ifd(_EXIF_POINTER).get(_COLOR_SPACE_TAG) == _UNCALIBRATED
    except (SyntaxError, ValueError, struct.error, OSError):  # damaged: the pixels may be right
        return False


def _linear(pixels: NDArray[Any], notes: list[str], white_value: float | None) -> Photo:
    """Store linear integers unchanged, and floating-point values over a white value."""
    if pixels.dtype == np.uint16:
        return Photo(_frame(pixels, 0), "linear", (*notes, NOISE_NOTE))
    values = pixels.astype(np.float64)
    known = np.isfinite(values)
    top = float(values[known].max(initial=0.0))
    white = max(FLOAT_HEADROOM * top, 0.0) if white_value is None else white_value
    scale = (WHITE_DN - FLOAT_BLACK_DN) / white if white > 0.0 else 0.0
    dn = np.rint(FLOAT_BLACK_DN + scale * np.where(known, values, 0.0))
    notes = [*notes, f"values were divided by {white:.6g} to fit the range"]
    if (dn < 0).any():
        notes.append(f"{int((dn < 0).sum())} values far below zero were raised to the lowest level")
    if not known.all():
        notes.append(f"{int((~known).sum())} values that are not numbers count as saturated")
    stored = np.where(known, np.clip(dn, 0, WHITE_DN - 1), WHITE_DN).astype(np.uint16)
    return Photo(_frame(stored, FLOAT_BLACK_DN), "linear", (*notes, NOISE_NOTE), white)


def _channels(pixels: NDArray[Any], where: str, notes: list[str]) -> NDArray[Any]:
    """Return any decoded array as (H, W) or (H, W, 3)."""
    squeezed = pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels
    if squeezed.ndim == 3 and squeezed.shape[2] == 4:
        notes.append("transparency was dropped")
        squeezed = squeezed[..., :3]
    if squeezed.ndim != 2 and not (squeezed.ndim == 3 and squeezed.shape[2] == 3):
        raise _error(
            "is not an image", where, "shape", str(pixels.shape), "(H, W), (H, W, 3) or (H, W, 4)"
        )
    return squeezed


def _tiff(file: Path, where: str, white_value: float | None) -> Photo:
    import tifffile

    notes: list[str] = []
    try:
        with tifffile.TiffFile(file) as stream:
            page = stream.pages.first
            height, width = int(page.imagelength), int(page.imagewidth)
            _check_size(width, height, where)
            ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)]
            size = file.stat().st_size
            if not ends or max(ends) > size:
                raise _error("is cut short", where, "TIFF", f"{size} bytes", "a whole file")
            planar = int(page.planarconfig) == 2 and page.samplesperpixel > 1
            profile = 34675 in page.tags
            pages = len(stream.pages)
            pixels = np.asarray(page.asarray())
    except InputError:
        raise
    except (
        OSError,
        ValueError,
        RuntimeError,
        IndexError,
        KeyError,
        TypeError,
        struct.error,
        AttributeError,
        MemoryError,
        ZeroDivisionError,
    ) as exc:
        got = str(exc).splitlines()[0][:120] if str(exc) else type(exc).__name__
        raise _error("is not a readable TIFF", where, "TIFF", got, "an uncompressed TIFF") from exc
    if pages > 1:
        notes.append(f"only the first of {pages} pages was taken")
    if planar:
        pixels = np.moveaxis(pixels, 0, -1)
    if profile:
        notes.append("its color profile was not applied; the colors count as sRGB primaries")
    pixels = _channels(pixels, where, notes)
    if pixels.dtype == np.uint8:
        return _from_display(pixels, where, notes)
    if pixels.dtype == np.uint16 or np.issubdtype(pixels.dtype, np.floating):
        return _linear(pixels, [*notes, "the TIFF's values count as linear light"], white_value)
    raise _error("has an unknown depth", where, "samples", str(pixels.dtype), "8, 16 bit or float")


def _exr(file: Path, where: str, white_value: float | None) -> Photo:
    import OpenEXR

    notes: list[str] = []
    try:
        with OpenEXR.File(str(file), header_only=True) as header:
            low, high = header.header()["dataWindow"]
            width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        _check_size(width, height, where)
        if width * height > MAX_EXR_EXPANSION * file.stat().st_size:
            raise ValueError(f"declares {width} x {height} pixels, more than it can store")
        # the library prints what it cannot read, on stdout, and goes on
        with (
            contextlib.redirect_stdout(io.StringIO()) as printed,
            OpenEXR.File(str(file), separate_channels=True) as stream,
        ):
            if printed.getvalue():
                raise ValueError(printed.getvalue().strip())
            channels = {name: np.array(c.pixels) for name, c in stream.channels().items()}
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as exc:
        got = str(exc).splitlines()[0][:120] if str(exc) else type(exc).__name__
        raise _error("is damaged", where, "OpenEXR", got, "a whole OpenEXR file") from exc
    names = next((n for n in (("R", "G", "B"), ("Y",)) if set(n) <= set(channels)), None)
    if names is None:
        raise _error("contains no image", where, "channels", ", ".join(sorted(channels)), "R, G, B")
    if left := sorted(set(channels) - set(names)):
        notes.append(f"channels {', '.join(left)} were omitted")
    planes = [channels[name].astype(np.float32) for name in names]
    if any(plane.shape != (height, width) for plane in planes):
        raise _error("contains no image", where, "channels", "different sizes", "one size")
    pixels = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
    return _linear(pixels, notes, white_value)
