"""The report's section on kernels that turn the relief of resting skin into that of strained."""

from __future__ import annotations

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
        checks.append(
            page.Check(
                f"{name}: histogram distance after the kernel over that before, worst state",
                worst["distance"] / worst["distance_before"],
                evaluation.MAX_HISTOGRAM_DISTANCE,
                "<=",
                "",
                worst=state_words(worst["name"]),
            )
        )
    untold = [state_words(fit["name"]) for fit in fits if fit["valid"] and not _told(fit)]
    yield page.Heading("Convolution kernels")
    if untold:
        yield page.note(
            f"The patch is too small for {'; '.join(untold)}: two histograms of one skin of this "
            "size differ by more than half of what the strain changes, so that the distance left "
            "by the kernel is not judged."
        )
    yield page.records(
        fits,
        (
            ("state", lambda fit: state_words(fit["name"])),
            ("r", lambda fit: fit["stretch_s"]),
            ("alpha", lambda fit: number(fit.get("alpha"))),
            ("standard error", lambda fit: number(fit.get("alpha_stderr"))),
            ("95 % half width", lambda fit: number(fit.get("alpha_95"))),
            ("sigma, um", lambda fit: number(fit.get("sigma_um"))),
            ("standard error, um", lambda fit: number(fit.get("sigma_stderr_um"))),
            ("95 % half width, um", lambda fit: number(fit.get("sigma_95_um"))),
            ("distance before", lambda fit: number(fit["distance_before"])),
            ("after", lambda fit: number(fit["distance"])),
            ("other skin of this size", lambda fit: number(fit.get("noise_floor"))),
            ("nearly as good", lambda fit: fit.get("near_best_count", 0)),
            ("fitted", lambda fit: "yes" if fit["valid"] else "no"),
        ),
        caption="Kernels fitted to histograms of normals; distances before and after each. "
        "Kernel errors are not Gaussian: 95 % half widths differ from 1.96 standard errors",
    )
    yield page.Plots(_plots(fits, document.get("tables", [])))
    yield from _direction(document.get("direction"))


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
        series = [
            figures.Curve(
                f"jaws at {angle:.0f}°",
                [row[0] for row in rows],
                [row[1] for row in rows],
                [row[2] for row in rows],
                line=False,
            )
            for angle, rows in points.items()
        ]
        for table in tables:
            line = table["lines"]
            series.append(
                figures.Curve(
                    f"lines, {table['name']}",
                    line["stretch"],
                    [number(v) for v in line[key]],
                    marks=False,
                )
            )
        if series:
            plots.append(figures.curves(title, "stretch ratio r of the skin", title, series))
    return plots


def _direction(found: Mapping[str, Any] | None) -> Iterator[page.Block]:
    if not found:
        return
    rows = [
        (angle, number(alpha), number(alpha_error), number(sigma), number(sigma_error))
        for angle, alpha, alpha_error, sigma, sigma_error in zip(
            found["angle_deg"],
            found["alpha_offset"],
            found["alpha_stderr"],
            found["sigma_offset_um"],
            found["sigma_stderr_um"],
            strict=True,
        )
    ]
    yield page.Heading("Kernels by the direction of stretch, less one table of all")
    yield page.table(
        ("jaws at, °", "alpha", "standard error", "sigma, um", "standard error, um"),
        rows,
        caption="Offsets of each direction",
    )
    yield page.note(
        "Chance of such differences where the direction does not matter: alpha "
        f"{100 * number(found['p_alpha']):.2g} %, sigma {100 * number(found['p_sigma']):.2g} %."
    )


def _told(fit: Mapping[str, Any]) -> bool:
    """Return whether a strain changes the histogram by more than twice what chance does."""
    return number(fit["distance_before"]) > 2.0 * number(fit["noise_floor"])
