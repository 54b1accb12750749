"""Find the commands that repeat the computation of maps, calibrations and benchmarks.

Commands name folders without their parents: they run in the folder that holds the results.
"""

import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from capture.calibration.record import Calibration
from capture.session import Session, SessionError
from model.skin import SkinAppearance
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.recipes import recipe_for_session
from skinrig.appearances.contents import hash_file, is_fused
from skinrig.next_steps import shell_quote
from skinrig.reporting.folders import ReportInputs

CALIBRATION_PREFIX = "calibration "
"""Prefix of an appearance's inputs that are files of a calibration."""


def repeat_maps(name: str, appearance: SkinAppearance, found: ReportInputs) -> str:
    """Return the command that makes maps again; empty where their session is not found.

    Parameters
    ----------
    name
        Folder of the maps.
    appearance
        Its contents.
    found
        Sessions and calibrations near them.
    """
    if is_fused(appearance):
        parts = appearance.parameters.get("appearances", ())
        names = [shell_quote(Path(str(part)).name) for part in _listed(parts)]
        return f"skinrig fuse {' '.join(names)} --out {shell_quote(name)}" if names else ""
    place = next(
        (one for one in found.sessions if one.name == appearance.parameters.get("session")), None
    )
    if place is None:
        return ""
    wants: list[str] = []
    with suppress(SessionError, InputsError, OSError, ValueError):
        session = Session.open(place)
        recipe = recipe_for_session(session)
        made = {*appearance.maps, *appearance.files}
        wants = [one for one in recipe.maps if made & set(recipe.expand(session, [one]))]
    if not wants:
        return ""
    words = ["skinrig reconstruct", shell_quote(place.name), "--maps", ",".join(wants)]
    used = {d for key, d in appearance.inputs.items() if key.startswith(CALIBRATION_PREFIX)}
    stores = [one for one in found.calibrations if used & hash_files(one)]
    words += ["--calibration", shell_quote(stores[0].name)] if stores else []
    state = str(appearance.parameters.get("state", "neutral"))
    words += ["--state", shell_quote(state)] if state != "neutral" else []
    return " ".join([*words, "--out", shell_quote(name)])


def hash_files(calibration: Path) -> set[str]:
    """Return the digests of a calibration's documents."""
    return {hash_file(file) for file in calibration.glob("*.json")}


def repeat_calibration(folder: str, calibration: Calibration, sessions: Iterable[Path]) -> str:
    """Return the command that makes a calibration again; empty where a session is missing."""
    by_id = {}
    for session in sessions:
        with suppress(OSError, ValueError, KeyError):
            by_id[json.loads((session / "session.json").read_bytes())["id"]] = session.name
    if not calibration.inputs or not set(calibration.inputs) <= by_id.keys():
        return ""
    given = " ".join(shell_quote(by_id[one]) for one in calibration.inputs)
    return f"skinrig calibrate {calibration.kind} {given} --out {shell_quote(folder)}"


def _listed(parts: object) -> list[str]:
    return [str(part) for part in parts] if isinstance(parts, (list, tuple)) else []
