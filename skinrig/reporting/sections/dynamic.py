"""The report's section on a moving face: blood of its states, wrinkle zones, kernels by site."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from model import microstructure
from model.microstructure import KernelTable
from model.skin import SkinAppearance, SkinMap
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.expressions import clamped, zone_sums
from skinrig.appearances.dynamic import FACIAL_COLOR, KIND, MICROSTRUCTURE, WRINKLES, parts_of
from skinrig.arrays import BoolArray, Float64Array
from skinrig.drawing import figures
from skinrig.reporting import map_images as map_pictures
from skinrig.reporting import page
from skinrig.reporting.sections import facial_color

SHOWN = 4
"""States drawn; the tables list all."""
WIDTH_PX = 240
ZONE_COLORS = np.array(
    [
        [0.85, 0.1, 0.1],
        [0.1, 0.65, 0.15],
        [0.1, 0.25, 0.85],
        [0.5, 0.3, 0.1],
        [0.1, 0.75, 0.8],
        [0.8, 0.15, 0.7],
        [0.95, 0.55, 0.1],
        [0.5, 0.5, 0.5],
    ]
)
"""Zones in the colors that Jimenez2011 names them by."""


def is_dynamic(appearance: SkinAppearance) -> bool:
    """Return whether an appearance holds fitted parts of a moving face."""
    return appearance.parameters.get("kind") == KIND


def section(
    name: str,
    appearance: SkinAppearance,
    truths: Mapping[str, SkinAppearance],
    checks: list[page.Check],
) -> str:
    """Return what was fitted, and how far it is from the truth.

    Parameters
    ----------
    name
        For headings.
    appearance
        Folder of `skinrig.appearances.dynamic`.
    truths
        True blood of each state, as far as it is there.
    checks
        Judgements are added to it.
    """
    parts = parts_of(appearance)
    body = ""
    if FACIAL_COLOR in parts:
        body += facial_color.section(name, appearance, parts[FACIAL_COLOR], truths, checks)
    if WRINKLES in parts:
        body += _wrinkles(appearance, parts[WRINKLES])
    if MICROSTRUCTURE in parts:
        body += _microstructure(appearance, parts[MICROSTRUCTURE])
    return body


def _wrinkles(appearance: SkinAppearance, part: Mapping[str, Any]) -> str:
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    layer = model.layers[0]
    masks = np.moveaxis(np.asarray(layer.masks, float), 0, 2)
    tints = ZONE_COLORS[np.arange(masks.shape[2]) % len(ZONE_COLORS)]
    pictures = map_pictures.color_picture("zones", masks @ tints, width=WIDTH_PX)
    relief = _normals(layer.wrinkle)
    pictures += map_pictures.normal_picture(
        "wrinkle map", relief, valid=np.ones(relief.shape[:2], bool), width=WIDTH_PX
    )
    for name in list(part["expressions"])[:SHOWN]:
        shown = model.evaluate({name: 1.0}).normals
        pictures += map_pictures.normal_picture(
            f"normals, {name}", shown, valid=np.ones(shown.shape[:2], bool), width=WIDTH_PX
        )
    table: Any = layer.table
    rows = []
    for name, row in table.rows.items():
        stderr = model.weight_stderr.get(name, ())
        rows.append(
            (
                name,
                *(
                    f"{w:.2f} ({e:.2f})" if np.isfinite(e) else "not determined"
                    for w, e in zip(row, stderr or [np.inf] * len(row), strict=True)
                ),
            )
        )
    together = dict.fromkeys(list(table.rows)[:2], 1.0)
    sums = zone_sums(together, table)
    clamps = [(clamp, *(float(v) for v in clamped(sums, clamp))) for clamp in ("unit", "signed")]
    return (
        f"<h3>Wrinkles</h3><div class='maps'>{pictures}</div>"
        + page.table(("expression", *table.zones), rows, caption="Weights (standard error)")
        + page.table(
            ("clamp", *table.zones), clamps, caption=f"{' + '.join(together)}: zones' sums"
        )
        + f"<p class='note'>Map and zones explain {100 * part['explained']:.0f} % of the "
        "differences between expressions and neutral.</p>"
    )


def _normals(derivatives: Any) -> Float64Array:
    values = np.asarray(derivatives, float)
    small = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=2)
    return np.asarray(small / np.linalg.norm(small, axis=2, keepdims=True))


def _microstructure(appearance: SkinAppearance, part: Mapping[str, Any]) -> str:
    rows, alphas, sigmas, pictures = [], [], [], ""
    for site, entry in part["sites"].items():
        table = KernelTable.from_json(appearance.files[entry["table"]].decode())
        low, high = table.stretch_range
        r = np.linspace(low, high, 61)
        alpha, sigma_um = microstructure.kernel_parameters(r, table)
        alphas.append(figures.Curve(site, r.tolist(), alpha.tolist(), marks=False))
        sigmas.append(figures.Curve(site, r.tolist(), sigma_um.tolist(), marks=False))
        relief = appearance.maps[entry["map"]]
        spread = 2.5 * float(np.std(relief.values[_valid(relief)]))
        pictures += map_pictures.scalar_picture(
            f"{site}: neutral relief",
            relief.values,
            low=-spread,
            high=spread,
            scale="gray",
            valid=relief.valid,
            unit="um",
            width=WIDTH_PX,
        )
        rows.append(
            (
                site,
                entry["pixel_um"],
                entry["kernels"] or "the paper's table",
                f"{low:.2f} – {high:.2f}",
                table.source,
            )
        )
    plots = figures.curves("strength", "stretch ratio", "alpha", alphas)
    plots += figures.curves("width", "stretch ratio", "sigma, um", sigmas)
    return (
        f"<h3>Microstructure</h3><div class='maps'>{pictures}</div><div class='plots'>{plots}</div>"
        + page.table(
            ("site", "pixel, um", "kernels fitted", "stretch", "table from"),
            rows,
            caption="Sites with microstructure",
        )
    )


def _valid(skin_map: SkinMap) -> BoolArray:
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid
