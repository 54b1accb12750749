"""Options that several commands take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from datetime import datetime
from inspect import Parameter, Signature, cleandoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from skinrig.commands import completion
from skinrig.errors import UnusableError, UsageError

if TYPE_CHECKING:
    from skinrig.capturing.sequences import SequenceOrder


def option(text: str, *names: str, **settings: Any) -> Any:
    """Return an option: its help, its names unless they are the parameter's, settings of Typer."""
    return typer.Option(*names, help=text, **settings)


Json = Annotated[bool, option("Print exactly one JSON document on stdout.", "--json")]
Seed = Annotated[int, option("Seed of everything that is drawn.")]
Out = Annotated[Path, option("Folder to write.", "--out")]


def _check_output_folder(context: typer.Context, out: Path) -> Path:
    """Refuse a folder that maps cannot go to before minutes are spent on them."""
    if not context.resilient_parsing:
        from model.store import require_free

        require_free(out)
    return out


NewMaps = Annotated[
    Path, typer.Option("--out", callback=_check_output_folder, help="Folder to write.")
]
"""An APPEARANCE/ folder, new or to be replaced."""


def check_output_file(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder where a file is to be written, before the work."""
    if out is not None and not context.resilient_parsing and out.is_dir():
        raise UnusableError(f"--out: {out} is a folder, expected a file to write")
    return out


def check_output_page(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder, and the standard output, which has no name to be opened by."""
    if out is not None and not context.resilient_parsing and str(out) == STDOUT_MARK:
        raise UsageError("--out: got '-', expected a file to write")
    return check_output_file(context, out)


STDOUT_MARK = "-"
"""The standard output where a file is named."""
Page = Annotated[Path, typer.Option("-o", "--out", callback=check_output_page, help="The page.")]
Subject = Annotated[
    str,
    option(
        "Whose skin: a preset, I to VI, palest or darkest, or a file NAME.toml.",
        autocompletion=completion.subjects,
    ),
]
Size = Annotated[str, option("Of the pictures: small or full.", autocompletion=completion.sizes)]
Width = Annotated[int | None, option("Pixels across, instead of the size.")]
Resume = Annotated[bool, option("Go on with a session that was interrupted.", "--resume")]
Site = Annotated[str | None, option("Where the skin is from: forehead (default), cheek or chin.")]
Sites = Annotated[
    str | None, option("Where the probe is placed, joined by commas: forehead,cheek,chin.")
]
Pairs = Annotated[int, option("Image pairs a state.", "--repeats")]
Placements = Annotated[int, option("Placements a site and direction.", "--repeats")]
AllBrackets = Annotated[
    bool, option("Record every exposure, also such as show no more.", "--all-brackets")
]
Angles = Annotated[str | None, option("Angles of the caliper, degrees, joined by commas: 0,90.")]
Directions = Annotated[str | None, option("How many directions of the head: 16.", "--angles")]
Steps = Annotated[str | None, option("First and last position of the caliper: -2..3.")]
Consent = Annotated[
    list[str] | None,
    option("Use that the subject agreed to; repeatable, or by commas.", "--consent"),
]
ConsentExpires = Annotated[
    datetime | None,
    typer.Option("--consent-expires", formats=["%Y-%m-%d"], help="Last day of the consent."),
]


def target_option(rig: str) -> Any:
    """Return the option --target of a rig."""
    names = completion.target_completer(rig)
    return option(
        f"A target instead of a subject: {', '.join(names)}.",
        autocompletion=lambda incomplete: completion.filter_by_prefix(names, incomplete),
    )


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """Options of a sequence in time before the flash rig.

    Attributes
    ----------
    sequence
        A sequence in time: an expression made and dropped by a sound, such as smile, or exercise or
        alcohol, followed after the event.
    prompt_period
        Of a sequence: seconds from sound to sound; default 5.
    shot_period
        Of a sequence: seconds from shot to shot; default 5.5, of alcohol 300.
    captures
        Shots of a sequence by sounds; default: each phase, a tenth twice.
    duration
        Seconds an event is followed; default 60 for exercise, 3600 for alcohol.
    """

    sequence: str | None = None
    prompt_period: str | None = None
    shot_period: str | None = None
    captures: int | None = None
    duration: str | None = None

    def order(self) -> SequenceOrder | None:
        """Return the sequence that is asked for; None without one."""
        from skinrig.capturing.option_values import parse_sequence

        return parse_sequence(
            self.sequence, self.prompt_period, self.shot_period, self.captures, self.duration
        )


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function as Typer takes a command: its docstring says what its options are.

    A parameter that is positional only becomes an argument, any other an option, unless it is
    annotated with one of Typer's; its help is what the section of parameters says of it.
    A parameter that is annotated with a dataclass gets an object of it: the fields of the
    dataclass, described in its section of attributes, are options in its place.
    """
    types = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in types.items() if is_dataclass(kind)}
    text, helps = split_docstring(function.__doc__)
    shown: list[Parameter] = []
    positional = []
    for name, one in signature(function).parameters.items():
        if name in groups:
            shown += _options_of(groups[name])
            continue
        is_argument = one.kind is Parameter.POSITIONAL_ONLY
        if is_argument:
            positional.append(name)
        kind = _annotate_parameter(name, types[name], helps, argument=is_argument)
        shown.append(one.replace(annotation=kind, kind=Parameter.KEYWORD_ONLY))

    def run(**given: Any) -> None:
        made = {
            name: kind(**{one.name: given.pop(one.name) for one in fields(kind)})
            for name, kind in groups.items()
        }
        arguments = [given.pop(name) for name in positional]
        function(*arguments, **made, **given)

    run.__name__, run.__doc__ = function.__name__, text
    run.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return run


def _options_of(group: Any) -> Iterator[Parameter]:
    """Yield the fields of a dataclass as parameters of a command."""
    hints = get_type_hints(group, include_extras=True)
    _, helps = split_docstring(group.__doc__)
    for one in fields(group):
        yield Parameter(
            one.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if one.default is MISSING else one.default,
            annotation=_annotate_parameter(one.name, hints[one.name], helps),
        )


def _annotate_parameter(
    name: str, kind: Any, helps: Mapping[str, str], *, argument: bool = False
) -> Any:
    """Return a parameter's type with its option or argument; flags have no opposite."""
    if name not in helps:
        return kind
    if get_origin(kind) is Annotated:
        base, info = get_args(kind)
        info = copy(info)
        info.help = helps[name]
        return Annotated[base, info]
    if argument:
        return Annotated[kind, typer.Argument(help=helps[name])]
    names = [f"--{name.replace('_', '-')}"] if kind is bool else []
    return Annotated[kind, option(helps[name], *names)]


def split_docstring(docstring: str | None) -> tuple[str, dict[str, str]]:
    r"""Return what a docstring says before its parameters or attributes, and of each of them.

    Examples
    --------
    >>> split_docstring("Fit.\n\nParameters\n----------\nseed\n    Of the\n    search.")
    ('Fit.', {'seed': 'Of the search.'})
    """
    text, _, section = cleandoc(docstring or "").partition("\nParameters\n----------\n")
    if not section:
        text, _, section = text.partition("\nAttributes\n----------\n")
    helps: dict[str, str] = {}
    name = ""
    for line in section.splitlines():
        if line.startswith(" "):
            helps[name] = f"{helps.get(name, '')} {line.strip()}".lstrip()
        else:
            name = line.strip()
    return text.rstrip(), helps
