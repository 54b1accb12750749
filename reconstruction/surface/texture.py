"""Convert estimates at surface points to textures, and export the textured mesh."""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from model.skin import MAP_UNITS, SkinMap
from reconstruction.arrays import BoolArray, FloatArray
from reconstruction.scan.mesh import RefinedScan
from reconstruction.surface import texture_fill
from reconstruction.surface.estimates import PointValues
from reconstruction.surface.texture_fill import TexelMap

MIN_MEASURED_WEIGHT: Final = 0.99
"""Minimum weight of a measured texel: all corners of its triangle must be measured."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTexture:
    """A square texture on a refined scan.

    Attributes
    ----------
    surface
        Points, triangles and texture coordinates.
    texels
        Triangle of each texel.
    """

    surface: RefinedScan
    texels: TexelMap

    @staticmethod
    def of(surface: RefinedScan, *, size: int) -> SurfaceTexture:
        """Lay out a surface in a texture of ``size`` texels along each side."""
        return SurfaceTexture(surface, texture_fill.rasterize(surface.corner_uv, size))

    def map(
        self,
        values: FloatArray,
        stderr: FloatArray | None,
        valid: BoolArray,
        unit: str,
        description: str,
    ) -> SkinMap:
        """Interpolate values at the points to a map.

        Parameters
        ----------
        values, stderr
            (P,) or (P, 3).
        valid
            (P,).
        unit, description
            Unit and description of the map.

        Returns
        -------
        SkinMap
            Invalid texels are filled from their neighborhood.
        """
        trust = np.asarray(valid, np.float32)
        drawn = partial(texture_fill.texels_from_points, self.texels, self.surface.faces)
        filled = texture_fill.densify(self.texels, self.surface.faces, values, trust)
        _, weight = drawn(np.ones(len(trust), np.float32), trust)
        spread = None if stderr is None else drawn(stderr, trust)[0]
        shape = filled.values.shape[:2] + (() if np.ndim(values) == 1 else (3,))
        return SkinMap(
            filled.values.reshape(shape),
            unit,
            None if spread is None else spread.reshape(shape),
            weight >= MIN_MEASURED_WEIGHT,
            description,
        )

    def normals(self, found: PointValues, description: str) -> SkinMap:
        """Interpolate unit normals to a map, with angles in rad as standard errors."""
        drawn = self.map(found.values, found.stderr, found.valid, MAP_UNITS["normals"], description)
        length = np.linalg.norm(drawn.values, axis=-1, keepdims=True)
        unit = np.where(length > 0, drawn.values / np.maximum(length, 1e-9), (0.0, 0.0, 1.0))
        return SkinMap(unit.astype(np.float32), drawn.unit, drawn.stderr, drawn.valid, description)

    def wavefront(self) -> bytes:
        """Return the surface as an OBJ file in mm with its texture coordinates and normals."""
        surface = self.surface
        corner = surface.corner_uv.reshape(-1, 2)
        uv, which = np.unique(corner, axis=0, return_inverse=True)
        which = which.reshape(-1, 3) + 1
        at = surface.faces + 1
        out = io.StringIO()
        out.write("# mm, rig frame; texture coordinates (0, 0) bottom left\n")
        np.savetxt(out, surface.points_mm, "v %.4f %.4f %.4f")
        np.savetxt(out, uv, "vt %.6f %.6f")
        np.savetxt(out, surface.normals, "vn %.5f %.5f %.5f")
        rows = np.stack([at, which, at], axis=-1).reshape(-1, 9)
        np.savetxt(out, rows, "f %d/%d/%d %d/%d/%d %d/%d/%d")
        return out.getvalue().encode("ascii")
