"""Light directions from photographs of a chrome ball, seen from far away."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import CalibrationError

HIGHLIGHT_LEVEL = 0.9  # of the brightest pixel: threshold of a highlight
MIN_HIGHLIGHT_CONTRAST = 4.0  # brightest pixel over the median: below it nothing is a highlight
MIN_BALL_PIXELS = 100


class ChromeBallError(CalibrationError):
    """Raised for photographs of a ball without a highlight; the message names them."""


def directions_from_chrome_ball(images: Sequence[NDArray], mask: NDArray) -> Float64Array:
    """Return the directions to distant lights from their highlights on a mirror ball.

    Parameters
    ----------
    images : sequence of ndarray, shape (H, W) or (H, W, 3)
        One photograph per light, any monotonic scale, the ball at one position.
    mask : ndarray, shape (H, W) or (H, W, 3)
        Mask of the ball: bool, or brighter than half its largest value.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Unit vectors to the lights: x right, y up, z towards the camera.

    Raises
    ------
    ChromeBallError
        If shapes differ, the mask is empty, or an image shows no highlight; the message names it.

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
    [[0.86, -0.0, 0.52]]
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
    rows, columns = np.nonzero(inside)
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    radius = (np.ptp(columns) + np.ptp(rows) + 2) / 4
    directions = []
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
        across = (spot - middle) / radius
        x, y = float(across[0]), -float(across[1])
        z = float(np.sqrt(max(1.0 - x * x - y * y, 0.0)))
        n = np.array([x, y, z])
        direction = 2.0 * z * n - np.array([0.0, 0.0, 1.0])
        directions.append(direction / np.linalg.norm(direction))
    return np.array(directions).reshape(-1, 3)


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
