"""Load and check meshes with blend shapes: .npz, OBJ and glTF files."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from model.checks.files import read_arrays
from rigsim.geometry.mesh import MeshError, MeshFileError, check_triangles
from skinrig.arrays import Float32Array, Float64Array, Int32Array
from skinrig.blend_shapes import gltf as blend_shape_gltf
from skinrig.blend_shapes import obj as blend_shape_obj

NPZ_KEYS: Final = ("vertices_mm", "uv", "faces", "shape_names", "shape_deltas_mm")
MM_PER_M: Final = 1000.0
"""Millimeters per meter, the unit of glTF files."""


@dataclass(frozen=True, slots=True, eq=False)
class BlendShapeMesh:
    """A triangle mesh with texture coordinates and displacements of its vertices by blend shape.

    Attributes
    ----------
    vertices_mm : ndarray of float32, shape (V, 3)
        Neutral positions; vertices on seams of the texture are split.
    uv : ndarray of float32, shape (V, 2)
        (0, 0) is bottom left of the texture.
    faces : ndarray of int32, shape (F, 3)
    shapes : mapping of str to ndarray of float32, shape (V, 3)
        Displacement at weight 1, mm.
    """

    vertices_mm: Float32Array
    uv: Float32Array
    faces: Int32Array
    shapes: Mapping[str, Float32Array] = field(repr=False)

    def __post_init__(self) -> None:
        """Check shapes, indices and sizes."""
        check_triangles(self.vertices_mm, self.faces, self.uv, self.shapes)

    def deform(self, weights: Mapping[str, float]) -> Float64Array:
        """Return the vertices displaced by weighted blend shapes, mm, shape (V, 3).

        Parameters
        ----------
        weights
            Weight by shape, any finite number; missing shapes have weight 0.

        Raises
        ------
        MeshError
            If the mesh lacks a shape, or a weight is not finite.
        """
        moved = self.vertices_mm.astype(np.float64)
        for name, weight in weights.items():
            if name not in self.shapes:
                near = difflib.get_close_matches(name, self.shapes, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise MeshError(
                    f"weights: got shape {name!r}, expected one of "
                    f"{', '.join(self.shapes) or 'none: the mesh has no shapes'}{hint}"
                )
            if not np.isfinite(weight):
                raise MeshError(
                    f"weights: got {weight} for {name!r}, expected a finite number; correct it"
                )
            moved += float(weight) * self.shapes[name].astype(np.float64)
        return moved


def load(path: Path | str) -> BlendShapeMesh:
    """Load a mesh with blend shapes.

    Parameters
    ----------
    path
        .npz of `NPZ_KEYS` in mm; .obj, the neutral mesh in mm with one .obj per shape next to
        it, or the folder of these; .gltf or .glb in m, with one mesh that has morph targets.

    Raises
    ------
    MeshFileError
        If a file is not readable; the message names place and reason.
    MeshError
        If the mesh is inconsistent.
    """
    source = Path(path)
    kind, scale = source.suffix.lower(), 1.0
    if not source.exists():
        raise MeshFileError(f"{source}: no such file or folder; check the name")
    if source.is_dir() or kind == ".obj":
        vertices, uv, faces, deltas = blend_shape_obj.read(source)
    elif kind in (".gltf", ".glb"):
        vertices, uv, faces, deltas = blend_shape_gltf.read(source)
        scale = MM_PER_M
    elif kind == ".npz":
        vertices, uv, faces, deltas = _read_npz(source)
    else:
        raise MeshFileError(
            f"{source}: got {kind or 'no suffix'}, expected .npz, .obj, .gltf, .glb or a folder"
        )
    return BlendShapeMesh(
        np.asarray(scale * vertices, np.float32),
        np.asarray(uv, np.float32),
        np.asarray(faces, np.int32),
        {name: np.asarray(scale * moved, np.float32) for name, moved in deltas.items()},
    )


def _read_npz(path: Path) -> blend_shape_obj.MeshArrays:
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise MeshFileError(f"{path}: not a readable .npz: {error}") from error
    if missing := [key for key in NPZ_KEYS if key not in arrays]:
        raise MeshFileError(f"{path}: {', '.join(missing)} missing; export it again")
    names = arrays["shape_names"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise MeshFileError(
            f"{path}: shape_names: got {names.dtype} {names.shape}, expected one row of text"
        )
    if len(set(names.tolist())) != names.size:
        raise MeshFileError(f"{path}: shape_names: got a name twice; rename one")
    for key in ("vertices_mm", "uv", "shape_deltas_mm"):
        if arrays[key].dtype.kind != "f":
            raise MeshFileError(f"{path}: {key}: got {arrays[key].dtype}, expected floats")
    if arrays["faces"].dtype.kind not in "iu":
        raise MeshFileError(f"{path}: faces: got {arrays['faces'].dtype}, expected integers")
    expected = (names.size, len(arrays["vertices_mm"]), 3)
    if arrays["shape_deltas_mm"].shape != expected:
        raise MeshFileError(
            f"{path}: shape_deltas_mm: got shape {arrays['shape_deltas_mm'].shape}, "
            f"expected {expected}"
        )
    deltas = arrays["shape_deltas_mm"].astype(np.float64)
    return (
        arrays["vertices_mm"].astype(np.float64),
        arrays["uv"].astype(np.float64),
        arrays["faces"].astype(np.int64),
        dict(zip(names.tolist(), deltas, strict=True)),
    )
