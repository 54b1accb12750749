"""Relief grown from a patch as the page's shader grows it, a function of the pixel alone."""

import math

import numpy as np

from skinrig.arrays import Float32Array, Float64Array, Int64Array, UInt32Array
from skinrig.viewer.microstructure.relief_growth import (
    GROWN_LEVELS,
    MAX_LATTICE_PX,
    STEP_PX,
    GrownRelief,
    compute_reach_px,
)

WEIGHT_POWER = 4
"""Power of the barycentric weights: the share of skin where places mix is small, but not so small
that the blend's own slopes show."""


def level_of(growth: GrownRelief, level: int) -> Float32Array:
    """Return the patch's means over 2^level pixels a side, shape (P / 2^level,) * 2."""
    if not 0 <= level < GROWN_LEVELS:
        raise ValueError(f"level: got {level}, expected 0 to {GROWN_LEVELS - 1}")
    side = growth.patch.shape[0] >> level
    blocks = growth.patch.reshape(side, 1 << level, side, 1 << level).astype(np.float64)
    return blocks.mean(axis=(1, 3)).astype(np.float32)


def window(
    growth: GrownRelief, top: int, left: int, shape: tuple[int, int], *, level: int = 0
) -> Float32Array:
    """Return heights, um, of a window of the grown relief.

    Parameters
    ----------
    top, left : int
        First row and column, px of that level; any integer within +-2^17 px of level 0.
    shape : (int, int)
        Rows and columns.
    level : int
        0 is the patch's own pixels, each level halves both sides.

    Returns
    -------
    ndarray of float32, shape `shape`
    """
    patch = level_of(growth, level)
    if (max(abs(top), abs(left)) + max(shape)) << level > MAX_LATTICE_PX:
        raise ValueError(
            f"window: got ({top}, {left}) {shape} at level {level}, expected within "
            f"{MAX_LATTICE_PX} px of level 0"
        )
    y, x = np.meshgrid(
        np.arange(top, top + shape[0]), np.arange(left, left + shape[1]), indexing="ij"
    )
    corners, weights = _corners_at(x, y, growth.cell_px, level)
    total = np.zeros(shape)
    for (i, j), weight in zip(corners, weights, strict=True):
        move_x, move_y = _moves(growth, i, j)
        total += weight * patch[y + (move_y >> level), x + (move_x >> level)]
    return total.astype(np.float32)


def _moves(growth: GrownRelief, i: Int64Array, j: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return by how many pixels of level 0 the patch's places are from the relief's."""
    at_x, at_y = _corner_px(i, j, growth.cell_px)
    drawn = hashed(i, j, growth.seed)
    # the hexagon's first pixel becomes one of the first pixels that keep its last inside
    free_x = STEP_PX * ((drawn & np.uint32(0xFFFF)) % np.uint32(growth.choices)).astype(np.int64)
    free_y = STEP_PX * ((drawn >> np.uint32(16)) % np.uint32(growth.choices)).astype(np.int64)
    reach = compute_reach_px(growth.cell_px)
    return free_x + reach - at_x, free_y + reach - at_y


def hashed(i: Int64Array, j: Int64Array, seed: int) -> UInt32Array:
    """Return 32 mixed bits for lattice corners; integer arithmetic modulo 2^32 throughout.

    Examples
    --------
    >>> hashed(np.array([0, 1]), np.array([0, 0]), 0).tolist() != [0, 0]
    True
    """
    with np.errstate(over="ignore"):
        h = np.asarray(i).astype(np.uint32) * np.uint32(0x9E3779B1)
        h = h ^ (np.asarray(j).astype(np.uint32) * np.uint32(0x85EBCA77)) ^ np.uint32(seed)
        # finalizer of MurmurHash3: every input bit reaches every output bit
        h = (h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B)
        h = (h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35)
        h = h ^ (h >> np.uint32(16))
    return np.asarray(h, np.uint32)


def _corner_px(i: Int64Array, j: Int64Array, cell_px: int) -> tuple[Int64Array, Int64Array]:
    """Return columns and rows of lattice corners, on whole steps of `STEP_PX`."""
    # half the cell a row to the side, and sqrt(3)/2 of it down; in integers: 14189 / 16384
    x = (2 * i + j) * cell_px // 2
    y = (j * cell_px * 14189) >> 14
    return (x // STEP_PX) * STEP_PX, (y // STEP_PX) * STEP_PX


def _corners_at(
    x: Int64Array, y: Int64Array, cell_px: int, level: int
) -> tuple[list[tuple[Int64Array, Int64Array]], list[Float64Array]]:
    """Return the three corners around pixels of a level, and their weights (squares sum to 1)."""
    scale = float(1 << level)
    u = (x + 0.5) * scale / cell_px
    v = (y + 0.5) * scale / cell_px
    down = v * (2.0 / math.sqrt(3.0))
    right = u - 0.5 * down
    i, j = np.floor(right).astype(np.int64), np.floor(down).astype(np.int64)
    p, q = right - i, down - j
    rest = 1.0 - p - q
    upper = rest > 0.0
    one = np.where(upper, 0, 1)
    corners = [(i + one, j + one), (i, j + 1), (i + 1, j)]
    raw = [np.abs(rest), np.where(upper, q, 1.0 - p), np.where(upper, p, 1.0 - q)]
    power = [w**WEIGHT_POWER for w in raw]
    length = np.sqrt(sum(w * w for w in power))
    return corners, [w / length for w in power]
