"""Triangle meshes in millimeters with texture coordinates: checks, normals, files."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array, Int32Array

EXTENT_RANGE_MM: Final = (1.0, 5000.0)
"""Range of a mesh's longest side, mm; outside it the unit is wrong."""


class MeshError(ValueError):
    """Error for a mesh that cannot be used; the message names the field and the remedy."""


class MeshFileError(MeshError, OSError):
    """Error for a mesh file that cannot be read."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh in the rig frame."""

    vertices_mm: Float32Array
    """Positions in mm, shape (V, 3), rig frame."""
    faces: Int32Array
    """Vertex indices, shape (F, 3), counter-clockwise seen from outside."""
    uv: Float32Array
    """Texture coordinates, shape (V, 2), in [0, 1]; (0, 0) is bottom left."""
    normals: Float32Array
    """Unit shading normals, shape (V, 3), outward."""
    shapes: Mapping[str, Float32Array] = field(default_factory=dict)
    """Blend shapes of the mesh: displacement of each vertex at weight 1, mm, (V, 3) each."""

    def __post_init__(self) -> None:
        """Check shapes, ranges and finiteness."""
        check_triangles(self.vertices_mm, self.faces, self.uv, self.shapes, self.normals)
        if self.uv.min() < 0.0 or self.uv.max() > 1.0:
            raise MeshError(f"uv: got {self.uv.min()} to {self.uv.max()}, expected [0, 1]")


def check_triangles(
    vertices_mm: Float32Array,
    faces: Int32Array,
    uv: Float32Array,
    shapes: Mapping[str, Float32Array],
    normals: Float32Array | None = None,
) -> None:
    """Raise for shapes, indices, numbers or sizes that a mesh cannot have.

    Parameters
    ----------
    vertices_mm, faces, uv, shapes, normals
        As the fields of `Mesh`; texture coordinates in any range.

    Raises
    ------
    MeshError
        A field is wrong.
    """
    count = len(vertices_mm)
    for name, array, shape in (
        ("vertices_mm", vertices_mm, (count, 3)),
        ("uv", uv, (count, 2)),
        ("normals", vertices_mm if normals is None else normals, (count, 3)),
        ("faces", faces, (len(faces), 3)),
        *((f"shapes[{name!r}]", deltas, (count, 3)) for name, deltas in shapes.items()),
    ):
        if array.shape != shape:
            raise MeshError(f"{name}: got shape {array.shape}, expected {shape}")
        if not np.isfinite(array).all():
            raise MeshError(f"{name}: got values that are not finite, expected numbers only")
    if count < 3 or len(faces) < 1:
        raise MeshError(f"mesh: got {count} vertices, {len(faces)} faces, expected a triangle")
    if faces.min() < 0 or faces.max() >= count:
        raise MeshError(
            f"faces: got indices {faces.min()} to {faces.max()}, expected 0 to {count - 1}"
        )
    extent = float(np.ptp(vertices_mm, axis=0).max())
    low, high = EXTENT_RANGE_MM
    if not low <= extent <= high:
        raise MeshError(
            f"vertices_mm: got an extent of {extent:g}, expected {low:g} to {high:g} mm; "
            "scale the mesh to millimeters"
        )


def build_mesh(
    vertices_mm: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    shapes: Mapping[str, ArrayLike] | None = None,
) -> Mesh:
    """Return a checked mesh, with angle-weighted normals where none are given.

    Parameters
    ----------
    vertices_mm, faces, uv, normals, shapes
        As the fields of `Mesh`; any real or integer type.

    Returns
    -------
    Mesh
        The same in float32 and int32.

    Raises
    ------
    MeshError
        A field is wrong.
    """
    vertices = np.ascontiguousarray(vertices_mm, np.float32)
    triangles = np.ascontiguousarray(faces, np.int32)
    if vertices.ndim != 2 or triangles.ndim != 2:
        raise MeshError(
            f"mesh: got vertices of shape {vertices.shape} and faces of shape {triangles.shape}, "
            "expected (V, 3) and (F, 3)"
        )
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise MeshError(
            f"faces: got indices {triangles.min()} to {triangles.max()}, "
            f"expected 0 to {len(vertices) - 1}"
        )
    shading = vertex_normals(vertices, triangles) if normals is None else normals
    return Mesh(
        vertices,
        triangles,
        np.ascontiguousarray(uv, np.float32),
        np.ascontiguousarray(shading, np.float32),
        {name: np.ascontiguousarray(deltas, np.float32) for name, deltas in (shapes or {}).items()},
    )


def grid_faces(rows: int, columns: int) -> Int32Array:
    """Return the two triangles of each cell of a grid of vertices, shape (F, 3).

    Parameters
    ----------
    rows, columns
        Vertices along each side; they are numbered row by row.
    """
    at = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    return np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ([a, c, b], [b, c, d])])


