"""The report's section on a moving face: blood of its states, wrinkle zones, kernels by site."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model import microstructure
from model.facial_color import HemoglobinRig
from model.microstructure import KernelTable
from model.skin import SkinAppearance, SkinMap
from model.wrinkle_expressions import clamped, zone_sums
from model.wrinkle_model import FILE as WRINKLE_FILE
from model.wrinkle_model import WrinkleModel
from skinrig import facial_color_evaluation as evaluation
from skinrig import figures, map_pictures, page
from skinrig.applying import colors, hemoglobin_rig
from skinrig.dynamic_appearance import FACIAL_COLOR, KIND, MICROSTRUCTURE, WRINKLES, parts_of

SHOWN = 4
"""States drawn; the tables list all."""
WIDTH_PX = 240
ZONE_COLORS = np.array(
    [[0.85, 0.1, 0.1], [0.1, 0.65, 0.15], [0.1, 0.25, 0.85], [0.5, 0.3, 0.1],
     [0.1, 0.75, 0.8], [0.8, 0.15, 0.7], [0.95, 0.55, 0.1], [0.5, 0.5, 0.5]]
)  # fmt: skip
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
        Folder of `skinrig.dynamic_appearance`.
    truths
        True blood of each state, as far as it is there.
    checks
        Judgements are added to it.
    """
    parts = parts_of(appearance)
    body = ""
    if FACIAL_COLOR in parts:
        body += _facial_color(name, appearance, parts[FACIAL_COLOR], truths, checks)
    if WRINKLES in parts:
        body += _wrinkles(appearance, parts[WRINKLES])
    if MICROSTRUCTURE in parts:
        body += _microstructure(appearance, parts[MICROSTRUCTURE])
    return body


def _facial_color(
    name: str,
    appearance: SkinAppearance,
    part: Mapping[str, Any],
    truths: Mapping[str, SkinAppearance],
    checks: list[page.Check],
) -> str:
    rig = hemoglobin_rig(appearance)
    body = (
        "<h3>Hemoglobin rig</h3><p class='note'>Each state is a scale and a bias of the neutral "
        f"map, over discs of {rig.radius_px:.1f} px; a blend is an affine combination.</p>"
    )
    body += _blends(appearance, rig)
    rows = []
    for state, maps in rig.states.items():
        placed = [row for row in part["alignment"] if row["state"] == state]
        rms, largest = part["storage_error"][state]
        change = appearance.maps.get(f"change_{state}")
        rows.append(
            (
                state, _mean(change), float(np.median(maps.scale[maps.valid])),
                100 * rms, 100 * largest,
                placed[0]["median_error_px"] if placed else "",
                placed[0]["by"] if placed else "",
            )
        )  # fmt: skip
    body += page.table(
        ("state", "mean change of blood, points", "median scale",
         "lost by storing small, rms, points", "largest, points", "error of place, px",
         "placed by"),
        rows,
        caption="States; points are percent of the dermis' volume",
    )  # fmt: skip
    body += _repeats(part.get("repeatability"))
    if truths:
        states, changes = evaluation.compare(appearance, rig, truths, rng=np.random.default_rng(0))
        body += _errors(name, states, changes, checks)
    for state in list(rig.states)[:SHOWN]:
        measured = appearance.maps.get(f"hemoglobin_{state}")
        true = evaluation.true_blood(truths[state]) if state in truths else None
        if measured is None:
            continue
        blend = rig.evaluate({state: 1.0})
        seen = blend.valid if true is None or true.valid is None else blend.valid & true.valid
        body += map_pictures.map_panel(
            f"blood of {state}, by the rig", "volume fraction",
            estimate=np.where(blend.valid, blend.hemoglobin, 0.0),
            standard_error=np.where(blend.valid, blend.stderr, 0.0),
            truth=None if true is None else true.values, valid=seen,
        )  # fmt: skip
    return body


