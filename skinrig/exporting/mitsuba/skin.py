"""Write simulated skin for Mitsuba: its mesh, the maps of its reflection, and its material."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from model.skin import SkinAppearance
from rigsim.geometry.atlas import Atlas, dilate_texture, unwrap
from rigsim.geometry.mesh import Mesh
from rigsim.light.surface_brdf import ETA_OIL, OIL_SMOOTHING
from rigsim.mitsuba.scene_radiance import plastic_scale
from rigsim.scenes.gradient.rendering import ReliefGrid
from rigsim.tissue.skin_layers import ETA
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.exporting.images import write_channels
from skinrig.exporting.mitsuba.elements import Element, build_plugin, build_property, build_texture

MESH_FILE: Final = "face.ply"
TEXTURES_FOLDER: Final = "textures"
SKIN_ID: Final = "skin"
BLEND_PARTS: Final = 2.0
"""Materials that a blend of weight 1/2 averages: each has twice its strength, so that they add."""
POLARIZED_PARTS: Final = 2.0
"""Transmittance of the parallel analyzer for specular over that for diffuse light."""
COATING_PROPERTIES: Final[Mapping[str, str]] = {
    "film": "film",
    "film_alpha": "film_alpha",
    "film_ior": "film_eta",
    "powder": "powder",
}
"""Maps of a coating by the property of `skincoat` that reads them."""
SKIN_PROPERTIES: Final[Mapping[str, str]] = {
    "r_d": "r_d",
    "alpha": "roughness",
    "oil": "oil",
    "vellus": "fuzz",
    "bare": "bare",
    "normals": "normals",
}
"""Maps of bare skin by the property of `skincoat` that reads them."""


def write_skin(truth: SkinAppearance, mesh: Mesh, folder: Path) -> tuple[str, ...]:
    """Write the mesh and the maps of a face as PLY and linear float EXR.

    Parameters
    ----------
    truth
        Ground truth of a dome session; its maps are on the mesh's texture.
    mesh
        Mesh of the face, mm, rig frame.
    folder
        Existing folder.

    Returns
    -------
    tuple of str
        Names of the maps, each in ``textures/NAME.exr``; row 0 is v = 1.
    """
    return write_maps(_surface_maps(truth), mesh, folder)


def write_maps(
    maps: Mapping[str, Float32Array],
    mesh: Mesh | ReliefGrid,
    folder: Path,
    *,
    specular_parts: float = 1.0,
) -> tuple[str, ...]:
    """Write a mesh and the maps on it, with those that Mitsuba's own materials need.

    Parameters
    ----------
    maps
        Maps by name, shape (N, N[, 3]).
    mesh
        The mesh, mm, rig frame. A relief has the skin's normals itself, and its maps, of shape
        (H, W[, 3]), cover its whole texture.
    folder
        Existing folder.
    specular_parts
        Factor of the specular reflection of the stock material.

    Returns
    -------
    tuple of str
        As of `write_skin`.
    """
    (folder / MESH_FILE).write_bytes(encode_ply(mesh))
    (folder / TEXTURES_FOLDER).mkdir()
    maps = {
        **maps,
        "stock_diffuse": np.float32(BLEND_PARTS * plastic_scale(ETA)) * maps["r_d"],
        "stock_specular": np.float32(BLEND_PARTS * specular_parts) * maps["bare"],
    }
    covered = None
    if "oil" in maps:
        maps["stock_oil_roughness"] = np.float32(OIL_SMOOTHING) * maps["roughness"]
    if isinstance(mesh, Mesh):
        atlas = unwrap(mesh, len(maps["r_d"]))
        tangent = rotate_to_triangles(atlas, mesh, maps["normals"])
        maps["stock_normals"] = np.float32(0.5) * (tangent + np.float32(1.0))
        covered = atlas.covered
    for name, values in maps.items():
        filled = values if covered is None else _fill(values, covered)
        channels = {"Y" if filled.ndim == 2 else "RGB": filled}
        about = {"unit": "1", "colorSpace": "raw", "comments": _COMMENTS.get(name, "")}
        write_channels(folder / TEXTURES_FOLDER / f"{name}.exr", channels, about)
    return tuple(maps)


_COMMENTS: Final = {
    "r_d": "factor of the diffuse term, camera RGB over white",
    "normals": "unit normals with relief, rig frame",
    "fuzz": "optical depth of vellus hair",
    "bare": "fraction not behind hair; scales specular reflection",
    "stock_normals": "(n + 1) / 2, frame of each triangle of face.ply: +x along u, +z normal",
}


def _surface_maps(truth: SkinAppearance) -> dict[str, Float32Array]:
    """Return the maps of the surface by name, as float32; without hair everything is bare."""
    names = [name for name in SKIN_PROPERTIES.values() if name != "bare"]
    names += [name for name in COATING_PROPERTIES.values() if name in truth.maps]
    maps = {name: np.asarray(truth.maps[name].values, np.float32) for name in names}
    hair = truth.maps["hair"].values if "hair" in truth.maps else np.zeros_like(maps["oil"])
    maps["bare"] = np.asarray(1.0 - hair, np.float32)
    return maps


def _fill(values: Float32Array, covered: BoolArray) -> Float32Array:
    """Return a map whose border is filled from its neighbors, and the rest by its mean."""
    known = dilate_texture(np.ones(covered.shape, np.float32), covered) > 0.0
    filled = dilate_texture(values, covered)
    filled[~known] = values[covered].mean(axis=0)
    return filled


def rotate_to_triangles(atlas: Atlas, mesh: Mesh, normals: FloatArray) -> Float32Array:
    """Rotate normals to the frames that a renderer derives from each triangle.

    The frame's z is the mesh's interpolated normal, and x the derivative of position along u. It is
    constant on a triangle, unlike in frames that are averaged at vertices.

    Parameters
    ----------
    atlas
        Surface under each texel.
    mesh
        Its mesh.
    normals
        Unit normals, shape (N, N, 3), rig frame.

    Returns
    -------
    ndarray of float32
        Unit normals, shape (N, N, 3); (0, 0, 1) where the texture has no surface.

    Examples
    --------
    >>> from rigsim.geometry.mesh import build_mesh
    >>> faces, uv = [[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0, 1]]
    >>> wall = build_mesh([[0, 0, 0], [0, 0, -9], [0, 9, -9], [0, 9, 0]], faces, uv)
    >>> tilted = np.full((8, 8, 3), (0.8, 0.0, 0.6), np.float32)
    >>> rotate_to_triangles(unwrap(wall, 8), wall, tilted)[4, 4].round(3).tolist()
    [-0.6000000238418579, 0.0, 0.800000011920929]
    """
    corners = mesh.vertices_mm[mesh.faces].astype(np.float64)
    uv = mesh.uv[mesh.faces].astype(np.float64)
    (du1, dv1), (du2, dv2) = ((uv[:, k] - uv[:, 0]).T for k in (1, 2))
    edges = [corners[:, k] - corners[:, 0] for k in (1, 2)]
    area = du1 * dv2 - dv1 * du2
    # the sign matters and the length does not: a mirrored chart has a negative area
    along_u = np.sign(area)[:, None] * (dv2[:, None] * edges[0] - dv1[:, None] * edges[1])
    up = atlas.normal.astype(np.float64)
    x = along_u[np.maximum(atlas.prim, 0)]
    x = x - np.sum(x * up, axis=-1, keepdims=True) * up
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    x = x / np.maximum(length, 1e-300)
    axes = (x, np.cross(up, x), up)
    turned = np.stack([np.sum(axis * normals, axis=-1) for axis in axes], axis=-1)
    turned[~atlas.covered | (length[..., 0] <= 0.0)] = (0.0, 0.0, 1.0)
    return np.asarray(turned / np.linalg.norm(turned, axis=-1, keepdims=True), np.float32)


def encode_ply(mesh: Mesh | ReliefGrid) -> bytes:
    """Return a mesh as the bytes of a binary PLY with normals and texture coordinates u, v.

    Examples
    --------
    >>> from rigsim.geometry.mesh import build_mesh
    >>> one = build_mesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2]], [[0, 0], [1, 0], [0, 1]])
    >>> len(encode_ply(one)) - encode_ply(one).index(b"end_header") - len("end_header;") - 13
    96
    """
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    rows = np.column_stack([mesh.vertices_mm, mesh.normals, mesh.uv])
    corners = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", (3,))])
    corners["count"] = 3
    corners["index"] = mesh.faces
    lines = (
        "ply",
        "format binary_little_endian 1.0",
        "comment unit: mm; u, v: (0, 0) is bottom left",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        f"element face {len(corners)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    )
    header = "\n".join(lines).encode("ascii")
    return header + np.ascontiguousarray(rows, "<f4").tobytes() + corners.tobytes()


def describe_face(material: Element) -> list[Element]:
    """Return a material and the shape of the face that refers to it."""
    material.set("id", SKIN_ID)
    shape = build_plugin(
        "shape",
        "ply",
        build_property("filename", MESH_FILE),
        build_property("flip_tex_coords", True),  # the renderer's v runs down the rows
        Element("ref", {"id": SKIN_ID}),
        id="face",
    )
    return [material, shape]


def _read(name: str, file: str) -> Element:
    return build_texture(name, f"{TEXTURES_FOLDER}/{file}.exr")


def describe_skin_coat(maps: Collection[str], *, is_ggx: bool = False) -> Element:
    """Return the skin as the plugin `skincoat`.

    Parameters
    ----------
    maps
        Names of the written maps; those of a coating are optional.
    is_ggx
        Whether the skin's facets are GGX, otherwise Beckmann.
    """
    properties = {**SKIN_PROPERTIES, **COATING_PROPERTIES}
    read = [_read(name, file) for name, file in properties.items() if file in maps]
    kind = build_property("distribution", "ggx" if is_ggx else "beckmann")
    return build_plugin("bsdf", "skincoat", kind, *read)


def describe_stock_skin() -> Element:
    """Return the skin as a blend of Mitsuba's own materials, without vellus hair and coating."""
    facets = build_plugin(
        "bsdf",
        "blendbsdf",
        _read("weight", "oil"),
        _describe_facets("beckmann", ETA, "roughness"),
        _describe_facets("ggx", ETA_OIL, "stock_oil_roughness"),
    )
    return _add_interior(facets, has_normals=True)


