"""Define options of several commands, and create commands from functions with docstrings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from datetime import datetime
from inspect import Parameter, Signature, cleandoc, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

import typer

from skinrig.atomic_file import require_writable
from skinrig.command_line import completion
from skinrig.command_line.help import HELP_ALL
from skinrig.errors import UnusableError, UsageError, require_choice

if TYPE_CHECKING:
    from skinrig.capturing.sequences import SequenceOrder


def option(text: str, *names: str, **settings: Any) -> Any:
    """Return an option of Typer; without names, it is named after its parameter."""
    return typer.Option(*names, help=text, **settings)


def choice(*values: str, text: str | None = None, metavar: str | None = None) -> Any:
    """Return an option with a closed set of values: listed in help, completed and checked.

    Parameters
    ----------
    values
        Valid values; any other raises `UnusableError`, which lists them.
    text
        Help of the option; None: that of the command's docstring.
    metavar
        Label of the value in help; None: the values.
    """

    def check(parameter: typer.CallbackParam, value: str | None) -> str | None:
        return None if value is None else require_choice(parameter.opts[0], value, values)

    return typer.Option(
        metavar=metavar or f"[{'|'.join(values)}]",
        help=text,
        callback=check,
        autocompletion=lambda incomplete: completion.filter_by_prefix(values, incomplete),
    )


Json = Annotated[bool, option("Print exactly one JSON document on stdout.", "--json")]


def _print_full_help(context: typer.Context, given: bool) -> bool:
    """Print the help with all options, and end the command."""
    if given and not context.resilient_parsing:
        context.meta[HELP_ALL] = True
        typer.echo(context.get_help())
        raise typer.Exit
    return given


HelpAll = Annotated[
    bool,
    typer.Option(
        HELP_ALL, is_eager=True, callback=_print_full_help, help="Show all options and exit."
    ),
]
Seed = Annotated[int, option("Random seed.")]
ExecutorName = Annotated[
    str,
    option(
        "Where independent tasks run: threads (one after the other in this process), local:N (N "
        "processes) or tcp://HOST:PORT (a Dask scheduler).",
        "--executor",
        metavar="TEXT",
    ),
]
DaysAgo = Annotated[
    int,
    option(
        "Day of the session, days before today; LEDs and frame of dome and sphere are those of "
        "that day."
    ),
]
SessionSeed = Annotated[
    int | None,
    option(
        "Random seed of one session of the same subject and rig: noise, position, motion and "
        "controllers; default: that of --seed."
    ),
]


def _check_output_place(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a place that cannot be written to, before the computation starts."""
    if out is not None and not context.resilient_parsing:
        require_writable(out)
    return out


Out = Annotated[Path, option("Folder to write.", "--out", callback=_check_output_place)]
OptionalOut = Annotated[
    Path | None, option("Folder to write.", "--out", callback=_check_output_place)
]


def _check_output_folder(context: typer.Context, out: Path) -> Path:
    """Refuse a folder that cannot be written, before the computation starts."""
    if not context.resilient_parsing:
        from model.store import require_free

        require_writable(out)
        require_free(out)
    return out


NewMaps = Annotated[
    Path, typer.Option("--out", callback=_check_output_folder, help="Folder to write.")
]
"""An APPEARANCE/ folder, new or replaced."""


