"""Build the report page from checks and blocks drawn by templates."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal, TypeVar

import numpy as np
from markupsafe import Markup

from model.skin import SkinAppearance
from skinrig.drawing import frame_sheet, png, templates
from skinrig.reporting import map_names
from skinrig.unit_format import format_quantity, format_unit

Row = TypeVar("Row")

PAGE_STYLE = resources.files("skinrig").joinpath("data/report.css").read_text(encoding="utf-8")
PAGE_SCRIPT = resources.files("skinrig").joinpath("data/report.js").read_text(encoding="utf-8")
_IMAGE = re.compile(r'<img [^>]*src="(data:[^"]+)">')
MAX_UNBROKEN_CHARS = 22
"""Characters up to which the text of a cell is kept on one line."""
BAR_STOPS = 17
"""Colors of the bar of a color scale; linear in sRGB between them."""


@dataclass(frozen=True, slots=True)
class Check:
    """One limit and the measured value."""

    name: str
    got: float
    bound: float
    sense: Literal["<=", ">="]
    unit: str = ""
    note: str = ""
    masked: float = float("nan")
    """Fraction of pixels without an estimate; NaN: does not apply."""
    coverage: float = float("nan")
    """Coverage of the 68 % intervals; NaN: unknown."""
    worst: str = ""
    """Group with the largest error, in words: a melanin band, a strain step, a channel."""
    worst_got: float = float("nan")
    """Lower bound of the error in that group, in ``unit``; NaN where it is not comparable."""
    command: str = ""
    """Command that repeats it, with the paths as given; empty: unknown."""

    @property
    def passed(self) -> bool:
        """Whether ``got`` keeps ``bound``; NaN does not."""
        return self.got <= self.bound if self.sense == "<=" else self.got >= self.bound

    @property
    def used(self) -> float:
        """Measured value over the limit, above 1 where it is missed; NaN for lower limits."""
        if self.sense == ">=" or not self.bound > 0.0:
            return float("nan")
        return self.got / self.bound


@dataclass(frozen=True, slots=True)
class ReportedAppearance:
    """An appearance with its ground truth and checks."""

    name: str
    appearance: SkinAppearance
    truth: SkinAppearance | None
    checks: list[Check]
    """Sections append their checks."""
    command: str = ""
    """Command that makes the maps again; empty: unknown."""

    def check(
        self, quantity: str, got: float, bound: float, unit: str = "", note: str = "", **more: Any
    ) -> None:
        """Add the check of a number against its upper limit."""
        more = {"command": self.command} | more
        self.checks.append(Check(f"{self.name}: {quantity}", got, bound, "<=", unit, note, **more))

    def check_fraction(
        self, quantity: str, got: float, bound: float, note: str = "", **more: Any
    ) -> None:
        """Add the check of a fraction against its upper limit, both in percent."""
        self.check(quantity, 100 * got, 100 * bound, "%", note, **more)


def find_worst(rows: Iterable[Row], size: Callable[[Row], float]) -> Row | None:
    """Return the row of the largest finite size, if there are several."""
    finite = [row for row in rows if math.isfinite(size(row))]
    return max(finite, key=size) if len(finite) > 1 else None


class Block:
    """A piece of a page."""

    __slots__ = ()

    @property
    def macro(self) -> str:
        """Macro of ``blocks.html`` that draws it."""
        return type(self).__name__.lower()


@dataclass(frozen=True, slots=True)
class Heading(Block):
    """A heading; level 2 begins a section of the page and of its contents."""

    text: str
    level: int = 3
    folder: str = ""
    """Name of the folder of the results, in small letters below a heading of level 2."""


@dataclass(frozen=True, slots=True)
class Paragraph(Block):
    """Plain text."""

    text: str
    kind: str = ""
    """Class in the style sheet, such as "note"."""


@dataclass(frozen=True, slots=True)
class Bullets(Block):
    """A list of sentences."""

    items: Sequence[str]


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table."""

    text: str
    kind: str = ""
    """Class in the style sheet: "n" a number, "k" kept on one line."""
    names_row: bool = False


@dataclass(frozen=True, slots=True)
class Table(Block):
    """A table with a caption; a heading without text leaves its cell empty."""

    caption: str
    head: Sequence[Cell]
    rows: Sequence[Sequence[Cell]]

    @property
    def title(self) -> str:
        """First sentence of the caption: what is seen of a folded table."""
        return re.split(r"\. (?=[A-Z])", self.caption)[0]


