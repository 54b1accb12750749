"""Subset of TIFF for DNG: directories of tags, written and read within bounds.

References
----------
TIFF Revision 6.0, Adobe, 1992.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

from capture.documents import Fault
from capture.raw.frame import RawError

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12

_TYPE_FORMATS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii"}
_TYPE_FORMATS |= {11: "f", 12: "d"}
_MAX_ENTRIES = 512
_MAX_VALUE_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Entry:
    """One tag of a directory, its values already in bytes."""

    tag: int
    kind: int
    count: int
    data: bytes


def encode_entry(tag: int, kind: int, values: Sequence[float] | str | bytes) -> Entry:
    """Return a little-endian entry; rationals are the nearest fraction of 32-bit integers."""
    if isinstance(values, str):
        values = values.encode("ascii") + b"\0"
    if isinstance(values, bytes):
        return Entry(tag, kind, len(values), values)
    if kind in (RATIONAL, SRATIONAL):
        top = 2**31 - 1 if kind == SRATIONAL else 2**32 - 1
        parts = [part for value in values for part in _fraction(value, top)]
        return Entry(
            tag, kind, len(values), struct.pack(f"<{len(parts)}{_TYPE_FORMATS[kind][0]}", *parts)
        )
    data = struct.pack(f"<{len(values)}{_TYPE_FORMATS[kind]}", *values)
    return Entry(tag, kind, len(values), data)


def encode_directory(entries: Iterable[Entry], offset: int) -> bytes:
    """Encode a directory for ``offset`` of the file, followed by its longer values."""
    ordered = sorted(entries, key=lambda e: e.tag)
    table = struct.pack("<H", len(ordered))
    place = offset + 2 + 12 * len(ordered) + 4
    tail = b""
    for e in ordered:
        value = e.data.ljust(4, b"\0")
        if len(e.data) > 4:
            value = struct.pack("<I", place + len(tail))
            tail += e.data + b"\0" * (len(e.data) % 2)
        table += struct.pack("<HHI", e.tag, e.kind, e.count) + value
    return table + struct.pack("<I", 0) + tail


class Directory:
    """Tags of one directory of a file, read on demand and never outside the file.

    Parameters
    ----------
    buffer : memoryview
        The whole file.
    offset : int or None
        Offset of the directory; None for the first.
    where : str
        File name for messages.
    """

    def __init__(self, buffer: memoryview, *, offset: int | None = None, where: str) -> None:
        self._buffer = buffer
        self._where = where
        self._order = {b"II*\0": "<", b"MM\0*": ">"}.get(bytes(buffer[:4]), "")
        if not self._order:
            raise self._error("is not a TIFF or DNG", "magic", repr(bytes(buffer[:4])), "II*\\0")
        start = self._unpack("I", 4, "first directory")[0] if offset is None else offset
        (count,) = self._unpack("H", start, "directory")
        if not 0 < count <= _MAX_ENTRIES:
            expected = f"1 to {_MAX_ENTRIES} tags"
            raise self._error("has a broken directory", f"byte {start}", f"{count} tags", expected)
        self._tags: dict[int, tuple[int, int, int]] = {}
        for number in range(count):
            at = start + 2 + 12 * number
            tag, kind, length = self._unpack("HHI", at, "tag")
            self._tags[tag] = (kind, length, at + 8)

    def __contains__(self, tag: int) -> bool:
        """Return whether the directory has ``tag``."""
        return tag in self._tags

    def data(self, tag: int) -> bytes:
        """Return the bytes of ``tag``; empty when it is missing."""
        if tag not in self._tags:
            return b""
        kind, count, at = self._tags[tag]
        if kind not in _TYPE_FORMATS:
            raise self._error("has a broken tag", f"tag {tag}", f"type {kind}", "a TIFF 6 type")
        size = struct.calcsize("<" + _TYPE_FORMATS[kind]) * count
        if size > _MAX_VALUE_BYTES:
            expected = f"at most {_MAX_VALUE_BYTES}"
            raise self._error("has a broken tag", f"tag {tag}", f"{size} bytes", expected)
        if size > 4:
            (at,) = self._unpack("I", at, f"tag {tag}")
        self._inside(at, size, f"tag {tag}")
        return bytes(self._buffer[at : at + size])

    def numbers(self, tag: int) -> tuple[float, ...]:
        """Return the values of ``tag``, rationals divided; empty when it is missing."""
        data = self.data(tag)
        if not data:
            return ()
        kind = self._tags[tag][0]
        if kind in (ASCII, UNDEFINED):
            return tuple(data)
        letter = _TYPE_FORMATS[kind][0]
        values = struct.unpack(f"{self._order}{len(data) // struct.calcsize(letter)}{letter}", data)
        if kind not in (RATIONAL, SRATIONAL):
            return values
        pairs = zip(values[::2], values[1::2], strict=True)
        return tuple(n / d if d else float("nan") for n, d in pairs)

    def number(self, tag: int) -> float | None:
        """Return the first value of ``tag``, or None when it is missing."""
        return next(iter(self.numbers(tag)), None)

    def integer(self, tag: int, default: int | None = None) -> int:
        """Return the one whole number of ``tag``; a missing tag without default is an error."""
        values = self.numbers(tag)
        if not values and default is not None:
            return default
        if len(values) != 1 or not float(values[0]).is_integer():
            raise self._error("has a broken tag", f"tag {tag}", str(values), "one whole number")
        return int(values[0])

    def text(self, tag: int) -> str:
        """Return the printable ASCII of ``tag``, empty when it is missing."""
        text = self.data(tag).split(b"\0")[0].decode("ascii", "replace").strip()
        return "".join(c if c.isascii() and c.isprintable() else "?" for c in text)

    def children(self, tag: int) -> list[Directory]:
        """Return the directories that ``tag`` points to; empty when it is missing."""
        places = self.numbers(tag)[:16]
        return [Directory(self._buffer, offset=int(p), where=self._where) for p in places]

    def _unpack(self, form: str, at: int, what: str) -> tuple[int, ...]:
        size = struct.calcsize("<" + form)
        self._inside(at, size, what)
        return struct.unpack(self._order + form, self._buffer[at : at + size])

    def _inside(self, at: int, size: int, what: str) -> None:
        if at + size > len(self._buffer):
            expected = f"at least {at + size} bytes"
            got = f"a file of {len(self._buffer)} bytes"
            raise self._error("is cut short or damaged", what, got, expected)

    def _error(self, what: str, path: str, got: str, expected: str) -> RawError:
        advice = "Take the file from its source again, or retake the frame."
        return RawError(what, where=self._where, faults=[Fault(path, got, expected)], advice=advice)


@lru_cache(maxsize=4096)  # a session's frames repeat the same numbers
def _fraction(value: float, top: int) -> tuple[int, int]:
    """Return the nearest numerator and denominator that both stay within ``top``."""
    exact = Fraction(value)
    limit = int(top / max(1.0, abs(value)))
    nearest = exact.limit_denominator(max(limit, 1))
    return nearest.numerator, nearest.denominator
