"""Plots of benchmarks: error against seconds, for one run and for two."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinrig.benchmarks.results import SECONDS_NAME
from skinrig.drawing import figures, point_names


def plot_error_against_time(stage: str, document: Mapping[str, Any]) -> str:
    """Plot error against seconds of one stage on log-log axes, as SVG.

    Parameters
    ----------
    stage
        Name, for the title.
    document
        The stage's entry in a ``skinrig.bench/2`` document.

    Returns
    -------
    str
        SVG with an alternative text. Each condition has a color. The points of its Pareto front are
        joined and, where there is room, labeled with their settings; other points are hollow.
        Knees have a ring; a dash marks the Cramér-Rao bound where it is known.
    """
    figure, axes = figures.create_canvas(5.2, 3.4)
    points, fronts = document["points"], document["fronts"]
    seconds, error, bars, exact = _measured(points)
    labels: list[tuple[str, float, float]] = []
    joined = [best for front in fronts if len(best := np.array(front["points"], int)) > 1]
    named = len(fronts) <= MAX_NAMED_FRONTS
    for number, front in enumerate(fronts):
        color = figures.SERIES_COLORS[number % len(figures.SERIES_COLORS)]
        own = np.array([_matches_condition(p, front["condition"]) for p in points])
        best = np.array(front["points"], int)
        beaten = np.setdiff1d(np.flatnonzero(own), best)
        axes.errorbar(
            seconds[own], error[own], yerr=bars[:, own], fmt="none", ecolor=color, elinewidth=1
        )
        axes.plot(seconds[beaten], error[beaten], "o", mfc="none", mec=color, ms=4)
        what = _format_knobs(front["condition"]) or "front"
        axes.plot(
            seconds[best], error[best], "o-", color=color, ms=4, label=what if named else None
        )
        bend = front["knee"]
        if bend is not None:
            axes.plot(seconds[bend], error[bend], "o", mfc="none", mec="0.5", ms=11)
        for index in best if named or len(best) > 1 else ():
            label = _format_knobs(_effort(points, index, front["condition"]))
            label += "  (knee)" if index == bend else ""
            label += "  (error 0)" if exact[index] else ""
            labels.append((label, float(seconds[index]), float(error[index])))
    bounds = np.array([p.get("cramer_rao_bound") or np.nan for p in points], float)
    if np.isfinite(bounds).any():
        known = np.isfinite(bounds)
        axes.plot(seconds[known], bounds[known], "_", color="0.5", ms=14, label="Cramér-Rao bound")
    if document.get("reference_error", 0) > 0:
        axes.axhline(
            document["reference_error"], color="0.5", lw=0.8, ls=":", label="error of the reference"
        )
    axes.margins(x=0.25, y=0.2)
    small = document.get("size") == "small"
    _set_up_axes(axes, f"{stage}, small size" if small else stage, document)
    legend = None
    if axes.get_legend_handles_labels()[0]:
        legend = axes.legend(fontsize=figures.SMALL_TEXT_PT, frameon=False)
    ends = np.stack([error - bars[0], error + bars[1]])
    point_names.name_points(
        figure,
        axes,
        labels,
        points=list(zip(seconds.tolist(), error.tolist(), strict=True)),
        lines=[
            *(np.column_stack([seconds[best], error[best]]) for best in joined),
            *np.stack([np.stack([seconds, end], 1) for end in ends], 1),
        ],
        legend=legend,
    )
    summaries = "; ".join(_summary(front, seconds, error) for front in fronts[:MAX_NAMED_FRONTS])
    alt = (
        f"{stage}: {document['error_name']}, {figures.format_range(error)}, against "
        f"{figures.format_range(seconds)} seconds for {len(points)} settings; fronts: {summaries}"
    )
    return figures.to_svg(figure, alt)


def _measured(points: Sequence[Mapping[str, Any]]) -> tuple[NDArray[Any], ...]:
    """Return seconds, errors and error bars (2, n) fit for log axes, and a mask of zero errors."""
    # a log axis cannot show 0: times are at least the clock's resolution
    seconds = np.maximum(np.array([p["seconds"] for p in points], float), 1e-7)
    error = np.array([p["error"] for p in points], float)
    low, high = np.array([p["error_interval"] for p in points], float).T
    exact = ~(error > 0.0)
    if (
        exact.any() and not exact.all()
    ):  # an error of 0 is drawn a decade below the least other error
        error = np.where(exact, error[~exact].min() / 10.0, error)
        low, high = np.where(exact, error, low), np.where(exact, error, high)
    bars = np.maximum(np.stack([error - low, high - error]), 0.0)
    bars[0] = np.minimum(
        bars[0], 0.999 * error
    )  # the lower end of a bar stays above 0 on the log axis
    return seconds, error, bars, exact


def _effort(
    points: Sequence[Mapping[str, Any]], index: int, condition: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the knobs of a point that are not part of the condition and that differ by point."""
    return {
        k: v
        for k, v in points[index]["knobs"].items()
        if k not in condition and any(p["knobs"].get(k) != v for p in points)
    }


