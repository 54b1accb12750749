"""Grow relief of any size from one small patch, as a function of the pixel only.

A 16K displacement exceeds the textures of many browsers (8K) and a page of 5 MB. The page therefore
grows it from a patch of some hundred pixels. On a lattice of equilateral triangles, each corner has
its own offset in the patch, and the three offsets of a triangle are blended. Shader and this module
use the same integer arithmetic.

Definitions:

- Corner (i, j) uses the patch at an offset of a multiple of `STEP_PX` pixels. A hash of (i, j) and
  the seed chooses it among all offsets at which its hexagon is within the patch. With integer
  offsets, samples are at pixels also in the levels of a mip pyramid up to `GROWN_LEVELS`.
- Weights are barycentric weights to the power `WEIGHT_POWER`, divided by the root of their summed
  squares. Mean and variance are those of the patch where the three parts are uncorrelated (Heitz
  and Neyret 2018, eq. 2, without their histogram transform, so that a skewed histogram is less
  skewed in blended regions). Weights are continuous, thus the relief is seamless. In blended
  regions it is a mixture of up to three parts, unlike real skin.
- Level L > 0 blends the patch's means over 2^L pixels with the weights at the pixel's center. This
  is the mean of the grown relief, except for the change of the weights over one pixel.

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
"""Number of pyramid levels that can be grown: 0 (the patch's pixels) to GROWN_LEVELS - 1."""
STEP_PX: Final = 2 ** (GROWN_LEVELS - 1)
MAX_LATTICE_PX: Final = 2**17
"""Maximum coordinate, beyond which the lattice's integers exceed 32 bits."""
MIN_MOVES: Final = 4
"""Minimum number of offsets per axis; with fewer, repetition is obvious."""


@dataclass(frozen=True, slots=True, eq=False)
class GrownRelief:
    """A patch with the parameters of its growth.

    Attributes
    ----------
    patch : ndarray of float32, shape (P, P)
        Heights, um, with mean 0; row 0 is the top. P is a multiple of `STEP_PX`.
    pixel_um : float
        Pixel size on the skin, > 0.
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
        """Raise for patches that are too small for a cell."""
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
        """Number of offsets per axis."""
        return _choices(self.patch.shape[0], self.cell_px)


def compute_reach_px(cell_px: int) -> int:
    """Return the radius in which a corner's offset is used, a multiple of `STEP_PX`, px.

    The hexagon's radius is one cell. Pixels of the coarsest level extend half a step farther, and
    corners are rounded to whole steps, up to half a step from the lattice.
    """
    return STEP_PX * math.ceil((cell_px + STEP_PX + 1) / STEP_PX)


def _choices(side_px: int, cell_px: int) -> int:
    return (side_px - 2 * compute_reach_px(cell_px)) // STEP_PX


def compute_max_cell_px(side_px: int) -> int:
    """Return the largest cell with at least `MIN_MOVES` offsets per axis in a patch."""
    fits = [c for c in range(1, side_px) if _choices(side_px, c) >= MIN_MOVES]
    return max(fits, default=0)


STRETCH_NODES: Final = 33
"""Nodes per axis of the table of variances: stretch ratios at equal steps from 0.5 to 1.5."""
STRETCH_RANGE: Final = (0.5, 1.5)
MIN_LEVEL_PX: Final = 6
"""Minimum side of the coarsest evaluated level."""


def compute_slope_rms(growth: GrownRelief) -> list[float]:
    """Return the RMS of slopes resolved by pixels of 2^level px, by level of a relief.

    A slope is the gradient by central differences over two pixels of the level, as in the page's
    normals. Levels with fewer than six pixels per side are not evaluated.
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
    """Return the variance of slopes under strain relative to neutral skin.

    It follows from the kernels' transfer functions and the patch's power spectrum, averaged with
    that of the patch rotated by 90 degrees, as anisotropy of the relief is not modeled. Slopes are
    those of the deformed surface: heights over stretched lengths.

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
