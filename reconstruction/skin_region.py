"""Find the skin around a face of which only the square is given: the rest has other colors.

Cheeks and nose give the color of this skin in this light. A pixel belongs to the face's skin if its
color is that color within a tolerance, and if a path of such pixels leads from it to the cheeks.
Hair, eyes, teeth, clothes and walls are left out. So is skin of clearly another color: painted lips
and dark moles.
"""

from typing import Final

import numpy as np

from reconstruction.arrays import BoolArray, Float32Array, Float64Array

SEED_ELLIPSES: Final = (
    (0.28, 0.62, 0.10, 0.14),
    (0.72, 0.62, 0.10, 0.14),
    (0.50, 0.55, 0.06, 0.12),
)
"""Cheeks and nose: centers and half axes of ellipses relative to the face's square."""
FACE_ELLIPSE: Final = (0.50, 0.60, 0.85, 1.15)
"""Ellipse outside which nothing belongs to the face, relative to its square."""
COLOR_SD: Final = (0.07, 0.09, 0.70)
"""Least standard deviations of log red/green, log blue/green and log green over a face: blood and
melanin change the ratios, light and gloss the brightness."""
MAX_SQUARED_DISTANCE: Final = 14.2
"""Squared distance of a color that 0.27 % of normal deviates in three dimensions exceed."""


def find_face_skin(rgb: Float32Array, valid: BoolArray, face: tuple[float, ...]) -> BoolArray:
    """Find the skin of a face.

    Parameters
    ----------
    rgb
        (H, W, 3): linear light, any white.
    valid
        (H, W): pixels with a value.
    face
        Left, top, width and height of the face's square over those of the image.

    Returns
    -------
    BoolArray
        (H, W): pixels of the face's skin; none if cheeks and nose have no value.

    Examples
    --------
    >>> scene = np.tile(np.float32([0.3, 0.3, 0.3]), (40, 40, 1))
    >>> scene[8:32, 8:32] = 0.5, 0.3, 0.2
    >>> skin = find_face_skin(scene, np.ones((40, 40), bool), (0.25, 0.25, 0.5, 0.5))
    >>> bool(skin[8:32, 8:32].all()), int(skin.sum())
    (True, 576)
    """
    import cv2

    height, width = valid.shape
    square = np.asarray(face) * [width, height, width, height]
    usable = valid & (rgb > 0).all(axis=-1)
    seeds = np.zeros(valid.shape, bool)
    for ellipse in SEED_ELLIPSES:
        seeds |= _fill_ellipse(valid.shape, square, ellipse)
    seeds &= usable
    if not seeds.any():
        return seeds
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log(np.where(usable[..., None], rgb, 1.0).astype(np.float64))
    color = np.stack([log[..., 0] - log[..., 1], log[..., 2] - log[..., 1], log[..., 1]], axis=-1)
    near = usable & _fill_ellipse(valid.shape, square, FACE_ELLIPSE)
    alike = near & (_squared_distance(color, color[seeds]) < MAX_SQUARED_DISTANCE)
    # a single pixel does not connect the face with a background of its color
    opened = cv2.morphologyEx(alike.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, parts = cv2.connectedComponents(opened)
    count = np.bincount(parts[seeds & (opened > 0)], minlength=2)
    return np.asarray((parts == count.argmax()) & (count.max() > 0))


def _fill_ellipse(
    shape: tuple[int, ...], square: Float64Array, ellipse: tuple[float, ...]
) -> BoolArray:
    x, y, across, down = ellipse
    left, top, width, height = square
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    right_of = (columns + 0.5 - left - x * width) / (across * width)
    below = (rows + 0.5 - top - y * height) / (down * height)
    return np.asarray(right_of**2 + below**2 <= 1)


def _squared_distance(color: Float64Array, seeds: Float64Array) -> Float64Array:
    """Return squared distances from the seeds' color; half of the seeds may have another one."""
    center = np.median(seeds, axis=0)
    spread = np.maximum(np.median(np.abs(seeds - center), axis=0) * 1.4826, COLOR_SD)
    return np.asarray((((color - center) / spread) ** 2).sum(axis=-1))
