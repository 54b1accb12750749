"""Close small holes of a mesh by patches, and fill measured maps there.

Several charts of a scan meet at the rim of a hole, so that a patch cannot extend them. It gets its
own disc in an empty part of the texture. Maps that are functions of the surface point cover it
automatically; measured maps are interpolated from the rim.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array

MAX_LOOP_MM: Final = 200.0
"""Maximum length of a closed loop: an eye, a nostril, the underside of a chin."""
MAX_HOLE_RIM_RATIO: Final = 0.5
"""Maximum length of a hole relative to the longest loop; longer loops are outer rims."""
WEIGHT_ROUNDS: Final = 3
"""Iterations of the energy's weights, which depend on the resulting shape."""
MIN_EDGE_WEIGHT: Final = 1e-3
"""Minimum cotangent weight of an edge; with less, triangles may be inverted."""


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


def find_patches(vertices_mm: FloatArray, faces: NDArray[np.integer]) -> list[HolePatch]:
    """Find patches that close the small holes of a mesh, the longest loop first.

    Parameters
    ----------
    vertices_mm
        Shape (V, 3); coincident vertices count as one.
    faces
        Shape (F, 3).

    Returns
    -------
    list of HolePatch
        Patches of all loops except the longest, which is the rim of a scan, those above
        `MAX_LOOP_MM`, and self-intersecting ones.
    """
    points = np.asarray(vertices_mm, np.float64)
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    joined = first[place.reshape(-1)][np.asarray(faces, np.int64)]
    found = [(float(_edges(points[loop]).sum()), loop) for loop in _loops(joined)]
    found.sort(key=lambda one: -one[0])
    if not found:
        return []
    most = min(MAX_LOOP_MM, MAX_HOLE_RIM_RATIO * found[0][0])
    neighbors = _neighbors(joined, len(points))
    return [_patch(points, neighbors, loop, size) for size, loop in found[1:] if size <= most]


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


def _patch(
    points: Float64Array, neighbors: sparse.csr_matrix, loop: Int64Array, length: float
) -> HolePatch:
    disc, faces = _disc(len(loop), np.cumsum(_edges(points[loop])) / length)
    n, m = len(loop), len(disc) - len(loop)
    if m == 0:
        return HolePatch(loop, disc, faces, np.zeros((0, 3)), length)
    patch = HolePatch(loop, disc, faces, np.zeros((m, 3)), length)
    flat = patch.interpolate_from_rim(points[loop])
    # also fixed: vertices adjacent to the loop, with the mesh's edges to the loop
    adjacent = neighbors[loop].tocoo()
    outer = np.setdiff1d(adjacent.col, loop)
    index = {int(v): n + m + k for k, v in enumerate(outer)}
    around = np.array(
        [
            (i, index[int(v)])
            for i, v in zip(adjacent.row, adjacent.col, strict=True)
            if int(v) in index
        ]
    ).reshape(-1, 2)
    whole = np.concatenate([flat, points[outer]])
    for _ in range(WEIGHT_ROUNDS):
        whole[n : n + m] = _smoothed(whole, faces, around, n, m)
    return HolePatch(loop, disc, faces, whole[n : n + m].copy(), length)


