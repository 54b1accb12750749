"""The report's section on microrelief: states of strain beside their truths, and their trends."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.gradient.stages import HISTOGRAM_FILE, STRAIN_FILE
from skinrig.arrays import BoolArray, FloatArray
from skinrig.drawing import figures
from skinrig.evaluating import microrelief as evaluation
from skinrig.reporting import map_images as map_pictures
from skinrig.reporting import page
from skinrig.reporting.map_names import state_words
from skinrig.reporting.sections import kernel

WIDTH_PX = 200
SHOWN = 7
"""States shown as pictures, spread evenly over those there are."""
HISTOGRAM_REACH = 0.75
"""Part of a histogram's side that is shown, from its middle."""


def is_microrelief(appearance: SkinAppearance) -> bool:
    """Return whether an appearance holds states of stretched skin."""
    return bool(evaluation.states_of(appearance))


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> str:
    """Return the states of stretched skin, their histograms, kernels and errors.

    Parameters
    ----------
    name
        For headings.
    appearance
        With maps "normals_<state>" and "height_<state>".
    truth
        Of the same session; None: standard errors only.
    checks
        Judgements are added to it.
    """
    body = _pictures(appearance, truth)
    if truth is not None:
        body += _relief_errors(name, appearance, truth, checks)
    body += _strain(name, appearance, truth, checks)
    body += _histograms(appearance)
    body += _variances(appearance)
    body += kernel.section(name, appearance, checks)
    return body


def _pictures(appearance: SkinAppearance, truth: SkinAppearance | None) -> str:
    states = evaluation.states_of(appearance)
    order = sorted(states, key=_by_step)
    first = "a000_n0" if "a000_n0" in states else order[0]
    body = _beside_truth(first, appearance, truth)
    one = [state for state in order if state[:4] == first[:4]]
    chosen = [one[round(k)] for k in np.linspace(0, len(one) - 1, min(SHOWN, len(one)))]
    series = []
    for kind, title in (("normals", "normals"), ("height", "height")):
        row = ""
        for state in chosen:
            skin_map = appearance.maps.get(f"{kind}_{state}")
            if skin_map is not None:
                row += _shown(f"{title}, {state_words(state)}", skin_map, appearance)
        if row:
            series.append(f"<div class='maps small'>{row}</div>")
    if len(one) > 1:
        body += "<h3>From compressed to stretched</h3>" + "".join(series)
    return body


def _beside_truth(state: str, appearance: SkinAppearance, truth: SkinAppearance | None) -> str:
    """Return truth | estimate | error | standard error of one state's normals and height."""
    body = ""
    normals = appearance.maps.get(f"normals_{state}")
    true = None if truth is None else truth.maps.get(f"normals_{state}")
    if normals is not None:
        parts = []
        if true is not None:
            parts.append(_normal_picture("truth", true, state))
        parts.append(_normal_picture("estimate", normals, state))
        good = _valid(normals)
        if true is not None:
            from model import metrics

            good = good & _valid(true)
            error = np.degrees(metrics.angular_error_rad(normals.values, true.values))
            parts.append(_angle_picture("error", np.nan_to_num(error), good, state))
        if normals.stderr is not None:
            spread = np.degrees(normals.stderr[..., 0])
            parts.append(_angle_picture("standard error", spread, _valid(normals), state))
        body += f"<h3>normals, {state_words(state)}</h3><div class='maps'>{''.join(parts)}</div>"
    height = appearance.maps.get(f"height_{state}")
    if height is not None:
        relief = None
        if truth is not None:
            relief = evaluation.true_relief(appearance, truth, state)
        body += map_pictures.map_panel(
            f"height, {state_words(state)}",
            "um",
            estimate=height.values,
            standard_error=height.stderr,
            truth=relief,
            valid=_valid(height),
            width=280,
        )
    return body


