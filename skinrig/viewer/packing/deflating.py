"""Arrays as one gzip stream, each compressed in the way that suits it.

Searching for repetitions costs nearly all of the time that compression takes, and finds next to
none in the noise that fine textures are: Huffman codes and runs alone are as small there, or
smaller, in a hundredth of the time.
"""

import struct
import zlib
from collections.abc import Iterable
from typing import Final

_GZIP_HEADER: Final = b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x02\xff"
"""gzip, deflate, no name, no time, slowest, unknown system (RFC 1952): the same everywhere."""
_EMPTY_LAST_BLOCK: Final = b"\x03\x00"
"""An empty last block of deflate."""
_MEMORY_LEVEL: Final = 9
MAX_QUICK_RATIO: Final = 0.9
"""Repetitions are searched for thoroughly where a quick search makes this much of the size."""
MAX_MEASURED_BYTES: Final = 1 << 20
"""Bytes above which a size is guessed from codes and runs alone."""


def gzipped(parts: Iterable[bytes]) -> bytes:
    """Return parts behind each other as one gzip member, the same bytes for the same parts.

    Parameters
    ----------
    parts
        Each is compressed without a look at the others.

    Examples
    --------
    >>> import gzip
    >>> gzip.decompress(gzipped([b"one " * 9, b"", b"two"])) == b"one " * 9 + b"two"
    True
    """
    out = [_GZIP_HEADER]
    check, size = 0, 0
    for part in parts:
        check = zlib.crc32(part, check)
        size += len(part)
        if part:
            out.append(_smallest(part))
    return b"".join([*out, _EMPTY_LAST_BLOCK, struct.pack("<II", check, size & 0xFFFFFFFF)])


def guessed_size(data: bytes) -> int:
    """Return about how many bytes `gzipped` makes of data, quickly: to compare orders of it."""
    if len(data) < MAX_MEASURED_BYTES:
        return len(zlib.compress(data, 1))
    return min(len(_deflated(data, 1, strategy)) for strategy in _WITHOUT_SEARCH)


_WITHOUT_SEARCH: Final = (zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)


def _smallest(part: bytes) -> bytes:
    plain = min((_deflated(part, 1, strategy) for strategy in _WITHOUT_SEARCH), key=len)
    quick = _deflated(part, 6, zlib.Z_DEFAULT_STRATEGY)
    if len(quick) > MAX_QUICK_RATIO * len(plain):
        return min(plain, quick, key=len)
    return _deflated(part, 9, zlib.Z_DEFAULT_STRATEGY)


def _deflated(part: bytes, level: int, strategy: int) -> bytes:
    """Return blocks of deflate that end at a whole byte, none of them the last (RFC 1951)."""
    packer = zlib.compressobj(level, zlib.DEFLATED, -zlib.MAX_WBITS, _MEMORY_LEVEL, strategy)
    return packer.compress(part) + packer.flush(zlib.Z_SYNC_FLUSH)