def _summary(front: Mapping[str, Any], seconds: NDArray[Any], error: NDArray[Any]) -> str:
    text = f"{_format_knobs(front['condition']) or 'front'}: {len(front['points'])} settings"
    bend = front["knee"]
    if bend is None:
        return text
    return f"{text}, knee at {seconds[bend]:.3g} s, error {error[bend]:.3g}"


def _set_up_axes(axes: Any, title: str, document: Mapping[str, Any]) -> None:
    """Set log scales, title and axis labels."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    figures.format_log_axes(axes.xaxis, axes.yaxis)
    axes.set_xlabel(document.get("seconds_name", SECONDS_NAME))
    axes.set_ylabel("\n".join(textwrap.wrap(document["error_name"], 36)))
    axes.set_title(title, fontsize=10)


MAX_NAMED_FRONTS = 6
"""Largest number of fronts whose points are all labeled; of more, only fronts of several points
are."""


def _matches_condition(point: Mapping[str, Any], condition: Mapping[str, Any]) -> bool:
    return all(point["knobs"].get(name) == value for name, value in condition.items())


def _format_knobs(knobs: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v}" for k, v in knobs.items() if v is not None)


def plot_compared_fronts(
    stage: str, a: tuple[str, Mapping[str, Any]], b: tuple[str, Mapping[str, Any]]
) -> str:
    """Plot error against seconds of one stage of two benchmarks on log-log axes, as SVG.

    Parameters
    ----------
    stage
        Name, for the title.
    a, b
        Label, and the stage's entry of a ``skinrig.bench/2`` document.

    Returns
    -------
    str
        SVG with an alternative text. Thin lines join settings that both benchmarks measured.
    """
    figure, axes = figures.create_canvas(5.2, 3.4)
    positions: list[dict[str, tuple[float, float]]] = []
    summaries = []
    for number, (label, document) in enumerate((a, b)):
        points = [p for p in document["points"] if p["error"] > 0.0]
        seconds = np.array([p["seconds"] for p in points], float)
        error = np.array([p["error"] for p in points], float)
        mark = {"mfc": "none" if number else None, "color": figures.SERIES_COLORS[number]}
        axes.plot(seconds, error, "os"[number], ms=5, label=label, **mark)
        positions.append(
            {
                str(p["knobs"]): (s, e)
                for p, s, e in zip(points, seconds.tolist(), error.tolist(), strict=True)
            }
        )
        summaries.append(
            f"{label}: errors {figures.format_range(error)} in {figures.format_range(seconds)}"
            f" seconds"
        )
    for knobs in sorted(positions[0].keys() & positions[1].keys()):
        (s0, e0), (s1, e1) = positions[0][knobs], positions[1][knobs]
        axes.plot([s0, s1], [e0, e1], "-", color="0.5", lw=0.6, zorder=0)
    axes.margins(x=0.15, y=0.2)
    _set_up_axes(axes, stage, a[1])
    axes.legend(fontsize=figures.SMALL_TEXT_PT, frameon=False)
    return figures.to_svg(figure, f"{stage}: {'; '.join(summaries)}")
