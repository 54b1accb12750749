"""Report section on a sequence: blood by region and phase, with time constants."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from model.skin import SkinAppearance
from reconstruction.pipeline.flash.sequence import CURVES_FILE
from skinrig.drawing import figures
from skinrig.evaluating.subsurface import parse_number
from skinrig.reporting import page

PLACE_COLORS = ("#2a78b8", "#d1602b", "#3f8f4f", "#8153a8", "#b8912a", "#555555")


def is_sequence(appearance: SkinAppearance) -> bool:
    """Return whether an appearance has curves of a sequence."""
    return CURVES_FILE in appearance.files


def section(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield the curves of all regions, their levels, time constants and phase coverage."""
    document = json.loads(appearance.files[CURVES_FILE])
    cycle_s = document.get("cycle_s")
    yield page.Heading(f"Blood volume fraction in time: {document['state']}")
    if cycle_s is not None:
        phases = document["phases"]
        yield page.build_note(
            f"{phases['captures']} images, one every {document['shot_period_s']:g} s, sample "
            f"{phases['distinct']} phases of a cycle of {cycle_s:g} s. The phases are "
            f"{phases['interval_s']:g} s apart. Images are ordered by flash time."
        )
    yield _curves(document, cycle_s)
    yield page.build_view("sequence", document=document, seen=_words)


def _curves(document: Mapping[str, Any], cycle_s: float | None) -> page.Plots:
    key, axis = ("phase_s", "phase, s") if cycle_s is not None else ("time_s", "time, s")
    when = np.array([parse_number(frame[key]) for frame in document["frames"]])
    order = np.argsort(when)
    curves = []
    for index, (place, one) in enumerate(document["curves"].items()):
        values = 100.0 * np.array([parse_number(v) for v in one["hemoglobin"]])
        errors = 100.0 * np.array([parse_number(v) for v in one["stderr"]])
        color, line = PLACE_COLORS[index % len(PLACE_COLORS)], cycle_s is None
        points = when[order], values[order], errors[order]
        curves.append(figures.PlotSeries(place, *points, line=line, color=color))
    title = f"blood volume fraction, {document['state']}"
    return page.Plots(
        [figures.draw_curves(title, axis, "blood volume fraction, % of the dermis", curves)]
    )


def _words(transition: Mapping[str, Any]) -> str:
    if not transition["decided"]:
        return "undetermined"
    power = transition.get("power")
    certain = "" if power is None else f" (power of the test: {100 * power:.0f} %)"
    return "yes" if transition["seen"] else f"no{certain}"
