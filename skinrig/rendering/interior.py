"""Compute subsurface light of a rendered face: entering flux by all lights, and exiting flux."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.dipole import gather as dipole_gather
from model.dipole.gather import SourceTree
from model.skin_reflectance import transmittance
from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh
from rigsim.mitsuba.startup import thread_count
from rigsim.render import Caster, visibility
from skinrig.arrays import Float32Array, Float64Array, Int32Array
from skinrig.rendering.geometry import FittedSurface, SurfacePointSamples
from skinrig.rendering.lights import Light

POINTS_PER_SIDE: Final = 2
"""Sample points along each side of a surface element."""
MIN_LIGHTS_FOR_ONE_POINT: Final = 8
"""Number of lights from which one sample point suffices, since their shadow edges differ."""


@dataclass(frozen=True, slots=True, eq=False)
class Lighting:
    """Lights with their shadow caster."""

    lamps: Sequence[Light]
    shadows: Caster
    samples: int
    """Shadow rays per light with a radius."""

    def entering_radiance(
        self,
        lamp: Light,
        position_mm: Float32Array,
        face_normal: Float32Array,
        normals: Float32Array,
        eta: float,
    ) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
        """Compute the irradiance and visibility of a light at points.

        Parameters
        ----------
        lamp
            The light.
        position_mm, face_normal, normals
            Points, normals of their triangles and of the maps, shape (n, 3).
        eta
            Refractive index of the skin.

        Returns
        -------
        entered, arriving : ndarray of float64, shape (n, 3)
            Transmitted and incident light, relative to a white patch that faces the light.
        towards : ndarray of float64, shape (n, 3)
            Unit vectors to the light.
        seen : ndarray of float64, shape (n,)
            Visible fraction of the light; 0 if the point does not face it.
        """
        towards, white = lamp.directions_and_irradiance(position_mm)
        cosine = np.einsum("nk,nk->n", normals.astype(np.float64), towards)
        faced = np.flatnonzero((cosine > 0.0) & (white > 0.0).any(axis=-1))
        seen = np.zeros(len(cosine))
        center, radius = lamp.disc()
        place, normal = (np.ascontiguousarray(one[faced]) for one in (position_mm, face_normal))
        samples = self.samples if radius > 0.0 else 1
        seen[faced] = visibility(
            self.shadows, place, normal, center, radius_mm=radius, samples=samples
        )
        arriving = white * (np.maximum(cosine, 0.0) * seen)[:, None]
        return arriving * transmittance(cosine, eta)[:, None], arriving, towards, seen


@dataclass(frozen=True, slots=True, eq=False)
class Interior:
    """Skin below a surface, discretized to S surface elements, independent of the lights.

    Attributes
    ----------
    surface
        Surface and maps.
    position_mm
        Center of each element, shape (S, 3).
    points_mm
        Points of the mesh in each element, where its light is sampled, shape (S, P, 3).
    points_prim
        Their triangles, shape (S, P).
    normals
        Normal of the maps at the center of each element, shape (S, 3).
    tree
        Search tree of positions and areas of the elements.
    tolerance
        Target error of the exiting flux, relative to the largest entering flux.
    """

    surface: FittedSurface
    position_mm: Float32Array
    points_mm: Float32Array
    points_prim: Int32Array
    normals: Float32Array
    tree: SourceTree
    tolerance: float = dipole_gather.GATHER_TOL

    @staticmethod
    def of(
        surface: FittedSurface,
        *,
        subdivisions: int = 1,
        region: tuple[ArrayLike, float] | None = None,
    ) -> Interior:
        """Discretize the skin by texels.

        Parameters
        ----------
        surface
            Surface and maps.
        subdivisions
            Elements along each side of a texel.
        region
            Center, mm, and radius, mm, of the discretized skin; None: all.
        """
        atlas = (
            surface.atlas
            if subdivisions == 1
            else unwrap(surface.mesh, surface.atlas.size * subdivisions)
        )
        chosen = atlas.covered
        if region is not None:
            place, far = np.asarray(region[0], np.float32), region[1]
            chosen = chosen & (np.linalg.norm(atlas.position_mm - place, axis=-1) < far)
        rows, columns = np.nonzero(chosen)
        uv = np.stack([(columns + 0.5) / atlas.size, 1.0 - (rows + 0.5) / atlas.size], axis=-1)
        position, across, along = (
            layer[chosen] for layer in (atlas.position_mm, atlas.dp_du_mm, atlas.dp_dv_mm)
        )
        across, along = across / np.float32(atlas.size), along / np.float32(atlas.size)
        area = np.linalg.norm(np.cross(across.astype(np.float64), along), axis=-1)
        held = surface.at(uv.astype(np.float32), position, atlas.normal[chosen])
        tree = SourceTree.of(position, area)
        points = _sample_elements(surface.mesh, atlas, (rows, columns), position, across + along)
        return Interior(surface, position, *points, held.normals, tree)

    def with_surface(self, surface: FittedSurface) -> Interior:
        """Return the same elements with other maps on the same mesh with the same normals."""
        return replace(self, surface=surface)

    def compute_entered_flux(self, lighting: Lighting) -> Float64Array:
        """Return the flux entering each element, relative to a white patch, (S, 3)."""
        faces = lighting.shadows.face_normals[self.points_prim]
        total = np.zeros((len(self.normals), 3))
        # several points per element anti-alias the shadow edges
        count = self.points_prim.shape[1] if len(lighting.lamps) < MIN_LIGHTS_FOR_ONE_POINT else 1
        eta = self.surface.model.eta
        for k in range(count):
            at = np.ascontiguousarray(self.points_mm[:, k]), np.ascontiguousarray(faces[:, k])
            for lamp in lighting.lamps:
                total += lighting.entering_radiance(lamp, *at, self.normals, eta)[0] / count
        return total

    def compute_exitant_flux(
        self,
        entered: Float64Array,
        position_mm: Float32Array,
        rows: SurfacePointSamples,
        entered_at: Float64Array,
    ) -> Float64Array:
        """Return the subsurface flux arriving at points from inside, before transmission, (n, 3).

        Parameters
        ----------
        entered
            Entering flux of the elements, see `compute_entered_flux`.
        position_mm, rows
            Points, shape (n, 3), and values of the maps there.
        entered_at
            Entering flux at the points themselves, shape (n, 3).
        """
        return dipole_gather.gather(
            self.tree,
            entered,
            position_mm,
            rows.r_d,
            rows.translucency_mm,
            eta=self.surface.model.eta,
            tolerance=self.tolerance,
            entered_at=entered_at,
            workers=min(thread_count(), 4),
        ).exitance


def _sample_elements(
    mesh: Mesh,
    atlas: Atlas,
    element: tuple[NDArray[np.intp], NDArray[np.intp]],
    center_mm: Float32Array,
    diagonal_mm: Float32Array,
) -> tuple[Float32Array, Int32Array]:
    """Return points of the mesh in each element and their triangles, (S, P, 3) and (S, P).

    Points of the element's plane would lie below neighboring triangles, which would shade them.
    """
    fine = unwrap(mesh, atlas.size * POINTS_PER_SIDE)
    rows, columns = element
    points = np.repeat(center_mm[:, None], POINTS_PER_SIDE**2, axis=1)
    prims = np.repeat(atlas.prim[rows, columns][:, None], POINTS_PER_SIDE**2, axis=1)
    size = np.linalg.norm(diagonal_mm, axis=-1)
    for k, (i, j) in enumerate(np.ndindex(POINTS_PER_SIDE, POINTS_PER_SIDE)):
        at = POINTS_PER_SIDE * rows + i, POINTS_PER_SIDE * columns + j
        # a chart nearby in the texture is another place
        apart = np.linalg.norm(fine.position_mm[at] - center_mm, axis=-1)
        own = fine.covered[at] & (apart < size)
        points[own, k], prims[own, k] = fine.position_mm[at][own], fine.prim[at][own]
    return points, prims
