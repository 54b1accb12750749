"""Close holes of a surface by smooth patches, with the standard error of their distance to it.

A patch has the least bending energy between the rim and the ring of vertices outside of it. It
continues the surface's slope and curvature; its error grows with the distance from the rim.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from reconstruction.scan.repair import TriangleMesh, directed_edges

MAX_LOOP_MM: Final = 200.0
"""Maximum length of a closed loop: an eye, a nostril, the underside of a chin."""
MAX_HOLE_RIM_RATIO: Final = 0.5
"""Maximum length of a hole relative to the longest loop; longer loops are outer rims."""
WEIGHT_ROUNDS: Final = 3
"""Iterations of the energy's weights, which depend on the resulting shape."""
MIN_EDGE_WEIGHT: Final = 1e-3
"""Minimum cotangent weight of an edge; with less, triangles may be inverted."""
PATCH_ERROR_MM: Final = 3.5
"""Standard error at 1 mm from a rim whose normals deviate by 1 rad from their mean.

It was set, with both exponents below, on scans of the simulated heads of seeds 0 to 7."""
DEPTH_EXPONENT: Final = 0.1
"""Exponent of the distance to the rim, 1 mm added, in the standard error."""
SPREAD_EXPONENT: Final = 1.5
"""Exponent of the deviation of the rim's normals in the standard error."""
N_RIM_NEIGHBORS: Final = 8
"""Number of nearest vertices of the rim whose normals give this deviation."""
SCAN_NOISE_MM: Final = 0.12
"""Error across the surface of 68 % of the scanned vertices at rims of up to 40 mm.

It was measured on scans of seeds 0 to 7."""
MAX_EDGE_FRACTION: Final = 0.25
"""Longest edge of a rim over its length above which the edges of the disc are made more equal."""
MAX_CHORD_FRACTION: Final = 0.4
"""Maximum arc of the disc that a triangle of a notch spans, over the whole circle."""
HULL_MARGIN: Final = 0.98
"""Maximum radius of the outermost ring of a disc over the distance of the rim's longest chord."""


@dataclass(frozen=True, slots=True, eq=False)
class HolePatch:
    """A disc that closes a hole.

    Attributes
    ----------
    rim : ndarray of int, shape (n,)
        Vertices of the mesh along the loop, in the orientation of the patch's triangles.
    disc : ndarray of float64, shape (n + m, 2)
        Positions of rim and new vertices in the unit disc.
    faces : ndarray of int, shape (f, 3)
        Indices into rim and new vertices, in that order; counterclockwise from outside.
    inner_mm : ndarray of float64, shape (m, 3)
        Positions of the new vertices.
    length_mm : float
        Length of the loop.
    """

    rim: Int64Array
    disc: Float64Array
    faces: Int64Array
    inner_mm: Float64Array
    length_mm: float

    def interpolate_from_rim(self, values: Float64Array) -> Float64Array:
        """Interpolate values of the rim, (n, C), harmonically to all vertices, (n + m, C).

        The results are within the range of the rim's values.
        """
        n = len(self.rim)
        weights = _uniform(self.faces, len(self.disc))
        inner = weights[n:, n:].tocsc()
        return np.concatenate([values, splu(inner).solve(-(weights[n:, :n] @ values))])


def find_patches(
    vertices_mm: FloatArray, faces: NDArray[np.integer], *, weld: bool = True
) -> list[HolePatch]:
    """Find patches that close the small holes of a mesh, the longest loop first.

    Parameters
    ----------
    vertices_mm
        Shape (V, 3).
    faces
        Shape (F, 3).
    weld
        Whether coincident vertices count as one.

    Returns
    -------
    list of HolePatch
        Patches of all loops except the longest, which is the rim of a scan, those above
        `MAX_LOOP_MM`, and self-intersecting ones.
    """
    points, joined = np.asarray(vertices_mm, np.float64), np.asarray(faces, np.int64)
    if weld:
        _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
        joined = first[place.reshape(-1)][joined]
    found = [(float(_edges(points[loop]).sum()), loop) for loop in _loops(joined)]
    found.sort(key=lambda one: -one[0])
    if not found:
        return []
    most = min(MAX_LOOP_MM, MAX_HOLE_RIM_RATIO * found[0][0])
    return [
        _patch(points, joined[np.isin(joined, loop).any(axis=1)], loop, size)
        for size, loop in found[1:]
        if size <= most
    ]


