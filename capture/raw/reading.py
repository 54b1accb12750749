"""Read raw files of any camera: ours by our own reader, all others through LibRaw."""

import mmap
from pathlib import Path
from typing import Any

import numpy as np
import rawpy

from capture.documents import Fault
from capture.raw.dng import decode_dng, is_skinrig_dng
from capture.raw.frame import MAX_PIXELS, RawError, RawFrame
from capture.raw.tiff import Directory

_RAW_ADVICE = "Give a raw file as the camera wrote it; for other images use skinrig import."
_FLOAT_SAMPLES = 3
_ORIENTATION_BY_FLIP = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}
"""EXIF orientation by LibRaw's flip: 4 exchanges rows and columns, 2 and 1 then reverse them."""


def read(path: str | Path) -> RawFrame:
    """Read the raw frame of a file.

    Parameters
    ----------
    path : str or Path
        A DNG of ours, or a raw file of any camera that LibRaw supports.

    Returns
    -------
    RawFrame
        The visible sensor values unchanged, uint16, shape (H, W), in the sensor's rows whatever
        the file's orientation. For a foreign file with an odd visible area the last row or column
        is omitted, so that 2 x 2 cells are whole.

    Raises
    ------
    RawError
        When the file is missing, empty, truncated, damaged, implausible in size or not a raw file;
        also for sensors without a 2 x 2 cell and for floating-point DNGs.
    """
    where = str(path)
    try:
        with open(path, "rb") as file:
            size = file.seek(0, 2)
            if not size:
                raise _error("is empty", where, "size", "0 bytes", "a raw file")
            # the frame's pixels keep the mapping alive
            buffer = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except FileNotFoundError as exc:
        raise _error("is missing", where, "file", "nothing", "a raw file") from exc
    except OSError as exc:
        raise _error("cannot be read", where, "file", str(exc.strerror), "a raw file") from exc
    return decode(buffer, where=where)


def decode(buffer: memoryview, *, where: str = "") -> RawFrame:
    """Return the raw frame of a file's bytes; see `read`."""
    if is_skinrig_dng(buffer):
        return decode_dng(buffer, where=where)
    return _decode_with_libraw(buffer, _tags(buffer, where), where)


def _tags(buffer: memoryview, where: str) -> Directory | None:
    """Return the first directory; None when the file is not a TIFF, an error for a broken DNG."""
    if bytes(buffer[:4]) not in (b"II*\0", b"MM\0*"):
        return None
    try:
        return Directory(buffer, where=where)
    except RawError:
        if where.lower().endswith(".dng"):
            raise
        return None


def _error(what: str, where: str, path: str, got: str, expected: str) -> RawError:
    return RawError(
        what,
        where=where,
        faults=[Fault(path, got, expected)],
        advice=_RAW_ADVICE,
        code="SR-IMP-015",
    )


def _decode_with_libraw(buffer: memoryview, tags: Directory | None, where: str) -> RawFrame:
    with rawpy.RawPy() as raw:
        try:
            raw.open_buffer(_Reader(buffer))
            sizes = raw.sizes
            if sizes.raw_width * sizes.raw_height > MAX_PIXELS:
                got = f"{sizes.raw_width} x {sizes.raw_height}"
                raise _error("is absurd", where, "size", got, f"at most {MAX_PIXELS} pixels")
            raw.unpack()
        except rawpy.LibRawError as exc:
            reason = exc.args[0] if exc.args else ""
            got = reason.decode("ascii", "replace") if isinstance(reason, bytes) else str(reason)
            raise _error("is not a raw file", where, "LibRaw", got, "a raw file") from exc
        return _translate(raw, tags, where)


class _Reader:
    """File object with the only method that LibRaw needs."""

    def __init__(self, buffer: memoryview) -> None:
        self._buffer = buffer

    def read(self) -> bytes:
        return bytes(self._buffer)


