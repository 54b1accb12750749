"""Repair scanned triangles to one surface: manifold, oriented, without islands and pinholes.

Geometry and texture are separate: vertices are welded, and each corner of a triangle carries its
own texture coordinates, so that seams of the texture do not split the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array

WELD_DISTANCE_MM: Final = 1e-3
"""Grid on which vertices are welded."""
MIN_TRIANGLE_HEIGHT_MM: Final = 1e-3
"""Height below which triangles are degenerate."""


class ScanMeshError(ValueError):
    """Scans that do not yield a surface."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Welded triangles with texture coordinates by corner."""

    vertices_mm: Float64Array
    """Shape (V, 3)."""
    faces: Int64Array
    """Shape (F, 3), counter-clockwise from outside."""
    corner_uv: Float64Array | None = None
    """Texture coordinates of each corner, shape (F, 3, 2), (0, 0) bottom left; None: none yet."""

    def face_vectors(self) -> Float64Array:
        """Return normals whose length is twice each triangle's area, shape (F, 3)."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return np.asarray(np.cross(b - a, c - a), np.float64)

    def normals(self) -> Float32Array:
        """Return unit vertex normals, weighted by area, shape (V, 3); (0, 0, 1) for none."""
        total = np.zeros_like(self.vertices_mm)
        vectors = self.face_vectors()
        for corner in range(3):
            for k in range(3):
                total[:, k] += np.bincount(
                    self.faces[:, corner], vectors[:, k], minlength=len(total)
                )
        length = np.linalg.norm(total, axis=1, keepdims=True)
        up = np.array([0.0, 0.0, 1.0])
        return np.where(length > 0, total / np.maximum(length, 1e-300), up).astype(np.float32)

    def select_faces(self, rows: BoolArray | NDArray[np.intp]) -> TriangleMesh:
        """Return some of the triangles with the vertices they use."""
        faces = self.faces[rows]
        used, faces = np.unique(faces, return_inverse=True)
        uv = None if self.corner_uv is None else self.corner_uv[rows]
        return TriangleMesh(self.vertices_mm[used], faces.reshape(-1, 3), uv)


@dataclass(frozen=True, slots=True)
class RepairReport:
    """Counts of defects found and repaired."""

    counts: dict[str, int] = field(default_factory=dict)

    def __str__(self) -> str:
        """Return the counts that are not zero, in words."""
        found = [f"{count} {what}" for what, count in self.counts.items() if count]
        return ", ".join(found) or "nothing to repair"


def repair_mesh(
    mesh: TriangleMesh, *, max_hole_mm: float = 40.0, min_surface_fraction: float = 1.0
) -> tuple[TriangleMesh, RepairReport]:
    """Repair a scan to one manifold, oriented surface.

    Parameters
    ----------
    mesh : TriangleMesh
        As scanned.
    max_hole_mm : float
        Holes with a longer rim stay open; >= 0.
    min_surface_fraction : float
        Area of the smallest connected surface to keep, relative to the largest one, 0 to 1.

    Returns
    -------
    mesh : TriangleMesh
        The largest connected surfaces, one by default, oriented like the majority of their
        triangles, normals outward.
    report : RepairReport

    Raises
    ------
    ScanMeshError
        Where no triangle is left.
    """
    counts: dict[str, int] = {}
    before = len(mesh.vertices_mm)
    mesh = weld(mesh)
    counts["doubled vertices"] = before - len(mesh.vertices_mm)
    good = _sound(mesh)
    counts["degenerate triangles"] = int(np.count_nonzero(~good))
    mesh = _some(mesh, good)
    _, first = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
    counts["doubled triangles"] = len(mesh.faces) - len(first)
    mesh = mesh.select_faces(np.sort(first))
    before = len(mesh.faces)
    mesh = _without_surplus(mesh)
    counts["triangles on edges of three"] = before - len(mesh.faces)
    mesh, flipped = _oriented(mesh)
    counts["triangles turned over"] = flipped
    mesh, split = _split_pinches(mesh)
    counts["pinched vertices"] = split
    before = len(mesh.faces)
    mesh = largest_surface(mesh, min_fraction=min_surface_fraction)
    counts["triangles of islands"] = before - len(mesh.faces)
    mesh, filled = _fill_holes(mesh, max_hole_mm)
    counts["holes filled"] = filled
    return _outward(mesh), RepairReport(counts)


def weld(mesh: TriangleMesh) -> TriangleMesh:
    """Join vertices at the same position."""
    grid = np.round(mesh.vertices_mm / WELD_DISTANCE_MM).astype(np.int64)
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return TriangleMesh(mesh.vertices_mm[first], place.reshape(-1)[mesh.faces], mesh.corner_uv)


def crop(
    mesh: TriangleMesh, *, box_mm: tuple[tuple[float, float, float], tuple[float, float, float]]
) -> TriangleMesh:
    """Omit triangles outside a box around the face.

    Parameters
    ----------
    mesh : TriangleMesh
    box_mm : pair of corners
        Least and greatest coordinates to keep; triangles are not cut.

    Raises
    ------
    ScanMeshError
        Where no triangle is left.
    """
    centers = mesh.vertices_mm[mesh.faces].mean(axis=1)
    low, high = np.array(box_mm)
    keep = np.asarray(((centers >= low) & (centers <= high)).all(axis=1))
    if not keep.any():
        raise ScanMeshError(
            f"crop: got no triangle of {len(keep)} in the box {box_mm}, expected the face; "
            "check unit and frame of the scan [SR-REC-010]"
        )
    return mesh.select_faces(keep)


def largest_surface(mesh: TriangleMesh, *, min_fraction: float = 1.0) -> TriangleMesh:
    """Return the connected surface of the largest area, and others above a fraction of it."""
    group = _face_groups(mesh.faces)
    area = np.bincount(group, np.linalg.norm(mesh.face_vectors(), axis=1))
    keep = area > min_fraction * area.max()
    keep[int(np.argmax(area))] = True
    return mesh.select_faces(keep[group])


def boundary_edges(faces: Int64Array) -> Int64Array:
    """Return the directed edges of exactly one triangle, shape (E, 2)."""
    edges = directed_edges(faces)
    return np.asarray(edges[_uses(edges)[1] == 1])


def directed_edges(faces: Int64Array) -> Int64Array:
    """Return all directed edges, shape (3 F, 2); triangle k has rows 3 k to 3 k + 2."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def _uses(edges: Int64Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the number of each row's undirected edge, and how many rows share it."""
    _, place, counts = np.unique(
        np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    place = place.reshape(-1)
    return place, counts[place]


def _pairs(faces: Int64Array) -> tuple[NDArray[np.intp], BoolArray]:
    """Return rows of directed edges that two triangles share, and which have equal direction."""
    edges = directed_edges(faces)
    place, uses = _uses(edges)
    order = np.argsort(place, kind="stable")
    order = order[uses[order] == 2].reshape(-1, 2)
    same = edges[order[:, 0], 0] == edges[order[:, 1], 0]
    return order, same


def _sound(mesh: TriangleMesh) -> BoolArray:
    """Return which triangles have an area."""
    faces = mesh.faces
    differ = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    corners = mesh.vertices_mm[faces]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    twice_area = np.linalg.norm(mesh.face_vectors(), axis=1)
    return np.asarray(differ & (twice_area > MIN_TRIANGLE_HEIGHT_MM * sides.max(axis=1)))


def _without_surplus(mesh: TriangleMesh) -> TriangleMesh:
    """Remove triangles until no edge has more than two: fins first, else all at that edge."""
    while True:
        _, uses = _uses(directed_edges(mesh.faces))
        rows = np.arange(len(uses)) // 3
        crowded = np.zeros(len(mesh.faces), np.bool_)
        crowded[rows[uses > 2]] = True
        if not crowded.any():
            return mesh
        free = np.bincount(rows[uses == 1], minlength=len(mesh.faces))
        fins = crowded & (free == 2)
        mesh = _some(mesh, ~(fins if fins.any() else crowded))


def _some(mesh: TriangleMesh, keep: BoolArray) -> TriangleMesh:
    if not keep.any():
        raise ScanMeshError(
            "mesh: got no sound triangle, expected a surface; check the scan in a mesh viewer"
        )
    return mesh.select_faces(keep)


def _face_groups(faces: Int64Array) -> NDArray[np.intp]:
    """Return the number of the connected surface of each triangle, across shared edges."""
    pairs, _ = _pairs(faces)
    rows = pairs // 3
    graph = coo_matrix((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), (len(faces),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1])


def _oriented(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Turn triangles over so that neighbors agree with the majority of each surface.

    In a graph each triangle has two nodes, as it is and turned over; joined nodes agree.
    """
    count = len(mesh.faces)
    pairs, same = _pairs(mesh.faces)
    one, two = (pairs // 3).T
    cross = np.where(same, count, 0)
    ends = np.concatenate([one, one + count]), np.concatenate([two + cross, two + count - cross])
    graph = coo_matrix((np.ones(len(ends[0])), ends), (2 * count,) * 2)
    _, group = connected_components(graph, directed=False)
    as_is, turned = group[:count], group[count:]
    # a one-sided surface has both in one group: its triangles stay as they are
    size = np.bincount(as_is, minlength=int(group.max()) + 1)
    flip = (size[turned] > size[as_is]) & (as_is != turned)
    tie = (size[turned] == size[as_is]) & (turned < as_is)
    flip |= tie
    return _flipped(mesh, flip), int(np.count_nonzero(flip))


def _flipped(mesh: TriangleMesh, flip: BoolArray) -> TriangleMesh:
    faces = mesh.faces.copy()
    faces[flip] = faces[flip][:, ::-1]
    uv = None if mesh.corner_uv is None else mesh.corner_uv.copy()
    if uv is not None:
        uv[flip] = uv[flip][:, ::-1]
    return TriangleMesh(mesh.vertices_mm, faces, uv)


def _split_pinches(mesh: TriangleMesh) -> tuple[TriangleMesh, int]:
    """Give each fan of triangles at a vertex a vertex of its own."""
    pairs, same = _pairs(mesh.faces)
    pairs = pairs[~same]  # triangles that agree about the edge
    corner = np.arange(3 * len(mesh.faces))  # corner k begins edge k of `directed_edges`
    after = corner - corner % 3 + (corner + 1) % 3
    # an edge from a to b of one triangle is the edge from b to a of the other
    one = np.concatenate([corner[pairs[:, 0]], after[pairs[:, 0]]])
    two = np.concatenate([after[pairs[:, 1]], corner[pairs[:, 1]]])
    graph = coo_matrix((np.ones(len(one)), (one, two)), (len(corner),) * 2)
    fans, fan = connected_components(graph, directed=False)
    vertex = np.empty(fans, np.int64)
    vertex[fan] = mesh.faces.reshape(-1)
    used = len(np.unique(mesh.faces))
    split = TriangleMesh(mesh.vertices_mm[vertex], fan.reshape(-1, 3), mesh.corner_uv)
    return split, fans - used


def _fill_holes(mesh: TriangleMesh, max_hole_mm: float) -> tuple[TriangleMesh, int]:
    """Close rims up to a length by a fan around their middle."""
    edges = boundary_edges(mesh.faces)
    follows = {int(a): int(b) for a, b in edges}
    owner = {}
    if mesh.corner_uv is not None:
        owner = {(int(a), int(b)): k for k, (a, b) in enumerate(directed_edges(mesh.faces))}
    vertices, faces, uvs = [mesh.vertices_mm], [mesh.faces], [mesh.corner_uv]
    new, filled = len(mesh.vertices_mm), 0
    while follows:
        start, here = follows.popitem()
        loop = [start]
        while here != start and here in follows:
            loop.append(here)
            here = follows.pop(here)
        points = mesh.vertices_mm[loop]
        rim_mm = float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())
        if here != start or len(loop) < 3 or rim_mm > max_hole_mm:
            continue
        ahead = np.roll(loop, -1)
        vertices.append(points.mean(axis=0, keepdims=True))
        faces.append(np.column_stack([ahead, loop, np.full(len(loop), new)]))
        if mesh.corner_uv is not None:
            flat = mesh.corner_uv.reshape(-1, 2)
            at = np.array([owner[a, b] for a, b in zip(loop, ahead.tolist(), strict=True)])
            begin, end = flat[at], flat[at - at % 3 + (at + 1) % 3]
            middle = np.broadcast_to(begin.mean(axis=0), begin.shape)
            uvs.append(np.stack([end, begin, middle], axis=1))
        new, filled = new + 1, filled + 1
    uv = None if mesh.corner_uv is None else np.concatenate([u for u in uvs if u is not None])
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces), uv), filled


def _outward(mesh: TriangleMesh) -> TriangleMesh:
    """Turn a surface inside out where its normals point to its middle."""
    vectors = mesh.face_vectors()
    centers = mesh.vertices_mm[mesh.faces].mean(axis=1)
    area = np.linalg.norm(vectors, axis=1)
    middle = (centers * area[:, None]).sum(axis=0) / area.sum()
    inward = np.einsum("fk,fk->", vectors, centers - middle) < 0
    return _flipped(mesh, np.full(len(vectors), bool(inward)))
