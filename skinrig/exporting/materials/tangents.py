"""Compute tangent frames of a mesh for normal maps, as renderers rebuild them.

A tangent-space normal is defined only in the frame in which it was baked. Frames here follow the
rules that most programs share. The tangent of a vertex is the direction of increasing u, averaged
over its triangles by angle and projected to the plane perpendicular to the vertex normal. The
bitangent is the cross product times the chart's handedness. Frames are interpolated over triangles
and not orthogonalized again.

References
----------
Mikkelsen 2008, Simulation of Wrinkled Surfaces Revisited, section 2.3 and appendix (MikkTSpace).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.surface.texture_fill import push_pull, rasterize
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array
from skinrig.exporting.materials.udim import TiledMesh

MIN_VECTOR_LENGTH = 1e-12
MIN_FRAME_VOLUME = 1e-6
"""Minimum volume of a frame; below it the texture is folded and the normal is undefined."""
MIN_TANGENT_Z = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class FramedMesh:
    """A mesh with a tangent at each vertex.

    Attributes
    ----------
    vertices_mm : ndarray of float32, shape (V, 3)
    normals : ndarray of float32, shape (V, 3)
    uv : ndarray of float32, shape (V, 2)
        Texture coordinates; (0, 0) is bottom left.
    tangents : ndarray of float32, shape (V, 4)
        Unit vector along increasing u, and a sign; the bitangent, along increasing v, is
        sign * cross(normal, tangent).
    faces : ndarray of int32, shape (F, 3)
    source : ndarray of int64, shape (V,)
        Index of the original vertex; vertices shared by mirrored charts are duplicated.
    """

    vertices_mm: Float32Array
    normals: Float32Array
    uv: Float32Array
    tangents: Float32Array
    faces: Int32Array
    source: Int64Array

    @staticmethod
    def of(mesh: Mesh | TiledMesh) -> FramedMesh:
        """Compute the tangents of a mesh.

        Examples
        --------
        >>> from rigsim.geometry.mesh import build_mesh
        >>> flat = build_mesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]],
        ...                   [[0, 0], [1, 0], [0, 1]])
        >>> FramedMesh.of(flat).tangents[0].tolist()
        [1.0, 0.0, 0.0, 1.0]
        """
        points = mesh.vertices_mm.astype(np.float64)
        uv = mesh.uv.astype(np.float64)
        along_u, turn = _face_tangents(points[mesh.faces], uv[mesh.faces])
        sign = np.where(turn >= 0.0, 1, -1)
        # a vertex of both mirrored and unmirrored charts is duplicated
        corner_keys = 2 * mesh.faces.astype(np.int64) + (sign < 0)[:, None]
        keys, faces = np.unique(corner_keys.reshape(-1), return_inverse=True)
        source, signs = keys // 2, np.where(keys % 2 == 1, -1.0, 1.0)
        faces = faces.reshape(-1, 3)
        normals = mesh.normals[source].astype(np.float64)
        total = np.zeros((len(keys), 3))
        for corner in range(3):
            vertex = faces[:, corner]
            normal = normals[vertex]
            here = points[mesh.faces[:, corner]]
            first = _project_across(points[mesh.faces[:, (corner + 1) % 3]] - here, normal)
            last = _project_across(points[mesh.faces[:, (corner + 2) % 3]] - here, normal)
            angle = np.arccos(np.clip(np.sum(first * last, axis=1), -1.0, 1.0))
            known = np.abs(turn) > 0.0
            np.add.at(total, vertex, (angle * known)[:, None] * _project_across(along_u, normal))
        tangent = _unit(total)
        lost = np.linalg.norm(tangent, axis=1) < 0.5
        axis = np.eye(3)[np.argmin(np.abs(normals[lost]), axis=1)]
        tangent[lost] = _project_across(axis, normals[lost])  # any direction in the plane
        frames = np.column_stack([tangent, signs]).astype(np.float32)
        own = mesh.vertices_mm[source], normals.astype(np.float32), mesh.uv[source]
        return FramedMesh(*own, frames, faces.astype(np.int32), source)

    def select_faces(self, faces: BoolArray) -> FramedMesh:
        """Return the mesh with the selected faces, (F,), and all vertices and frames."""
        return replace(self, faces=self.faces[faces])

    def to_obj(self, per_mm: float, unit: str) -> str:
        """Return the mesh as Wavefront OBJ text with texture coordinates and normals.

        Parameters
        ----------
        per_mm
            Scene units per mm.
        unit
            Name of the scene unit, for the comment.
        """
        lines = [f"# skin, scene unit {unit}, +y up; texture coordinate (0, 0) is bottom left"]
        points = (self.vertices_mm * per_mm).tolist()
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*row) for row in points]
        lines += ["vt {:.9g} {:.9g}".format(*row) for row in self.uv.tolist()]
        lines += ["vn {:.6g} {:.6g} {:.6g}".format(*row) for row in self.normals.tolist()]
        lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (self.faces + 1).tolist()]
        return "\n".join(lines) + "\n"

    def count_holes(self) -> int:
        """Return the number of boundary loops beyond one per connected surface, ignoring seams.

        Examples
        --------
        >>> from rigsim.geometry.mesh import build_mesh
        >>> square = [[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]]
        >>> flat = build_mesh(square, [[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0, 1]])
        >>> FramedMesh.of(flat).count_holes()
        0
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        _, welded = np.unique(self.vertices_mm, axis=0, return_inverse=True)
        faces = welded.reshape(-1)[self.faces]
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        found, count = np.unique(edges, axis=0, return_counts=True)
        rim = found[count == 1]
        side = int(welded.max()) + 1

        def parts(pairs: NDArray[np.intp]) -> int:
            joined = coo_array((np.ones(len(pairs), np.int8), tuple(pairs.T)), (side, side))
            labels = connected_components(joined, directed=False)[1]
            return len(np.unique(labels[rim[:, 0]]))

        return parts(rim) - parts(found)

    def texel_frames(self, size: int) -> tuple[Float64Array, BoolArray]:
        """Return the interpolated frame of each texel.

        Parameters
        ----------
        size
            Width and height, texels.

        Returns
        -------
        axes : ndarray, shape (size, size, 3, 3)
            Rows are tangent, bitangent and normal in the mesh's frame; image row 0 is v = 1.
        covered : ndarray of bool, shape (size, size)
        """
        texels = rasterize(self.uv[self.faces].astype(np.float64), size)
        covered = texels.covered
        corners = self.faces[texels.face[covered]]
        share = texels.weight[covered].astype(np.float64)
        weights = np.column_stack([1.0 - share.sum(axis=1), share])
        tangent = self.tangents.astype(np.float64)
        normal = self.normals.astype(np.float64)
        bitangent = tangent[:, 3:] * np.cross(normal, tangent[:, :3])
        axes = np.broadcast_to(np.eye(3), (size, size, 3, 3)).copy()
        for row, values in enumerate((tangent[:, :3], bitangent, normal)):
            mixed = np.einsum("nk,nkc->nc", weights, values[corners])
            axes[covered, row] = _unit(mixed) if row == 2 else mixed
        return axes, covered


