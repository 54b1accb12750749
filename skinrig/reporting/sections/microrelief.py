"""Report section on microrelief: strain steps with ground truth, and trends."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.gradient.stages import HISTOGRAM_FILE, KERNEL_FILE, STRAIN_FILE
from skinrig.arrays import BoolArray, FloatArray
from skinrig.drawing import figures
from skinrig.evaluating import microrelief as evaluation
from skinrig.evaluating.subsurface import parse_number, read_document
from skinrig.reporting import map_images, page
from skinrig.reporting.map_names import state_title

T = TypeVar("T")
WIDTH_PX = 200
MAX_SHOWN_STATES = 7
"""Strain steps drawn, at even intervals."""
SHOWN_HISTOGRAM_FRACTION = 0.75
"""Central fraction of each side of a histogram that is shown."""


def is_microrelief(appearance: SkinAppearance) -> bool:
    """Return whether an appearance has strain steps of skin."""
    return bool(evaluation.find_states(appearance))


def section(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    """Yield the strain steps of skin, their histograms, kernels and errors.

    Parameters
    ----------
    subject
        With maps "normals_<state>" and "height_<state>".
        Its truth is of the same session; None: uncertainties only.
    """
    yield from _images(subject.appearance, subject.truth)
    yield from _relief_errors(subject)
    yield from _strain(subject)
    yield from _histograms(subject.appearance)
    yield from _variances(subject.appearance)
    yield from draw_kernels(subject)


def _images(appearance: SkinAppearance, truth: SkinAppearance | None) -> Iterator[page.Block]:
    states = evaluation.find_states(appearance)
    order = sorted(states, key=_by_step)
    first = "a000_n0" if "a000_n0" in states else order[0]
    yield from _compare_with_truth(first, appearance, truth)
    one = [state for state in order if state[:4] == first[:4]]
    chosen = _select_states(one)
    series = []
    for kind in ("normals", "height"):
        maps = {state: appearance.maps.get(f"{kind}_{state}") for state in chosen}
        row = [
            _map_image(f"{kind}, {state_title(state)}", skin_map, appearance)
            for state, skin_map in maps.items()
            if skin_map is not None
        ]
        if row:
            series.append(page.Images(row, small=True))
    if len(one) > 1:
        yield page.Heading("From compressed to stretched")
        yield from series


def _compare_with_truth(
    state: str, appearance: SkinAppearance, truth: SkinAppearance | None
) -> Iterator[page.Block]:
    """Yield ground truth | estimate | error | uncertainty of normals and height of one step."""
    normals = appearance.maps.get(f"normals_{state}")
    true = None if truth is None else truth.maps.get(f"normals_{state}")
    words = f"normals, {state_title(state)}"
    if normals is not None:
        parts = [_scalar_image(words, normals).normals("estimate", normals.values)]
        if true is not None:
            good = normals.mask & true.mask
            error = np.degrees(metrics.angular_error_rad(normals.values, true.values))
            parts.insert(0, _scalar_image(words, true).normals("ground truth", true.values))
            parts.append(_angle_image("error", np.nan_to_num(error), good, words))
        if normals.stderr is not None:
            spread = np.degrees(normals.stderr[..., 0])
            parts.append(_angle_image("standard uncertainty", spread, normals.mask, words))
        yield page.Heading(words)
        yield page.Images(parts)
    height = appearance.maps.get(f"height_{state}")
    if height is not None:
        yield from map_images.draw_map_panel(
            f"height, {state_title(state)}",
            "um",
            estimate=height.values,
            standard_error=height.stderr,
            truth=None if truth is None else evaluation.true_relief(appearance, truth, state),
            valid=height.mask,
        )


def _map_image(title: str, skin_map: SkinMap, appearance: SkinAppearance) -> page.Image:
    if skin_map.values.ndim == 3:
        return _scalar_image("", skin_map, WIDTH_PX).normals(title, skin_map.values)
    heights = [m.values[m.mask] for k, m in appearance.maps.items() if k.startswith("height_a")]
    reach = float(np.percentile(np.abs(np.concatenate(heights)), 99)) if heights else 1.0
    drawing = map_images.MapDrawing("", "um", skin_map.mask, WIDTH_PX)
    return drawing.draw_signed(title, skin_map.values, reach)


def _scalar_image(words: str, skin_map: SkinMap, width: int = 280) -> map_images.MapDrawing:
    return map_images.MapDrawing(words, "", skin_map.mask, width)


def _angle_image(title: str, degrees: FloatArray, valid: BoolArray, words: str) -> page.Image:
    drawing = map_images.MapDrawing(words, "°", valid)
    return drawing.size(title, degrees, map_images.compute_percentile_reach(degrees, valid, 98))


def _relief_errors(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    truth = subject.truth
    if truth is None:
        return
    rows = evaluation.compare(subject.appearance, truth, rng=np.random.default_rng(0))
    if not rows:
        return
    neutral = [row for row in rows if row.state.endswith("_n0")]
    where, worst_got = "", math.nan
    if worst := page.find_worst(rows, lambda row: row.mean_deg):
        where, worst_got = f"{state_title(worst.state)}: {worst.mean_deg:.3g}°", worst.mean_deg
    for row in neutral:
        subject.check(
            "specular normals, mean error",
            row.mean_deg,
            evaluation.MAX_NORMAL_ERROR_DEG,
            "°",
            state_title(row.state),
            masked=row.masked,
            coverage=row.coverage,
            worst=where,
            worst_got=worst_got,
        )
    limit, skin = (
        100 * evaluation.MAX_HEIGHT_ERROR,
        page.build_single_subject_note(truth.parameters),
    )
    yield page.build_view("relief_errors", states=rows, limit=limit, skin=skin)


def _strain(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    appearance, truth = subject.appearance, subject.truth
    document = read_document(appearance, STRAIN_FILE)
    if document is None:
        return
    errors = [] if truth is None else evaluation.compare_stretch(appearance, truth)
    true = {row.state: row.truth for row in errors}
    if errors:
        worst = max(errors, key=lambda row: abs(row.error))
        got, where = abs(worst.error), state_title(worst.state)
        text = "stretch ratio, largest error"
        subject.check(text, got, evaluation.MAX_STRAIN_ERROR, worst=where)
    yield page.build_view("strain", states=document["states"], truths=true, degrees=math.degrees)


def _histograms(appearance: SkinAppearance) -> Iterator[page.Block]:
    document = read_document(appearance, HISTOGRAM_FILE)
    if document is None:
        return
    states = sorted(document["states"], key=lambda state: _by_step(state["name"]))
    chosen = _select_states(states)
    counts = [np.asarray(state["counts"], float) for state in chosen]
    top = max((float(np.sqrt(count).max()) for count in counts), default=1.0)
    panels = []
    for state, count in zip(chosen, counts, strict=True):
        side = len(count)
        cut = round(side * (1 - SHOWN_HISTOGRAM_FRACTION) / 2)
        # rows hold n across the jaws from -1: the page shows + at the top
        shown = np.sqrt(count)[::-1][cut : side - cut, cut : side - cut]
        drawing = map_images.MapDrawing("histogram of normals", width=WIDTH_PX)
        panels.append(drawing.size(state_title(state["name"]), shown, top))
    aliased = [state_title(state["name"]) for state in states if state["aliased"]]
    yield page.Heading("Histograms of normals, square root of frequency")
    yield page.build_note("Horizontal: along the jaws. Vertical: across the jaws.")
    yield page.Images(panels, small=True)
    if aliased:
        yield page.build_note(
            f"Too few samples per bin in {'; '.join(aliased)}. Distances between these "
            "histograms are sampling noise."
        )


def _variances(appearance: SkinAppearance) -> Iterator[page.Block]:
    by_angle = evaluation.normal_variances(appearance)
    if not by_angle:
        return
    series = [
        figures.PlotSeries(
            f"jaws at {angle:.0f}°",
            [row[0] for row in rows],
            [row[2] for row in rows],
            [row[3] for row in rows],
        )
        for angle, rows in by_angle.items()
    ]
    plot = figures.draw_curves(
        "roughness along the jaws", "stretch ratio r of the skin", "variance of n", series
    )
    yield page.Plots([plot])


def _select_states(states: Sequence[T]) -> list[T]:
    """Return at most `MAX_SHOWN_STATES` strain steps at even intervals."""
    count = min(MAX_SHOWN_STATES, len(states))
    return [states[round(k)] for k in np.linspace(0, len(states) - 1, count)]


def _by_step(state: str) -> tuple[str, int]:
    angle, step = state.split("_")
    return angle, int(step[1:]) * (-1 if step[0] == "m" else 1)


def draw_kernels(subject: page.ReportedAppearance) -> Iterator[page.Block]:
    """Yield kernels by strain step and direction, and check their residual distances.

    Parameters
    ----------
    subject
        With the kernel document; without it nothing is yielded.
    """
    document = read_document(subject.appearance, KERNEL_FILE)
    if document is None or not document["fits"]:
        return
    fits: Sequence[Mapping[str, Any]] = sorted(document["fits"], key=lambda fit: fit["stretch_s"])
    judged = [fit for fit in fits if fit["valid"] and _is_significant(fit)]
    if judged:
        worst = max(judged, key=lambda fit: fit["distance"] / fit["distance_before"])
        got = worst["distance"] / worst["distance_before"]
        where = state_title(worst["name"])
        text = "ratio of histogram distances after and before the kernel, largest"
        subject.check(text, got, evaluation.MAX_HISTOGRAM_DISTANCE, worst=where)
    untold = [state_title(fit["name"]) for fit in fits if fit["valid"] and not _is_significant(fit)]
    yield page.build_view("kernels", fits=fits, untold=untold)
    yield page.Plots(_kernel_plots(fits, document.get("tables", [])))
    if direction := document.get("direction"):
        yield page.build_view("kernel_directions", found=direction)


def _kernel_plots(
    fits: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Draw strength and width of kernels over the stretch of the skin."""
    plots = []
    for key, error, title in (
        ("alpha", "alpha_stderr", "kernel strength alpha"),
        ("sigma_um", "sigma_stderr_um", "kernel width sigma, um"),
    ):
        points: dict[float, list[tuple[float, float, float]]] = {}
        for fit in fits:
            if fit["valid"]:
                points.setdefault(fit["angle_deg"], []).append(
                    (fit["stretch_s"], parse_number(fit[key]), parse_number(fit[error]))
                )
        series = []
        for angle, rows in points.items():
            stretch, values, errors = (list(column) for column in zip(*rows, strict=True))
            name = f"jaws at {angle:.0f}°"
            series.append(figures.PlotSeries(name, stretch, values, errors, line=False))
        for table in tables:
            line = table["lines"]
            drawn = [parse_number(v) for v in line[key]]
            series.append(
                figures.PlotSeries(f"fit, {table['name']}", line["stretch"], drawn, marks=False)
            )
        if series:
            plots.append(figures.draw_curves(title, "stretch ratio r of the skin", title, series))
    return plots


def _is_significant(fit: Mapping[str, Any]) -> bool:
    """Return whether strain changes the histogram by more than twice the sampling noise."""
    return parse_number(fit["distance_before"]) > 2.0 * parse_number(fit["noise_floor"])
