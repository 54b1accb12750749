"""Read meshes whose texture coordinates span several UDIM tiles.

Maps cover tile 1001: u and v from 0 to 1. Parts of a head, such as its back or teeth, may be on
other tiles. Their faces keep their coordinates; only faces on the first tile get maps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigsim.geometry.mesh import Mesh, build_mesh, vertex_normals
from skinrig.arrays import Float32Array, FloatArray, Int32Array
from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.exporting.options import FIRST_TILE, ExportError
from skinrig.rendering.geometry import read_mesh

TILES_PER_ROW: Final = 10
"""Number of tiles per row."""
UV_ROUNDING: Final = 1e-5
"""Tolerance of texture coordinates on a tile's border."""


@dataclass(frozen=True, slots=True, eq=False)
class TiledMesh:
    """A mesh with texture coordinates on any UDIM tiles.

    Attributes
    ----------
    vertices_mm, faces, uv, normals, shapes
        As in :class:`rigsim.geometry.mesh.Mesh`; texture coordinates of any tile.
    tile
        UDIM tile of each face, (F,).
    """

    vertices_mm: Float32Array
    faces: Int32Array
    uv: Float32Array
    normals: Float32Array
    tile: NDArray[np.intp]
    shapes: Mapping[str, Float32Array] = field(default_factory=dict)

    @staticmethod
    def of(mesh: Mesh) -> TiledMesh:
        """Wrap a mesh whose texture is on the first tile."""
        tile = np.full(len(mesh.faces), FIRST_TILE, np.intp)
        return TiledMesh(
            mesh.vertices_mm, mesh.faces, mesh.uv, mesh.normals, tile, dict(mesh.shapes)
        )

    @property
    def tiles(self) -> tuple[int, ...]:
        """Tiles of the mesh; the first tile is always included, and first."""
        return (FIRST_TILE, *sorted(set(self.tile.tolist()) - {FIRST_TILE}))

    def first(self) -> Mesh:
        """Return the faces of the first tile.

        Raises
        ------
        ExportError
            If the mesh has no face there.
        """
        faces = self.faces[self.tile == FIRST_TILE]
        if not len(faces):
            raise ExportError(
                f"--mesh: got faces on tiles {', '.join(map(str, self.tiles[1:]))}, expected some "
                f"on {FIRST_TILE}, the tile of the maps; move its texture coordinates"
            )
        used, flat = np.unique(faces, return_inverse=True)
        return build_mesh(
            self.vertices_mm[used],
            flat.reshape(-1, 3),
            np.clip(self.uv[used], 0.0, 1.0),
            self.normals[used],
            shapes={n: moved[used] for n, moved in self.shapes.items()},
        )


def find_tiles(uv: FloatArray, faces: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the UDIM tile of each face.

    Parameters
    ----------
    uv
        (V, 2); u from 0 to 10, v from 0.
    faces
        (F, 3).

    Raises
    ------
    ExportError
        If a face crosses a border of tiles, or coordinates are outside of all tiles.

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 0.0], [1.0, 2.0]])
    >>> find_tiles(corners, np.array([[0, 1, 2], [1, 3, 2]])).tolist()
    [1001, 1002]
    """
    corners = np.asarray(uv, np.float64)[faces]
    cell = np.floor(corners.mean(axis=1))
    inside = (corners >= cell[:, None] - UV_ROUNDING) & (
        corners <= cell[:, None] + 1.0 + UV_ROUNDING
    )
    across = np.flatnonzero(~inside.all(axis=(1, 2)))
    if len(across):
        low, high = corners[across[0]].min(axis=0), corners[across[0]].max(axis=0)
        raise ExportError(
            f"--mesh: face {across[0]} extends from {low.round(3).tolist()} to "
            f"{high.round(3).tolist()} of the texture, expected each face on one UDIM tile; cut "
            "its texture along the tiles' borders"
        )
    if len(cell) and (cell.min() < 0.0 or cell[:, 0].max() >= TILES_PER_ROW):
        raise ExportError(
            f"--mesh: texture coordinates {corners.min():.3g} to {corners.max():.3g}, expected u "
            f"from 0 to {TILES_PER_ROW} and v from 0, as UDIM tiles are numbered"
        )
    return np.asarray(FIRST_TILE + cell[:, 0] + TILES_PER_ROW * cell[:, 1], np.intp)


def read(path: Path) -> TiledMesh:
    """Read a mesh in mm, or a .gltf or .glb in m, with texture coordinates over any tiles.

    Raises
    ------
    rigsim.geometry.mesh.MeshError, rigsim.geometry.mesh.MeshError
        If the file is missing or damaged, or lacks texture coordinates.
    ExportError
        See `find_tiles`.
    """
    vertices, faces, uv, shapes = _contents(path)
    if uv.min() >= -UV_ROUNDING and uv.max() <= 1.0 + UV_ROUNDING:
        inside = np.clip(uv, 0.0, 1.0)
        return TiledMesh.of(build_mesh(vertices, faces, inside, shapes=shapes))
    # the checks of a mesh require coordinates in 0 to 1: they run on a scaled copy
    lowest, span = float(uv.min()), max(float(np.ptp(uv)), 1.0)
    checked = build_mesh(vertices, faces, (uv - lowest) / (2.0 * span), shapes=shapes)
    points, corners = checked.vertices_mm, checked.faces
    normals, tiles = vertex_normals(points, corners), find_tiles(uv, corners)
    wide = np.asarray(uv, np.float32)
    return TiledMesh(points, corners, wide, normals, tiles, dict(checked.shapes))


Contents = tuple[FloatArray, NDArray[np.integer], FloatArray, dict[str, FloatArray]]


def _contents(path: Path) -> Contents:
    """Return vertices, faces, texture coordinates and blend shapes of a file, in its unit."""
    if path.is_dir() or path.suffix.lower() in (".gltf", ".glb"):
        read = blend_shapes.load(path)
        return read.vertices_mm, read.faces, read.uv, dict(read.shapes)
    try:
        mesh = read_mesh(path)
    except ValueError as error:
        # only texture coordinates over several tiles are accepted here
        if "uv: got" not in str(error):
            raise
        return _read_tiles(path)
    return mesh.vertices_mm, mesh.faces, mesh.uv, dict(mesh.shapes)


def _read_tiles(path: Path) -> Contents:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            shapes = {}
            if {"shape_names", "shape_deltas_mm"} <= set(arrays.files):
                names = [str(name) for name in arrays["shape_names"]]
                shapes = dict(zip(names, arrays["shape_deltas_mm"], strict=True))
            return arrays["vertices_mm"], arrays["faces"], arrays["uv"], shapes
    import trimesh

    loaded = trimesh.load(path, process=False, force="mesh")
    uv = np.asarray(loaded.visual.uv, np.float64)
    return np.asarray(loaded.vertices), np.asarray(loaded.faces), uv, {}
