"""Format help and parse the command line: sections of commands, commands per rig."""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from typing import Any, Final, cast

from typer.core import TyperCommand, TyperGroup

from skinrig.command_line.renamed_options import (
    format_notice,
    renamed_options_of,
    replace_former_names,
)
from skinrig.errors import UnusableError, UsageError

HELP_SECTIONS: Final[tuple[tuple[str, tuple[str, ...]], ...]] = (
    ("Start here", ("demo", "photo", "doctor")),
    (
        "Capture with a rig or its simulation",
        (
            "plan",
            "simulate",
            "capture",
            "serve",
            "calibrate",
            "import",
            "diagnose",
            "verify",
            "session",
        ),
    ),
    ("Reconstruct and model", ("reconstruct", "fuse", "fit", "apply", "edit", "analyse")),
    ("Report, render and export", ("report", "status", "view", "render", "export")),
    ("Measure errors and run times", ("bench", "soak", "study")),
)
OTHER_SECTION: Final = "More"


FURTHER_OPTIONS: Final = (
    *("--session-seed", "--days-ago", "--plan", "--consent", "--consent-expires"),
    *("--omit", "--renderer", "--movement", "--mesh", "--wrapped", "--scanner"),
    *("--prompt-period", "--shot-period", "--captures", "--duration", "--relaxation"),
    *("--camera-offset-mm", "--subsurface", "--interreflections"),
)
"""Options that the help of a command with `HELP_ALL` names without text: one screen suffices."""
HELP_ALL: Final = "--help-all"

FORMER_IMPORT_NAMES: Final = {"lp": "olat"}

_TYPE_LABELS: Final = (
    (re.compile(r"<list\[(\w+)\]>"), r"<\1>"),
    (re.compile("<%Y-%m-%d>"), "<date>"),
)
"""Typer's labels of types, after Python's, and the labels that the help shows instead."""


class Command(TyperCommand):
    """A command that accepts former option names; its help hides Python's type names."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Replace former names of options, each with a notice on stderr, and parse."""
        if not ctx.resilient_parsing:
            renamed = _renamed(self, ctx.parent)
            args, found = replace_former_names(args, renamed, _options(self))
            for former in found:
                print(format_notice(former, renamed[former]), file=sys.stderr, flush=True)
        return super().parse_args(ctx, args)

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters; for completion, those of renamed options also by former name."""
        params = super().get_params(ctx)
        if not ctx.resilient_parsing:
            return params
        former_by_present: dict[str, list[str]] = {}
        for former, present in _renamed(self, ctx.parent).items():
            former_by_present.setdefault(present, []).append(former)
        return [_with_names(param, former_by_present) for param in params]

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Complete names of options; former names are not offered."""
        renamed = _renamed(self, ctx.parent)
        return [one for one in super().shell_complete(ctx, incomplete) if one.value not in renamed]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options; repeatable ones with the type of a single value."""
        super().format_options(ctx, cast(Any, _WithoutTypes(formatter)))


class _WithoutTypes:
    """A help formatter that writes definition lists without Python's type names."""

    def __init__(self, formatter: Any) -> None:
        self._formatter = formatter

    def __getattr__(self, name: str) -> Any:
        return getattr(self._formatter, name)

    def write_dl(self, rows: Iterable[tuple[str, str]], *args: Any, **settings: Any) -> None:
        self._formatter.write_dl(
            [(format_argument(name), text) for name, text in rows], *args, **settings
        )


def format_argument(name: str) -> str:
    """Return an argument's label in the help, with the type of a single value.

    Examples
    --------
    >>> format_argument("paths... <list[Path]>"), format_argument("--expires <%Y-%m-%d>")
    ('paths... <path>', '--expires <date>')
    """
    for pattern, words in _TYPE_LABELS:
        name = pattern.sub(words, name)
    return name.replace("<Path>", "<path>")


class Commands(TyperGroup):
    """A group that lists its commands under the headings of `HELP_SECTIONS`, untruncated."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the headings, each with its commands."""
        for title, rows in self._sections(ctx):
            with formatter.section(title):
                formatter.write_dl(rows)

    def _sections(self, ctx: Any) -> Iterator[tuple[str, list[tuple[str, str]]]]:
        left = {
            name: command
            for name in self.list_commands(ctx)
            if (command := self.get_command(ctx, name)) is not None and not command.hidden
        }
        for title, names in HELP_SECTIONS:
            rows = [(name, summarize_command(left.pop(name))) for name in names if name in left]
            if rows:
                yield title, rows
        if left:
            yield (
                OTHER_SECTION,
                [(name, summarize_command(command)) for name, command in left.items()],
            )


class Subcommands(TyperGroup):
    """A group within the group, with one untruncated list of commands."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands with their full summaries."""
        found = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, summarize_command(one)) for name, one in found if one is not None]
            )


