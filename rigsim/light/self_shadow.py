"""Which lights a relief hides from its own points: horizons of a height field, by sweeping lines.

A line in each direction is swept from the light's side; the upper convex hull of what was passed
tells the horizon of the next point in constant time on average (Timonen and Westerholm 2010,
doi:10.1111/j.1467-8659.2009.01642.x). Lines lie a pixel apart; heights between pixels are linear.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from rigsim.arrays import Float32Array


class HorizonError(ValueError):
    """A height field or a direction cannot be used."""


def horizon_tangent(
    height_um: Float32Array, *, pixel_um: float, azimuth_rad: float
) -> Float32Array:
    """Return the tangent of the horizon's elevation in one direction.

    Parameters
    ----------
    height_um
        Heights, um, shape (H, W); row 0 is the top. Around the field the relief is taken as level
        and too low to hide anything.
    pixel_um
        Distance of neighbours, um, > 0.
    azimuth_rad
        Direction of the light over the field, from +x towards the top.

    Returns
    -------
    ndarray of float32
        Shape (H, W), >= 0; 0 where nothing stands higher.
    """
    height = np.ascontiguousarray(height_um, np.float32)
    if height.ndim != 2 or not np.isfinite(height).all():
        raise HorizonError(f"height_um: got shape {height.shape}, expected finite (H, W)")
    if not (0.0 < pixel_um < math.inf and math.isfinite(azimuth_rad)):
        raise HorizonError(f"pixel_um, azimuth_rad: got {pixel_um}, {azimuth_rad}")
    right, down = math.cos(azimuth_rad), -math.sin(azimuth_rad)
    # sweep along the axis that the direction follows most; away from the light
    steep = abs(down) > abs(right)
    field = height.T if steep else height
    along, across = (down, right) if steep else (right, down)
    backwards = along < 0.0
    # the light is at +along: begin at the far end and walk towards smaller coordinates
    field = np.ascontiguousarray(field if backwards else field[:, ::-1])
    slope = across / abs(along)  # drift across per step towards the light
    out = np.zeros_like(field)
    _sweep(field, np.float32(pixel_um * math.hypot(1.0, slope)), -slope, out)
    out = out if backwards else out[:, ::-1]
    return np.ascontiguousarray(out.T if steep else out)


@njit(parallel=True, cache=True)
def _sweep(field, step, drift, out):  # type: ignore[no-untyped-def]
    """Walk over the columns, from the light's side; each line drifts over the rows."""
    rows, columns = field.shape
    most = math.ceil(abs(drift) * (columns - 1))
    first = -most if drift > 0.0 else 0
    lines = rows + most
    for line in prange(lines):
        start = first + line
        place = np.empty(columns, np.float32)
        level = np.empty(columns, np.float32)
        top = 0
        for column in range(columns):
            exact = start + drift * column
            row = math.floor(exact + 0.5)
            if row < 0 or row >= rows:
                continue
            low = math.floor(exact)
            part = np.float32(exact - low)
            below = min(max(low, 0), rows - 1)
            above = min(max(low + 1, 0), rows - 1)
            own = (np.float32(1.0) - part) * field[below, column] + part * field[above, column]
            here = np.float32(column) * step
            # points of the hull that the next one hides from here are never seen again
            while top > 0:
                rise = (level[top - 1] - own) / (here - place[top - 1])
                if top > 1:
                    further = (level[top - 2] - own) / (here - place[top - 2])
                    if further >= rise:
                        top -= 1
                        continue
                if rise <= 0.0 and top == 1:
                    top -= 1
                    continue
                break
            if top > 0:
                rise = (level[top - 1] - own) / (here - place[top - 1])
                if rise > 0.0:
                    out[row, column] = rise
            place[top] = here
            level[top] = own
            top += 1
