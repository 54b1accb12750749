"""Read a photograph of any format as a raw frame of linear values without its metadata."""

import contextlib
import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capture import raw
from capture.arrays import FloatArray, UInt16Array
from capture.documents import InputError
from capture.importers.exif import EXIF_POINTER_TAG, ORIENTATION_TAG, ExifData, read_tiff_exif
from capture.importers.image_checks import (
    check_jpeg,
    check_png,
    check_size,
    image_error,
    note_orientation,
    photo_error,
    read_head,
    require_photograph,
    turn_upright,
)

Encoding = Literal["raw", "linear", "sRGB"]

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
    orientation: int = 1
    """EXIF orientation, 1 to 8, by which the pixels were turned upright."""
    flash_fired: bool | None = None
    """Whether EXIF data state that a flash fired; None: they do not state it."""

    @property
    def exposure_settings(self) -> dict[str, str | int | float]:
        """Stated settings of the exposure, by the names that `compare_exposures` reads."""
        frame = self.frame
        stated = {"exposure_s": frame.exposure_s, "iso": frame.iso, "f_number": frame.f_number}
        settings: dict[str, str | int | float] = {k: v for k, v in stated.items() if v is not None}
        if self.flash_fired is not None:
            settings["flash"] = "fired" if self.flash_fired else "off"
        return settings