def _image_directories(tags: Directory | None) -> list[Directory]:
    """Return the directories of full-size images in a foreign file: the first, or sub-images."""
    if tags is None:
        return []
    return [d for d in (tags, *tags.children(330)) if d.integer(254, 0) == 0]


def _translate(raw: Any, tags: Directory | None, where: str) -> RawFrame:
    if raw.raw_type != rawpy.RawType.Flat:
        got = str(raw.raw_type)
        raise _error("has no color filter array", where, "sensor", got, "one value per pixel")
    if any(_FLOAT_SAMPLES in image.numbers(339) for image in _image_directories(tags)):
        raise _error("is a floating-point DNG", where, "samples", "float", "whole numbers")
    visible = raw.raw_image_visible
    mono = raw.num_colors == 1
    step = 1 if mono else 2
    height, width = (side // step * step for side in visible.shape)
    cfa = np.array(visible[:height, :width], dtype=np.uint16)
    if mono:
        pattern, cells = "MONO", np.zeros(1, int)
    else:
        if raw.raw_pattern is None or raw.raw_pattern.shape != (2, 2):
            shape = None if raw.raw_pattern is None else raw.raw_pattern.shape
            raise _error("has an unknown filter array", where, "cell", str(shape), "(2, 2)")
        cells = raw.raw_colors_visible[:2, :2].ravel()
        pattern = "".join(chr(raw.color_desc[int(c)]) for c in cells)
    levels = raw.black_level_per_channel
    description = _read_description(raw, tags)
    try:
        return RawFrame(
            cfa=cfa,
            pattern=pattern,
            black=tuple(float(levels[int(c)]) for c in cells),
            white=int(raw.white_level),
            path=where,
            orientation=_ORIENTATION_BY_FLIP.get(int(raw.sizes.flip), 1),
            **description,
        )
    except RawError as exc:
        raise RawError(
            "cannot be decoded", where=where, faults=exc.faults, advice=_RAW_ADVICE
        ) from exc


def _read_description(raw: Any, tags: Directory | None) -> dict[str, Any]:
    """Return the metadata of a file; missing fields are omitted."""
    found: dict[str, Any] = {}
    other = getattr(raw, "other", None)
    if other is not None:
        shot = {
            "exposure_s": float(other.shutter_speed),
            "iso": round(other.iso_speed),
            "f_number": float(other.aperture),
            "focal_mm": float(other.focal_length),
        }
        found |= {key: value for key, value in shot.items() if 0 < value < float("inf")}
    balance = [float(x) for x in raw.camera_whitebalance[:3]]
    if all(x > 0 for x in balance):
        inverse = [1.0 / x for x in balance]
        found["neutral"] = tuple(x / max(inverse) for x in inverse)
    # rawpy's matrix is all zeros for any DNG (LibRaw issue 751), so it is read from the tags
    matrix = np.asarray(raw.rgb_xyz_matrix[:3], np.float64)
    if matrix.any():
        found["color_matrix"] = matrix
    if tags is not None:
        found |= _tagged(tags)
    return found


def _tagged(tags: Directory) -> dict[str, Any]:
    found: dict[str, Any] = {}
    make, model = tags.text(271), tags.text(272)
    name = model if model.startswith(make) else f"{make} {model}"
    if name.strip():
        found["camera_model"] = name.strip()[:200]
    if serial := tags.text(50735):
        found["camera_serial"] = serial[:200]
    codes = {17: "A", 20: "D55", 21: "D65", 22: "D75", 23: "D50"}
    for matrix_tag, light_tag in ((50722, 50779), (50721, 50778)):
        matrix = tags.numbers(matrix_tag)
        light = codes.get(tags.integer(light_tag, 0))
        if len(matrix) == 9 and light is not None and "color_matrix" not in found:
            found["color_matrix"] = np.reshape(matrix, (3, 3))
            found["color_illuminant"] = light
    noise = tags.numbers(51041)
    if len(noise) >= 2:
        found["noise_profile"] = (float(noise[0]), float(noise[1]))
    return found
