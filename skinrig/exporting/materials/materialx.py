"""Write MaterialX materials: an OpenPBR surface, and image nodes with color spaces."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance
from skinrig.drawing import templates
from skinrig.exporting.images import ExportImage, ImageFolder
from skinrig.exporting.materials.material import MAP_NOTES, Material, list_expression_omissions
from skinrig.exporting.options import FIRST_TILE, TILE_SEPARATORS, ExportSettings
from skinrig.exporting.sealing import IMAGE_ORIENTATION, format_provenance

MATERIALX_FILE, DOCUMENT_FILE = "skin.mtlx", "material.json"
SCHEMA: Final = "skinrig.export.material/1"
TEXTURE_FOLDER: Final = "textures"
LINEAR_SRGB_NAME: Final = "lin_rec709"
"""MaterialX's name of linear sRGB; data have no color space."""


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write an OpenPBR material with its textures and the mesh.

    Parameters
    ----------
    appearance
        Appearance of a dome, or a fitted model.
    folder
        Existing, empty folder.
    delivery
        Scene unit (m by default), names of tiles, green of the normal map, another mesh.

    Returns
    -------
    list of (str, str)
        Omissions with reasons: maps of tiles other than the first.

    Raises
    ------
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    material = Material.of(appearance, delivery.mesh)
    left_out = material.list_mesh_omissions(delivery)
    left_out += list_expression_omissions(appearance)
    out = ImageFolder(folder, delivery, appearance, tiles=material.tiles)
    scale = write_textures(material, out)
    (folder / "skin.obj").write_text(
        material.mesh.to_obj(delivery.units_per_mm, delivery.scene_unit), encoding="utf-8"
    )
    out.document(DOCUMENT_FILE, describe_material(material, appearance, delivery, SCHEMA, scale))
    return left_out


def write_textures(material: Material, out: ImageFolder) -> float:
    """Write the textures of `format_openpbr`; return the largest radius, mm."""
    for name in ("base_color", "specular_roughness", "specular_weight", "translucency"):
        out.write_exr(material.image(name, out.delivery), TEXTURE_FOLDER)
    out.write_png(material.image("base_color", out.delivery), TEXTURE_FOLDER)
    out.write_png(material.image("normal", out.delivery), TEXTURE_FOLDER)
    radius = material.radius_mm
    shown = radius[material.covered] if material.covered.any() else radius
    scale = float(shown.max())
    what = f"{MAP_NOTES['subsurface_radius']}; over {scale:.9g} mm, the largest"
    shares = np.clip(radius / scale, 0.0, 1.0)
    out.write_exr(
        ExportImage("subsurface_radius_scale", shares, what=what, valid=material.valid),
        TEXTURE_FOLDER,
    )
    out.errors(material.error_images(), TEXTURE_FOLDER)
    text = format_openpbr(material, scale, out.delivery, format_provenance(out.appearance))
    (out.root / MATERIALX_FILE).write_text(text, encoding="utf-8")
    return scale


def describe_material(
    material: Material,
    appearance: SkinAppearance,
    delivery: ExportSettings,
    schema: str,
    scale: float,
) -> dict[str, Any]:
    """Return the document of an exported material.

    Parameters
    ----------
    material, appearance
        The exported material and its source.
    delivery
        The scene's unit.
    schema
        Schema of the document.
    scale
        Radius of subsurface scattering, mm.
    """
    facts = material.facts(appearance)
    return {
        **facts,
        "schema": schema,
        "scene_unit": delivery.scene_unit,
        "mm_per_scene_unit": 1.0 / delivery.units_per_mm,
        "orientation": IMAGE_ORIENTATION,
        "udim": {"tiles": list(material.tiles), "measured": [material.tiles[0]]},
        "frame": "+x right, +y up, +z towards the main camera",
        "subsurface": {
            **facts["subsurface"],
            "radius_in_scene_units": scale * delivery.units_per_mm,
        },
    }


def format_openpbr(
    material: Material, radius_mm: float, delivery: ExportSettings, provenance: str
) -> str:
    """Format a material whose textures are in `TEXTURE_FOLDER`.

    Parameters
    ----------
    material
        The material.
    radius_mm
        Subsurface radius; the texture of radius scales is relative to it.
    delivery
        Scene unit, names of tiles, green of the normal map.
    provenance
        JSON, see `skinrig.exporting.sealing.format_provenance`.
    """
    return templates.render(
        "exporting/templates/openpbr.mtlx",
        material=material,
        radius=f"{radius_mm * delivery.units_per_mm:.9g}",
        eta=f"{material.eta:.9g}",
        delivery=delivery,
        provenance=provenance,
        folder=TEXTURE_FOLDER,
    )


def format_image_nodes(
    files: Mapping[str, tuple[str, str]],
    delivery: ExportSettings,
    *,
    tangent_normal: str | None,
    provenance: str,
) -> str:
    """Format a node graph with one image node per map, which records its color space.

    Parameters
    ----------
    files
        File and MaterialX type by map; "color3" is linear sRGB, other types are data.
    delivery
        Names of tiles, green of the normal map.
    tangent_normal
        Name of a 16-bit normal map in tangent space; None: no such map.
    provenance
        JSON, see `skinrig.exporting.sealing.format_provenance`.
    """
    shown = {name: (_all_tiles(file, delivery), kind) for name, (file, kind) in files.items()}
    normal = None if tangent_normal is None else _all_tiles(tangent_normal, delivery)
    return templates.render(
        "exporting/templates/maps.mtlx",
        files=shown,
        normal=normal,
        delivery=delivery,
        provenance=provenance,
    )


def _all_tiles(file: str, delivery: ExportSettings) -> str:
    """Replace the tile number of a file's name by the token of all tiles."""
    stem, dot, suffix = file.rpartition(".")
    tile = "" if delivery.udim == "none" else f"{TILE_SEPARATORS[delivery.udim]}{FIRST_TILE}"
    return delivery.format_reference(stem.removesuffix(tile), suffix) if dot and tile else file
