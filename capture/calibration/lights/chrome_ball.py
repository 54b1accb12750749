"""Light directions from photographs of a chrome ball, seen from far away."""

from collections.abc import Sequence
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, gaussian_filter, label, map_coordinates

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import CalibrationError

HIGHLIGHT_LEVEL = 0.9  # of the brightest pixel: threshold of a highlight
MIN_HIGHLIGHT_CONTRAST = 4.0  # brightest pixel over the median: below it nothing is a highlight
MIN_BALL_PIXELS = 100
MIN_DISC_OVERLAP = 0.94
"""Area common to mask and disc over the area of either; a half disc has 0.6."""
MAX_STRAY_FRACTION = 0.05
"""Pixels of a mask apart from its largest part, over all: more are another object."""
MAX_OUTLINE_OFFSET = 0.05
"""Distance of the ball's outline in the images from the mask's, over the radius."""
MIN_OUTLINE_RATIO = 3.0
"""Contrast at the outline over that at the mask's, and over that of other places."""
MIN_OUTLINE_CONTRAST = 1e-3
"""Slope at an outline, in roots of the highlights' level per pixel: below it there is none."""
OUTLINE_SIDE_PX = 256
OUTLINE_RADIUS_PX = 60
"""Images are reduced for the search of the outline: their longer side and the ball's radius."""
OUTLINE_RADII = np.linspace(0.85, 1.15, 7)
"""Radii of the search over the mask's."""


class ChromeBallError(CalibrationError):
    """Raised for photographs of a ball without a highlight; the message names them."""


def directions_from_chrome_ball(images: Sequence[NDArray], mask: NDArray) -> Float64Array:
    """Return the directions to distant lights from their highlights on a mirror ball.

    Parameters
    ----------
    images : sequence of ndarray, shape (H, W) or (H, W, 3)
        One photograph per light, any monotonic scale, the ball at one position.
    mask : ndarray, shape (H, W) or (H, W, 3)
        Mask of the ball: bool, or brighter than half its largest value. Stray pixels are left out.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Unit vectors to the lights: x right, y up, z towards the camera.

    Raises
    ------
    ChromeBallError
        If shapes differ, an image shows no highlight, or the mask is empty, not a disc, or away
        from the ball's outline in the images; the message names it.

    Notes
    -----
    The camera looks along -z from far away (orthographic): a highlight at the point of normal n is
    a light in the direction 2 (n . z) n - z. Perspective would rotate it by up to the angle at
    which the ball is seen.

    Examples
    --------
    >>> y, x = np.mgrid[:81, :81] - 40
    >>> ball = x**2 + y**2 <= 30**2
    >>> spot = np.exp(-((x - 15) ** 2 + y**2) / 4.0)
    >>> directions_from_chrome_ball([spot], ball).round(2).tolist()
    [[0.87, -0.0, 0.5]]
    """
    inside = np.asarray(mask)
    inside = inside.max(axis=-1) if inside.ndim == 3 else inside
    inside = inside if inside.dtype == bool else inside > 0.5 * inside.max(initial=0)
    count = int(np.count_nonzero(inside))
    if inside.ndim != 2 or count < MIN_BALL_PIXELS:
        raise ChromeBallError(
            f"mask: got {count} pixels of a ball in shape {inside.shape}, expected (H, W) and at"
            f" least {MIN_BALL_PIXELS}"
        )
    inside, middle, radius = _fit_disc(inside)
    directions = []
    total = np.zeros(inside.shape)
    for number, image in enumerate(images):
        gray = np.asarray(image, np.float64)
        gray = gray.mean(axis=-1) if gray.ndim == 3 else gray
        if gray.shape != inside.shape:
            raise ChromeBallError(
                f"image {number}: got shape {gray.shape}, expected {inside.shape} as the mask"
            )
        spot = _highlight_center(gray, inside)
        if spot is None:
            raise ChromeBallError(
                f"image {number}: shows no highlight on the ball, expected a bright one; omit "
                "the image, or light the ball"
            )
        total += np.nan_to_num(gray / gray[int(spot[1]), int(spot[0])], posinf=0.0, neginf=0.0)
        across = (spot - middle) / radius
        x, y = float(across[0]), -float(across[1])
        z = float(np.sqrt(max(1.0 - x * x - y * y, 0.0)))
        n = np.array([x, y, z])
        direction = 2.0 * z * n - np.array([0.0, 0.0, 1.0])
        directions.append(direction / np.linalg.norm(direction))
    _require_outline(total, middle, radius)
    return np.array(directions).reshape(-1, 3)


