"""Cast rays on a mesh, by one of two ray tracers.

Mitsuba's LLVM variants trace where they work, otherwise Embree by embreex, which needs no LLVM.
"""

from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import BoolArray, Float32Array, Int32Array
from rigsim.geometry.mesh import Mesh
from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import VariantChoice, choose_variant

RAYS_PER_CALL: Final = 1 << 22
"""Rays per call; bounds the memory of a ray batch."""


RayHits: TypeAlias = tuple[Int32Array, Float32Array]
"""Triangle that each ray hits, -1 for none, and weights of its corners 1 and 2, (N, 2)."""


class Caster:
    """Traces rays against one mesh.

    Parameters
    ----------
    mesh
        The mesh; it is copied.
    choice
        Variant to use; ``None`` chooses one for this machine.
    """

    def __init__(self, mesh: Mesh, *, choice: VariantChoice | None = None) -> None:
        self.mesh = mesh
        self.choice = choose_variant("rgb") if choice is None else choice
        self.attributes = np.concatenate([mesh.vertices_mm, mesh.normals, mesh.uv], axis=1)
        self._face_normals: Float32Array | None = None
        vectorized = self.choice.is_vectorized
        self._tracer = _MitsubaTracer(mesh, self.choice) if vectorized else _EmbreeTracer(mesh)

    @property
    def face_normals(self) -> Float32Array:
        """Unit normals of the triangles, shape (F, 3); zero for a triangle without area."""
        if self._face_normals is None:
            corners = self.mesh.vertices_mm[self.mesh.faces]
            edges = corners[:, 1:] - corners[:, :1]
            self._face_normals = normalize(np.cross(edges[:, 0], edges[:, 1]))
        return self._face_normals

    def first_hit(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Find the first triangle on each ray.

        Parameters
        ----------
        origins
            Start points in mm, shape (N, 3).
        directions
            Unit vectors, shape (N, 3).

        Returns
        -------
        prim : ndarray of int32
            Triangle that was hit, shape (N,), -1 for none.
        weight : ndarray of float32
            Weights of the triangle's second and third corner, shape (N, 2).
        """
        start, way = _ray_arrays(origins, directions)
        prim = np.empty(len(start), np.int32)
        weight = np.empty((len(start), 2), np.float32)
        for part in _parts(len(start)):
            prim[part], weight[part] = self._tracer.first_hit(start[part], way[part])
        return prim, weight

    def is_blocked(
        self, origins: ArrayLike, directions: ArrayLike, length_mm: ArrayLike
    ) -> BoolArray:
        """Return which rays hit a triangle before their end.

        Parameters
        ----------
        origins
            Start points in mm, shape (N, 3).
        directions
            Unit vectors, shape (N, 3).
        length_mm
            Length of each ray in mm, shape (N,).

        Returns
        -------
        ndarray of bool
            Shape (N,).
        """
        start, way = _ray_arrays(origins, directions)
        length = np.ascontiguousarray(np.broadcast_to(length_mm, len(start)), np.float32)
        out = np.empty(len(start), np.bool_)
        for part in _parts(len(start)):
            out[part] = self._tracer.is_blocked(start[part], way[part], length[part])
        return out


class _MitsubaTracer:
    def __init__(self, mesh: Mesh, choice: VariantChoice) -> None:
        self._choice = choice
        mi = load_mitsuba(choice)
        shape = mi.Mesh("mesh", len(mesh.vertices_mm), len(mesh.faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = pad_memory(np.ravel(mesh.vertices_mm))
        parameters["faces"] = pad_memory(np.ravel(mesh.faces).astype(np.uint32))
        parameters.update()
        self._scene: Any = mi.load_dict({"type": "scene", "mesh": shape})

    def _ray(
        self, mi: Any, origins: Float32Array, directions: Float32Array, length: Any = None
    ) -> Any:
        start = mi.Point3f(*(pad_memory(origins[:, k]) for k in range(3)))
        way = mi.Vector3f(*(pad_memory(directions[:, k]) for k in range(3)))
        ray = mi.Ray3f(start, way)
        if length is not None:
            ray.maxt = mi.Float(pad_memory(length))
        return ray

    def first_hit(self, origins: Float32Array, directions: Float32Array) -> RayHits:
        mi = load_mitsuba(self._choice)
        import drjit as dr

        ray = self._ray(mi, origins, directions)
        hit = self._scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(hit)  # otherwise each of the reads below would trace again
        valid = np.array(hit.is_valid())
        prim = np.where(valid, np.array(hit.prim_index).astype(np.int64), -1).astype(np.int32)
        weight = np.stack([np.array(hit.prim_uv.x), np.array(hit.prim_uv.y)], axis=-1)
        return prim, np.where(valid[:, None], weight, 0.0).astype(np.float32)

    def is_blocked(
        self, origins: Float32Array, directions: Float32Array, length: Float32Array
    ) -> BoolArray:
        mi = load_mitsuba(self._choice)
        hit = self._scene.ray_test(self._ray(mi, origins, directions, length), coherent=True)
        return np.array(hit, np.bool_)


class _EmbreeTracer:
    def __init__(self, mesh: Mesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices_mm, mesh.faces)

    def first_hit(self, origins: Float32Array, directions: Float32Array) -> RayHits:
        if not len(origins):
            return np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        hit = self._scene.run(origins, directions, output=True)
        prim = np.asarray(hit["primID"], np.int32)
        weight = np.stack([hit["u"], hit["v"]], axis=-1).astype(np.float32)
        return prim, np.where(prim[:, None] >= 0, weight, np.float32(0.0))

    def is_blocked(
        self, origins: Float32Array, directions: Float32Array, length: Float32Array
    ) -> BoolArray:
        if not len(origins):
            return np.zeros(0, np.bool_)
        hit = self._scene.run(origins, directions, dists=length.copy(), query="OCCLUDED")
        return np.asarray(hit) != -1


def _ray_arrays(origins: ArrayLike, directions: ArrayLike) -> tuple[Float32Array, Float32Array]:
    start = np.ascontiguousarray(origins, np.float32)
    way = np.ascontiguousarray(directions, np.float32)
    if start.shape != way.shape or start.ndim != 2 or start.shape[1] != 3:
        raise ValueError(f"rays: got shapes {start.shape} and {way.shape}, expected (N, 3) twice")
    return start, way


def _parts(count: int) -> list[slice]:
    return [slice(at, min(at + RAYS_PER_CALL, count)) for at in range(0, count, RAYS_PER_CALL)]


def normalize(vectors: Float32Array) -> Float32Array:
    """Return vectors of length 1; those of length 0 stay."""
    squared = np.einsum("...i,...i->...", vectors, vectors)
    inverse = np.zeros_like(squared)
    np.divide(np.float32(1.0), np.sqrt(squared), out=inverse, where=squared > 0.0)
    return vectors * inverse[..., None]
