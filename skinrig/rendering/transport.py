"""Trace light that leaves the skin and returns to it: interreflection between parts of a face.

Monte Carlo paths start at elements of the skin, in cosine-weighted directions. Where a path meets
the skin, the fitted model reflects: subsurface light by R_d, and the lamps' light by the lobes.
Paths continue from element to element, so that the rays of the first reflection serve
all later ones. In the unit of `skinrig.rendering.render`, the light from the skin that enters an
element is::

    entered_b = mean over directions of F_t(in) (F_t(out) R_d entered_(b-1) + surface_b)

Later reflections are diffuse: the lobes reflect the light of the lamps, and towards the camera all
light. Paths leave where they enter; the dipole spreads the sum of all entering light at the end,
as its width of some millimeters is small against the distance between parts of a face.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 9: Monte Carlo ray tracing.
Kajiya 1986, doi:10.1145/15886.15902.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from model.skin_reflectance import lobe_brdf, transmittance
from rigsim.geometry.atlas import unwrap
from rigsim.render import Caster
from skinrig.arrays import Float32Array, Float64Array, Int32Array
from skinrig.errors import require_choice
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.geometry import FittedSurface, SurfacePointSamples
from skinrig.rendering.interior import Lighting

Transport = Literal["direct", "path"]
"""Light of the lamps alone, or also light that skin reflects onto skin."""

PATH_SAMPLES: Final = 64
"""Directions per element, at the knee of the curve of error against time."""
MAX_REFLECTIONS: Final = 50
"""Reflections by the skin before the camera's; a face needs 4 to 6, a closed cavity of R_d 0.8
needs 41."""
MIN_REFLECTION: Final = 1e-4
"""Largest entering light of a reflection, relative to the first, below which paths end."""
MAX_ELEMENT_SIDE: Final = 128
"""Elements along a side of the texture: a side of 2 mm on a face."""
RAY_OFFSET_MM: Final = 0.02
"""Distance from the surface at which paths start."""
N_NEIGHBORS: Final = 4
"""Elements from which a point's returning light is interpolated."""
CAMERA_SAMPLES: Final = 16
"""Directions per camera ray for light that the surface reflects towards the camera."""
FACET_ROUGHNESS: Final = 0.3
"""GGX roughness of the facets of half of these directions: near that of skin."""
GOLDEN_RATIO: Final = 0.5 * (1.0 + math.sqrt(5.0))


@dataclass(frozen=True, slots=True, eq=False)
class ReturningLight:
    """Light of some lamps that returns to the skin.

    Attributes
    ----------
    entered
        Light from the skin that enters each element, (S, 3).
    exitance
        Light below the surface that leaves each element: R_d times all that enters, (S, 3).
    lamps
        Incident light and unit vectors of each lamp at the elements, each (S, 3).
    reflections
        Number of reflections until paths ended.
    """

    entered: Float64Array
    exitance: Float64Array
    lamps: tuple[tuple[Float64Array, Float64Array], ...]
    reflections: int


