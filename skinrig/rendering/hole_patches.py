"""Close small holes of a mesh by patches, and fill measured maps there.

Several charts of a scan meet at the rim of a hole, so that a patch cannot extend them. It gets its
own disc in an empty part of the texture. Maps that are functions of the surface point cover it
automatically; measured maps are interpolated from the rim.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from reconstruction.scan.hole_patches import HolePatch, find_patches
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray

GRID_CELLS: Final = 512
"""Side of the grid for the search of empty texture space."""
PATCH_MARGIN: Final = 4.0 / 256.0
"""Minimum distance of a disc from charts: four texels of a map of 256, for texture filters."""
MIN_RELATIVE_SCALE: Final = 0.25
"""Minimum texture scale of a patch relative to its surroundings; below it, the hole stays open."""
MIN_FOLD_COSINE: Final = 0.5
"""Cosine between a triangle's normal and the mean within `FOLD_RINGS` below which it is folded."""
FOLD_RINGS: Final = 3
FOLD_ROUNDS: Final = 8
FOLD_STEPS: Final = 5
"""Number of searches for folds, and steps of smoothing after each; folds that are left stay."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchChart:
    """A disc of the texture for a patch.

    Attributes
    ----------
    patch
        The patch.
    center : ndarray of float64, shape (2,)
        Texture coordinates.
    radius : float
    rim_uv : ndarray of float64, shape (n, 2)
        Texture coordinates of the patch's rim in the surrounding charts.
    """

    patch: HolePatch
    center: Float64Array
    radius: float
    rim_uv: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ClosedMesh:
    """A mesh whose small holes are closed.

    Attributes
    ----------
    mesh
        Mesh with patches; vertices of the original mesh come first.
    charts
        Charts of the patches.
    left_open_mm
        Lengths of loops without space in the texture.
    """

    mesh: Mesh
    charts: tuple[PatchChart, ...]
    open_loops_mm: tuple[float, ...]

    def paint(self, values: FloatArray) -> Float32Array:
        """Return values, (..., H, W, C) or (H, W), with patches interpolated from their rims.

        Row 0 is at v = 1. The rims' texels must have values.
        """
        layers = np.array(values if values.ndim > 2 else values[..., None], np.float32)
        for layer in layers.reshape(-1, *layers.shape[-3:]):
            for chart in self.charts:
                _paint(layer, chart)
        return layers.reshape(values.shape)

    def added(self) -> tuple[tuple[str, str], ...]:
        """Return the surface that was not measured, with its source."""
        if not self.charts:
            return ()
        lengths = [chart.patch.length_mm for chart in self.charts]
        text = (
            f"{len(lengths)} {'hole' if len(lengths) == 1 else 'holes'} of "
            f"{min(lengths):.0f} to {max(lengths):.0f} mm circumference "
            "not measured; closed by smooth patches with colors of their rims"
        )
        return (("surface in holes of the scan", text),)

    def omitted(self) -> tuple[tuple[str, str], ...]:
        """Return the holes that stay open, with reasons."""
        if not self.open_loops_mm:
            return ()
        text = (
            f"the texture has no space for {len(self.open_loops_mm)} of up to "
            f"{max(self.open_loops_mm):.0f} mm circumference"
        )
        return (("open holes", text),)

    def summary(self) -> tuple[tuple[str, str], ...]:
        """Return what was not measured in holes, closed or open."""
        return (*self.added(), *self.omitted())


def close_holes(mesh: Mesh) -> ClosedMesh:
    """Close the small holes of a scanned mesh.

    Parameters
    ----------
    mesh
        Mesh without blend shapes.
    """
    found = find_patches(mesh.vertices_mm, mesh.faces)
    if not found or mesh.shapes:
        return ClosedMesh(mesh, (), ())
    taken = unwrap(mesh, GRID_CELLS).covered
    flat = np.pad(mesh.uv.astype(np.float64), ((0, 0), (0, 1)))
    surface = max(_area(mesh.vertices_mm, mesh.faces), 1e-9)
    scale = float(
        np.sqrt(_area(flat, mesh.faces) / surface)
    )  # texture units per mm, from total areas
    vertices, faces, uv = [mesh.vertices_mm], [mesh.faces], [mesh.uv]
    count = len(mesh.vertices_mm)
    charts: list[PatchChart] = []
    open_mm: list[float] = []
    for patch in found:
        whole = np.concatenate([mesh.vertices_mm[patch.rim], patch.inner_mm])
        place = place_disc(taken, scale * np.sqrt(_area(whole, patch.faces) / np.pi))
        if place is None:
            open_mm.append(patch.length_mm)
            continue
        center, radius = place
        _take(taken, center, radius)
        charts.append(PatchChart(patch, center, radius, mesh.uv[patch.rim].astype(np.float64)))
        vertices.append(whole.astype(np.float32))
        faces.append((patch.faces + count).astype(np.int32))
        uv.append((center + radius * patch.disc).astype(np.float32))
        count += len(whole)
    joined = build_mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv))
    return ClosedMesh(joined, tuple(charts), tuple(open_mm))


def smooth_folds(mesh: Mesh) -> Mesh:
    """Return a mesh without folded triangles, which shadow each other and have false normals.

    Their vertices, and no others, move to the mean of their neighbors. Texture coordinates stay.

    Parameters
    ----------
    mesh
        Mesh without blend shapes.
    """
    points = mesh.vertices_mm.astype(np.float64)
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    same = first[place.reshape(-1)]
    joined, total = same[mesh.faces], len(points)
    number = np.repeat(np.arange(len(joined)), 3)
    corner = sparse.csr_matrix((np.ones(len(number)), (joined.reshape(-1), number)))
    corner.resize(total, len(joined))
    near = corner @ corner.T
    near.setdiag(0.0)
    near.data[:] = near.data > 0.0
    for _ in range(FOLD_ROUNDS):
        a, b, c = (points[joined[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        around = normals
        for _ in range(FOLD_RINGS):
            around = corner.T @ (corner @ around)
        cosine = np.einsum("fk,fk->f", normals, around)
        length = np.linalg.norm(normals, axis=1) * np.linalg.norm(around, axis=1)
        rows = np.unique(joined[cosine < MIN_FOLD_COSINE * length])
        for _ in range(FOLD_STEPS if len(rows) else 0):
            points[rows] = (near[rows] @ points) / near[rows].sum(axis=1)
    same_place = np.array_equal(points, mesh.vertices_mm)
    return mesh if same_place else build_mesh(points[same], mesh.faces, mesh.uv)


def _area(points: FloatArray, faces: NDArray[np.integer]) -> float:
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def place_disc(
    taken: BoolArray, radius: float, *, min_scale: float = MIN_RELATIVE_SCALE
) -> tuple[Float64Array, float] | None:
    """Return center and radius of the largest empty disc, reduced if necessary; None: no space.

    Parameters
    ----------
    taken
        Occupied cells of the texture, shape (`GRID_CELLS`, `GRID_CELLS`).
    radius
        Radius to place, texture units.
    min_scale
        Least radius to accept, over the one to place.
    """
    far = ndimage.distance_transform_edt(np.pad(~taken, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(far)), far.shape)
    most = (float(far[row, column]) - 1.0) / GRID_CELLS - PATCH_MARGIN
    if most < min_scale * radius:
        return None
    center = np.array([(column + 0.5) / GRID_CELLS, 1.0 - (row + 0.5) / GRID_CELLS])
    return center, min(radius, most)


def _take(taken: BoolArray, center: Float64Array, radius: float) -> None:
    at = (np.arange(GRID_CELLS) + 0.5) / GRID_CELLS
    far2 = (at[None, :] - center[0]) ** 2 + (1.0 - at[:, None] - center[1]) ** 2
    taken[far2 <= (radius + 1.0 / GRID_CELLS) ** 2] = True


def _paint(layer: Float32Array, chart: PatchChart) -> None:
    """Draw a patch into a map (H, W, C), row 0 at the top, in place."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    height, width, _ = layer.shape
    if min(height, width) < 2:  # one value for the whole face
        return
    rows = (1.0 - chart.rim_uv[:, 1]) * height - 0.5
    columns = chart.rim_uv[:, 0] * width - 0.5
    planes = np.moveaxis(layer, -1, 0)
    at = [rows, columns]
    drawn = [ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in planes]
    rim = np.stack(drawn, axis=-1)
    values = chart.patch.interpolate_from_rim(rim.astype(np.float64))
    reach = chart.radius + PATCH_MARGIN
    x0, y0 = chart.center
    j = np.arange(max(int((x0 - reach) * width), 0), min(int((x0 + reach) * width) + 1, width))
    top, bottom = int((1 - y0 - reach) * height), int((1 - y0 + reach) * height) + 1
    i = np.arange(max(top, 0), min(bottom, height))
    x, y = np.meshgrid((j + 0.5) / width - x0, 1.0 - (i + 0.5) / height - y0)
    disc = np.stack([x, y], axis=-1)
    far = np.linalg.norm(disc, axis=-1) / chart.radius
    inside = far * chart.radius <= reach
    # outside of the disc, values of its edge, for texture filters
    within = disc / chart.radius / np.maximum(far, 1.0)[..., None]
    # the rim is a polygon within the circle
    polygon = np.concatenate([chart.patch.disc, 1.5 * chart.patch.disc[: len(chart.patch.rim)]])
    both = np.concatenate([values, values[: len(chart.patch.rim)]])
    found = LinearNDInterpolator(polygon, both)(within[inside])
    # the polygon of three or four vertices ends within the circle
    beyond = np.isnan(found).any(axis=-1)
    if beyond.any():
        found[beyond] = NearestNDInterpolator(polygon, both)(within[inside][beyond])
    block = layer[i[0] : i[-1] + 1, j[0] : j[-1] + 1]
    block[inside] = found
