"""Rasterize the strain of a mesh into its texture, and look up the kernels of each pixel.

T is interpolated between vertices and decomposed at each pixel (Nagano2015, eq. 11), and so is the
texture's scale. Pixel (0, 0)'s center is (0, 0) and row 0 is the top: u = (x + 1/2) / W,
v = 1 - (y + 1/2) / H.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import BoolArray, Float32Array, FloatArray
from model.checks import Checks
from model.microstructure import texture_kernels
from model.microstructure.convolution import LineKernels
from model.microstructure.kernel_table import ALPHA_LIMITS, FOREHEAD, KernelTable
from model.microstructure.map_windows import MapWindow
from model.microstructure.mesh_strain import MeshStrain, StrainError

PAD_PX = 4
"""Width of the padding around islands, px, for interpolation between pixels."""


@dataclass(frozen=True, slots=True)
class TextureStrain:
    """Strain at the pixels of a window of a texture.

    Attributes
    ----------
    stretch : ndarray of float32, shape (h, w, 2)
        r_s and r_t; 1 where unknown.
    axes : ndarray of float32, shape (h, w, 2, 2)
        Unit vectors (x right, y down) of s and t, px; 0 where unknown.
    px_per_mm : ndarray of float32, shape (h, w, 2)
        Pixels per millimeter of neutral skin along s and t.
    covered, padded : ndarray of bool, shape (h, w)
        Pixels with their center in a triangle, and padding pixels that repeat nearby values.
    """

    stretch: Float32Array
    axes: Float32Array
    px_per_mm: Float32Array
    covered: BoolArray
    padded: BoolArray


def rasterize(
    strain: MeshStrain,
    faces: ArrayLike,
    uv: ArrayLike,
    size: tuple[int, int],
    *,
    window: MapWindow | None = None,
    pad_px: int = PAD_PX,
) -> TextureStrain:
    """Fill a texture, or a window of it, with the strain of a mesh.

    Parameters
    ----------
    strain : MeshStrain
    faces, uv : array_like, shapes (F, 3), (V, 2)
        Of the mesh.
    size : (int, int)
        Height and width of the whole texture, px.
    window : Window, optional
        The whole texture by default. Pixels are bit-identical in every window.
    pad_px : int
        Pixels by which islands are extended.

    Raises
    ------
    StrainError
        For a mesh that is not the strain's, or a window beyond the texture.
    """
    triangles = np.ascontiguousarray(faces, np.int64)
    texture = np.asarray(uv, np.float64)
    Checks(StrainError).shape("uv", texture, (strain.valid.size, 2))
    height, width = size
    if height < 1 or width < 1 or pad_px < 0:
        raise StrainError(f"size, pad_px: got {size}, {pad_px}, expected at least 1 px and 0 px")
    asked = MapWindow(0, height, 0, width) if window is None else window
    if asked.expand(0, size) != asked or min(asked.shape) < 1:
        raise StrainError(f"window: got {asked}, expected one within {size}")
    around = asked.expand(pad_px, size)
    shape = around.shape
    state = np.zeros(shape, np.uint8)
    stretch = np.ones((*shape, 2), np.float32)
    axes = np.zeros((*shape, 2, 2), np.float32)
    scale = np.zeros((*shape, 2), np.float32)
    places = (texture[:, 0] * width - 0.5, (1.0 - texture[:, 1]) * height - 0.5)
    values = np.concatenate([strain.tensor, strain.uv_metric], axis=1)
    found = (state, stretch, axes, scale)
    size_px = (float(width), float(height))
    texture_kernels.fill_texture(triangles, places, values, strain.valid, around, size_px, found)
    for _ in range(pad_px):
        texture_kernels.pad_once(state, state.copy(), stretch, axes, scale)
    inner = asked.within(around)
    part = (inner.rows, inner.columns)
    return TextureStrain(
        stretch=np.ascontiguousarray(stretch[part]),
        axes=np.ascontiguousarray(axes[part]),
        px_per_mm=np.ascontiguousarray(scale[part]),
        covered=state[part] == texture_kernels.COVERED,
        padded=state[part] == texture_kernels.PADDED,
    )


@dataclass(frozen=True, slots=True, eq=False)
class KernelRegions:
    """Kinds of skin over a texture.

    Attributes
    ----------
    tables : tuple of KernelTable
        One for each kind.
    weights : ndarray, shape (N, h, w)
        Weight of each kind, >= 0, over the whole texture at any resolution, row 0 on top; bilinear
        between pixels. Weights are divided by their sum; where it is 0, the first kind counts.
    """

    tables: tuple[KernelTable, ...]
    weights: FloatArray

    def __post_init__(self) -> None:
        """Raise for weights that do not fit the tables."""
        object.__setattr__(self, "tables", tuple(self.tables))
        count = len(self.tables)
        Checks(StrainError).within("tables", count, "[1, inf)")
        Checks(StrainError).shape("weights", self.weights, (count, "h", "w"))
        Checks(StrainError).within("weights", self.weights, "[0, inf)")

    def weights_at(self, u: FloatArray, v: FloatArray) -> Float32Array:
        """Return weights at rows of v and columns of u, shape (N, len(v), len(u))."""
        _, height, width = self.weights.shape
        y0, y1, fy = _between((1.0 - np.asarray(v)) * height - 0.5, height)
        x0, x1, fx = _between(np.asarray(u) * width - 0.5, width)
        weights = np.asarray(self.weights, np.float32)
        rows = weights[:, y0] * (1.0 - fy)[:, None] + weights[:, y1] * fy[:, None]
        found = rows[:, :, x0] * (1.0 - fx) + rows[:, :, x1] * fx
        total = found.sum(axis=0)
        found[0, total == 0.0] = 1.0
        return np.asarray(found / np.where(total > 0.0, total, 1.0), np.float32)

    def table_at(self, uv: FloatArray) -> NDArray[np.intp]:
        """Return the number of the table with the largest weight at points, shape (V, 2)."""
        _, height, width = self.weights.shape
        y = np.clip(np.rint((1.0 - uv[:, 1]) * height - 0.5), 0, height - 1).astype(np.intp)
        x = np.clip(np.rint(uv[:, 0] * width - 0.5), 0, width - 1).astype(np.intp)
        return np.asarray(np.argmax(self.weights[:, y, x], axis=0))


def _between(at: FloatArray, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Float32Array]:
    """Return the pixels before and after positions, and the fractions between them."""
    held = np.clip(at, 0.0, count - 1.0)
    first = np.minimum(np.floor(held).astype(np.intp), max(count - 2, 0))
    return first, np.minimum(first + 1, count - 1), np.asarray(held - first, np.float32)


def regional_kernels(
    strain: TextureStrain,
    regions: KernelRegions,
    size: tuple[int, int],
    *,
    window: MapWindow | None = None,
    extrapolate: Literal["hold", "formula"] = "hold",
) -> tuple[LineKernels, LineKernels]:
    """Return the kernels of both passes, alpha and sigma blended by the weight of each kind.

    Parameters
    ----------
    strain : TextureStrain
        Of the window.
    regions : KernelRegions
    size : (int, int)
        Height and width of the whole texture, px.
    window, extrapolate
        As of `rasterize` and `line_kernels`.
    """
    here = MapWindow(0, size[0], 0, size[1]) if window is None else window
    made = [line_kernels(strain, table, extrapolate=extrapolate) for table in regions.tables]
    if len(made) == 1:
        return made[0]
    shares = regions.weights_at(
        (np.arange(here.left, here.right) + 0.5) / size[1],
        1.0 - (np.arange(here.top, here.bottom) + 0.5) / size[0],
    )
    first, second = (
        LineKernels(
            made[0][axis].axis,
            np.einsum("nyx,nyx->yx", shares, np.stack([lines[axis].alpha for lines in made])),
            np.einsum("nyx,nyx->yx", shares, np.stack([lines[axis].sigma_px for lines in made])),
        )
        for axis in range(2)
    )
    return first, second


def line_kernels(
    strain: TextureStrain,
    table: KernelTable = FOREHEAD,
    *,
    extrapolate: Literal["hold", "formula"] = "hold",
) -> tuple[LineKernels, LineKernels]:
    """Return the kernels of both passes for the strain at each pixel.

    Parameters
    ----------
    strain : TextureStrain
    table : KernelTable
        Table of the skin.
    extrapolate : {"hold", "formula"}
        As of `model.microstructure.kernel_parameters`.

    Returns
    -------
    LineKernels, LineKernels
        Along s and along t; alpha is 0 where unknown.
    """
    Checks().choice("extrapolate", extrapolate, ("hold", "formula"))
    shape = strain.covered.shape
    alpha, sigma = np.empty((2, *shape), np.float32), np.empty((2, *shape), np.float32)
    ends = table.stretch_range if extrapolate == "hold" else (0.0, math.inf)
    texture_kernels.look_up_kernels(
        strain.stretch,
        (strain.covered | strain.padded).astype(np.uint8),
        np.asarray(table.alpha_breaks, np.float64),
        np.asarray(table.alpha_lines, np.float64),
        1e-3 * np.asarray(table.sigma_lines_um(), np.float64),
        np.asarray(ends, np.float64),
        np.asarray(ALPHA_LIMITS, np.float64),
        strain.px_per_mm,
        alpha,
        sigma,
    )
    first, second = (
        LineKernels(np.ascontiguousarray(strain.axes[:, :, axis]), alpha[axis], sigma[axis])
        for axis in range(2)
    )
    return first, second
