"""Export all maps of an appearance as float EXR and 16-bit PNG, with one document."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.exporting.images import (
    CAMERA_SPACE,
    DATA_SPACE,
    SRGB_SPACE,
    ExportImage,
    ImageFolder,
    png_range,
)
from skinrig.exporting.materials import materialx, tangents
from skinrig.exporting.materials.tangents import FramedMesh
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import IMAGE_ORIENTATION, format_provenance
from skinrig.rendering.geometry import MESH_FILES, GeometryError, read_own_mesh

DOCUMENT_FILE: Final = "maps.json"
SCHEMA: Final = "skinrig.export.maps/1"
CHROMOPHORE_PACK: Final = "chromophores"
"""Name of the packed map: melanin in R, hemoglobin in G, as in texture libraries."""
SRGB_MAPS: Final = ("image", "specular_image", "color")
CAMERA_RGB_MAPS: Final = ("diffuse", "specular", "r_d", "reflectance", "albedo", "crossed")


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write the maps of an appearance.

    Parameters
    ----------
    appearance
        Any appearance.
    folder
        Existing, empty folder.
    delivery
        Selected maps, names of tiles, green of normals, with or without errors.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    ExportError
        If a selected map is missing, or the appearance has none.
    """
    names = choose_maps(appearance, delivery)
    out = ImageFolder(folder, delivery, appearance)
    on_mesh = any(name in appearance.files for name in MESH_FILES)
    shown: dict[str, tuple[str, str]] = {}  # file and type by name in the material file
    for number, name in enumerate(names):
        delivery.report(f"content {number}/{len(names)}: {name}")
        image = _image(name, appearance.maps[name], delivery, on_mesh)
        exr = out.write_exr(image)
        out.write_png(image)
        colored = "color3" if image.space == SRGB_SPACE else "vector3"
        shown[name] = (exr, colored if image.values.ndim == 3 else "float")
        out.errors(_errors(name, appearance.maps[name]))
    if {"melanin", "hemoglobin"} <= set(names):
        packed = _pack_chromophores(appearance)
        if packed is None:
            out.record_omission(CHROMOPHORE_PACK, "melanin and hemoglobin differ in size")
        else:
            out.write_exr(packed)
            # values times 2 and 4 map the channels' ranges 0 to 0.5 and 0 to 0.25 to 0 to 1
            scaled = packed.values * np.array([2.0, 4.0, 1.0], np.float32)
            what = f"{packed.what}; R is 2 times melanin, G is 4 times hemoglobin"
            out.write_png(replace(packed, values=scaled, what=what, low=0.0, high=1.0))
    normal = None
    if on_mesh:
        normal, why = _tangent_normals(appearance, names, out)
        if why:
            out.record_omission("normal", why)
    text = materialx.format_image_nodes(
        shown, delivery, tangent_normal=normal, provenance=format_provenance(appearance)
    )
    (folder / "maps.mtlx").write_text(text, encoding="utf-8")
    for name, data in sorted(appearance.files.items()):
        (folder / "files").mkdir(exist_ok=True)
        (folder / "files" / name).write_bytes(data)
    out.document(
        DOCUMENT_FILE,
        {
            "schema": SCHEMA,
            "orientation": IMAGE_ORIENTATION,
            "normal_y": delivery.green_direction,
            "udim": "none" if delivery.udim == "none" else "tile 1001",
            "rig_frame": "mm, +x right, +y up, +z towards the main camera",
            "left_out": [list(row) for row in out.left_out],
        },
    )
    return out.left_out


def choose_maps(appearance: SkinAppearance, delivery: ExportSettings) -> list[str]:
    """Return the names of the selected maps.

    Raises
    ------
    ExportError
        If a selected map is missing, or the appearance has none.
    """
    names = list(delivery.only) or sorted(appearance.maps)
    missing = [name for name in names if name not in appearance.maps]
    if missing or not names:
        raise ExportError(
            f"--only: got {missing[0] if missing else 'no maps'}, expected some of "
            f"{', '.join(sorted(appearance.maps)) or 'a reconstruction that has some'}"
        )
    return names


def _image(name: str, skin_map: SkinMap, delivery: ExportSettings, on_mesh: bool) -> ExportImage:
    """Convert a map to an image; normals in a camera's frame get the requested green."""
    values, what = skin_map.values, skin_map.description
    low, high = png_range(name)
    if _is_normals(name, skin_map):
        low, high = -1.0, 1.0
        if not on_mesh:
            values = values * np.array([1.0, delivery.y, 1.0], np.float32)
        frame = f"image frame: x right, y {'up' if delivery.y > 0 else 'down'}"
        frame = "rig frame, green is not flipped" if on_mesh else frame
        what = f"{what}; {frame}".strip("; ")
    space = DATA_SPACE
    if values.ndim == 3 and name.startswith(SRGB_MAPS):
        space = SRGB_SPACE
    elif values.ndim == 3 and name.startswith(CAMERA_RGB_MAPS):
        space = CAMERA_SPACE
        low, high = (0.0, 1.0) if low is None else (low, high)
    return ExportImage(name, values, skin_map.unit, space, what, low, high, skin_map.valid)


def _is_normals(name: str, skin_map: SkinMap) -> bool:
    return "normals" in name and skin_map.values.ndim == 3


def _errors(name: str, skin_map: SkinMap) -> Iterator[ExportImage]:
    if skin_map.stderr is not None:
        unit = "rad" if _is_normals(name, skin_map) else skin_map.unit
        what = f"standard uncertainty of {name}, 68 %"
        yield ExportImage(f"{name}.stderr", skin_map.stderr, unit, what=what, valid=skin_map.valid)
    what = f"1 where {name} is valid, else 0"
    yield ExportImage(f"{name}.valid", intersect_valid(skin_map).astype(np.float32), what=what)


def _pack_chromophores(appearance: SkinAppearance) -> ExportImage | None:
    melanin, blood = appearance.maps["melanin"], appearance.maps["hemoglobin"]
    if melanin.values.shape != blood.values.shape:
        return None
    valid = intersect_valid(melanin, blood)
    layers = [melanin.values, blood.values, np.zeros_like(blood.values)]
    what = "R melanin (epidermis), G hemoglobin (dermis), volume fractions; B is empty, 0"
    return ExportImage(CHROMOPHORE_PACK, np.stack(layers, axis=-1), what=what, valid=valid)


def _tangent_normals(
    appearance: SkinAppearance, names: list[str], out: ImageFolder
) -> tuple[str | None, str]:
    """Write tangent-space normals; return the PNG's name, or None and the reason."""
    found = next((n for n in ("normals_refined", "normals") if n in names), None)
    if found is None:
        return None, "the maps have neither normals_refined nor normals"
    one = appearance.maps[found]
    height, width = one.values.shape[:2]
    if height != width:
        return None, f"{found} is {height} x {width}, expected a square texture"
    try:
        mesh = read_own_mesh(appearance)
    except GeometryError as error:
        return None, str(error)
    axes, covered = FramedMesh.of(mesh).texel_frames(height)
    valid = covered & one.mask
    turned = tangents.fill_tangent_normals(
        tangents.rotate_to_tangent(one.values, axes, covered), valid
    )
    what = f"{found} in the tangent frames of the mesh's vertices (MikkTSpace's rules)"
    what = f"{what}, {out.delivery.green_direction}"
    image = ExportImage.from_normals("normal_tangent", turned, out.delivery, what, valid=valid)
    return out.write_exr_and_png(image), ""
