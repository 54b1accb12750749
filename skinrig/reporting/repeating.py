"""Find the command that repeats a reconstruction, with the paths of its folders as given."""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from capture.session import Session, SessionError
from model.skin import SkinAppearance
from reconstruction.pipeline.inputs import InputsError
from reconstruction.pipeline.recipes import recipe_for_session
from skinrig.appearances.contents import hash_file
from skinrig.next_steps import shell_quote
from skinrig.reporting.folders import ReportInputs
from skinrig.workspace import read_document

CALIBRATION_PREFIX = "calibration "
"""Prefix of an appearance's inputs that are files of a calibration."""


def repeat_maps(name: str, appearance: SkinAppearance, found: ReportInputs) -> str:
    """Return the command that makes maps again; empty if their folders or options are unknown.

    Only `skinrig reconstruct` is repeated. Options whose files an appearance does not name, a scan,
    a basis or landmarks, have no command.

    Parameters
    ----------
    name
        Name of the maps in `found`.
    appearance
        Its contents.
    found
        Sessions and calibrations near them.
    """
    used = list_used_calibrations(appearance)
    session = find_session(appearance, found)
    stores = list(_list_stores(used, session, found)) if session is not None else []
    others = appearance.inputs.keys() - {CALIBRATION_PREFIX + kind for kind in used} - {"session"}
    derived = others or "edit" in appearance.parameters
    if session is None or derived or (used and len(stores) != 1):
        return ""
    wants: list[str] = []
    with suppress(SessionError, InputsError, OSError, ValueError):
        recipe = recipe_for_session(session)
        made = {*appearance.maps, *appearance.files}
        wants = [one for one in recipe.maps if made & set(recipe.expand(session, [one]))]
    if not wants:
        return ""
    words = ["skinrig reconstruct", shell_quote(session.path), "--maps", ",".join(wants)]
    words += ["--calibration", shell_quote(stores[0])] if used else []
    words += _list_options(appearance)
    return " ".join([*words, "--out", shell_quote(found.appearances[name])])


def _list_options(appearance: SkinAppearance) -> Iterator[str]:
    """Yield the words of the options that an appearance records."""
    state = str(appearance.parameters.get("state", "neutral"))
    if state != "neutral":
        yield from ("--state", shell_quote(state))
    held = appearance.parameters.get("held_out")
    names = {k: v for k, v in held.items() if v} if isinstance(held, dict) else {}
    if names:
        parts = [f"{field}={','.join(map(str, values))}" for field, values in names.items()]
        yield from ("--hold-out", shell_quote(",".join(parts)))
    rank = sum(one.startswith("basis_weight_") for one in appearance.maps)
    if rank:
        yield from ("--rank", str(rank))


def list_used_calibrations(appearance: SkinAppearance) -> dict[str, str]:
    """Return the digest of each calibration that maps were made with, by kind."""
    return {
        key.removeprefix(CALIBRATION_PREFIX): digest
        for key, digest in appearance.inputs.items()
        if key.startswith(CALIBRATION_PREFIX)
    }


def find_session(appearance: SkinAppearance, found: ReportInputs) -> Session | None:
    """Return the session that maps were reconstructed from; None if it is not found."""
    for place in found.sessions:
        if place.name == appearance.parameters.get("session"):
            with suppress(SessionError, OSError, ValueError):
                session = Session.open(place)
                if session.content_hash == appearance.inputs.get("session"):
                    return session
    return None


def hash_calibrations(kind: str, found: ReportInputs, rig: str | None) -> dict[Path, str]:
    """Return the digest of the calibration of a kind, by the folder that has it.

    Parameters
    ----------
    kind
        Kind of calibration.
    found
        Its calibrations are searched.
    rig
        Name of the rig; None: any.
    """
    files = {folder: folder / f"{kind}.json" for folder in found.calibrations}
    return {
        folder: hash_file(file)
        for folder, file in files.items()
        if (document := read_document(file)) is not None
        and (rig is None or document.get("rig") == rig)
    }


def _list_stores(used: Mapping[str, str], session: Session, found: ReportInputs) -> Iterator[Path]:
    """Yield the folder with the used files; without it, all with their kinds for this rig."""
    kinds = {kind: hash_calibrations(kind, found, session.rig.name) for kind in used}
    complete = [f for f in found.calibrations if all(f in of_kind for of_kind in kinds.values())]
    same = [f for f in complete if all(kinds[kind][f] == used[kind] for kind in used)]
    yield from same[:1] or complete