def _shown(title: str, skin_map: SkinMap, appearance: SkinAppearance) -> str:
    if skin_map.values.ndim == 3:
        return map_pictures.normal_picture(
            title, skin_map.values, valid=_valid(skin_map), width=WIDTH_PX
        )
    heights = [m.values[_valid(m)] for k, m in appearance.maps.items() if k.startswith("height_a")]
    reach = float(np.percentile(np.abs(np.concatenate(heights)), 99)) if heights else 1.0
    return map_pictures.scalar_picture(
        title,
        skin_map.values,
        low=-reach,
        high=reach,
        scale="RdBu_r",
        valid=_valid(skin_map),
        unit="um",
        width=WIDTH_PX,
    )


def _normal_picture(title: str, skin_map: SkinMap, state: str) -> str:
    return map_pictures.normal_picture(
        title, skin_map.values, valid=_valid(skin_map), of=f"normals, {state_words(state)}"
    )


def _angle_picture(title: str, degrees: FloatArray, valid: BoolArray, state: str) -> str:
    return map_pictures.scalar_picture(
        title,
        degrees,
        low=0.0,
        high=map_pictures.reach_of(degrees, valid, 98),
        scale="magma",
        valid=valid,
        unit="°",
        of=f"normals, {state_words(state)}",
    )


def _relief_errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> str:
    rows = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    if not rows:
        return ""
    neutral = [row for row in rows if row.state.endswith("_n0")]
    where, worst_got = _worst(rows)
    for row in neutral:
        checks.append(
            page.Check(
                f"{name}: specular normals at the lens's resolution, mean error",
                row.mean_deg,
                evaluation.MAX_NORMAL_ERROR_DEG,
                "<=",
                "°",
                state_words(row.state),
                masked=row.masked,
                coverage=row.coverage,
                worst=where,
                worst_got=worst_got,
            )
        )
    note = (
        "<p class='note'>Errors are told at the lens's resolution; the unblurred truth has detail "
        "that this aperture does not show. Heights have the lens's blur undone and are told "
        f"against the unblurred relief: {100 * evaluation.HEIGHT_LIMIT:g} % is kept on smooth "
        "relief; on skin, steep walls of furrows hide light from themselves, which is not "
        "corrected, and standard errors, which know noise alone, are then too small.</p>"
    )
    note += page.one_skin(truth.parameters)
    return (
        "<h3>Errors of normals and height</h3>"
        + note
        + page.table(
            (
                "state",
                "pixels",
                "masked, %",
                "mean error, °",
                "median, °",
                "68 % interval",
                "unblurred truth, °",
                "median standard error, °",
                "68 % coverage, %",
                "height rms, um",
                "relief rms, um",
                "of relief, %",
            ),
            [
                (
                    state_words(row.state),
                    row.pixels,
                    100 * row.masked,
                    row.mean_deg,
                    row.median_deg,
                    f"{row.interval_deg[0]:.3g} – {row.interval_deg[1]:.3g}",
                    row.unblurred_deg,
                    row.stderr_deg,
                    100 * row.coverage,
                    row.height_um,
                    row.relief_um,
                    100 * row.height_relative,
                )
                for row in rows
            ],
            caption="Every state against its truth; angles of normals in degrees",
        )
    )


def _worst(rows: Sequence[evaluation.ReliefError]) -> tuple[str, float]:
    """Return the state whose normals are worst and their error, where there are several."""
    told = [row for row in rows if math.isfinite(row.mean_deg)]
    if len(told) < 2:
        return "", math.nan
    worst = max(told, key=lambda row: row.mean_deg)
    return f"{state_words(worst.state)}: {worst.mean_deg:.3g}°", worst.mean_deg


