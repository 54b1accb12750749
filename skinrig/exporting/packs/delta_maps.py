"""Write the map pack of a digital human: neutral maps, and deltas of expressions.

The pack follows the face materials of engines: a base color with up to three animated color maps
(cm1 to cm3), a normal map with up to three animated wrinkle maps (wm1 to wm3), masks of their
zones, and cavity, scatter and micro normal maps. Animated maps are deltas: colors of 512 x 512,
normals of 1024 x 1024. The encoding of deltas is our own, since engines do not publish one;
``delta_maps.json`` has it, and the EXR files have unencoded numbers.

Colors come from the hemoglobin rig, whose maps are registered to the flash camera's image. They are
mapped to a face's texture only if another appearance and landmarks of both are given.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import wrinkles
from model.skin import SkinAppearance
from model.texture_resampling import resample
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.dynamic import FACIAL_COLOR, MICROSTRUCTURE, WRINKLES
from skinrig.arrays import BoolArray, Float64Array
from skinrig.exporting.images import DATA_SPACE, ExportImage, ImageFolder
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.packs import color_deltas, detail_maps
from skinrig.exporting.sealing import IMAGE_ORIENTATION

DOCUMENT_FILE: Final = "delta_maps.json"
SCHEMA: Final = "skinrig.export.delta-maps/1"
NORMAL_SIZE: Final = 1024
PART_MAPS: Final = {
    FACIAL_COLOR: "base color, cm1 to cm3",
    WRINKLES: "normal, wm1 to wm3, masks, cavity",
    MICROSTRUCTURE: "micro normals",
}
"""Maps of the pack by their source part."""
COLOR_CODING: Final = "linear: shown = base + weight * delta; PNG: delta = 2 code / 65535 - 1"
NORMAL_CODING: Final = (
    "slopes n_x/n_z and n_y/n_z, green with the sign of normal_y: shown = slopes of normal + "
    "weight * delta; PNG: delta = 2 code / 65535 - 1; slopes beyond 1 are clipped in PNG alone"
)


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write the pack of a dynamic appearance.

    Parameters
    ----------
    appearance
        Result of `skinrig fit facial-color` or `skinrig fit wrinkles`, or both.
    folder
        Existing, empty folder.
    delivery
        Expressions by `only` (default: the first three), green of normals, names of tiles;
        `target_face` and `landmarks` map colors to a texture.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    ExportError
        If the folder has neither part, or lacks an expression.
    """
    parts = dynamic_appearance.describe_parts(appearance)
    if not {FACIAL_COLOR, WRINKLES, MICROSTRUCTURE} & set(parts):
        raise ExportError(
            f"metahuman: got {', '.join(parts) or 'maps without fitted parts'}, expected "
            "facial_color, wrinkles or microstructure; run `skinrig fit facial-color`, `skinrig "
            "fit wrinkles` or `skinrig fit microstructure`"
        )
    out = ImageFolder(folder, delivery, appearance)
    document: dict[str, Any] = {}
    known: set[str] = set()
    if FACIAL_COLOR in parts:
        document["color"], states = color_deltas.write(appearance, out)
        known |= set(states)
    if WRINKLES in parts:
        document["wrinkles"], rows = _write_wrinkles(appearance, parts, out)
        known |= set(rows)
    if MICROSTRUCTURE in parts:
        document |= detail_maps.write_micro_normals(appearance, parts[MICROSTRUCTURE], out)
    for part, what in PART_MAPS.items():
        if part not in parts:
            fit = f"skinrig fit {part.replace('_', '-')}"
            out.record_omission(what, f"{part} is missing in the folder; run `{fit}`")
    document |= detail_maps.write_scatter(out)
    unknown = [name for name in delivery.only if name not in known]
    if unknown:
        raise ExportError(
            f"--only: got {unknown[0]!r}, expected some of {', '.join(sorted(known)) or 'no state'}"
        )
    out.document(
        DOCUMENT_FILE,
        {
            "schema": SCHEMA,
            "orientation": IMAGE_ORIENTATION,
            "normal_y": delivery.green_direction,
            "color_coding": COLOR_CODING,
            "normal_coding": NORMAL_CODING,
            **document,
            "left_out": [list(row) for row in out.left_out],
        },
    )
    return out.left_out


def _write_wrinkles(
    appearance: SkinAppearance, parts: Mapping[str, Any], out: ImageFolder
) -> tuple[dict[str, Any], list[str]]:
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    rows = sorted({str(row) for layer in model.layers for row in layer.table.rows})  # type: ignore[union-attr]
    fitted = [str(n) for n in parts[WRINKLES].get("expressions", [])]
    have = [name for name in fitted if name in rows] + [n for n in rows if n not in fitted]
    chosen = color_deltas.select_states(have, "wrinkles", out)
    names = {f"wm{k}": row for k, row in enumerate(chosen, start=1)}
    known = np.ones(model.base.shape[:2], bool) if model.valid is None else model.valid
    slopes, valid = color_deltas.resize_map(np.asarray(model.base, np.float64), known, NORMAL_SIZE)
    sign = np.array([1.0, out.delivery.y])
    _write_normal("normal", slopes, valid, out, "neutral normals")
    clipped = {}
    for name, row in names.items():
        shown = model.evaluate({row: 1.0})
        moved = wrinkles.encode(shown.normals.astype(np.float64), limit=None) - model.base
        delta, _ = color_deltas.resize_map(moved, shown.valid, NORMAL_SIZE)
        layers = np.concatenate([delta * sign, np.zeros((*delta.shape[:2], 1))], axis=-1)
        what = f"slopes added by {row} at weight 1: R n_x/n_z, G n_y/n_z, B 0"
        out.write_exr_and_png(
            ExportImage(f"{name}_delta", layers, "1", DATA_SPACE, what, -1.0, 1.0, valid)
        )
        clipped[name] = float(np.mean(np.abs(delta[valid]) > 1.0)) if valid.any() else 0.0
        _write_normal(f"{name}_normal", slopes + delta, valid, out, f"normals of {row}")
    masks = {}
    for number, layer in enumerate(model.layers):
        zones = list(getattr(layer.table, "zones", ()))
        for zone, mask in enumerate(layer.masks):
            name = f"wrinkle_mask_{number}_{zone}"
            sized = resample(np.asarray(mask, np.float64), (NORMAL_SIZE, NORMAL_SIZE))
            zone_name = zones[zone] if zone < len(zones) else str(zone)
            out.write_png(ExportImage(name, sized, low=0.0, high=1.0, what=f"zone {zone_name}"))
            masks[name] = zone_name
    hollows = detail_maps.write_cavity(np.asarray(model.base, np.float64), known, NORMAL_SIZE, out)
    out.errors([ExportImage("normal_mask", valid.astype(float))])
    return {
        "size": NORMAL_SIZE,
        "layout": "the dome's texture",
        "maps": names,
        "masks": masks,
        "measured_size": list(model.base.shape[:2]),
        "clipped_share": clipped,
        "valid_share": float(valid.mean()),
        **hollows,
    }, have


def _write_normal(
    name: str, slopes: Float64Array, valid: BoolArray, out: ImageFolder, description: str
) -> None:
    description = (
        f"{description}, tangent space over the smooth shape, {out.delivery.green_direction}"
    )
    out.write_png(
        ExportImage.from_normals(
            name, wrinkles.decode(slopes), out.delivery, description, valid=valid
        )
    )