def _disc(count: int, angles: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Return points of the unit disc, the rim first, and their triangles.

    The number of points per ring is proportional to its radius.
    """
    from scipy.spatial import Delaunay

    angle = 2.0 * np.pi * angles
    points = [np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    rings = max(1, round(count / (2.0 * np.pi)))
    for ring in range(1, rings):
        radius = 1.0 - ring / rings
        number = max(4, round(count * radius))
        turn = 2.0 * np.pi * (np.arange(number) + 0.5 * (ring % 2)) / number
        points.append(radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    if count > 3:
        points.append(np.zeros((1, 2)))
    disc = np.concatenate(points)
    # slightly enlarged, the rim is the convex hull in spite of rounding
    lifted = np.concatenate([1.001 * points[0], *points[1:]])
    faces = Delaunay(lifted).simplices.astype(np.int64) if len(disc) > 3 else np.array([[0, 1, 2]])
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


def _smoothed(
    points: Float64Array, faces: Int64Array, rim: Int64Array, n: int, m: int
) -> Float64Array:
    """Return the m inner points with minimum bending energy; other points are fixed."""
    total = len(points)
    rows, columns, values = [], [], []
    for k in range(3):
        a, b, c = (points[faces[:, (k + s) % 3]] for s in range(3))
        one, two = b - a, c - a
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        cotangent = 0.5 * (one * two).sum(axis=1) / np.maximum(sine, 1e-12)
        weight = np.clip(cotangent, MIN_EDGE_WEIGHT, 10.0)
        rows += [faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]]
        columns += [faces[:, (k + 2) % 3], faces[:, (k + 1) % 3]]
        values += [weight, weight]
    # outside of the loop, only edge lengths are known; weights decrease with them
    size = np.linalg.norm(points[rim[:, 0]] - points[rim[:, 1]], axis=1)
    own = np.linalg.norm(points[np.roll(np.arange(n), -1)] - points[:n], axis=1).mean()
    rows.append(rim[:, 0])
    columns.append(rim[:, 1])
    values.append(own / np.maximum(size, 1e-3 * own))
    shape = (total, total)
    weights = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    ).tocsr()
    sums = np.asarray(weights.sum(axis=1)).ravel()
    bending = (sparse.diags(1.0 / np.maximum(sums, 1e-12)) @ weights - sparse.eye(total)).tocsr()
    used = bending[: n + m]
    free = used[:, n : n + m]
    held = used[:, :n] @ points[:n] + used[:, n + m :] @ points[n + m :]
    normal = (free.T @ free).tocsc() + 1e-12 * sparse.eye(m, format="csc")
    return np.asarray(splu(normal).solve(-(free.T @ held)))


GRID_CELLS: Final = 512
"""Side of the grid for the search of empty texture space."""
PATCH_MARGIN: Final = 4.0 / 256.0
"""Minimum distance of a disc from charts: four texels of a map of 256, for texture filters."""
MIN_RELATIVE_SCALE: Final = 0.25
"""Minimum texture scale of a patch relative to its surroundings; below it, the hole stays open."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchChart:
    """A disc of the texture for a patch.

    Attributes
    ----------
    patch
        The patch.
    center : ndarray of float64, shape (2,)
        Texture coordinates.
    radius : float
    rim_uv : ndarray of float64, shape (n, 2)
        Texture coordinates of the patch's rim in the surrounding charts.
    """

    patch: HolePatch
    center: Float64Array
    radius: float
    rim_uv: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ClosedMesh:
    """A mesh whose small holes are closed.

    Attributes
    ----------
    mesh
        Mesh with patches; vertices of the original mesh come first.
    charts
        Charts of the patches.
    left_open_mm
        Lengths of loops without space in the texture.
    """

    mesh: Mesh
    charts: tuple[PatchChart, ...]
    open_loops_mm: tuple[float, ...]

    def paint(self, values: FloatArray) -> Float32Array:
        """Return values, (..., H, W, C) or (H, W), with patches interpolated from their rims.

        Row 0 is at v = 1. The rims' texels must have values.
        """
        layers = np.array(values if values.ndim > 2 else values[..., None], np.float32)
        for layer in layers.reshape(-1, *layers.shape[-3:]):
            for chart in self.charts:
                _paint(layer, chart)
        return layers.reshape(values.shape)

    def summary(self) -> tuple[tuple[str, str], ...]:
        """Return omissions about holes, with reasons."""
        rows = {}
        if self.charts:
            lengths = [chart.patch.length_mm for chart in self.charts]
            rows["surface in holes of the scan"] = (
                f"{len(lengths)} {'hole' if len(lengths) == 1 else 'holes'} of "
                f"{min(lengths):.0f} to {max(lengths):.0f} mm circumference "
                "not measured; closed by smooth patches with colors of their rims"
            )
        if self.open_loops_mm:
            rows["open holes"] = (
                f"the texture has no space for {len(self.open_loops_mm)} of up to "
                f"{max(self.open_loops_mm):.0f} mm circumference"
            )
        return tuple(rows.items())


def close_holes(mesh: Mesh) -> ClosedMesh:
    """Close the small holes of a scanned mesh.

    Parameters
    ----------
    mesh
        Mesh without blend shapes.
    """
    found = find_patches(mesh.vertices_mm, mesh.faces)
    if not found or mesh.shapes:
        return ClosedMesh(mesh, (), ())
    taken = unwrap(mesh, GRID_CELLS).covered
    flat = np.pad(mesh.uv.astype(np.float64), ((0, 0), (0, 1)))
    surface = max(_area(mesh.vertices_mm, mesh.faces), 1e-9)
    scale = float(
        np.sqrt(_area(flat, mesh.faces) / surface)
    )  # texture units per mm, from total areas
    vertices, faces, uv = [mesh.vertices_mm], [mesh.faces], [mesh.uv]
    count = len(mesh.vertices_mm)
    charts: list[PatchChart] = []
    open_mm: list[float] = []
    for patch in found:
        whole = np.concatenate([mesh.vertices_mm[patch.rim], patch.inner_mm])
        place = _placed(taken, scale * np.sqrt(_area(whole, patch.faces) / np.pi))
        if place is None:
            open_mm.append(patch.length_mm)
            continue
        center, radius = place
        _take(taken, center, radius)
        charts.append(PatchChart(patch, center, radius, mesh.uv[patch.rim].astype(np.float64)))
        vertices.append(whole.astype(np.float32))
        faces.append((patch.faces + count).astype(np.int32))
        uv.append((center + radius * patch.disc).astype(np.float32))
        count += len(whole)
    joined = build_mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv))
    return ClosedMesh(joined, tuple(charts), tuple(open_mm))


