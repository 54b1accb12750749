"""Bytes as text that HTML leaves alone, seven bits a byte of UTF-8."""

from __future__ import annotations

from typing import Final

import numpy as np

UNSAFE: Final = (0, 8, 9, 10, 11, 12, 13, 26, 27, 34, 38, 60, 127)
"""Codes of characters that HTML, editors or transports may change: controls, line ends, and those
with which markup begins."""


def as_text(data: bytes) -> str:
    """Return bytes as text of which UTF-8 holds seven bits a byte (base64: six).

    A character below 128 is seven bits, the first the highest. Those that a page or an editor may
    change (`UNSAFE`) become, with the seven bits behind them, one of two bytes:
    ``(index in UNSAFE + 1) * 128 + next``.

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
    codes = (groups @ (1 << np.arange(6, -1, -1))).astype(np.uint16)
    unsafe = np.full(128, -1, np.int64)
    unsafe[list(UNSAFE)] = np.arange(len(UNSAFE))
    if len(codes) and unsafe[codes[-1]] >= 0:
        codes = np.append(codes, np.uint16(32))  # something for the last to be joined with
    keep = np.ones(len(codes), np.bool_)
    behind = -1  # the last that was joined to one before it
    for at in np.flatnonzero(unsafe[codes] >= 0):
        if at == behind:
            continue
        behind = int(at) + 1
        keep[behind] = False
        codes[at] = (unsafe[codes[at]] + 1) * 128 + codes[behind]
    return codes[keep].astype("<u2").tobytes().decode("utf-16-le")
