"""Sample textures from texels of the same part of a surface."""

from typing import Final

import numpy as np
from numba import njit, prange

MAX_TEXEL_DISTANCE: Final = 2.0
"""Maximum distance of a used texel from a point on the surface, in widths of the texel."""
POINTS_PER_THREAD_BLOCK: Final = 1 << 12


@njit(parallel=True, cache=True)
def look_up(values, valid, position, width, uv, point, out, total_weight):  # type: ignore[no-untyped-def]
    """Blend the four texels around texture coordinates, without those of other parts.

    Charts are adjacent in a texture. Texels around a point near a chart's border, or in a chart
    smaller than a texel, may thus belong to another part of the surface.

    Parameters
    ----------
    values : float32 (H, W, C)
        Row 0 is at v = 1.
    valid : bool (H, W)
        Texels with values.
    position : float32 (H, W, 3)
        Surface point of each texel, mm.
    width : float32 (H, W)
        Longer side of the texel on the surface, mm.
    uv : float32 (n, 2)
        Texture coordinates.
    point : float32 (n, 3)
        Surface points, mm, in the frame of `position`.
    out : float32 (n, C)
        Blended values; 0 without a used texel.
    total_weight : float32 (n,)
        Sum of the weights of used texels, 0 to 1.
    """
    rows, columns, channels = values.shape
    for chunk in prange((uv.shape[0] + POINTS_PER_THREAD_BLOCK - 1) // POINTS_PER_THREAD_BLOCK):
        for i in range(
            chunk * POINTS_PER_THREAD_BLOCK, min((chunk + 1) * POINTS_PER_THREAD_BLOCK, uv.shape[0])
        ):
            x = min(max(uv[i, 0] * columns - 0.5, 0.0), columns - 1.0)
            y = min(max((1.0 - uv[i, 1]) * rows - 0.5, 0.0), rows - 1.0)
            column, row = min(int(x), columns - 2), min(int(y), rows - 2)
            fx, fy = x - column, y - row
            total = 0.0
            for k in range(channels):
                out[i, k] = 0.0
            for corner in range(4):
                r, c = row + corner // 2, column + corner % 2
                if not valid[r, c]:
                    continue
                weight = (fy if corner // 2 else 1.0 - fy) * (fx if corner % 2 else 1.0 - fx)
                away = 0.0
                for k in range(3):
                    away += (position[r, c, k] - point[i, k]) ** 2
                if weight <= 0.0 or away > (MAX_TEXEL_DISTANCE * width[r, c]) ** 2:
                    continue
                total += weight
                for k in range(channels):
                    out[i, k] += np.float32(weight) * values[r, c, k]
            total_weight[i] = total
            if total > 0.0:
                for k in range(channels):
                    out[i, k] /= np.float32(total)
