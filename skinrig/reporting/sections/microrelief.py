"""The report's section on microrelief: states of strain beside their truths, and their trends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.gradient.stages import HISTOGRAM_FILE, STRAIN_FILE
from skinrig.arrays import BoolArray, FloatArray
from skinrig.drawing import figures
from skinrig.evaluating import microrelief as evaluation
from skinrig.evaluating.subsurface import document_of, number
from skinrig.reporting import map_images, page
from skinrig.reporting.map_images import valid_of
from skinrig.reporting.map_names import state_words
from skinrig.reporting.sections import kernel

WIDTH_PX = 200
MAX_SHOWN_STATES = 7
"""States shown as pictures, spread evenly over those there are."""
SHOWN_HISTOGRAM_FRACTION = 0.75
"""Part of a histogram's side that is shown, from its middle."""


def is_microrelief(appearance: SkinAppearance) -> bool:
    """Return whether an appearance holds states of stretched skin."""
    return bool(evaluation.states_of(appearance))


def section(
    name: str, appearance: SkinAppearance, truth: SkinAppearance | None, checks: list[page.Check]
) -> Iterator[page.Block]:
    """Yield the states of stretched skin, their histograms, kernels and errors.

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
    yield from _images(appearance, truth)
    if truth is not None:
        yield from _relief_errors(name, appearance, truth, checks)
    yield from _strain(name, appearance, truth, checks)
    yield from _histograms(appearance)
    yield from _variances(appearance)
    yield from kernel.section(name, appearance, checks)


def _images(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    states = evaluation.states_of(appearance)
    order = sorted(states, key=_by_step)
    first = "a000_n0" if "a000_n0" in states else order[0]
    yield from _beside_truth(first, appearance, truth)
    one = [state for state in order if state[:4] == first[:4]]
    chosen = [one[round(k)] for k in np.linspace(0, len(one) - 1, min(MAX_SHOWN_STATES, len(one)))]
    series = []
    for kind, title in (("normals", "normals"), ("height", "height")):
        row = []
        for state in chosen:
            skin_map = appearance.maps.get(f"{kind}_{state}")
            if skin_map is not None:
                row.append(_shown(f"{title}, {state_words(state)}", skin_map, appearance))
        if row:
            series.append(page.Images(row, small=True))
    if len(one) > 1:
        yield page.Heading("From compressed to stretched")
        yield from series


def _beside_truth(
    state: str, appearance: SkinAppearance, truth: SkinAppearance | None
) -> Iterator[page.Block]:
    """Yield truth | estimate | error | standard error of one state's normals and height."""
    normals = appearance.maps.get(f"normals_{state}")
    true = None if truth is None else truth.maps.get(f"normals_{state}")
    if normals is not None:
        parts = []
        if true is not None:
            parts.append(_normal_image("truth", true, state))
        parts.append(_normal_image("estimate", normals, state))
        good = valid_of(normals)
        if true is not None:
            good = good & valid_of(true)
            error = np.degrees(metrics.angular_error_rad(normals.values, true.values))
            parts.append(_angle_image("error", np.nan_to_num(error), good, state))
        if normals.stderr is not None:
            spread = np.degrees(normals.stderr[..., 0])
            parts.append(_angle_image("standard error", spread, valid_of(normals), state))
        yield page.Heading(f"normals, {state_words(state)}")
        yield page.Images(parts)
    height = appearance.maps.get(f"height_{state}")
    if height is not None:
        relief = None
        if truth is not None:
            relief = evaluation.true_relief(appearance, truth, state)
        yield from map_images.map_panel(
            f"height, {state_words(state)}",
            "um",
            estimate=height.values,
            standard_error=height.stderr,
            truth=relief,
            valid=valid_of(height),
            width=280,
        )


def _shown(title: str, skin_map: SkinMap, appearance: SkinAppearance) -> page.Image:
    if skin_map.values.ndim == 3:
        return map_images.normal_image(
            title, skin_map.values, valid=valid_of(skin_map), width=WIDTH_PX
        )
    heights = [
        m.values[valid_of(m)] for k, m in appearance.maps.items() if k.startswith("height_a")
    ]
    reach = float(np.percentile(np.abs(np.concatenate(heights)), 99)) if heights else 1.0
    return map_images.scalar_image(
        title,
        skin_map.values,
        low=-reach,
        high=reach,
        scale="RdBu_r",
        valid=valid_of(skin_map),
        unit="um",
        width=WIDTH_PX,
    )


def _normal_image(title: str, skin_map: SkinMap, state: str) -> page.Image:
    return map_images.normal_image(
        title, skin_map.values, valid=valid_of(skin_map), of=f"normals, {state_words(state)}"
    )


def _angle_image(title: str, degrees: FloatArray, valid: BoolArray, state: str) -> page.Image:
    return map_images.scalar_image(
        title,
        degrees,
        low=0.0,
        high=map_images.reach_of(degrees, valid, 98),
        scale="magma",
        valid=valid,
        unit="°",
        of=f"normals, {state_words(state)}",
    )