def vertex_normals(vertices_mm: ArrayLike, faces: ArrayLike) -> Float32Array:
    """Return unit vertex normals, weighted by the angle of each face at the vertex.

    Vertices at the same position (texture seams) share one normal.

    Parameters
    ----------
    vertices_mm
        Positions in mm, shape (V, 3).
    faces
        Vertex indices, shape (F, 3).

    Returns
    -------
    ndarray
        Unit vectors, shape (V, 3), float32; (0, 0, 1) where no face has an area.

    Examples
    --------
    >>> vertex_normals([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])[0].tolist()
    [0.0, 0.0, 1.0]
    """
    points = np.asarray(vertices_mm, np.float64)
    triangles = np.asarray(faces, np.int64)
    corners = points[triangles]  # (F, 3, 3)
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    cross = np.cross(ahead[:, 0], behind[:, 0])
    area = np.linalg.norm(cross, axis=-1, keepdims=True)
    face_normals = np.divide(cross, area, out=np.zeros_like(cross), where=area > 0.0)
    sine = np.linalg.norm(np.cross(ahead, behind), axis=-1)
    angle = np.arctan2(sine, np.sum(ahead * behind, axis=-1))
    _, shared = np.unique(points.astype(np.float32), axis=0, return_inverse=True)
    total = np.zeros((int(shared.max()) + 1, 3))
    for corner in range(3):
        np.add.at(total, shared[triangles[:, corner]], face_normals * angle[:, corner, None])
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), total.shape)
    unit = np.where(length > 1e-12, total / np.maximum(length, 1e-12), up)
    return np.asarray(unit[shared], np.float32)


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh in millimeters from an .npz or .obj file.

    Parameters
    ----------
    path
        An .npz with arrays ``vertices_mm`` (V, 3), ``faces`` (F, 3) and ``uv`` (V, 2), and, where
        it has blend shapes, ``shape_names`` (S,) and ``shape_deltas_mm`` (S, V, 3); or an .obj with
        texture coordinates whose unit is the millimeter.

    Returns
    -------
    Mesh
        The mesh in the file's frame; see `center_face` to move it to the rig's origin.

    Raises
    ------
    MeshFileError
        The file is missing, damaged or of another kind.
    MeshError
        The mesh in it is wrong.
    """
    path = Path(path)
    if path.suffix == ".npz":
        return _load_npz(path)
    if path.suffix == ".obj":
        return _load_obj(path)
    raise MeshFileError(f"{path}: got suffix {path.suffix!r}, expected .npz or .obj")


def center_face(mesh: Mesh, *, nose_tip_mm: tuple[float, float, float] = (0.0, -8.0, 25.0)) -> Mesh:
    """Translate a face mesh so that the rig's cameras look at its center.

    Parameters
    ----------
    mesh
        A face that looks towards +z; its foremost vertex is taken as the tip of the nose.
    nose_tip_mm
        Target position of that vertex, mm, rig frame.

    Returns
    -------
    Mesh
        The mesh, translated only.
    """
    foremost = mesh.vertices_mm[int(np.argmax(mesh.vertices_mm[:, 2]))]
    shift = np.array(nose_tip_mm, np.float32) - foremost
    return Mesh(mesh.vertices_mm + shift, mesh.faces, mesh.uv, mesh.normals, mesh.shapes)


def _load_npz(path: Path) -> Mesh:
    if path.is_file() and not zipfile.is_zipfile(path):
        # NumPy would treat it as a pickle and suggest allow_pickle=True, which is unsafe
        raise MeshFileError(f"{path}: cannot be read as .npz: expected an archive of arrays")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            missing = {"vertices_mm", "faces", "uv"} - set(arrays.files)
            if missing:
                raise MeshFileError(f"{path}: lacks {', '.join(sorted(missing))}")
            shapes: dict[str, ArrayLike] = {}
            if {"shape_names", "shape_deltas_mm"} <= set(arrays.files):
                names = [str(name) for name in arrays["shape_names"]]
                shapes = dict(zip(names, arrays["shape_deltas_mm"], strict=True))
            return build_mesh(arrays["vertices_mm"], arrays["faces"], arrays["uv"], shapes=shapes)
    except MeshError:
        raise
    except FileNotFoundError as error:
        raise MeshFileError(f"{path}: cannot be read: the file does not exist") from error
    except Exception as error:  # zip, pickle and header errors have no common base
        # NumPy suggests allow_pickle=True for object arrays; never unpickle untrusted files
        pickled = "allow_pickle" in str(error)
        why = "holds objects, expected arrays of numbers" if pickled else error
        raise MeshFileError(f"{path}: cannot be read as .npz: {why}") from error


def _load_obj(path: Path) -> Mesh:
    import trimesh

    try:
        loaded = trimesh.load(path, process=False, force="mesh")
    except Exception as error:  # the reader raises errors of many types
        raise MeshFileError(f"{path}: cannot be read as .obj: {error}") from error
    uv = getattr(loaded.visual, "uv", None)
    if uv is None or len(uv) != len(loaded.vertices):
        raise MeshFileError(f"{path}: has no texture coordinates; export it with UVs")
    return build_mesh(loaded.vertices, loaded.faces, uv)
