"""What slopes a pixel of microstructure shows, and how their variance changes with the skin.

Tables for the page: what a pixel does not show goes into the roughness of the highlight.
"""

from typing import Final

import numpy as np

from model.microstructure import KernelTable, gaussian_weights, kernel_parameters
from skinrig.arrays import Float64Array
from skinrig.viewer.microstructure.relief_growth import GrownRelief

STRETCH_NODES: Final = 33
"""Stretch ratios a side of the table of variances, evenly from 0.5 to 1.5."""
STRETCH_RANGE: Final = (0.5, 1.5)
MIN_LEVEL_PX: Final = 6
"""Pixels a side of the coarsest level whose slopes are counted."""


def slope_rms(growth: GrownRelief) -> list[float]:
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


def strained_variance(growth: GrownRelief, table: KernelTable) -> Float64Array:
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
