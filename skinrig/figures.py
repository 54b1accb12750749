"""Plots of the report as SVG text, equal bytes for equal input."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skinrig import svg

_COLORS = ("#2a78b8", "#d1602c", "#3f8f4f", "#8458a8")


def _figure(width_in: float, height_in: float) -> tuple[Any, Any]:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    mpl.rcParams["svg.hashsalt"] = "skinrig"
    mpl.rcParams["svg.fonttype"] = "none"
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    # transparent on the page; strokes and text take the page's color through CSS
    figure.patch.set_alpha(0.0)
    axes.patch.set_alpha(0.0)
    return figure, axes


def _svg(figure: Any, alt: str) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return svg.simplified(buffer.getvalue(), alt=alt)


def _plain_numbers(*log_axes: Any) -> None:
    """Label decades by plain numbers, and what lies between them where decades are too few."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for axis in log_axes:
        low, high = axis.get_view_interval()
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axis.set_major_formatter(plain)
        few = high < 30.0 * low
        some = FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
        axis.set_minor_formatter(some if few else NullFormatter())
        axis.set_tick_params(which="minor", labelsize=7)


def _span(values: NDArray[np.floating]) -> str:
    """Return the ends of what is finite, as words."""
    finite = values[np.isfinite(values)]
    return f"{finite.min():.3g} to {finite.max():.3g}" if finite.size else "none"


def error_against_seconds(stage: str, document: Mapping[str, Any]) -> str:
    """Draw one stage of a benchmark document: error against seconds, log-log.

    Parameters
    ----------
    stage
        Name, for the title.
    document
        The stage's entry in a ``skinrig.bench/2`` document.

    Returns
    -------
    str
        An image with a name, as SVG. The Pareto front of each condition is joined, in a color of
        its own, and its points are labelled with their effort; others are hollow. Knees have a
        ring, and the Cramer-Rao bound a dash where it is known.
    """
    figure, axes = _figure(5.2, 3.4)
    points, fronts = document["points"], document["fronts"]
    seconds = np.array([p["seconds"] for p in points], float)
    error = np.array([p["error"] for p in points], float)
    low = np.array([p["error_interval"][0] for p in points], float)
    high = np.array([p["error_interval"][1] for p in points], float)
    exact = ~(error > 0.0)
    if exact.any() and not exact.all():  # a log axis has no place for 0: below the others
        error = np.where(exact, error[~exact].min() / 10.0, error)
        low, high = np.where(exact, error, low), np.where(exact, error, high)
    bars = np.maximum(np.stack([error - low, high - error]), 0.0)
    bars[0] = np.minimum(bars[0], 0.999 * error)  # a log axis has no room for zero
    middle = np.log([seconds.min(), seconds.max()]).mean()
    named = len(fronts) <= MOST_NAMED
    for number, front in enumerate(fronts):
        color = _COLORS[number % len(_COLORS)]
        own = np.array([_shares(p, front["condition"]) for p in points])
        best = np.array(front["points"], int)
        beaten = np.setdiff1d(np.flatnonzero(own), best)
        axes.errorbar(
            seconds[own], error[own], yerr=bars[:, own], fmt="none", ecolor=color, elinewidth=1
        )
        axes.plot(seconds[beaten], error[beaten], "o", mfc="none", mec=color, ms=4)
        what = _words(front["condition"]) or "front"
        axes.plot(
            seconds[best], error[best], "o-", color=color, ms=4, label=what if named else None
        )
        bend = front["knee"]
        if bend is not None:
            axes.plot(seconds[bend], error[bend], "o", mfc="none", mec="0.5", ms=11)
        for index in best if named or len(best) > 1 else ():
            effort = {
                k: v for k, v in points[index]["knobs"].items() if k not in front["condition"]
            }
            label = _words(effort)
            label += "  (knee)" if index == bend else ""
            label += "  (error 0)" if exact[index] else ""
            # names of points on the right run to the left, into the plot
            right = np.log(seconds[index]) > middle
            words = axes.annotate(
                label, (seconds[index], error[index]), xytext=(-5 if right else 5, 5),
                textcoords="offset points", ha="right" if right else "left", fontsize=6,
            )  # fmt: skip
            words.set_in_layout(False)  # a long label must not squeeze the axes away
    bounds = np.array([p.get("cramer_rao_bound") or np.nan for p in points], float)
    if np.isfinite(bounds).any():
        known = np.isfinite(bounds)
        axes.plot(seconds[known], bounds[known], "_", color="0.5", ms=14, label="Cramér-Rao")
    if document.get("reference_error", 0) > 0:
        axes.axhline(
            document["reference_error"], color="0.5", lw=0.8, ls=":", label="reference's own"
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.25, y=0.2)
    _plain_numbers(axes.xaxis, axes.yaxis)
    axes.set_xlabel("seconds, warm, median")
    axes.set_ylabel("\n".join(textwrap.wrap(document["error_name"], 36)))
    small = document.get("size") == "small"
    axes.set_title(f"{stage}, small size" if small else stage, fontsize=10)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=6, frameon=False)
    told = "; ".join(
        f"{_words(front['condition']) or 'front'}: {len(front['points'])} settings"
        + (
            ""
            if front["knee"] is None
            else f", knee at {seconds[front['knee']]:.3g} s, error {error[front['knee']]:.3g}"
        )
        for front in fronts[:MOST_NAMED]
    )
    alt = (
        f"{stage}: {document['error_name']}, {_span(error)}, against {_span(seconds)} seconds for "
        f"{len(points)} settings; fronts: {told}"
    )
    return _svg(figure, alt)


