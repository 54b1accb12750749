"""Trace rays against a triangle mesh with Embree: first hits and occlusion."""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, FloatArray, Int32Array

RAYS_PER_CALL: Final = 1 << 20
"""Rays traced in one call; limits the memory of a batch."""


class RayCaster:
    """Trace rays against one mesh.

    Parameters
    ----------
    vertices_mm : array_like, shape (V, 3)
        Positions in mm.
    faces : array_like of int, shape (F, 3)
        Vertex indices.

    Raises
    ------
    ValueError
        When triangles are missing, an index is out of range, or a position is not finite.

    Examples
    --------
    >>> caster = RayCaster([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    >>> caster.is_blocked([[0.2, 0.2, 1.0]], [[0.0, 0.0, -1.0]], [2.0]).tolist()
    [True]
    """

    def __init__(self, vertices_mm: ArrayLike, faces: ArrayLike) -> None:
        vertices = np.ascontiguousarray(vertices_mm, np.float32)
        triangles = np.ascontiguousarray(faces, np.int32)
        Checks().shape("faces", triangles, ("F", 3))
        Checks().numbers("vertices_mm", vertices, ("V", 3))
        Checks().within("faces", triangles, f"[0, {len(vertices)})")
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene: Any = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, vertices, triangles)

    def first_hit(
        self, origins_mm: ArrayLike, directions: ArrayLike
    ) -> tuple[Int32Array, Float32Array]:
        """Return the first triangle that each ray hits, and its distance.

        Parameters
        ----------
        origins_mm, directions : array_like, shape (N, 3)
            Start in mm, and unit vector.

        Returns
        -------
        triangle : ndarray of int32, shape (N,)
            -1 for none.
        distance_mm : ndarray of float32, shape (N,)
            Infinite for none.
        """
        start, way = _pair(origins_mm, directions)
        triangle = np.full(len(start), -1, np.int32)
        distance = np.full(len(start), np.inf, np.float32)
        for at in range(0, len(start), RAYS_PER_CALL):
            part = slice(at, at + RAYS_PER_CALL)
            hit = self._scene.run(start[part], way[part], output=True)
            triangle[part] = hit["primID"]
            distance[part] = np.where(triangle[part] >= 0, hit["tfar"], np.inf)
        return triangle, distance

    def is_blocked(
        self, origins_mm: ArrayLike, directions: ArrayLike, length_mm: ArrayLike
    ) -> BoolArray:
        """Return which rays hit a triangle before their end.

        Parameters
        ----------
        origins_mm, directions : array_like, shape (N, 3)
            Start in mm, and unit vector.
        length_mm : array_like, shape (N,) or ()
            Length of each ray, mm.
        """
        start, way = _pair(origins_mm, directions)
        length = np.ascontiguousarray(np.broadcast_to(length_mm, len(start)), np.float32)
        out = np.zeros(len(start), np.bool_)
        for at in range(0, len(start), RAYS_PER_CALL):
            part = slice(at, at + RAYS_PER_CALL)
            found = self._scene.run(
                start[part], way[part], dists=length[part].copy(), query="OCCLUDED"
            )
            out[part] = np.asarray(found) != -1
        return out


def _pair(origins: ArrayLike, directions: ArrayLike) -> tuple[FloatArray, FloatArray]:
    start = np.ascontiguousarray(origins, np.float32)
    way = np.ascontiguousarray(directions, np.float32)
    Checks().shape("rays' origins", start, (None, 3))
    Checks().shape("rays' directions", way, start.shape)
    return start, way
