"""Options that several commands take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from datetime import datetime
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from skinrig.commands import completion
from skinrig.errors import UnusableError, UsageError

if TYPE_CHECKING:
    from skinrig.capturing.sequences import SequenceOrder


def option(text: str, *names: str, **settings: Any) -> Any:
    """Return an option: its help, its names unless they are the parameter's, settings of Typer."""
    return typer.Option(*names, help=text, **settings)


def argument(text: str, **settings: Any) -> Any:
    """Return an argument by its help and settings of Typer."""
    return typer.Argument(help=text, **settings)


Json = Annotated[bool, option("Print exactly one JSON document on stdout.", "--json")]
Seed = Annotated[int, option("Seed of everything that is drawn.")]
Out = Annotated[Path, option("Folder to write.", "--out")]


def _free(context: typer.Context, out: Path) -> Path:
    """Refuse a folder that maps cannot go to before minutes are spent on them."""
    if not context.resilient_parsing:
        from model.store import require_free

        require_free(out)
    return out


NewMaps = Annotated[Path, typer.Option("--out", callback=_free, help="Folder to write.")]
"""An APPEARANCE/ folder, new or to be replaced."""


def file_to_write(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder where a file is to be written, before the work."""
    if out is not None and not context.resilient_parsing and out.is_dir():
        raise UnusableError(f"--out: {out} is a folder, expected a file to write")
    return out


def page_to_write(context: typer.Context, out: Path | None) -> Path | None:
    """Refuse a folder, and the standard output, which has no name to be opened by."""
    if out is not None and not context.resilient_parsing and str(out) == STDOUT_MARK:
        raise UsageError("--out: got '-', expected a file to write")
    return file_to_write(context, out)


STDOUT_MARK = "-"
"""The standard output where a file is named."""
Page = Annotated[Path, typer.Option("-o", "--out", callback=page_to_write, help="The page.")]
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


def target_of(rig: str) -> Any:
    """Return the option --target of a rig."""
    names = completion.targets_of(rig)
    return option(
        f"A target instead of a subject: {', '.join(names)}.",
        autocompletion=lambda incomplete: completion.beginning(names, incomplete),
    )


@dataclass(frozen=True, slots=True)
class SequenceOptions:
    """Options of a sequence in time before the flash rig."""

    sequence: Annotated[
        str | None,
        option(
            "A sequence in time: an expression made and dropped by a sound, such as smile, or "
            "exercise or alcohol, followed after the event."
        ),
    ] = None
    prompt_period: Annotated[
        str | None, option("Of a sequence: seconds from sound to sound; default 5.")
    ] = None
    shot_period: Annotated[
        str | None, option("Of a sequence: seconds from shot to shot; default 5.5, of alcohol 300.")
    ] = None
    captures: Annotated[
        int | None, option("Shots of a sequence by sounds; default: each phase, a tenth twice.")
    ] = None
    duration: Annotated[
        str | None,
        option("Seconds an event is followed; default 60 for exercise, 3600 for alcohol."),
    ] = None

    def order(self) -> SequenceOrder | None:
        """Return the sequence that is asked for; None without one."""
        from skinrig.capturing.option_values import parse_sequence

        return parse_sequence(
            self.sequence, self.prompt_period, self.shot_period, self.captures, self.duration
        )


def expand(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its dataclass parameters as options.

    Parameters
    ----------
    function
        Each parameter that is annotated with a dataclass gets an object of it. The fields of the
        dataclass are options of the command, in its place.
    """
    types = get_type_hints(function, include_extras=True)
    groups: dict[str, Any] = {name: kind for name, kind in types.items() if is_dataclass(kind)}
    shown: list[Parameter] = []
    for name, one in signature(function).parameters.items():
        if name not in groups:
            shown.append(one.replace(annotation=types[name], kind=Parameter.KEYWORD_ONLY))
            continue
        hints = get_type_hints(groups[name], include_extras=True)
        for option in fields(groups[name]):
            default = Parameter.empty if option.default is MISSING else option.default
            shown.append(
                Parameter(
                    option.name,
                    Parameter.KEYWORD_ONLY,
                    default=default,
                    annotation=hints[option.name],
                )
            )

    def command(**given: Any) -> None:
        made = {
            name: kind(**{one.name: given.pop(one.name) for one in fields(kind)})
            for name, kind in groups.items()
        }
        function(**made, **given)

    command.__name__, command.__doc__ = function.__name__, function.__doc__
    command.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return command
