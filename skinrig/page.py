"""The pieces of the report page: checks, tables, map panels; text in, HTML out."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from skinrig import png

STYLE = resources.files("skinrig").joinpath("data/report.css").read_text(encoding="utf-8")


def escape(value: object) -> str:
    """Return ``value`` as text that is safe inside HTML."""
    return html.escape(str(value), quote=True)


@dataclass(frozen=True, slots=True)
class Check:
    """One promise, what was measured, and whether it was kept."""

    name: str
    got: float
    bound: float
    sense: Literal["<=", ">="]
    unit: str = ""
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether ``got`` keeps to ``bound``; NaN does not."""
        return self.got <= self.bound if self.sense == "<=" else self.got >= self.bound


def number(value: float) -> str:
    """Return a number with four significant digits, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.4g}"


def checks_table(checks: Sequence[Check]) -> str:
    """Return the table of checks, the missed ones first."""
    rows = []
    for check in sorted(checks, key=lambda c: c.passed):
        word, kind = ("kept", "good") if check.passed else ("missed", "bad")
        sign = "≤" if check.sense == "<=" else "≥"
        rows.append(
            f"<tr><td>{escape(check.name)}</td>"
            f"<td class=n>{number(check.got)} {escape(check.unit)}</td>"
            f"<td class=n>{sign} {number(check.bound)} {escape(check.unit)}</td>"
            f'<td class="{kind}">{word}</td><td>{escape(check.note)}</td></tr>'
        )
    return (
        "<table><thead><tr><th>check</th><th class=n>measured</th><th class=n>limit</th>"
        "<th>verdict</th><th>remark</th></tr></thead><tbody>" + "".join(rows) + "</tbody></table>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[object]], *, caption: str = "") -> str:
    """Return a table; numbers are set right-aligned with four digits."""

    def cell(value: object) -> str:
        if isinstance(value, (float, np.floating)):
            return f"<td class=n>{number(float(value))}</td>"
        if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
            return f"<td class=n>{value}</td>"
        return f"<td>{escape(value)}</td>"

    body = "".join("<tr>" + "".join(cell(v) for v in row) + "</tr>" for row in rows)
    title = f"<caption>{escape(caption)}</caption>" if caption else ""
    header = "".join(f"<th>{escape(h)}</th>" for h in head)
    return f"<table>{title}<thead><tr>{header}</tr></thead><tbody>{body}</tbody></table>"


def folded(title: str, body: str) -> str:
    """Return HTML that opens when its title is clicked; printed pages show the title only."""
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def facts(values: Mapping[str, object]) -> str:
    """Return a two-column table of names and values."""
    return table(("what", "value"), list(values.items()))


def shrink(image: NDArray[np.generic], width: int) -> NDArray[np.generic]:
    """Take every n-th pixel so that the image is at most ``width`` wide."""
    step = max(1, -(-image.shape[1] // width))
    return image[step // 2 :: step, step // 2 :: step]


def _picture(
    title: str,
    values: NDArray[np.floating],
    low: float,
    high: float,
    scale: str,
    valid: NDArray[np.bool_] | None,
    unit: str,
    width: int,
) -> str:
    small = shrink(values, width)
    mask = None if valid is None else shrink(valid, width).astype(bool)
    shown = small[mask] if mask is not None and mask.any() else small
    shown = shown[np.isfinite(shown)]
    median = number(float(np.median(shown))) if shown.size else "–"
    ramp = np.tile(np.linspace(low, high, 96)[None, :], (6, 1))
    alt = f"{title}: scale {number(low)} to {number(high)} {unit}, median {median}"
    return (
        f'<figure><img alt="{escape(alt)}" src="'
        f'{png.data_uri(png.colorize(small.astype(float), low, high, scale=scale, valid=mask))}">'
        f"<figcaption>{escape(title)}</figcaption>"
        f'<div class=scale><span>{number(low)}</span><img alt="" src="'
        f'{png.data_uri(png.colorize(ramp, low, high, scale=scale))}"><span>{number(high)} '
        f"{escape(unit)}</span></div></figure>"
    )


def color_picture(title: str, linear: NDArray[np.floating], *, width: int = 320) -> str:
    """Return a figure of a linear sRGB image, (H, W, 3)."""
    small = shrink(np.asarray(linear), width)
    return plain_picture(title, png.srgb8(small.astype(float)))


def plain_picture(title: str, image: NDArray[np.uint8]) -> str:
    """Return a figure of an 8-bit image, (H, W) or (H, W, 3), shown as it is."""
    return (
        f'<figure><img alt="{escape(title)}" src="{png.data_uri(image)}">'
        f"<figcaption>{escape(title)}</figcaption></figure>"
    )


def stored_picture(title: str, data: bytes) -> str:
    """Return a figure of a PNG file's bytes, as they are."""
    text = base64.b64encode(data).decode("ascii")
    return (
        f'<figure><img alt="{escape(title)}" src="data:image/png;base64,{text}">'
        f"<figcaption>{escape(title)}</figcaption></figure>"
    )


def scalar_picture(
    title: str,
    values: NDArray[np.floating],
    *,
    low: float,
    high: float,
    scale: str = "viridis",
    valid: NDArray[np.bool_] | None = None,
    unit: str = "",
    width: int = 280,
) -> str:
    """Return a figure of a map, (H, W), with its color scale; pixels not valid are gray."""
    return _picture(title, values, low, high, scale, valid, unit, width)


def map_panel(
    name: str,
    unit: str,
    *,
    estimate: NDArray[np.floating],
    standard_error: NDArray[np.floating] | None = None,
    truth: NDArray[np.floating] | None = None,
    valid: NDArray[np.bool_] | None = None,
    width: int = 280,
) -> str:
    """Return truth | estimate | error | standard error of a map, truth and estimate to one scale.

    Parameters
    ----------
    name, unit
        Of the map, for headings and scales.
    estimate, standard_error, truth
        (H, W); what is None is left out of the row.
    valid
        (H, W); other pixels are gray.
    width
        Pixels across; larger maps are thinned out.
    """
    mask = np.isfinite(estimate) if valid is None else np.asarray(valid, bool)
    of_scale = [estimate[mask & np.isfinite(estimate)]]
    if truth is not None:
        of_scale.append(truth[mask & np.isfinite(truth)])
    joined = np.concatenate(of_scale)
    low, high = np.percentile(joined, [1, 99]) if joined.size else (0.0, 1.0)
    parts = []
    if truth is not None:
        parts.append(_picture("truth", truth, low, high, "viridis", mask, unit, width))
    parts.append(_picture("estimate", estimate, low, high, "viridis", mask, unit, width))
    if truth is not None:
        error = estimate - truth
        inside = np.abs(error[mask & np.isfinite(error)])
        reach = float(np.percentile(inside, 98)) if inside.size else 1.0
        parts.append(
            _picture("estimate − truth", error, -reach, reach, "RdBu_r", mask, unit, width)
        )
    if standard_error is not None:
        inside = standard_error[mask & np.isfinite(standard_error)]
        reach = float(np.percentile(inside, 98)) if inside.size else 1.0
        parts.append(
            _picture("standard error", standard_error, 0.0, reach, "magma", mask, unit, width)
        )
    return f"<h3>{escape(name)}</h3><div class=maps>{''.join(parts)}</div>"


def document(title: str, body: str) -> str:
    """Return the whole page; it makes no request and runs no script."""
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "img-src data:; style-src 'unsafe-inline'\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>"
        f"<body><main>{body}</main></body></html>\n"
    )
