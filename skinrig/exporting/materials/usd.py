"""Write a mesh with its material and blend shapes as OpenUSD.

The material has two networks: UsdPreviewSurface, which every reader supports but which lacks
subsurface scattering, and the OpenPBR surface of the MaterialX export in the render context
``mtlx``. sigma_tr is also in the customData of the material.

References
----------
OpenUSD: UsdGeom, UsdSkel (blend shapes), UsdPreviewSurface specification 2.6.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from model.skin import SkinAppearance
from skinrig.drawing import templates
from skinrig.errors import MissingExtra
from skinrig.exporting.images import ImageFolder
from skinrig.exporting.materials import blender, materialx
from skinrig.exporting.materials.expression_normals import VARIANT_NOTE, expression_normals
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import METERS_PER_UNIT, ExportSettings
from skinrig.exporting.sealing import PROVENANCE_KEY, format_provenance

USD_FILE, DOCUMENT_FILE = "skin.usdc", "usd.json"
SCHEMA: Final = "skinrig.export.usd/1"
ROOT_PRIM: Final = "/Skin"


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write skin.usdc with its textures.

    Parameters
    ----------
    appearance
        Appearance of a dome, or a fitted model.
    folder
        Existing, empty folder.
    delivery
        Scene unit (m by default), names of tiles, green of the normal map, another mesh; blend
        shapes come from it.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    skinrig.errors.MissingExtra
        If usd-core is not installed.
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    try:
        from pxr import Tf
    except ImportError as error:
        raise MissingExtra("export to USD", "usd") from error
    material = Material.of(appearance, delivery.mesh)
    tiles = material.list_mesh_omissions(delivery)
    out = ImageFolder(folder, delivery, appearance, tiles=material.tiles)
    scale = materialx.write_textures(material, out)
    out.write_png(material.image("specular_roughness", delivery), materialx.TEXTURE_FOLDER)
    variants = {}
    for name, normals in expression_normals(appearance, material).items():
        variants[name] = f"normal_{name}"
        image = material.normal_image(variants[name], normals, delivery)
        out.write_png(image, materialx.TEXTURE_FOLDER)
    names = {name: Tf.MakeValidIdentifier(name) for name in material.shapes}
    radius = scale * delivery.units_per_mm
    provenance = format_provenance(appearance)
    _write_stage(folder / USD_FILE, material, names, variants, radius, delivery, provenance)
    textures = (
        ("Subsurface Radius", _place(delivery, "subsurface_radius_scale", "exr"), 1.0),
        # Blender's level of 0.5 is the reflection of a dielectric
        ("Specular IOR Level", _place(delivery, "specular_weight", "exr"), 0.5),
    )
    script = blender.Import(USD_FILE, scale, None, textures).script()
    (folder / blender.SCRIPT_FILE).write_text(script, encoding="utf-8")
    facts = materialx.describe_material(material, appearance, delivery, SCHEMA, scale)
    out.document(
        DOCUMENT_FILE,
        {**facts, "blend_shapes": names, "variants": dict.fromkeys(variants, VARIANT_NOTE)},
    )
    what = "subsurface scattering and specular weight of UsdPreviewSurface"
    in_blender = f"the mtlx network has both; {blender.SCRIPT_FILE} sets them"
    left_out = [*tiles, (what, f"not part of it: {in_blender}")]
    if not material.shapes:
        left_out.append(("blend shapes", "the mesh has none; give one that has with --mesh"))
    return left_out


def _write_stage(
    path: Path,
    material: Material,
    names: Mapping[str, str],
    variants: Mapping[str, str],
    radius: float,
    delivery: ExportSettings,
    provenance: str,
) -> None:
    """Write the stage; blend shapes keep their names, and variants have normal maps of a name."""
    from pxr import Sdf, Vt

    mesh, per_mm = material.mesh, delivery.units_per_mm
    points = mesh.vertices_mm * per_mm
    text = templates.render(
        "exporting/templates/skin.usda",
        unit_m=METERS_PER_UNIT[delivery.scene_unit],
        shapes=list(names.values()),
        variants=variants,
        sigma_tr=material.sigma_tr(),
        materialx=materialx.MATERIALX_FILE,
        linear_srgb=materialx.LINEAR_SRGB_NAME,
        eta=float(material.eta),
        radius=radius,
        y=delivery.y,
        file=lambda name, suffix: _place(delivery, name, suffix),
    )
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(text)
    layer.customLayerData = {PROVENANCE_KEY: provenance}
    extent = np.stack([points.min(axis=0), points.max(axis=0)])
    corners = Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1), np.int32))
    counts = Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32))
    vectors = {".extent": extent, "/Face.extent": extent}
    vectors |= {"/Face.points": points, "/Face.normals": mesh.normals}
    vectors |= {f"/Face/{names[n]}.offsets": d * per_mm for n, d in material.shapes.items()}
    arrays = {p: Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(v, "f4")) for p, v in vectors.items()}
    arrays |= {"/Face.faceVertexIndices": corners, "/Face.faceVertexCounts": counts}
    arrays["/Face.primvars:st"] = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv, "f4"))
    for place, values in arrays.items():
        layer.GetAttributeAtPath(f"{ROOT_PRIM}{place}").default = values
    layer.Export(str(path))


def _place(delivery: ExportSettings, name: str, suffix: str) -> str:
    return f"{materialx.TEXTURE_FOLDER}/{delivery.format_reference(name, suffix)}"
