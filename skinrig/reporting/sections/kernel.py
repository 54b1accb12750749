"""The report's section on kernels that turn the relief of resting skin into that of strained."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from model.skin import SkinAppearance
from reconstruction.pipeline.gradient.stages import KERNEL_FILE
from skinrig.drawing import figures
from skinrig.evaluating import microrelief as evaluation
from skinrig.evaluating.subsurface import document_of, number
from skinrig.reporting import page
from skinrig.reporting.map_names import state_words


def section(
    name: str, appearance: SkinAppearance, checks: list[page.Check]
) -> Iterator[page.Block]:
    """Yield kernels by state and direction, and judge the distances that they leave.

    Parameters
    ----------
    name
        For headings.
    appearance
        With the kernel document; without it nothing is returned.
    checks
        A judgement is added to it.
    """
    document = document_of(appearance, KERNEL_FILE)
    if document is None or not document["fits"]:
        return
    fits: Sequence[Mapping[str, Any]] = sorted(document["fits"], key=lambda fit: fit["stretch_s"])
    judged = [fit for fit in fits if fit["valid"] and _told(fit)]
    if judged:
        worst = max(judged, key=lambda fit: fit["distance"] / fit["distance_before"])
        got = worst["distance"] / worst["distance_before"]
        where = state_words(worst["name"])
        text = f"{name}: histogram distance after the kernel over that before, worst state"
        limit = evaluation.MAX_HISTOGRAM_DISTANCE
        checks.append(page.Check(text, got, limit, "<=", worst=where))
    untold = [state_words(fit["name"]) for fit in fits if fit["valid"] and not _told(fit)]
    yield page.view("kernels", fits=fits, untold=untold)
    yield page.Plots(_plots(fits, document.get("tables", [])))
    if direction := document.get("direction"):
        yield page.view("kernel_directions", found=direction)


def _plots(fits: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]) -> list[str]:
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
                    (fit["stretch_s"], number(fit[key]), number(fit[error]))
                )
        series = []
        for angle, rows in points.items():
            stretch, values, errors = (list(column) for column in zip(*rows, strict=True))
            name = f"jaws at {angle:.0f}°"
            series.append(figures.Curve(name, stretch, values, errors, line=False))
        for table in tables:
            line = table["lines"]
            drawn = [number(v) for v in line[key]]
            series.append(
                figures.Curve(f"lines, {table['name']}", line["stretch"], drawn, marks=False)
            )
        if series:
            plots.append(figures.curves(title, "stretch ratio r of the skin", title, series))
    return plots


def _told(fit: Mapping[str, Any]) -> bool:
    """Return whether a strain changes the histogram by more than twice what chance does."""
    return number(fit["distance_before"]) > 2.0 * number(fit["noise_floor"])
