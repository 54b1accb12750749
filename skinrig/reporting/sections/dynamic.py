"""The report's section on a moving face: blood of its states, wrinkle zones, kernels by site."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from model import microstructure
from model.microstructure import KernelTable
from model.skin import SkinAppearance
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import clamped, zone_sums
from skinrig.appearances.dynamic import (
    DYNAMIC_KIND,
    FACIAL_COLOR,
    MICROSTRUCTURE,
    WRINKLES,
    parts_of,
)
from skinrig.arrays import Float64Array, FloatArray
from skinrig.drawing import figures
from skinrig.reporting import map_images, page
from skinrig.reporting.sections import facial_color

MAX_SHOWN_EXPRESSIONS = 4
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
    return appearance.parameters.get("kind") == DYNAMIC_KIND


def section(
    name: str,
    appearance: SkinAppearance,
    truths: Mapping[str, SkinAppearance],
    checks: list[page.Check],
) -> Iterator[page.Block]:
    """Yield what was fitted, and how far it is from the truth.

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
    if FACIAL_COLOR in parts:
        yield from facial_color.section(name, appearance, parts[FACIAL_COLOR], truths, checks)
    if WRINKLES in parts:
        yield from _wrinkles(appearance, parts[WRINKLES])
    if MICROSTRUCTURE in parts:
        yield from _microstructure(appearance, parts[MICROSTRUCTURE])


def _wrinkles(appearance: SkinAppearance, part: Mapping[str, Any]) -> Iterator[page.Block]:
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    layer = model.layers[0]
    masks = np.moveaxis(np.asarray(layer.masks, float), 0, 2)
    tints = ZONE_COLORS[np.arange(masks.shape[2]) % len(ZONE_COLORS)]
    images = [map_images.color_image("zones", masks @ tints, width=WIDTH_PX)]
    shown: dict[str, FloatArray] = {"wrinkle map": _normals(layer.wrinkle)}
    for name in list(part["expressions"])[:MAX_SHOWN_EXPRESSIONS]:
        shown[f"normals, {name}"] = model.evaluate({name: 1.0}).normals
    drawing = map_images.MapDrawing(width=WIDTH_PX)
    images += [drawing.normals(title, normals) for title, normals in shown.items()]
    table: Any = layer.table
    together = dict.fromkeys(list(table.rows)[:2], 1.0)
    sums = zone_sums(together, table)
    clamps = {clamp: clamped(sums, clamp).tolist() for clamp in ("unit", "signed")}
    yield page.Heading("Wrinkles")
    yield page.Images(images)
    stderr = model.weight_stderr
    yield page.view(
        "wrinkles", table=table, stderr=stderr, part=part, together=together, clamps=clamps
    )


def _normals(derivatives: Any) -> Float64Array:
    values = np.asarray(derivatives, float)
    small = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=2)
    return np.asarray(small / np.linalg.norm(small, axis=2, keepdims=True))


def _microstructure(appearance: SkinAppearance, part: Mapping[str, Any]) -> Iterator[page.Block]:
    rows, alphas, sigmas, images = [], [], [], []
    for site, entry in part["sites"].items():
        table = KernelTable.from_json(appearance.files[entry["table"]].decode())
        low, high = table.stretch_range
        r = np.linspace(low, high, 61)
        alpha, sigma_um = microstructure.kernel_parameters(r, table)
        alphas.append(figures.Curve(site, r.tolist(), alpha.tolist(), marks=False))
        sigmas.append(figures.Curve(site, r.tolist(), sigma_um.tolist(), marks=False))
        relief = appearance.maps[entry["map"]]
        spread = 2.5 * float(np.std(relief.values[relief.mask]))
        drawing = map_images.MapDrawing("", "um", relief.valid, WIDTH_PX)
        title = f"{site}: neutral relief"
        images.append(drawing.scalar(title, relief.values, -spread, spread, "gray"))
        kernels, stretch = entry["kernels"] or "the paper's table", f"{low:.2f} – {high:.2f}"
        rows.append((site, entry["pixel_um"], kernels, stretch, table.source))
    yield page.Heading("Microstructure")
    yield page.Images(images)
    yield page.Plots(
        [
            figures.curves("strength", "stretch ratio", "alpha", alphas),
            figures.curves("width", "stretch ratio", "sigma, um", sigmas),
        ]
    )
    yield page.table(
        ("site", "pixel, um", "kernels fitted", "stretch", "table from"),
        rows,
        caption="Sites with microstructure",
    )
