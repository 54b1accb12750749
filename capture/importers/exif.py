"""EXIF data of developed images: color space, orientation, and the settings of the exposure."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

ORIENTATION_TAG, N_ORIENTATIONS = 0x0112, 8
EXIF_POINTER_TAG = 0x8769
_COLOR_SPACE_TAG, _UNCALIBRATED = 0xA001, 0xFFFF
_EXPOSURE_TAG, _APERTURE_TAG, _ISO_TAG, _FLASH_TAG = 0x829A, 0x829D, 0x8827, 0x9209
_TIFFFILE_NAMES = {
    _EXPOSURE_TAG: "ExposureTime",
    _APERTURE_TAG: "FNumber",
    _ISO_TAG: "ISOSpeedRatings",
    _FLASH_TAG: "Flash",
}
MAX_ISO, MAX_F_NUMBER, MAX_EXPOSURE_S = 10_000_000, 1000.0, 86_400.0


@dataclass(frozen=True, slots=True)
class ExifData:
    """What EXIF data (Exif 2.32) state; None where they state nothing usable."""

    uncalibrated: bool = False
    """Whether the color space is stated not to be sRGB."""
    orientation: int = 1
    """From 1 to 8."""
    exposure_s: float | None = None
    iso: int | None = None
    f_number: float | None = None
    flash_fired: bool | None = None


def read_exif(tiff: bytes) -> ExifData:
    """Return what the EXIF data of a JPEG or PNG file state; damaged data state nothing.

    Parameters
    ----------
    tiff
        Their TIFF structure, without the header ``Exif``.
    """
    from PIL.Image import Exif

    found = Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about data that are cut short
            found.load(b"Exif\0\0" + tiff)
            orientation = found.get(ORIENTATION_TAG, 1)
            tags = dict(found.get_ifd(EXIF_POINTER_TAG))
    except (SyntaxError, ValueError, TypeError, struct.error, OSError):  # the pixels may be right
        return ExifData()
    return _parse(tags, orientation)


def read_tiff_exif(directory: object, orientation: object) -> ExifData:
    """Return what the EXIF directory of a TIFF file states, as ``tifffile`` returns it by name."""
    if not isinstance(directory, Mapping):
        return ExifData(orientation=known_orientation(orientation))
    tags = {tag: directory.get(name) for tag, name in _TIFFFILE_NAMES.items()}
    return _parse(tags, orientation)


def _parse(tags: Mapping[int, Any], orientation: object) -> ExifData:
    flash = _parse_number(tags.get(_FLASH_TAG), 65_535.0)
    iso = _parse_number(tags.get(_ISO_TAG), MAX_ISO)
    return ExifData(
        tags.get(_COLOR_SPACE_TAG) == _UNCALIBRATED,
        known_orientation(orientation),
        _parse_number(tags.get(_EXPOSURE_TAG), MAX_EXPOSURE_S) or None,
        round(iso) if iso else None,
        _parse_number(tags.get(_APERTURE_TAG), MAX_F_NUMBER) or None,
        None if flash is None else bool(int(flash) & 1),
    )


def _parse_number(value: Any, largest: float) -> float | None:
    """Return a number, a fraction or the first of several; None if it is out of range.

    Examples
    --------
    >>> _parse_number((1, 50), 10.0), _parse_number(8, 10.0), _parse_number((1, 0), 10.0)
    (0.02, 8.0, None)
    """
    try:
        if isinstance(value, tuple) and len(value) == 2 and all(isinstance(v, int) for v in value):
            value = value[0] / value[1]
        elif isinstance(value, tuple):
            value = value[0]
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError, OverflowError):
        return None
    return number if 0.0 <= number <= largest else None


def known_orientation(value: object) -> int:
    """Return an orientation from 1 to 8; 1 for any other value."""
    return value if isinstance(value, int) and 1 <= value <= N_ORIENTATIONS else 1


def compute_exposure(settings: Mapping[str, Any]) -> float | None:
    """Return the exposure that settings state, in seconds at ISO 100 and f/1, or None.

    A flash is shorter than the exposure: its time does not count where ``flash`` is "fired". ISO
    and f-number count as 100 and 1 if they are not stated.

    Parameters
    ----------
    settings
        With ``exposure_s``, ``iso``, ``f_number`` and ``flash``, each optional.

    Examples
    --------
    >>> compute_exposure({"exposure_s": 0.02, "iso": 200, "f_number": 2.0})
    0.01
    >>> compute_exposure({"exposure_s": 0.02, "iso": 200, "f_number": 2.0, "flash": "fired"})
    0.5
    >>> compute_exposure({"iso": 200}) is None
    True
    """
    fired = settings.get("flash") == "fired"
    if not fired and "exposure_s" not in settings:
        return None
    time = 1.0 if fired else float(settings["exposure_s"])
    iso, f_number = float(settings.get("iso", 100.0)), float(settings.get("f_number", 1.0))
    exposure = time * iso / 100.0 / f_number**2
    return exposure if exposure > 0.0 else None
