"""Store smooth maps on coarse grids: average over valid pixels, and interpolate back."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from model.arrays import BoolArray, Float64Array


class CoarseMapError(ValueError):
    """Error for a size at which no map can be stored."""


@dataclass(frozen=True, slots=True, eq=False)
class CoarseGrid:
    """Relation between the pixels of a map and the cells of a coarse one.

    Cell and pixel grids cover the same rectangle. A cell is the mean of the valid pixels in it, by
    area; a pixel is interpolated bilinearly between the centers of the cells that contain valid
    pixels. Both are linear and preserve a constant.
    """

    shape: tuple[int, int]
    """Of the map, (H, W) px."""
    stored: tuple[int, int]
    """Of the small map, (h, w) cells, at most that of the map."""

    def __post_init__(self) -> None:
        """Raise for cells smaller than pixels."""
        for full, few in zip(self.shape, self.stored, strict=True):
            if not 1 <= few <= full:
                raise CoarseMapError(f"stored: got {self.stored}, expected 1 to {self.shape}")

    def coarsen(self, values: Float64Array, valid: BoolArray) -> tuple[Float64Array, BoolArray]:
        """Return the means of the cells (h, w), 0 where there is none, and the mask of means.

        Parameters
        ----------
        values
            (H, W); ignored where not valid.
        valid
            (H, W).
        """
        down, across = (_areas(*pair) for pair in zip(self.shape, self.stored, strict=True))
        weight = down @ valid.astype(np.float64) @ across.T
        # relative to one value, so that a constant is preserved to the last digit
        about = float(values[valid].mean()) if valid.any() else 0.0
        total = down @ np.where(valid, values - about, 0.0) @ across.T
        held = weight > 1e-9
        return np.where(held, about + total / np.where(held, weight, 1.0), 0.0), held

    def refine(self, *cells: Float64Array, valid: BoolArray) -> tuple[Float64Array, ...]:
        """Return small maps at the size of the map; NaN where no valid cell is near.

        Parameters
        ----------
        cells
            Each (h, w).
        valid
            (h, w): cells with a value.
        """
        down, across = (
            _interpolation_weights(*pair) for pair in zip(self.shape, self.stored, strict=True)
        )
        if valid.all():
            return tuple(np.asarray(down @ one @ across.T) for one in cells)
        weight = down @ valid.astype(np.float64) @ across.T
        weight = np.where(weight > 0.0, weight, np.nan)
        return tuple(
            np.asarray((down @ np.where(valid, one, 0.0) @ across.T) / weight) for one in cells
        )


def coarse_grid(shape: tuple[int, int], size: int | None) -> CoarseGrid:
    """Return the grid of a map stored at ``size`` cells per side, or its own size if that is less.

    Examples
    --------
    >>> coarse_grid((2048, 100), 256).stored
    (256, 100)
    """
    if size is not None and size < 1:
        raise CoarseMapError(f"size: got {size}, expected at least 1 cell")
    few = shape if size is None else (min(shape[0], size), min(shape[1], size))
    return CoarseGrid(shape, few)


def _areas(pixels: int, cells: int) -> csr_array:
    """Return the fraction of each pixel inside each cell, (cells, pixels)."""
    edges = np.arange(cells + 1) * (pixels / cells)
    starts = np.floor(edges[:-1] + 1e-9).astype(np.intp)
    ends = np.minimum(np.ceil(edges[1:] - 1e-9).astype(np.intp), pixels)
    rows = np.repeat(np.arange(cells), ends - starts)
    columns = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])
    share = np.minimum(columns + 1, edges[rows + 1]) - np.maximum(columns, edges[rows])
    return csr_array((share, (rows, columns)), shape=(cells, pixels))


def _interpolation_weights(pixels: int, cells: int) -> csr_array:
    """Return the weights of linear interpolation between cell centers, (pixels, cells)."""
    at = np.clip((np.arange(pixels) + 0.5) * (cells / pixels) - 0.5, 0.0, cells - 1.0)
    low = np.minimum(at.astype(np.intp), max(cells - 2, 0))
    high = np.minimum(low + 1, cells - 1)
    share = at - low
    rows = np.tile(np.arange(pixels), 2)
    return csr_array(
        (np.concatenate([1.0 - share, share]), (rows, np.concatenate([low, high]))),
        shape=(pixels, cells),
    )
