"""Map a face's texels to the common map: accumulate values, and detect covered texels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import binary_closing, map_coordinates, maximum_filter

from model.checks import Checks
from model.texture_statistics.masks import fill_smoothly
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.correspondence.common_parameterization import (
    CYLINDER_RADIUS_MM,
    CommonFrame,
    Correspondence,
    ParameterizationError,
)

SHADOW_DEPTH_MM: Final = 10.0
"""Depth below the outermost texel at the same position beyond which a texel is covered, as under
an ear or the chin."""


def splat_bilinear(
    position_px: Float64Array, values: Float64Array, size: int
) -> tuple[Float64Array, Float64Array]:
    """Add values to the four pixels around each position; return sums (N, N, C) and weights."""
    total = np.zeros((size * size, values.shape[1]))
    weight = np.zeros(size * size)
    low = np.floor(position_px).astype(np.int64)
    part = position_px - low
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            x, y = low[:, 0] + dx, low[:, 1] + dy
            use = (x >= 0) & (x < size) & (y >= 0) & (y < size) & (share > 1e-6)
            index = y[use] * size + x[use]
            weight += np.bincount(index, share[use], minlength=size * size)
            for c, layer in enumerate(values[use].T):
                total[:, c] += np.bincount(index, share[use] * layer, minlength=size * size)
    return total.reshape(size, size, -1), weight.reshape(size, size)


def close_gaps(covered: BoolArray) -> BoolArray:
    """Close gaps of up to two pixels, as between texels wider apart than the map's pixels."""
    padded = np.pad(covered, 3, mode="edge")
    closed = binary_closing(padded, structure=np.ones((3, 3)), iterations=2)
    return np.asarray(closed[3:-3, 3:-3] | covered, np.bool_)


def is_outermost(
    position: Float64Array, reach: Float64Array, visible: BoolArray, side_mm: float, size: int
) -> BoolArray:
    """Return the texels within `SHADOW_DEPTH_MM` of the outermost nearby, on cells of 2 mm.

    Parameters
    ----------
    position
        (H, W, 2): column and row in a map of ``size`` pixels and ``side_mm`` per side.
    reach
        (H, W): distance of the texels from the axis, mm.
    visible
        (H, W): texels that exist.
    """
    cells = max(1, math.ceil(side_mm / 2.0))
    at = np.floor((position + 0.5) * (cells / size)).astype(np.int64)
    inside = visible & np.all((at >= 0) & (at < cells), axis=2)
    index = at[..., 1] * cells + at[..., 0]
    highest = np.zeros(cells * cells)
    np.maximum.at(highest, index[inside], reach[inside])
    highest = maximum_filter(highest.reshape(cells, cells), size=3, mode="nearest").ravel()
    out = visible & ~inside
    out[inside] = reach[inside] >= highest[index[inside]] - SHADOW_DEPTH_MM
    return np.asarray(out, np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class TexelChart:
    """Position of each texel of a face's texture in the common map.

    Attributes
    ----------
    size
        Pixels per side of the map.
    position_px
        (H, W, 2), column and row; may be outside the map.
    on_surface
        (H, W): texels of the surface.
    outermost
        (H, W): texels not covered by another part of the face.
    stderr_mm
        (H, W): standard error of the position; NaN where it is not known.
    """

    size: int
    position_px: Float64Array
    on_surface: BoolArray
    outermost: BoolArray
    stderr_mm: Float32Array

    def gather(
        self, texture: ArrayLike, valid: ArrayLike | None = None
    ) -> tuple[Float32Array, BoolArray]:
        """Average a texture into the common map.

        Parameters
        ----------
        texture
            (H, W) or (H, W, C).
        valid
            (H, W), texels to use; by default all of the surface.

        Returns
        -------
        values : ndarray of float32, shape (N, N) or (N, N, C)
            Filled from the neighborhood where the map has no texel.
        valid : ndarray of bool, shape (N, N)
            Pixels at most half a texel's distance from a texel.
        """
        image = np.asarray(texture, np.float64)
        use = self.on_surface & self.outermost
        if valid is not None:
            use = use & np.asarray(valid, np.bool_)
        total, weight = splat_bilinear(self.position_px[use], _layers(image)[use], self.size)
        mean = total / np.maximum(weight, 1e-12)[..., None]
        known = weight > 0.0
        filled = fill_smoothly(mean, known) if known.any() else np.zeros_like(mean)
        near = close_gaps(known) if known.any() else known
        return filled.astype(np.float32).reshape(known.shape + image.shape[2:]), near

    def read(self, common: ArrayLike) -> tuple[Float32Array, BoolArray]:
        """Read a common map at the texels, by bilinear interpolation.

        Parameters
        ----------
        common
            (N, N) or (N, N, C).

        Returns
        -------
        values : ndarray of float32, shape (H, W) or (H, W, C)
            The nearest pixel's where a texel is outside the map.
        inside : ndarray of bool, shape (H, W)
            Texels of the surface inside the map.
        """
        image = np.asarray(common, np.float64)
        at = [self.position_px[..., 1], self.position_px[..., 0]]
        out = [
            map_coordinates(layer, at, order=1, mode="nearest")
            for layer in np.moveaxis(_layers(image), 2, 0)
        ]
        values = np.stack(out, axis=-1).astype(np.float32)
        last = self.size - 0.5
        inside = self.on_surface & np.all(
            (self.position_px >= -0.5) & (self.position_px <= last), axis=2
        )
        return values.reshape(self.on_surface.shape + image.shape[2:]), inside


def _layers(image: Float64Array) -> Float64Array:
    """Return an image (H, W) or (H, W, C) as (H, W, C)."""
    return image if image.ndim == 3 else image[..., None]


def chart_texels(
    position_mm: ArrayLike, valid: ArrayLike, correspondence: Correspondence, frame: CommonFrame
) -> TexelChart:
    """Compute the positions of a face's texels in the common map.

    Parameters
    ----------
    position_mm
        (H, W, 3), rig frame.
    valid
        (H, W), texels of the surface; values elsewhere are ignored.
    correspondence
        Correspondence of this face.
    frame
        The common map.
    """
    position = np.asarray(position_mm, np.float64)
    shown = np.asarray(valid, np.bool_)
    Checks(ParameterizationError).shape("position", position, ("H", "W", 3))
    Checks(ParameterizationError).shape("valid", shown, position.shape[:2])
    if not shown.any():
        got = "got no valid texel, expected some"
        raise ParameterizationError(f"position: {got}; check the mask")
    place = np.full((*shown.shape, 2), -2.0)
    error = np.full(shown.shape, np.nan, np.float32)
    uv, off = correspondence.map_points(position[shown])
    place[shown], error[shown] = frame.to_pixel(uv), off
    tip = np.asarray(correspondence.cylinder.tip_mm)
    reach = np.zeros(shown.shape)
    reach[shown] = np.hypot(
        position[shown, 0] - tip[0], position[shown, 2] - tip[2] + CYLINDER_RADIUS_MM
    )
    visible = shown & is_outermost(place, reach, shown, frame.side_mm, frame.size)
    return TexelChart(frame.size, place, shown, visible, error)
