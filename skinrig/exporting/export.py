"""Export: formats, consent of the subjects and the sealed folder."""

from collections.abc import Mapping
from datetime import date, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from capture.session import Session, verify
from model import store
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.errors import UsageError, one_of
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import ExportResult, export_sealed

APPEARANCE_FORMATS: Final[Mapping[str, str]] = {
    "maps": "maps.write",
    "mtlx": "materials.materialx.write",
    "gltf": "materials.gltf.write",
    "usd": "materials.usd.write",
    "spectral": "sessions.spectral.write_spectra",
    "metahuman": "packs.delta_maps.write",
    "merl": "brdfs.write_merl",
    "rgl": "brdfs.write_rgl",
}
"""Format to the function of this package that writes it: each module imports its own libraries."""
SESSION_FORMATS: Final[Mapping[str, str]] = {
    "mhl": "sessions.copies.write_session",
    "frames": "sessions.copies.write_frames",
    "event-model": "sessions.copies.write_events",
    "lp": "sessions.light_lists.write",
    "stokes": "sessions.spectral.write_stokes",
}
"""The same of a session: all of it, the DNG files alone, or other descriptions of them."""
SURFACE_FORMATS: Final = ("mtlx", "gltf", "usd", "merl", "rgl")
"""Formats of a surface in space, which a dome's maps hold and a photograph's do not."""
_DOME_MAPS: Final = ("position", "normals", "normals_refined", "r_d")
"""Maps of which a dome's reconstruction holds one at least."""


def load_writer(to: str) -> Any:
    """Return the function that writes a format: of appearance or session, folder, `ExportSettings`.

    Examples
    --------
    >>> sorted({load_writer(to).__name__ for to in APPEARANCE_FORMATS})
    ['write', 'write_merl', 'write_rgl', 'write_spectra']
    """
    module, _, name = {**APPEARANCE_FORMATS, **SESSION_FORMATS}[to].rpartition(".")
    return getattr(import_module(f"skinrig.exporting.{module}"), name)


def export(
    source: str | Path,
    out: str | Path,
    to: str,
    delivery: ExportSettings | None = None,
    *,
    use: str | None = None,
    today: date | None = None,
    now: datetime | None = None,
) -> ExportResult:
    """Write an appearance or a session for another program, sealed by an ASC MHL manifest.

    The folder is there as a whole, or not at all.

    Parameters
    ----------
    source
        APPEARANCE/ or SESSION/ folder.
    out
        New folder.
    to
        One of `APPEARANCE_FORMATS`, or of `SESSION_FORMATS` for a session.
    delivery
        Scene unit, tiles, green of normals, errors, mesh; None: as `ExportSettings()`.
    use
        What the copy is for. Must lie within the consent of every measured subject, on a day
        before it ends; may be None where an appearance was simulated.
    today, now
        Day on which consent is judged, and time in the manifest; None: the present.

    Returns
    -------
    Exported
        With what the format asks for and the source does not hold as left out.

    Raises
    ------
    capture.session.ConsentError
        Where a subject has not agreed to the use, or not any more.
    ExportError
        For an unknown format, one of surfaces for maps of none, a damaged session, or a folder
        that exists.
    model.store.StoreError
        For a folder that is none of maps, or damaged.
    ValueError
        Of the format, for a source that it cannot be made of.
    """
    one_of("to", to, (*APPEARANCE_FORMATS, *SESSION_FORMATS), ExportError)
    if Path(out).exists():
        raise ExportError(f"{out}: exists; choose a new folder [SR-EXP-002]")
    order = delivery or ExportSettings()
    held: SkinAppearance | Session
    if to in SESSION_FORMATS:
        held = _session(source, use, today)
    else:
        held = _appearance(source, use, today)
        if to in SURFACE_FORMATS and not any(name in held.maps for name in _DOME_MAPS):
            others = ", ".join(name for name in APPEARANCE_FORMATS if name not in SURFACE_FORMATS)
            raise ExportError(
                f"to: got {to!r}, which is of a dome's maps (position, normals, r_d, lobes), but "
                f"{source} holds {', '.join(held.maps) or 'none'}; expected {others}; choose one "
                "[SR-EXP-004]"
            )
        if order.onto is not None:
            _appearance(order.onto, use, today)  # its maps are handed on, too
    write = load_writer(to)
    return export_sealed(Path(out), lambda part: write(held, part, order), now)


def _appearance(path: str | Path, use: str | None, today: date | None) -> SkinAppearance:
    """Read an appearance whose subjects agreed to a use."""
    appearance = store.read(path)
    consent.require_consent(appearance, use, folder=str(path), today=today)
    return appearance


def _session(path: str | Path, use: str | None, today: date | None) -> Session:
    """Open an undamaged session whose subject agreed to a use."""
    if use is None:
        raise UsageError("--use: got none; name the purpose of the copy [SR-EXP-001]")
    session = Session.open(path)
    session.require_consent(use, today=today)
    found = verify(path)
    if not found.ok:
        raise ExportError(
            f"{path}: is damaged, nothing was copied: {found.problems[0]}; restore it from a copy "
            "[SR-EXP-003]"
        )
    return session
