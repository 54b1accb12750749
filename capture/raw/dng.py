"""Write and read our own DNG: uncompressed 16 bit, deterministic, with step and light.

References
----------
Digital Negative (DNG) Specification 1.6, Adobe, 2021; EXIF 2.32, CIPA DC-008, 2019.
"""

import os
import re
import struct
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import xxhash

from capture.arrays import UInt8Array, UInt16Array
from capture.documents import Fault, canonical_json, read_json
from capture.raw.frame import ILLUMINANT_CODES, MAX_PIXELS, RawError, RawFrame
from capture.raw.thumbnail import draw_thumbnail
from capture.raw.tiff import (
    ASCII,
    BYTE,
    DOUBLE,
    LONG,
    RATIONAL,
    SHORT,
    SRATIONAL,
    UNDEFINED,
    Directory,
    Entry,
    encode_directory,
    encode_entry,
)

XMP_NAMESPACE = "urn:skinrig:frame:1"
SOFTWARE_NAME = "skinrig"

_CFA_LETTERS = "RGB"
_CFA_PHOTOMETRIC, _LINEAR_PHOTOMETRIC = 32803, 34892
_ALIGNMENT_BYTES = 64
_CROP_PX = 8
_HEAD_BYTES = 65_536
# XYZ (D65) -> linear sRGB, IEC 61966-2-1: written to the file when the camera's own is unknown
_SRGB_FROM_XYZ = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)

