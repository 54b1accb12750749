"""Check that a file is a whole image before it is decoded, and name what else it is."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.documents import Fault, InputError
from capture.importers.exif import ExifData, read_exif

MAX_IMAGE_BYTES = 2**30
MAX_IMAGE_PIXELS = 2**26  # four raw cells each: the largest frame a session takes
MAX_IMAGE_SIDE_PX = 32_767
_IMAGE_ADVICE = "Give the photograph as the camera or the raw converter wrote it."


FRAMES_ADVICE = "Write its frames to a folder, by `ffmpeg -i VIDEO frames/%05d.png` for one."
VIDEO_ADVICE = f"Name the video itself in `skinrig import olat` or `photos`. Or: {FRAMES_ADVICE}"
CONVERSION_ADVICE = "Convert it to TIFF or PNG of 16 bits, or set the camera to JPEG or RAW."
VIDEO_SUFFIXES = frozenset(".mp4 .mov .avi .mkv .webm .m4v".split())
VIDEO_BRANDS = (b"isom", b"mp42", b"qt  ", b"avc1", b"M4V ", b"AVI ")
OTHER_KINDS = {
    "HEIC image": ((b"heic", b"heix", b"mif1", b"msf1"), (".heic", ".heif")),
    "AVIF image": ((b"avif",), (".avif",)),
    "WebP image": ((b"WEBP",), (".webp",)),
    "GIF image": ((b"GIF8",), (".gif",)),
    "BMP image": ((b"BM",), (".bmp",)),
    "Photoshop file": ((b"8BPS",), (".psd", ".psb")),
    "JPEG XL image": ((b"\xff\x0a",), (".jxl",)),
    "JPEG 2000 image": ((b"\0\0\0\x0cjP",), (".jp2", ".j2k")),
    "Targa image": ((), (".tga",)),
    "Netpbm image": ((), (".pgm", ".ppm", ".pnm")),
    "NumPy array": ((b"\x93NUMPY",), (".npy",)),
}
"""Formats that are not read: first bytes, or the brand of ISO base media or RIFF, and suffixes."""
OTHER_IMAGE_SUFFIXES = frozenset(one for _, suffixes in OTHER_KINDS.values() for one in suffixes)


class PhotoError(InputError):
    """Raised for a photograph, or a folder of them, that cannot be imported."""


def image_error(what: str, where: str, path: str, got: str, expected: str) -> PhotoError:
    """Return the error of one fault of a file."""
    return photo_error(what, where, [Fault(path, got, expected)])


def photo_error(what: str, where: str, faults: Sequence[Fault]) -> PhotoError:
    """Return the error of a file, with what to do."""
    return PhotoError(what, where=where, faults=faults, advice=_IMAGE_ADVICE, code="SR-IMP-014")


def read_head(file: Path, where: str) -> bytes:
    """Return the first 16 bytes of a file; refuse what is empty, too large or not a file."""
    try:
        if not file.is_file():
            raise image_error("is not a file", where, "file", "nothing or a folder", "a photograph")
        size = file.stat().st_size
        if size == 0:
            raise image_error("is empty", where, "size", "0 bytes", "a photograph")
        if size > MAX_IMAGE_BYTES:
            raise image_error(
                "is too large", where, "size", f"{size} bytes", f"at most {MAX_IMAGE_BYTES}"
            )
        with file.open("rb") as stream:
            return stream.read(16)
    except OSError as exc:
        raise image_error(
            "cannot be read", where, "file", str(exc.strerror), "a photograph"
        ) from exc


def check_size(width: int, height: int, where: str) -> None:
    """Refuse an image, width and height in pixels, that no camera takes."""
    if (
        min(width, height) < 1
        or max(width, height) > MAX_IMAGE_SIDE_PX
        or (width * height > MAX_IMAGE_PIXELS)
    ):
        raise image_error(
            "is implausible in size",
            where,
            "size",
            f"{width} x {height} pixels",
            f"sides of 1 to {MAX_IMAGE_SIDE_PX}, at most {MAX_IMAGE_PIXELS} pixels",
        )


def check_png(data: bytes, where: str) -> tuple[list[str], ExifData]:
    """Check the chunks of a PNG, and return notes on its content and its EXIF data."""
    at, exif = 8, ExifData()
    kinds: set[bytes] = set()
    notes: list[str] = []
    while True:
        if at + 12 > len(data):
            raise image_error("is cut short", where, "PNG", f"{len(data)} bytes", "a whole file")
        length, kind = struct.unpack_from(">I4s", data, at)
        if at + 12 + length > len(data):
            raise image_error("is cut short", where, "PNG", f"{len(data)} bytes", "a whole file")
        (found,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(data[at + 4 : at + 8 + length]) != found:
            name = kind.decode("ascii", "replace")
            raise image_error(
                "is damaged", where, f"PNG chunk {name}", "a wrong checksum", "its own"
            )
        if not kinds:
            if kind != b"IHDR" or length != 13:
                raise image_error("is damaged", where, "PNG", "no header", "a header first")
            width, height, _, color = struct.unpack_from(">IIBB", data, at + 8)
            check_size(width, height, where)
            if color in (4, 6):
                notes.append("transparency was dropped")
        if kind == b"eXIf":
            exif = read_exif(data[at + 8 : at + 8 + length])
            notes += _note_exif(exif)
        kinds.add(kind)
        at += 12 + length
        if kind == b"IEND":
            break
    if kinds & {b"iCCP", b"cICP"}:
        notes.append("its color profile was not applied; the colors count as sRGB")
    return notes, exif


_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def check_jpeg(data: bytes, where: str) -> tuple[list[str], ExifData]:
    """Check the segments of a JPEG, and return notes on its content and its EXIF data."""
    at, notes, sized, exif = 2, [], False, ExifData()
    cut = image_error("is cut short", where, "JPEG", f"{len(data)} bytes", "a whole file")
    while True:
        if at + 4 > len(data):
            raise cut
        if data[at] != 0xFF:
            raise image_error("is damaged", where, "JPEG", f"no marker at byte {at}", "a marker")
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
            check_size(width, height, where)
            sized = True
            if body[5:6] == b"\4":
                notes.append("its four inks (CMYK) were converted without their color profile")
        if marker == 0xE2 and body.startswith(b"ICC_PROFILE\0") and b"sRGB" not in body:
            notes.append("its color profile was not applied; the colors count as sRGB")
        if marker == 0xE1 and body.startswith(b"Exif\0\0"):
            exif = read_exif(body[6:])
            notes += _note_exif(exif)
        at += 2 + length
        if marker == 0xDA:
            break
    # the scan escapes 0xFF, so that this can only be the end of the image
    if not sized or data.find(b"\xff\xd9", at) < 0:
        raise cut
    return list(dict.fromkeys(notes)), exif


def _note_exif(exif: ExifData) -> list[str]:
    """Return notes on EXIF data of a file that is decoded upright."""
    notes = note_orientation(exif.orientation)
    if exif.uncalibrated:
        return ["its EXIF names no sRGB (uncalibrated color); the colors count as sRGB", *notes]
    return notes


def note_orientation(orientation: int) -> list[str]:
    """Return the note that an image was turned upright; none for one that is stored so."""
    if orientation == 1:
        return []
    return [f"the image was turned as its EXIF orientation {orientation} asks"]


def turn_upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return stored pixels (H, W) or (H, W, C) as upright image; Exif 2.32, tag 0x0112.

    Examples
    --------
    >>> turn_upright(np.array([[1, 2], [3, 4]]), 6).tolist()
    [[3, 1], [4, 2]]
    """
    if orientation >= 5:  # rows are columns of the upright image
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def require_photograph(file: Path, head: bytes) -> None:
    """Refuse images of other formats, and videos, by their first bytes or suffix."""
    suffix = file.suffix.lower()
    brand = head[8:12] if head[4:8] == b"ftyp" or head[:4] == b"RIFF" else b""
    kind = next(
        (
            name
            for name, (brands, suffixes) in OTHER_KINDS.items()
            if brand in brands or head.startswith(brands) or suffix in suffixes
        ),
        "video" if suffix in VIDEO_SUFFIXES or brand in VIDEO_BRANDS else None,
    )
    if kind is None:
        return
    raise PhotoError(
        f"is a {kind}",
        where=str(file),
        advice=VIDEO_ADVICE if kind == "video" else CONVERSION_ADVICE,
        code="SR-IMP-017",
    )


def advise_conversion(name: str) -> str:
    """Return how a file of another format becomes images that are read; empty for others.

    Examples
    --------
    >>> advise_conversion("IMG_1.HEIC")
    'Convert it to TIFF or PNG of 16 bits, or set the camera to JPEG or RAW.'
    >>> advise_conversion("notes.txt")
    ''
    """
    suffix = Path(name).suffix.lower()
    if suffix in VIDEO_SUFFIXES:
        return VIDEO_ADVICE
    if suffix in OTHER_IMAGE_SUFFIXES:
        return CONVERSION_ADVICE
    return ""