def _repeats(told: Mapping[str, Any] | None) -> str:
    """Return how far states repeat, and whether melanin drifts."""
    if not told:
        return ""
    drifts = {row["region"]: row for row in told["melanin_drift"]}
    rows = []
    for row in told["hemoglobin"]:
        drift = drifts.get(row["region"])
        slope = "" if drift is None else (
            f"{100 * drift['slope_per_minute']:+.4f} ({100 * drift['slope_stderr']:.4f})"
        )  # fmt: skip
        rows.append(
            (
                row["region"], 100 * row["within"], 100 * row["between"],
                float("nan") if row["correlation"] is None else row["correlation"],
                "yes" if row["scatters"] else "no", slope,
                "" if drift is None else f"{drift['p_value']:.2g}",
            )
        )  # fmt: skip
    return page.table(
        ("region", "between repeats, points", "between states, points", "intraclass correlation",
         "more than noise", "melanin's drift a minute, points", "p"),
        rows,
        caption="Repeats: standard deviations of blood",
    )  # fmt: skip


def _blends(appearance: SkinAppearance, rig: HemoglobinRig) -> str:
    """Draw the face's color in each state and in the first two together."""
    melanin = appearance.maps.get("melanin")
    if melanin is None:
        return ""
    names = list(rig.states)
    asked: dict[str, dict[str, float]] = {"neutral": {"neutral": 1.0}}
    asked |= {state: {state: 1.0} for state in names[:SHOWN]}
    if len(names) > 1:
        asked[f"{names[0]} + {names[1]}"] = {names[0]: 1.0, names[1]: 1.0, "neutral": -1.0}
    pictures = ""
    for title, weights in asked.items():
        blend = rig.evaluate(weights)
        seen = blend.valid if melanin.valid is None else blend.valid & melanin.valid
        color = colors(melanin.values, np.where(seen, blend.hemoglobin, 0.0), seen)
        pictures += map_pictures.color_picture(title, color, width=WIDTH_PX)
    return (
        f"<div class='maps'>{pictures}</div><p class='note'>Diffuse color without shading, linear "
        "sRGB under D65.</p>"
    )


def _errors(
    name: str,
    states: list[evaluation.StateError],
    changes: list[evaluation.ChangeError],
    checks: list[page.Check],
) -> str:
    if not states:
        return ""
    by_rig = [row for row in states if row.way == evaluation.WAYS[1]]
    for row in by_rig:
        checks.append(
            page.Check(
                f"{name}: blood of {row.state} by the rig, median error",
                100 * row.median_relative, 100 * evaluation.LEVEL_LIMIT, "<=", "%",
            )
        )  # fmt: skip
    body = "<h3>Blood of each state: error by way</h3>" + page.table(
        ("state", "way", "median |error| %", "68 % interval", "rms, points", "bias %",
         "68 % coverage %", "pixels"),
        [
            (row.state, row.way, 100 * row.median_relative,
             f"{100 * row.interval[0]:.2f} – {100 * row.interval[1]:.2f}", 100 * row.rms,
             100 * row.bias, 100 * row.coverage, row.pixels)
            for row in states
        ],
        caption="Against the true blood of each state, by way of getting it",
    )  # fmt: skip
    body += page.table(
        ("state", "true change, points", "found, points", "rms of the map, points",
         "68 % coverage %"),
        [
            (row.state, 100 * row.true, 100 * row.found, 100 * row.rms, 100 * row.coverage)
            for row in changes
        ],
        caption="Change of blood from the neutral state, one melanin for all states",
    )  # fmt: skip
    labels = list(dict.fromkeys(row.state for row in states))
    series = {
        way: [
            next((100 * r.median_relative for r in states if (r.state, r.way) == (label, way)),
                 float("nan"))
            for label in labels
        ]
        for way in evaluation.WAYS
    }  # fmt: skip
    plot = figures.bars("median error of a state's blood", labels, series, unit="%")
    return body + f"<div class='plots'>{plot}</div>"


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


def _normals(derivatives: Any) -> NDArray[np.float64]:
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
            f"{site}: neutral relief", relief.values, low=-spread, high=spread, scale="gray",
            valid=relief.valid, unit="um", width=WIDTH_PX,
        )  # fmt: skip
        rows.append(
            (site, entry["pixel_um"], entry["kernels"] or "the paper's table",
             f"{low:.2f} – {high:.2f}", table.source)
        )  # fmt: skip
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


def _mean(skin_map: SkinMap | None) -> float:
    if skin_map is None:
        return float("nan")
    good = _valid(skin_map)
    return 100 * float(skin_map.values[good].mean()) if good.any() else float("nan")


def _valid(skin_map: SkinMap) -> NDArray[np.bool_]:
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid
