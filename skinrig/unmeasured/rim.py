"""Trim the jagged rim of a scan to a smooth closed curve on the measured surface.

A screened Poisson equation yields the distance from the rim, in which teeth of the rim vanish with
the distance. The scan is cut where this distance is constant. No vertex of the scan moves.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from reconstruction.scan.repair import boundary_edges
from skinrig.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from skinrig.unmeasured.level_cuts import cut_at_zero

TRIM_MM: Final = 6.0
"""Width that is cut off inside of the rim."""
SCREENING_MM: Final = 6.0
"""Length over which the solution decays. Teeth 10 mm long shrink to a twentieth at `TRIM_MM`."""
SMOOTH_MM: Final = 6.0
"""Standard deviation of the smoothed curve with which a rim's length is compared."""
STEP_MM: Final = 0.25
"""Distance of the points at which a rim is smoothed."""


@dataclass(frozen=True, slots=True, eq=False)
class TrimmedScan:
    """A scan inside of a smooth rim.

    Attributes
    ----------
    vertices : ndarray of int, shape (n,)
        Vertices of the scan that are left, in ascending order; they come first.
    edges : ndarray of int, shape (m, 2)
        Ends, in the scan, of the edges with a new vertex on the rim; these come next.
    fraction : ndarray of float64, shape (m,)
        Place of each new vertex from the first end (0) to the second (1).
    faces : ndarray of int, shape (f, 3)
        Triangles of the vertices that are left and of the new ones.
    rim : ndarray of int, shape (r,)
        Vertices along the rim in the orientation of triangles outside of it; the first one is not
        repeated.
    """

    vertices: Int64Array
    edges: Int64Array
    fraction: Float64Array
    faces: Int64Array
    rim: Int64Array

    def carry(self, values: FloatArray) -> Float64Array:
        """Return values of the scan's vertices, (V, ...), at those left and the new ones."""
        known = np.asarray(values, np.float64)
        first, second = known[self.edges[:, 0]], known[self.edges[:, 1]]
        share = self.fraction.reshape(-1, *[1] * (known.ndim - 1))
        return np.concatenate([known[self.vertices], first + share * (second - first)])


class RimError(ValueError):
    """A mesh without a rim that can be trimmed."""


def trim_rim(vertices_mm: FloatArray, faces: NDArray[np.integer]) -> TrimmedScan:
    """Cut off the rim of a scan at `TRIM_MM`.

    Parameters
    ----------
    vertices_mm
        Shape (V, 3). Vertices at equal positions, at seams of the texture, count as one.
    faces
        Shape (F, 3).

    Raises
    ------
    RimError
        If the mesh is closed, or nothing is left.
    """
    points, triangles = np.asarray(vertices_mm, np.float64), np.asarray(faces, np.int64)
    place = weld_positions(points)
    rim = _outer_rim(points, place[triangles])
    level = _rim_distance(points, place[triangles], rim) - TRIM_MM
    cut = cut_at_zero(triangles, level[place], place)
    if not len(cut.above):
        raise RimError("mesh: got nothing inside of the rim, expected a scan of a head; scan more")
    whole = cut.extend(points)
    joined = weld_positions(whole)
    kept = _largest_part(joined[cut.above])
    inside = cut.above[kept]
    used = np.unique(inside)
    old = used[used < len(points)]
    new = used[used >= len(points)] - len(points)
    number = np.zeros(len(whole), np.int64)
    number[used] = np.arange(len(used))
    loop = _longest_loop(whole, joined[inside])
    # a loop in vertices that are used: the first of those at one position
    first = np.full(len(whole), -1, np.int64)
    first[joined[used][::-1]] = np.arange(len(used))[::-1]
    return TrimmedScan(old, cut.edges[new], cut.fraction[new], number[inside], first[loop])


def weld_positions(points_mm: FloatArray) -> Int64Array:
    """Return for each vertex the number of the first one at its position, shape (V,).

    Examples
    --------
    >>> weld_positions(np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]])).tolist()
    [0, 1, 0]
    """
    _, first, place = np.unique(
        points_mm.astype(np.float32), axis=0, return_index=True, return_inverse=True
    )
    return np.asarray(first[place.reshape(-1)], np.int64)


