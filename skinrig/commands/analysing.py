"""`skinrig analyse`: what fitted faces have in common."""

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from skinrig.commands.help import Command, Subcommands
from skinrig.commands.options import Json, Out, command, option
from skinrig.console import Console
from skinrig.errors import UnusableError, UsageError, one_of

Labels = Annotated[Path | None, option("Table name,TRAIT,... of 0 and 1, a line for each face.")]

analyse_app = typer.Typer(cls=Subcommands, help="Analyse faces together.", no_args_is_help=True)


@analyse_app.callback()
def analyse() -> None:
    """Analyse faces together."""


@analyse_app.command("brdf", cls=Command)
@command
def analyse_brdf(
    appearances: list[Path] | None = None,
    /,
    *,
    out: Out,
    labels: Labels = None,
    basis: Path | None = None,
    points: int | None = None,
    method: str = "shares",
    seed: int = 0,
    json: Json = False,
) -> None:
    """Tell how many lobes the surfaces of faces need, and draw their mean reflection.

    Needed is the first number whose error exceeds the least one by no more than 5 % of the fall
    from one lobe to the least; the next columns say it by 2 and 10 %, and where the error falls
    below what noise alone leaves.

    Example: skinrig analyse brdf appearance-a appearance-b --labels labels.csv --out analysis

    Parameters
    ----------
    appearances
        Maps of dome sessions, with lobes; none: simulated faces.
    basis
        Folder of the MERL files the lobes were fitted with.
    points
        Texels of each face, default 2000; simulated: points of the one person and of the seven
        conditions, default 5000, each of the 87 people having two fifths of it.
    method
        How lobes are joined: as shares of materials, or as brdf.
    seed
        Of everything random.
    """
    from reconstruction.brdf_basis.space import Method
    from skinrig.analysing import brdf as analysing_brdf

    how = one_of("--method", method, get_args(Method))
    if points is not None and points < 20:
        raise UnusableError(f"--points: got {points}, expected 20 or more")
    console = Console(json)
    if appearances:
        each = points or analysing_brdf.N_POINTS_PER_FACE
        given: dict[str, Any] = {"labels": labels, "basis": basis, "method": how, "seed": seed}
        found = analysing_brdf.analyze_measured(out, appearances, points_each=each, **given)
    elif labels is not None or basis is not None:
        raise UsageError("--labels, --basis: are of measured faces; name their folders")
    else:
        some = points or analysing_brdf.N_POINTS_PER_DATASET
        each = max(1, round(0.4 * some))
        found = analysing_brdf.analyze_simulated(
            out, points=some, points_each=each, method=how, seed=seed, progress=console.progress
        )
    documents = [one.document() for one in found]
    console.rows(
        ("points of", "needs", "by 2 %", "by 10 %", "to noise", "error", "others", "noise"),
        ((d["name"], *_plateaus(d), *_at_plateau(d)) for d in documents),
    )
    for document in documents:
        left_out = document["left_out"]
        console.left_out((f"{document['name']}, {r} lobes and more", why) for r, why in left_out)
        if document["points_lost"]:
            console.say(f"{document['name']}: {document['points_lost']} points show no lobe")
    console.say(f"{out}: figure-14.png, figure-15.png, curves.csv, analysis.json")
    console.document("skinrig.analyse-brdf/1", {"out": out, "datasets": documents})


def _plateaus(document: dict[str, Any]) -> list[object]:
    """Return the plateau, by the usual and two other shares of the fall, and the rank at noise."""
    by_share, at_noise = document["plateau_by_share"], document["rank_at_noise"]
    return [document["plateau"], by_share["0.02"], by_share["0.1"], at_noise or "-"]


def _at_plateau(document: dict[str, Any]) -> list[str]:
    """Return the errors at the plateau, in and out of sample, and what noise leaves."""
    at = document["ranks"].index(document["plateau"])
    errors = (document["error"][at], document["held_out_error"][at], document["noise"])
    return ["-" if value is None else f"{100.0 * value:.1f} %" for value in errors]
