"""`skinrig fit reflectance`: the skin reflectance model of a subject."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands.options import Json, NewMaps
from skinrig.console import Console
from skinrig.next_steps import named


def fit_reflectance(
    dome: Annotated[Path, typer.Argument(help="Maps of a dome session: normals, r_d, lobes.")],
    out: NewMaps,
    probe: Annotated[
        Path | None, typer.Argument(help="Maps of a fibre probe session on the same subject.")
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            "--landmarks",
            "--sites",
            help="Table name,x,y of the probe's sites in texels of the dome's maps.",
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Put lobes, albedo, normals and translucency of a subject together as one model.

    Example: skinrig fit reflectance appearance-dome appearance-probe --out model
    """
    from skinrig.fitting.reflectance import fit_reflectance as fit
    from skinrig.fitting.reflectance import summary

    console = Console(json)
    found = fit(dome, probe, out=out, landmarks=landmarks)
    rows = summary(found)
    console.rows(("median over valid texels", "red", "green", "blue"), rows)
    for site in found.placed.sites if found.placed is not None else ():
        console.say(f"{site.name}: texel row {site.texel[0]}, column {site.texel[1]}")
    for text in found.assumed:
        console.say(f"assumed: {text}")
    for what, why in found.left_out:
        console.say(f"left out: {what}: {why}")
    valid = float(found.model.valid.mean())
    console.say(f"{out}: reflectance model, {100 * valid:.0f} % of its texels valid")
    console.say(f"next: skinrig render {named(out)} --light 1,1,2 --out picture")
    console.document(
        "skinrig.fit/1",
        {
            "model": "reflectance",
            "out": out,
            "assumed": list(found.assumed),
            "left_out": [list(row) for row in found.left_out],
            "rows": [list(row) for row in rows],
        },
    )