@dataclass(frozen=True, slots=True)
class ColorScale:
    """The bar below an image of a map."""

    name: str
    low: str
    high: str
    unit: str


@dataclass(frozen=True, slots=True)
class Image:
    """An image with its title, for an `Images` row."""

    title: str
    address: str
    """The file as a ``data:`` address."""
    alt: str
    size: tuple[int, int] | None = None
    """Width and height, pixels; None: as the file has it."""
    scale: ColorScale | None = None


@dataclass(frozen=True, slots=True)
class Images(Block):
    """A row of images."""

    images: Sequence[Image]
    small: bool = False
    together: bool = False
    """Whether up to three images stay in one row on narrow screens, to be compared."""


@dataclass(frozen=True, slots=True)
class Plots(Block):
    """A row of SVG drawings."""

    drawings: Sequence[str]


@dataclass(frozen=True, slots=True)
class Collapsible(Block):
    """Blocks that open when their title is clicked, and are open when printed."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True, slots=True)
class View(Block):
    """Results of a section with their template."""

    template: str
    """Its name below ``reporting/templates``, without suffix."""
    data: Mapping[str, Any]

    @property
    def html(self) -> Markup:
        """The filled template; it writes tables by `build_table` and labels by `map_names`."""
        helpers: dict[str, Any] = {
            "as_table": build_table,
            "cell": Cell,
            # numbers keep their percent signs when a narrow cell breaks a text
            "unbroken": lambda text: text.replace(" %", "\N{NO-BREAK SPACE}%"),
            "number": format_number,
            "abs": np.abs,
            "median": np.median,
            "finite": lambda values: bool(np.isfinite(values).all()),
            "or_nan": lambda value: math.nan if value is None else float(value),
            "or_empty": lambda value: "" if value is None else float(value),
            "words": map_names.map_title,
            "state_words": map_names.state_title,
            "unit_sign": format_unit,
            "written": format_quantity,
        }
        name = f"reporting/templates/{self.template}.html"
        return Markup(templates.render(name, **helpers, **self.data))


@dataclass(frozen=True, slots=True)
class Part:
    """Blocks below a heading of level 2; without an anchor, those before the first."""

    anchor: str
    title: str
    blocks: list[Block]
    folder: str = ""


def format_number(value: float) -> str:
    """Format a number with four significant digits; a dash for missing ones."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.4g}"


def format_short_unit(unit: str) -> str:
    """Return a short unit for tables and scales; empty for a plain number.

    Examples
    --------
    >>> [format_short_unit(unit) for unit in ("volume fraction of the epidermis", "1", "mm")]
    ['volume fraction', '', 'mm']
    """
    return "" if unit == "1" else unit.split(" of ")[0]


def build_checks_table(checks: Sequence[Check]) -> View:
    """Return the table of checks, the missed ones first."""
    return build_view("checks", checks=sorted(checks, key=lambda check: check.passed))


def build_table(head: Sequence[str], rows: Sequence[Sequence[object]], *, caption: str) -> Table:
    """Return a table; numbers are set right-aligned with four digits.

    Parameters
    ----------
    head
        Titles of columns; an empty one leaves its cell without a heading.
    rows
        Cells; the first of each row names it.
    caption
        Caption of the table.
    """

    def cell(value: object, first: bool) -> Cell:
        if isinstance(value, (float, np.floating)):
            return Cell(format_number(float(value)), "n", first)
        if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
            return Cell(str(value), "n", first)
        text = str(value)
        return Cell(text, "k" if len(text) <= MAX_UNBROKEN_CHARS else "", first)

    numeric = [
        bool(rows) and all(isinstance(row[k], (int, float, np.number)) for row in rows)
        for k in range(len(head))
    ]
    return Table(
        caption,
        [Cell(title, "n" if right else "") for title, right in zip(head, numeric, strict=True)],
        [[cell(value, k == 0) for k, value in enumerate(row)] for row in rows],
    )


def build_facts_table(values: Mapping[str, object], *, caption: str) -> Table:
    """Return a two-column table of names and values."""
    return build_table(("quantity", "value"), list(values.items()), caption=caption)


def build_assumptions_table(texts: Iterable[str]) -> Table:
    """Return the table of assumptions."""
    rows = [[text] for text in texts]
    return build_table(("assumption",), rows, caption="Assumed, not measured")


def build_view(template: str, **data: Any) -> View:
    """Return the results of a section with their template."""
    return View(template, data)


def build_note(text: str) -> Paragraph:
    """Return a remark of plain text."""
    return Paragraph(text, "note")


