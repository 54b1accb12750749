"""Options that several commands take."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands import completion
from skinrig.errors import UnusableError, UsageError

Rig = Annotated[
    str,
    typer.Argument(
        help="Name of a rig: flash, dome, gradient or probe.", autocompletion=completion.rigs
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print exactly one JSON document on stdout.")]
Seed = Annotated[int, typer.Option(help="Seed of everything that is drawn.")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write.")]


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
    if out is not None and not context.resilient_parsing and str(out) == STDOUT:
        raise UsageError("--out: got '-', expected a file to write")
    return file_to_write(context, out)


STDOUT = "-"
"""The standard output where a file is named."""
Page = Annotated[Path, typer.Option("-o", "--out", callback=page_to_write, help="The page.")]
Site = Annotated[
    str | None,
    typer.Option(help="Where the gradient rig's skin is from: forehead (default), cheek or chin."),
]
Sites = Annotated[
    str | None,
    typer.Option(help="Where the probe is placed, joined by commas: forehead,cheek,chin."),
]
Repeats = Annotated[
    int, typer.Option(help="Placements of the probe a site and angle; pairs a state of the flash.")
]
AllBrackets = Annotated[
    bool, typer.Option("--all-brackets", help="The probe's exposures that can show no more, too.")
]
Angles = Annotated[
    str | None,
    typer.Option(
        help="Angles of the caliper, degrees, joined by commas: 0,90; of the probe how many "
        "directions of its head: 16."
    ),
]
Sequence = Annotated[
    str | None,
    typer.Option(
        help="Of the flash rig, a sequence in time: an expression made and dropped by a sound, "
        "such as smile, or exercise or alcohol, followed after the event."
    ),
]
PromptPeriod = Annotated[
    str | None, typer.Option(help="Of a sequence: seconds from sound to sound; default 5.")
]
ShotPeriod = Annotated[
    str | None,
    typer.Option(help="Of a sequence: seconds from shot to shot; default 5.5, of alcohol 300."),
]
Captures = Annotated[
    int | None,
    typer.Option(help="Shots of a sequence by sounds; default: each phase, a tenth twice."),
]
Duration = Annotated[
    str | None,
    typer.Option(help="Seconds an event is followed; default 60 for exercise, 3600 for alcohol."),
]
Steps = Annotated[str | None, typer.Option(help="First and last position of the caliper: -2..3.")]
Consent = Annotated[
    list[str] | None,
    typer.Option("--consent", help="Use that the subject agreed to; repeatable, or by commas."),
]
ConsentExpires = Annotated[
    datetime | None,
    typer.Option("--consent-expires", formats=["%Y-%m-%d"], help="Last day of the consent."),
]
