"""EXIF data of developed images: color space, orientation, and the settings of the exposure."""

from __future__ import annotations

import math
import struct
import warnings
from collections.abc import Mapping, Sequence
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
EXPOSURE_TERMS = {"exposure_s": "time", "iso": "ISO", "f_number": "f-number"}
"""Settings that the exposure depends on, and what they are called."""
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
        _parse_number(tags.get(_EXPOSURE_TAG), MAX_EXPOSURE_S, fraction=True) or None,
        round(iso) if iso else None,
        _parse_number(tags.get(_APERTURE_TAG), MAX_F_NUMBER, fraction=True) or None,
        None if flash is None else bool(int(flash) & 1),
    )


def _parse_number(value: Any, largest: float, *, fraction: bool = False) -> float | None:
    """Return a number, a fraction or the first of several; None if it is out of range.

    Examples
    --------
    >>> _parse_number((1, 50), 10.0, fraction=True), _parse_number((200, 200), 1000.0)
    (0.02, 200.0)
    >>> _parse_number((1, 0), 10.0, fraction=True) is None
    True
    """
    try:
        if fraction and isinstance(value, tuple) and len(value) == 2:
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


def compare_exposures(images: Sequence[Mapping[str, Any]]) -> tuple[list[float], str]:
    """Return the exposures of several images in a common unit, and the terms that they consist of.

    A flash is shorter than the exposure: its time does not count where ``flash`` is "fired".

    Parameters
    ----------
    images
        Settings of each, with ``exposure_s``, ``iso``, ``f_number`` and ``flash``, each optional.

    Returns
    -------
    list of float
        Products of time, ISO and 1 / f-number^2, as far as stated; empty where the images do not
        state the same terms, where a flash fired for some only, and without images.
    str
        "time, ISO and f-number", or those of them that are stated; empty with the list.

    Examples
    --------
    >>> compare_exposures([{"exposure_s": 0.5, "iso": 100}, {"exposure_s": 0.25, "iso": 100}])
    ([50.0, 25.0], 'time and ISO')
    >>> flash = {"exposure_s": 0.5, "f_number": 2.0, "flash": "fired"}
    >>> compare_exposures([flash, {**flash, "f_number": 4.0}])
    ([0.25, 0.0625], 'f-number')
    >>> compare_exposures([flash, {**flash, "flash": "off"}])
    ([], '')
    """
    fired = {one.get("flash") == "fired" for one in images}
    names = [name for name in EXPOSURE_TERMS if name != "exposure_s" or fired == {False}]
    stated = {tuple(name for name in names if float(one.get(name, 0.0)) > 0.0) for one in images}
    if len(fired) != 1 or len(stated) != 1 or not (terms := stated.pop()):
        return [], ""
    power = {"f_number": -2}
    found = [math.prod(float(one[k]) ** power.get(k, 1) for k in terms) for one in images]
    words = [EXPOSURE_TERMS[name] for name in terms]
    return found, " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
