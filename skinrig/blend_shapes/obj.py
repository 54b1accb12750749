"""Read blend shapes from OBJ files: a neutral mesh, and one file of the same topology per shape.

Polygons are triangulated as fans. Vertices are split where a texture seam gives them several
texture coordinates. Normals, materials, groups, points, lines and smoothing are ignored.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rigsim.geometry.mesh import MeshFileError
from skinrig.arrays import Float64Array, Int64Array

MeshArrays = tuple[Float64Array, Float64Array, Int64Array, dict[str, Float64Array]]
"""Vertices (V, 3), texture coordinates (V, 2), triangles (F, 3), and shapes by name (V, 3)."""
NEUTRAL = "neutral"
"""Stem of the neutral file of a folder, case-insensitive."""


@dataclass(frozen=True, slots=True)
class ObjMesh:
    """Contents of an OBJ file with its own indices."""

    positions: Float64Array
    texture: Float64Array
    corners: Int64Array
    """Triangles, (F, 3, 2): position and texture index of each corner."""


def read(path: Path) -> MeshArrays:
    """Read a neutral OBJ file and its blend shapes.

    Parameters
    ----------
    path
        A folder with neutral.obj, or the neutral file.

    Returns
    -------
    vertices, uv, faces, deltas
        Shapes (V, 3), (V, 2), (F, 3), and (V, 3) each; in the file's unit.

    Raises
    ------
    MeshFileError
        If the neutral file is missing, a line is invalid, or topologies differ.
    """
    neutral_path = path if path.is_file() else _neutral_of(path)
    neutral = parse(neutral_path)
    others = sorted(p for p in neutral_path.parent.iterdir() if p.suffix.lower() == ".obj")
    pairs, split = np.unique(neutral.corners.reshape(-1, 2), axis=0, return_inverse=True)
    faces = split.reshape(-1, 3).astype(np.int64)
    deltas = {}
    for file in others:
        if file == neutral_path:
            continue
        shape = parse(file)
        if len(shape.positions) != len(neutral.positions):
            raise MeshFileError(
                f"{file}: got {len(shape.positions)} vertices, expected {len(neutral.positions)} "
                f"as in {neutral_path.name}"
            )
        # texture coordinates of shapes are ignored, as exporters may omit or renumber them
        if not np.array_equal(shape.corners[..., 0], neutral.corners[..., 0]):
            raise MeshFileError(
                f"{file}: faces differ from those of {neutral_path.name}; export"
                f" with the same topology"
            )
        deltas[file.stem] = (shape.positions - neutral.positions)[pairs[:, 0]]
    if len(pairs) == 0:
        raise MeshFileError(
            f"{neutral_path}: got no faces, expected triangles or polygons; check the file"
        )
    if pairs[:, 1].min() < 0:
        raise MeshFileError(
            f"{neutral_path}: got faces without texture coordinates, expected f v/vt; export them"
        )
    return neutral.positions[pairs[:, 0]], neutral.texture[pairs[:, 1]], faces, deltas


def _neutral_of(folder: Path) -> Path:
    found = [p for p in folder.iterdir() if p.suffix.lower() == ".obj"]
    named = [p for p in found if p.stem.lower() == NEUTRAL]
    if len(named) != 1:
        raise MeshFileError(
            f"{folder}: got {len(found)} .obj files, {len(named)} of them called {NEUTRAL}.obj, "
            "expected one of that name and one for each shape"
        )
    return named[0]


def parse(path: Path) -> ObjMesh:
    """Read positions, texture coordinates and faces of an OBJ file.

    Parameters
    ----------
    path
        Text file; a backslash at the end of a line continues it.

    Returns
    -------
    ObjMesh
        Texture indices are -1 where a face has none.

    Raises
    ------
    MeshFileError
        If a line is invalid; the message has its number.
    """
    positions: list[tuple[float, ...]] = []
    texture: list[tuple[float, ...]] = []
    corners: list[tuple[tuple[int, int], ...]] = []
    try:
        lines = path.read_text("utf-8", errors="replace").replace("\\\n", " ").splitlines()
    except OSError as error:
        raise MeshFileError(f"{path}: not readable: {error.strerror}") from error
    for number, line in enumerate(lines, 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            if words[0] == "v":
                positions.append(_floats(words[1:4], 3))
            elif words[0] == "vt":
                texture.append(_floats(words[1:3], 2))
            elif words[0] == "f":
                if len(words) < 4:
                    raise ValueError(f"got a face of {len(words) - 1} corners, expected 3 or more")
                fan = [_corner(word, len(positions), len(texture)) for word in words[1:]]
                corners.extend((fan[0], fan[i], fan[i + 1]) for i in range(1, len(fan) - 1))
        except ValueError as error:
            raise MeshFileError(f"{path}, line {number}: {error}") from error
    return ObjMesh(
        np.array(positions, np.float64).reshape(-1, 3),
        np.array(texture, np.float64).reshape(-1, 2),
        np.array(corners, np.int64).reshape(-1, 3, 2),
    )


def _floats(words: list[str], count: int) -> tuple[float, ...]:
    if len(words) != count:
        raise ValueError(f"got {len(words)} numbers, expected {count}")
    values = tuple(float(word) for word in words)
    if not np.isfinite(values).all():
        raise ValueError("got NaN or infinity, expected numbers")
    return values


def _corner(word: str, positions: int, texture: int) -> tuple[int, int]:
    parts = word.split("/")
    found = []
    for text, count, what in zip(parts, (positions, texture), ("vertex", "texture"), strict=False):
        if what == "texture" and text == "":
            continue
        try:
            given = int(text)
        except ValueError:
            raise ValueError(f"got corner {word!r}, expected v, v/vt or v/vt/vn") from None
        index = given - 1 if given > 0 else count + given
        if given == 0 or not 0 <= index < count:
            raise ValueError(f"got {what} {text} of {count} before this line")
        found.append(index)
    return found[0], found[1] if len(found) > 1 else -1
