"""The report's section on the blood of a moving face: its states, their repeats and errors."""

from __future__ import annotations

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
from skinrig.reporting.map_images import valid_of
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
    rows = []
    for state, maps in rig.states.items():
        placed = [row for row in part["alignment"] if row["state"] == state]
        rms, largest = part["storage_error"][state]
        change = appearance.maps.get(f"change_{state}")
        rows.append(
            (
                state,
                _mean(change),
                float(np.median(maps.scale[maps.valid])),
                100 * rms,
                100 * largest,
                placed[0]["median_error_px"] if placed else "",
                placed[0]["by"] if placed else "",
            )
        )
    yield page.table(
        (
            "state",
            "mean change of blood, points",
            "median scale",
            "lost by storing small, rms, points",
            "largest, points",
            "error of place, px",
            "placed by",
        ),
        rows,
        caption="States; points are percent of the dermis' volume, the mean change is over all "
        "pixels whose change was found",
    )
    yield from _repeats(part.get("repeatability"))
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
        seen = blend.valid if true is None or true.valid is None else blend.valid & true.valid
        yield from map_images.map_panel(
            f"blood of {state}, by the rig",
            "volume fraction",
            estimate=np.where(blend.valid, blend.hemoglobin, 0.0),
            standard_error=np.where(blend.valid, blend.stderr, 0.0),
            truth=None if true is None else true.values,
            valid=seen,
        )


def _repeats(told: Mapping[str, Any] | None) -> Iterator[page.Block]:
    """Yield how far states repeat, and whether melanin drifts."""
    if not told:
        return
    drifts = {row["region"]: row for row in told["melanin_drift"]}
    rows = []
    for row in told["hemoglobin"]:
        drift = drifts.get(row["region"])
        slope = (
            ""
            if drift is None
            else (f"{100 * drift['slope_per_minute']:+.4f} ({100 * drift['slope_stderr']:.4f})")
        )
        rows.append(
            (
                row["region"],
                100 * row["within"],
                100 * row["between"],
                float("nan") if row["correlation"] is None else row["correlation"],
                "yes" if row["scatters"] else "no",
                slope,
                "" if drift is None else f"{drift['p_value']:.2g}",
            )
        )
    yield page.table(
        (
            "region",
            "between repeats, points",
            "between states, points",
            "intraclass correlation",
            "more than noise",
            "melanin's drift a minute, points",
            "p",
        ),
        rows,
        caption="Repeats: standard deviations of blood",
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
        seen = blend.valid if melanin.valid is None else blend.valid & melanin.valid
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
        worst = _worst(row.state, banded)
        checks.append(
            page.Check(
                f"{name}: blood of {row.state} by the rig, median error",
                100 * row.median_relative,
                100 * evaluation.MAX_LEVEL_ERROR,
                "<=",
                "%",
                coverage=row.coverage,
                worst=worst,
            )
        )
    yield page.Heading("Blood of each state: error by way")
    yield page.records(
        states,
        (
            ("state", lambda row: row.state),
            ("way", lambda row: row.way),
            ("median |error|, %", lambda row: 100 * row.median_relative),
            (
                "68 % interval",
                lambda row: f"{100 * row.interval[0]:.2f} – {100 * row.interval[1]:.2f}",
            ),
            ("rms, points", lambda row: 100 * row.rms),
            ("bias, %", lambda row: 100 * row.bias),
            ("68 % coverage, %", lambda row: 100 * row.coverage),
            ("pixels", lambda row: row.pixels),
        ),
        caption="Against the true blood of each state, by way of getting it; pixels that every "
        "way tells",
    )
    yield page.records(
        changes,
        (
            ("state", lambda row: row.state),
            ("true change, points", lambda row: 100 * row.true),
            ("found, points", lambda row: 100 * row.found),
            ("rms of the map, points", lambda row: 100 * row.rms),
            ("68 % coverage, %", lambda row: 100 * row.coverage),
        ),
        caption="Change of blood from the neutral state, one melanin for all states; over those of "
        "these pixels whose change was found",
    )
    if banded:
        yield page.table(
            ("state", "band", "pixels", "median |error|, %", "bias, %", "68 % coverage, %"),
            banded,
            caption="Blood by the rig, by band of the true melanin fraction C_m; all pixels that "
            "the rig tells, also where the state itself was not measured",
        )
    labels = list(dict.fromkeys(row.state for row in states))
    series = {
        way: [
            next(
                (100 * r.median_relative for r in states if (r.state, r.way) == (label, way)),
                float("nan"),
            )
            for label in labels
        ]
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
        good = blend.valid & (true.values > 0)
        if true.valid is not None:
            good = good & true.valid
        for low, high in MELANIN_RANGES:
            inside = good & (melanin.values >= low) & (melanin.values < high)
            if np.count_nonzero(inside) < MIN_BAND_PIXELS:
                continue
            found, real = blend.hemoglobin[inside], true.values[inside].astype(np.float64)
            relative = (found - real) / real
            held = np.abs(found - real) <= blend.stderr[inside]
            rows.append(
                (
                    state,
                    melanin_band(low, high),
                    int(inside.sum()),
                    100 * float(np.median(np.abs(relative))),
                    100 * float(np.median(relative)),
                    100 * float(np.mean(held)),
                )
            )
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
    good = valid_of(skin_map)
    return 100 * float(skin_map.values[good].mean()) if good.any() else float("nan")