MOST_NAMED = 6
"""Fronts that a plot has room to name; of more, only those of several points are labelled."""


def _shares(point: Mapping[str, Any], condition: Mapping[str, Any]) -> bool:
    return all(point["knobs"].get(name) == value for name, value in condition.items())


def _words(knobs: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v}" for k, v in knobs.items() if v is not None)


def bars(
    title: str,
    labels: Sequence[str],
    series: Mapping[str, NDArray[np.floating] | Sequence[float]],
    *,
    unit: str,
    limit: float | None = None,
) -> str:
    """Draw groups of bars, one group a label, one bar a series; NaN leaves a gap."""
    figure, axes = _figure(6.2, 3.0)
    position = np.arange(len(labels))
    width = 0.8 / max(len(series), 1)
    for number, (name, values) in enumerate(series.items()):
        axes.bar(
            position + (number - (len(series) - 1) / 2) * width,
            np.asarray(values, float),
            width,
            label=name,
            color=_COLORS[number % len(_COLORS)],
        )
    if limit is not None:
        axes.axhline(limit, color="0.5", ls="--", lw=1)
    axes.set_xticks(position, labels, fontsize=8)
    axes.set_ylabel(unit)
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=7, frameon=False)
    told = "; ".join(
        f"{name}: "
        + ", ".join(
            f"{' '.join(label.split())} {value:.3g}"
            for label, value in zip(labels, np.asarray(values, float), strict=True)
            if np.isfinite(value)
        )
        for name, values in series.items()
    )
    held = "" if limit is None else f"; limit {limit:g}"
    return _svg(figure, f"{title}, {unit}: {told}{held}")