def _strain(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> str:
    document = evaluation.document_of(appearance, STRAIN_FILE)
    if document is None:
        return ""
    true = (
        {}
        if truth is None
        else {row.state: row for row in evaluation.compare_stretch(appearance, truth)}
    )
    if true:
        worst = max(true.values(), key=lambda row: abs(row.error))
        checks.append(
            page.Check(
                f"{name}: stretch of the skin, largest error",
                abs(worst.error),
                evaluation.MAX_STRAIN_ERROR,
                "<=",
                "",
                worst=state_words(worst.state),
            )
        )
    rows = [
        (
            state_words(state["name"]),
            _value(state["reading_mm"]),
            _value(state["force_n"]),
            _value(state["reading_ratio"]),
            _value(state["stretch_s"]),
            round(_value(state["stretch_s_stderr"]), 6),
            true[state["name"]].truth if state["name"] in true else math.nan,
            round(_value(state["slip"]), 6),
            _value(state["stretch_t"]),
            round(math.degrees(_value(state["shear_rad"])), 4),
            round(math.degrees(_value(state["rotation_rad"])), 4),
            state["windows"],
            "yes" if state["valid"] else "no",
        )
        for state in document["states"]
    ]
    return "<h3>Strain of the skin, from its pigment</h3>" + page.table(
        (
            "state",
            "jaws, mm",
            "force, N",
            "caliper's ratio",
            "skin's r",
            "standard error",
            "true r",
            "slip",
            "r across",
            "shear, °",
            "rotation, °",
            "windows",
            "measured",
        ),
        rows,
        caption="Stretch ratio r of the skin between the jaws, and what the caliper reads",
    )


def _histograms(appearance: SkinAppearance) -> str:
    document = evaluation.document_of(appearance, HISTOGRAM_FILE)
    if document is None:
        return ""
    states = sorted(document["states"], key=lambda state: _by_step(state["name"]))
    chosen = [states[round(k)] for k in np.linspace(0, len(states) - 1, min(SHOWN, len(states)))]
    counts = [np.asarray(state["counts"], float) for state in chosen]
    top = max((float(np.sqrt(count).max()) for count in counts), default=1.0)
    panels = ""
    for state, count in zip(chosen, counts, strict=True):
        side = len(count)
        cut = round(side * (1 - HISTOGRAM_REACH) / 2)
        # rows hold n across the jaws from -1: the page shows + at the top
        shown = np.sqrt(count)[::-1][cut : side - cut, cut : side - cut]
        panels += map_pictures.scalar_picture(
            state_words(state["name"]),
            shown,
            low=0.0,
            high=top,
            scale="magma",
            width=WIDTH_PX,
            of="histogram of normals",
        )
    aliased = [state_words(state["name"]) for state in states if state["aliased"]]
    note = (
        page.note(
            f"Too few samples a bucket in {'; '.join(aliased)}: distances between these "
            "histograms show chance."
        )
        if aliased
        else ""
    )
    return (
        "<h3>Histograms of normals, root of share</h3><p class='note'>Along the jaws to the right, "
        f"across them up.</p><div class='maps small'>{panels}</div>{note}"
    )


def _variances(appearance: SkinAppearance) -> str:
    by_angle = evaluation.variances(appearance)
    if not by_angle:
        return ""
    series = [
        figures.Curve(
            f"jaws at {angle:.0f}°",
            [row[0] for row in rows],
            [row[2] for row in rows],
            [row[3] for row in rows],
        )
        for angle, rows in by_angle.items()
    ]
    plot = figures.curves(
        "roughness along the jaws", "stretch ratio r of the skin", "variance of n", series
    )
    return f"<div class='plots'>{plot}</div>"


def _by_step(state: str) -> tuple[str, int]:
    angle, step = state.split("_")
    return angle, int(step[1:]) * (-1 if step[0] == "m" else 1)


def _value(value: object) -> float:
    return math.nan if value is None else float(str(value))


def _valid(skin_map: SkinMap) -> BoolArray:
    shape = skin_map.values.shape[:2]
    return np.ones(shape, bool) if skin_map.valid is None else skin_map.valid