@dataclass(frozen=True, slots=True, eq=False)
class SkinExchange:
    """Paths between elements of a surface, independent of the lights.

    Attributes
    ----------
    surface, caster
        Model on its mesh, and rays against the mesh.
    position_mm, face_normal
        Elements and normals of their triangles, (S, 3).
    rows
        Values of the maps at the elements.
    way
        Directions of paths, unit vectors, (S, N, 3).
    met
        Element that a path meets, (S, N); -1: none, or the inside of the mesh.
    seed, samples
        Seed, and N.
    """

    surface: FittedSurface
    caster: Caster
    position_mm: Float32Array
    face_normal: Float32Array
    rows: SurfacePointSamples
    way: Float32Array
    met: Int32Array
    seed: int
    samples: int
    _tree: cKDTree

    @staticmethod
    def of(
        surface: FittedSurface,
        caster: Caster,
        *,
        samples: int = PATH_SAMPLES,
        seed: int = 0,
        side: int | None = None,
    ) -> SkinExchange:
        """Trace the paths of a surface.

        Parameters
        ----------
        surface
            Model on its mesh.
        caster
            Rays against the mesh.
        samples
            Directions per element, at least 1.
        seed
            Seed of the directions.
        side
            Elements along a side of the texture; None: that of the maps, at most
            `MAX_ELEMENT_SIDE`.

        Raises
        ------
        RenderingError
            Without a direction, or without an element.
        """
        if samples < 1:
            raise RenderingError(f"path samples: got {samples}, expected 1 or more; raise them")
        size = min(surface.atlas.size, MAX_ELEMENT_SIDE) if side is None else side
        atlas = surface.atlas if size == surface.atlas.size else unwrap(surface.mesh, size)
        lines, columns = np.nonzero(atlas.covered)
        if not len(lines):
            raise RenderingError("mesh: got no texel on it, expected a textured surface")
        uv = np.stack([(columns + 0.5) / size, 1.0 - (lines + 0.5) / size], axis=-1)
        position = atlas.position_mm[atlas.covered]
        rows = surface.at(uv.astype(np.float32), position, atlas.normal[atlas.covered])
        faces = caster.face_normals[atlas.prim[atlas.covered]]
        tree = cKDTree(position.astype(np.float64))
        way = _cosine_directions(rows.normals, samples, seed)
        met = _meet(caster, tree, position, faces, way)
        return SkinExchange(surface, caster, position, faces, rows, way, met, seed, samples, tree)

    @staticmethod
    def for_transport(
        transport: Transport, surface: FittedSurface, caster: Caster, *, samples: int, seed: int
    ) -> SkinExchange | None:
        """Return the paths of a transport; None for direct light.

        Parameters
        ----------
        transport
            "direct" or "path".
        surface, caster, samples, seed
            See `of`.
        """
        require_choice("transport", transport, get_args(Transport), RenderingError)
        if transport == "direct":
            return None
        return SkinExchange.of(surface, caster, samples=samples, seed=seed)

    def trace(self, lighting: Lighting) -> ReturningLight:
        """Trace the light of lamps until paths end.

        Parameters
        ----------
        lighting
            The lamps and their shadows.
        """
        eta = self.surface.model.eta
        direct = np.zeros((len(self.met), 3))
        lamps = []
        for lamp in lighting.lamps:
            through, arriving, towards, _ = lighting.entering_radiance(
                lamp, self.position_mm, self.face_normal, self.rows.normals, eta
            )
            direct += through
            lamps.append((arriving, towards))
        shine = self._lobe_radiance(self.met, -self.way, lamps)
        return self.scatter(direct, shine=shine, lamps=lamps)

    def scatter(
        self,
        direct: Float64Array,
        *,
        shine: Float64Array | None = None,
        lamps: Sequence[tuple[Float64Array, Float64Array]] = (),
    ) -> ReturningLight:
        """Reflect entering light between elements until paths end.

        Parameters
        ----------
        direct
            Light of the lamps that enters each element, (S, 3).
        shine
            Radiance of surface reflection along each path, (S, N, 3); None: none.
        lamps
            Field of the result.
        """
        into, out = self._transmittances()
        # an estimate above 1 would make energy
        r_d = np.clip(self.rows.r_d.astype(np.float64), 0.0, 1.0)
        total = np.zeros_like(direct)
        source = r_d * direct
        first = 0.0
        for number in range(1, MAX_REFLECTIONS + 1):
            radiance = out[..., None] * np.where(
                (self.met >= 0)[..., None], source[np.maximum(self.met, 0)], 0.0
            )
            if number == 1 and shine is not None:
                radiance += shine
            entered = (into[..., None] * radiance).mean(axis=1)
            total += entered
            size = float(np.abs(entered).max(initial=0.0))
            first = max(first, size)
            if size <= MIN_REFLECTION * first:
                break
            source = r_d * entered
        return ReturningLight(total, r_d * (direct + total), tuple(lamps), number)

    def entered_at(self, light: ReturningLight, points_mm: Float32Array) -> Float64Array:
        """Return the light from the skin that enters points, (n, 3), interpolated."""
        count = min(N_NEIGHBORS, len(self.position_mm))
        distance, index = self._tree.query(points_mm.astype(np.float64), k=range(1, count + 1))
        weight = 1.0 / np.maximum(distance, 1e-3) ** 2
        weight /= weight.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nk,nkc->nc", weight, light.entered[index]))

    def reflected_at(
        self,
        light: ReturningLight,
        position_mm: Float32Array,
        face_normal: Float32Array,
        rows: SurfacePointSamples,
        view: Float32Array,
        *,
        samples: int = CAMERA_SAMPLES,
    ) -> Float64Array:
        """Return the light from the skin that the surface reflects towards the camera, (n, 3).

        Parameters
        ----------
        light
            Light of the lamps on the skin.
        position_mm, face_normal, view
            Points, normals of their triangles and unit vectors to the camera, (n, 3).
        rows
            Values of the maps there.
        samples
            Directions per point.
        """
        way, density = _camera_directions(rows.normals, view, samples, self.seed + 1)
        met = _meet(self.caster, self._tree, position_mm, face_normal, way)
        radiance = self._lobe_radiance(met, -way, light.lamps)
        cosine = -np.einsum("snk,snk->sn", self.rows.normals[np.maximum(met, 0)], way)
        leaving = np.where(met >= 0, transmittance(cosine, self.surface.model.eta), 0.0)
        radiance += leaving[..., None] * light.exitance[np.maximum(met, 0)]
        faced = np.sum(rows.normals * view, axis=1) > 0.0
        point, number = np.nonzero((met >= 0) & faced[:, None])
        toward = way[point, number]
        at = rows.weights[point], toward, view[point], rows.normals[point]
        lobe = lobe_brdf(self.surface.model.lobes, *at)
        lobe *= np.maximum(np.einsum("nk,nk->n", toward, rows.normals[point]), 0.0)
        share = (lobe / density[point, number])[:, None] * radiance[point, number]
        total = [np.bincount(point, weights=c, minlength=len(way)) for c in share.T]
        return np.stack(total, axis=1) / samples

    def _transmittances(self) -> tuple[Float64Array, Float64Array]:
        """Return F_t at the start of each path and at the element that it meets, (S, N)."""
        eta = self.surface.model.eta
        into = transmittance(np.einsum("sk,snk->sn", self.rows.normals, self.way), eta)
        normals = self.rows.normals[np.maximum(self.met, 0)]
        out = transmittance(-np.einsum("snk,snk->sn", normals, self.way), eta)
        return into, np.where(self.met >= 0, out, 0.0)

    def _lobe_radiance(
        self,
        met: Int32Array,
        back: Float32Array,
        lamps: Sequence[tuple[Float64Array, Float64Array]],
    ) -> Float64Array:
        """Return the lamps' light that met elements' surfaces reflect back, (S, N, 3)."""
        found = np.zeros((*met.shape, 3))
        normals = self.rows.normals
        for arriving, towards in lamps:
            lit = (met >= 0) & (arriving[np.maximum(met, 0)] > 0.0).any(axis=-1)
            place = np.nonzero(lit)
            index = met[place]
            at = self.rows.weights[index], towards[index], back[place], normals[index]
            lobe = lobe_brdf(self.surface.model.lobes, *at)
            found[place] += np.pi * lobe[:, None] * arriving[index]
        return found


