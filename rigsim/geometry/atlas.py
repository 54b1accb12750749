"""Rasterize a mesh into its texture: surface point, frame and stretch of each texel."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from rigsim.arrays import BoolArray, Float32Array, Int32Array
from rigsim.geometry.mesh import Mesh


@dataclass(frozen=True, slots=True)
class Atlas:
    """Surface point, frame and stretch under each texel; row 0 is the top, v = 1."""

    prim: Int32Array
    """Triangle under the texel's center, shape (N, N); -1 without one."""
    position_mm: Float32Array
    """Surface point, shape (N, N, 3), rig frame."""
    normal: Float32Array
    """Unit shading normal, shape (N, N, 3)."""
    dp_du_mm: Float32Array
    """Change of the point along u, shape (N, N, 3), mm per unit of u."""
    dp_dv_mm: Float32Array
    """Change of the point along v, shape (N, N, 3), mm per unit of v."""

    @property
    def covered(self) -> BoolArray:
        """Return the texels with a surface under their center, shape (N, N)."""
        return self.prim >= 0

    @property
    def size(self) -> int:
        """Return the number of texels along one side."""
        return int(self.prim.shape[0])

    def texel_mm(self) -> tuple[Float32Array, Float32Array]:
        """Return the length of one texel step along u and along v in mm, shape (N, N) each."""
        scale = np.float32(1.0 / self.size)
        return (
            np.linalg.norm(self.dp_du_mm, axis=-1) * scale,
            np.linalg.norm(self.dp_dv_mm, axis=-1) * scale,
        )

    def typical_texel_mm(self) -> float:
        """Return the median of the covered texels' longer sides, mm."""
        along_u, along_v = self.texel_mm()
        return float(np.median(np.maximum(along_u, along_v)[self.covered]))

    def translate(self, offset_mm: Float32Array) -> Atlas:
        """Return the atlas of the surface moved as a whole by (3,) mm, rig frame."""
        there = np.where(self.covered[..., None], self.position_mm + offset_mm, self.position_mm)
        return dataclasses.replace(self, position_mm=there)


def unwrap(mesh: Mesh, size: int) -> Atlas:
    """Rasterize the surface of a mesh into its texture.

    Parameters
    ----------
    mesh
        Any mesh with texture coordinates; where triangles overlap in the texture the last counts.
    size
        Texels along one side of the square texture, at least 8.

    Returns
    -------
    Atlas
        Surface under each texel.
    """
    if size < 8:
        raise ValueError(f"size: got {size}, expected at least 8 texels")
    prim, weight = _rasterize(mesh.uv, mesh.faces, size)
    du, dv = _vertex_tangents(mesh)
    flat = prim.reshape(-1)
    weights = weight.reshape(-1, 2)
    fields = []
    for values in (mesh.vertices_mm, mesh.normals, du, dv):
        fields.append(interpolate(values, mesh.faces, flat, weights).reshape(size, size, 3))
    position, normal, dp_du, dp_dv = fields
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0.0, normal / np.maximum(length, 1e-12), normal)
    return Atlas(prim, position, normal.astype(np.float32), dp_du, dp_dv)


def texture_of_vertices(mesh: Mesh, values: Float32Array, size: int) -> Float32Array:
    """Interpolate vertex values to the texels of a mesh's texture.

    Parameters
    ----------
    mesh
        Any mesh with texture coordinates.
    values
        One value per vertex, shape (V,).
    size
        Texels along one side of the square texture.

    Returns
    -------
    ndarray
        Shape (size, size), float32; 0 where no surface is.
    """
    prim, weight = _rasterize(mesh.uv, mesh.faces, size)
    column = np.ascontiguousarray(values, np.float32)[:, None]
    texels = interpolate(column, mesh.faces, prim.reshape(-1), weight.reshape(-1, 2))
    return texels.reshape(size, size)


def interpolate(
    values: Float32Array, faces: Int32Array, prim: Int32Array, weight: Float32Array
) -> Float32Array:
    """Interpolate vertex values over triangles.

    Parameters
    ----------
    values
        Values at the vertices, shape (V, C).
    faces
        Vertex indices, shape (F, 3).
    prim
        Triangle of each point, shape (N,); -1 gives zeros.
    weight
        Weights of the second and third corner, shape (N, 2).

    Returns
    -------
    ndarray
        Shape (N, C), float32.
    """
    return _interpolate(values, faces, prim, weight)


def sample(texture: Float32Array, uv: Float32Array, mask: BoolArray) -> Float32Array:
    """Sample a texture bilinearly, clamped at its border.

    Parameters
    ----------
    texture
        Shape (N, N) or (N, N, C), row 0 is the top (v = 1).
    uv
        Texture coordinates, shape (..., 2).
    mask
        Points to sample, shape (...); the others get zero.

    Returns
    -------
    ndarray
        Shape (...) or (..., C), float32.
    """
    leading = uv.shape[:-1]
    layers = texture if texture.ndim == 3 else texture[..., None]
    out = _sample(
        np.ascontiguousarray(layers, np.float32),
        np.ascontiguousarray(uv.reshape(-1, 2), np.float32),
        np.ascontiguousarray(mask.reshape(-1)),
    )
    return out.reshape(*leading, layers.shape[-1]) if texture.ndim == 3 else out.reshape(leading)


