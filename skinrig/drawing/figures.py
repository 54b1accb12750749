"""Draw the plots of the report as deterministic SVG text."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from skinrig.arrays import FloatArray
from skinrig.drawing import svg

SERIES_COLORS = ("#2a78b8", "#d1602c", "#3f8f4f", "#8458a8")
SMALL_TEXT_PT = 9
"""Size of the smallest text of a plot, points; 12 pixels in a browser."""


def create_canvas(width_in: float, height_in: float) -> tuple[Any, Any]:
    """Create a figure without background, and its axes; sizes in inches."""
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


def to_svg(figure: Any, alt: str) -> str:
    """Convert a figure to SVG text with the alternative text ``alt``."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    # savefig draws twice, first for the layout; print_svg computes the layout in its single pass
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    return svg.simplify_svg(buffer.getvalue(), alt=alt)


def format_log_axes(*log_axes: Any) -> None:
    """Label decades of logarithmic axes by plain numbers, and ticks between a few decades."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    for axis in log_axes:
        low, high = axis.get_view_interval()
        plain = FuncFormatter(lambda value, _: f"{value:g}")
        axis.set_major_formatter(plain)
        few = high < 30.0 * low
        some = FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")
        axis.set_minor_formatter(some if few else NullFormatter())
        axis.set_tick_params(which="minor", labelsize=SMALL_TEXT_PT)


def format_range(values: FloatArray) -> str:
    """Format the range of the finite values."""
    finite = values[np.isfinite(values)]
    return f"{finite.min():.3g} to {finite.max():.3g}" if finite.size else "none"


def draw_bars(
    title: str,
    labels: Sequence[str],
    series: Mapping[str, FloatArray | Sequence[float]],
    *,
    unit: str,
    limits: Mapping[str, float] | None = None,
) -> str:
    """Draw groups of bars, one group per label, one bar per series; NaN leaves a gap.

    The limit of a series in ``limits`` is a dashed line of its color.
    """
    figure, axes = create_canvas(6.2, 3.0)
    position = np.arange(len(labels))
    width = 0.8 / max(len(series), 1)
    words = []
    for number, (name, values) in enumerate(series.items()):
        color, shift = SERIES_COLORS[number % len(SERIES_COLORS)], number - (len(series) - 1) / 2
        heights = np.asarray(values, float)
        axes.bar(position + shift * width, heights, width, label=name, color=color)
        if limits and name in limits:
            axes.axhline(limits[name], color=color, ls="--", lw=1)
        known = zip(labels, heights, strict=True)
        shown = (f"{' '.join(label.split())} {h:.3g}" for label, h in known if np.isfinite(h))
        words.append(f"{name}: {', '.join(shown)}")
    axes.set_xticks(position, labels, fontsize=SMALL_TEXT_PT)
    _title(axes, title, y_name=unit)
    held = "".join(f"; limit of {name} {limit:.3g}" for name, limit in (limits or {}).items())
    return to_svg(figure, f"{title}, {unit}: {'; '.join(words)}{held}")


@dataclass(frozen=True, slots=True)
class IntervalSeries:
    """Points with an interval each, and the range that they should reach."""

    name: str
    values: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    accepted: tuple[float, float]
    """Range drawn as a band."""


def draw_intervals(
    title: str, labels: Sequence[str], series: Sequence[IntervalSeries], *, unit: str
) -> str:
    """Draw points with their intervals above labels, and each series' accepted range as a band."""
    figure, axes = create_canvas(6.2, 3.0)
    position = np.arange(len(labels), dtype=float)
    words = []
    for number, one in enumerate(series):
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        values, low, high = (np.asarray(part, float) for part in (one.values, one.low, one.high))
        bars = np.maximum(np.stack([values - low, high - values]), 0.0)
        shift = 0.15 * (number - (len(series) - 1) / 2)
        look = {"fmt": "o", "color": color, "ms": 4, "elinewidth": 1, "capsize": 2}
        axes.axhspan(*one.accepted, color=color, alpha=0.15, lw=0)
        axes.errorbar(position + shift, values, yerr=bars, label=one.name, **look)
        known = zip(labels, values, strict=True)
        shown = (f"{' '.join(label.split())} {v:.3g}" for label, v in known if np.isfinite(v))
        span = f"accepted {one.accepted[0]:g} to {one.accepted[1]:g}"
        words.append(f"{one.name} ({span}): {', '.join(shown)}")
    axes.set_xticks(position, labels, fontsize=8)
    axes.set_xlim(-0.5, len(labels) - 0.5)
    _title(axes, title, y_name=unit)
    return to_svg(figure, f"{title}, {unit}: {'; '.join(words)}")


def _title(axes: Any, title: str, y_name: str, x_name: str = "") -> None:
    axes.set_xlabel(x_name)
    axes.set_ylabel(y_name)
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=SMALL_TEXT_PT, frameon=False)


@dataclass(frozen=True, slots=True)
class PlotSeries:
    """One series of a plot: points with standard uncertainties, a line, or both."""

    name: str
    x: Sequence[float] | FloatArray
    y: Sequence[float] | FloatArray
    stderr: Sequence[float] | FloatArray | None = None
    marks: bool = True
    """Whether points are marked."""
    line: bool = True
    """Whether points are connected."""
    color: str | None = None
    """A color of matplotlib; None: by the order of the series."""


def draw_curves(
    title: str, x_name: str, y_name: str, series: Sequence[PlotSeries], *, log_y: bool = False
) -> str:
    """Draw series over a common axis with bars of one standard uncertainty; NaN leaves a gap.

    On a logarithmic axis, values at or below zero leave a gap, too.
    """
    figure, axes = create_canvas(5.2, 3.4)
    for number, curve in enumerate(series):
        color = curve.color or SERIES_COLORS[number % len(SERIES_COLORS)]
        style = ("o" if curve.marks else "") + ("-" if curve.line else "")
        x, y = np.asarray(curve.x, float), np.asarray(curve.y, float)
        if log_y:
            y = np.where(y > 0.0, y, np.nan)
        if curve.stderr is None:
            axes.plot(x, y, style or "o", color=color, ms=4, lw=1.2, label=curve.name)
            continue
        bars = np.where(np.isfinite(curve.stderr), np.asarray(curve.stderr, float), 0.0)
        down = np.fmin(bars, 0.999 * y) if log_y else bars  # a log axis cannot show zero
        look = {"fmt": style or "o", "color": color, "ms": 4, "lw": 1.2, "elinewidth": 1}
        axes.errorbar(x, y, yerr=np.stack([down, bars]), label=curve.name, **look)
    if log_y:
        axes.set_yscale("log")
        format_log_axes(axes.yaxis)
    _title(axes, title, y_name, x_name)
    spans = "; ".join(
        f"{curve.name} {format_range(np.asarray(curve.y, float))} over "
        f"{format_range(np.asarray(curve.x, float))}"
        for curve in series
    )
    return to_svg(figure, f"{title}: {y_name} against {x_name}; {spans}")


def draw_sensitivity(title: str, c_m: FloatArray, c_hd: FloatArray, percent: FloatArray) -> str:
    """Draw the Cramér-Rao bound over melanin and blood volume fractions, in percent.

    Parameters
    ----------
    title
        Title with the chromophore.
    c_m, c_hd
        (N,) and (M,) volume fractions.
    percent
        (N, M) Cramér-Rao bound of the relative standard deviation; contours at 1, 3, 10, 30
        and 100 %.
    """
    figure, axes = create_canvas(4.2, 3.2)
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
        axes.clabel(contour, fmt="%g %%", fontsize=SMALL_TEXT_PT)
    ticks = np.array([0.001, 0.01, 0.05, 0.15, 0.3, 0.5])
    axes.set_xticks(np.cbrt(ticks), [f"{t:g}" for t in ticks], fontsize=SMALL_TEXT_PT)
    axes.set_yticks(np.cbrt(ticks[:-1]), [f"{t:g}" for t in ticks[:-1]], fontsize=SMALL_TEXT_PT)
    axes.set_xlim(np.cbrt(c_m[0]), np.cbrt(c_m[-1]))
    axes.set_ylim(np.cbrt(c_hd[0]), np.cbrt(c_hd[-1]))
    axes.set_xlabel("melanosome volume fraction C_m")
    axes.set_ylabel("blood volume fraction C_hd")
    axes.set_title(title, fontsize=10)
    figure.colorbar(mesh, ax=axes, label="log10 of the bound in percent")
    row, column = np.unravel_index(int(np.argmin(shown)), shown.shape)
    alt = (
        f"{title}: smallest Cramér-Rao bound {shown[row, column]:.2g} % at melanin "
        f"{c_m[column]:.2g}, blood {c_hd[row]:.2g}; below 10 % on "
        f"{100 * float(np.mean(shown < 10)):.0f} %, above 100 % on "
        f"{100 * float(np.mean(shown > 100)):.0f} % of the plane"
    )
    return to_svg(figure, alt)