def build_single_subject_note(parameters: Mapping[str, object]) -> Paragraph:
    """Return a remark on the subject, where a session holds one and has no bands.

    Examples
    --------
    >>> build_single_subject_note({"preset": "III"}).text
    'All errors are for one subject, III; the session has no melanin bands.'
    """
    subject = next((f", {parameters[k]}" for k in ("subject", "preset") if parameters.get(k)), "")
    return build_note(f"All errors are for one subject{subject}; the session has no melanin bands.")


def render_fragment(blocks: Iterable[Block]) -> str:
    """Return blocks as HTML, without a page around them."""
    return templates.render("reporting/templates/fragment.html", blocks=list(blocks))


def render_page(
    title: str,
    lead: Iterable[Block],
    sections: Iterable[Block],
    *,
    reload_s: int | None = None,
    folded: bool = True,
) -> str:
    """Return the whole page; it makes no request, and its one script enlarges images.

    Parameters
    ----------
    title
        Title of the page.
    lead
        First blocks: verdict and images.
    sections
        Blocks below the contents.
    reload_s
        Seconds after which a browser loads the page again; None: never.
    folded
        Fold the tables of the sections; those of the lead are open.
    """
    style = PAGE_STYLE + _bars() + frame_sheet.build_style()
    taken = {"content", "contents"}
    head, body = _parts(lead, taken), _parts(sections, taken)
    page = templates.render(
        "reporting/templates/page.html",
        title=title,
        style=style,
        reload_s=reload_s,
        script=PAGE_SCRIPT,
        masked_gray=png.INVALID_GRAY,
        policy=f"default-src 'none'; img-src data:; style-src '{templates.hash_inline(style)}'; "
        f"script-src '{templates.hash_inline(PAGE_SCRIPT)}'; base-uri 'none'; form-action 'none'",
        lead=head,
        body=body,
        folded=folded,
        titled=[part for part in head + body if part.anchor],
    )
    return link_repeated_images(page)


def link_repeated_images(page: str, *, least_bytes: int = 5000) -> str:
    r"""Replace each image that is on the page already by a link to it.

    Parameters
    ----------
    page
        HTML; an image is ``<img ... src="data:...">``.
    least_bytes
        Smaller images are repeated.

    Examples
    --------
    >>> one, other = '<img alt="a" src="data:x">', '<img alt="c" src="data:y">'
    >>> print(link_repeated_images(one + other + one, least_bytes=6).replace("><", ">\n<"))
    <img id="image-1" alt="a" src="data:x">
    <img alt="c" src="data:y">
    <a href="#image-1">shown above</a>
    """
    counts = Counter(_IMAGE.findall(page))
    numbers: dict[str, int] = {}

    def replace(found: re.Match[str]) -> str:
        address = found[1]
        if address in numbers:
            return f'<a href="#image-{numbers[address]}">shown above</a>'
        if counts[address] == 1 or len(address) < least_bytes:
            return found[0]
        numbers[address] = len(numbers) + 1
        return found[0].replace("<img", f'<img id="image-{numbers[address]}"', 1)

    return _IMAGE.sub(replace, page)


def _parts(blocks: Iterable[Block], taken: set[str]) -> list[Part]:
    """Return blocks by section, each section with an id that no other has."""
    parts = [Part("", "", [])]
    for block in blocks:
        if isinstance(block, Heading) and block.level == 2:
            anchor = _anchor(f"{block.text} {block.folder}", taken)
            parts.append(Part(anchor, block.text, [], block.folder))
        else:
            parts[-1].blocks.append(block)
    return parts


def _anchor(heading: str, taken: set[str]) -> str:
    """Return an id for a heading that no other has.

    Examples
    --------
    >>> taken = set()
    >>> _anchor("Maps: flash II", taken), _anchor("Maps: flash-II", taken)
    ('maps-flash-ii', 'maps-flash-ii-2')
    """
    name = re.sub(r"[^a-z0-9]+", "-", heading.casefold()).strip("-") or "section"
    number_, free = 2, name
    while free in taken:
        free, number_ = f"{name}-{number_}", number_ + 1
    taken.add(free)
    return free


def _bars() -> str:
    """Return the style of the color bars, with the colors of the images."""
    rules = []
    for scale, name in png.SCALE_CLASSES.items():
        stops = ",".join("#" + bytes(rgb).hex() for rgb in png.sample_palette(scale, BAR_STOPS))
        rules.append(f".bar.{name}{{background:linear-gradient(90deg,{stops})}}")
    return "\n".join(rules)
