"""Track points from one image to another by optical flow, checked both ways."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, UInt8Array


class RegistrationError(ValueError):
    """Images or points that cannot be registered."""


CONTRAST_SIGMA_PX = 8.0
MAX_BACKTRACK_ERROR_PX = 0.3
"""Largest distance of a point from its start after the way back, px."""
MIN_IMAGE_PEAK = 1e-12
"""Brightest value below which, or above whose inverse, an image is rescaled: local standard
deviations would fall below the floor for textureless areas, or overflow."""


@dataclass(frozen=True, slots=True)
class Tracks:
    """Positions of tracked points in the second image.

    Attributes
    ----------
    points_px : ndarray of float64, shape (K, 2)
        Column and row in the second image; where not `valid`, those in the first.
    valid : ndarray of bool, shape (K,)
        Found inside the image, and consistent on the way back.
    """

    points_px: Float64Array
    valid: BoolArray


def normalize_local_contrast(image: FloatArray) -> UInt8Array:
    """Normalize an image to local contrast, 8 bit: local mean and standard deviation are removed.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Linear values, any unit. Values that are not finite count as 0.
    sigma_px : float
        Of the neighborhood, px, > 0.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        128 is the local mean, 32 one local standard deviation.

    Raises
    ------
    RegistrationError
        If `image` is not (H, W) of at least 16 x 16.
    """
    Checks(RegistrationError).shape("image", image, ("H", "W"))
    Checks(RegistrationError).within("sides of image, px", np.shape(image), "[16, inf)")
    known = np.isfinite(image)
    values = np.maximum(np.where(known, image, 0.0), 0.0)
    top = float(values.max())
    if top > 0.0 and not MIN_IMAGE_PEAK < top < 1.0 / MIN_IMAGE_PEAK:
        values = values / top  # squares would overflow or vanish in single precision
    values = np.sqrt(values).astype(np.float32)
    mean = cv2.GaussianBlur(values, (0, 0), CONTRAST_SIGMA_PX)
    rest = values - mean
    spread = np.sqrt(cv2.GaussianBlur(rest * rest, (0, 0), 2 * CONTRAST_SIGMA_PX))
    floor = 1e-2 * float(spread.max(initial=0.0)) + 1e-12
    return np.clip(np.rint(128 + 32 * rest / np.maximum(spread, floor)), 0, 255).astype(np.uint8)


def is_inside_image(at_px: FloatArray, shape: tuple[int, ...], margin_px: int = 0) -> BoolArray:
    """Return which positions (..., 2), column and row, are in an image, less a margin."""
    last = [shape[1] - 1 - margin_px, shape[0] - 1 - margin_px]
    return np.asarray(((at_px >= margin_px) & (at_px <= last)).all(axis=-1))


def select_textured_points(
    local_contrast: UInt8Array,
    points_px: Float64Array,
    *,
    count: int,
    cell_px: int = 12,
    margin_px: int = 12,
) -> NDArray[np.intp]:
    """Choose points that can be tracked: the one with most texture in each cell of the image.

    Parameters
    ----------
    local_contrast : ndarray of uint8, shape (H, W)
        See `normalize_local_contrast`.
    points_px : ndarray, shape (P, 2)
        Candidates; those that are not finite or too near the border are omitted.
    count : int
        Largest number to choose, by most texture.
    cell_px, margin_px : int
        Side of the cells, and width of the border, px.

    Returns
    -------
    ndarray of int
        Indices into `points_px`.
    """
    width = local_contrast.shape[1]
    with np.errstate(invalid="ignore"):
        chosen = np.flatnonzero(is_inside_image(points_px, local_contrast.shape, margin_px))
    if not chosen.size:
        return chosen
    places = np.rint(points_px[chosen]).astype(int)
    texture = cv2.cornerMinEigenVal(local_contrast, 9, ksize=3)[places[:, 1], places[:, 0]]
    cell = (places[:, 1] // cell_px) * (width // cell_px + 1) + places[:, 0] // cell_px
    order = np.lexsort((-texture, cell))
    first = np.ones(order.size, bool)
    first[1:] = cell[order][1:] != cell[order][:-1]
    best = order[first]
    best = best[texture[best] > 0]
    best = best[np.argsort(-texture[best], kind="stable")[:count]]
    return np.sort(chosen[best])


def track_points(
    first: UInt8Array,
    second: UInt8Array,
    points_px: Float64Array,
    *,
    window_px: int = 17,
    levels: int = 3,
) -> Tracks:
    """Track points from one image to another by pyramidal Lucas-Kanade, forth and back.

    Parameters
    ----------
    first, second : ndarray of uint8, shape (H, W)
        See `normalize_local_contrast`.
    points_px : ndarray, shape (K, 2)
        Column and row in `first`.
    window_px : int
        Side of the window, px.
    levels : int
        Levels of the pyramid above the image.

    Returns
    -------
    Tracks
    """
    Checks(RegistrationError).shape("second", second, first.shape)
    start: Any = np.ascontiguousarray(points_px, np.float32).reshape(-1, 1, 2)
    if not len(start):
        return Tracks(np.zeros((0, 2)), np.zeros(0, bool))
    settings: dict[str, Any] = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.003),
    }
    one: Any = first
    two: Any = second
    there, found, _ = cv2.calcOpticalFlowPyrLK(one, two, start, None, **settings)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(two, one, there, None, **settings)
    gap = np.linalg.norm(back - start, axis=-1).reshape(-1)
    there = there.reshape(-1, 2).astype(np.float64)
    inside = is_inside_image(there, first.shape)
    good = (
        (found.reshape(-1) == 1)
        & (returned.reshape(-1) == 1)
        & inside
        & (gap <= MAX_BACKTRACK_ERROR_PX)
    )
    return Tracks(np.where(good[:, None], there, start.reshape(-1, 2)), good)
