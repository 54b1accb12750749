"""The command that hands captures and appearances to other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.cli_options import Json, Out
from skinrig.console import Console


def export(
    source: Annotated[
        Path, typer.Argument(help="SESSION/ folder; APPEARANCE/ of a dome for merl and rgl.")
    ],
    to: Annotated[str, typer.Option(help="mhl, frames, event-model; merl, rgl.")],
    out: Out,
    use: Annotated[
        str | None, typer.Option(help="What a session is for; the consent must cover it.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(help="Place on the skin, U,V in 0 to 1: its BRDF too (merl, rgl).")
    ] = None,
    radius: Annotated[float, typer.Option(help="Average around the place, mm.")] = 0.0,
    without_diffuse: Annotated[
        bool, typer.Option("--without-diffuse", help="The place's surface alone.")
    ] = False,
    json: Json = False,
) -> None:
    """Hand a session on, within the subject's consent, or the BRDFs of an appearance.

    All files are listed in an ASC MHL manifest.

    Example: skinrig export session --to frames --use research --out delivery
    """
    from skinrig import export as hand_on
    from skinrig.brdf_export import SUFFIX, place_of

    console = Console(json)
    if to in SUFFIX:
        place = place_of(at, radius_mm=radius, diffuse=not without_diffuse)
        done = hand_on.export_brdfs(source, out, to=to, place=place)
    else:
        done = hand_on.export(source, out, to=to, use=hand_on.named(use))
    console.say(f"{done.path}: {done.files} files, listed in {done.manifest}")
    console.document(
        "skinrig.export/1", {"path": done.path, "files": done.files, "manifest": done.manifest}
    )
