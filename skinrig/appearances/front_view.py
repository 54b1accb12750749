"""A surface seen from the front: its points as a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from skinrig.arrays import BoolArray, Float64Array, FloatArray

FRONT_VIEW_WIDTH_PX = 220
"""Pixels across."""


@dataclass(frozen=True, slots=True)
class FrontView:
    """Points of a surface as they lie in a picture from the front, without perspective.

    Attributes
    ----------
    shape
        Rows and columns of the picture.
    rows, columns
        Where each point falls, shape (N,); -1 outside the picture.
    order
        Points from the back to the front, shape (N,).
    """

    shape: tuple[int, int]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    order: NDArray[np.intp]

    @staticmethod
    def of(position_mm: FloatArray, box: tuple[FloatArray, FloatArray]) -> FrontView:
        """Look along -z at points, shape (N, 3), inside a box given by its two corners."""
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
        """Return the picture of a value at each point, (N,) or (N, 3), and where there is one.

        The frontmost point of a pixel is shown; gaps of up to two pixels between points take the
        nearest one's value.
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
