"""Layout of a displacement map: the window shown in each cell, and drawing of any part."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from model.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from model.displacement_synthesis import kernels
from model.displacement_synthesis.regions import interpolate_weights
from model.displacement_synthesis.sources import PatchSources, SynthesisError

TILE_PX = 1024
"""Side of the tiles in which steps are closed; the result depends on it."""
MARGIN_TO_RANGE_RATIO = 8.0
"""A tile's margin in ranges of the screened Poisson equation: a step has decayed to e^-8."""


class CellGrid(NamedTuple):
    """Grid of the cells of a map."""

    lines_y: Int64Array
    """(ny + 1,) rows at which cells begin, the last one the map's height."""
    lines_x: Int64Array
    """(nx + 1,) columns at which cells begin, the last one the map's width."""
    overlap: int
    """Overlap of neighboring windows, px, half of it on each side of a line."""
    window: int
    """Side of the windows, px."""
    wrap: tuple[bool, bool]
    """Whether the map is periodic, vertically and horizontally."""


class SiteLayout(NamedTuple):
    """Layout of the patches of one site."""

    sources: PatchSources
    cells: Int64Array
    """(ny, nx, 4): source, row and column of the window, filled pixels in it; source -2: none."""
    across: NDArray[np.int16]
    """(ny, nx, window): where each cell begins within its overlap with the one to the left."""
    down: NDArray[np.int16]
    """(ny, width): where each row of cells begins within its overlap with the one above."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Layout of a map: the window shown in each cell; any part can be drawn alone."""

    grid: CellGrid
    sites: tuple[SiteLayout, ...]
    weights: Float64Array | None
    """(R, h, w) weights of sites on a coarse grid; None: one site everywhere."""
    range_px: float
    """Distance over which steps at cuts are closed, px."""

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the map."""
        return int(self.grid.lines_y[-1]), int(self.grid.lines_x[-1])

    @property
    def filled_fraction(self) -> float:
        """Return the fraction of the windows' pixels that were filled, not measured, 0 to 1."""
        chosen = [site.cells[site.cells[..., 0] >= 0] for site in self.sites]
        count = sum(len(each) for each in chosen) * self.grid.window**2
        return float(sum(int(each[:, 3].sum()) for each in chosen)) / count

    def draw(self, rows: tuple[int, int], columns: tuple[int, int]) -> Float32Array:
        """Draw a part of the map; the result does not depend on the other parts.

        Parameters
        ----------
        rows, columns : (int, int)
            First and last + 1, within the map.

        Returns
        -------
        ndarray of float32
            Heights, um; a pixel is the same in every part.

        Raises
        ------
        SynthesisError
            For a part outside the map.
        """
        self._check(rows, columns)
        out = np.empty((rows[1] - rows[0], columns[1] - columns[0]), np.float32)
        for top, left in self.tiles(rows, columns):
            tile = self.tile(top, left)
            y0, x0 = max(top, rows[0]), max(left, columns[0])
            y1, x1 = min(top + tile.shape[0], rows[1]), min(left + tile.shape[1], columns[1])
            out[y0 - rows[0] : y1 - rows[0], x0 - columns[0] : x1 - columns[0]] = tile[
                y0 - top : y1 - top, x0 - left : x1 - left
            ]
        return out

    def cut_mask(self, rows: tuple[int, int], columns: tuple[int, int]) -> BoolArray:
        """Return the pixels that touch another window than their own, in any visible site.

        Parameters
        ----------
        rows, columns : (int, int)
            First and last + 1, within the map.
        """
        self._check(rows, columns)
        found = np.zeros((rows[1] - rows[0], columns[1] - columns[0]), bool)
        for site in self.sites:
            _, labels, _ = self._write_windows(site, rows[0], columns[0], found.shape)
            for axis in (0, 1):
                other = np.diff(labels, axis=axis) != 0
                ends = [np.zeros_like(other.take([0], axis)), other]
                found |= np.concatenate(ends, axis) | np.concatenate(ends[::-1], axis)
        return found

    def tiles(
        self, rows: tuple[int, int] | None = None, columns: tuple[int, int] | None = None
    ) -> Iterator[tuple[int, int]]:
        """Yield first row and column of each tile of the map, or of those that meet a part."""
        rows, columns = rows or (0, self.shape[0]), columns or (0, self.shape[1])
        for top in range(rows[0] // TILE_PX * TILE_PX, rows[1], TILE_PX):
            for left in range(columns[0] // TILE_PX * TILE_PX, columns[1], TILE_PX):
                yield top, left

    def tile(self, top: int, left: int) -> Float32Array:
        """Draw one of :meth:`tiles`, in um."""
        shape = self.shape
        high, wide = min(TILE_PX, shape[0] - top), min(TILE_PX, shape[1] - left)
        if self.weights is None:
            return self._relief(self.sites[0], top, left, (high, wide))
        part = (top, top + high), (left, left + wide)
        shares = np.stack(
            [interpolate_weights(one, shape, *part, wrap=self.grid.wrap) for one in self.weights]
        )
        shares /= np.sqrt((shares**2).sum(axis=0))
        out = np.zeros((high, wide), np.float32)
        for site, share in zip(self.sites, shares.astype(np.float32), strict=True):
            if share.any():
                out += share * self._relief(site, top, left, (high, wide))
        return out

    def _check(self, rows: tuple[int, int], columns: tuple[int, int]) -> None:
        for name, (first, last), size in zip(
            ("rows", "columns"), (rows, columns), self.shape, strict=True
        ):
            if not 0 <= first < last <= size:
                raise SynthesisError(f"{name}: got {first}...{last}, expected within 0...{size}")

    def _write_windows(
        self, site: SiteLayout, top: int, left: int, size: tuple[int, int]
    ) -> tuple[Float32Array, Int64Array, Int64Array]:
        out = np.empty(size, np.float32)
        labels, pixels = np.empty(size, np.int64), np.empty(size, np.int64)
        kernels.write_windows(top, left, self.grid, site, out, labels, pixels)
        return out, labels, pixels

    def _relief(self, site: SiteLayout, top: int, left: int, size: tuple[int, int]) -> Float32Array:
        margin = math.ceil(MARGIN_TO_RANGE_RATIO * self.range_px)
        out, labels, pixels = self._write_windows(
            site, top - margin, left - margin, (size[0] + 2 * margin, size[1] + 2 * margin)
        )
        steps = np.empty_like(out)
        kernels.cut_divergence(out, labels, pixels, site, steps)
        out += _solve_correction(steps, self.range_px)
        return out[margin : margin + size[0], margin : margin + size[1]]


def _solve_correction(divergence: Float32Array, range_px: float) -> Float32Array:
    """Return c of ``(1 / range^2 - Laplace) c = divergence``, periodic over the array."""
    rows, columns = (fft.next_fast_len(n, real=True) for n in divergence.shape)
    spectrum = fft.rfft2(divergence, s=(rows, columns))
    ky = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.arange(rows) / rows)
    kx = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.arange(columns // 2 + 1) / columns)
    spectrum /= (ky[:, None] + kx[None, :] + range_px**-2).astype(np.float32)
    whole = fft.irfft2(spectrum, s=(rows, columns), overwrite_x=True)
    return np.asarray(whole[: divergence.shape[0], : divergence.shape[1]])
