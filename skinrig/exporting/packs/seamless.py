"""Relief that repeats without a seam, and its normals."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skinrig.arrays import Float64Array

FADE_DIVISOR: Final = 8
"""One part of so many of a tile is faded into what lies beyond its other end."""


def periodic(image: ArrayLike) -> Float64Array:
    """Return an image that repeats without a seam: what is beyond its end fades into its beginning.

    By weights whose squares sum to 1, so that relief of independent places keeps its variance.

    Parameters
    ----------
    image
        (H, W), finite, mean 0; 8 pixels and more a side.

    Returns
    -------
    ndarray
        Smaller by an eighth along each axis; beyond the faded eighth its values are the image's.

    Examples
    --------
    >>> image = np.random.default_rng(0).normal(size=(64, 80))
    >>> tile = periodic(image)
    >>> tile.shape, np.array_equal(tile[8:, 10:], image[8:56, 10:70])
    ((56, 70), True)
    """
    found = np.asarray(image, np.float64)
    for axis in (0, 1):
        found = np.moveaxis(found, axis, 0)
        band = len(found) // FADE_DIVISOR
        size = len(found) - band
        # 0 with a slope of 0 at the beginning, 1 with a slope of 0 at the end
        share = np.sin(0.5 * np.pi * np.sin(0.5 * np.pi * np.arange(band) / band) ** 2)
        rise, fall = share[:, None], np.sqrt(1.0 - share**2)[:, None]
        faded = rise * found[:band] + fall * found[size:]
        found = np.moveaxis(np.concatenate([faded, found[band:size]]), 0, axis)
    return found


def periodic_normals(height_um: Float64Array, pixel_um: float) -> Float64Array:
    """Return unit normals of relief that repeats, (H, W, 3), +Y up, row 0 at the top.

    Examples
    --------
    >>> x = np.arange(64)
    >>> relief = np.sin(2 * np.pi * x / 64) * np.ones((4, 1))
    >>> normals = periodic_normals(relief, 1.0)
    >>> round(float(-normals[0, 0, 0] / normals[0, 0, 2]), 3), float(normals[0, 16, 0].round(6))
    (0.098, -0.0)
    """
    along_x = (np.roll(height_um, -1, 1) - np.roll(height_um, 1, 1)) / (2.0 * pixel_um)
    along_y = (np.roll(height_um, 1, 0) - np.roll(height_um, -1, 0)) / (2.0 * pixel_um)
    normals = np.stack([-along_x, -along_y, np.ones(height_um.shape)], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
