"""`skinrig fuse`: one person's maps by several rigs to one appearance."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from skinrig.command_line.options import Json, Out, command
from skinrig.console import Console
from skinrig.next_steps import shell_quote


@command
def fuse(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION_OR_APPEARANCE")],
    /,
    out: Out = Path("double"),
    without: str | None = None,
    landmarks: Path | None = None,
    image_landmarks: Path | None = None,
    sites: Path | None = None,
    json: Json = False,
) -> None:
    """Fuse one person's maps by flash rig, dome, gradient rig and probe into one appearance.

    Melanin, blood, R_d and sigma_tr are estimated together, on the dome's texture. The gradient
    rig's patch keeps its pixels and gets the dome's low frequencies. Wrinkles that `skinrig fit
    wrinkles` fitted to the dome's expressions are carried along.

    Example: skinrig fuse session-flash session-dome session-gradient session-probe --out double

    Parameters
    ----------
    sessions
        SESSION/ folders with their maps next to them, or APPEARANCE/ folders; one per rig, and one
        with fitted wrinkles.
    without
        What to leave out, separated by commas: rigs (flash, dome, gradient, probe), wrinkles, maps
        (diffuse, r_d, normals, sigma_tr), covariance, or unmeasured (eyes, hair, crown and neck
        for display). The cost of others is printed: the maps are also estimated with them.
    landmarks
        CSV table name,x,y,z in mm of the dome's mesh, or name,x,y in texels of its maps.
    image_landmarks
        CSV table name,x,y in pixels of the flash rig's maps.
    sites
        CSV table name,x,y of sites of probe and gradient rig, texels of the dome's maps.
    """
    from skinrig.capturing.option_values import parse_names
    from skinrig.fusing.cost import compare_without
    from skinrig.fusing.double import FusionInputs, fuse, fuse_sources
    from skinrig.fusing.sources import read_sources
    from skinrig.fusing.summary import summarize
    from skinrig.fusing.unmeasured import UNMEASURED_NAME
    from skinrig.unmeasured.person import UNMEASURED_KEY

    console = Console(json)
    given = FusionInputs(
        tuple(sessions), parse_names(without) or (), landmarks, image_landmarks, sites
    )
    found = fuse(given, out=out, progress=console.progress)
    rows = summarize(found)
    console.print_table(("map", "median", "68 % interval, %", "common to the face, %"), rows)
    console.print_table(
        ("rig", "probability that it is faulty", "p value of its gains"),
        [(one.rig, round(one.probability, 4), one.p_value) for one in found.all_checks],
    )
    cost = []
    if set(given.without) - {UNMEASURED_NAME}:
        console.progress("once more, with what was left out")
        whole = fuse_sources(read_sources(given.paths), replace(given, without=()))
        cost = compare_without(whole.appearance, found.appearance)
        head = ("map", "68 % interval with all, %", "without, %", "change, standard errors")
        console.print_table(head, cost)
    if found.contradiction is not None:
        console.print_line(f"contradiction: {found.contradiction}")
    console.print_each("assumed", found.assumed)
    console.print_omissions(found.left_out)
    added = found.appearance.parameters.get(UNMEASURED_KEY)
    if isinstance(added, dict):
        console.print_line(
            f"not measured, for display: {', '.join(added['parts'])}; --without {UNMEASURED_NAME} "
            "leaves them out"
        )
    console.print_line(f"{out}: {', '.join(sorted(found.appearance.maps))}")
    console.print_line(f"next: skinrig report {shell_quote(out)}")
    console.print_document(
        "skinrig.fuse/1",
        {
            "out": out,
            "maps": sorted(found.appearance.maps),
            "rows": rows,
            "cost": cost,
            "fusion": found.appearance.parameters["fusion"],
            "contradiction": found.contradiction,
            "unmeasured": added,
            "left_out": found.left_out,
        },
    )
