"""A relief of any size grown from one small patch, a function of the pixel alone.

A browser cannot hold a 16K displacement (textures end at 8K on many machines) and a page of 5 MB
cannot carry one. So the page grows what it shows from a patch of some hundred pixels: on a lattice
of equilateral triangles each corner carries its own place of the patch, and the three places of a
triangle are blended. Shader and this module do the same arithmetic on the same integers.

What is fixed here:

- Corner (i, j) shows the patch moved by a whole number of `STEP_PX` pixels that a hash of (i, j)
  and the seed chooses among all moves at which its hexagon stays within the patch. Whole numbers:
  no sample lies between pixels, and levels of a mip pyramid up to `GROWN_LEVELS` move by whole
  pixels too.
- Weights are the barycentric ones to the power `WEIGHT_POWER`, divided by the root of their summed
  squares: mean and variance are those of the patch where the three places are uncorrelated (Heitz
  and Neyret 2018, eq. 2, without their transform of histograms, so a skewed histogram comes out
  less skewed where places meet). Weights are continuous: there are no seams. Between places relief
  is a mixture of up to three, which no skin has.
- Level L > 0 blends the patch's own means over 2^L pixels with the weights at the pixel's centre:
  what the mean of the grown relief is but for the weights' change over one pixel.

References
----------
Heitz, Neyret 2018, High-Performance By-Example Noise using a Histogram-Preserving Blending
Operator, Proc. ACM Comput. Graph. Interact. Tech. 1(2), 31. doi:10.1145/3233304
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinrig.arrays import Float32Array, Float64Array, Int64Array, UInt32Array

GROWN_LEVELS: Final = 4
"""Levels of a pyramid that can be grown: 0 (the patch's pixels) to GROWN_LEVELS - 1."""
STEP_PX: Final = 2 ** (GROWN_LEVELS - 1)
WEIGHT_POWER: Final = 4
"""Power of the barycentric weights: the share of skin where places mix is small, but not so small
that the blend's own slopes show."""
MAX_LATTICE_PX: Final = 2**17
"""Farther out the lattice's integers leave 32 bits."""
MIN_MOVES: Final = 4
"""Moves to choose from along each side; below, repetition would be seen at once."""


class ReliefGrowthError(ValueError):
    """A patch that nothing can be grown from, or pixels that no level has."""


@dataclass(frozen=True, slots=True, eq=False)
class GrownRelief:
    """A patch with what its growth is determined by.

    Attributes
    ----------
    patch : ndarray of float32, shape (P, P)
        Heights, um, of mean 0; row 0 is the top. P is a multiple of `STEP_PX`.
    pixel_um : float
        Length of skin that a pixel has, > 0.
    cell_px : int
        Edge of the lattice's triangles, px.
    seed : int
        0 ... 2^32 - 1.
    """

    patch: Float32Array
    pixel_um: float
    cell_px: int
    seed: int

    def __post_init__(self) -> None:
        """Refuse patches that a cell does not fit into."""
        shape = self.patch.shape
        if len(shape) != 2 or shape[0] != shape[1] or shape[0] % STEP_PX:
            raise ReliefGrowthError(
                f"patch: got shape {shape}, expected a square with sides of a multiple of {STEP_PX}"
            )
        if not np.isfinite(self.patch).all():
            raise ReliefGrowthError("patch: got NaN or infinity, expected heights in um")
        if not (math.isfinite(self.pixel_um) and self.pixel_um > 0):
            raise ReliefGrowthError(f"pixel_um: got {self.pixel_um}, expected above 0")
        if not 0 <= self.seed < 2**32:
            raise ReliefGrowthError(f"seed: got {self.seed}, expected 0 to 2^32 - 1")
        if self.cell_px < 2 * STEP_PX or self.choices < MIN_MOVES:
            raise ReliefGrowthError(
                f"cell_px: got {self.cell_px} for a patch of {shape[0]} px, expected at least "
                f"{2 * STEP_PX} and at most {largest_cell_px(shape[0])}"
            )

    @property
    def choices(self) -> int:
        """Moves to choose from along each side."""
        return _choices(self.patch.shape[0], self.cell_px)

    def level(self, level: int) -> Float32Array:
        """Return the patch's means over 2^level pixels a side, shape (P / 2^level,) * 2."""
        if not 0 <= level < GROWN_LEVELS:
            raise ReliefGrowthError(f"level: got {level}, expected 0 to {GROWN_LEVELS - 1}")
        side = self.patch.shape[0] >> level
        blocks = self.patch.reshape(side, 1 << level, side, 1 << level).astype(np.float64)
        return blocks.mean(axis=(1, 3)).astype(np.float32)

    def window(
        self, top: int, left: int, shape: tuple[int, int], *, level: int = 0
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
        patch = self.level(level)
        if (max(abs(top), abs(left)) + max(shape)) << level > MAX_LATTICE_PX:
            raise ReliefGrowthError(
                f"window: got ({top}, {left}) {shape} at level {level}, expected within "
                f"{MAX_LATTICE_PX} px of level 0"
            )
        y, x = np.meshgrid(
            np.arange(top, top + shape[0]), np.arange(left, left + shape[1]), indexing="ij"
        )
        corners, weights = _corners_at(x, y, self.cell_px, level)
        total = np.zeros(shape)
        for (i, j), weight in zip(corners, weights, strict=True):
            move_x, move_y = self._moves(i, j)
            total += weight * patch[y + (move_y >> level), x + (move_x >> level)]
        return total.astype(np.float32)

    def _moves(self, i: Int64Array, j: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Return by how many pixels of level 0 the patch's places are from the relief's."""
        at_x, at_y = _corner_px(i, j, self.cell_px)
        drawn = hashed(i, j, self.seed)
        # the hexagon's first pixel becomes one of the first pixels that keep its last inside
        free_x = STEP_PX * ((drawn & np.uint32(0xFFFF)) % np.uint32(self.choices)).astype(np.int64)
        free_y = STEP_PX * ((drawn >> np.uint32(16)) % np.uint32(self.choices)).astype(np.int64)
        reach = reach_px(self.cell_px)
        return free_x + reach - at_x, free_y + reach - at_y


def reach_px(cell_px: int) -> int:
    """Return how many pixels from its corner a place may be shown, a multiple of `STEP_PX`.

    The hexagon's radius is one cell; a pixel of the coarsest level reaches half a step farther,
    and corners lie on whole steps, up to half of one from the lattice's.
    """
    return STEP_PX * math.ceil((cell_px + STEP_PX + 1) / STEP_PX)


def _choices(side_px: int, cell_px: int) -> int:
    return (side_px - 2 * reach_px(cell_px)) // STEP_PX


def largest_cell_px(side_px: int) -> int:
    """Return the largest cell that leaves `MIN_MOVES` moves in a patch of so many pixels."""
    fits = [c for c in range(1, side_px) if _choices(side_px, c) >= MIN_MOVES]
    return max(fits, default=0)


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
