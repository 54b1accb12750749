"""Meshes whose vertices move by blend shapes: checked, loaded from .npz, OBJ and glTF files."""

import difflib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from skinrig.arrays import Float32Array, Float64Array, Int32Array
from skinrig.blend_shapes import gltf as blend_shape_gltf
from skinrig.blend_shapes import obj as blend_shape_obj
from skinrig.blend_shapes.obj import BlendShapeError, BlendShapeFileError

__all__ = ["BlendShapeError", "BlendShapeFileError", "BlendShapeMesh", "load"]

EXTENT_RANGE_MM: Final = (1.0, 5000.0)
"""Longest side of a mesh that is believed to be in millimetres."""
NPZ_KEYS: Final = ("vertices_mm", "uv", "faces", "shape_names", "shape_deltas_mm")
MM_PER_M: Final = 1000.0
"""glTF files are in metres."""


@dataclass(frozen=True, slots=True, eq=False)
class BlendShapeMesh:
    """A triangle mesh with a texture, and how far each shape moves its vertices.

    Attributes
    ----------
    vertices_mm : ndarray of float32, shape (V, 3)
        Neutral positions; vertices on seams of the texture are split.
    uv : ndarray of float32, shape (V, 2)
        (0, 0) is bottom left of the texture.
    faces : ndarray of int32, shape (F, 3)
    shapes : mapping of str to ndarray of float32, shape (V, 3)
        Movement by a weight of 1, mm.
    """

    vertices_mm: Float32Array
    uv: Float32Array
    faces: Int32Array
    shapes: Mapping[str, Float32Array] = field(repr=False)

    def __post_init__(self) -> None:
        """Check shapes, indices and sizes."""
        count = len(self.vertices_mm)
        arrays = [
            ("vertices_mm", self.vertices_mm, (count, 3)),
            ("uv", self.uv, (count, 2)),
            ("faces", self.faces, (len(self.faces), 3)),
            *((f"shape {name!r}", deltas, (count, 3)) for name, deltas in self.shapes.items()),
        ]
        for name, array, shape in arrays:
            if array.shape != shape:
                raise BlendShapeError(f"{name}: got shape {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise BlendShapeError(f"{name}: got NaN or infinity, expected numbers only")
        if count < 3 or len(self.faces) < 1:
            raise BlendShapeError(
                f"mesh: got {count} vertices and {len(self.faces)} triangles, expected a triangle"
            )
        if self.faces.min() < 0 or self.faces.max() >= count:
            raise BlendShapeError(
                f"faces: got indices {self.faces.min()}...{self.faces.max()}, "
                f"expected 0...{count - 1}"
            )
        low, high = EXTENT_RANGE_MM
        extent = float(np.ptp(self.vertices_mm, axis=0).max())
        if not low <= extent <= high:
            raise BlendShapeError(
                f"vertices_mm: got an extent of {extent:g} mm, expected {low:g}...{high:g}; "
                "scale it to millimetres, glTF to metres"
            )

    def deformed(self, weights: Mapping[str, float]) -> Float64Array:
        """Return the vertices under weights of shapes, mm, shape (V, 3).

        Parameters
        ----------
        weights
            By shape; any finite number, 0 is neutral. Shapes that are not named stay at 0.

        Raises
        ------
        BlendShapeError
            For a shape that the mesh lacks, or a weight that is not finite.
        """
        moved = self.vertices_mm.astype(np.float64)
        for name, weight in weights.items():
            if name not in self.shapes:
                near = difflib.get_close_matches(name, self.shapes, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise BlendShapeError(
                    f"weights: got shape {name!r}, expected one of "
                    f"{', '.join(self.shapes) or 'none: the mesh has no shapes'}{hint}"
                )
            if not np.isfinite(weight):
                raise BlendShapeError(f"weights: got {weight} for {name!r}, expected a number")
            moved += float(weight) * self.shapes[name].astype(np.float64)
        return moved


def load(path: Path | str) -> BlendShapeMesh:
    """Load a mesh with blend shapes.

    Parameters
    ----------
    path
        .npz of `NPZ_KEYS` in mm; .obj, the neutral mesh in mm with one .obj for each shape beside
        it, or the folder of these; .gltf or .glb in m, with one mesh that has morph targets.

    Raises
    ------
    BlendShapeFileError
        For a file that cannot be read, with what and where.
    BlendShapeError
        For a mesh that contradicts itself.
    """
    source = Path(path)
    kind, scale = source.suffix.lower(), 1.0
    if not source.exists():
        raise BlendShapeFileError(f"{source}: no such file or folder")
    if source.is_dir() or kind == ".obj":
        vertices, uv, faces, deltas = blend_shape_obj.read(source)
    elif kind in (".gltf", ".glb"):
        vertices, uv, faces, deltas = blend_shape_gltf.read(source)
        scale = MM_PER_M
    elif kind == ".npz":
        vertices, uv, faces, deltas = _read_npz(source)
    else:
        raise BlendShapeFileError(
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
        with np.load(path, allow_pickle=False) as archive:
            missing = [key for key in NPZ_KEYS if key not in archive]
            if missing:
                raise BlendShapeFileError(f"{path}: lacks {', '.join(missing)}")
            arrays = {key: archive[key] for key in NPZ_KEYS}
    except BlendShapeFileError:
        raise
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise BlendShapeFileError(f"{path}: not a readable .npz: {error}") from error
    names = arrays["shape_names"]
    if names.ndim != 1 or names.dtype.kind != "U":
        raise BlendShapeFileError(
            f"{path}: shape_names: got {names.dtype} {names.shape}, expected one row of text"
        )
    if len(set(names.tolist())) != names.size:
        raise BlendShapeFileError(f"{path}: shape_names: got a name twice")
    for key in ("vertices_mm", "uv", "shape_deltas_mm"):
        if arrays[key].dtype.kind != "f":
            raise BlendShapeFileError(f"{path}: {key}: got {arrays[key].dtype}, expected floats")
    if arrays["faces"].dtype.kind not in "iu":
        raise BlendShapeFileError(f"{path}: faces: got {arrays['faces'].dtype}, expected integers")
    expected = (names.size, len(arrays["vertices_mm"]), 3)
    if arrays["shape_deltas_mm"].shape != expected:
        raise BlendShapeFileError(
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
