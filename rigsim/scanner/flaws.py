"""Add the mesh defects of real scans, and encode meshes as binary PLY."""

import numpy as np
from scipy.spatial import cKDTree

from rigsim.arrays import Float64Array, FloatArray, Int32Array, Int64Array


def add_mesh_defects(
    vertices_mm: Float64Array, faces: Int32Array, *, edge_mm: float, rng: np.random.Generator
) -> tuple[Float64Array, Int32Array]:
    """Return a mesh with holes, islands, doubled vertices, degenerate and surplus triangles.

    Parameters
    ----------
    vertices_mm, faces
        A sound mesh, shape (V, 3) and (F, 3).
    edge_mm
        Typical length of an edge.
    rng
        Random positions of the defects.

    Returns
    -------
    vertices, faces
        In another order than before.
    """
    vertices, triangles = vertices_mm, faces.astype(np.int64)
    triangles = _punch(vertices, triangles, 8, (1.2 * edge_mm, 2.2 * edge_mm), rng)
    share = max(len(triangles) // 400, 4)
    vertices, fins = _fins(vertices, triangles, share // 4 + 1, edge_mm, rng)
    vertices, islands = _islands(vertices, triangles, 6, edge_mm, rng)
    vertices, slivers = _slivers(vertices, triangles, share, rng)
    flat = triangles[rng.choice(len(triangles), share)][:, [0, 0, 1]]
    twice = triangles[rng.choice(len(triangles), share)]
    triangles = np.concatenate([triangles, fins, islands, slivers, flat, twice])
    vertices, triangles = _pinch(vertices, triangles, 6, edge_mm, rng)
    turned = rng.choice(len(triangles), share, replace=False)
    triangles[turned] = triangles[turned][:, ::-1]
    vertices, triangles = _unweld(vertices, triangles, len(triangles) // 40, rng)
    order = rng.permutation(len(vertices))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    shuffled = place[triangles][rng.permutation(len(triangles))]
    return vertices[order], shuffled.astype(np.int32)


def encode_binary_ply(
    vertices_mm: FloatArray, faces: Int32Array, uv: FloatArray | None = None
) -> bytes:
    """Return a mesh as the bytes of a little-endian binary PLY with float32 positions.

    With ``uv``, shape (V, 2), its vertices have texture coordinates s and t.
    """
    rows = vertices_mm if uv is None else np.column_stack([vertices_mm, uv])
    corners = np.empty(len(faces), [("count", "u1"), ("index", "<i4", (3,))])
    corners["count"] = 3
    corners["index"] = faces
    lines = (
        "ply",
        "format binary_little_endian 1.0",
        "comment unit: mm",
        f"element vertex {len(vertices_mm)}",
        "property float x",
        "property float y",
        "property float z",
        *(() if uv is None else ("property float s", "property float t")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    )
    return (
        "\n".join(lines).encode("ascii")
        + np.ascontiguousarray(rows, "<f4").tobytes()
        + corners.tobytes()
    )


def _punch(
    vertices: Float64Array,
    faces: Int64Array,
    count: int,
    radius_mm: tuple[float, float],
    rng: np.random.Generator,
) -> Int64Array:
    """Remove discs of triangles, as where a highlight saturates the stripes."""
    centers = vertices[faces].mean(axis=1)
    lost = np.zeros(len(faces), np.bool_)
    for at in rng.choice(len(faces), count):
        lost |= np.linalg.norm(centers - centers[at], axis=1) < rng.uniform(*radius_mm)
    return faces[~lost]


def _fins(
    vertices: Float64Array, faces: Int64Array, count: int, edge_mm: float, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array]:
    """Add triangles to edges that already have two."""
    base = faces[rng.choice(len(faces), count)]
    corners = vertices[base]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    tips = corners[:, :2].mean(axis=1) + edge_mm * normal
    new = len(vertices) + np.arange(count)
    return np.concatenate([vertices, tips]), np.column_stack([base[:, :2], new])


def _islands(
    vertices: Float64Array, faces: Int64Array, count: int, edge_mm: float, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array]:
    """Add small floating components in front of the face."""
    parts, rows = [vertices], []
    first = len(vertices)
    for at in rng.choice(len(vertices), count):
        ring = np.linspace(0, 2 * np.pi, 7)[:-1]
        disc = np.stack([np.cos(ring), np.sin(ring), 0.2 * rng.standard_normal(6)], axis=-1)
        away = np.array([*rng.uniform(-10, 10, 2), rng.uniform(12, 40)])
        middle = vertices[at] + away
        parts.append(np.concatenate([middle[None], middle + 1.5 * edge_mm * disc]))
        rows += [(first, first + 1 + k, first + 1 + (k + 1) % 6) for k in range(6)]
        first += 7
    return np.concatenate(parts), np.array(rows)


def _slivers(
    vertices: Float64Array, faces: Int64Array, count: int, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array]:
    """Add triangles without area along edges."""
    base = faces[rng.choice(len(faces), count)]
    middle = vertices[base[:, :2]].mean(axis=1)
    new = len(vertices) + np.arange(count)
    return np.concatenate([vertices, middle]), np.column_stack([base[:, :2], new])


def _pinch(
    vertices: Float64Array, faces: Int64Array, count: int, edge_mm: float, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array]:
    """Move a corner of a triangle to a nearby vertex that is not its neighbor."""
    tree = cKDTree(vertices)
    out = faces.copy()
    for row in rng.choice(len(faces), count):
        corner = out[row, 0]
        around = [
            other
            for other in tree.query_ball_point(vertices[corner], 2.6 * edge_mm)
            if np.linalg.norm(vertices[other] - vertices[corner]) > 1.7 * edge_mm
        ]
        if around:
            out[row, 0] = rng.choice(around)
    return vertices, out


def _unweld(
    vertices: Float64Array, faces: Int64Array, count: int, rng: np.random.Generator
) -> tuple[Float64Array, Int64Array]:
    """Give some triangles their own vertices at the same positions."""
    rows = rng.choice(len(faces), count, replace=False)
    out = faces.copy()
    out[rows] = len(vertices) + np.arange(3 * count).reshape(-1, 3)
    return np.concatenate([vertices, vertices[faces[rows].reshape(-1)]]), out
