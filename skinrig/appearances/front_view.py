"""Project surface points to an image from the front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skinrig.arrays import BoolArray, Float64Array, FloatArray

FRONT_VIEW_WIDTH_PX = 220
"""Image width."""


@dataclass(frozen=True, slots=True)
class FrontView:
    """Orthographic projection of surface points to an image from the front.

    Attributes
    ----------
    shape
        Rows and columns of the image.
    rows, columns
        Pixel of each point, shape (N,); -1 outside the image.
    order
        Indices of the points from back to front, shape (N,).
    """

    shape: tuple[int, int]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    order: NDArray[np.intp]

    @staticmethod
    def of(position_mm: FloatArray, box: tuple[FloatArray, FloatArray]) -> FrontView:
        """Project points, shape (N, 3), along -z; a box given by two corners is the image."""
        low, high = box
        pixel = max(float(high[0] - low[0]) / FRONT_VIEW_WIDTH_PX, 1e-9)
        height = max(int(np.ceil(float(high[1] - low[1]) / pixel)), 1)
        columns = np.floor((position_mm[:, 0] - low[0]) / pixel).astype(np.intp)
        rows = np.floor((high[1] - position_mm[:, 1]) / pixel).astype(np.intp)
        inside = (columns >= 0) & (columns < FRONT_VIEW_WIDTH_PX) & (rows >= 0) & (rows < height)
        return FrontView(
            (height, FRONT_VIEW_WIDTH_PX),
            np.where(inside, rows, -1),
            np.where(inside, columns, -1),
            np.argsort(position_mm[:, 2], kind="stable"),
        )

    def rasterize(
        self, values: FloatArray, *, valid: BoolArray | None = None
    ) -> tuple[Float64Array, BoolArray]:
        """Return the image of a value per point, (N,) or (N, 3), and its valid pixels.

        The frontmost point of a pixel is visible; gaps of up to two pixels between points get the
        value of the nearest.
        """
        chosen = self.order[(self.rows[self.order] >= 0)]
        image = np.zeros((*self.shape, *values.shape[1:]))
        hit = np.zeros(self.shape, bool)
        good = np.zeros(self.shape, bool)
        at = self.rows[chosen], self.columns[chosen]
        image[at] = values[chosen]
        hit[at] = True
        good[at] = True if valid is None else valid[chosen]
        distance, nearest = ndimage.distance_transform_edt(~hit, return_indices=True)
        image, good = image[tuple(nearest)], good[tuple(nearest)]
        return image, good & (distance <= 2.0)
