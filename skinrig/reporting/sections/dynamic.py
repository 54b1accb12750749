"""Report section on a moving face: blood by expression, wrinkle zones, kernels by site."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from model import microstructure
from model.facial_color import HemoglobinRig
from model.facial_color.state_maps import NEUTRAL
from model.microstructure import KernelTable
from model.skin import SkinAppearance, SkinMap
from model.tissue_optics.layers import C_HD_MAX
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import clamp_sums, zone_sums
from skinrig.appearances.dynamic import (
    DYNAMIC_KIND,
    FACIAL_COLOR,
    MICROSTRUCTURE,
    WRINKLES,
    describe_parts,
)
from skinrig.applying.expression import read_hemoglobin_rig, skin_reflectance
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.drawing import figures
from skinrig.evaluating import facial_color as evaluation
from skinrig.reporting import map_images, page
from skinrig.reporting.map_names import split_melanin_bands

MAX_SHOWN_EXPRESSIONS = 4
"""Expressions drawn; the tables list all."""
WIDTH_PX = 240
CHANGE_GAIN = 4.0
"""Factor on the change of blood in exaggerated images."""
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
    """Return whether an appearance has fitted parts of a moving face."""
    return appearance.parameters.get("kind") == DYNAMIC_KIND


def section(
    subject: page.ReportedAppearance, truths: Mapping[str, SkinAppearance]
) -> Iterator[page.Block]:
    """Yield the fitted parts and their errors.

    Parameters
    ----------
    subject
        Folder of `skinrig.appearances.dynamic`.
    truths
        True blood volume fraction by expression, where given.
    """
    appearance = subject.appearance
    parts = describe_parts(appearance)
    if FACIAL_COLOR in parts:
        yield from draw_facial_color(subject, parts[FACIAL_COLOR], truths)
    if WRINKLES in parts:
        yield from _wrinkles(appearance, parts[WRINKLES])
    if MICROSTRUCTURE in parts:
        yield from _microstructure(appearance, parts[MICROSTRUCTURE])


def _wrinkles(appearance: SkinAppearance, part: Mapping[str, Any]) -> Iterator[page.Block]:
    model = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    layer = model.layers[0]
    masks = np.moveaxis(np.asarray(layer.masks, float), 0, 2)
    tints = ZONE_COLORS[np.arange(masks.shape[2]) % len(ZONE_COLORS)]
    images = [map_images.draw_color_image("zones", masks @ tints, width=WIDTH_PX)]
    shown: dict[str, FloatArray] = {"wrinkle map": _normals(layer.wrinkle)}
    for name in list(part["expressions"])[:MAX_SHOWN_EXPRESSIONS]:
        shown[f"normals, {name}"] = model.evaluate({name: 1.0}).normals
    drawing = map_images.MapDrawing(width=WIDTH_PX)
    images += [drawing.normals(title, normals) for title, normals in shown.items()]
    table: Any = layer.table
    together = dict.fromkeys(list(table.rows)[:2], 1.0)
    sums = zone_sums(together, table)
    clamps = {clamp: clamp_sums(sums, clamp).tolist() for clamp in ("unit", "signed")}
    yield page.Heading("Wrinkles")
    yield page.Images(images)
    stderr = model.weight_stderr
    yield page.build_view(
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
        alphas.append(figures.PlotSeries(site, r.tolist(), alpha.tolist(), marks=False))
        sigmas.append(figures.PlotSeries(site, r.tolist(), sigma_um.tolist(), marks=False))
        relief = appearance.maps[entry["map"]]
        spread = 2.5 * float(np.std(relief.values[relief.mask]))
        drawing = map_images.MapDrawing("", "um", relief.valid, WIDTH_PX)
        title = f"{site}: neutral topography"
        images.append(drawing.draw_scalar(title, relief.values, -spread, spread, "gray"))
        kernels, stretch = entry["kernels"] or "published table", f"{low:.2f} – {high:.2f}"
        rows.append((site, entry["pixel_um"], kernels, stretch, table.source))
    yield page.Heading("Microstructure")
    yield page.Images(images)
    yield page.Plots(
        [
            figures.draw_curves("strength", "stretch ratio", "alpha", alphas),
            figures.draw_curves("width", "stretch ratio", "sigma, um", sigmas),
        ]
    )
    yield page.build_table(
        ("site", "pixel, um", "kernels fitted", "stretch ratio", "source of the table"),
        rows,
        caption="Sites with microstructure",
    )


MAX_SHOWN_STATES = 4
"""Expressions drawn; the tables list all."""


def draw_facial_color(
    subject: page.ReportedAppearance, part: Mapping[str, Any], truths: Mapping[str, SkinAppearance]
) -> Iterator[page.Block]:
    """Yield the blood volume fraction of each expression, its repeatability and its errors.

    Parameters
    ----------
    subject
        Folder of `skinrig.appearances.dynamic`.
    part
        Record of the fit.
    truths
        True blood volume fraction by expression, where given.
    """
    appearance = subject.appearance
    rig = read_hemoglobin_rig(appearance)
    yield page.Heading("Hemoglobin rig")
    yield page.build_note(
        "Each expression scales and offsets the neutral map over discs of "
        f"{rig.radius_px:.1f} px. Blends are affine combinations."
    )
    yield from _blends(appearance, rig)
    mean = {state: _mean_change(appearance.maps.get(f"change_{state}")) for state in rig.states}
    scales = {state: float(np.median(m.scale[m.valid])) for state, m in rig.states.items()}
    yield page.build_view(
        "facial_states", states=rig.states, part=part, changes=mean, scales=scales
    )
    if repeats := part.get("repeatability"):
        yield page.build_view("facial_repeats", repeats=repeats)
    if truths:
        yield from _color_errors(subject, rig, truths)
    for state in list(rig.states)[:MAX_SHOWN_STATES]:
        measured = appearance.maps.get(f"hemoglobin_{state}")
        true = evaluation.true_blood(truths[state]) if state in truths else None
        if measured is None:
            continue
        blend = rig.evaluate({state: 1.0})
        seen = blend.valid if true is None else blend.valid & true.mask
        yield from map_images.draw_map_panel(
            f"blood volume fraction of {state}, by the rig",
            "volume fraction",
            estimate=np.where(blend.valid, blend.hemoglobin, 0.0),
            standard_error=np.where(blend.valid, blend.stderr, 0.0),
            truth=None if true is None else true.values,
            valid=seen,
        )
        yield from _change(appearance, state, measured=blend.valid, truths=truths)


def _change(
    appearance: SkinAppearance,
    state: str,
    *,
    measured: BoolArray,
    truths: Mapping[str, SkinAppearance],
) -> Iterator[page.Block]:
    """Draw the change of blood from neutral, the same pixels in both expressions."""
    change = appearance.maps.get(f"change_{state}")
    if change is None:
        return
    both = [evaluation.true_blood(truths[one]) for one in (state, NEUTRAL) if one in truths]
    shown, parts = change.mask & measured, [("estimate", change.values)]
    if len(both) == 2 and both[0] is not None and both[1] is not None:
        shown = shown & both[0].mask & both[1].mask
        parts.insert(0, ("ground truth", both[0].values - both[1].values))
    if not shown.any():
        return
    reach = max(map_images.compute_percentile_reach(one, shown, 98) for _, one in parts)
    title = f"change of the blood volume fraction from neutral to {state}"
    drawing = map_images.MapDrawing(title, "volume fraction", shown)
    yield page.Heading(title)
    yield page.Images([drawing.draw_signed(label, one, reach) for label, one in parts])


def _blends(appearance: SkinAppearance, rig: HemoglobinRig) -> Iterator[page.Block]:
    """Draw the skin color of each expression and of the first two together."""
    melanin = appearance.maps.get("melanin")
    if melanin is None:
        return
    names = list(rig.states)
    asked: dict[str, dict[str, float]] = {"neutral": {"neutral": 1.0}}
    asked |= {state: {state: 1.0} for state in names[:MAX_SHOWN_STATES]}
    if len(names) > 1:
        asked[f"{names[0]} + {names[1]}"] = {names[0]: 1.0, names[1]: 1.0, "neutral": -1.0}
    images = []
    for title, weights in asked.items():
        blend = rig.evaluate(weights)
        seen = blend.valid & melanin.mask
        found = [(title, np.where(seen, blend.hemoglobin, 0.0))]
        if title in names:
            rest = rig.evaluate(asked["neutral"])
            both = seen & rest.valid
            more = rest.hemoglobin + CHANGE_GAIN * (blend.hemoglobin - rest.hemoglobin)
            found.append((f"{title}, change × {CHANGE_GAIN:g}", np.where(both, more, 0.0)))
        for words, blood in found:
            color = skin_reflectance(melanin.values, np.clip(blood, 0.0, C_HD_MAX), seen)
            color = np.where(seen[..., None], color, map_images.GRAY_LINEAR)
            images.append(map_images.draw_color_image(words, color, width=WIDTH_PX))
    yield page.Images(images)
    yield page.build_note(
        "Diffuse reflectance without shading, linear sRGB under D65. Enlarge an image to flip "
        "between two of them, or to multiply their difference."
    )


def _color_errors(
    subject: page.ReportedAppearance, rig: HemoglobinRig, truths: Mapping[str, SkinAppearance]
) -> Iterator[page.Block]:
    rng = np.random.default_rng(0)
    states, changes = evaluation.compare(subject.appearance, rig, truths, rng=rng)
    if not states:
        return
    banded = compute_errors_by_band(rig, truths)
    for row in states:
        if row.method == evaluation.PREDICTION_METHODS[1]:
            text = f"blood volume fraction of {row.state}, median error"
            got, worst = row.median_relative, _worst_band(row.state, banded)
            limit = evaluation.level_limit(rig)
            subject.check_fraction(text, got, limit, coverage=row.coverage, worst=worst)
    yield page.build_view("facial_errors", states=states, changes=changes, banded=banded)
    labels = list(dict.fromkeys(row.state for row in states))
    found = {(row.state, row.method): 100 * row.median_relative for row in reversed(states)}
    series = {
        way: [found.get((label, way), float("nan")) for label in labels]
        for way in evaluation.PREDICTION_METHODS
    }
    yield page.Plots(
        [figures.draw_bars("median error of the blood volume fraction", labels, series, unit="%")]
    )


def compute_errors_by_band(
    rig: HemoglobinRig, truths: Mapping[str, SkinAppearance]
) -> list[tuple[object, ...]]:
    """Return the errors of the rig by expression and band of true melanin.

    Parameters
    ----------
    rig
        Its states.
    truths
        By expression; those without "melanin" at rest are omitted.

    Returns
    -------
    list of tuple
        Expression, band, pixels; in percent: median relative |error|, bias, coverage of one
        standard uncertainty.
    """
    rows: list[tuple[object, ...]] = []
    for state in rig.states:
        true = evaluation.true_blood(truths[state]) if state in truths else None
        of_truth = truths[state].maps if state in truths else {}
        melanin = of_truth.get("melanin_at_rest", of_truth.get("melanin"))
        if true is None or melanin is None:
            continue
        blend = rig.evaluate({state: 1.0})
        if melanin.values.shape != blend.hemoglobin.shape:
            continue
        good = blend.valid & (true.values > 0) & true.mask
        for band, inside in split_melanin_bands(melanin.values, good):
            found, real = blend.hemoglobin[inside], true.values[inside].astype(np.float64)
            relative = (found - real) / real
            held = np.abs(found - real) <= blend.stderr[inside]
            off = np.median(np.abs(relative)), np.median(relative), np.mean(held)
            percent = (100 * float(one) for one in off)
            rows.append((state, band, int(inside.sum()), *percent))
    return rows


def _worst_band(state: str, banded: list[tuple[object, ...]]) -> str:
    """Return the band of the largest error, where there are several."""
    own = [(float(str(row[3])), str(row[1])) for row in banded if row[0] == state]
    if len(own) < 2:
        return ""
    error, band = max(own)
    return f"{band}: {error:.3g} %"


def _mean_change(skin_map: SkinMap | None) -> float:
    if skin_map is None or not skin_map.mask.any():
        return float("nan")
    return 100 * float(skin_map.values[skin_map.mask].mean())
