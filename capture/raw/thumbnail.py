"""Draw the small picture of a raw frame that file managers and raw developers list.

References
----------
Digital Negative (DNG) Specification 1.6, Adobe, 2021, "Preview Images".
"""

from typing import Final

import numpy as np

from capture.arrays import UInt8Array
from capture.raw.frame import RawFrame

MAX_SIDE_PX: Final = 160
"""Longer side of a thumbnail at most, pixels, as in EXIF."""
MIN_BLOCK_PX: Final = 8
"""Side of the block of photosites for a thumbnail's pixel.

A thumbnail's 3 bytes per block are 2.4 % of the photosites' 128; its directory is extra.
"""
MIN_FRAME_PX: Final = 64
"""Smaller frames have no thumbnail."""
DISPLAY_GAMMA: Final = 2.2
"""Exponent of a display's transfer function."""


def draw_thumbnail(frame: RawFrame) -> UInt8Array | None:
    """Draw one photosite of each color per block, relative to the neutral of the frame.

    Parameters
    ----------
    frame
        The frame, at least `MIN_FRAME_PX` and one block wide and high; a smaller or longer one
        has no thumbnail.

    Returns
    -------
    array of uint8, shape (H, W, 3), or None
        Red, green and blue for a display, row 0 at the top.

    Examples
    --------
    >>> gray = np.full((64, 128), 600, np.uint16)
    >>> frame = RawFrame(cfa=gray, pattern="RGGB", black=(100.0,) * 4, white=1100)
    >>> draw_thumbnail(frame)[:2, :2, 0].tolist(), draw_thumbnail(frame).shape
    ([[186, 186], [186, 186]], (8, 16, 3))
    """
    height, width = frame.cfa.shape
    if min(height, width) < MIN_FRAME_PX:
        return None
    block = max(MIN_BLOCK_PX, 2 * -(-max(height, width) // (2 * MAX_SIDE_PX)))
    rows, columns = height // block, width // block
    if 0 in (rows, columns):
        return None
    neutral = frame.neutral or (1.0, 1.0, 1.0)
    channels = []
    for color, balance in zip("RGB", neutral, strict=True):
        place = 0 if frame.pattern == "MONO" else frame.pattern.index(color)
        row, column = divmod(place, 2)
        values = frame.cfa[row::block, column::block][:rows, :columns]
        black = frame.black[place]
        share = (values - np.float32(black)) / np.float32((frame.white - black) * balance)
        channels.append(np.clip(share, 0.0, 1.0) ** np.float32(1.0 / DISPLAY_GAMMA))
    return (255.0 * np.stack(channels, axis=-1) + 0.5).astype(np.uint8)
