"""Light inside a rendered face: what enters each texel by all lights, and where it comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import dipole_gather
from model.dipole_gather import SourceTree
from model.skin_reflectance import transmitted
from rigsim.mesh import Float32Array
from rigsim.render import Caster, thread_count, visibility
from skinrig.rendering_geometry import FittedSurface, Rows
from skinrig.rendering_lights import Light

FloatArray = NDArray[np.float64]

POINTS: Final = 2
"""Points along each side of a texel that light is looked for at."""


@dataclass(frozen=True, slots=True, eq=False)
class Interior:
    """The skin below a surface, ready for any light.

    Attributes
    ----------
    laid
        Surface and maps.
    texels
        Flat indices of the texels that light enters by, shape (S,).
    tree
        Their places and areas.
    """

    laid: FittedSurface
    texels: NDArray[np.intp]
    tree: SourceTree

    @staticmethod
    def of(laid: FittedSurface) -> Interior:
        """Take every texel of the mesh as a place where light enters."""
        atlas = laid.atlas
        texels = np.flatnonzero(atlas.covered)
        across = np.cross(
            atlas.dp_du_mm.reshape(-1, 3)[texels], atlas.dp_dv_mm.reshape(-1, 3)[texels]
        )
        area = np.linalg.norm(across.astype(np.float64), axis=-1) / atlas.size**2
        tree = SourceTree.of(atlas.position_mm.reshape(-1, 3)[texels], area)
        return Interior(laid, texels, tree)

    def entered(self, lamps: Sequence[Light], shadows: Caster, samples: int) -> FloatArray:
        """Return what passes the surface at the texels, over what a white patch shows, (S, 3)."""
        atlas = self.laid.atlas
        position, du, dv = (
            layer.reshape(-1, 3)[self.texels]
            for layer in (atlas.position_mm, atlas.dp_du_mm, atlas.dp_dv_mm)
        )
        faces = shadows.face_normals[atlas.prim.reshape(-1)[self.texels]]
        normals = self.laid.normals.reshape(-1, 3)[self.texels]
        total = np.zeros((len(self.texels), 3))
        # several points of each texel, or shadows would end in steps
        offsets = ((np.arange(POINTS) + 0.5) / POINTS - 0.5) / atlas.size
        for across in offsets:
            for along in offsets:
                place = position + np.float32(across) * du + np.float32(along) * dv
                for lamp in lamps:
                    light = entering(
                        lamp, place, faces, normals, shadows, samples, self.laid.model.eta
                    )[0]
                    total += light / POINTS**2
        return total

    def leaving(
        self, entered: FloatArray, position_mm: Float32Array, rows: Rows, entered_at: FloatArray,
        *, tolerance: float = dipole_gather.TOLERANCE,
    ) -> FloatArray:  # fmt: skip
        """Return what comes back to the surface from inside at points, before it leaves, (n, 3).

        Parameters
        ----------
        entered
            At the texels, see `entered`.
        position_mm, rows
            Points, shape (n, 3), and what the maps hold there.
        entered_at
            What enters at the points themselves, shape (n, 3).
        tolerance
            Aimed-at error over the brightest light that entered.
        """
        return dipole_gather.gather(
            self.tree, entered, position_mm, rows.r_d, rows.translucency_mm,
            eta=self.laid.model.eta, tolerance=tolerance, entered_at=entered_at,
            workers=min(thread_count(), 4),
        ).exitance  # fmt: skip


def entering(
    lamp: Light,
    position_mm: Float32Array,
    face_normal: Float32Array,
    normals: Float32Array,
    shadows: Caster,
    samples: int,
    eta: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what a light brings to points.

    Parameters
    ----------
    lamp
        The light.
    position_mm, face_normal, normals
        Points, normals of their triangles and of the maps, shape (n, 3).
    shadows
        What casts shadows.
    samples
        Points on the light's disc; one where it has no radius.
    eta
        Refractive index of the skin.

    Returns
    -------
    entered, arriving : ndarray of float64, shape (n, 3)
        Through the boundary, and before it: over what a white patch that faces the light shows.
    towards : ndarray of float64, shape (n, 3)
        Unit vectors to the light.
    seen : ndarray of float64, shape (n,)
        Share of the light that is seen; 0 where the point does not face it.
    """
    towards, white = lamp.reach(position_mm)
    cosine = np.einsum("nk,nk->n", normals.astype(np.float64), towards)
    faced = np.flatnonzero((cosine > 0.0) & (white > 0.0).any(axis=-1))
    seen = np.zeros(len(cosine))
    center, radius = lamp.disc()
    seen[faced] = visibility(
        shadows, np.ascontiguousarray(position_mm[faced]),
        np.ascontiguousarray(face_normal[faced]), center,
        radius_mm=radius, samples=samples if radius > 0.0 else 1,
    )  # fmt: skip
    arriving = white * (np.maximum(cosine, 0.0) * seen)[:, None]
    return arriving * transmitted(cosine, eta)[:, None], arriving, towards, seen
