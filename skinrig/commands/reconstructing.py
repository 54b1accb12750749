"""`skinrig calibrate` and `skinrig reconstruct`: calibrations and maps from sessions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Annotated

import typer

from skinrig.command_line import completion
from skinrig.command_line.options import (
    ExecutorName,
    Json,
    MeshFile,
    NewMaps,
    OptionalOut,
    Out,
    choice,
    command,
)
from skinrig.command_line.renamed_options import replace_former_values
from skinrig.commands.dynamic import print_fit
from skinrig.console import Console, format_count, select_attributes
from skinrig.errors import UnusableError, UsageError
from skinrig.next_steps import shell_quote, suggest, suggest_after_geometry
from skinrig.studies.executors import check_executor
from skinrig.workspace import scan


@command
def calibrate(
    kind: Annotated[str, typer.Argument(autocompletion=completion.complete_calibrations)],
    sessions: list[Path],
    /,
    out: Out = Path("calibration"),
    square_mm: float = 36.0,
    sphere_mm: float = 50.0,
    phantom: Path | None = None,
    json: Json = False,
) -> None:
    """Calibrate a rig from sessions of a target; report the drift since the last calibration.

    Example: skinrig calibrate sensor session-flat --out calibration

    Parameters
    ----------
    sessions
        SESSION/ folders of the target.
    square_mm
        Side of the calibration board's squares, mm (dome: geometry, scanner).
    sphere_mm
        Radius of the mirror sphere, mm (dome: lights).
    phantom
        Certificate of the phantom, JSON (probe: fiber).
    kind
        Calibration: sensor, color, polarization or white (flash); geometry, lights or
        scanner (dome); sensor, lights or polarization (gradient); fiber (probe).
    """
    from capture.former_names import FORMER_NAMES
    from skinrig.calibrating.calibrate import calibrate as make
    from skinrig.calibrating.dome import dome_targets

    console = Console(json)
    (kind,) = replace_former_values([kind], FORMER_NAMES)
    console.progress(f"calibrate {kind} from {format_count(len(sessions), 'session')}")
    done = make(kind, sessions, out, targets=dome_targets(square_mm, sphere_mm), phantom=phantom)
    rows = [(name.replace("_", " "), value) for name, value in done.summary]
    console.print_table(("quantity", "value"), rows)
    console.print_each("found", done.findings)
    drift = [
        one for one in done.drift if one.change and (one.sigmas is None or abs(one.sigmas) > 2)
    ]
    console.print_each("drift", drift)
    remarks = [
        *([format_count(len(done.findings), "finding")] if done.findings else []),
        *([f"drift of {format_count(len(drift), 'value')}"] if drift else []),
    ]
    verdict = f"check {' and '.join(remarks)} before use" if remarks else "usable, no finding"
    console.print_line(f"{done.path}: {verdict}; valid until {done.calibration.valid_until}")
    lights = suggest_after_geometry(sessions[0], out) if kind == "geometry" else None
    near = scan(out.parent)
    rig = done.calibration.rig
    own = {p: d for p, d in near.sessions.items() if d.get("rig", {}).get("name") == rig}
    steps = suggest(replace(near, sessions=own), out.parent)
    after = [s.command for s in steps if s.command.startswith("skinrig reconstruct")]
    for line in [lights] if lights else after:
        console.print_line(f"next: {line}")
    values = {"path": done.path, "values": dict(done.summary), "findings": done.findings}
    console.print_document("skinrig.calibrate/1", values | {"drift": [str(d) for d in done.drift]})


def check_rank(rank: int | None, basis: Path | None) -> None:
    """Raise if the number of basis BRDFs exceeds the number of materials.

    Parameters
    ----------
    rank
        Number of basis BRDFs of a dome's maps; None: the default number.
    basis
        Folder of MERL or RGL tables; None: the built-in materials.

    Raises
    ------
    skinrig.errors.UnusableError
        More basis BRDFs than materials. The reconstruction itself refuses numbers below 1.
    """
    if rank is None or (basis is not None and not basis.is_dir()):
        return
    if basis is None:
        from model.brdf import recipe as brdf_recipe

        most = sum(1 for _ in brdf_recipe.materials())
    else:
        from model.brdf.tables import list_material_files

        most = len(list_material_files(basis))
    if rank > most:
        where = "the built-in basis" if basis is None else str(basis)
        raise UnusableError(
            f"--rank: got {rank}, expected at most {most}: basis BRDFs are mixtures of the "
            f"{format_count(most, 'material')} of {where}; give a smaller number"
        )


@dataclass(frozen=True, slots=True)
class DomeMapOptions:
    """Options of maps of a light dome.

    Attributes
    ----------
    scan
        Face mesh, PLY in mm; default: the session's own scan (dome).
    merl_basis
        Folder of MERL or RGL tables for the basis BRDFs; default: built-in materials (dome).
    hold_out
        Frames excluded from all fits: lights=L007,L023,views=C03 (dome).
    rank
        Number of basis BRDFs; default 4 (dome).
    """

    scan: Path | None = None
    merl_basis: Path | None = None
    hold_out: str | None = None
    rank: int | None = None


@command
def reconstruct(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION")],
    /,
    *,
    maps: Annotated[str | None, typer.Option(autocompletion=completion.complete_wants)] = None,
    out: OptionalOut = None,
    list_maps: Annotated[bool, typer.Option("--list")] = False,
    calibration: Path | None = None,
    state: str = "neutral",
    landmarks: Path | None = None,
    dome: DomeMapOptions,
    executor: ExecutorName = "threads",
    json: Json = False,
) -> None:
    """Compute maps of a session; stages that are up to date are reused.

    Several sessions are reconstructed one by one, each into the folder OUT/NAME of its name.

    Example: skinrig reconstruct session --maps melanin,hemoglobin --out appearance

    Example: skinrig reconstruct monday tuesday --maps melanin --out appearances

    Parameters
    ----------
    calibration
        CALIBRATION/ folder; default: nominal values, listed as assumed (flash, photographs).
    state
        Expression or condition to reconstruct.
    landmarks
        CSV table name,x,y of the sites, in pixels of the 256 x 256 face map (probe).
    sessions
        SESSION/ folder; several are reconstructed one by one.
    maps
        Maps to compute, separated by commas (required without --list).
    list_maps
        Print the names of the maps that each session yields, and compute nothing.
    """
    from model.store import FORMER_MAP_NAMES
    from reconstruction.pipeline.inputs import DomeOptions
    from skinrig.appearances.state_truth import find_comparison_truth
    from skinrig.studies.reconstruction import ReconstructionOrder, reconstruct_sessions

    console = Console(json)
    if list_maps:
        _print_maps(sessions, console)
        return
    if maps is None or out is None:
        missing = "--maps" if maps is None else "--out"
        raise UsageError(
            f"{missing}: not given; name the maps and the folder, as --maps melanin --out maps; "
            "--list prints the maps of a session"
        )
    check_executor(executor)
    check_rank(dome.rank, dome.merl_basis)
    wants = [name.strip() for name in maps.split(",") if name.strip()]
    wants = replace_former_values(wants, FORMER_MAP_NAMES)
    folders = assign_output_folders(sessions, out)
    found = [find_comparison_truth(session, state) for session in sessions]
    truths = [truth for truth in found if truth]
    orders = [
        ReconstructionOrder(
            session=session,
            want=tuple(wants),
            out=folder,
            calibration=calibration,
            state=state,
            landmarks=landmarks,
            truth=truth.name if truth else "",
            dome=DomeOptions(dome.scan, dome.merl_basis, dome.hold_out, dome.rank),
        )
        for session, folder, truth in zip(sessions, folders, found, strict=True)
    ]
    made = []
    results = reconstruct_sessions(orders, executor=executor, progress=console.progress)
    for session, folder, done in zip(sessions, folders, results, strict=True):
        if len(sessions) > 1:
            console.print_line(f"{session}:")
        console.print_each("assumed", done.assumed)
        for outcome, names in (("run", done.ran), ("reused", done.reused)):
            if names:
                console.print_line(f"{outcome}: {', '.join(names)}")
        console.print_each("omitted", (f"{what} ({why})" for what, why in done.omitted))
        written = select_attributes(done, "ran", "reused", "assumed", "work")
        made.append({"path": folder, **written, "left_out": done.omitted})
    shown = [out, *truths, *([calibration] if calibration else [])]
    console.print_line(f"next: skinrig report {' '.join(map(shell_quote, shown))}")
    console.print_document(
        "skinrig.reconstruct/1", made[0] if len(made) == 1 else {"path": out, "appearances": made}
    )


def _print_maps(sessions: Sequence[Path], console: Console) -> None:
    """Print the names of the maps that each session yields."""
    from reconstruction.pipeline.recipes import list_maps

    found = {str(session): list_maps(session) for session in sessions}
    for session, names in found.items():
        console.print_line(f"{session}: {', '.join(names)}" if len(found) > 1 else "\n".join(names))
    console.print_document("skinrig.maps/1", {"maps": found})


def assign_output_folders(sessions: Sequence[Path], out: Path) -> list[Path]:
    """Return the output folder of each session's maps.

    Parameters
    ----------
    sessions
        SESSION/ folders.
    out
        Output folder of a single session; parent of the output folders of several.

    Raises
    ------
    skinrig.errors.UnusableError
        If two sessions have the same name, or `out` of several holds maps already.

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
            f"SESSION: got two folders named {twice!r}, expected different names;"
            " reconstruct them one by one, each with its own --out"
        )
    if (out / "appearance.json").exists():
        raise UnusableError(
            f"--out: {out} holds the maps of one session, expected a folder for the maps of"
            f" {len(names)} sessions; name another folder"
        )
    return [out / name for name in names]


