r"""Camera protocol over TCP: a sealed JSON line, then the pixels; no I/O.

One message is a header line, ``<JSON object>*<CRC4>\n`` (ASCII, checksum as in
`capture.devices.wire`), followed by ``blob_bytes`` bytes with the CRC-32 ``blob_crc32``; without
these two keys nothing follows. The client sends one request and waits::

    {"id": 1, "do": "open", "version": 1, "view": "cam"}     -> {"id": 1, "ok": true, "info": {..}}
    {"id": 2, "do": "clock"}                                 -> {"id": 2, "ok": true, "clock_s": ..}
    {"id": 3, "do": "configure", "exposure_s": .., "iso": ..}   -> the same two, as set
    {"id": 4, "do": "arm", "count": 1, "trigger": "edge"}    -> {"id": 4, "ok": true}
    {"id": 5, "do": "fire"}                                  -> {"id": 5, "ok": true}
    {"id": 6, "do": "frame", "timeout_s": 6.0}               -> {"id": 6, "ok": true, "frame": {..},
                                                                 "blob_bytes": .., "blob_crc32": ..}
    {"id": 7, "do": "abort"}                                 -> {"id": 7, "ok": true}

A refusal is ``{"id": n, "ok": false, "error": "FrameTimeout", "text": "..."}``. While a frame that
has arrived is being read out the answer may be preceded by ``{"id": n, "developing": true}``. The
blob of a frame is uint16, little endian, row by row (``"shape": [H, W]``), or a whole raw file
(no ``shape``).
"""

import json
import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from capture.arrays import UInt16Array
from capture.devices import wire
from capture.devices.camera import CameraInfo, Exposure, Frame, Trigger
from capture.documents import to_json_table

CAMERA_WIRE_VERSION = 1
MAX_HEADER_BYTES = 65_536
MAX_BLOB_BYTES = 2**30


class BadMessage(ValueError):
    """Raised for bytes that are not a message; the rest of the stream cannot be trusted."""


def encode_message(fields: Mapping[str, Any], blob: bytes | None = None) -> bytes:
    r"""Return the bytes of one message.

    Examples
    --------
    >>> encode_message({"id": 2, "do": "clock"})
    b'{"id":2,"do":"clock"}*CF97\n'
    """
    table = dict(fields)
    if blob is not None:
        table["blob_bytes"], table["blob_crc32"] = len(blob), zlib.crc32(blob)
    text = json.dumps(table, separators=(",", ":"), allow_nan=False)
    return wire.seal(text).encode("ascii") + b"\n" + (blob or b"")


def decode_header(line: bytes) -> dict[str, Any]:
    """Return the fields of a header line without its newline; raise `BadMessage` otherwise."""
    try:
        fields = json.loads(wire.unseal(line.decode("ascii")))
    except (ValueError, RecursionError) as exc:
        raise BadMessage(f"header: {exc}") from exc
    if not isinstance(fields, dict):
        raise BadMessage(f"header: got {type(fields).__name__}, expected a JSON object")
    return fields


def blob_size(fields: Mapping[str, Any]) -> int:
    """Return the number of bytes after a header, 0 to `MAX_BLOB_BYTES`; raise `BadMessage`."""
    size = fields.get("blob_bytes", 0)
    if not isinstance(size, int) or isinstance(size, bool) or not 0 <= size <= MAX_BLOB_BYTES:
        raise BadMessage(f"blob_bytes: got {size!r}, expected 0 to {MAX_BLOB_BYTES}")
    return size


def check_blob(fields: Mapping[str, Any], blob: bytes) -> None:
    """Raise `BadMessage` when the bytes after a header do not match its checksum."""
    if "blob_bytes" in fields and zlib.crc32(blob) != fields.get("blob_crc32"):
        raise BadMessage(f"blob_crc32: got {zlib.crc32(blob)}, expected {fields['blob_crc32']}")


def info_to_json(info: CameraInfo) -> dict[str, Any]:
    """Return the properties of a camera as JSON values."""
    return to_json_table(info)


def info_from_json(table: Mapping[str, Any]) -> CameraInfo:
    """Return the properties of a camera; raise `BadMessage` when a field is missing."""
    try:
        pixel_um = None if table.get("pixel_um") is None else float(table["pixel_um"])
        if pixel_um is not None and not 0.0 < pixel_um < math.inf:
            raise ValueError(f"pixel_um: got {pixel_um}, expected more than 0")
        return CameraInfo(
            serial=str(table["serial"]),
            model=str(table["model"]),
            width_px=int(table["width_px"]),
            height_px=int(table["height_px"]),
            pattern=str(table["pattern"]),
            black=tuple(float(level) for level in table["black"]),
            white=int(table["white"]),
            triggers=tuple(Trigger(name) for name in table["triggers"]),
            pixel_um=pixel_um,
        )
    except (KeyError, TypeError, ValueError) as exc:
        raise BadMessage(f"info: {exc!r}") from exc


def frame_to_message(frame: Frame) -> tuple[dict[str, Any], bytes]:
    """Return the header fields and the blob of a frame."""
    table: dict[str, Any] = {
        "serial": frame.serial,
        "seq": frame.seq,
        "t_start_s": frame.t_start_s,
        "t_end_s": frame.t_end_s,
        "exposure_s": frame.exposure.exposure_s,
        "iso": frame.exposure.iso,
        "light": dict(frame.light),
    }
    if isinstance(frame.image, bytes):
        return table, frame.image
    table["shape"] = list(frame.image.shape)
    return table, frame.image.astype("<u2", copy=False).tobytes()


def frame_from_message(table: Mapping[str, Any], blob: bytes) -> Frame:
    """Return the frame that `frame_to_message` has encoded; raise `BadMessage` otherwise."""
    image: UInt16Array | bytes = blob
    try:
        if "shape" in table:
            height, width = (int(side) for side in table["shape"])
            if min(height, width) < 1 or 2 * height * width != len(blob):
                raise BadMessage(f"shape: got {table['shape']!r} for {len(blob)} bytes")
            image = np.frombuffer(blob, "<u2").reshape(height, width).astype(np.uint16)
        return Frame(
            serial=str(table["serial"]),
            seq=int(table["seq"]),
            t_start_s=float(table["t_start_s"]),
            t_end_s=float(table["t_end_s"]),
            exposure=Exposure(float(table["exposure_s"]), int(table["iso"])),
            image=image,
            light=dict(table["light"]),
        )
    except BadMessage:
        raise
    except (KeyError, TypeError, ValueError) as exc:
        raise BadMessage(f"frame: {exc!r}") from exc
