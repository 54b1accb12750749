"""Put a fitted model's maps on a mesh: read meshes, transfer normals, sample values."""

from __future__ import annotations

import dataclasses
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance
from rigsim.geometry.atlas import Atlas, dilate_texture, unwrap
from rigsim.geometry.mesh import Mesh, MeshError, MeshFileError, build_mesh, load_mesh
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.rendering.lookup_kernels import look_up

MESH_FILES: Final = ("mesh.obj", "mesh.ply")
"""File names of the mesh of an appearance's maps."""
MAX_SAME_MESH_MM: Final = 1.0
"""Maximum median distance from the maps' positions for a mesh to be the original one."""
MAX_LAYOUT_DISTANCE_MM: Final = 40.0
"""Maximum median distance from the maps' positions for texture coordinates of the same layout."""
MIN_COVERED_FRACTION: Final = 0.2
"""Minimum fraction of a mesh's texels with values in the maps."""
FRAME_DILATION_STEPS: Final = 4
N_NEAREST_TEXELS: Final = 8
"""Number of nearest texels that replace missing values at a point."""
N_SPARSE_TEXELS: Final = 8_000
"""Number of random texels that replace missing values far from valid texels."""
MIN_BLEND_WEIGHT: Final = 0.01
"""Minimum bilinear weight of the texels around a point that belong to its part of the surface."""