def check_output_file(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder as output file, before the computation starts."""
    if out is not None and not context.resilient_parsing and out.is_dir():
        raise UnusableError(
            f"--out: {out} is a folder, expected a file to write; name a file [SR-CLI-011]"
        )
    if str(out) != STDOUT_MARK:
        _check_output_place(context, out)
    return out


def check_output_page(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder or the standard output, which a browser cannot open."""
    if out is not None and not context.resilient_parsing and str(out) == STDOUT_MARK:
        raise UsageError("--out: got '-', expected a file to write; name a file")
    return check_output_file(context, out)


STDOUT_MARK = "-"
"""File name of the standard output."""
Page = Annotated[
    Path, typer.Option("-o", "--out", callback=check_output_page, help="HTML file to write.")
]
MeshFile = Annotated[
    Path, typer.Option("-o", "--out", callback=check_output_page, help="PLY file to write, mm.")
]
Subject = Annotated[
    str,
    option(
        "Simulated subject: preset I to VI, palest or darkest, ita:DEGREES, monk:N, or a file "
        "NAME.toml.",
        autocompletion=completion.complete_subjects,
    ),
]
Scale = Annotated[str, choice("small", "full")]
Renderer = Annotated[
    str,
    choice(
        "mitsuba",
        "fast",
        "reference",
        text="Renderer: scenes of Mitsuba, compiled loops without it, or voxel skin.",
    ),
]
Width = Annotated[int | None, option("Image width, pixels; default: that of the scale.")]
Resume = Annotated[bool, option("Continue an interrupted session.", "--resume")]
Site = Annotated[
    str | None,
    choice("forehead", "cheek", "chin", text="Skin site in the caliper; default: forehead."),
]
Sites = Annotated[
    str | None,
    option("Sites of the probe, separated by commas: forehead,cheek,chin; default: the plan's."),
]
Pairs = Annotated[int, option("Image pairs per expression (flash).", "--repeats")]
Bands = Annotated[
    str | None,
    option(
        "Narrow-band LEDs, centers in nm with optional full widths, such as 450,580:12: one more "
        "crossed frame each (flash); default: none.",
        "--bands",
    ),
]
Placements = Annotated[int, option("Placements per site and direction (probe).", "--repeats")]
AllBrackets = Annotated[
    bool, option("Record every exposure bracket (probe only).", "--all-brackets")
]
Angles = Annotated[
    str | None,
    option("Angles of the caliper, degrees, separated by commas: 0,90; default: the plan's."),
]
Directions = Annotated[
    str | None, option("Number of directions of the probe's head; default: the plan's.", "--angles")
]
Steps = Annotated[
    str | None, option("First and last caliper position: -2..3; default: the plan's.")
]
Consent = Annotated[
    list[str] | None,
    option(
        "Permitted use of the subject's data, such as research; repeatable, or separated by "
        "commas; default: none.",
        "--consent",
    ),
]
ConsentExpires = Annotated[
    datetime | None,
    typer.Option(
        "--consent-expires",
        formats=["%Y-%m-%d"],
        help="Last day of the consent; default: unlimited.",
    ),
]


def target_option(rig: str) -> Any:
    """Return the option --target of a rig, with its closed set of targets."""
    text = "Calibration target to capture; default: a subject."
    return choice(*completion.list_targets(rig), text=text)


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """Options of a time sequence (flash rig).

    Attributes
    ----------
    sequence
        Capture a time sequence: an expression prompted by a sound, such as smile, or the recovery
        after exercise or alcohol.
    prompt_period
        Time between sounds of a sequence, s; default 5.
    shot_period
        Time between shots of a sequence, s; default 5.5, for alcohol 300.
    captures
        Number of shots of a prompted sequence; default: one per phase, plus 10 % repeats.
    duration
        Time after exercise or alcohol, s; default 60 for exercise, 3600 for alcohol.
    """

    sequence: str | None = None
    prompt_period: str | None = None
    shot_period: str | None = None
    captures: int | None = None
    duration: str | None = None

    def order(self) -> SequenceOrder | None:
        """Return the options as a request for a sequence; None without --sequence."""
        from skinrig.capturing.option_values import parse_sequence

        return parse_sequence(
            self.sequence, self.prompt_period, self.shot_period, self.captures, self.duration
        )


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function as a command of Typer, with help from its docstring.

    A positional-only parameter becomes an argument, any other an option, unless it is annotated
    with one of Typer's. The docstring's section of parameters is its help. A parameter annotated
    with a dataclass is replaced by options, one per field, with help from the section of
    attributes; the function gets an instance.
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
    """Yield the fields of a dataclass as a command's parameters."""
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
    """Return a parameter's type annotated with its option or argument; flags lack --no-."""
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
    r"""Split a docstring into its text and the help of each parameter or attribute.

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
