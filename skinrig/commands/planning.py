"""The command `skinrig plan`."""

from __future__ import annotations

import json as json_text
from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.commands import completion
from skinrig.commands.options import Json, Rig, file_to_write
from skinrig.console import Console
from skinrig.next_steps import named
from skinrig.written_units import written


def plan(
    rig: Rig,
    want: Annotated[
        str,
        typer.Option(
            help="Medians that must be reached: dome normals<=1deg,r_d<=3%; flash melanin<=12%,"
            "hemoglobin<=25%; gradient normals<=2deg; probe sigma_tr<=3%. Empty: what the whole "
            "rig, or --forecast, will give."
        ),
    ] = "",
    subject: Annotated[
        str,
        typer.Option(
            help="Skin that is forecast: a preset, I to VI, or a file NAME.toml.",
            autocompletion=completion.subjects,
        ),
    ] = "III",
    width: Annotated[
        int | None, typer.Option(help="Pixels across the cameras; default: the rig's own.")
    ] = None,
    most_lights: Annotated[
        int | None, typer.Option(help="No more lights of the dome than these.")
    ] = None,
    valid_share: Annotated[
        float, typer.Option(help="Of what the whole rig gives an estimate, so much must keep it.")
    ] = 0.9,
    forecast: Annotated[
        Path | None, typer.Option(help="A plan, JSON: say what it will give instead.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", callback=file_to_write, help="File for the plan, JSON.")
    ] = None,
    confirm: Annotated[
        Path | None,
        typer.Option(help="Folder: simulate the plan, reconstruct, and compare with the forecast."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the face.")] = 0,
    json: Json = False,
) -> None:
    """Choose the smallest plan that reaches an error, and say what it leaves out.

    Example: skinrig plan dome --want "normals<=1deg,r_d<=3%" --out plan.json

    Example: skinrig plan flash --want "melanin<=12%,hemoglobin<=25%" --subject II

    Example: skinrig plan dome --forecast plan.json
    """
    from skinrig.planning.plans import choose, confirmed, lines
    from skinrig.simulating.subject_records import unseen

    console = Console(json)
    if not 0 < valid_share <= 1:
        raise errors.UnusableError(f"--valid-share: got {valid_share:g}, expected above 0, up to 1")
    unused = unseen(subject, rig, console.progress)
    choice = choose(
        rig,
        want,
        subject=subject,
        seed=seed,
        width_px=width,
        most_lights=most_lights,
        valid_share=valid_share,
        forecast=forecast,
    )
    for line in lines(choice):
        console.say(line)
    document = choice.to_document()
    if unused:
        document["subject_unused"] = list(unused)
    reached = choice.reached
    if confirm is not None:
        found = confirmed(choice, confirm, subject=subject, seed=seed, progress=console.progress)
        document["confirmation"] = found
        for row in found:
            console.say(
                f"measured: {row['name']} {written(format(row['median'], '.3g'), row['unit'])}, "
                f"{'within' if row['within'] else 'OUTSIDE'} the forecast's interval"
            )
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = out.with_name(f".{out.name}.part")
        part.write_text(json_text.dumps(choice.plan.to_json(), indent=1) + "\n", encoding="utf-8")
        part.replace(out)
        console.say(f"next: skinrig capture {rig} --plan {named(out)} --out session")
    console.document(document.pop("schema"), document)
    if not reached:
        raise typer.Exit(errors.LIMIT_MISSED)
