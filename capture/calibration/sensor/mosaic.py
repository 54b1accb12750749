"""Read a color mosaic as one gray image, for scenes with the color of the light."""

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float32Array, Float64Array
from capture.raw import RawFrame

_COLOR_LETTERS = "RGB"


def channel_levels(frame: RawFrame) -> Float64Array:
    """Return the median of each channel above black, fraction of full scale, shape (3,).

    For a frame of gray objects this is the color of the light.
    """
    levels: dict[str, list[float]] = {}
    for cell, color in enumerate(_pattern(frame)):
        part = frame.cfa[cell // 2 :: 2, cell % 2 :: 2]
        level = (float(np.median(part)) - frame.black[cell]) / (frame.white - frame.black[cell])
        levels.setdefault(color, []).append(level)
    return np.array([float(np.mean(levels[color])) for color in _COLOR_LETTERS])


def neutral_mosaic(frame: RawFrame, color: ArrayLike) -> Float32Array:
    """Return a gray image of the sensor's full resolution, without interpolation.

    Parameters
    ----------
    frame : RawFrame
        Frame of a sensor with a 2 x 2 color filter array, showing objects of one color.
    color : array_like, shape (3,)
        Color of the objects in camera RGB, any scale, > 0.

    Returns
    -------
    ndarray of float32, shape (H, W)
        Fraction of full scale of the brightest channel.

    Raises
    ------
    ValueError
        If the color is not positive.

    Examples
    --------
    >>> cfa = np.array([[110, 120], [120, 105]], np.uint16)
    >>> frame = RawFrame(cfa=cfa, pattern="RGGB", black=(100.0,) * 4, white=200)
    >>> neutral_mosaic(frame, [0.5, 1.0, 0.25]).round(2).tolist()
    [[0.20000000298023224, 0.20000000298023224], [0.20000000298023224, 0.20000000298023224]]
    """
    rgb = np.asarray(color, np.float64)
    if rgb.shape != (3,) or not (rgb > 0).all() or not np.isfinite(rgb).all():
        raise ValueError(f"color: got {rgb.tolist()}, expected three numbers > 0")
    rgb = rgb / rgb.max()
    out = np.empty(frame.cfa.shape, np.float32)
    for cell, name in enumerate(_pattern(frame)):
        at = slice(cell // 2, None, 2), slice(cell % 2, None, 2)
        scale = 1.0 / ((frame.white - frame.black[cell]) * rgb[_COLOR_LETTERS.index(name)])
        values = frame.cfa[at].astype(np.float32)
        out[at] = (values - np.float32(frame.black[cell])) * np.float32(scale)
    return out


def _pattern(frame: RawFrame) -> str:
    if len(frame.pattern) != 4:
        raise ValueError(
            f"frame: got pattern {frame.pattern!r}, expected a 2 x 2 color filter array"
        )
    return frame.pattern
