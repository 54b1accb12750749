"""The report's section on the blood of a moving face: its states, their repeats and errors."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from model.facial_color import HemoglobinRig
from model.skin import SkinAppearance, SkinMap
from skinrig.applying.expression import colors, hemoglobin_rig
from skinrig.drawing import figures
from skinrig.evaluating import facial_color as evaluation
from skinrig.evaluating.flash import MELANIN_RANGES
from skinrig.reporting import map_images, page
from skinrig.reporting.map_names import melanin_band

MAX_SHOWN_STATES = 4
"""States drawn; the tables list all."""
WIDTH_PX = 240
MIN_BAND_PIXELS = 20
"""Of a melanin band that is told."""


def section(
    name: str,
    appearance: SkinAppearance,
    part: Mapping[str, Any],
    truths: Mapping[str, SkinAppearance],
    checks: list[page.Check],
) -> Iterator[page.Block]:
    """Yield the states of a face's blood, how they repeat, and how far off they are.

    Parameters
    ----------
    name
        For headings.
    appearance
        Folder of `skinrig.appearances.dynamic`.
    part
        What it records of the blood's fit.
    truths
        True blood of each state, as far as it is there.
    checks
        Judgements are added to it.
    """
    rig = hemoglobin_rig(appearance)
    yield page.Heading("Hemoglobin rig")
    yield page.note(
        "Each state is a scale and a bias of the neutral "
        f"map, over discs of {rig.radius_px:.1f} px; a blend is an affine combination."
    )
    yield from _blends(appearance, rig)
    mean = {state: _mean(appearance.maps.get(f"change_{state}")) for state in rig.states}
    scales = {state: float(np.median(m.scale[m.valid])) for state, m in rig.states.items()}
    yield page.view("facial_states", states=rig.states, part=part, changes=mean, scales=scales)
    if repeats := part.get("repeatability"):
        yield page.view("facial_repeats", repeats=repeats)
    if truths:
        states, changes = evaluation.compare(appearance, rig, truths, rng=np.random.default_rng(0))
        banded = errors_by_band(rig, truths)
        yield from _errors(name, states, changes, banded, checks)
    for state in list(rig.states)[:MAX_SHOWN_STATES]:
        measured = appearance.maps.get(f"hemoglobin_{state}")
        true = evaluation.true_blood(truths[state]) if state in truths else None
        if measured is None:
            continue
        blend = rig.evaluate({state: 1.0})
        seen = blend.valid if true is None else blend.valid & true.mask
        yield from map_images.map_panel(
            f"blood of {state}, by the rig",
            "volume fraction",
            estimate=np.where(blend.valid, blend.hemoglobin, 0.0),
            standard_error=np.where(blend.valid, blend.stderr, 0.0),
            truth=None if true is None else true.values,
            valid=seen,
        )


def _blends(appearance: SkinAppearance, rig: HemoglobinRig) -> Iterator[page.Block]:
    """Draw the face's color in each state and in the first two together."""
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
        color = colors(melanin.values, np.where(seen, blend.hemoglobin, 0.0), seen)
        images.append(map_images.color_image(title, color, width=WIDTH_PX))
    yield page.Images(images)
    yield page.note("Diffuse color without shading, linear sRGB under D65.")


def _errors(
    name: str,
    states: list[evaluation.StateError],
    changes: list[evaluation.ChangeError],
    banded: list[tuple[object, ...]],
    checks: list[page.Check],
) -> Iterator[page.Block]:
    if not states:
        return
    by_rig = [row for row in states if row.way == evaluation.PREDICTION_METHODS[1]]
    for row in by_rig:
        checks.append(
            page.Check.of_shares(
                f"{name}: blood of {row.state} by the rig, median error",
                row.median_relative,
                evaluation.MAX_LEVEL_ERROR,
                coverage=row.coverage,
                worst=_worst(row.state, banded),
            )
        )
    yield page.view("facial_errors", states=states, changes=changes, banded=banded)
    labels = list(dict.fromkeys(row.state for row in states))
    found = {(row.state, row.way): 100 * row.median_relative for row in reversed(states)}
    series = {
        way: [found.get((label, way), float("nan")) for label in labels]
        for way in evaluation.PREDICTION_METHODS
    }
    yield page.Plots([figures.bars("median error of a state's blood", labels, series, unit="%")])


def errors_by_band(
    rig: HemoglobinRig, truths: Mapping[str, SkinAppearance]
) -> list[tuple[object, ...]]:
    """Return the errors of each state's blood by the rig, by band of true melanin.

    Parameters
    ----------
    rig
        Its states.
    truths
        Of each state; a state whose truth has no "melanin", at rest, is left out.

    Returns
    -------
    list of tuple
        State, band, pixels, median size of the relative error in percent, bias in percent, share
        of truths within one standard error in percent.
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
        for low, high in MELANIN_RANGES:
            inside = good & (melanin.values >= low) & (melanin.values < high)
            if np.count_nonzero(inside) < MIN_BAND_PIXELS:
                continue
            found, real = blend.hemoglobin[inside], true.values[inside].astype(np.float64)
            relative = (found - real) / real
            held = np.abs(found - real) <= blend.stderr[inside]
            off = np.median(np.abs(relative)), np.median(relative), np.mean(held)
            percent = (100 * float(one) for one in off)
            rows.append((state, melanin_band(low, high), int(inside.sum()), *percent))
    return rows


def _worst(state: str, banded: list[tuple[object, ...]]) -> str:
    """Return the band of a state's largest error, where there are several."""
    own = [(float(str(row[3])), str(row[1])) for row in banded if row[0] == state]
    if len(own) < 2:
        return ""
    error, band = max(own)
    return f"{band}: {error:.3g} %"


def _mean(skin_map: SkinMap | None) -> float:
    if skin_map is None:
        return float("nan")
    good = skin_map.mask
    return 100 * float(skin_map.values[good].mean()) if good.any() else float("nan")
