"""The pieces of the report page: checks, tables, the page itself; text in, HTML out."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Literal

import numpy as np

from skinrig.written_units import written

STYLE = resources.files("skinrig").joinpath("data/report.css").read_text(encoding="utf-8")
SHORT = 22
"""Characters up to which a cell's text is not broken over lines."""
BAR_STOPS = 17
"""Colors that a scale's bar runs through; between them it is straight in sRGB."""


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
    masked: float = float("nan")
    """Share of what was to be measured that has no estimate; NaN: does not apply."""
    coverage: float = float("nan")
    """Share of truths inside the 68 % intervals; NaN: not told."""
    worst: str = ""
    """Where it is worst, in words: a melanin band, a state, a channel."""
    worst_got: float = float("nan")
    """As large as it surely is there, in ``unit``; NaN where that is no number like ``got``."""

    @property
    def passed(self) -> bool:
        """Whether ``got`` keeps to ``bound``; NaN does not."""
        return self.got <= self.bound if self.sense == "<=" else self.got >= self.bound

    @property
    def used(self) -> float:
        """Share of the limit that is used up: above 1 it is missed; NaN where it has no sense."""
        if self.sense == ">=" or not self.bound > 0.0:
            return float("nan")
        return self.got / self.bound


def number(value: float) -> str:
    """Return a number with four significant digits, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.4g}"


def short_unit(unit: str) -> str:
    """Return a unit as tables and scales have room for; none where it is a plain number.

    Examples
    --------
    >>> short_unit("volume fraction of the epidermis"), short_unit("1"), short_unit("mm")
    ('volume fraction', '', 'mm')
    """
    return "" if unit == "1" else unit.split(" of ")[0]


def checks_table(checks: Sequence[Check]) -> str:
    """Return the table of checks, the missed ones first."""
    rows = []
    for check in sorted(checks, key=lambda c: c.passed):
        word, kind = ("kept", "good") if check.passed else ("missed", "bad")
        sign = "≤" if check.sense == "<=" else "≥"
        rows.append(
            f'<tr><td class="{kind}">{word}</td><th scope="row">{escape(check.name)}</th>'
            f'<td class="n">{_with_unit(check.got, check.unit)}</td>'
            f'<td class="n">{sign} {_with_unit(check.bound, check.unit)}</td>'
            f'<td class="n">{_percent(check.used)}</td>'
            f'<td class="n">{_percent(check.coverage)}</td>'
            f'<td class="n">{_percent(check.masked)}</td><td>{_joined(check.worst)}</td>'
            f"<td>{_joined(check.note)}</td></tr>"
        )
    head = (
        ("verdict", ""),
        ("check", ""),
        ("measured", "n"),
        ("limit", "n"),
        ("of the limit", "n"),
        ("truths in 68 % intervals", "n"),
        ("masked", "n"),
        ("worst", ""),
        ("remark", ""),
    )
    caption = "What was promised and what was measured; missed checks stand first"
    return _scrollable(_head(head, caption) + "".join(rows) + "</tbody></table>", caption)


def _with_unit(value: float, unit: str) -> str:
    return escape(written(number(value), unit))


def _joined(text: str) -> str:
    """Return text whose numbers keep their percent signs when a narrow cell breaks it."""
    return escape(text).replace(" %", "\N{NO-BREAK SPACE}%")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else ""


def _head(head: Sequence[tuple[str, str]], caption: str) -> str:
    cells = "".join(
        f'<th scope="col"{f""" class="{kind}" """.rstrip() if kind else ""}>{escape(title)}</th>'
        if title
        else "<td></td>"
        for title, kind in head
    )
    return f"<table><caption>{escape(caption)}</caption><thead><tr>{cells}</tr></thead><tbody>"


def _scrollable(body: str, name: str) -> str:
    """Return what may be wider than the page, so that a keyboard reaches all of it."""
    return f'<div class="scroll" tabindex="0" role="group" aria-label="{escape(name)}">{body}</div>'


def table(head: Sequence[str], rows: Sequence[Sequence[object]], *, caption: str) -> str:
    """Return a table; numbers are set right-aligned with four digits.

    Parameters
    ----------
    head
        Titles of columns; an empty one leaves its cell without a heading.
    rows
        Cells; the first of each row names it.
    caption
        What the table tells.
    """

    def cell(value: object, first: bool) -> str:
        if isinstance(value, (float, np.floating)):
            kind, text = "n", number(float(value))
        elif isinstance(value, (int, np.integer)) and not isinstance(value, bool):
            kind, text = "n", str(value)
        else:
            text = escape(value)
            kind = "k" if len(text) <= SHORT else ""
        marked = f' class="{kind}"' if kind else ""
        if first and text:
            return f'<th scope="row"{marked}>{text}</th>'
        return f"<td{marked}>{text}</td>"

    numeric = [
        bool(rows) and all(isinstance(row[k], (int, float, np.number)) for row in rows)
        for k in range(len(head))
    ]
    body = "".join(
        "<tr>" + "".join(cell(v, k == 0) for k, v in enumerate(row)) + "</tr>" for row in rows
    )
    titles = [(title, "n" if right else "") for title, right in zip(head, numeric, strict=True)]
    return _scrollable(_head(titles, caption) + body + "</tbody></table>", caption)


def folded(title: str, body: str) -> str:
    """Return HTML that opens when its title is clicked, and is open when printed."""
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def facts(values: Mapping[str, object], *, caption: str) -> str:
    """Return a two-column table of names and values."""
    return table(("what", "value"), list(values.items()), caption=caption)


def note(text: str) -> str:
    """Return a remark of plain text."""
    return f'<p class="note">{escape(text)}</p>'


def one_skin(parameters: Mapping[str, object]) -> str:
    """Return a remark on whom errors are of, where a session holds one subject and has no bands.

    Examples
    --------
    >>> one_skin({"preset": "III"})
    '<p class="note">Errors are of one subject, III: there are no bands to tell apart.</p>'
    """
    for key in ("subject", "preset"):
        if parameters.get(key):
            subject = parameters[key]
            return note(f"Errors are of one subject, {subject}: there are no bands to tell apart.")
    return note("Errors are of one subject: there are no bands to tell apart.")


def document(title: str, lead: str, sections: str) -> str:
    """Return the whole page; it makes no request and runs no script.

    Parameters
    ----------
    title
        Of the page.
    lead
        HTML of what stands first: the verdict.
    sections
        HTML of the rest; each ``<h2>`` begins a section of the table of contents.
    """
    head, contents, body = _in_sections(lead, sections)
    style = STYLE + _bars()
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    policy = (
        f"default-src 'none'; img-src data:; style-src 'sha256-{digest}'; base-uri 'none'; "
        "form-action 'none'"
    )
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{style}</style></head>"
        '<body><a class="skip" href="#content">Skip to the verdict</a>'
        f'<header><h1>{escape(title)}</h1></header><main id="content">{head}{contents}{body}'
        "</main></body></html>\n"
    )


def _in_sections(lead: str, sections: str) -> tuple[str, str, str]:
    """Return lead, contents and body, with an id and a landmark for each second heading."""
    taken: set[str] = {"content", "contents"}
    entries: list[tuple[str, str]] = []

    def wrapped(text: str) -> str:
        pieces = re.split(r"<h2>(.*?)</h2>", text)
        out = pieces[0]
        for heading, body in zip(pieces[1::2], pieces[2::2], strict=True):
            name = _anchor(heading, taken)
            entries.append((name, heading))
            out += (
                f'<section aria-labelledby="{name}"><h2 id="{name}">{heading}</h2>{body}</section>'
            )
        return out

    head, body = wrapped(lead), wrapped(sections)
    links = "".join(f'<li><a href="#{name}">{heading}</a></li>' for name, heading in entries)
    contents = (
        f'<nav aria-labelledby="contents"><h2 id="contents">Contents</h2><ul>{links}</ul></nav>'
    )
    return head, contents if entries else "", body


def _anchor(heading: str, taken: set[str]) -> str:
    """Return an id for a heading that no other has.

    Examples
    --------
    >>> taken = set()
    >>> _anchor("Maps: flash II", taken), _anchor("Maps: flash-II", taken)
    ('maps-flash-ii', 'maps-flash-ii-2')
    """
    plain = html.unescape(heading).casefold()
    name = re.sub(r"[^a-z0-9]+", "-", plain).strip("-") or "section"
    number_, free = 2, name
    while free in taken:
        free, number_ = f"{name}-{number_}", number_ + 1
    taken.add(free)
    return free


def _bars() -> str:
    """Return the style of the color scales' bars, of the same colors as the pictures."""
    from skinrig.drawing import png

    rules = []
    for scale, name in png.SCALES.items():
        stops = ",".join("#" + bytes(rgb).hex() for rgb in png.palette(scale, BAR_STOPS))
        rules.append(f".bar.{name}{{background:linear-gradient(90deg,{stops})}}")
    return "\n".join(rules)
