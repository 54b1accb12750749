"""Join relief across charts: islands of a texture that meet on the skin.

A map grown in the texture has a step of height where two charts meet. Within a millimeter of such
seams the relief fades into noise in space, which is the same on both sides. Weights divided by the
root of their sum of squares keep the RMS height.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from model.displacement_synthesis.volume_noise import VolumeNoise
from rigsim.geometry.atlas import Atlas, unwrap
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import Float64Array

SEAM_FADE_MM: Final = 1.0
"""Distance from a seam at which the relief is that of the map alone."""
SEAM_ATLAS_PX: Final = 1024
ROWS_PER_BAND: Final = 256
POSITION_DECIMALS: Final = 4
"""Vertices equal to this many decimals of a millimeter are one point of the skin."""


@dataclass(frozen=True, slots=True, eq=False)
class ChartSeams:
    """Edges of a mesh whose two triangles belong to different places of the texture.

    Attributes
    ----------
    first, second
        Texture coordinates of both ends, on either side, (E, 2, 2).
    length_mm
        (E,).
    """

    first: Float64Array
    second: Float64Array
    length_mm: Float64Array

    @staticmethod
    def of(vertices_mm: ArrayLike, faces: ArrayLike, uv: ArrayLike) -> ChartSeams:
        """Find the seams of a mesh whose vertices are split there.

        Examples
        --------
        >>> points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
        >>> uv = [[0, 0], [0.4, 0], [0, 0.4], [0.6, 0], [1, 0.4], [0.6, 0.4]]
        >>> ChartSeams.of(points, [[0, 1, 2], [3, 4, 5]], uv).length_mm.round(3).tolist()
        [1.414]
        """
        points, texture = np.asarray(vertices_mm, np.float64), np.asarray(uv, np.float64)
        triangles = np.asarray(faces, np.int64)
        rounded = np.round(points, POSITION_DECIMALS)
        place = np.unique(rounded, axis=0, return_inverse=True)[1].reshape(-1)
        edges = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        ends = place[edges]
        edges = np.where((ends[:, 0] > ends[:, 1])[:, None], edges[:, ::-1], edges)
        ends = np.sort(ends, axis=1)
        order = np.lexsort(ends.T)
        edges, ends = edges[order], ends[order]
        shared = np.flatnonzero(np.all(ends[1:] == ends[:-1], axis=1))
        a, b = texture[edges[shared]], texture[edges[shared + 1]]
        split = np.abs(a - b).max(axis=(1, 2)) > 1e-6
        across = points[edges[shared[split]]]
        return ChartSeams(a[split], b[split], np.linalg.norm(across[:, 1] - across[:, 0], axis=1))

    def sample(self, step: float) -> tuple[Float64Array, Float64Array]:
        """Return texture coordinates along all seams on either side, (N, 2) each.

        Parameters
        ----------
        step
            Distance of the samples in the texture, of the longer side.
        """
        reach = [
            np.linalg.norm(side[:, 1] - side[:, 0], axis=1) for side in (self.first, self.second)
        ]
        count = np.maximum(np.ceil(np.maximum(*reach) / step).astype(int), 1)
        edge = np.repeat(np.arange(len(count)), count)
        at = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        part = ((at + 0.5) / count[edge])[:, None]
        first, second = (
            (1.0 - part) * side[edge, 0] + part * side[edge, 1]
            for side in (self.first, self.second)
        )
        return first, second


def join_charts(height_um: Any, mesh: Mesh, noise: VolumeNoise) -> float:
    """Fade a map into noise in space at the seams of its charts, in place.

    Parameters
    ----------
    height_um
        Map over the mesh's texture, (N, N), row 0 at v = 1; an array or a memory map.
    mesh
        Mesh with texture coordinates.
    noise
        Noise of the relief's RMS height.

    Returns
    -------
    float
        Length of the seams, mm; 0 leaves the map unchanged.
    """
    seams = ChartSeams.of(mesh.vertices_mm, mesh.faces, mesh.uv)
    if not len(seams.length_mm):
        return 0.0
    atlas = unwrap(mesh, SEAM_ATLAS_PX)
    if not atlas.covered.any():
        return 0.0
    distance = _seam_distance_mm(atlas, seams)
    start = atlas.typical_texel_mm()
    known = ndimage.distance_transform_edt(
        ~atlas.covered, return_distances=False, return_indices=True
    )
    side = len(height_um)
    middle = (np.arange(side) + 0.5) * SEAM_ATLAS_PX / side - 0.5
    for top in range(0, side, ROWS_PER_BAND):
        rows = middle[top : top + ROWS_PER_BAND]
        low, high = max(int(rows[0]), 0), int(np.ceil(rows[-1])) + 1
        if distance[low : high + 1].min() > start + SEAM_FADE_MM:
            continue
        at = np.meshgrid(rows, middle, indexing="ij")
        away = ndimage.map_coordinates(distance, at, order=1, mode="nearest")
        near = away < start + SEAM_FADE_MM
        part = np.clip((away[near] - start) / SEAM_FADE_MM, 0.0, 1.0) * (0.5 * np.pi)
        drawn = noise.at(_extrapolate_position(mesh, atlas, known, at[0][near], at[1][near]))
        band = np.array(height_um[top : top + ROWS_PER_BAND])
        band[near] = np.sin(part) * band[near] + np.cos(part) * drawn
        height_um[top : top + ROWS_PER_BAND] = band
    return float(seams.length_mm.sum())


def sample_map(height_um: Any, uv: Float64Array) -> Float64Array:
    """Interpolate a map (N, N), row 0 at v = 1, at texture coordinates (M, 2), bilinearly."""
    side = len(height_um)
    x, y = uv[:, 0] * side - 0.5, (1.0 - uv[:, 1]) * side - 0.5
    column, row = (np.clip(np.floor(at).astype(int), 0, side - 2) for at in (x, y))
    fx, fy = np.clip(x - column, 0.0, 1.0), np.clip(y - row, 0.0, 1.0)
    corners = [[height_um[row + dy, column + dx] for dx in (0, 1)] for dy in (0, 1)]
    upper, lower = ((1.0 - fx) * a + fx * b for a, b in corners)
    return np.asarray((1.0 - fy) * upper + fy * lower, np.float64)


def _seam_distance_mm(atlas: Atlas, seams: ChartSeams) -> Float64Array:
    """Return each texel's distance from the nearest seam, mm, by the size of texels there."""
    away = np.ones((atlas.size, atlas.size), bool)
    for uv in seams.sample(0.5 / atlas.size):
        place = np.stack([(1.0 - uv[:, 1]) * atlas.size, uv[:, 0] * atlas.size]).astype(int)
        away[tuple(np.clip(place, 0, atlas.size - 1))] = False
    along_u, along_v = atlas.texel_mm()
    texel_mm = np.where(atlas.covered, np.sqrt(along_u * along_v), atlas.typical_texel_mm())
    texels, nearest = ndimage.distance_transform_edt(away, return_indices=True)
    return np.asarray(texels * texel_mm[tuple(nearest)], np.float64)


def _extrapolate_position(
    mesh: Mesh, atlas: Atlas, known: Any, row: Float64Array, column: Float64Array
) -> Float64Array:
    """Return the surface point at fractional texels, mm, in the plane of the nearest triangle."""
    limit = atlas.size - 1
    texel = tuple(np.clip(np.rint(at).astype(int), 0, limit) for at in (row, column))
    triangle = mesh.faces[atlas.prim[tuple(index[texel] for index in known)]]
    corners = mesh.uv[triangle].astype(np.float64)
    uv = np.stack([(column + 0.5) / atlas.size, 1.0 - (row + 0.5) / atlas.size], axis=1)
    a, b, at = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], uv - corners[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(area == 0.0, np.inf, area)
    along_a = (at[:, 0] * b[:, 1] - at[:, 1] * b[:, 0]) / area
    along_b = (a[:, 0] * at[:, 1] - a[:, 1] * at[:, 0]) / area
    points = mesh.vertices_mm[triangle].astype(np.float64)
    return np.asarray(
        points[:, 0]
        + along_a[:, None] * (points[:, 1] - points[:, 0])
        + along_b[:, None] * (points[:, 2] - points[:, 0])
    )