def describe_polarized_skin(polarizer: str, has_normals: bool) -> Element:
    """Return skin behind an analyzer by Mitsuba's own materials, without polarization.

    Parameters
    ----------
    polarizer
        "parallel", or "crossed", without specular reflection.
    has_normals
        Whether a map has the skin's normals.
    """
    facets = _describe_facets("ggx", ETA, "roughness")
    if polarizer == "crossed":
        facets = build_plugin("bsdf", "diffuse", build_property("reflectance", (0.0, 0.0, 0.0)))
    return _add_interior(facets, has_normals=has_normals)


def _add_interior(facets: Element, *, has_normals: bool) -> Element:
    """Return facets over a diffuse interior, each at its full strength."""
    interior = build_plugin(
        "bsdf",
        "plastic",
        build_property("int_ior", float(ETA)),
        build_property("ext_ior", 1.0),
        build_property("specular_reflectance", 0.0),
        _read("diffuse_reflectance", "stock_diffuse"),
    )
    weight = build_property("weight", 1.0 / BLEND_PARTS)
    blend = build_plugin("bsdf", "blendbsdf", weight, interior, facets)
    if not has_normals:
        return blend
    return build_plugin("bsdf", "normalmap", _read("normalmap", "stock_normals"), blend)


def _describe_facets(distribution: str, eta: float, roughness: str) -> Element:
    """Return facets of a dielectric: those of a metal without absorption."""
    return build_plugin(
        "bsdf",
        "roughconductor",
        build_property("distribution", distribution),
        build_property("eta", float(eta)),
        build_property("k", 0.0),
        _read("alpha", roughness),
        _read("specular_reflectance", "stock_specular"),
    )
