"""Fill holes of maps, and downsample maps."""

import numpy as np

from model.facial_color.coarse_maps import CoarseGrid, coarse_grid
from skinrig.arrays import BoolArray, Float64Array, FloatArray


def fill_holes(values: FloatArray, valid: BoolArray) -> Float64Array:
    """Fill invalid texels from their surroundings, so that texture filters are unaffected.

    Means over increasingly large cells are interpolated back until all texels are filled.

    Parameters
    ----------
    values
        (H, W) or (H, W, C); invalid values are ignored.
    valid
        (H, W); if no texel is valid, the result is 0.

    Examples
    --------
    >>> fill_holes(np.array([[1.0, 7.0], [1.0, 1.0]]), np.array([[True, False], [True,
    ...     True]])).tolist()
    [[1.0, 1.0], [1.0, 1.0]]
    """
    if values.ndim == 3:
        return np.stack([fill_holes(one, valid) for one in np.moveaxis(values, -1, 0)], axis=-1)
    out = np.where(valid, values, 0.0).astype(np.float64)
    missing = ~valid
    few = (values.shape[0], values.shape[1])
    while missing.any() and valid.any():
        few = (max(1, few[0] // 2), max(1, few[1] // 2))
        cells = CoarseGrid(valid.shape, few)
        coarse, held = cells.coarsen(out, valid)
        (up,) = cells.refine(coarse, valid=held)
        known = missing & np.isfinite(up)
        out[known] = up[known]
        missing &= ~known
    return out


def downsample(values: Float64Array, size: int) -> Float64Array:
    """Return means over cells, (size, size[, C]); smaller maps are unchanged."""
    if values.shape[0] <= size:
        return values
    cells = coarse_grid((values.shape[0], values.shape[1]), size)
    everywhere = np.ones(values.shape[:2], np.bool_)
    if values.ndim == 2:
        return cells.coarsen(values, everywhere)[0]
    return np.stack([cells.coarsen(one, everywhere)[0] for one in np.moveaxis(values, -1, 0)], -1)
