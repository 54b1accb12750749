"""Read a frame's linear values, of a mosaic or of a monochrome sensor."""

import numpy as np

from capture import raw
from reconstruction.arrays import BoolArray, Float32Array


def read_linear(frame: raw.RawFrame) -> tuple[Float32Array, BoolArray]:
    """Return values (H, W, C) as fractions of the range, and which are not saturated (H, W).

    A mosaic has half the rows and columns and three channels, a monochrome frame one channel.
    """
    if frame.pattern == "MONO":
        (black,) = frame.black
        values = (frame.cfa.astype(np.float32) - black) / np.float32(frame.white - black)
        return values[..., None], frame.cfa < frame.white
    image = raw.linear_rgb(frame, demosaic="superpixel")
    return image.rgb, image.valid