def _area(points: FloatArray, faces: NDArray[np.integer]) -> float:
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _placed(taken: BoolArray, radius: float) -> tuple[Float64Array, float] | None:
    """Return center and radius of the largest empty disc, reduced if necessary; None: no space."""
    far = ndimage.distance_transform_edt(np.pad(~taken, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(far)), far.shape)
    most = (float(far[row, column]) - 1.0) / GRID_CELLS - PATCH_MARGIN
    if most < MIN_RELATIVE_SCALE * radius:
        return None
    center = np.array([(column + 0.5) / GRID_CELLS, 1.0 - (row + 0.5) / GRID_CELLS])
    return center, min(radius, most)


def _take(taken: BoolArray, center: Float64Array, radius: float) -> None:
    at = (np.arange(GRID_CELLS) + 0.5) / GRID_CELLS
    far2 = (at[None, :] - center[0]) ** 2 + (1.0 - at[:, None] - center[1]) ** 2
    taken[far2 <= (radius + 1.0 / GRID_CELLS) ** 2] = True


def _paint(layer: Float32Array, chart: PatchChart) -> None:
    """Draw a patch into a map (H, W, C), row 0 at the top, in place."""
    from scipy.interpolate import LinearNDInterpolator

    height, width, _ = layer.shape
    if min(height, width) < 2:  # one value for the whole face
        return
    rows = (1.0 - chart.rim_uv[:, 1]) * height - 0.5
    columns = chart.rim_uv[:, 0] * width - 0.5
    planes = np.moveaxis(layer, -1, 0)
    at = [rows, columns]
    drawn = [ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in planes]
    rim = np.stack(drawn, axis=-1)
    values = chart.patch.interpolate_from_rim(rim.astype(np.float64))
    reach = chart.radius + PATCH_MARGIN
    x0, y0 = chart.center
    j = np.arange(max(int((x0 - reach) * width), 0), min(int((x0 + reach) * width) + 1, width))
    top, bottom = int((1 - y0 - reach) * height), int((1 - y0 + reach) * height) + 1
    i = np.arange(max(top, 0), min(bottom, height))
    x, y = np.meshgrid((j + 0.5) / width - x0, 1.0 - (i + 0.5) / height - y0)
    disc = np.stack([x, y], axis=-1)
    far = np.linalg.norm(disc, axis=-1) / chart.radius
    inside = far * chart.radius <= reach
    # outside of the disc, values of its edge, for texture filters
    within = disc / chart.radius / np.maximum(far, 1.0)[..., None]
    # the rim is a polygon within the circle
    polygon = np.concatenate([chart.patch.disc, 1.5 * chart.patch.disc[: len(chart.patch.rim)]])
    both = np.concatenate([values, values[: len(chart.patch.rim)]])
    found = LinearNDInterpolator(polygon, both)(within[inside])
    block = layer[i[0] : i[-1] + 1, j[0] : j[-1] + 1]
    block[inside] = found