@command
def fit_template(
    scan: Path,
    /,
    out: MeshFile,
    template: Path | None = None,
    landmarks: Path | None = None,
    template_landmarks: Path | None = None,
    unit: Annotated[str, choice("mm", "cm", "m", "inch")] = "mm",
    search: Annotated[str, choice("auto", "always", "never")] = "auto",
    steps: int = 8,
    json: Json = False,
) -> None:
    """Wrap a face template onto a scan, so that scans share triangles and texture layout.

    The fit is deterministic. The mesh stays in the scan's frame.

    Example: skinrig fit template session-smile --out smile.ply

    Example: skinrig fit template scan.obj --unit m --landmarks points.csv --out wrapped.ply

    Parameters
    ----------
    scan
        Scanned mesh, .obj or .ply, or a session with a scan.
    template
        Mesh with texture coordinates, mm: .obj or .ply; default: an average face.
    landmarks
        CSV table name,x,y,z of the template's named points on the scan, mm.
    template_landmarks
        CSV table name,x,y,z of named points of your own template, mm.
    unit
        Length unit of the scan's file: mm, cm, m or inch.
    search
        Search of the face's pose: auto (where the frames differ), always or never.
    steps
        Number of stiffness steps.
    """
    from skinrig.fitting.template import TemplateFiles
    from skinrig.fitting.template import fit_template as fit

    console = Console(json)
    found = fit(
        TemplateFiles(scan, template, landmarks, template_landmarks, unit),
        out=out,
        search={"auto": None, "always": True, "never": False}[search],
        steps=steps,
        progress=console.progress,
    )
    figures = {
        "vertices": len(found.valid),
        "valid_fraction": float(found.valid.mean()),
        "rms_mm": found.rms_mm,
        "median_across_mm": median(found.across_mm[found.valid].tolist()),
        "median_along_mm": median(found.along_mm[found.valid].tolist()),
        "folded": found.folded,
        "scale": found.pose.scale,
        "match": found.pose.match,
    }
    console.print_table(("figure", "value"), figures.items())
    if scan.is_dir():
        console.print_line(
            f"next: skinrig reconstruct {shell_quote(scan)} --scan {shell_quote(out)} "
            "--maps normals --out appearance"
        )
    print_fit(console, "template", out, figures)


