"""Face templates: a mesh with texture coordinates and named points, wrapped onto scans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np

from reconstruction.arrays import Float64Array
from reconstruction.scan.repair import ScanMeshError, TriangleMesh

TEMPLATE_FILE: Final = "data/face_template.npz"
"""The default template, made by ``tools/make_face_template.py``."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceTemplate:
    """A face of fixed triangles and texture coordinates, in millimeters."""

    mesh: TriangleMesh
    """Welded triangles with texture coordinates, counter-clockwise from outside."""
    landmarks_mm: Mapping[str, Float64Array] = field(default_factory=dict)
    """Named points of its surface, each of shape (3,)."""

    def __post_init__(self) -> None:
        self.texture()

    def texture(self) -> Float64Array:
        """Return the texture coordinates of each triangle's corners, shape (F, 3, 2)."""
        if self.mesh.corner_uv is None:
            raise ScanMeshError(
                "template: got no texture coordinates, expected some; export the template with "
                "its texture coordinates [SR-REC-026]"
            )
        return self.mesh.corner_uv

    def vertex_areas_mm2(self) -> Float64Array:
        """Return a third of the area of the triangles at each vertex, shape (V,)."""
        return vertex_areas_mm2(self.mesh)


def vertex_areas_mm2(mesh: TriangleMesh) -> Float64Array:
    """Return a third of the area of the triangles at each vertex, shape (V,)."""
    third = np.linalg.norm(mesh.face_vectors(), axis=1) / 6.0
    total = np.zeros(len(mesh.vertices_mm))
    for corner in range(3):
        total += np.bincount(mesh.faces[:, corner], third, len(total))
    return total


@lru_cache(maxsize=1)
def load_default_template() -> FaceTemplate:
    """Return the average face that comes with the product.

    Examples
    --------
    >>> template = load_default_template()
    >>> "nose tip" in template.landmarks_mm, template.mesh.corner_uv.shape[1:]
    (True, (3, 2))
    """
    with resources.files("reconstruction").joinpath(TEMPLATE_FILE).open("rb") as file:
        data: Any = np.load(file)
        faces = data["faces"].astype(np.int64)
        mesh = TriangleMesh(
            data["vertices_mm"].astype(np.float64), faces, data["uv"].astype(np.float64)[faces]
        )
        names = data["landmark_names"].tolist()
        points = data["landmarks_mm"].astype(np.float64)
    return FaceTemplate(mesh, dict(zip(names, points, strict=True)))
