"""Complete a trimmed scan to crown, neck and behind the ears by the fitted mean head.

Triangles between the trimmed rim and the border of the fitted head are built in the head's texture,
where both are curves in a plane. Positions join the rim; their stated error is the fit's.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from reconstruction.scan.closest_points import closest_barycentric
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import BoolArray, Float64Array, Int64Array
from skinrig.unmeasured.head_fit import FittedHead
from skinrig.unmeasured.rim import TrimmedScan, trim_rim

CLEARANCE_RATIO: Final = 0.6
"""Least distance of the head's vertices from the rim, over their spacing."""
JOIN_MM: Final = 20.0
"""Distance from the rim over which the head's offset from the scan fades."""
N_RIM_POINTS: Final = 12
"""Nearest points of the rim whose offsets a vertex follows."""
N_TRIANGLES: Final = 12
"""Nearest triangles of the head that are searched for the place of a point."""


@dataclass(frozen=True, slots=True, eq=False)
class CompletedHead:
    """A scan within a smooth rim, and the surface that the fitted head adds.

    Attributes
    ----------
    trimmed
        Scan within the rim.
    measured_mm : ndarray of float64, shape (n, 3)
        Vertices of the trimmed scan.
    filled_mm : ndarray of float64, shape (r + m, 3)
        Vertices of the added surface: those of the rim, then new ones.
    faces : ndarray of int, shape (f, 3)
        Triangles of the added surface, indices into `filled_mm`.
    plane : ndarray of float64, shape (r + m, 2)
        Texture coordinates on the fitted head, 0 to 1.
    stderr_mm : ndarray of float64, shape (r + m,)
        Standard error of the added surface across itself; that of the fit.
    """

    trimmed: TrimmedScan
    measured_mm: Float64Array
    filled_mm: Float64Array
    faces: Int64Array
    plane: Float64Array
    stderr_mm: Float64Array

    @property
    def rim_count(self) -> int:
        """Number of vertices of the rim."""
        return len(self.trimmed.rim)

    def interpolate_from_rim(self, values: Float64Array) -> Float64Array:
        """Interpolate values of the rim, (r, C), harmonically to the added surface, (r + m, C)."""
        from scipy import sparse
        from scipy.sparse.linalg import splu

        count, total = self.rim_count, len(self.filled_mm)
        i, j = np.concatenate(
            [self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]
        ).T
        pattern = sparse.coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (total,) * 2)
        pattern = pattern.tocsr()
        pattern.data[:] = 1.0
        inner = (sparse.diags(np.asarray(pattern.sum(axis=1)).ravel()) - pattern).tocsr()[count:]
        solved = splu(inner[:, count:].tocsc()).solve(-(inner[:, :count] @ values))
        return np.concatenate([values, solved])


def complete_head(mesh: Mesh, fitted: FittedHead) -> CompletedHead:
    """Trim the rim of a scan and complete it by the fitted head.

    Parameters
    ----------
    mesh
        Scan, mm, with its holes closed.
    fitted
        Mean head that was fitted to it.

    Raises
    ------
    skinrig.unmeasured.rim.RimError
        If the scan has no rim that can be trimmed.
    """
    trimmed = trim_rim(mesh.vertices_mm, mesh.faces)
    measured_mm = trimmed.carry(mesh.vertices_mm)
    head, stderr = fitted.draw()
    rim_mm = measured_mm[trimmed.rim]
    rim_uv = locate_on_head(rim_mm, head)
    surface = head.vertices_mm.astype(np.float64)
    scale = _texture_size_mm(head)
    curve, nodes = rim_uv * scale, head.uv.astype(np.float64) * scale
    spacing = scale / np.sqrt(len(nodes))
    clear = CLEARANCE_RATIO * float(spacing.mean())
    outside = ~_inside(nodes, curve) & (cKDTree(curve).query(nodes)[0] > clear)
    outside &= _apart_from_edges(nodes, curve)
    kept = np.flatnonzero(outside)
    plane = np.concatenate([curve, nodes[kept]])
    faces = _triangles_outside(plane, len(curve))
    offset = rim_mm - _sample(head, surface, rim_uv)
    away, near = cKDTree(rim_mm).query(surface[kept], k=N_RIM_POINTS)
    weight = 1.0 / (away + 1e-3) ** 2
    weight /= weight.sum(axis=1, keepdims=True)
    fade = np.exp(-((away[:, 0] / JOIN_MM) ** 2))
    joined = surface[kept] + fade[:, None] * np.einsum("nk,nkc->nc", weight, offset[near])
    filled = np.concatenate([rim_mm, joined])
    errors = np.concatenate([_sample(head, stderr[:, None], rim_uv)[:, 0], stderr[kept]])
    return CompletedHead(trimmed, measured_mm, filled, faces, plane / scale, errors)