@command
def fit_reflectance(
    dome: Path,
    probe: Path | None = None,
    /,
    *,
    out: NewMaps,
    landmarks: Annotated[Path | None, typer.Option("--landmarks", "--sites")] = None,
    json: Json = False,
) -> None:
    """Combine basis BRDFs, albedo, normals and translucency of a subject into one model.

    Example: skinrig fit reflectance appearance-dome appearance-probe --out model

    Parameters
    ----------
    dome
        Maps of a dome session: normals, r_d, basis BRDF weights.
    probe
        Maps of a fiber probe session of the same subject; default: dome maps only.
    landmarks
        CSV table name,x,y of the probe's sites, texels of the dome's maps.
    """
    from skinrig.fitting.reflectance import fit_reflectance as fit
    from skinrig.fitting.reflectance import summarize_medians

    console = Console(json)
    found = fit(dome, probe, out=out, landmarks=landmarks)
    rows = summarize_medians(found)
    console.print_table(("median over valid texels", "red", "green", "blue"), rows)
    for site in found.placed.sites if found.placed is not None else ():
        console.print_line(f"{site.name}: texel row {site.texel[0]}, column {site.texel[1]}")
    console.print_each("assumed", found.assumed)
    console.print_omissions(found.left_out)
    valid = float(found.model.valid.mean())
    console.print_line(f"{out}: reflectance model, {100 * valid:.0f} % of its texels valid")
    console.print_line(f"next: skinrig render {shell_quote(out)} --light 1,1,2 --out picture")
    print_fit(
        console,
        "reflectance",
        out,
        select_attributes(found, "assumed", "left_out") | {"rows": rows},
    )