def _edges(loop_mm: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.norm(np.roll(loop_mm, -1, axis=0) - loop_mm, axis=1))


def _loops(faces: Int64Array) -> list[Int64Array]:
    """Return loops of vertices around holes, in the orientation of filling triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    number = int(faces.max()) + 1
    alone = ~np.isin(edges[:, 0] * number + edges[:, 1], edges[:, 1] * number + edges[:, 0])
    open_edges = edges[alone]
    # reversed orientation, as the patch is on the other side of the edge
    starts, counts = np.unique(open_edges[:, 1], return_counts=True)
    twice = {int(v) for v in starts[counts > 1]}
    ahead = {int(b): int(a) for a, b in open_edges}
    loops = []
    while ahead:
        start = min(ahead)
        loop = [start]
        at = ahead.pop(start)
        while at != start and at in ahead:
            loop.append(at)
            at = ahead.pop(at)
        if at == start and len(loop) >= 3 and not twice & set(loop):
            loops.append(np.array(loop, np.int64))
    return loops


def _neighbors(faces: Int64Array, count: int) -> sparse.csr_matrix:
    """Return the adjacency matrix of vertices, (V, V)."""
    i, j = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    whole = sparse.coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), (count, count))
    return whole.tocsr()


def _patch(points: Float64Array, scan: Int64Array, loop: Int64Array, length: float) -> HolePatch:
    """Return the patch of a loop; ``scan`` are the triangles at its vertices, shape (F, 3)."""
    arcs = _arcs(points[loop])
    disc, faces = _disc(arcs, _notches(points, scan, loop, arcs))
    n, m = len(loop), len(disc) - len(loop)
    patch = HolePatch(loop, disc, faces, np.zeros((m, 3)), length)
    outer = np.setdiff1d(scan, loop)
    index = np.concatenate([loop, outer])
    order = np.argsort(index)
    local = order[np.searchsorted(index, scan, sorter=order)]
    local = np.where(local < n, local, local + m)
    both = np.concatenate([faces, local])
    flat = patch.interpolate_from_rim(points[loop])
    whole = np.concatenate([flat, points[outer]])
    for _ in range(WEIGHT_ROUNDS):
        whole[n : n + m] = _smoothed(whole, both, n, m)
    return HolePatch(loop, disc, faces, whole[n : n + m].copy(), length)


def _arcs(loop_mm: Float64Array) -> Float64Array:
    """Return the part of the circle from each vertex of a rim to the next; the sum is 1.

    It is that of the edge in the rim's length. Where an edge is long, the mean with equal parts
    leaves all below 0.42, although the edge of a slit takes up to half of the length.
    """
    sizes = _edges(loop_mm)
    arcs = sizes / sizes.sum()
    if arcs.max() > MAX_EDGE_FRACTION:
        arcs = 0.5 * (arcs + 1.0 / len(arcs))
    return np.asarray(arcs)


def _notches(
    points: Float64Array, scan: Int64Array, loop: Int64Array, arcs: Float64Array
) -> BoolArray:
    """Return the corners of a rim whose angle inside the hole is acute, none next to another."""
    mesh = TriangleMesh(points, scan)
    before, after = np.roll(loop, 1), np.roll(loop, -1)
    one, two = points[before] - points[loop], points[after] - points[loop]
    inside = np.einsum("nk,nk->n", np.cross(two, one), mesh.normals()[loop])
    notch = (inside > 0.0) & (np.einsum("nk,nk->n", one, two) > 0.0)
    # an edge has two triangles: none may be added across the notch where its ends have one already
    chords = np.sort(np.stack([before, after], axis=-1), axis=1) @ (len(points), 1)
    notch &= ~np.isin(chords, np.sort(directed_edges(scan), axis=1) @ (len(points), 1))
    notch &= np.roll(arcs, 1) + arcs < MAX_CHORD_FRACTION
    for corner in np.flatnonzero(notch):
        notch[corner] &= not notch[corner - 1]
    return notch if len(loop) - np.count_nonzero(notch) > 3 else np.zeros_like(notch)


def _disc(arcs: Float64Array, notches: BoolArray) -> tuple[Float64Array, Int64Array]:
    """Return points of the unit disc, the rim first, and their triangles.

    The number of points per ring is proportional to its radius. All rings are inside the rim's
    chords, so that each edge of the rim has a triangle. A notch of the rim has one triangle, with
    its neighbors: with others, these would fold.
    """
    from scipy.spatial import Delaunay

    count, corner = len(arcs), np.flatnonzero(notches)
    angle = 2.0 * np.pi * (np.cumsum(arcs) - arcs)
    hull = angle[~notches]
    chord = float(np.cos(0.5 * np.diff(hull, append=hull[0] + 2.0 * np.pi).max()))
    points = [np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    rings = max(1, round(count / (2.0 * np.pi)))
    shrink = min(1.0, HULL_MARGIN * chord * rings / max(rings - 1, 1))
    for ring in range(1, rings):
        radius = 1.0 - ring / rings
        number = max(4, round(count * radius))
        turn = 2.0 * np.pi * (np.arange(number) + 0.5 * (ring % 2)) / number
        points.append(shrink * radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    disc = np.concatenate([*points, np.zeros((1, 2))])
    # slightly enlarged, the rim is the convex hull in spite of rounding
    lifted = np.concatenate([1.001 * disc[:count], disc[count:]])
    used = np.setdiff1d(np.arange(len(disc)), corner)
    ears = np.stack([(corner - 1) % count, corner, (corner + 1) % count], axis=-1)
    faces = np.concatenate([used[Delaunay(lifted[used]).simplices], ears])
    a, b, c = (disc[faces[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((area < 0.0)[:, None], faces[:, ::-1], faces)
    return disc, faces


def _uniform(faces: Int64Array, count: int) -> sparse.csr_matrix:
    """Return the graph Laplacian, (count, count)."""
    pattern = _neighbors(faces, count)
    pattern.data[:] = 1.0
    degree = np.asarray(pattern.sum(axis=1)).ravel()
    return (sparse.diags(degree) - pattern).tocsr()


def _smoothed(points: Float64Array, faces: Int64Array, n: int, m: int) -> Float64Array:
    """Return the m inner points with minimum bending energy; other points are fixed.

    The energy is the area integral of the squared Laplacian over patch and rim, whose rings of
    neighbors are complete.
    """
    total = len(points)
    rows, columns, values = [], [], []
    area = np.zeros(total)
    for k in range(3):
        a, b, c = (points[faces[:, (k + s) % 3]] for s in range(3))
        one, two = b - a, c - a
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        cotangent = 0.5 * (one * two).sum(axis=1) / np.maximum(sine, 1e-12)
        weight = np.clip(cotangent, MIN_EDGE_WEIGHT, 10.0)
        rows += [faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]]
        columns += [faces[:, (k + 2) % 3], faces[:, (k + 1) % 3]]
        values += [weight, weight]
        area += np.bincount(faces[:, k], sine / 6.0, total)
    shape = (total, total)
    weights = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    ).tocsr()
    sums = np.asarray(weights.sum(axis=1)).ravel()
    scale = sparse.diags(1.0 / np.sqrt(np.maximum(area, 1e-9 * area.max())))
    bending = (scale @ (weights - sparse.diags(sums))).tocsr()
    used = bending[: n + m]
    free = used[:, n : n + m]
    held = used[:, :n] @ points[:n] + used[:, n + m :] @ points[n + m :]
    normal = (free.T @ free).tocsc()
    normal += 1e-12 * normal.diagonal().max() * sparse.eye(m, format="csc")
    return np.asarray(splu(normal).solve(-(free.T @ held)))


@dataclass(frozen=True, slots=True, eq=False)
class ClosedScan:
    """A scan whose holes are closed by smooth patches.

    Attributes
    ----------
    mesh
        Vertices and triangles of the scan, then those of the patches.
    stderr_mm : ndarray of float64, shape (V,)
        Standard error of the patches across the surface, mm, at least `SCAN_NOISE_MM`; 0 for
        vertices of the scan.
    hole_faces : ndarray of bool, shape (F,)
        Triangles of the patches.
    rims_mm
        Lengths of the closed rims, the longest first.
    """

    mesh: TriangleMesh
    stderr_mm: Float64Array
    hole_faces: BoolArray
    rims_mm: tuple[float, ...]

    def corner_stderr_mm(self) -> Float64Array:
        """Return standard errors of the triangles' corners, shape (F, 3), mm.

        Corners of patches at the rim have the scan's noise; 0 for triangles of the scan.
        """
        corners = np.maximum(self.stderr_mm[self.mesh.faces], SCAN_NOISE_MM)
        return np.where(self.hole_faces[:, None], corners, 0.0)


def close_scan(mesh: TriangleMesh) -> ClosedScan:
    """Close the holes of a scan that `reconstruction.scan.repair.repair_mesh` has repaired.

    Parameters
    ----------
    mesh
        A scan without texture coordinates, as those of patches are not known.

    Returns
    -------
    ClosedScan
        Loops longer than `MAX_LOOP_MM`, and the outer rim, stay open.
    """
    vertices, faces = [mesh.vertices_mm], [mesh.faces]
    errors, count = [np.zeros(len(mesh.vertices_mm))], len(mesh.vertices_mm)
    normals = mesh.normals().astype(np.float64)
    patches = find_patches(mesh.vertices_mm, mesh.faces, weld=False)
    for patch in patches:
        index = np.concatenate([patch.rim, count + np.arange(len(patch.inner_mm))])
        rim_mm = mesh.vertices_mm[patch.rim]
        vertices.append(patch.inner_mm)
        faces.append(index[patch.faces])
        errors.append(estimate_patch_error(patch.inner_mm, rim_mm, normals[patch.rim]))
        count += len(patch.inner_mm)
    closed = TriangleMesh(np.concatenate(vertices), np.concatenate(faces))
    holes = np.arange(len(closed.faces)) >= len(mesh.faces)
    rims_mm = tuple(patch.length_mm for patch in patches)
    return ClosedScan(closed, np.concatenate(errors), holes, rims_mm)


def estimate_patch_error(
    points_mm: Float64Array, rim_mm: Float64Array, rim_normals: Float64Array
) -> Float64Array:
    """Estimate the standard error of a patch's points across the surface.

    It grows with the distance to the rim, and with the bend of the surface along the rim. The
    scan's noise adds to it.

    Parameters
    ----------
    points_mm
        Shape (m, 3).
    rim_mm, rim_normals
        Vertices of the rim and unit normals of the scan there, shape (n, 3), n >= 3.

    Returns
    -------
    ndarray of float64
        Shape (m,), mm.

    Examples
    --------
    >>> rim = np.array([[9.0, 0, 0], [0, 9, 0], [-9, 0, 0], [0, -9, 0]])
    >>> bent = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, -0.6, 0.8]])
    >>> estimate_patch_error(np.array([[0.0, 0, 0], [6, 0, 0]]), rim, bent).round(2).tolist()
    [2.28, 2.08]
    """
    count = min(N_RIM_NEIGHBORS, len(rim_mm))
    away_mm, nearest = cKDTree(rim_mm).query(points_mm, k=count, workers=1)
    around = rim_normals[nearest.reshape(-1, count)]
    cosine = np.clip(np.einsum("mnk,mk->mn", around, unit_vectors(around.mean(axis=1))), -1.0, 1.0)
    spread = np.sqrt(np.mean(np.square(np.arccos(cosine)), axis=1))
    depth = 1.0 + away_mm.reshape(-1, count)[:, 0]
    bent_mm = PATCH_ERROR_MM * depth**DEPTH_EXPONENT * spread**SPREAD_EXPONENT
    return np.asarray(np.hypot(bent_mm, SCAN_NOISE_MM))
