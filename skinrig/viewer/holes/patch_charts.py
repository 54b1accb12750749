"""Places in the texture for what closes a mesh's holes, and values there for maps that have none.

The charts of a scan meet the rim of a hole from several sides, so that a patch cannot continue
them: it gets a disc of its own where the texture is empty. Maps that are drawn by the point of the
surface cover it by themselves; those that were measured are painted on.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.viewer.holes import closing as hole_closing
from skinrig.viewer.holes.closing import Patch
from skinrig.viewer.scene import Texture, ViewerScene

GRID_CELLS: Final = 512
"""Side of the grid on which empty places are sought."""
PATCH_MARGIN: Final = 4.0 / 256.0
"""Between a disc and anything else: four texels of a map of 256, so that filters stay clean."""
MIN_RELATIVE_SCALE: Final = 0.25
"""Of the scale of the texture around: coarser than this a patch finds no place."""
MEASURED_TEXTURES: Final = ("albedo_map", "lobe_shares", "translucency", "albedo_traits")
"""Textures that are not drawn by the point of the surface."""


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A disc of the texture that holds a patch.

    Attributes
    ----------
    patch
        What it holds.
    center : ndarray of float64, shape (2,)
        Texture coordinates.
    radius : float
    rim_uv : ndarray of float64, shape (n, 2)
        Where the patch's rim lies in the charts around.
    """

    patch: Patch
    center: Float64Array
    radius: float
    rim_uv: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ClosedMesh:
    """A mesh whose small holes are closed.

    Attributes
    ----------
    mesh
        With the patches; vertices of the mesh before come first.
    charts
        Of the patches.
    left_open_mm
        Lengths of loops that found no place in the texture.
    """

    mesh: Mesh
    charts: tuple[Chart, ...]
    left_open_mm: tuple[float, ...]

    def painted(self, scene: ViewerScene) -> ViewerScene:
        """Return a scene whose measured textures continue into the patches."""
        if not self.charts:
            return scene
        textures: Mapping[str, Texture] = {
            name: self.painted_texture(one) if name in MEASURED_TEXTURES else one
            for name, one in scene.textures.items()
        }
        return dataclasses.replace(scene, textures=textures)

    def painted_texture(self, texture: Texture) -> Texture:
        """Return a texture with the values of the rims continued into the patches."""
        values = texture.values.reshape(-1, *texture.values.shape[-3:]).copy()
        for layer in values:
            for chart in self.charts:
                _paint(layer, chart)
        return dataclasses.replace(texture, values=values.reshape(texture.values.shape))

    def summary(self) -> tuple[tuple[str, str], ...]:
        """Return what the page says of it."""
        rows = {}
        if self.charts:
            lengths = [chart.patch.length_mm for chart in self.charts]
            rows["surface in holes of the scan"] = (
                f"{len(lengths)} {'hole' if len(lengths) == 1 else 'holes'} of "
                f"{min(lengths):.0f} to {max(lengths):.0f} mm around "
                "could not be measured: smooth patches close them, colored from their rims"
            )
        if self.left_open_mm:
            rows["holes that stay open"] = (
                f"the texture has no room for {len(self.left_open_mm)} of up to "
                f"{max(self.left_open_mm):.0f} mm around"
            )
        return tuple(rows.items())


def closed(mesh: Mesh) -> ClosedMesh:
    """Return a scanned mesh with its small holes closed.

    Parameters
    ----------
    mesh
        Without blend shapes.
    """
    patches = hole_closing.patches(mesh.vertices_mm, mesh.faces)
    if not patches or mesh.shapes:
        return ClosedMesh(mesh, (), ())
    taken = unwrap(mesh, GRID_CELLS).covered
    scale = _uv_per_mm(mesh)
    vertices, faces, uv = [mesh.vertices_mm], [mesh.faces], [mesh.uv]
    count = len(mesh.vertices_mm)
    charts: list[Chart] = []
    open_mm: list[float] = []
    for patch in patches:
        whole = np.concatenate([mesh.vertices_mm[patch.rim], patch.inner_mm])
        place = _placed(taken, scale * np.sqrt(_area(whole, patch.faces) / np.pi))
        if place is None:
            open_mm.append(patch.length_mm)
            continue
        center, radius = place
        _take(taken, center, radius)
        charts.append(Chart(patch, center, radius, mesh.uv[patch.rim].astype(np.float64)))
        vertices.append(whole.astype(np.float32))
        faces.append((patch.faces + count).astype(np.int32))
        uv.append((center + radius * patch.disc).astype(np.float32))
        count += len(whole)
    joined = build_mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv))
    return ClosedMesh(joined, tuple(charts), tuple(open_mm))