class GeometryError(ValueError):
    """A mesh that is inconsistent with the maps."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePointSamples:
    """Values of the maps at n points."""

    r_d: Float32Array
    """Albedo, shape (n, 3)."""
    weights: Float32Array
    """Weights of the basis BRDFs, shape (n, K)."""
    normals: Float32Array
    """Unit normals in the frame of the mesh, shape (n, 3)."""
    translucency_mm: Float32Array
    """Diffuse mean free path 1/sigma_tr, shape (n, 3)."""
    measured: BoolArray
    """Whether a valid texel is within a texel's width; other points have values of the nearest."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedSurface:
    """A model's maps on a mesh.

    Attributes
    ----------
    model
        Model with tables and maps.
    mesh
        Mesh with the texture coordinates of the maps.
    atlas
        Texture atlas of the mesh.
    normals
        Unit normals of the maps in the frame of the mesh, shape (H, W, 3).
    is_transferred
        Whether the mesh has moved relative to the maps, so that the normals were rotated with it.
    """

    model: SkinReflectance
    mesh: Mesh
    atlas: Atlas
    normals: Float32Array
    is_transferred: bool
    _values: Float32Array
    _known: BoolArray
    """Texels with a surface and valid maps."""
    _width_mm: Float32Array
    _trees: list[tuple[cKDTree, NDArray[np.intp]]] = field(default_factory=list)
    """Search trees of all valid texels, and of a random subset, built on demand."""

    @staticmethod
    def of(model: SkinReflectance, mesh: Mesh, *, rest: Mesh | None = None) -> FittedSurface:
        """Put maps on a mesh.

        Parameters
        ----------
        model
            Model whose maps have one square size.
        mesh
            Mesh with the maps' texture coordinates, original or moved.
        rest
            Original mesh of the maps, required if `mesh` has moved, since normals in object space
            are valid only on the mesh on which they were measured.

        Raises
        ------
        GeometryError
            If the texture coordinates have another layout, or the mesh has moved and `rest` is
            missing.
        """
        height, width = model.valid.shape
        if height != width:
            raise GeometryError(f"maps: got {height} x {width} texels, expected a square texture")
        atlas = unwrap(mesh, width)
        both = atlas.covered & model.valid
        share = float(np.sum(both)) / max(float(np.sum(atlas.covered)), 1.0)
        if share < MIN_COVERED_FRACTION:
            raise GeometryError(
                f"mesh: the maps have values for {100 * share:.0f} % of it, expected at least "
                f"{100 * MIN_COVERED_FRACTION:.0f} %; its texture coordinates are not those of "
                "the maps: export it with the layout of the appearance's own mesh"
            )
        apart = np.linalg.norm(atlas.position_mm[both] - model.position_mm[both], axis=-1)
        median = float(np.median(apart))
        if median > MAX_LAYOUT_DISTANCE_MM:
            raise GeometryError(
                f"mesh: its points are {median:.0f} mm (median) from their positions in the maps, "
                f"expected less than {MAX_LAYOUT_DISTANCE_MM:.0f} mm; its texture coordinates are "
                "not those of the maps, or it is in another frame"
            )
        moved = rest is not None and (
            mesh.vertices_mm.shape != rest.vertices_mm.shape
            or bool(np.abs(mesh.vertices_mm - rest.vertices_mm).max() >= 1e-3)
        )
        if rest is None and median > MAX_SAME_MESH_MM:
            raise GeometryError(
                f"mesh: its points are {median:.1f} mm (median) from their positions in the maps, "
                "expected the original mesh for normals in the rig frame; give that one, too"
            )
        normals = np.asarray(model.normals, np.float32)
        if moved and rest is not None:
            normals = transfer_normals(normals, unwrap(rest, width), atlas)
        depth = np.asarray(model.translucency_mm, np.float32)
        # unknown texels get the median, as subsurface scattering needs a value everywhere
        usual = np.median(depth[model.valid], axis=0)
        layers = [model.r_d, model.weights, normals, np.where(depth > 0.0, depth, usual)]
        values = np.concatenate([np.asarray(layer, np.float32) for layer in layers], axis=-1)
        width = np.maximum(*atlas.texel_mm())
        return FittedSurface(model, mesh, atlas, normals, moved, np.nan_to_num(values), both, width)

    def with_sigma_tr(self, sigma_tr_per_mm: ArrayLike) -> FittedSurface:
        """Return the same surface with a uniform sigma_tr, three channels, 1/mm."""
        depth = (1.0 / np.asarray(sigma_tr_per_mm, np.float64)).astype(np.float32)
        spread_out = np.broadcast_to(depth, self.model.translucency_mm.shape).copy()
        values = self._values.copy()
        values[..., -3:] = depth
        model = dataclasses.replace(
            self.model, translucency_mm=spread_out, translucency_stderr_mm=None
        )
        return dataclasses.replace(self, model=model, _values=values)

    def with_lobes(self, model: SkinReflectance) -> FittedSurface:
        """Return the same surface with basis BRDFs and weights of another model of these maps."""
        layers = [self._values[..., :3], model.weights, self._values[..., -6:]]
        values = np.concatenate(layers, axis=-1)
        own = dataclasses.replace(self.model, lobes=model.lobes, weights=model.weights)
        return dataclasses.replace(self, model=own, _values=values.astype(np.float32))

    def at(
        self, uv: Float32Array, position_mm: Float32Array, normal: Float32Array
    ) -> SurfacePointSamples:
        """Sample the maps at points of the mesh.

        Interpolation is bilinear over valid texels of the same part of the surface. Without any,
        nearby valid texels on the mesh are used, with the mesh's normal. Neighbors in the texture
        could belong to other parts of the face where charts are small.

        Parameters
        ----------
        uv
            Texture coordinates, shape (n, 2), (0, 0) is bottom left.
        position_mm
            Points, shape (n, 3), in the frame of the mesh.
        normal
            Shading normals of the mesh at the points, shape (n, 3).
        """
        point, place = (np.ascontiguousarray(one, np.float32) for one in (position_mm, uv))
        rows = np.zeros((len(uv), self._values.shape[-1]), np.float32)
        share = np.zeros(len(uv), np.float32)
        texels = self._values, self._known, self.atlas.position_mm, self._width_mm
        look_up(*texels, place, point, rows, share)
        lobes = self.model.weights.shape[-1]
        measured = share > MIN_BLEND_WEIGHT
        lost = np.flatnonzero(~measured)
        if len(lost):
            rows[lost], near = self._sample_neighbors(point[lost])
            measured[lost] = near
            far = lost[~near]
            rows[far, 3 + lobes : 6 + lobes] = normal[far]
        r_d, weights, normals, translucency = np.split(rows, (3, 3 + lobes, 6 + lobes), axis=-1)
        return SurfacePointSamples(r_d, weights, normalize_vectors(normals), translucency, measured)

    def _sample_neighbors(self, point: Float32Array) -> tuple[Float32Array, BoolArray]:
        """Return means of valid texels near points, and whether one is within its own width."""
        if not self._trees:
            every = np.flatnonzero(self._known)
            some = np.sort(np.random.default_rng(0).permutation(every)[:N_SPARSE_TEXELS])
            place = self.atlas.position_mm.reshape(-1, 3).astype(np.float64)
            self._trees.extend((cKDTree(place[t]), t) for t in (every, some))
        means, near = self._mean(*self._trees[0], point)
        far = np.flatnonzero(~near)
        if len(far):
            means[far] = self._mean(*self._trees[1], point[far])[0]
        return means, near

    def _mean(
        self, tree: cKDTree, texels: NDArray[np.intp], point: Float32Array
    ) -> tuple[Float32Array, BoolArray]:
        """Return inverse-square means of nearest texels, and whether one is within its width."""
        count = min(N_NEAREST_TEXELS, len(texels))
        distance, index = tree.query(point.astype(np.float64), k=range(1, count + 1))
        found = texels[index]
        weight = 1.0 / np.maximum(distance, 1e-3) ** 2
        weight /= weight.sum(axis=1, keepdims=True)
        values = self._values.reshape(-1, self._values.shape[-1])[found]
        near = distance[:, 0] < self._width_mm.reshape(-1)[found[:, 0]]
        return np.einsum("nk,nkc->nc", weight, values).astype(np.float32), near


