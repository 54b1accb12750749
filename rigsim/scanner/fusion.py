"""Fuse range images of several cameras into one surface.

Signed distances along the rays are averaged in voxels (Curless and Levoy 1996, doi
10.1145/237170.237269); the surface is the dual one, a vertex in each voxel cell that it passes
(surface nets, Gibson 1998, doi 10.1007/BFb0056277), cut into triangles along shorter diagonals.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import ndimage

from rigsim.arrays import Float64Array, Int32Array, Int64Array

TRUNCATION_VOXELS: Final = 3.0
"""Truncation depth: voxels deeper below the surface than this many sides are ignored."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeImage:
    """Distances along the rays of a pinhole camera."""

    center_mm: Float64Array
    axes: Float64Array
    """Unit vectors right, up and back, shape (3, 3)."""
    pitch: float
    """Side of a pixel at unit distance."""
    range_mm: Float64Array
    """Distance along the ray, shape (N, N), row 0 at the top; NaN without a surface."""
    weight: Float64Array
    """Weight of each range, (N, N), 0 to 1: product of the cosines at camera and projector."""

    @classmethod
    def from_view(
        cls, center_mm: Float64Array, target_mm: Float64Array, side: int, pitch: float
    ) -> RangeImage:
        """Return an image without ranges."""
        back = (center_mm - target_mm) / np.linalg.norm(center_mm - target_mm)
        right = np.cross([0.0, 1.0, 0.0], back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(back, right), back])
        nothing = np.full((side, side), np.nan)
        return cls(center_mm, axes, pitch, nothing, np.zeros((side, side)))

    def rays(self) -> Float64Array:
        """Return the unit vector of each pixel's ray, shape (N, N, 3)."""
        side = len(self.range_mm)
        x = self.pitch * (np.arange(side) - 0.5 * (side - 1))
        local = np.stack(np.broadcast_arrays(x[None, :], -x[:, None], -1.0), axis=-1)
        way = local @ self.axes
        return np.asarray(way / np.linalg.norm(way, axis=-1, keepdims=True))

    def with_ranges(self, range_mm: Float64Array, weight: Float64Array) -> RangeImage:
        """Return the image with ranges."""
        return replace(self, range_mm=range_mm, weight=weight)

    def points(self) -> Float64Array:
        """Return the visible points, shape (K, 3)."""
        seen = np.isfinite(self.range_mm)
        return self.center_mm + self.range_mm[seen][:, None] * self.rays()[seen]

    def signed_distances(self, points: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return each point's signed surface distance, and its weight; NaN if not visible."""
        local = (points - self.center_mm) @ self.axes.T
        middle = 0.5 * (len(self.range_mm) - 1)
        x = middle + local[:, 0] / -local[:, 2] / self.pitch
        y = middle - local[:, 1] / -local[:, 2] / self.pitch
        words = {"order": 1, "mode": "constant", "cval": np.nan, "prefilter": False}
        seen = ndimage.map_coordinates(self.range_mm, [y, x], **words)
        weight = ndimage.map_coordinates(self.weight, [y, x], **words)
        before = seen - np.linalg.norm(points - self.center_mm, axis=1)
        # sqrt(weight) is about the cosine from ray distance to perpendicular distance
        return before * np.sqrt(weight), weight


def fuse_range_images(
    images: Sequence[RangeImage], voxel_mm: float
) -> tuple[Float64Array, Int32Array]:
    """Fuse range images into a triangle mesh.

    Parameters
    ----------
    images
        Range image of each camera.
    voxel_mm
        Side of a voxel.

    Returns
    -------
    vertices : ndarray
        Shape (V, 3), mm.
    faces : ndarray of int32
        Shape (F, 3), counter-clockwise seen from outside.
    """
    seen = np.concatenate([image.points() for image in images])
    if not len(seen):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    low = seen.min(axis=0) - 2.0 * voxel_mm
    size = np.ceil((np.ptp(seen, axis=0)) / voxel_mm).astype(int) + 5
    distance = np.full(size, np.nan)
    deep = TRUNCATION_VOXELS * voxel_mm
    y, z = np.meshgrid(np.arange(size[1]), np.arange(size[2]), indexing="ij")
    for i in range(size[0]):  # one slab at a time limits memory
        points = low + voxel_mm * np.stack([np.full_like(y, i), y, z], axis=-1).reshape(-1, 3)
        total, weights = np.zeros(len(points)), np.zeros(len(points))
        for image in images:
            before, weight = image.signed_distances(points)
            near = np.isfinite(before) & (before > -deep)
            total[near] += weight[near] * np.minimum(before[near], deep)
            weights[near] += weight[near]
        known = weights > 0
        total[known] /= weights[known]
        total[~known] = np.nan
        distance[i] = total.reshape(size[1], size[2])
    return _surface_net(distance, low, voxel_mm, deep)


def _surface_net(
    distance: Float64Array, low: Float64Array, voxel_mm: float, deep: float
) -> tuple[Float64Array, Int32Array]:
    shape = np.array(distance.shape) - 1
    corners = list(itertools.product((0, 1), repeat=3))

    def at(corner: tuple[int, ...]) -> Float64Array:
        return distance[tuple(slice(c, c + n) for c, n in zip(corner, shape, strict=True))]

    near = np.ones(shape, np.bool_)
    for corner in corners:
        # cells next to unknown voxels, or at the truncation limit, contain no surface
        near &= np.abs(np.nan_to_num(at(corner), nan=np.inf)) < 0.999 * deep
    total, count = np.zeros((*shape, 3)), np.zeros(shape)
    for a, b in itertools.combinations(corners, 2):
        if sum(abs(i - j) for i, j in zip(a, b, strict=True)) != 1:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            cut = near & ((at(a) < 0) != (at(b) < 0))
            t = at(a) / (at(a) - at(b))
        where = np.array(a) + np.where(cut, t, 0.0)[..., None] * (np.array(b) - np.array(a))
        total += np.where(cut[..., None], where, 0.0)
        count += cut
    active = count > 0
    index = np.full(shape, -1, np.int64)
    index[active] = np.arange(np.count_nonzero(active))
    cells = np.argwhere(active)
    vertices = low + voxel_mm * (cells + total[active] / count[active][:, None])
    quads = []
    inside = distance < 0
    known = np.isfinite(distance)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        # grid edges along the axis whose four cells all exist
        inner = [slice(0, n) for n in shape]
        inner[u], inner[v] = slice(1, shape[u]), slice(1, shape[v])
        ahead = list(inner)
        ahead[axis] = slice(1, shape[axis] + 1)
        here, there = tuple(inner), tuple(ahead)
        crossed = known[here] & known[there] & (inside[here] != inside[there])
        where = np.argwhere(crossed)
        where[:, u] += 1
        where[:, v] += 1
        around = []
        for du, dv in ((1, 1), (0, 1), (0, 0), (1, 0)):
            cell = where.copy()
            cell[:, u] -= du
            cell[:, v] -= dv
            around.append(index[tuple(cell.T)])
        quad = np.stack(around, axis=1)
        flip = ~inside[here][crossed]
        quad[flip] = quad[flip][:, ::-1]
        quads.append(quad[(quad >= 0).all(axis=1)])
    return vertices, _triangulate_quads(vertices, np.concatenate(quads))


def _triangulate_quads(vertices: Float64Array, quads: Int64Array) -> Int32Array:
    """Cut quads along their shorter diagonals."""
    a, b, c, d = (vertices[quads[:, k]] for k in range(4))
    along = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
    first = np.where(along[:, None], quads[:, [0, 1, 2]], quads[:, [0, 1, 3]])
    second = np.where(along[:, None], quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])
    return np.concatenate([first, second]).astype(np.int32)
