"""The commands that make calibrations, and maps."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands import completion
from skinrig.commands.options import Json, Out, command
from skinrig.console import Console, format_count, select_attributes
from skinrig.errors import UnusableError
from skinrig.next_steps import shell_quote


@command
def calibrate(
    kind: Annotated[str, typer.Argument(autocompletion=completion.calibrations)],
    sessions: list[Path],
    /,
    out: Out = Path("calibration"),
    square_mm: float = 36.0,
    sphere_mm: float = 50.0,
    phantom: Path | None = None,
    json: Json = False,
) -> None:
    """Make a calibration from sessions of a target and say how it drifted.

    Example: skinrig calibrate sensor session-flat --out calibration

    Parameters
    ----------
    sessions
        Sessions of the target.
    square_mm
        Side of the squares of geometry's board, mm.
    sphere_mm
        Radius of the mirror sphere of lights, mm.
    phantom
        Certificate (JSON) of the block fibre was measured on.
    kind
        Of the flash rig sensor, color, polarization, white; of the dome geometry, lights; of the
        gradient sphere sensor, lights, polarization; of the probe fibre.
    """
    from skinrig.calibrating.calibrate import calibrate as make
    from skinrig.calibrating.dome import dome_targets

    console = Console(json)
    done = make(kind, sessions, out, targets=dome_targets(square_mm, sphere_mm), phantom=phantom)
    console.rows(("quantity", "value"), done.summary)
    console.each("found", done.findings)
    for change in done.drift:
        if change.change and (change.sigmas is None or abs(change.sigmas) > 2):
            console.say(f"drift: {change}")
    console.say(f"{done.path}: valid until {done.calibration.valid_until}")
    values = {"path": done.path, "values": dict(done.summary), "findings": done.findings}
    console.document("skinrig.calibrate/1", values | {"drift": [str(d) for d in done.drift]})


def check_rank(rank: int | None, basis: Path | None) -> None:
    """Raise unless a basis has as many materials as lobes are asked for.

    Parameters
    ----------
    rank
        Lobes that a dome's points share; None: as many as usual.
    basis
        Folder of MERL tables; None: the built-in materials.

    Raises
    ------
    skinrig.errors.UnusableError
        More lobes than materials; that there are fewer than one is told by the reconstruction.
    """
    if rank is None or (basis is not None and not basis.is_dir()):
        return
    if basis is None:
        from model.brdf import recipe as brdf_recipe

        most = sum(1 for _ in brdf_recipe.materials())
    else:
        most = sum(file.suffix.lower() == ".binary" for file in basis.iterdir())
    if rank > most:
        where = "the built-in basis" if basis is None else str(basis)
        raise UnusableError(
            f"--rank: got {rank}, expected at most {most}: lobes are mixtures of the "
            f"{format_count(most, 'material')} of {where}"
        )


@command
def reconstruct(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION")],
    /,
    want: Annotated[str, typer.Option(autocompletion=completion.complete_wants)],
    out: Out,
    calibration: Path | None = None,
    state: str = "neutral",
    scan: Path | None = None,
    basis: Path | None = None,
    landmarks: Path | None = None,
    hold_out: str | None = None,
    rank: int | None = None,
    json: Json = False,
) -> None:
    """Make maps of a session; computes only what is wanted and not there yet.

    Maps of several sessions, each by itself, go to folders of their names in the one of --out.

    Example: skinrig reconstruct session --want melanin,hemoglobin --out appearance

    Example: skinrig reconstruct monday tuesday --want melanin --out appearances

    Parameters
    ----------
    calibration
        CALIBRATION/ folder.
    state
        State of the subject.
    scan
        Mesh of the face, PLY in mm, instead of a dome session's.
    basis
        Folder of MERL tables to fit a dome's lobes with.
    landmarks
        Table name,x,y of a probe's sites in pixels of its 256 x 256 map.
    hold_out
        A dome's frames that no fit sees: lights=L007,L023,views=C03.
    rank
        Lobes that a dome's points share; default 4.
    sessions
        SESSION/ folder.
    want
        Maps, separated by commas; a wrong name lists those there are.
    """
    from reconstruction.pipeline import recipes as pipeline
    from reconstruction.pipeline.inputs import DomeOptions
    from skinrig.appearances.state_truth import find_comparison_truth

    console = Console(json)
    check_rank(rank, basis)
    wants = [name.strip() for name in want.split(",") if name.strip()]
    made = []
    for session, folder in zip(sessions, assign_output_folders(sessions, out), strict=True):
        truth = find_comparison_truth(session, state)
        if len(sessions) > 1:
            console.say(f"{session}:")
        done = pipeline.reconstruct(
            session,
            want=wants,
            out=folder,
            calibration=calibration,
            state=state,
            landmarks=landmarks,
            progress=console.progress,
            truth=truth.name if truth else "",
            dome=DomeOptions(scan, basis, hold_out, rank),
        )
        console.each("assumed", done.assumed)
        console.say(f"run: {', '.join(done.ran) or 'nothing'}")
        console.say(f"reused: {', '.join(done.reused) or 'nothing'}")
        console.each("left out", (f"{what} ({why})" for what, why in done.omitted))
        written = select_attributes(done, "ran", "reused", "left_out", "assumed", "work")
        made.append({"path": folder, **written})
    console.say(f"next: skinrig report {shell_quote(out)}")
    console.document(
        "skinrig.reconstruct/1", made[0] if len(made) == 1 else {"path": out, "appearances": made}
    )


def assign_output_folders(sessions: Sequence[Path], out: Path) -> list[Path]:
    """Return where the maps of each session go.

    Parameters
    ----------
    sessions
        One or several.
    out
        As given: the folder of one session's maps, else the one that holds theirs.

    Raises
    ------
    skinrig.errors.UnusableError
        Where two sessions would go to one folder, or several into a folder of maps.

    Examples
    --------
    >>> [str(folder) for folder in assign_output_folders([Path("a"), Path("b/c")], Path("out"))]
    ['out/a', 'out/c']
    """
    if len(sessions) == 1:
        return [out]
    names = [session.absolute().name for session in sessions]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UnusableError(
            f"SESSION: got two of the name {twice!r}, whose maps would go to one folder;"
            " reconstruct them one by one"
        )
    if (out / "appearance.json").exists():
        raise UnusableError(
            f"--out: {out} holds the maps of one session, expected a folder for those of"
            f" {len(names)}; name another"
        )
    return [out / name for name in names]
