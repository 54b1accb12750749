"""Gather subsurface scattering on a grid of surface points by the dipole (`model.dipole`)."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage

from model.dipole import gather as dipole_gather
from skinrig.arrays import Float64Array

SHADED_CELLS: Final = 125
"""Side of the grid on which light enters the skin and leaves it: 80 um of a patch of 10 mm."""
SKIN_COLOR: Final = (0.46, 0.31, 0.23)
"""R_d of red, green and blue light: the mean of simulated faces."""
SKIN_PATH_MM: Final = (1.84, 1.02, 0.645)
"""1/sigma_tr of red, green and blue light at the forehead, mm (Weyrich et al. 2005, table 2)."""


def gather_subsurface(
    points: Float64Array, area: Float64Array, entered: Float64Array
) -> Float64Array:
    """Return the exitance, (N, N, 3), of light that entered, gathered on a coarser grid.

    Parameters
    ----------
    points
        Surface points, (N, N, 3), mm.
    area
        Area of each, (N, N), mm^2.
    entered
        Irradiance that entered at each, (N, N).
    """
    side = points.shape[0]
    cells = min(SHADED_CELLS, side)
    starts = np.linspace(0, side, cells, endpoint=False).astype(int)

    def summed(image: Float64Array) -> Float64Array:
        return np.add.reduceat(np.add.reduceat(image, starts, axis=0), starts, axis=1)

    total = summed(area)
    place = np.stack([summed(area * points[..., k]) / total for k in range(3)], axis=-1)
    light = (summed(area * entered) / total).reshape(-1, 1) * np.ones(3)
    at = place.reshape(-1, 3)
    found = dipole_gather.exitance(
        at, total.reshape(-1), light, at, SKIN_COLOR, SKIN_PATH_MM, workers=2
    ).reshape(cells, cells, 3)
    where = (np.arange(side) + 0.5) * cells / side - 0.5
    rows, columns = np.meshgrid(where, where, indexing="ij")
    planes = [
        ndimage.map_coordinates(found[..., k], [rows, columns], order=1, mode="nearest")
        for k in range(3)
    ]
    return np.stack(planes, axis=-1)
