"""Shorten SVG plots of matplotlib, without style sheet and with alternative text."""

import hashlib
import html
import re

COORDINATE_DECIMALS = 2
"""Decimals of coordinates; 0.01 points is below the resolution of screens and printers."""

_TAG_PATTERN = re.compile(r"<[^>]+>")
_LONG_NUMBER = re.compile(r"-?\d+\.\d+(?:e-?\d+)?")
_DROPPED_STYLES = {"font-family", "stroke-linejoin"}
_FONT_FAMILY = "DejaVu Sans, Verdana, Arial, sans-serif"


def simplify_svg(svg: str, *, alt: str) -> str:
    r"""Shorten a plot of matplotlib's SVG writer to a fifth to half of its length.

    Parameters
    ----------
    svg
        Output of the writer, with text as text elements.
    alt
        Alternative text of the plot.

    Returns
    -------
    str
        The element ``<svg>`` as a labeled image. It has no style attributes, which a strict
        content security policy refuses. Black becomes the color of the surrounding text, so that
        it is legible on dark pages. Its ids are unique on a page.

    Examples
    --------
    >>> line = '<path d="M 1.23456 2 \nL 3 4 " style="fill: none; stroke: #000000"/>'
    >>> drawn = f'<?xml?><svg width="9pt"><g id="a"><g id="b">{line}</g></g></svg>'
    >>> shorter = simplify_svg(drawn, alt="a < b")
    >>> shorter[shorter.index("<path"):]
    '<path d="M1.23 2L3 4" fill="none" stroke="currentColor"/></svg>'
    >>> 'aria-label="a &lt; b"' in shorter
    True
    """
    text = svg[svg.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"<style\b.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<path\b[^>]*fill: none; opacity: 0\"/>", "", text)
    text = text.replace("xlink:href", "href").replace("#000000", "currentColor")
    text = re.sub(r' xmlns:xlink="[^"]*"| version="[^"]*"', "", text)
    text = _TAG_PATTERN.sub(lambda found: _attributes(found[0]), text)
    text = re.sub(r">\s+<", "><", text)
    text = _own_ids(text)
    text = _joined(_unnested(text))
    named = (
        f'<svg role="img" aria-label="{html.escape(alt, quote=True)}" font-family="{_FONT_FAMILY}" '
        'fill="currentColor" stroke-linejoin="round" '
    )
    return text.replace("<svg ", named, 1)


def _attributes(tag: str) -> str:
    """Replace styles of a tag by attributes, shorten its numbers, and drop empty rotations."""
    if tag.startswith("</") or "base64," in tag:
        return re.sub(r"\s+", " ", tag)

    def of_style(found: re.Match[str]) -> str:
        pairs = (entry.split(":", 1) for entry in found[1].split(";") if ":" in entry)
        kept = {name.strip(): value.strip() for name, value in pairs}
        return "".join(
            f' {name}="{value.removesuffix("px")}"'
            for name, value in kept.items()
            if name not in _DROPPED_STYLES and (name, value) != ("text-anchor", "start")
        )

    tag = re.sub(r'\s+style="([^"]*)"', of_style, tag)
    tag = re.sub(r' transform="rotate\(-?0 [^"]*\)"', "", tag)
    tag = _LONG_NUMBER.sub(lambda found: f"{round(float(found[0]), COORDINATE_DECIMALS):g}", tag)
    tag = re.sub(r"\s+", " ", tag)
    # the letters of path commands are separators themselves
    return re.sub(r' d="([^"]*)"', lambda found: f' d="{_path(found[1])}"', tag)


def _path(commands: str) -> str:
    return re.sub(r" ?([MLCQHVzZ]) ?", r"\1", commands.strip())


def _own_ids(text: str) -> str:
    """Drop ids without references, and make the others unique to this plot."""
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', text))
    names = sorted({one or other for one, other in used})
    prefix = "f" + hashlib.sha256(text.encode()).hexdigest()[:8]
    text = re.sub(
        r' id="([^"]*)"',
        lambda found: f' id="{prefix}{names.index(found[1])}"' if found[1] in names else "",
        text,
    )
    return re.sub(
        r'(href="#|url\(#)([^")]+)',
        lambda found: f"{found[1]}{prefix}{names.index(found[2])}",
        text,
    )


def _unnested(text: str) -> str:
    """Remove groups without attributes."""
    pieces: list[str] = []
    kept: list[bool] = []
    for piece in re.split(r"(</?g\b[^>]*>)", text):
        if piece.startswith("<g"):
            kept_group = piece != "<g>"
            if not piece.endswith("/>"):
                kept.append(kept_group)
                if kept_group:
                    pieces.append(piece)
        elif piece == "</g>":
            if kept.pop():
                pieces.append(piece)
        else:
            pieces.append(piece)
    return re.sub(r"<defs\s*/>|<defs></defs>", "", "".join(pieces))


def _joined(text: str) -> str:
    """Join open paths that follow each other and look the same."""
    pattern = re.compile(r'<path d="([^"]*)"([^>]*fill="none"[^>]*)/><path d="([^"]*)"\2/>')
    while True:
        text, changes = pattern.subn(r'<path d="\1\3"\2/>', text)
        if not changes:
            return text