def transfer_normals(normals: Float32Array, rest: Atlas, moved: Atlas) -> Float32Array:
    """Transfer normals of relief to a deformed surface.

    Relief keeps its height. A normal is transformed by the inverse transpose of the change of the
    frame of two tangents and the smooth normal, so that stretched skin becomes flatter.

    Parameters
    ----------
    normals
        Unit normals on the undeformed surface, shape (N, N, 3).
    rest, moved
        Atlas before and after the deformation, see `rigsim.geometry.atlas.unwrap`.

    Returns
    -------
    ndarray of float32
        Unit normals, shape (N, N, 3); unchanged where either atlas has no surface.

    Examples
    --------
    >>> from rigsim.geometry.mesh import build_mesh
    >>> faces, uv = [[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0, 1]]
    >>> flat = build_mesh([[0, 0, 0], [9, 0, 0], [9, 9, 0], [0, 9, 0]], faces, uv)
    >>> turned = build_mesh([[0, 0, 0], [0, 0, -9], [0, 9, -9], [0, 9, 0]], faces, uv)
    >>> tilted = np.full((8, 8, 3), (0.6, 0.0, 0.8), np.float32)
    >>> carried = transfer_normals(tilted, unwrap(flat, 8), unwrap(turned, 8))
    >>> carried[4, 4].round(3).tolist()
    [0.800000011920929, 0.0, -0.6000000238418579]
    """
    before, after = _frames(rest), _frames(moved)
    # the normal axis is scaled to the length of the tangents, for well-conditioned frames
    height = np.sqrt(np.linalg.norm(np.cross(before[..., 0, :], before[..., 1, :]), axis=-1))
    for frame in (before, after):
        frame[..., 2, :] *= height[..., None]
    good = (np.abs(np.linalg.det(before)) > 1e-9) & (np.abs(np.linalg.det(after)) > 1e-9)
    whole = good[..., None, None]
    # with frames as rows, x = c B before and x' = c A after: the change is B^-1 A, whose inverse
    # transpose acts on normals (columns) as A^-1 B
    slopes = np.einsum("hwij,hwj->hwi", before, normals.astype(np.float64))
    turned = np.linalg.solve(np.where(whole, after, np.eye(3)), slopes[..., None])[..., 0]
    return np.where(good[..., None], normalize_vectors(turned), normals).astype(np.float32)


def read_own_mesh(appearance: SkinAppearance) -> Mesh:
    """Read the mesh of an appearance's maps.

    Raises
    ------
    GeometryError
        If it has no mesh with texture coordinates.
    """
    for name in MESH_FILES:
        if name in appearance.files:
            return parse_mesh(appearance.files[name], name)
    raise GeometryError(
        f"appearance: {MESH_FILES[0]} is missing; create it by `skinrig reconstruct SESSION --maps "
        "normals,r_d,basis_weight_0`, or give a mesh with --mesh"
    )


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh in mm with texture coordinates: .obj, .ply, or .npz of `rigsim.geometry.mesh`.

    Raises
    ------
    MeshFileError
        If the file is missing, damaged, of another type, or without texture coordinates.
    """
    path = Path(path)
    if path.suffix == ".npz":
        return load_mesh(path)
    if path.suffix not in (".obj", ".ply"):
        raise MeshFileError(f"{path}: got suffix {path.suffix!r}, expected .obj, .ply or .npz")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MeshFileError(f"{path}: {error.strerror}") from error
    return parse_mesh(data, str(path))


def parse_mesh(data: bytes, name: str) -> Mesh:
    """Parse the bytes of an .obj or .ply file; see `read_mesh`."""
    import trimesh

    kind = Path(name).suffix[1:]
    try:
        loaded = trimesh.load(io.BytesIO(data), file_type=kind, process=False, force="mesh")
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
        uv = getattr(loaded.visual, "uv", None)
    except Exception as error:  # the reader raises exceptions of its parsers
        raise MeshFileError(
            f"{name}: not readable as .{kind} ({error}); export it again"
        ) from error
    if uv is None or len(uv) != len(vertices):
        raise MeshFileError(
            f"{name}: got no texture coordinates, expected those of the appearance's own mesh; "
            "export them, too"
        )
    try:
        return build_mesh(vertices, faces, np.clip(uv, *_rounding_margin(np.asarray(uv))))
    except MeshFileError:
        raise
    except MeshError as error:
        raise MeshError(f"{name}: {error}") from error


def normalize_vectors(vectors: ArrayLike) -> Float32Array:
    """Normalize vectors, shape (..., 3), to float32; (0, 0, 1) for zero vectors."""
    given = np.asarray(vectors)
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])
    return np.asarray(np.where(length > 1e-9, given / np.maximum(length, 1e-9), up), np.float32)


def _frames(atlas: Atlas) -> Float64Array:
    """Return the tangents along u and v and the normal, as rows, shape (N, N, 3, 3)."""
    layers = np.concatenate([atlas.dp_du_mm, atlas.dp_dv_mm, atlas.normal], axis=-1)
    wide = dilate_texture(layers, atlas.covered, steps=FRAME_DILATION_STEPS)
    return wide.reshape(atlas.size, atlas.size, 3, 3).astype(np.float64)


def _rounding_margin(uv: FloatArray) -> tuple[float, float]:
    """Return the range within which rounded coordinates are clipped; others remain errors."""
    low, high = float(uv.min()), float(uv.max())
    return (0.0 if low > -1e-5 else low), (1.0 if high < 1.0 + 1e-5 else high)