def _area(points: FloatArray, faces: NDArray[np.integer]) -> float:
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _uv_per_mm(mesh: Mesh) -> float:
    """Return the texture's scale by whole areas."""
    flat = np.concatenate([mesh.uv, np.zeros((len(mesh.uv), 1), np.float32)], axis=1)
    in_texture = _area(flat.astype(np.float64), mesh.faces)
    return float(np.sqrt(in_texture / max(_area(mesh.vertices_mm, mesh.faces), 1e-9)))


def _placed(taken: BoolArray, radius: float) -> tuple[Float64Array, float] | None:
    """Return middle and radius of the emptiest place, smaller where it must be; None: no room."""
    far = ndimage.distance_transform_edt(np.pad(~taken, 1))[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(far)), far.shape)
    most = (float(far[row, column]) - 1.0) / GRID_CELLS - PATCH_MARGIN
    if most < MIN_RELATIVE_SCALE * radius:
        return None
    center = np.array([(column + 0.5) / GRID_CELLS, 1.0 - (row + 0.5) / GRID_CELLS])
    return center, min(radius, most)


def _take(taken: BoolArray, center: Float64Array, radius: float) -> None:
    at = (np.arange(GRID_CELLS) + 0.5) / GRID_CELLS
    far2 = (at[None, :] - center[0]) ** 2 + (1.0 - at[:, None] - center[1]) ** 2
    taken[far2 <= (radius + 1.0 / GRID_CELLS) ** 2] = True


def _paint(layer: Float32Array, chart: Chart) -> None:
    """Draw a patch into a map (H, W, C), row 0 at the top, in place."""
    from scipy.interpolate import LinearNDInterpolator

    height, width, _ = layer.shape
    if min(height, width) < 2:  # one value for the whole face
        return
    rows = (1.0 - chart.rim_uv[:, 1]) * height - 0.5
    columns = chart.rim_uv[:, 0] * width - 0.5
    planes = np.moveaxis(layer, -1, 0)
    at = [rows, columns]
    drawn = [ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in planes]
    rim = np.stack(drawn, axis=-1)
    values = chart.patch.continued(rim.astype(np.float64))
    reach = chart.radius + PATCH_MARGIN
    x0, y0 = chart.center
    j = np.arange(max(int((x0 - reach) * width), 0), min(int((x0 + reach) * width) + 1, width))
    top, bottom = int((1 - y0 - reach) * height), int((1 - y0 + reach) * height) + 1
    i = np.arange(max(top, 0), min(bottom, height))
    x, y = np.meshgrid((j + 0.5) / width - x0, 1.0 - (i + 0.5) / height - y0)
    disc = np.stack([x, y], axis=-1)
    far = np.linalg.norm(disc, axis=-1) / chart.radius
    inside = far * chart.radius <= reach
    # beside the disc what its edge has, for filters
    within = disc / chart.radius / np.maximum(far, 1.0)[..., None]
    # the rim is a polygon within the circle
    polygon = np.concatenate([chart.patch.disc, 1.5 * chart.patch.disc[: len(chart.patch.rim)]])
    both = np.concatenate([values, values[: len(chart.patch.rim)]])
    found = LinearNDInterpolator(polygon, both)(within[inside])
    block = layer[i[0] : i[-1] + 1, j[0] : j[-1] + 1]
    block[inside] = found
