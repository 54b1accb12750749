"""Find the closest points of a scanned surface, with its normals and borders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import BoolArray, Float64Array, Int64Array
from reconstruction.scan.repair import TriangleMesh, boundary_edges, repair_mesh

MIN_SURFACE_FRACTION: Final = 0.03
"""Area, relative to the largest surface, below which a connected surface is an island."""
PIECE_EDGE_MM: Final = 4.0
"""Longest edge of the pieces into which triangles are divided for the search."""
NEAREST_PIECES: Final = 6
"""Number of nearest pieces whose triangles are examined exactly."""
NORMAL_SMOOTHINGS: Final = 2
"""Averages of the scan's normals over neighboring vertices, against the noise of ranges."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoints:
    """Points of a surface closest to given ones."""

    points_mm: Float64Array
    """Shape (N, 3)."""
    normals: Float64Array
    """Unit normals of the smoothed surface there, shape (N, 3)."""
    distance_mm: Float64Array
    """Shape (N,)."""
    on_border: BoolArray
    """Whether a point is next to a border or a hole, shape (N,)."""


class ScanSurface:
    """Surface of a scan, prepared for searches of closest points.

    Parameters
    ----------
    mesh : TriangleMesh
        As scanned; it is repaired, and islands are omitted. Holes stay open.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        clean, self.report = repair_mesh(
            mesh, max_hole_mm=0.0, min_surface_fraction=MIN_SURFACE_FRACTION
        )
        self.mesh = clean
        self.normals = _smooth_normals(clean)
        self.border = np.zeros(len(clean.vertices_mm))
        self.border[boundary_edges(clean.faces)] = 1.0
        points, self._owner = _pieces(clean)
        self._tree = cKDTree(points)

    def find_closest(self, points_mm: Float64Array) -> ClosestPoints:
        """Return the closest points of the surface.

        Parameters
        ----------
        points_mm : ndarray, shape (N, 3)

        Returns
        -------
        ClosestPoints
        """
        _, near = self._tree.query(points_mm, k=min(NEAREST_PIECES, self._tree.n))
        triangle = self._owner[near.reshape(len(points_mm), -1)]
        corners = self.mesh.vertices_mm[self.mesh.faces[triangle]]  # (N, K, 3, 3)
        weight = closest_barycentric(points_mm[:, None], corners)
        found = np.einsum("nkc,nkcd->nkd", weight, corners)
        away = np.linalg.norm(found - points_mm[:, None], axis=-1)
        best = np.argmin(away, axis=1)
        row = np.arange(len(points_mm))
        faces, w = self.mesh.faces[triangle[row, best]], weight[row, best]
        normals = np.einsum("nc,ncd->nd", w, self.normals[faces])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return ClosestPoints(
            found[row, best],
            normals,
            away[row, best],
            np.einsum("nc,nc->n", w, self.border[faces]) > 0.5,
        )


def closest_barycentric(points: Float64Array, corners: Float64Array) -> Float64Array:
    """Return barycentric weights of the closest points of triangles.

    Parameters
    ----------
    points : ndarray, shape (..., 3)
    corners : ndarray, shape (..., 3, 3)
        Corners of a triangle for each point; leading axes broadcast.

    Returns
    -------
    ndarray
        Weights of the corners, >= 0 with sum 1, shape (..., 3).

    Examples
    --------
    >>> triangle = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    >>> closest_barycentric(np.array([1.0, -3.0, 5.0]), triangle).tolist()
    [0.5, 0.5, 0.0]
    """
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v = (d11 * d20 - d01 * d21) / area
    w = (d00 * d21 - d01 * d20) / area
    inside = np.stack([1.0 - v - w, v, w], axis=-1)
    # outside, the closest point is on one of the edges
    t_ab = np.clip(d20 / np.maximum(d00, 1e-30), 0.0, 1.0)
    t_ac = np.clip(d21 / np.maximum(d11, 1e-30), 0.0, 1.0)
    bc = c - b
    t_bc = np.clip(_dot(points - b, bc) / np.maximum(_dot(bc, bc), 1e-30), 0.0, 1.0)
    zero = np.zeros_like(t_ab)
    edges = np.stack(
        [
            np.stack([1.0 - t_ab, t_ab, zero], axis=-1),
            np.stack([1.0 - t_ac, zero, t_ac], axis=-1),
            np.stack([zero, 1.0 - t_bc, t_bc], axis=-1),
        ],
        axis=-2,
    )  # (..., 3 edges, 3)
    on_edge = np.einsum("...ec,...cd->...ed", edges, corners)
    away = np.sum((on_edge - points[..., None, :]) ** 2, axis=-1)
    best = np.take_along_axis(edges, np.argmin(away, axis=-1)[..., None, None], axis=-2)[..., 0, :]
    return np.where((inside >= 0.0).all(axis=-1, keepdims=True), inside, best)


def _dot(a: Float64Array, b: Float64Array) -> Float64Array:
    return np.einsum("...k,...k->...", a, b)


def _smooth_normals(mesh: TriangleMesh) -> Float64Array:
    normals = mesh.normals().astype(np.float64)
    for _ in range(NORMAL_SMOOTHINGS):
        means = normals[mesh.faces].sum(axis=1)
        total = np.zeros_like(normals)
        for corner in range(3):
            for k in range(3):
                total[:, k] += np.bincount(mesh.faces[:, corner], means[:, k], len(normals))
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return normals


def _pieces(mesh: TriangleMesh) -> tuple[Float64Array, Int64Array]:
    """Return centers of pieces of triangles with short edges, and the triangle of each piece."""
    corners, owner = mesh.vertices_mm[mesh.faces], np.arange(len(mesh.faces))
    centers, owners = [], []
    while len(corners):
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
        small = sides.max(axis=1) <= PIECE_EDGE_MM
        centers.append(corners[small].mean(axis=1))
        owners.append(owner[small])
        corners, owner, sides = corners[~small], owner[~small], sides[~small]
        # halved at the longest edge, from corner k - 1 to corner k
        k = np.argmax(sides, axis=1)
        row = np.arange(len(corners))
        middle = 0.5 * (corners[row, k] + corners[row, k - 1])
        one, two = corners.copy(), corners
        one[row, k], two[row, k - 1] = middle, middle
        corners, owner = np.concatenate([one, two]), np.concatenate([owner, owner])
    return np.concatenate(centers), np.concatenate(owners)