def _relief_errors(
    name: str, appearance: SkinAppearance, truth: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    rows = evaluation.compare(appearance, truth, rng=np.random.default_rng(0))
    if not rows:
        return
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
    yield page.Heading("Errors of normals and height")
    yield page.note(
        "Errors are told at the lens's resolution; the unblurred truth has detail "
        "that this aperture does not show. Heights have the lens's blur undone and are told "
        f"against the unblurred relief: {100 * evaluation.MAX_HEIGHT_ERROR:g} % is kept on smooth "
        "relief; on skin, steep walls of furrows hide light from themselves, which is not "
        "corrected, and standard errors, which know noise alone, are then too small."
    )
    yield page.one_skin(truth.parameters)
    yield page.records(
        rows,
        (
            ("state", lambda row: state_words(row.state)),
            ("pixels", lambda row: row.pixels),
            ("masked, %", lambda row: 100 * row.masked),
            ("mean error, °", lambda row: row.mean_deg),
            ("median, °", lambda row: row.median_deg),
            ("68 % interval", lambda row: f"{row.interval_deg[0]:.3g} – {row.interval_deg[1]:.3g}"),
            ("unblurred truth, °", lambda row: row.unblurred_deg),
            ("median standard error, °", lambda row: row.stderr_deg),
            ("68 % coverage, %", lambda row: 100 * row.coverage),
            ("height rms, um", lambda row: row.height_um),
            ("relief rms, um", lambda row: row.relief_um),
            ("of relief, %", lambda row: 100 * row.height_relative),
        ),
        caption="Every state against its truth; angles of normals in degrees",
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
) -> Iterator[page.Block]:
    document = document_of(appearance, STRAIN_FILE)
    if document is None:
        return
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
    yield page.Heading("Strain of the skin, from its pigment")
    yield page.records(
        document["states"],
        (
            ("state", lambda state: state_words(state["name"])),
            ("jaws, mm", lambda state: number(state["reading_mm"])),
            ("force, N", lambda state: number(state["force_n"])),
            ("caliper's ratio", lambda state: number(state["reading_ratio"])),
            ("skin's r", lambda state: number(state["stretch_s"])),
            ("standard error", lambda state: round(number(state["stretch_s_stderr"]), 6)),
            (
                "true r",
                lambda state: true[state["name"]].truth if state["name"] in true else math.nan,
            ),
            ("slip", lambda state: round(number(state["slip"]), 6)),
            ("r across", lambda state: number(state["stretch_t"])),
            ("shear, °", lambda state: round(math.degrees(number(state["shear_rad"])), 4)),
            ("rotation, °", lambda state: round(math.degrees(number(state["rotation_rad"])), 4)),
            ("windows", lambda state: state["windows"]),
            ("measured", lambda state: "yes" if state["valid"] else "no"),
        ),
        caption="Stretch ratio r of the skin between the jaws, and what the caliper reads",
    )


def _histograms(appearance: SkinAppearance) -> Iterator[page.Block]:
    document = document_of(appearance, HISTOGRAM_FILE)
    if document is None:
        return
    states = sorted(document["states"], key=lambda state: _by_step(state["name"]))
    chosen = [
        states[round(k)]
        for k in np.linspace(0, len(states) - 1, min(MAX_SHOWN_STATES, len(states)))
    ]
    counts = [np.asarray(state["counts"], float) for state in chosen]
    top = max((float(np.sqrt(count).max()) for count in counts), default=1.0)
    panels = []
    for state, count in zip(chosen, counts, strict=True):
        side = len(count)
        cut = round(side * (1 - SHOWN_HISTOGRAM_FRACTION) / 2)
        # rows hold n across the jaws from -1: the page shows + at the top
        shown = np.sqrt(count)[::-1][cut : side - cut, cut : side - cut]
        panels.append(
            map_images.scalar_image(
                state_words(state["name"]),
                shown,
                low=0.0,
                high=top,
                scale="magma",
                width=WIDTH_PX,
                of="histogram of normals",
            )
        )
    aliased = [state_words(state["name"]) for state in states if state["aliased"]]
    yield page.Heading("Histograms of normals, root of share")
    yield page.note("Along the jaws to the right, across them up.")
    yield page.Images(panels, small=True)
    if aliased:
        yield page.note(
            f"Too few samples a bucket in {'; '.join(aliased)}: distances between these "
            "histograms show chance."
        )


def _variances(appearance: SkinAppearance) -> Iterator[page.Block]:
    by_angle = evaluation.variances(appearance)
    if not by_angle:
        return
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
    yield page.Plots([plot])


def _by_step(state: str) -> tuple[str, int]:
    angle, step = state.split("_")
    return angle, int(step[1:]) * (-1 if step[0] == "m" else 1)