def locate_on_head(points_mm: Float64Array, head: Mesh) -> Float64Array:
    """Return the texture coordinates of the points of a head closest to given ones, (N, 2)."""
    corners = head.vertices_mm.astype(np.float64)[head.faces]
    _, near = cKDTree(corners.mean(axis=1)).query(points_mm, k=N_TRIANGLES)
    weight = closest_barycentric(points_mm[:, None], corners[near])
    away = np.linalg.norm(
        np.einsum("nkc,nkcd->nkd", weight, corners[near]) - points_mm[:, None], axis=-1
    )
    best = np.argmin(away, axis=1)
    row = np.arange(len(points_mm))
    uv = head.uv.astype(np.float64)[head.faces[near[row, best]]]
    return np.asarray(np.einsum("nc,ncd->nd", weight[row, best], uv))


def _texture_size_mm(head: Mesh) -> Float64Array:
    """Return the typical length of the texture's sides on the skin, shape (2,)."""
    columns = int(np.argmax(head.uv[:, 1] > head.uv[0, 1]))
    grid = head.vertices_mm.astype(np.float64).reshape(-1, columns, 3)
    across = np.linalg.norm(np.diff(grid, axis=1), axis=-1).sum(axis=1)
    up = np.linalg.norm(np.diff(grid, axis=0), axis=-1).sum(axis=0)
    return np.array([np.median(across), np.median(up)])


def _sample(head: Mesh, values: Float64Array, uv: Float64Array) -> Float64Array:
    """Return values of the head's vertices, (V, C), linearly interpolated in its texture."""
    from scipy.interpolate import RegularGridInterpolator

    columns = int(np.argmax(head.uv[:, 1] > head.uv[0, 1]))
    grid = values.reshape(-1, columns, values.shape[-1])
    axes = tuple(np.linspace(0.0, 1.0, count) for count in grid.shape[:2])
    return np.asarray(RegularGridInterpolator(axes, grid)(np.clip(uv[:, ::-1], 0.0, 1.0)))


def _inside(points: Float64Array, curve: Float64Array) -> BoolArray:
    """Return which points are inside of a closed curve, by the number of crossings."""
    inside = np.zeros(len(points), bool)
    for (x0, y0), (x1, y1) in zip(curve, np.roll(curve, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        between = (points[:, 1] > min(y0, y1)) & (points[:, 1] <= max(y0, y1))
        x = x0 + (points[between, 1] - y0) / (y1 - y0) * (x1 - x0)
        inside[between] ^= points[between, 0] < x
    return inside


def _apart_from_edges(nodes: Float64Array, curve: Float64Array) -> BoolArray:
    """Return which nodes are outside of the circles over the curve's edges.

    Then each edge is one of the Delaunay triangulation, unless the curve nearly touches itself.
    """
    after = np.roll(curve, -1, axis=0)
    middle, radius = 0.5 * (curve + after), 0.5 * np.linalg.norm(after - curve, axis=1)
    near = cKDTree(nodes).query_ball_point(middle, 1.01 * radius)
    apart = np.ones(len(nodes), bool)
    apart[np.unique(np.concatenate([np.array(one, np.int64) for one in near]))] = False
    return apart


def _triangles_outside(plane: Float64Array, count: int) -> Int64Array:
    """Return triangles of the plane outside of the curve of the first points, counterclockwise."""
    faces = Delaunay(plane).simplices.astype(np.int64)
    curve = plane[:count]
    faces = faces[~_inside(plane[faces].mean(axis=1), curve)]
    a, b, c = (plane[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return np.where((area < 0.0)[:, None], faces[:, ::-1], faces)[np.abs(area) > 1e-12]
