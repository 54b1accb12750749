"""Hits of a camera's rays, as the integrator `olat` keeps them, and light that a scene adds."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from rigsim.arrays import Float32Array, Int32Array, UInt16Array


@dataclass(slots=True, eq=False)
class HitBand:
    """Hits of some rows of an image, sorted by pixel."""

    pixel: Int32Array
    """Pixels with at least one hit, index into the flat image, shape (P,)."""
    first: Int32Array
    """First hit of each of these within the band, shape (P + 1,)."""
    slot: UInt16Array
    """Position in the pixel, row by row, shape (n,)."""
    prim: Int32Array
    """Triangles, shape (n,)."""
    position: Float32Array
    """Points, shape (n, 3)."""
    uv: Float32Array
    """Texture coordinates, shape (n, 2)."""
    start: Any
    """Starts of the shadow rays, `mi.Point3f`."""
    ends: tuple[Any, Any]
    """First hit of each pixel and the one after its last, `mi.UInt32`."""
    materials: list[tuple[Any, Any, Any]] = field(default_factory=list)
    """For each BSDF: itself, its hits (None: all), and what it keeps of them."""

    @property
    def count(self) -> int:
        """Return the number of hits."""
        return len(self.slot)

    def release_copies(self) -> None:
        """Release triangles, points and texture coordinates, which shading does not need."""
        self.prim = self.prim[:0].copy()  # a view would keep the memory
        self.position, self.uv = self.position[:0].copy(), self.uv[:0].copy()


@dataclass(frozen=True, slots=True, eq=False)
class ImageHits:
    """Hits of a camera's rays."""

    shape: tuple[int, int]
    """Rows and columns of the image."""
    subpixels: int
    """Rays along each side of a pixel."""
    camera: Any
    """Center of projection, `mi.Point3f`."""
    bands: tuple[HitBand, ...]
    """Hits in bands of rows, from the top."""

    @property
    def count(self) -> int:
        """Return the number of hits."""
        return sum(band.count for band in self.bands)

    def rows(self) -> tuple[Int32Array, Int32Array, UInt16Array, Float32Array, Float32Array]:
        """Return pixels, the first hit of each and the end, slots, positions, and uv of all."""
        bands = self.bands
        firsts = [band.first[:-1] + rows.start for band, rows in self.parts()]
        return (
            _joined([band.pixel for band in bands], (0,), np.int32),
            np.append(_joined(firsts, (0,), np.int32), self.count).astype(np.int32),
            _joined([band.slot for band in bands], (0,), np.uint16),
            _joined([band.position for band in bands], (0, 3), np.float32),
            _joined([band.uv for band in bands], (0, 2), np.float32),
        )

    def parts(self) -> Iterator[tuple[HitBand, slice]]:
        """Yield each band and the range of its hits."""
        end = 0
        for band in self.bands:
            start, end = end, end + band.count
            yield band, slice(start, end)


@dataclass(frozen=True, slots=True, eq=False)
class AddedLight:
    """What a scene adds to the direct light of a light; each is None or an array by hit."""

    interior: Float32Array | None = None
    """Pi times subsurface radiance before the boundary, shape (n, 3), for an intensity of 1."""
    visible: Float32Array | None = None
    """Factor of the light, shape (n,)."""
    replaces_diffuse: bool = False
    """Whether `interior` includes the diffuse term."""

    def part(self, rows: slice) -> "AddedLight":
        """Return what is added to some of the hits."""
        interior, visible = (None if a is None else a[rows] for a in (self.interior, self.visible))
        return AddedLight(interior, visible, self.replaces_diffuse)


NOTHING_ADDED: Final = AddedLight()


def _joined(parts: Sequence[Any], empty: tuple[int, ...], dtype: Any) -> Any:
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(empty, dtype)