def measure_raggedness(loop_mm: Float64Array) -> float:
    """Return the length of a closed curve over that of the same curve, smoothed.

    Parameters
    ----------
    loop_mm
        Points along the curve, shape (n, 3); the first one is not repeated.

    Examples
    --------
    >>> angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    >>> ring = 80.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)
    >>> round(measure_raggedness(ring), 3)
    1.003
    """
    closed = np.concatenate([loop_mm, loop_mm[:1]])
    away = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0.0, away[-1], max(int(away[-1] / STEP_MM), 8), endpoint=False)
    even = np.stack([np.interp(at, away, closed[:, k]) for k in range(3)], axis=-1)
    smooth = ndimage.gaussian_filter1d(even, SMOOTH_MM / STEP_MM, axis=0, mode="wrap")
    length = np.linalg.norm(smooth - np.roll(smooth, 1, axis=0), axis=1).sum()
    return float(away[-1] / length)


def find_rim(vertices_mm: FloatArray, faces: NDArray[np.integer]) -> Int64Array:
    """Return the vertices along the longest loop of a mesh's borders, shape (n,)."""
    points = np.asarray(vertices_mm, np.float64)
    return _longest_loop(points, weld_positions(points)[np.asarray(faces, np.int64)])


def _outer_rim(points: Float64Array, faces: Int64Array) -> Int64Array:
    """Return the vertices of the longest connected border."""
    edges = boundary_edges(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])
    if not len(edges):
        raise RimError("mesh: got a closed surface, expected a scan with a rim")
    used, local = np.unique(edges, return_inverse=True)
    local = local.reshape(-1, 2)
    graph = sparse.coo_matrix((np.ones(len(edges)), local.T), (len(used),) * 2)
    _, group = connected_components(graph, directed=False)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    longest = int(np.argmax(np.bincount(group[local[:, 0]], length)))
    return np.asarray(used[group == longest])


def _rim_distance(points: Float64Array, faces: Int64Array, rim: Int64Array) -> Float64Array:
    """Return the smoothed distance of each vertex from the rim, mm, shape (V,)."""
    total = len(points)
    weight = np.zeros(total)
    rows, columns, values = [], [], []
    for k in range(3):
        a, b, c = (faces[:, (k + s) % 3] for s in range(3))
        one, two = points[b] - points[a], points[c] - points[a]
        sine = np.maximum(np.linalg.norm(np.cross(one, two), axis=1), 1e-9)
        # at least 0, so that the solution has no maximum inside
        half = np.clip(0.5 * np.einsum("nk,nk->n", one, two) / sine, 0.0, 10.0)
        rows += [b, c]
        columns += [c, b]
        values += [half, half]
        weight += np.bincount(a, sine / 6.0, total)
    flat = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    edges = sparse.coo_matrix(flat, (total, total)).tocsr()
    system = sparse.diags(np.asarray(edges.sum(axis=1)).ravel()) - edges
    system = (system + sparse.diags(weight / SCREENING_MM**2)).tocsc()
    free = np.zeros(total, bool)
    free[np.unique(faces)] = True
    free[rim] = False
    inner = np.flatnonzero(free)
    right = -np.asarray(system[inner][:, rim].sum(axis=1)).ravel()
    solution = np.ones(total)
    solution[inner] = splu(system[inner][:, inner]).solve(right)
    return np.asarray(-SCREENING_MM * np.log(np.clip(solution, 1e-9, 1.0)))


def _largest_part(faces: Int64Array) -> BoolArray:
    """Return which triangles belong to the surface, connected by edges, of most triangles."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, number = np.unique(sides, axis=0, return_inverse=True)
    owner = np.repeat(np.arange(len(faces)), 3)
    side = len(faces) + number.reshape(-1)
    total = int(side.max()) + 1
    graph = sparse.coo_matrix((np.ones(len(owner)), (owner, side)), (total, total))
    _, group = connected_components(graph, directed=False)
    of_face = group[: len(faces)]
    return np.asarray(of_face == np.argmax(np.bincount(of_face)))


def _longest_loop(points: Float64Array, faces: Int64Array) -> Int64Array:
    """Return vertices along the longest border, in the orientation of triangles outside of it."""
    edges = boundary_edges(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])
    ahead: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        ahead.setdefault(b, []).append(a)
    best, longest = np.zeros(0, np.int64), 0.0
    while ahead:
        start = next(iter(ahead))
        loop, at = [start], _take(ahead, start)
        while at != start and at in ahead:
            loop.append(at)
            at = _take(ahead, at)
        line = points[loop]
        length = float(np.linalg.norm(line - np.roll(line, 1, axis=0), axis=1).sum())
        if at == start and length > longest:
            best, longest = np.array(loop, np.int64), length
    return best


def _take(ahead: dict[int, list[int]], at: int) -> int:
    following = ahead[at].pop()
    if not ahead[at]:
        del ahead[at]
    return following
