"""Suggest the next command, after a session and for the contents of a folder."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Final

from skinrig.workspace import Workspace, read_document, scan

CALIBRATION_BY_TARGET: Final[Mapping[str, Mapping[str, str]]] = {
    "flash": {
        "white": "white",
        "flat": "sensor",
        "dark": "sensor",
        "chart": "color",
        "malus": "polarization",
    },
    "dome": {"charuco": "geometry", "mirror": "lights", "white": "lights"},
    "gradient": {"ball": "lights", "flat": "sensor", "dark": "sensor"},
    "probe": {"phantom": "fiber"},
}
"""Calibration by rig and target."""
TARGETS_BY_CALIBRATION: Final[Mapping[tuple[str, str], tuple[str, ...]]] = {
    ("lights", "mirror"): ("mirror", "white"),
    ("lights", "white"): ("mirror", "white"),
    ("sensor", "dark"): ("flat", "dark"),
}
"""All targets of a calibration by its kind and one of them, where it needs several."""
DEFAULT_WANTS: Final[Mapping[str, str]] = {
    "flash": "melanin,hemoglobin",
    "dome": "normals,r_d",
    "gradient": "normals,height,histograms,kernels",
    "probe": "profiles,subsurface,translucency",
    "photographs": "melanin,hemoglobin",
}
"""Maps usually reconstructed from a session of skin, by rig."""
OPEN_COMMAND: Final = {"darwin": "open", "win32": "start"}.get(sys.platform, "xdg-open")
DEMO_FOLDER: Final = "demo"
PORTRAIT_FOLDER: Final = "portrait"
MAX_STEPS: Final = 4
"""Maximum number of suggested steps."""


@dataclass(frozen=True, slots=True)
class Step:
    """A command and its purpose."""

    command: str
    why: str


def shell_quote(path: str | Path) -> str:
    """Quote a path for a shell if it contains a space or another special character.

    Examples
    --------
    >>> shell_quote("session"), shell_quote("my session")
    ('session', "'my session'")
    """
    return shlex.quote(str(path))


def suggest_after_session(
    rig: str,
    session: str | Path,
    target: str | None,
    *,
    calibration: str | Path = "calibration",
    phantom: str | Path | None = None,
    source: str = "simulated",
) -> str:
    """Return the most likely next command after a session.

    Parameters
    ----------
    rig
        flash, dome, gradient or probe; another name counts as photographs.
    session
        SESSION/ folder.
    target
        Calibration target of the session; "sequence" for a time sequence, None for skin.
    calibration
        CALIBRATION/ folder for the command; one without a calibration of this rig is not named.
    phantom
        SESSION/ folder of a phantom, which calibrates a probe; None: there is none.
    source
        "measured" or "simulated": how a probe's phantom is captured.

    Examples
    --------
    >>> suggest_after_session("flash", "session-flash", None)
    'skinrig reconstruct session-flash --maps melanin,hemoglobin --out appearance'
    >>> suggest_after_session("probe", "session-phantom", "phantom")
    'skinrig calibrate fiber session-phantom --out calibration'
    >>> suggest_after_session("probe", "session", None, calibration="missing")
    'skinrig simulate probe --target phantom --out session-phantom'
    """
    place, store = shell_quote(session), shell_quote(calibration)
    if target == "sequence":
        return f"skinrig reconstruct {place} --maps perfusion_curves --out appearance"
    if not target:
        calibrated = _has_calibration(Path(calibration), rig)
        if rig == "probe" and not calibrated:  # its reconstruction requires calibrated fibers
            if phantom is not None:
                return suggest_after_session(rig, phantom, "phantom", calibration=calibration)
            return _suggest_target(rig, session, "phantom", source)
        needs = f" --calibration {store}" if calibrated else ""
        want = DEFAULT_WANTS.get(rig, DEFAULT_WANTS["photographs"])
        return f"skinrig reconstruct {place} --maps {want}{needs} --out appearance"
    kind = CALIBRATION_BY_TARGET.get(rig, {}).get(target)
    if kind is None:
        return f"skinrig verify {place}"
    found = _find_targets(rig, session) | {target: Path(session)}
    targets = TARGETS_BY_CALIBRATION.get((kind, target), (target,))
    placed = (rig, kind) != ("dome", "lights") or Path(calibration, "geometry.json").is_file()
    for other in (*targets, *(() if placed else ("charuco",))):
        if other not in found:
            return _suggest_target(rig, session, other, source)
    if not placed:  # light directions are estimated by calibrated cameras
        return f"skinrig calibrate geometry {shell_quote(found['charuco'])} --out {store}"
    given = " ".join(shell_quote(found[one]) for one in targets)
    return f"skinrig calibrate {kind} {given} --out {store}"


def suggest_after_geometry(session: str | Path, calibration: str | Path) -> str | None:
    """Return the next command for the lights of a dome whose cameras were calibrated.

    Parameters
    ----------
    session
        SESSION/ folder of the calibration board.
    calibration
        CALIBRATION/ folder for the command.

    Returns
    -------
    str or None
        None if no session of the mirror or of the white target of this dome is near.

    Examples
    --------
    >>> suggest_after_geometry("session-charuco", "calibration")
    """
    found = _find_targets("dome", session)
    for target in TARGETS_BY_CALIBRATION["lights", "mirror"]:
        if target in found:
            source = str(_read_session(session).get("source", "simulated"))
            return suggest_after_session(
                "dome", found[target], target, calibration=calibration, source=source
            )
    return None


def _read_session(session: str | Path) -> dict[str, Any]:
    return read_document(Path(session) / "session.json") or {}


def _find_targets(rig: str, session: str | Path) -> dict[str, Path]:
    """Return the sessions near a session, of the same rig, seed and source, by their target."""
    own = _read_session(session)
    return {
        _target(document): path
        for path, document in scan(Path(session).parent).sessions.items()
        if document.get("rig", {}).get("name") == rig
        and all(document.get(key) == own.get(key) for key in ("seed", "source"))
    }


def _suggest_target(rig: str, session: str | Path, target: str, source: str) -> str:
    """Return the command that makes the session of a target on the rig of another session."""
    made = "capture" if source == "measured" else "simulate"
    seed = _read_session(session).get("seed")
    option = f" --seed {seed}" if seed and made == "simulate" else ""
    first = out = Path(session).parent / f"session-{target}"
    numbers = count(2)
    while out.exists():
        out = Path(f"{first}-{next(numbers)}")
    return f"skinrig {made} {rig} --target {target}{option} --out {shell_quote(out)}"


def suggest(found: Workspace, folder: Path) -> tuple[Step, ...]:
    """Return the next steps for the contents of a folder, most useful first.

    Parameters
    ----------
    found
        Contents, by `workspace.scan`.
    folder
        Folder, as written in commands.
    """
    steps: list[Step] = []
    here = shell_quote(folder)
    if found.reports:
        page = shell_quote(found.reports[0])
        why = "the report in a browser: maps, errors, checks"
        steps.append(Step(f"{OPEN_COMMAND} {page}", why))
    elif found.appearances:
        steps.append(Step(f"skinrig report {here}", "one page on all results of this folder"))
    used = {d.get("parameters", {}).get("session") for d in found.appearances.values()}
    fresh = [
        (path, document)
        for path, document in found.sessions.items()
        if path.name not in used and not _target(document) and not _is_grayscale(document)
    ]
    if fresh:
        path, document = fresh[0]
        rig = document.get("rig", {}).get("name", "")
        stores = [folder for folder in found.calibrations if _has_calibration(folder, rig)]
        stores.sort(key=lambda folder: rig not in folder.name)
        phantoms = (p for p, d in found.sessions.items() if _target(d) == "phantom")
        command = suggest_after_session(
            rig,
            path,
            None,
            calibration=next(iter(stores), folder / "calibration"),
            phantom=next(phantoms, None),
            source=str(document.get("source", "simulated")),
        )
        if rig not in CALIBRATION_BY_TARGET:
            command += _state_option(document)
        maps = command.startswith("skinrig reconstruct")
        why = "maps with standard uncertainties" if maps else "the calibration that its maps need"
        steps.append(Step(command, why))
    viewable = {p: d for p, d in found.appearances.items() if _is_viewable(p, d)}
    if viewable:
        seen = shell_quote(_most_complete(viewable, ("facial_color.json", "mesh.obj")))
        steps.append(Step(f"skinrig view {seen}", "an interactive page of these maps, with lights"))
    permitted = {p: d for p, d in found.appearances.items() if _permits_research(d)}
    if permitted:
        given = _most_complete(permitted, ("mesh.obj",))
        measured = permitted[given].get("source") == "measured"
        use = " --use research" if measured else ""
        command = f"skinrig export {shell_quote(given)} --to maps{use} --out export"
        steps.append(Step(command, "files for other programs"))
    if found.photographs and not Path(PORTRAIT_FOLDER).exists():
        command = f"skinrig photo {shell_quote(found.photographs[0])} --out {PORTRAIT_FOLDER}"
        steps.append(Step(command, "maps of the face in the photograph, and a report"))
    if found.photographs and not found.sessions:
        command = f"skinrig import photos {here} --out session"
        steps.append(Step(command, "a session from the photographs"))
    if not steps:
        steps = [
            Step("skinrig demo", "all four rigs, simulated; two to five minutes"),
            Step("skinrig simulate flash --out session", "one simulated rig, with real drivers"),
            Step("skinrig photo FACE.jpg --out portrait", "maps of the face in your photograph"),
            Step("skinrig doctor", "a check of the installation, with fixes"),
        ]
    return tuple(steps[:MAX_STEPS])


def format_welcome(folder: Path, version: str) -> str:
    """Return the output of ``skinrig`` without arguments.

    Parameters
    ----------
    folder
        Current folder, as written in commands; its demo folder is used if it has no results.
    version
        Version of skinrig.
    """
    found = scan(folder)
    if not found.summary() and scan(folder / DEMO_FOLDER).summary():
        folder = folder / DEMO_FOLDER
        found = scan(folder)
    steps = suggest(found, folder)
    width = max(len(step.command) for step in steps)
    summary = found.summary()
    lines = [f"skinrig {version}: capture, calibrate and reconstruct skin appearance", ""]
    if summary:
        lines += [f"In {folder}: {summary}" if folder.name else f"Here: {summary}", ""]
    lines.append("Next:")
    lines += [f"  {step.command.ljust(width)}  {step.why}".rstrip() for step in steps]
    lines += ["", "All commands: skinrig --help; one of them: skinrig report --help"]
    return "\n".join(lines)


def _has_calibration(folder: Path, rig: str) -> bool:
    """Return whether a folder has a calibration of a rig, of a kind that its targets yield."""
    from capture.former_names import FORMER_KINDS

    kinds = set(CALIBRATION_BY_TARGET.get(rig, {}).values())
    files = (folder / f"{name}.json" for kind in kinds for name in (kind, FORMER_KINDS.get(kind)))
    documents = (read_document(file) or {} for file in files)
    return any(document.get("rig") == rig for document in documents)


def _target(session: Mapping[str, Any]) -> str:
    """Return the calibration target of a session; empty if its documents name none."""
    simulated = session.get("extra", {}).get("simulation", {}).get("target")
    if simulated:
        return str(simulated)
    steps = session.get("plan", {}).get("steps", ())
    kinds = {step.get("kind") for step in steps}
    rig = session.get("rig", {}).get("name", "")
    # the flash rig captures its white reference like a face, as a state named white
    states = {step.get("index", {}).get("state") for step in steps if step.get("kind") == "subject"}
    if rig == "flash" and states == {"white"}:
        return "white"
    targets = CALIBRATION_BY_TARGET.get(rig, {})
    return next((target for target in targets if target in kinds - {"dark"}), "")


def _state_option(session: Mapping[str, Any]) -> str:
    """Return the option --state for imported photographs; empty if they include neutral."""
    views = session.get("rig", {}).get("views", ())
    colored = {view.get("name") for view in views if view.get("cfa") != "MONO"}
    states = [
        str(step.get("index", {}).get("state", "neutral"))
        for step in session.get("plan", {}).get("steps", ())
        if step.get("kind") == "subject" and colored & set(step.get("cameras", ()))
    ]
    return "" if not states or "neutral" in states else f" --state {shell_quote(states[0])}"


def _is_viewable(path: Path, appearance: Mapping[str, Any]) -> bool:
    """Return whether `skinrig view` shows an appearance without further options."""
    parameters, files = appearance.get("parameters", {}), appearance.get("files", {})
    maps = appearance.get("maps", {})
    if "mesh.obj" in files and "r_d" in maps:
        return True
    if "brdf_basis.npz" in files and "reflectance_model" in parameters:
        return True
    if "fusion" not in parameters and parameters.get("parts"):
        return True
    if {"melanin", "hemoglobin"} <= maps.keys():  # landmarks map them to the head
        truth = str(parameters.get("truth") or "")
        return bool(truth) and (path.parent / truth / "appearance.json").is_file()
    if "translucency" in maps:
        return True
    of_image = "mesh.obj" not in files and "position" not in maps
    return of_image and any(name.split("_")[0] == "normals" for name in maps)


def _permits_research(appearance: Mapping[str, Any]) -> bool:
    """Return whether the subjects of an appearance have agreed to its export for research."""
    if appearance.get("source") != "measured":
        return True
    from capture.session import ConsentError
    from model.skin import SkinAppearance
    from skinrig.consent import require_consent

    try:
        parameters = appearance.get("parameters", {})
        require_consent(SkinAppearance({}, "measured", parameters), "research", folder="")
    except ConsentError:
        return False
    return True


def _is_grayscale(session: Mapping[str, Any]) -> bool:
    """Return whether a session has grayscale photographs only, which yield no skin maps."""
    rig = session.get("rig", {})
    filters = {view.get("cfa") for view in rig.get("views", ())}
    return rig.get("name") not in CALIBRATION_BY_TARGET and filters == {"MONO"}


def _most_complete(appearances: Mapping[Path, Mapping[str, Any]], files: Sequence[str]) -> Path:
    """Return the appearance with the first file of the list that any has, then the most maps."""

    def rank(path: Path) -> tuple[int, int]:
        document = appearances[path]
        there = [name in document.get("files", {}) for name in files]
        first = there.index(True) if any(there) else len(files)
        return -first, len(document.get("maps", {}))

    return max(appearances, key=rank)