_XMP_TEMPLATE = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:skinrig="{namespace}" {attributes}/>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end="r"?>"""


def encode_dng(
    cfa: UInt16Array,
    *,
    pattern: str,
    black: float | Sequence[float],
    white: int,
    **description: Any,
) -> bytes:
    """Encode ``cfa`` unchanged as a DNG; equal arguments give equal bytes.

    Parameters
    ----------
    cfa : array of uint16, shape (H, W)
        DN as read out, row 0 at the top; sides even unless MONO.
    pattern : str
        "RGGB", "BGGR", "GRBG", "GBRG" or "MONO".
    black : float or sequence of 4 floats
        Black level, DN, for all positions of the 2 x 2 cell or row by row.
    white : int
        Saturation level, DN.
    exposure_s, iso, f_number, focal_mm
        Exposure time (s), sensitivity, f-number, focal length (mm); omitted when None.
    camera_model, camera_serial : str
        ASCII, as the camera names itself.
    color_matrix : array, shape (3, 3), optional
        CIE XYZ of ``color_illuminant`` to camera RGB.
    color_illuminant : {"A", "D50", "D55", "D65", "D75"}
    neutral : tuple of 3 floats, optional
        Camera RGB of a neutral surface under the light of the frame.
    noise_profile : tuple (scale, offset), optional
        variance = scale * x + offset in fractions of full scale, see `noise_profile`.
    captured_at : datetime with zone, optional
    step_id, session_id : str
        Step and session of the frame.
    light : mapping, optional
        Light of the frame (polarizer, power, token, analyzer): JSON values.

    Raises
    ------
    RawError
        Listing every argument that cannot be written.

    Examples
    --------
    >>> cfa = np.arange(64, dtype=np.uint16).reshape(8, 8)
    >>> blob = encode_dng(cfa, pattern="RGGB", black=0, white=1023, step_id="S001")
    >>> frame = decode_dng(memoryview(blob))
    >>> bool((frame.cfa == cfa).all()), frame.pattern, frame.step_id
    (True, 'RGGB', 'S001')
    """
    cells = 1 if pattern == "MONO" else 4
    levels = (float(black),) * cells if isinstance(black, int | float) else tuple(black)
    matrix = description.pop("color_matrix", None)
    frame = RawFrame(
        cfa=cfa,
        pattern=pattern,
        black=tuple(float(level) for level in levels),
        white=int(white),
        color_matrix=None if matrix is None else np.asarray(matrix, np.float64),
        light=dict(description.pop("light", None) or {}),
        **description,
    )
    return encode_frame(frame)


def encode_frame(frame: RawFrame) -> bytes:
    """Encode a frame unchanged as a DNG; see `encode_dng`."""
    return b"".join(_encode_parts(frame))


def encode_frame_into(frame: RawFrame, allocate: Callable[[int], memoryview]) -> memoryview:
    """Encode a frame as `encode_frame` does, into memory of the caller.

    Parameters
    ----------
    frame
        The frame.
    allocate
        Returns writable memory of a size in bytes. Memory that was in use before costs less than
        new pages, which take longer than encoding.

    Returns
    -------
    memoryview
        The memory.

    Examples
    --------
    >>> frame = RawFrame(cfa=np.zeros((4, 4), np.uint16), pattern="MONO", black=(0.0,), white=9)
    >>> memory = memoryview(bytearray(10_000))
    >>> encode_frame_into(frame, lambda size: memory[:size]) == encode_frame(frame)
    True
    """
    head, pixels = _encode_parts(frame)
    blob = allocate(len(head) + len(pixels))
    blob[: len(head)], blob[len(head) :] = head, pixels
    return blob


def _encode_parts(frame: RawFrame) -> tuple[bytes, memoryview]:
    """Return all before the pixels, and the pixels."""
    pixels = np.ascontiguousarray(frame.cfa, dtype="<u2").data.cast("B")
    small = draw_thumbnail(frame)
    xmp = _xmp(frame, pixels)

    def lay_out(exif_at: int, small_at: int, pixels_at: int) -> tuple[bytes, bytes, bytes]:
        """Encode the directories for their places: main, EXIF, thumbnail with its pixels."""
        exif = encode_directory(_exif_entries(frame), exif_at)
        if small is None:
            return encode_directory(_main_entries(frame, xmp, exif_at, pixels_at), 8), exif, b""
        link = encode_entry(330, LONG, [small_at])
        main = encode_directory([*_main_entries(frame, xmp, exif_at, pixels_at), link], 8)
        size = len(encode_directory(_thumbnail_entries(small, 0), 0))
        tags = encode_directory(_thumbnail_entries(small, small_at + size), small_at)
        return main, exif, tags + small.tobytes()

    # lay out once with zero offsets to compute the sizes, then with the true ones
    main, exif, preview = map(len, lay_out(0, 0, 0))
    small_at = 8 + main + exif + exif % 2
    pixels_at = -(-(small_at + preview) // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES
    parts = lay_out(8 + main, small_at, pixels_at)
    head = struct.pack("<2sHI", b"II", 42, 8) + parts[0] + parts[1]
    return (head.ljust(small_at, b"\0") + parts[2]).ljust(pixels_at, b"\0"), pixels


def write_dng(path: str | Path, cfa: UInt16Array, **description: Any) -> None:
    """Write a DNG atomically; keyword arguments as for `encode_dng`."""
    blob = encode_dng(cfa, **description)
    target = Path(path)
    part = target.with_name(target.name + ".part")
    with open(part, "wb") as file:
        file.write(blob)
        file.flush()
        os.fsync(file.fileno())
    part.replace(target)


def is_skinrig_dng(buffer: memoryview) -> bool:
    """Return whether the file was written by `encode_dng`, even when part of its head is damaged.

    Two marks are searched for, so that a damaged file of ours is rejected by our strict reader and
    never interpreted by a lenient one (LibRaw identifies some formats only by the file's size).
    """
    head = bytes(buffer[:_HEAD_BYTES])
    return XMP_NAMESPACE.encode() in head or f"{SOFTWARE_NAME}\0".encode() in head


def decode_dng(buffer: memoryview, *, where: str = "") -> RawFrame:
    """Decode a DNG of ours; the frame's pixels are a read-only view of ``buffer``.

    Raises
    ------
    RawError
        When the file is truncated, damaged in one bit of its pixels, or not of ours.
    """
    tags = Directory(buffer, where=where)
    if 50706 not in tags or XMP_NAMESPACE.encode() not in tags.data(700):
        raise _error("is not a DNG of skinrig", where, "XMP", "no skinrig namespace", XMP_NAMESPACE)
    words = _read_xmp(tags.data(700), where)
    pixels = _pixels(buffer, tags, words.get("pixels", ""), where)
    mono = tags.integer(262) == _LINEAR_PHOTOMETRIC
    exif = next(iter(tags.children(34665)), None)
    if exif is None:
        raise _error("is damaged", where, "EXIF directory", "none", "one")
    matrix = tags.numbers(50721) if words.get("color") == "known" else ()
    code = tags.integer(50778, 21)
    neutral = tags.numbers(50728)
    noise = tags.numbers(51041)
    black = tags.numbers(50714)
    letters = "MONO" if mono else "".join(_letter(c) for c in tags.numbers(33422))
    try:
        return RawFrame(
            cfa=pixels,
            pattern=letters,
            black=tuple(float(level) for level in black),
            white=tags.integer(50717),
            exposure_s=exif.number(33434),
            iso=exif.integer(34867, exif.integer(34855, 0)) or None,
            camera_model=tags.text(50708) if words.get("camera") == "known" else "",
            camera_serial=tags.text(50735),
            color_matrix=np.reshape(matrix, (3, 3)) if len(matrix) == 9 else None,
            color_illuminant=next((k for k, v in ILLUMINANT_CODES.items() if v == code), str(code)),
            neutral=tuple(neutral) if words.get("neutral") == "known" else None,  # type: ignore[arg-type]
            noise_profile=(noise[0], noise[1]) if len(noise) == 2 else None,
            f_number=exif.number(33437),
            focal_mm=exif.number(37386),
            captured_at=_read_time(exif),
            step_id=words.get("step", ""),
            session_id=words.get("session", ""),
            light=read_json(words.get("light", "{}"), where=where, error=RawError),
            path=where,
        )
    except RawError as exc:
        raise RawError("is damaged", where=where, faults=exc.faults, advice=_DNG_ADVICE) from exc


_DNG_ADVICE = "Take the file from its source again, or retake the frame."


def _error(what: str, where: str, path: str, got: str, expected: str) -> RawError:
    return RawError(what, where=where, faults=[Fault(path, got, expected)], advice=_DNG_ADVICE)


def _thumbnail_entries(small: UInt8Array, pixels_at: int) -> list[Entry]:
    height, width, _ = small.shape
    return [
        encode_entry(254, LONG, [1]),  # a reduced image of another one in the file
        encode_entry(256, LONG, [width]),
        encode_entry(257, LONG, [height]),
        encode_entry(258, SHORT, [8, 8, 8]),
        encode_entry(259, SHORT, [1]),
        encode_entry(262, SHORT, [2]),
        encode_entry(273, LONG, [pixels_at]),
        encode_entry(277, SHORT, [3]),
        encode_entry(278, LONG, [height]),
        encode_entry(279, LONG, [small.size]),
        encode_entry(284, SHORT, [1]),
    ]


def _main_entries(frame: RawFrame, xmp: bytes, exif_at: int, pixels_at: int) -> list[Entry]:
    height, width = frame.cfa.shape
    mono = frame.pattern == "MONO"
    side = 1 if mono else 2
    crop = _CROP_PX if min(height, width) >= 8 * _CROP_PX else 0
    model = frame.camera_model or "unknown camera"
    entries = [
        encode_entry(254, LONG, [0]),
        encode_entry(256, LONG, [width]),
        encode_entry(257, LONG, [height]),
        encode_entry(258, SHORT, [16]),
        encode_entry(259, SHORT, [1]),
        encode_entry(262, SHORT, [_LINEAR_PHOTOMETRIC if mono else _CFA_PHOTOMETRIC]),
        encode_entry(271, ASCII, SOFTWARE_NAME),
        encode_entry(272, ASCII, model),
        encode_entry(273, LONG, [pixels_at]),
        encode_entry(274, SHORT, [1]),
        encode_entry(277, SHORT, [1]),
        encode_entry(278, LONG, [height]),
        encode_entry(279, LONG, [frame.cfa.size * 2]),
        encode_entry(284, SHORT, [1]),
        encode_entry(305, ASCII, SOFTWARE_NAME),
        encode_entry(700, BYTE, xmp),
        encode_entry(34665, LONG, [exif_at]),
        encode_entry(50706, BYTE, [1, 4, 0, 0]),
        encode_entry(50707, BYTE, [1, 3, 0, 0]),
        encode_entry(50708, ASCII, model),
        encode_entry(50713, SHORT, [side, side]),
        encode_entry(50714, RATIONAL, frame.black),
        encode_entry(50717, LONG, [frame.white]),
        encode_entry(50718, RATIONAL, [1.0, 1.0]),
        encode_entry(50719, LONG, [crop, crop]),
        encode_entry(50720, LONG, [width - 2 * crop, height - 2 * crop]),
        encode_entry(50829, LONG, [0, 0, height, width]),
    ]
    if not mono:
        matrix = (
            _SRGB_FROM_XYZ
            if frame.color_matrix is None
            else tuple(frame.color_matrix.ravel().tolist())
        )
        entries += [
            encode_entry(33421, SHORT, [2, 2]),
            encode_entry(33422, BYTE, [_CFA_LETTERS.index(c) for c in frame.pattern]),
            encode_entry(50710, BYTE, [0, 1, 2]),
            encode_entry(50711, SHORT, [1]),
            encode_entry(50721, SRATIONAL, matrix),
            encode_entry(50728, RATIONAL, frame.neutral or (1.0, 1.0, 1.0)),
            encode_entry(50778, SHORT, [ILLUMINANT_CODES[frame.color_illuminant]]),
        ]
    if frame.camera_serial:
        entries.append(encode_entry(50735, ASCII, frame.camera_serial))
    if frame.noise_profile is not None:
        entries.append(encode_entry(51041, DOUBLE, frame.noise_profile))
    if frame.captured_at is not None:
        entries.append(
            encode_entry(306, ASCII, f"{frame.captured_at.astimezone(UTC):%Y:%m:%d %H:%M:%S}")
        )
    return entries


def _exif_entries(frame: RawFrame) -> list[Entry]:
    entries = [encode_entry(36864, UNDEFINED, b"0231")]
    if frame.exposure_s is not None:
        entries.append(encode_entry(33434, RATIONAL, [frame.exposure_s]))
    if frame.f_number is not None:
        entries.append(encode_entry(33437, RATIONAL, [frame.f_number]))
    if frame.iso is not None:
        # ISO above 16 bit is in the long tag only, EXIF 2.3 section 4.6.5
        entries.append(encode_entry(34855, SHORT, [min(int(frame.iso), 65_535)]))
        entries.append(encode_entry(34864, SHORT, [3]))
        entries.append(encode_entry(34867, LONG, [int(frame.iso)]))
    if frame.focal_mm is not None:
        entries.append(encode_entry(37386, RATIONAL, [frame.focal_mm]))
    if frame.camera_serial:
        entries.append(encode_entry(42033, ASCII, frame.camera_serial))
    if frame.captured_at is not None:
        moment = frame.captured_at.astimezone(UTC)
        entries.append(encode_entry(36867, ASCII, f"{moment:%Y:%m:%d %H:%M:%S}"))
        entries.append(encode_entry(36881, ASCII, "+00:00"))
        entries.append(encode_entry(37521, ASCII, f"{moment:%f}"))
    return entries


def _xmp(frame: RawFrame, pixels: memoryview) -> bytes:
    words = {
        "step": frame.step_id,
        "session": frame.session_id,
        "light": canonical_json(dict(frame.light)).decode("ascii"),
        "color": "unknown" if frame.color_matrix is None else "known",
        "neutral": "unknown" if frame.neutral is None else "known",
        "camera": "known" if frame.camera_model else "unknown",
        "pixels": f"xxh3-128:{xxhash.xxh3_128_hexdigest(pixels)}",
    }
    attributes = " ".join(f"skinrig:{key}={quoteattr(text)}" for key, text in words.items())
    return _XMP_TEMPLATE.format(namespace=XMP_NAMESPACE, attributes=attributes).encode("utf-8")


def _read_xmp(packet: bytes, where: str) -> dict[str, str]:
    """Return our attributes; reject a packet that declares entities (expansion attacks)."""
    if len(packet) > 65_536 or re.search(rb"<!(DOCTYPE|ENTITY)", packet):
        raise _error("is damaged", where, "XMP", f"{len(packet)} bytes", "plain, below 64 KiB")
    try:
        root = ElementTree.fromstring(packet.rstrip(b"\0"))
    except ElementTree.ParseError as exc:
        raise _error("is damaged", where, "XMP", str(exc), "well-formed XML") from exc
    prefix = f"{{{XMP_NAMESPACE}}}"
    found: dict[str, str] = {}
    for element in root.iter():
        for key, value in element.attrib.items():
            if key.startswith(prefix):
                found[key.removeprefix(prefix)] = value
    return found


def _pixels(buffer: memoryview, tags: Directory, seal: str, where: str) -> UInt16Array:
    width, height = tags.integer(256), tags.integer(257)
    if not 0 < width * height <= MAX_PIXELS:
        raise _error("is damaged", where, "size", f"{width} x {height}", f"at most {MAX_PIXELS} px")
    layout = (tags.integer(258), tags.integer(259), tags.integer(277, 1))
    if layout != (16, 1, 1):
        raise _error("is damaged", where, "bits, compression, samples", str(layout), "(16, 1, 1)")
    start, size = tags.integer(273), tags.integer(279)
    if size != 2 * width * height:
        raise _error("is damaged", where, "pixel bytes", str(size), f"{2 * width * height}")
    if start + size != len(buffer):
        got = f"a file of {len(buffer)} bytes"
        raise _error("is cut short or too long", where, "size", got, f"{start + size} bytes")
    data = buffer[start : start + size]
    found = f"xxh3-128:{xxhash.xxh3_128_hexdigest(data)}"
    if found != seal:
        raise _error("has damaged pixels", where, "pixels", found, seal or "a seal in the XMP")
    return np.frombuffer(data, dtype="<u2").reshape(height, width)


def _read_time(exif: Directory) -> datetime | None:
    text = exif.text(36867)
    if not text:
        return None
    moment = f"{text}.{exif.text(37521) or '0'}+00:00"
    try:
        return datetime.strptime(moment, "%Y:%m:%d %H:%M:%S.%f%z").astimezone(UTC)
    except ValueError as exc:
        raise _error("is damaged", "", "capture time", text, "YYYY:MM:DD HH:MM:SS") from exc


def _letter(code: float) -> str:
    return _CFA_LETTERS[int(code)] if 0 <= code < 3 else "?"
