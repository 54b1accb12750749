"""Functions of skinrig for scripts and notebooks: one for each step from plan to page.

Each returns a result that refers to files on disk, as the commands write them. Notebooks display
results with pictures and verdicts. Errors are those of the packages, in one sentence each.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from skinrig.python_api.progress import show_progress
from skinrig.python_api.results import (
    CalibrationFolder,
    ChosenPlan,
    DiagnosedSession,
    ExportedFolder,
    FittedModel,
    HtmlPage,
    MapsFolder,
    NotebookResult,
    SessionFolder,
)

if TYPE_CHECKING:
    import xarray

FolderLike: TypeAlias = str | Path | NotebookResult
FIT_KINDS: Final = (
    "facial_color",
    "wrinkles",
    "microstructure",
    "reflectance",
    "traits",
    "template",
)
"""Kinds of `fit`."""


def to_path(folder: FolderLike) -> Path:
    """Return the path of a folder, or of a result.

    Examples
    --------
    >>> to_path("session").as_posix(), to_path(SessionFolder(Path("session"))).as_posix()
    ('session', 'session')
    """
    return folder.path if isinstance(folder, NotebookResult) else Path(folder)


def simulate(
    rig: str,
    out: str | Path,
    *,
    subject: str = "III",
    target: str | None = None,
    seed: int = 0,
    progress: bool = True,
    **options: Any,
) -> SessionFolder:
    """Simulate a capture with the real drivers, and write its ground truth next to it.

    Parameters
    ----------
    rig
        "flash", "dome", "gradient" or "probe".
    out
        New SESSION/ folder.
    subject
        Preset I to VI, palest, darkest, "ita:DEGREES", "monk:N", or a file NAME.toml.
    target
        Calibration target instead of a subject, such as "white".
    seed
        Seed of subject, rig and noise.
    progress
        Whether a progress bar is shown.
    **options
        Further fields of the rig's order, see `skinrig.simulating.orders`.

    Raises
    ------
    skinrig.simulating.orders.SimulationError
        For an option that the rig does not accept.
    """
    from skinrig.simulating.simulation import simulate_session

    given = {"subject": subject, "target": target, "seed": seed, **options}
    with show_progress(f"simulate {rig}", progress) as report_line:
        done = simulate_session(rig, out, progress=report_line, **given)
    return SessionFolder(done.session, done.truth)


def load_session(
    source: FolderLike | xarray.DataArray,
    out: str | Path | None = None,
    *,
    subject: str = "unnamed",
    consent: str | Sequence[str] | None = None,
) -> SessionFolder:
    """Open a session, or write one from an array of images under one light each.

    Parameters
    ----------
    source
        SESSION/ folder; or images with dimensions light, y, x and, for color, channel (R, G, B);
        linear, any unit, NaN or 0 where nothing was recorded. Its coordinates ``direction_x``,
        ``direction_y``, ``direction_z`` along light are the unit vectors towards the lights: x
        right, y up, z towards the camera.
    out
        New SESSION/ folder of an array; None for a folder.
    subject
        Pseudonym of the subject of an array, never a name; "none" for a thing.
    consent
        Uses that the subject has agreed to, such as "research" or "research,teaching"; None:
        every use of a thing and none of a person, of whom nothing is then exported.

    Raises
    ------
    capture.session.SessionError
        If the folder is not a session, or `out` exists.
    skinrig.errors.UsageError
        If `out` is missing or superfluous, or the array lacks a dimension or coordinate.
    """
    from capture.session import Session
    from skinrig.errors import UsageError

    if not isinstance(source, (str, Path, NotebookResult)):
        from skinrig.python_api.xarrays import write_stack_session

        if out is None:
            raise UsageError("out: got none with an array of images; name a new folder")
        from skinrig.consent import parse_subject

        person = parse_subject(subject, [consent] if isinstance(consent, str) else consent, None)
        return SessionFolder(write_stack_session(source, Path(out), person))
    if out is not None:
        raise UsageError("out: applies to arrays of images, not to a folder; remove it")
    from skinrig.appearances.state_truth import find_comparison_truth

    path = to_path(source)
    Session.open(path)
    return SessionFolder(path, find_comparison_truth(path))


def calibrate(
    kind: str,
    sessions: FolderLike | Sequence[FolderLike],
    out: str | Path = "calibration",
    *,
    square_mm: float = 36.0,
    sphere_mm: float = 50.0,
    phantom: str | Path | None = None,
) -> CalibrationFolder:
    """Estimate one kind of calibration from sessions of targets, and save it.

    Parameters
    ----------
    kind
        As for `skinrig calibrate`, such as "sensor" or "white".
    sessions
        One or more SESSION/ folders of the target.
    out
        CALIBRATION/ folder; other kinds in it are kept.
    square_mm
        Side of the calibration board's squares, mm (dome: geometry, scanner).
    sphere_mm
        Radius of the mirror sphere, mm (dome: lights).
    phantom
        Certificate of the phantom, JSON (probe: fiber); None: that of the simulated one.

    Raises
    ------
    skinrig.calibrating.outcome.CalibratingError
        If the sessions lack what the kind requires.
    """
    from skinrig.calibrating.calibrate import calibrate as save_calibration
    from skinrig.calibrating.dome import dome_targets

    paths, targets = [to_path(one) for one in _listed(sessions)], dome_targets(square_mm, sphere_mm)
    saved = save_calibration(kind, paths, Path(out), targets=targets, phantom=phantom)
    return CalibrationFolder(Path(out), saved)


def reconstruct(
    session: FolderLike,
    maps: str | Sequence[str],
    out: str | Path,
    *,
    calibration: FolderLike | None = None,
    state: str = "neutral",
    progress: bool = True,
    scan: str | Path | None = None,
    merl_basis: str | Path | None = None,
    rank: int | None = None,
    hold_out: str | None = None,
    landmarks: str | Path | None = None,
) -> MapsFolder:
    """Compute maps of a session; stages that are up to date are reused.

    Parameters
    ----------
    session
        SESSION/ folder.
    maps
        Names of maps, as a sequence or separated by commas.
    out
        APPEARANCE/ folder.
    calibration
        CALIBRATION/ folder; None: nominal values, which the notes list as assumed.
    state
        Expression or condition.
    progress
        Whether a progress bar is shown.
    scan
        Face mesh, PLY in mm; None: the session's own scan (dome).
    merl_basis
        Folder of MERL and RGL tables as basis BRDFs; None: the generated ones (dome).
    rank
        Number of basis BRDFs; None: 4 (dome).
    hold_out
        Lights and views that no fit uses, such as "lights=L007,views=C03" (dome).
    landmarks
        CSV table name,x,y of the sites on the translucency map, pixels (probe).

    Raises
    ------
    ValueError
        If a map is unknown, or the session lacks what it requires.
    """
    from reconstruction.pipeline import recipes
    from reconstruction.pipeline.inputs import DomeOptions
    from skinrig.appearances.state_truth import find_comparison_truth

    wanted = maps.split(",") if isinstance(maps, str) else maps
    path, target = to_path(session), Path(out)
    truth = find_comparison_truth(path, state)
    with show_progress("reconstruct", progress) as report_line:
        done = recipes.reconstruct(
            path,
            want=[name.strip() for name in wanted],
            out=target,
            calibration=None if calibration is None else to_path(calibration),
            state=state,
            landmarks=landmarks,
            dome=DomeOptions(scan, merl_basis, hold_out, rank),
            progress=report_line,
            truth=truth.name if truth else "",
        )
    notes = [f"assumed: {text}" for text in done.assumed]
    notes += [f"omitted: {what}: {why}" for what, why in done.omitted]
    return MapsFolder(target, truth, tuple(notes))


def diagnose(session: FolderLike) -> DiagnosedSession:
    """Find what is wrong with images under listed lights, polarized pairs or gradient patterns.

    Parameters
    ----------
    session
        Session of `load_session` from an array, of `skinrig import`, or of the flash or gradient
        rig.

    Raises
    ------
    ValueError
        If the session has no such images.
    """
    from reconstruction.pipeline.recipes import diagnose as find_faults

    path = to_path(session)
    return DiagnosedSession(path, find_faults(path))


def plan(rig: str, goals: str = "", *, out: str | Path = "plan.json", **options: Any) -> ChosenPlan:
    """Choose the smallest plan that reaches given errors, and write it.

    Parameters
    ----------
    rig
        "flash", "dome", "gradient" or "probe".
    goals
        Median errors to reach, such as "normals<=1deg,r_d<=3%"; empty: the complete rig.
    out
        Plan file, JSON.
    **options
        See `skinrig.planning.plans.choose`: subject, seed, width_px, max_lights and others.

    Raises
    ------
    skinrig.planning.plans.PlanningError
        If goals or options are invalid.
    """
    from skinrig.atomic_file import write_atomically
    from skinrig.planning.plans import choose

    choice = choose(rig, goals, **options)
    write_atomically(Path(out), json.dumps(choice.plan.to_json(), indent=1) + "\n")
    return ChosenPlan(Path(out), choice)


def report(
    paths: FolderLike | Sequence[FolderLike],
    out: str | Path = "report.html",
    *,
    compare: bool | None = None,
) -> HtmlPage:
    """Write a self-contained HTML report on results and their errors against ground truth.

    Parameters
    ----------
    paths
        Folders or files written by skinrig; two of one kind are compared.
    out
        HTML file; an existing one is replaced.
    compare
        Whether two runs are compared; None: if there are two of one kind.

    Raises
    ------
    skinrig.reporting.folders.ReportError
        If nothing is found.
    """
    from skinrig.atomic_file import write_atomically
    from skinrig.reporting.report import build_any

    done = build_any([to_path(one) for one in _listed(paths)], compare=compare)
    write_atomically(Path(out), done.html)
    return HtmlPage(Path(out), done.verdict)


def fit(
    kind: str, sources: FolderLike | Sequence[FolderLike], out: str | Path, **options: Any
) -> FittedModel:
    """Fit a model to maps or sessions.

    Parameters
    ----------
    kind
        One of `FIT_KINDS`.
    sources
        SESSION/ folders (facial_color), maps (wrinkles, microstructure, traits), maps of the dome
        and of the probe (reflectance), or a scanned mesh (template). "NAME=FOLDER" gives a state or
        a site.
    out
        New folder or file of the model.
    **options
        Arguments of the fit, see `skinrig.fitting`.

    Raises
    ------
    skinrig.errors.UnusableError
        If the kind is unknown.
    ValueError
        If the sources lack what the fit requires.
    """
    from importlib import import_module

    from skinrig.errors import require_choice

    require_choice("kind", kind, FIT_KINDS)
    paths, target = [to_path(one) for one in _listed(sources)], Path(out)
    make = getattr(import_module(f"skinrig.fitting.{kind}"), f"fit_{kind}")
    if kind == "template":
        from skinrig.fitting.template import TemplateFiles

        return FittedModel(target, kind, make(TemplateFiles(paths[0]), out=target, **options))
    if kind == "reflectance":
        return FittedModel(target, kind, make(*paths, out=target, **options))
    return FittedModel(target, kind, make(paths, out=target, **options))


def export(
    source: FolderLike, to: str, out: str | Path, *, use: str | None = None, **settings: Any
) -> ExportedFolder:
    """Write a session or an appearance in a format of other programs, within the consent.

    Parameters
    ----------
    source
        SESSION/ or APPEARANCE/ folder.
    to
        Format, see `skinrig export --help`.
    out
        New folder.
    use
        Purpose of the copy, which the subjects' consent must include; required where anybody was
        measured.
    **settings
        Fields of `skinrig.exporting.options.ExportSettings`.

    Raises
    ------
    skinrig.exporting.options.ExportError
        If the format is unknown or does not fit the source.
    capture.session.ConsentError
        If a subject has not agreed to the use.
    """
    from skinrig.exporting.export import export as write_export
    from skinrig.exporting.options import ExportSettings

    done = write_export(to_path(source), out, to, ExportSettings(**settings), use=use)
    return ExportedFolder(done.path, done)


def view(
    appearances: FolderLike | Sequence[FolderLike] = (),
    out: str | Path = "page.html",
    **options: Any,
) -> HtmlPage:
    """Write a self-contained interactive page of a face.

    Parameters
    ----------
    appearances
        Folders of one face; empty: a simulated head.
    out
        HTML file; an existing one is replaced.
    **options
        Arguments of `skinrig.viewer.faces.build_scene`: preset, seed, size, mesh and others.

    Raises
    ------
    ValueError
        If the maps cannot be displayed on a face.
    """
    from skinrig.viewer import faces, page

    paths = [to_path(one) for one in _listed(appearances)]
    page.write(faces.build_scene(paths, **options), Path(out))
    return HtmlPage(Path(out))


def _listed(given: FolderLike | Sequence[FolderLike]) -> Sequence[FolderLike]:
    """Return one folder or several as a sequence."""
    return [given] if isinstance(given, (str, Path, NotebookResult)) else given