@dataclass(frozen=True, slots=True)
class Curve:
    """One series of a plot: points with standard errors, a line, or both."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    stderr: Sequence[float] | None = None
    marks: bool = True
    """Whether points are marked."""
    line: bool = True
    """Whether they are joined."""
    color: str | None = None
    """As matplotlib knows it; None: by the order of the series."""


def curves(
    title: str, x_name: str, y_name: str, series: Sequence[Curve], *, log_y: bool = False
) -> str:
    """Draw series over a common axis, with bars of one standard error; NaN leaves a gap.

    On a logarithmic axis what is not above zero leaves a gap too.
    """
    figure, axes = _figure(5.2, 3.4)
    for number, curve in enumerate(series):
        color = curve.color or _COLORS[number % len(_COLORS)]
        style = ("o" if curve.marks else "") + ("-" if curve.line else "")
        x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
        if log_y:
            y = np.where(y > 0.0, y, np.nan)
        if curve.stderr is None:
            axes.plot(x, y, style or "o", color=color, ms=4, lw=1.2, label=curve.name)
            continue
        bars = np.where(np.isfinite(curve.stderr), np.asarray(curve.stderr, float), 0.0)
        down = np.fmin(bars, 0.999 * y) if log_y else bars  # a log axis has no room for zero
        axes.errorbar(
            x, y, yerr=np.stack([down, bars]), fmt=style or "o", color=color, ms=4, lw=1.2,
            elinewidth=1, label=curve.name,
        )  # fmt: skip
    if log_y:
        axes.set_yscale("log")
        _plain_numbers(axes.yaxis)
    axes.set_xlabel(x_name)
    axes.set_ylabel(y_name)
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=7, frameon=False)
    told = "; ".join(
        f"{curve.name} {_span(np.asarray(curve.y, float))} over {_span(np.asarray(curve.x, float))}"
        for curve in series
    )
    return _svg(figure, f"{title}: {y_name} against {x_name}; {told}")


def sensitivity(
    title: str,
    c_m: NDArray[np.floating],
    c_hd: NDArray[np.floating],
    percent: NDArray[np.floating],
) -> str:
    """Draw the least relative standard error over melanin and hemoglobin, in percent.

    Parameters
    ----------
    title
        Which chromophore.
    c_m, c_hd
        (N,) and (M,) volume fractions.
    percent
        (N, M) Cramer-Rao bound on the relative standard error; contours at 1, 3, 10, 30
        and 100 %.
    """
    figure, axes = _figure(4.2, 3.2)
    shown = np.clip(np.nan_to_num(percent, nan=1e4, posinf=1e4), 0.1, 1e3).T
    mesh = axes.pcolormesh(
        np.cbrt(c_m),
        np.cbrt(c_hd),
        np.log10(shown),
        cmap="viridis_r",
        shading="nearest",
        rasterized=True,
        vmin=-0.5,
        vmax=2.5,
    )
    if shown.min() < 100 < shown.max():
        contour = axes.contour(
            np.cbrt(c_m), np.cbrt(c_hd), shown, [1, 3, 10, 30, 100], colors="w", linewidths=0.7
        )
        axes.clabel(contour, fmt="%g %%", fontsize=7)
    ticks = np.array([0.001, 0.01, 0.05, 0.15, 0.3, 0.5])
    axes.set_xticks(np.cbrt(ticks), [f"{t:g}" for t in ticks], fontsize=7)
    axes.set_yticks(np.cbrt(ticks[:-1]), [f"{t:g}" for t in ticks[:-1]], fontsize=7)
    axes.set_xlim(np.cbrt(c_m[0]), np.cbrt(c_m[-1]))
    axes.set_ylim(np.cbrt(c_hd[0]), np.cbrt(c_hd[-1]))
    axes.set_xlabel("melanin fraction C_m")
    axes.set_ylabel("hemoglobin fraction C_hd")
    axes.set_title(title, fontsize=10)
    figure.colorbar(mesh, ax=axes, label="log10 of percent")
    row, column = np.unravel_index(int(np.argmin(shown)), shown.shape)
    alt = (
        f"{title}: least relative standard error {shown[row, column]:.2g} % at melanin "
        f"{c_m[column]:.2g}, hemoglobin {c_hd[row]:.2g}; below 10 % on "
        f"{100 * float(np.mean(shown < 10)):.0f} %, above 100 % on "
        f"{100 * float(np.mean(shown > 100)):.0f} % of the plane"
    )
    return _svg(figure, alt)


def compared_fronts(
    stage: str, a: tuple[str, Mapping[str, Any]], b: tuple[str, Mapping[str, Any]]
) -> str:
    """Draw one stage of two benchmarks: error against seconds of all settings, log-log.

    Parameters
    ----------
    stage
        Name, for the title.
    a, b
        Label and stage's entry of a ``skinrig.bench/2`` document.

    Returns
    -------
    str
        An image with a name, as SVG. Settings that both measured are joined by thin lines.
    """
    figure, axes = _figure(5.2, 3.4)
    places: list[dict[str, tuple[float, float]]] = []
    told = []
    for number, (label, document) in enumerate((a, b)):
        points = [p for p in document["points"] if p["error"] > 0.0]
        seconds = np.array([p["seconds"] for p in points], float)
        error = np.array([p["error"] for p in points], float)
        axes.plot(
            seconds, error, "os"[number], mfc="none" if number else None, ms=5,
            color=_COLORS[number], label=label,
        )  # fmt: skip
        places.append(
            {
                str(p["knobs"]): (s, e)
                for p, s, e in zip(points, seconds.tolist(), error.tolist(), strict=True)
            }
        )
        told.append(f"{label}: errors {_span(error)} in {_span(seconds)} seconds")
    for knobs in sorted(places[0].keys() & places[1].keys()):
        (s0, e0), (s1, e1) = places[0][knobs], places[1][knobs]
        axes.plot([s0, s1], [e0, e1], "-", color="0.5", lw=0.6, zorder=0)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.15, y=0.2)
    _plain_numbers(axes.xaxis, axes.yaxis)
    axes.set_xlabel("seconds, warm, median")
    axes.set_ylabel("\n".join(textwrap.wrap(a[1]["error_name"], 36)))
    axes.set_title(stage, fontsize=10)
    axes.legend(fontsize=7, frameon=False)
    return _svg(figure, f"{stage}: {'; '.join(told)}")
