"""How ``skinrig --help`` lists commands: by what people come for, each with its whole summary."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any, Final, cast

from typer.core import TyperCommand, TyperGroup

SECTIONS: Final[tuple[tuple[str, tuple[str, ...]], ...]] = (
    ("Begin", ("demo", "doctor")),
    (
        "Capture, on a rig or its simulation",
        ("plan", "simulate", "capture", "serve", "calibrate", "import", "verify"),
    ),
    ("From captures to models", ("reconstruct", "fit", "apply", "edit", "analyse")),
    ("Look, and hand on", ("report", "view", "render", "export")),
    ("Measure", ("bench",)),
)
OTHER: Final = "More"


_KINDS: Final = ((re.compile(r"<list\[(\w+)\]>"), r"<\1>"), (re.compile("<%Y-%m-%d>"), "<date>"))
"""How Typer writes kinds of arguments after Python's types, and what is written instead."""


class Command(TyperCommand):
    """A command whose help names kinds of arguments without Python's words for them."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options, those that are repeated as what one of them is."""
        super().format_options(ctx, cast(Any, _WithoutTypes(formatter)))


class _WithoutTypes:
    """A formatter of help that writes lists of definitions without Python's types."""

    def __init__(self, formatter: Any) -> None:
        self._formatter = formatter

    def __getattr__(self, name: str) -> Any:
        return getattr(self._formatter, name)

    def write_dl(self, rows: Iterable[tuple[str, str]], *args: Any, **settings: Any) -> None:
        self._formatter.write_dl([(plain(name), text) for name, text in rows], *args, **settings)


def plain(name: str) -> str:
    """Return how an argument is listed, with what one of it is.

    Examples
    --------
    >>> plain("paths... <list[Path]>"), plain("--consent-expires <%Y-%m-%d>"), plain("--size <int>")
    ('paths... <path>', '--consent-expires <date>', '--size <int>')
    """
    for pattern, words in _KINDS:
        name = pattern.sub(words, name)
    return name.replace("<Path>", "<path>")


class Commands(TyperGroup):
    """A group that lists its commands under the headings of `SECTIONS`, nothing cut off."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the headings and the commands below them."""
        for title, rows in self._sections(ctx):
            with formatter.section(title):
                formatter.write_dl(rows)

    def _sections(self, ctx: Any) -> Iterator[tuple[str, list[tuple[str, str]]]]:
        left = {
            name: command
            for name in self.list_commands(ctx)
            if (command := self.get_command(ctx, name)) is not None and not command.hidden
        }
        for title, names in SECTIONS:
            rows = [(name, summary(left.pop(name))) for name in names if name in left]
            if rows:
                yield title, rows
        if left:
            yield OTHER, [(name, summary(command)) for name, command in left.items()]


class Subcommands(TyperGroup):
    """A group within the group: one list, nothing cut off."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands with their whole summaries."""
        found = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl([(name, summary(one)) for name, one in found if one is not None])


def summary(command: Any) -> str:
    """Return the first paragraph of a command's help on one line, without its full stop."""
    text = (command.short_help or command.help or "").split("\n\n")[0]
    return " ".join(text.split()).rstrip(".")
