"""The report's section on kernels that turn the relief of resting skin into that of strained."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from model.skin import SkinAppearance
from reconstruction.pipeline.gradient.stages import KERNEL_FILE
from skinrig.drawing import figures
from skinrig.evaluating import microrelief as evaluation
from skinrig.reporting import page
from skinrig.reporting.map_names import state_words

_ALPHA_AND_SIGMA = (
    "alpha",
    "alpha_stderr",
    "alpha_95",
    "sigma_um",
    "sigma_stderr_um",
    "sigma_95_um",
)


def section(name: str, appearance: SkinAppearance, checks: list[page.Check]) -> str:
    """Return kernels by state and direction, and judge the distances that they leave.

    Parameters
    ----------
    name
        For headings.
    appearance
        With the kernel document; without it nothing is returned.
    checks
        A judgement is added to it.
    """
    document = evaluation.document_of(appearance, KERNEL_FILE)
    if document is None or not document["fits"]:
        return ""
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
    note = (
        page.note(
            f"The patch is too small for {'; '.join(untold)}: two histograms of one skin of this "
            "size differ by more than half of what the strain changes, so that the distance left "
            "by the kernel is not judged."
        )
        if untold
        else ""
    )
    body = (
        "<h3>Convolution kernels</h3>"
        + note
        + page.table(
            (
                "state",
                "r",
                "alpha",
                "standard error",
                "95 % half width",
                "sigma, um",
                "standard error, um",
                "95 % half width, um",
                "distance before",
                "after",
                "other skin of this size",
                "nearly as good",
                "fitted",
            ),
            [
                (
                    state_words(fit["name"]),
                    fit["stretch_s"],
                    *(_value(fit.get(key)) for key in _ALPHA_AND_SIGMA),
                    _value(fit["distance_before"]),
                    _value(fit["distance"]),
                    _value(fit.get("noise_floor")),
                    fit.get("near_best_count", 0),
                    "yes" if fit["valid"] else "no",
                )
                for fit in fits
            ],
            caption="Kernels fitted to histograms of normals; distances before and after each. "
            "Kernel errors are not Gaussian: 95 % half widths differ from 1.96 standard errors",
        )
    )
    plots = ""
    for key, error, title in (
        ("alpha", "alpha_stderr", "kernel strength alpha"),
        ("sigma_um", "sigma_stderr_um", "kernel width sigma, um"),
    ):
        points: dict[float, list[tuple[float, float, float]]] = {}
        for fit in fits:
            if fit["valid"]:
                points.setdefault(fit["angle_deg"], []).append(
                    (fit["stretch_s"], _value(fit[key]), _value(fit[error]))
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
        for table in document.get("tables", []):
            line = table["lines"]
            series.append(
                figures.Curve(
                    f"lines, {table['name']}",
                    line["stretch"],
                    [_value(v) for v in line[key]],
                    marks=False,
                )
            )
        if series:
            plots += figures.curves(title, "stretch ratio r of the skin", title, series)
    return body + f"<div class='plots'>{plots}</div>" + _direction(document.get("direction"))


def _direction(found: Mapping[str, Any] | None) -> str:
    if not found:
        return ""
    rows = [
        (angle, _value(alpha), _value(alpha_error), _value(sigma), _value(sigma_error))
        for angle, alpha, alpha_error, sigma, sigma_error in zip(
            found["angle_deg"],
            found["alpha_offset"],
            found["alpha_stderr"],
            found["sigma_offset_um"],
            found["sigma_stderr_um"],
            strict=True,
        )
    ]
    return (
        "<h3>Kernels by the direction of stretch, less one table of all</h3>"
        + page.table(
            ("jaws at, °", "alpha", "standard error", "sigma, um", "standard error, um"),
            rows,
            caption="Offsets of each direction",
        )
        + "<p class='note'>Chance of such differences where the direction does not matter: alpha "
        f"{100 * _value(found['p_alpha']):.2g} %, sigma {100 * _value(found['p_sigma']):.2g} %."
        "</p>"
    )


def _told(fit: Mapping[str, Any]) -> bool:
    """Return whether a strain changes the histogram by more than twice what chance does."""
    return _value(fit["distance_before"]) > 2.0 * _value(fit["noise_floor"])


def _value(value: object) -> float:
    return math.nan if value is None else float(str(value))
