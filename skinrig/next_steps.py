"""What to do next: after a session was captured, and with what lies in a folder."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skinrig.workspace import Workspace, scan

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
    "probe": {"phantom": "fibre"},
}
"""The calibration that each target of a rig makes."""
DEFAULT_WANTS: Final[Mapping[str, str]] = {
    "flash": "melanin,hemoglobin",
    "dome": "normals,r_d",
    "gradient": "normals,height,histograms,kernels",
    "probe": "profiles,subsurface,translucency",
    "photographs": "melanin,hemoglobin",
}
"""What is usually wanted of a session of skin."""
UNCALIBRATED_RIGS: Final = ("flash", "photographs")
"""Rigs whose maps need no calibration; without one something is assumed, and said."""
OPEN_COMMAND: Final = {"darwin": "open", "win32": "start"}.get(sys.platform, "xdg-open")
DEMO_FOLDER: Final = "demo"
MAX_STEPS: Final = 4
"""Next steps that are named at once."""


@dataclass(frozen=True, slots=True)
class Step:
    """A command and what it is for."""

    command: str
    why: str


def shell_quote(path: str | Path) -> str:
    """Return a path as a shell takes it: in quotes where it holds a space or the like.

    Examples
    --------
    >>> shell_quote("session"), shell_quote("my session")
    ('session', "'my session'")
    """
    return shlex.quote(str(path))


def suggest_after_session(
    rig: str, session: str | Path, target: str | None, *, calibration: str | Path = "calibration"
) -> str:
    """Return the command that a session is for, most likely.

    Parameters
    ----------
    rig
        flash, dome, gradient or probe; another name is taken for photographs.
    session
        Its folder.
    target
        The calibration target that it shows, "sequence" for one in time, None for skin.
    calibration
        Folder of calibrations that the command names.

    Examples
    --------
    >>> suggest_after_session("flash", "session-flash", None)
    'skinrig reconstruct session-flash --want melanin,hemoglobin --out appearance'
    >>> suggest_after_session("probe", "session-phantom", "phantom")
    'skinrig calibrate fibre session-phantom --out calibration'
    """
    place, store = shell_quote(session), shell_quote(calibration)
    if target == "sequence":
        return f"skinrig reconstruct {place} --want perfusion_curves --out appearance"
    if not target:
        calibrated = rig in DEFAULT_WANTS and rig not in UNCALIBRATED_RIGS
        needs = f" --calibration {store}" if calibrated else ""
        want = DEFAULT_WANTS.get(rig, DEFAULT_WANTS["photographs"])
        return f"skinrig reconstruct {place} --want {want}{needs} --out appearance"
    kind = CALIBRATION_BY_TARGET.get(rig, {}).get(target)
    if kind is None:
        return f"skinrig verify {place}"
    given = place
    if rig == "dome" and kind == "lights":  # one calibration of both
        given = f"{place} SESSION-WHITE" if target == "mirror" else f"SESSION-MIRROR {place}"
    return f"skinrig calibrate {kind} {given} --out {store}"


def suggest(found: Workspace, folder: Path) -> tuple[Step, ...]:
    """Return what to do next with what lies in a folder, the nearest first.

    Parameters
    ----------
    found
        By `workspace.scan`.
    folder
        As it is to be named in commands.
    """
    steps: list[Step] = []
    here = shell_quote(folder)
    if found.reports:
        page = shell_quote(found.reports[0])
        why = "the report in a browser: maps, errors, checks"
        steps.append(Step(f"{OPEN_COMMAND} {page}", why))
    elif found.appearances:
        steps.append(Step(f"skinrig report {here}", "one page of all that lies here"))
    used = {d.get("parameters", {}).get("session") for d in found.appearances.values()}
    fresh = [
        (path, document)
        for path, document in found.sessions.items()
        if path.name not in used and not _target(document) and not _is_grayscale(document)
    ]
    if fresh:
        path, document = fresh[0]
        rig = document.get("rig", {}).get("name", "")
        where = next((c for c in found.calibrations if rig in c.name), None)
        where = where or next(iter(found.calibrations), Path("calibration"))
        command = suggest_after_session(rig, path, None, calibration=where)
        if rig not in CALIBRATION_BY_TARGET:
            command += _state_option(document)
        steps.append(Step(command, "maps with standard errors"))
    if found.appearances:
        seen = shell_quote(_most_complete(found.appearances, ("facial_color.json", "mesh.obj")))
        steps.append(Step(f"skinrig view {seen}", "a page that shows the skin moving, under light"))
        given = _most_complete(found.appearances, ("mesh.obj",))
        measured = found.appearances[given].get("source") == "measured"
        use = " --use research" if measured else ""
        command = f"skinrig export {shell_quote(given)} --to maps{use} --out export"
        steps.append(Step(command, "other programs"))
    if found.photographs and not found.sessions:
        command = f"skinrig import photos {here} --out session"
        steps.append(Step(command, "photographs become a session"))
    if not steps:
        steps = [
            Step("skinrig demo", "all four rigs, simulated, in under three minutes"),
            Step("skinrig simulate flash --out session", "one virtual rig, by the real drivers"),
            Step("skinrig import photos DIR --out session", "photographs of your own"),
            Step("skinrig doctor", "what is installed, and how to mend what is not"),
        ]
    return tuple(steps[:MAX_STEPS])


def welcome(folder: Path, version: str) -> str:
    """Return what a plain ``skinrig`` prints.

    Parameters
    ----------
    folder
        Where it was typed, as commands are to name it; else the demo's folder in it.
    version
        Of skinrig.
    """
    found = scan(folder)
    if not found.summary() and scan(folder / DEMO_FOLDER).summary():
        folder = folder / DEMO_FOLDER
        found = scan(folder)
    steps = suggest(found, folder)
    width = max(len(step.command) for step in steps)
    summary = found.summary()
    lines = [f"skinrig {version}: skin appearance, captured, calibrated, reconstructed", ""]
    if summary:
        lines += [f"In {folder}: {summary}" if folder.name else f"Here: {summary}", ""]
    lines.append("Next:")
    lines += [f"  {step.command.ljust(width)}  {step.why}".rstrip() for step in steps]
    lines += ["", "All commands: skinrig --help; one of them: skinrig report --help"]
    return "\n".join(lines)


def _target(session: Mapping[str, Any]) -> str:
    """Return the calibration target of a session, as far as its documents say one."""
    simulated = session.get("extra", {}).get("simulation", {}).get("target")
    if simulated:
        return str(simulated)
    steps = session.get("plan", {}).get("steps", ())
    kinds = {step.get("kind") for step in steps}
    rig = session.get("rig", {}).get("name", "")
    # the flash rig takes its white tile as it takes a face, as a state of that name
    states = {step.get("index", {}).get("state") for step in steps if step.get("kind") == "subject"}
    if rig == "flash" and states == {"white"}:
        return "white"
    targets = CALIBRATION_BY_TARGET.get(rig, {})
    return next((target for target in targets if target in kinds - {"dark"}), "")


def _state_option(session: Mapping[str, Any]) -> str:
    """Return the option that chooses a photograph; empty where the usual state is there."""
    views = session.get("rig", {}).get("views", ())
    colored = {view.get("name") for view in views if view.get("cfa") != "MONO"}
    states = [
        str(step.get("index", {}).get("state", "neutral"))
        for step in session.get("plan", {}).get("steps", ())
        if step.get("kind") == "subject" and colored & set(step.get("cameras", ()))
    ]
    return "" if not states or "neutral" in states else f" --state {shell_quote(states[0])}"


def _is_grayscale(session: Mapping[str, Any]) -> bool:
    """Tell imported photographs without color, of which no map of skin can be made."""
    rig = session.get("rig", {})
    filters = {view.get("cfa") for view in rig.get("views", ())}
    return rig.get("name") not in CALIBRATION_BY_TARGET and filters == {"MONO"}


def _most_complete(appearances: Mapping[Path, Mapping[str, Any]], files: Sequence[str]) -> Path:
    """Return the appearance that holds the first of some files, else the next, most maps first."""

    def rank(path: Path) -> tuple[int, int]:
        document = appearances[path]
        there = [name in document.get("files", {}) for name in files]
        first = there.index(True) if any(there) else len(files)
        return -first, len(document.get("maps", {}))

    return max(appearances, key=rank)