def read_photo(
    path: str | Path, *, white_value: float | None = None, turn_raw: bool = True
) -> Photo:
    """Read a RAW, TIFF, OpenEXR, PNG or JPEG file; its content decides, not its name.

    Parameters
    ----------
    path : str or Path
        The file.
    white_value : float, optional
        Value of floating-point files that is stored as white, so that several files keep their
        ratios; default: a little above the file's own maximum.
    turn_raw : bool
        Whether a RAW file is turned by its orientation, too; False: rows stay those of the sensor.

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
    head = read_head(file, where)
    if head.startswith(_JPEG_MAGIC):
        notes, exif = check_jpeg(file.read_bytes(), where)
        return _state_exposure(_display(file, where, "JPEG", notes), exif)
    if head.startswith(_PNG_MAGIC):
        notes, exif = check_png(file.read_bytes(), where)
        return _state_exposure(_display(file, where, "PNG", notes), exif)
    if head.startswith(_EXR_MAGIC):
        return _exr(file, where, white_value)
    if head.startswith(_TIFF_MAGICS) and file.suffix.lower() in _TIFF_SUFFIXES:
        return _tiff(file, where, white_value)
    require_photograph(file, head)
    return _raw(file, where, turn=turn_raw)


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


def _assumed_noise(black: float, white: float) -> tuple[float, float]:
    gain = ASSUMED_FULL_WELL_E / (white - black)
    return raw.noise_profile(gain, ASSUMED_READ_NOISE_E, black=black, white=white)


NOISE_NOTE = (
    f"the noise is that of {ASSUMED_FULL_WELL_E:.0f} electrons at full scale and"
    f" {ASSUMED_READ_NOISE_E:.0f} electrons read noise"
)


def _raw(file: Path, where: str, *, turn: bool) -> Photo:
    try:
        frame = raw.read(file)
    except raw.RawError as exc:
        if (kind := _FORMAT_NAMES.get(file.suffix.lower())) is not None:
            begins = repr(file.read_bytes()[:4])
            expected = f"those of a {kind}"
            raise image_error(f"is not a {kind}", where, "first bytes", begins, expected) from exc
        raise photo_error(exc.what, where, exc.faults) from exc
    except NotImplementedError as exc:  # LibRaw's code for a filter array that it cannot describe
        raise image_error("has an unknown filter array", where, "cell", str(exc), "2 x 2") from exc
    notes = []
    if frame.noise_profile is None:
        black = float(np.mean(frame.black))
        frame = replace(frame, noise_profile=_assumed_noise(black, frame.white))
        notes.append(NOISE_NOTE)
    if frame.neutral is None and frame.pattern != "MONO":
        notes.append("the file names no white balance, so its channels count as balanced")
    orientation = frame.orientation if turn else 1
    if orientation != frame.orientation:
        notes.append(
            f"EXIF orientation {frame.orientation} was not followed: rows are those of the sensor"
        )
    notes += note_orientation(orientation)
    # metadata that identify people, places and owners are dropped
    frame = replace(
        _turn_mosaic(frame, orientation),
        camera_serial="", captured_at=None, step_id="", session_id="", light={}, path="",
        orientation=1,
    )  # fmt: skip
    return Photo(frame, "raw", tuple(notes), orientation=orientation)


def _turn_mosaic(frame: raw.RawFrame, orientation: int) -> raw.RawFrame:
    """Return a frame turned upright, with the cell of its filter array turned alike."""
    if orientation == 1:
        return frame
    cfa = np.ascontiguousarray(turn_upright(frame.cfa, orientation))
    if frame.pattern == "MONO":
        return replace(frame, cfa=cfa)
    cell = turn_upright(np.arange(4).reshape(2, 2), orientation).ravel()  # sides are even
    pattern = "".join(frame.pattern[k] for k in cell)
    return replace(frame, cfa=cfa, pattern=pattern, black=tuple(frame.black[k] for k in cell))


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


def _state_exposure(photo: Photo, exif: ExifData) -> Photo:
    """Return a developed image with the exposure and orientation that its EXIF data state."""
    frame = replace(
        photo.frame, exposure_s=exif.exposure_s, iso=exif.iso, f_number=exif.f_number
    )  # fmt: skip
    return replace(
        photo, frame=frame, orientation=exif.orientation, flash_fired=exif.flash_fired
    )  # fmt: skip


def _display(file: Path, where: str, what: str, notes: list[str]) -> Photo:
    import cv2

    try:
        pixels = cv2.imdecode(
            np.fromfile(file, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH
        )
    except (cv2.error, MemoryError, ValueError) as exc:
        raise image_error(
            "is damaged", where, what, "data that cannot be decoded", "a picture"
        ) from exc
    if pixels is None:
        raise image_error("is damaged", where, what, "data that cannot be decoded", "a picture")
    return _from_display(np.asarray(pixels), where, notes)


def _from_display(pixels: NDArray[Any], where: str, notes: list[str]) -> Photo:
    """Decode 8- or 16-bit display values, (H, W) or (H, W, 3)."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise image_error(
            "has an unknown depth", where, "samples", str(pixels.dtype), "8 or 16 bit"
        )
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
        raise image_error(
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
            check_size(width, height, where)
            ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)]
            size = file.stat().st_size
            if not ends or max(ends) > size:
                raise image_error("is cut short", where, "TIFF", f"{size} bytes", "a whole file")
            planar = int(page.planarconfig) == 2 and page.samplesperpixel > 1
            profile = 34675 in page.tags
            tags = page.tags
            exif = read_tiff_exif(tags.valueof(EXIF_POINTER_TAG), tags.valueof(ORIENTATION_TAG))
            pages = len(stream.pages)
            pixels = np.asarray(page.asarray())
    except InputError:
        raise
    except Exception as exc:  # the library computes with tags before it checks them
        got = str(exc).splitlines()[0][:120] if str(exc) else type(exc).__name__
        raise image_error(
            "is not a readable TIFF", where, "TIFF", got, "an uncompressed TIFF"
        ) from exc
    if pages > 1:
        notes.append(f"only the first of {pages} pages was taken")
    if planar:
        pixels = np.moveaxis(pixels, 0, -1)
    if profile:
        notes.append("its color profile was not applied; the colors count as sRGB primaries")
    pixels = turn_upright(_channels(pixels, where, notes), exif.orientation)
    notes += note_orientation(exif.orientation)
    if pixels.dtype == np.uint8:
        photo = _from_display(pixels, where, notes)
    elif pixels.dtype == np.uint16 or np.issubdtype(pixels.dtype, np.floating):
        photo = _linear(pixels, [*notes, "the TIFF's values count as linear light"], white_value)
    else:
        raise image_error(
            "has an unknown depth", where, "samples", str(pixels.dtype), "8, 16 bit or float"
        )
    return _state_exposure(photo, exif)


def _exr(file: Path, where: str, white_value: float | None) -> Photo:
    import OpenEXR

    notes: list[str] = []
    try:
        with OpenEXR.File(str(file), header_only=True) as header:
            low, high = header.header()["dataWindow"]
            width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        check_size(width, height, where)
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
        raise image_error("is damaged", where, "OpenEXR", got, "a whole OpenEXR file") from exc
    names = next((n for n in (("R", "G", "B"), ("Y",)) if set(n) <= set(channels)), None)
    if names is None:
        raise image_error(
            "contains no image", where, "channels", ", ".join(sorted(channels)), "R, G, B"
        )
    if left := sorted(set(channels) - set(names)):
        notes.append(f"channels {', '.join(left)} were omitted")
    planes = [channels[name].astype(np.float32) for name in names]
    if any(plane.shape != (height, width) for plane in planes):
        raise image_error("contains no image", where, "channels", "different sizes", "one size")
    pixels = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
    return _linear(pixels, notes, white_value)