def dilate_texture(texture: Float32Array, covered: BoolArray, *, steps: int = 4) -> Float32Array:
    """Fill texels next to covered ones with their neighbors' mean, for bilinear sampling.

    Parameters
    ----------
    texture
        Shape (N, N) or (N, N, C).
    covered
        Texels that hold a value, shape (N, N).
    steps
        Width of the border that is filled, in texels.

    Returns
    -------
    ndarray
        A filled copy; texels farther away are zero.
    """
    layers = texture if texture.ndim == 3 else texture[..., None]
    filled = np.where(covered[..., None], layers, 0.0).astype(np.float32)
    known = covered.copy()
    for _ in range(steps):
        if known.all():
            break
        total = np.zeros_like(filled)
        count = np.zeros(known.shape, np.float32)
        for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            to, source = _shifted(known.shape, dy, dx)
            total[to] += filled[source]  # unknown texels are zero
            count[to] += known[source]
        new = ~known & (count > 0)
        filled[new] = total[new] / count[new, None]
        known |= new
    return filled if texture.ndim == 3 else filled[..., 0]


def _shifted(
    shape: tuple[int, ...], dy: int, dx: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    def pair(n: int, d: int) -> tuple[slice, slice]:
        return slice(max(d, 0), n + min(d, 0)), slice(max(-d, 0), n + min(-d, 0))

    (to_y, from_y), (to_x, from_x) = pair(shape[0], dy), pair(shape[1], dx)
    return (to_y, to_x), (from_y, from_x)


def _vertex_tangents(mesh: Mesh) -> tuple[Float32Array, Float32Array]:
    corners = mesh.vertices_mm.astype(np.float64)[mesh.faces]
    uv = mesh.uv.astype(np.float64)[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    # Faces without area in the texture do not determine its stretch.
    flat = np.abs(determinant) < 1e-15
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, determinant))[:, None]
    du = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * inverse
    dv = (e2 * d1[:, :1] - e1 * d2[:, :1]) * inverse
    weight = np.where(flat, 0.0, np.abs(determinant))[:, None]
    out = []
    for tangent in (du, dv):
        total = np.zeros((len(mesh.vertices_mm), 3))
        norm = np.zeros((len(mesh.vertices_mm), 1))
        for corner in range(3):
            np.add.at(total, mesh.faces[:, corner], tangent * weight)
            np.add.at(norm, mesh.faces[:, corner], weight)
        out.append(np.asarray(total / np.maximum(norm, 1e-30), np.float32))
    return out[0], out[1]


@njit(cache=True)
def _rasterize(uv, faces, size):  # type: ignore[no-untyped-def]
    prim = np.full((size, size), -1, np.int32)
    weight = np.zeros((size, size, 2), np.float32)
    for f in range(faces.shape[0]):
        ax, ay = uv[faces[f, 0], 0] * size - 0.5, (1.0 - uv[faces[f, 0], 1]) * size - 0.5
        bx, by = uv[faces[f, 1], 0] * size - 0.5, (1.0 - uv[faces[f, 1], 1]) * size - 0.5
        cx, cy = uv[faces[f, 2], 0] * size - 0.5, (1.0 - uv[faces[f, 2], 1]) * size - 0.5
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-12:
            continue
        x0, x1 = max(0, int(np.ceil(min(ax, bx, cx)))), min(size - 1, int(max(ax, bx, cx)))
        y0, y1 = max(0, int(np.ceil(min(ay, by, cy)))), min(size - 1, int(max(ay, by, cy)))
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                w1 = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                w2 = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                if w1 >= -1e-6 and w2 >= -1e-6 and w1 + w2 <= 1.0 + 2e-6:
                    prim[y, x] = f
                    weight[y, x, 0] = w1
                    weight[y, x, 1] = w2
    return prim, weight


@njit(parallel=True, cache=True)
def _interpolate(values, faces, prim, weight):  # type: ignore[no-untyped-def]
    count, channels = prim.shape[0], values.shape[1]
    out = np.zeros((count, channels), np.float32)
    for i in prange(count):
        f = prim[i]
        if f >= 0:
            w1, w2 = weight[i, 0], weight[i, 1]
            w0 = 1.0 - w1 - w2
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            for k in range(channels):
                out[i, k] = w0 * values[a, k] + w1 * values[b, k] + w2 * values[c, k]
    return out


@njit(parallel=True, cache=True, nogil=True)
def _sample(texture, uv, mask):  # type: ignore[no-untyped-def]
    height, width, channels = texture.shape
    out = np.zeros((uv.shape[0], channels), np.float32)
    for i in prange(uv.shape[0]):
        if mask[i]:
            x = min(max(uv[i, 0] * width - 0.5, 0.0), width - 1.0)
            y = min(max((1.0 - uv[i, 1]) * height - 0.5, 0.0), height - 1.0)
            x0, y0 = min(int(x), width - 2), min(int(y), height - 2)
            fx, fy = x - x0, y - y0
            for k in range(channels):
                top = (1.0 - fx) * texture[y0, x0, k] + fx * texture[y0, x0 + 1, k]
                low = (1.0 - fx) * texture[y0 + 1, x0, k] + fx * texture[y0 + 1, x0 + 1, k]
                out[i, k] = (1.0 - fy) * top + fy * low
    return out