def _cosine_directions(normals: Float32Array, samples: int, seed: int) -> Float32Array:
    """Return cosine-weighted directions about normals, (n, samples, 3), stratified per point."""
    rng = np.random.default_rng([seed, 0x7061])
    shift = rng.random((len(normals), 2))
    number = np.arange(samples)
    u = ((number + 0.5) / samples + shift[:, :1] / samples - 0.5 / samples) % 1.0
    turn = 2.0 * np.pi * (number / GOLDEN_RATIO + shift[:, 1:])
    across = np.sqrt(u)
    axis = normals.astype(np.float64)
    helper = np.where(np.abs(axis[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(axis, side)
    found = (across * np.cos(turn))[..., None] * side[:, None]
    found += (across * np.sin(turn))[..., None] * other[:, None]
    found += np.sqrt(1.0 - u)[..., None] * axis[:, None]
    return found.astype(np.float32)


def _camera_directions(
    normals: Float32Array, view: Float32Array, samples: int, seed: int
) -> tuple[Float32Array, Float64Array]:
    """Return directions by a mixture of two densities, and the mixture's density, 1/sr.

    Half of the directions are cosine weighted, half are mirrored at facets of `FACET_ROUGHNESS`.
    """
    spread = _cosine_directions(normals, samples - samples // 2, seed)
    # facets of GGX: tan^2 = alpha^2 u / (1 - u); a cosine-weighted direction has sin^2 = u
    facet = _cosine_directions(normals, samples // 2, seed + 1).astype(np.float64)
    up = np.einsum("nsk,nk->ns", facet, normals)
    across = facet - up[..., None] * normals[:, None]
    facet = FACET_ROUGHNESS * across + up[..., None] * normals[:, None]
    facet /= np.linalg.norm(facet, axis=-1, keepdims=True)
    toward = np.einsum("nsk,nk->ns", facet, view)
    mirrored = (2.0 * toward[..., None] * facet - view[:, None]).astype(np.float32)
    way = np.concatenate([spread, mirrored], axis=1)
    half = way.astype(np.float64) + view[:, None]
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-9)
    up = np.clip(np.einsum("nsk,nk->ns", half, normals), 1e-6, 1.0)
    square = FACET_ROUGHNESS**2
    facets = square / (np.pi * (up**2 * (square - 1.0) + 1.0) ** 2) * up
    slant = np.maximum(np.einsum("nsk,nk->ns", half, view), 1e-6)
    cosine = np.maximum(np.einsum("nsk,nk->ns", way, normals), 0.0)
    part = (samples // 2) / samples
    density = (1.0 - part) * cosine / np.pi + part * facets / (4.0 * slant)
    return way, np.maximum(density, 1e-9)


def _meet(
    caster: Caster,
    tree: cKDTree,
    position_mm: Float32Array,
    face_normal: Float32Array,
    way: Float32Array,
) -> Int32Array:
    """Return the element that paths meet from outside, (n, N); -1: none."""
    count, samples = way.shape[:2]
    met = np.full((count, samples), -1, np.int32)
    start = position_mm + np.float32(RAY_OFFSET_MM) * face_normal
    point, number = np.nonzero(np.einsum("nsk,nk->ns", way, face_normal) > 0.0)
    toward = way[point, number]
    prim, weight = caster.first_hit(start[point], toward)
    hit = np.flatnonzero(prim >= 0)
    hit = hit[np.einsum("nk,nk->n", caster.face_normals[prim[hit]], toward[hit]) < 0.0]
    corners = caster.mesh.vertices_mm[caster.mesh.faces[prim[hit]]]
    share = np.concatenate([1.0 - weight[hit].sum(axis=1, keepdims=True), weight[hit]], axis=1)
    place = np.einsum("nk,nkc->nc", share, corners)
    met[point[hit], number[hit]] = tree.query(place)[1]
    return met
