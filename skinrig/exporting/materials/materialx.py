"""Materials as MaterialX text: an OpenPBR surface, and image nodes that state color spaces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from model.skin import SkinAppearance
from skinrig.exporting.images import Image, ImageFolder
from skinrig.exporting.materials import obj
from skinrig.exporting.materials.material import COLOR_NOTE, MAP_NOTES, Material
from skinrig.exporting.options import (
    FIRST_TILE,
    M_PER_MM,
    NORMAL_Y,
    TILE_SEPARATORS,
    UNITS_M,
    Delivery,
)
from skinrig.exporting.provenance import IMAGE_ORIENTATION, provenance
from skinrig.exporting.sealing import write_json

MATERIALX_VERSION: Final = "1.39"
MATERIALX_FILE, DOCUMENT_FILE = "skin.mtlx", "material.json"
SCHEMA: Final = "skinrig.export.material/1"
TEXTURE_FOLDER: Final = "textures"
LINEAR_SRGB_NAME: Final = "lin_rec709"
"""MaterialX's name of linear sRGB; data get no color space."""


def write(appearance: SkinAppearance, folder: Path, delivery: Delivery) -> list[tuple[str, str]]:
    """Write an OpenPBR material with its textures and the mesh.

    Parameters
    ----------
    appearance
        Of a dome, or a fitted model.
    folder
        Existing, empty.
    delivery
        Scene unit (m by default), names of tiles, green of the normal map, another mesh.

    Returns
    -------
    list of (str, str)
        What was left out, and why: maps of other tiles than the first.

    Raises
    ------
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    material = Material.of(appearance, delivery.mesh)
    left_out = material.left_out_of_mesh(delivery)
    unit = delivery.unit_or("m")
    out = ImageFolder(folder, delivery, tiles=material.tiles)
    scale = write_textures(material, out)
    if delivery.with_errors:
        for image in material.error_images():
            out.exr(image, TEXTURE_FOLDER)
    (folder / MATERIALX_FILE).write_text(
        openpbr_document(material, scale, delivery), encoding="utf-8"
    )
    per_mm = M_PER_MM / UNITS_M[unit]
    (folder / "skin.obj").write_text(obj.text(material.mesh, per_mm, unit), encoding="utf-8")
    write_json(
        folder / DOCUMENT_FILE,
        {
            **facts(material, appearance, schema=SCHEMA, unit=unit, per_mm=per_mm, scale=scale),
            "files": dict(sorted(out.records.items())),
        },
    )
    return left_out


def write_textures(material: Material, out: ImageFolder) -> float:
    """Write the textures that `openpbr_document` names; return the largest radius, mm."""
    for name in ("base_color", "specular_roughness", "specular_weight", "translucency"):
        out.exr(material.image(name, out.delivery), TEXTURE_FOLDER)
    out.png(material.image("base_color", out.delivery), TEXTURE_FOLDER)
    out.png(material.image("normal", out.delivery), TEXTURE_FOLDER)
    radius = material.radius_mm
    shown = radius[material.covered] if material.covered.any() else radius
    scale = float(shown.max())
    out.exr(
        Image(
            name="subsurface_radius_scale",
            values=np.clip(radius / scale, 0.0, 1.0),
            unit="1",
            what=f"{MAP_NOTES['subsurface_radius']}; over {scale:.9g} mm, the largest",
            valid=material.valid,
        ),
        TEXTURE_FOLDER,
    )
    return scale


def facts(
    material: Material,
    appearance: SkinAppearance,
    *,
    schema: str,
    unit: str,
    per_mm: float,
    scale: float,
) -> dict[str, Any]:
    """Return what a document beside an exported material says of it.

    Parameters
    ----------
    material, appearance
        What is exported, and what it was made of.
    schema
        Of the document.
    unit, per_mm
        The scene's unit, and how many of it a millimeter has.
    scale
        Radius of subsurface scattering, mm.
    """
    return {
        **provenance(appearance),
        "schema": schema,
        "scene_unit": unit,
        "mm_per_scene_unit": 1.0 / per_mm,
        "orientation": IMAGE_ORIENTATION,
        "udim": {"tiles": list(material.tiles), "measured": [material.tiles[0]]},
        "frame": "+x right, +y up, +z towards the main camera",
        "base_color": f"{MAP_NOTES['base_color']}; {COLOR_NOTE}",
        "subsurface": {
            **material.sigma_tr(),
            "radius_in_scene_units": scale * per_mm,
            "mapping": MAP_NOTES["subsurface_radius"],
        },
        "specular_ior": material.eta,
        "figures": material.figures(),
        "assumed": material.all_assumed(appearance),
    }


def openpbr_document(material: Material, radius_mm: float, delivery: Delivery) -> str:
    """Return a material whose textures lie in `TEXTURE_FOLDER`.

    Parameters
    ----------
    material
        What it is of.
    radius_mm
        Subsurface radius that the texture of radius scales is a share of.
    delivery
        Scene unit, names of tiles, green of the normal map.
    """
    unit = delivery.unit_or("m")
    per_mm = M_PER_MM / UNITS_M[unit]
    root = _root(
        f"Skin for OpenPBR. Scene unit: {unit}. Source: {material.source}. "
        f"Normals: {'+Y' if NORMAL_Y[delivery.normal_y] > 0 else '-Y'}."
    )
    graph = ElementTree.SubElement(root, "nodegraph", name="NG_skin")
    colors = ("base_color", "subsurface_radius_scale")
    for name in (*colors, "specular_roughness", "specular_weight"):
        kind = "color3" if name in colors else "float"
        _image(
            graph,
            name,
            kind,
            f"{TEXTURE_FOLDER}/{delivery.referred(name, 'exr')}",
            LINEAR_SRGB_NAME if name == "base_color" else None,
        )
        ElementTree.SubElement(graph, "output", name=f"{name}_out", type=kind, nodename=name)
    _normal_nodes(graph, f"{TEXTURE_FOLDER}/{delivery.referred('normal', 'png')}", delivery)
    shader = ElementTree.SubElement(
        root, "open_pbr_surface", name="SR_skin", type="surfaceshader", version="1.1.1"
    )

    def linked(name: str, kind: str, output: str) -> None:
        ElementTree.SubElement(
            shader, "input", name=name, type=kind, nodegraph="NG_skin", output=f"{output}_out"
        )

    def fixed(name: str, value: float) -> None:
        ElementTree.SubElement(shader, "input", name=name, type="float", value=f"{value:.9g}")

    linked("base_color", "color3", "base_color")
    linked("specular_weight", "float", "specular_weight")
    linked("specular_roughness", "float", "specular_roughness")
    fixed("specular_ior", material.eta)
    fixed("subsurface_weight", 1.0)
    linked("subsurface_color", "color3", "base_color")
    fixed("subsurface_radius", radius_mm * per_mm)
    linked("subsurface_radius_scale", "color3", "subsurface_radius_scale")
    fixed("subsurface_scatter_anisotropy", 0.0)
    linked("geometry_normal", "vector3", "normal")
    surface = ElementTree.SubElement(root, "surfacematerial", name="Skin", type="material")
    ElementTree.SubElement(
        surface, "input", name="surfaceshader", type="surfaceshader", nodename="SR_skin"
    )
    return _text(root)


def images_document(
    files: Mapping[str, tuple[str, str]], delivery: Delivery, *, tangent_normal: str | None
) -> str:
    """Return a node graph with an image node a map, so that a reader knows its color space.

    Parameters
    ----------
    files
        Map to file and MaterialX type; "color3" is linear sRGB, all else is data.
    delivery
        Names of tiles, green of the normal map.
    tangent_normal
        Name of a 16-bit normal map in tangent space, where there is one.
    """
    root = _root("Maps of skin with their color spaces; see maps.json for units and ranges.")
    graph = ElementTree.SubElement(root, "nodegraph", name="NG_maps")
    for name, (file, kind) in files.items():
        _image(
            graph,
            name,
            kind,
            _all_tiles(file, delivery),
            LINEAR_SRGB_NAME if kind == "color3" else None,
        )
        ElementTree.SubElement(graph, "output", name=f"{name}_out", type=kind, nodename=name)
    if tangent_normal is not None:
        _normal_nodes(graph, _all_tiles(tangent_normal, delivery), delivery)
    return _text(root)


def _all_tiles(file: str, delivery: Delivery) -> str:
    """Return a file's name with the token of all tiles in place of the tile's number."""
    stem, dot, suffix = file.rpartition(".")
    tile = "" if delivery.udim == "none" else f"{TILE_SEPARATORS[delivery.udim]}{FIRST_TILE}"
    return delivery.referred(stem.removesuffix(tile), suffix) if dot and tile else file


def _root(doc: str) -> ElementTree.Element:
    return ElementTree.Element("materialx", version=MATERIALX_VERSION, doc=doc)


def _image(
    graph: ElementTree.Element, name: str, kind: str, file: str, space: str | None
) -> ElementTree.Element:
    node = ElementTree.SubElement(graph, "image", name=name, type=kind)
    entry = ElementTree.SubElement(node, "input", name="file", type="filename", value=file)
    if space is not None:
        entry.set("colorspace", space)
    return node


def _normal_nodes(graph: ElementTree.Element, file: str, delivery: Delivery) -> None:
    """Add the normal map: codes 0 to 1, tangent space; a -Y map is turned back by its scale."""
    _image(graph, "normal_codes", "vector3", file, None)
    node = ElementTree.SubElement(graph, "normalmap", name="normal", type="vector3")
    ElementTree.SubElement(node, "input", name="in", type="vector3", nodename="normal_codes")
    ElementTree.SubElement(
        node, "input", name="scale", type="vector2", value=f"1, {NORMAL_Y[delivery.normal_y]:g}"
    )
    ElementTree.SubElement(graph, "output", name="normal_out", type="vector3", nodename="normal")


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