def rotate_to_tangent(normals: ArrayLike, axes: Float64Array, covered: BoolArray) -> Float32Array:
    """Rotate normals to the tangent frames of their texels.

    Parameters
    ----------
    normals
        Unit vectors in the frame of the axes, (H, W, 3).
    axes, covered
        See :meth:`FramedMesh.texel_frames`.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        Unit vectors, decoded by :func:`rotate_from_tangent`; (0, 0, 1) on uncovered texels. The
        third component is above 0, as maps require: normals that face away from the surface are
        projected to its horizon.
    """
    given = np.asarray(normals)
    good = covered & np.isfinite(given).all(axis=-1)
    out = np.zeros(given.shape, np.float32)
    out[..., 2] = 1.0
    world = given[good].astype(np.float64)
    tangent, bitangent, normal = (axes[..., row, :][good] for row in range(3))
    # a renderer decodes n = n' A with the interpolated, non-orthogonal axes as rows of A; hence
    # n' = n A^-1, where A^-1 is the adjugate (cross products of axes) over the frame's volume
    volume = np.sum(np.cross(tangent, bitangent) * normal, axis=-1)
    found = np.empty_like(world)
    found[:, 0] = np.sum(np.cross(bitangent, normal) * world, axis=-1)
    found[:, 1] = np.sum(np.cross(normal, tangent) * world, axis=-1)
    found[:, 2] = np.sum(np.cross(tangent, bitangent) * world, axis=-1)
    found = _unit(found * np.sign(volume)[:, None])
    found[:, 2] = np.maximum(found[:, 2], MIN_TANGENT_Z)
    found[np.abs(volume) < MIN_FRAME_VOLUME] = (0.0, 0.0, 1.0)
    out[good] = _unit(found)
    return out


def fill_tangent_normals(tangent_normals: ArrayLike, valid: BoolArray) -> Float32Array:
    """Fill invalid tangent-space normals from their surroundings, (H, W, 3).

    In tangent space, relief continues plausibly beyond an edge. In the rig frame, the normal of one
    part of a face could be projected to the horizon of another part.

    Parameters
    ----------
    tangent_normals
        Unit vectors, (H, W, 3).
    valid
        Valid texels, which are unchanged, (H, W).

    Examples
    --------
    >>> tilted = np.full((8, 8, 3), (0.6, 0.0, 0.8)) * np.eye(8, dtype=bool)[..., None]
    >>> fill_tangent_normals(tilted, np.eye(8, dtype=bool))[0, 7].round(3).tolist()
    [0.6000000238418579, 0.0, 0.800000011920929]
    """
    given = np.asarray(tangent_normals, np.float32)
    if not valid.any():
        return np.broadcast_to(np.array([0.0, 0.0, 1.0], np.float32), given.shape).copy()
    spread = push_pull(given, valid.astype(np.float32)).values.astype(np.float64)
    spread[..., 2] = np.maximum(spread[..., 2], MIN_TANGENT_Z)
    return np.where(valid[..., None], given, _unit(spread)).astype(np.float32)


def rotate_from_tangent(tangent_normals: ArrayLike, axes: Float64Array) -> Float64Array:
    """Decode a tangent-space map as a renderer does: unit normals in the axes' frame, (H, W, 3)."""
    return _unit(np.einsum("hwk,hwkc->hwc", np.asarray(tangent_normals, np.float64), axes))


def _face_tangents(points: Float64Array, uv: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return each triangle's unit direction of increasing u, and twice its signed area in uv."""
    a, b = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    (au, av), (bu, bv) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    area = au * bv - av * bu
    sign = np.where(area < 0.0, -1.0, 1.0)
    along = (bv[:, None] * a - av[:, None] * b) * sign[:, None]
    return _unit(along), area


def _project_across(vectors: Float64Array, normals: Float64Array) -> Float64Array:
    """Project vectors perpendicular to normals and normalize them; 0 for parallel ones."""
    return _unit(vectors - np.sum(vectors * normals, axis=1, keepdims=True) * normals)


def _unit(vectors: Float64Array) -> Float64Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(
        length > MIN_VECTOR_LENGTH, vectors / np.maximum(length, MIN_VECTOR_LENGTH), 0.0
    )
