"""Bytes as text that HTML leaves alone, seven bits a byte of UTF-8."""

from typing import Final

import numpy as np

UNSAFE_CODES: Final = (0, 8, 9, 10, 11, 12, 13, 26, 27, 34, 38, 60, 127)
"""Codes of characters that HTML, editors or transports may change: controls, line ends, and those
with which markup begins."""


def as_text(data: bytes) -> str:
    """Return bytes as text of which UTF-8 holds seven bits a byte (base64: six).

    A character below 128 is seven bits, the first the highest. Those that a page or an editor may
    change (`UNSAFE_CODES`) become, with the seven bits behind them, one of two bytes:
    ``(index in UNSAFE_CODES + 1) * 128 + next``.

    Parameters
    ----------
    data
        Any bytes.

    Examples
    --------
    >>> [ord(one) for one in as_text(bytes([131, 6]))]
    [65, 65, 64]
    """
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    groups = np.concatenate([bits, np.zeros(-len(bits) % 7, np.uint8)]).reshape(-1, 7)
    codes = (np.packbits(groups, axis=1)[:, 0] >> 1).astype(np.uint16)
    unsafe = np.full(128, -1, np.int64)
    unsafe[list(UNSAFE_CODES)] = np.arange(len(UNSAFE_CODES))
    if len(codes) and unsafe[codes[-1]] >= 0:
        codes = np.append(codes, np.uint16(32))  # something for the last to be joined with
    found = np.flatnonzero(unsafe[codes] >= 0)
    # of several behind each other every other one is joined to the one before it
    begins = np.diff(found, prepend=-2) > 1
    first = found[begins][np.cumsum(begins) - 1] if len(found) else found
    joining = found[(found - first) % 2 == 0]
    codes[joining] = (unsafe[codes[joining]] + 1) * 128 + codes[joining + 1]
    keep = np.ones(len(codes), np.bool_)
    keep[joining + 1] = False
    return codes[keep].astype("<u2").tobytes().decode("utf-16-le")