def _fit_disc(mask: BoolArray) -> tuple[BoolArray, Float64Array, float]:
    """Return the largest part of a mask without holes, its center (column, row) and its radius.

    Raises
    ------
    ChromeBallError
        If another part is large, or the part is not a disc.
    """
    parts, _ = label(mask)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    stray = 1.0 - float(sizes.max() / sizes.sum())
    if stray > MAX_STRAY_FRACTION:
        raise ChromeBallError(
            f"mask: got {stray:.0%} of its pixels apart from the largest part, expected one disc; "
            "mask the ball alone"
        )
    inside = np.asarray(binary_fill_holes(parts == int(sizes.argmax())))
    rows, columns = np.nonzero(inside)
    middle = np.array([columns.mean(), rows.mean()])
    radius = float(np.sqrt(len(rows) / np.pi))
    y, x = np.indices(inside.shape)
    disc = np.hypot(x - middle[0], y - middle[1]) < radius
    overlap = np.count_nonzero(disc & inside) / np.count_nonzero(disc | inside)
    if overlap < MIN_DISC_OVERLAP:
        raise ChromeBallError(
            f"mask: got a shape that overlaps a disc of its area by {overlap:.0%}, expected "
            f"{MIN_DISC_OVERLAP:.0%} or more; mask the whole ball, inside the image"
        )
    return inside, middle, radius


def _require_outline(total: Float64Array, middle: Float64Array, radius: float) -> None:
    """Raise `ChromeBallError` if the images have the ball's outline away from the mask's.

    The contrast of a circle is the median over it, so that highlights do not count. Images
    without an outline, such as a dark ball before a dark background, are not judged.
    """
    step = ceil(max(max(total.shape) / OUTLINE_SIDE_PX, radius / OUTLINE_RADIUS_PX, 1.0))
    reduced = gaussian_filter(np.sqrt(np.maximum(total, 0.0)), step)[::step, ::step]
    down, across = np.gradient(reduced)
    center, size = middle / step, radius / step
    angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle)])
    reach = np.arange(-np.ceil(size), np.ceil(size) + 1.0)
    moves = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    rows = [
        _measure_contrast(across, down, center + moves, size * scale * out)
        for scale in OUTLINE_RADII
    ]
    contrast = np.concatenate(rows)
    scales = OUTLINE_RADII.repeat(len(moves))
    moves = np.tile(moves, (len(OUTLINE_RADII), 1))
    best = int(contrast.argmax())
    shift = np.hypot(moves[:, 0], moves[:, 1])
    off = np.maximum(shift, size * np.abs(scales - 1.0))
    here = float(contrast[off <= 1.0].max())
    other = max(here, float(np.median(contrast)))
    if off[best] > max(MAX_OUTLINE_OFFSET * size, 2.0) and contrast[best] > max(
        MIN_OUTLINE_RATIO * other, MIN_OUTLINE_CONTRAST
    ):
        right, below = (float(value) for value in step * moves[best])
        raise ChromeBallError(
            "mask: got a disc away from the ball's outline, which the images have "
            f"{right:+.0f} px to the right and {-below:+.0f} px up, with {scales[best]:.2f} "
            "times the mask's radius; expected the ball's own mask"
        )


def _measure_contrast(
    across: Float64Array, down: Float64Array, centers: Float64Array, ring: Float64Array
) -> Float64Array:
    """Return the median radial slope on circles around centers (N, 2), from a ring (2, A)."""
    x, y = centers.T[:, :, None] + ring[:, None]
    normal = ring / np.linalg.norm(ring, axis=0)
    radial = normal[0] * map_coordinates(across, [y, x], order=1, mode="nearest")
    radial += normal[1] * map_coordinates(down, [y, x], order=1, mode="nearest")
    return np.asarray(np.median(np.abs(radial), axis=1))


def _highlight_center(gray: NDArray, inside: BoolArray) -> Float64Array | None:
    """Return column and row of the brightest spot's centroid, or None without a bright spot.

    Parameters
    ----------
    gray : ndarray of float, shape (H, W)
    inside : ndarray of bool, shape (H, W)
        Mask of the ball.
    """
    values = np.where(inside & np.isfinite(gray), gray, 0.0)
    brightest = float(values.max(initial=0.0))
    usual = float(np.median(values[inside])) if inside.any() else 0.0
    if not brightest > max(MIN_HIGHLIGHT_CONTRAST * usual, 0.0):
        return None
    spots, count = label(values >= HIGHLIGHT_LEVEL * brightest)
    sizes = np.bincount(spots.ravel(), minlength=count + 1)
    sizes[0] = 0
    spot = spots == int(np.argmax(sizes))
    rows, columns = np.nonzero(spot)
    weights = values[spot]
    return np.array([columns @ weights, rows @ weights]) / weights.sum()