class ImportCommands(Subcommands):
    """Commands of `skinrig import`; a former name works with a notice on stderr."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of this name, or of its present name."""
        present = FORMER_IMPORT_NAMES.get(cmd_name)
        if present is None:
            return super().get_command(ctx, cmd_name)
        if not ctx.resilient_parsing:
            print(format_notice(f"import {cmd_name}", f"import {present}"), file=sys.stderr)
        return super().get_command(ctx, present)


class RigCommand(Command):
    """A command of one rig; an option of other rigs is refused with their names.

    Where it has ``--help-all``, its help names rarely used options without text.
    """

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options; those of `FURTHER_OPTIONS` by name only, without `HELP_ALL`."""
        own = _options(self)
        short = HELP_ALL in own and not ctx.meta.get(HELP_ALL)
        further = tuple(name for name in FURTHER_OPTIONS if name in own and short)
        if not further:
            super().format_options(ctx, formatter)
            return
        hidden = [cast(Any, one) for one in self.params if set(further) & set(one.opts)]
        for one in hidden:
            one.hidden = True
        try:
            super().format_options(ctx, formatter)
        finally:
            for one in hidden:
                one.hidden = False
        with formatter.section(f"Further options ({HELP_ALL} explains them)"):
            formatter.write_text(", ".join(further))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; raise `UsageError` for an option of another rig."""
        try:
            return super().parse_args(ctx, args)
        except Exception as error:  # Typer does not export the class of unknown options
            option = getattr(error, "option_name", None)
            group = ctx.parent.command.commands if option and ctx.parent else {}
            others = [
                rig
                for rig, command in group.items()
                if option in _options(command) or option in _renamed(command, ctx.parent)
            ]
            if not others:
                raise
            raise UsageError(
                f"{option}: not an option of the {self.name} rig (only of {', '.join(others)}); "
                "remove it [SR-CLI-005]"
            ) from error


class RigGroup(Subcommands):
    """Commands of one verb, one per rig; options may also precede the rig."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Move the rig in front of the options, where Typer expects a command."""
        options: dict[str, Any] = {}
        for command in self.commands.values():
            own = _options(command)
            former = renamed_options_of(self.name, command.name)
            options |= own | {old: own[new] for old, new in former.items()}
        place = 0
        while place < len(args) and args[place].startswith("-"):
            option = options.get(args[place])
            place += 1 if option is None or option.is_flag else 2
        if 0 < place < len(args):
            args = [args[place], *args[:place], *args[place + 1 :]]
        elif args and args[0].partition("=")[0] in options and not ctx.resilient_parsing:
            ctx.fail(f"Missing argument 'RIG': {', '.join(self.commands)}")
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the command of the rig named by the first argument."""
        if args[0] in self.commands or ctx.resilient_parsing:
            return cast(tuple[str | None, Any, list[str]], super().resolve_command(ctx, args))
        return args[0], self.commands[self.kind_of(args[0])], args[1:]

    def kind_of(self, rig: str) -> str:
        """Return the command of a rig that is not a command's name; here, raise."""
        raise UnusableError(
            f"rig: got {rig!r}, expected one of {', '.join(self.commands)}; choose one [SR-CLI-006]"
        )


class RigFileGroup(RigGroup):
    """Commands of one verb, one per rig, which also accept a rig's TOML file."""

    def kind_of(self, rig: str) -> str:
        """Return the kind of rig, one of four, that a TOML file describes."""
        from capture.rig import load_rig

        described = load_rig(rig)
        if described.probe is not None:
            return "probe"
        kinds = {"gradient_sphere": "gradient", "dome": "dome"}
        return next((kind for box, kind in kinds.items() if box in described.boxes), "flash")


def _options(command: Any) -> dict[str, Any]:
    """Return the options of a command, keyed by each spelling."""
    return {
        name: option
        for option in command.params
        for name in (*option.opts, *option.secondary_opts)
        if name.startswith("-")  # arguments are listed by their bare names
    }


def _renamed(command: Any, parent: Any) -> Mapping[str, str]:
    """Return the renamed options of a command, below the context of its group or the root."""
    is_nested = parent is not None and parent.parent is not None
    return renamed_options_of(parent.command.name if is_nested else None, command.name)


def _with_names(param: Any, further: Mapping[str, Iterable[str]]) -> Any:
    """Return a parameter that also has further names, listed by one of its own."""
    names = [name for own in param.opts for name in further.get(own, ())]
    if not names:
        return param
    named = copy(param)
    named.opts = [*param.opts, *names]
    return named


def summarize_command(command: Any) -> str:
    """Return the first paragraph of a command's help on one line, without its period."""
    text = (command.short_help or command.help or "").split("\n\n")[0]
    return " ".join(text.split()).rstrip(".")
