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

from model.microstructure import KernelTable, gaussian_weights, kernel_parameters
from skinrig.arrays import Float32Array, Float64Array
from skinrig.viewer.scene import SceneError

GROWN_LEVELS: Final = 4
"""Levels of a pyramid that can be grown: 0 (the patch's pixels) to GROWN_LEVELS - 1."""
STEP_PX: Final = 2 ** (GROWN_LEVELS - 1)
MAX_LATTICE_PX: Final = 2**17
"""Farther out the lattice's integers leave 32 bits."""
MIN_MOVES: Final = 4
"""Moves to choose from along each side; below, repetition would be seen at once."""


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
            raise SceneError(
                f"patch: got shape {shape}, expected a square with sides of a multiple of {STEP_PX}"
            )
        if not np.isfinite(self.patch).all():
            raise SceneError("patch: got NaN or infinity, expected heights in um")
        if not (math.isfinite(self.pixel_um) and self.pixel_um > 0):
            raise SceneError(f"pixel_um: got {self.pixel_um}, expected above 0")
        if not 0 <= self.seed < 2**32:
            raise SceneError(f"seed: got {self.seed}, expected 0 to 2^32 - 1")
        if self.cell_px < 2 * STEP_PX or self.choices < MIN_MOVES:
            raise SceneError(
                f"cell_px: got {self.cell_px} for a patch of {shape[0]} px, expected at least "
                f"{2 * STEP_PX} and at most {compute_max_cell_px(shape[0])}"
            )

    @property
    def choices(self) -> int:
        """Moves to choose from along each side."""
        return _choices(self.patch.shape[0], self.cell_px)


def compute_reach_px(cell_px: int) -> int:
    """Return how many pixels from its corner a place may be shown, a multiple of `STEP_PX`.

    The hexagon's radius is one cell; a pixel of the coarsest level reaches half a step farther,
    and corners lie on whole steps, up to half of one from the lattice's.
    """
    return STEP_PX * math.ceil((cell_px + STEP_PX + 1) / STEP_PX)


def _choices(side_px: int, cell_px: int) -> int:
    return (side_px - 2 * compute_reach_px(cell_px)) // STEP_PX


def compute_max_cell_px(side_px: int) -> int:
    """Return the largest cell that leaves `MIN_MOVES` moves in a patch of so many pixels."""
    fits = [c for c in range(1, side_px) if _choices(side_px, c) >= MIN_MOVES]
    return max(fits, default=0)


STRETCH_NODES: Final = 33
"""Stretch ratios a side of the table of variances, evenly from 0.5 to 1.5."""
STRETCH_RANGE: Final = (0.5, 1.5)
MIN_LEVEL_PX: Final = 6
"""Pixels a side of the coarsest level whose slopes are counted."""


def compute_slope_rms(growth: GrownRelief) -> list[float]:
    """Return the rms of slopes that pixels of 2^level px still show, by level of a relief.

    A slope is the gradient by central differences over two pixels of the level, as the page's
    normals are; levels end where less than six pixels a side are left.
    """
    found = []
    height = growth.patch.astype(np.float64)
    step = growth.pixel_um
    while height.shape[0] >= MIN_LEVEL_PX:
        dx = (height[1:-1, 2:] - height[1:-1, :-2]) / (2.0 * step)
        dy = (height[2:, 1:-1] - height[:-2, 1:-1]) / (2.0 * step)
        found.append(float(np.sqrt(np.mean(dx**2 + dy**2))))
        side = height.shape[0] // 2
        height = height[: 2 * side, : 2 * side].reshape(side, 2, side, 2).mean(axis=(1, 3))
        step *= 2.0
    return found


def compute_strained_variance(growth: GrownRelief, table: KernelTable) -> Float64Array:
    """Return how the variance of slopes changes under strain, relative to neutral skin.

    The kernels' transfer functions on the patch's power spectrum, averaged with that of the
    patch turned by 90 degrees: what direction the relief has of its own is not followed. Slopes
    are those of the deformed surface: heights over lengths that are stretched too.

    Parameters
    ----------
    growth : GrownRelief
    table : KernelTable

    Returns
    -------
    ndarray, shape (STRETCH_NODES, STRETCH_NODES, 2)
        Variance along s and along t by r_s (rows) and r_t (columns), over `STRETCH_RANGE`.
    """
    side = growth.patch.shape[0]
    window = np.hanning(side + 2)[1:-1]
    spectrum = np.abs(np.fft.fft2(growth.patch * window[:, None] * window)) ** 2
    spectrum = 0.5 * (spectrum + spectrum.T)
    turn = 2.0 * np.pi * np.fft.fftfreq(side)
    slope = np.sin(turn) ** 2
    ratios = np.linspace(*STRETCH_RANGE, STRETCH_NODES)
    alpha, sigma_um = kernel_parameters(ratios, table)
    transfer = np.empty((STRETCH_NODES, side))
    for row, (a, s) in enumerate(zip(alpha, sigma_um / growth.pixel_um, strict=True)):
        weights = gaussian_weights(s)
        wave = np.cos(turn[:, None] * np.arange(weights.size)) @ (
            weights * np.where(np.arange(weights.size) > 0, 2.0, 1.0)
        )
        transfer[row] = (1.0 - a + a * wave) ** 2
    neutral = float(slope @ spectrum.sum(axis=1))
    along = (transfer * slope) @ spectrum @ transfer.T / neutral
    return np.stack([along / ratios[:, None] ** 2, along.T / ratios[None, :] ** 2], axis=2)
