"""Export sessions and appearances: choice of format, consent check and sealed folder."""

from collections.abc import Mapping, Sequence
from datetime import date, datetime
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from capture.session import Session, verify
from model import store
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.appearances.dynamic import describe_parts
from skinrig.errors import UsageError, require_choice
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import ExportResult, export_sealed
from skinrig.resources.forecast import forecast_resources, measure_folder_mb, require_resources

APPEARANCE_FORMATS: Final[Mapping[str, str]] = {
    "maps": "maps.write",
    "ome-zarr": "ome_zarr.write",
    "mtlx": "materials.materialx.write",
    "gltf": "materials.gltf.write",
    "usd": "materials.usd.write",
    "spectral": "sessions.spectral.write_spectra",
    "metahuman": "packs.delta_maps.write",
    "merl": "brdfs.write_merl",
    "rgl": "brdfs.write_rgl",
}
"""Writer of each format of an appearance; imported on use, with its libraries."""
SESSION_FORMATS: Final[Mapping[str, str]] = {
    "mhl": "sessions.copies.write_session",
    "frames": "sessions.copies.write_frames",
    "event-model": "sessions.copies.write_events",
    "lp": "sessions.light_lists.write",
    "stokes": "sessions.spectral.write_stokes",
    "zarr": "sessions.zarr_store.write",
    "mitsuba": "mitsuba.scene.write",
}
"""Writer of each format of a session: all files, the DNG files alone, or other descriptions."""
SURFACE_FORMATS: Final = ("mtlx", "gltf", "usd", "merl", "rgl")
"""Formats of a surface in space, which require maps of a dome."""
_DOME_MAPS: Final = ("position", "normals", "normals_refined", "r_d")
"""Maps of which a dome's reconstruction has at least one."""


def load_writer(to: str) -> Any:
    """Return the writer of a format; it takes appearance or session, folder, `ExportSettings`.

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

    The folder is written atomically.

    Parameters
    ----------
    source
        APPEARANCE/ or SESSION/ folder.
    out
        New folder.
    to
        One of `APPEARANCE_FORMATS`, or of `SESSION_FORMATS` for a session.
    delivery
        Scene unit, tiles, green of normals, errors, mesh; None: `ExportSettings()`.
    use
        Purpose of the copy, which the unexpired consent of every measured subject must include;
        may be None for simulated appearances.
    today, now
        Day of the consent check, and time in the manifest; None: the present.

    Returns
    -------
    ExportResult
        Omissions are parts of the format that the source lacks.

    Raises
    ------
    capture.session.ConsentError
        If a subject has not agreed to the use, or the consent has expired.
    ExportError
        If the format is unknown or requires a surface that the maps lack, the session is damaged,
        or the folder exists.
    model.store.StoreError
        If the folder is not an appearance, or damaged.
    ValueError
        If the source lacks what the format requires.
    """
    require_choice("to", to, (*APPEARANCE_FORMATS, *SESSION_FORMATS), ExportError)
    if Path(out).exists():
        raise ExportError(f"{out}: exists; choose a new folder [SR-EXP-002]")
    kind = "session" if to in SESSION_FORMATS else "appearance"
    need = forecast_resources(f"export {kind}", {"source_mb": measure_folder_mb(source)})
    require_resources(f"export --to {to}", need, Path(out))
    order = delivery or ExportSettings()
    held: SkinAppearance | Session
    if to in SESSION_FORMATS:
        held = _session(source, use, today, order)
    else:
        held = _appearance(source, use, today)
        if to in SURFACE_FORMATS and not any(name in held.maps for name in _DOME_MAPS):
            others = ", ".join(_list_usable_formats(held))
            raise ExportError(
                f"--to: got {to!r}, which requires a dome's maps (position, normals, r_d, basis "
                f"BRDFs), but {source} has {_list_names(list(held.maps))}; choose {others} "
                "[SR-EXP-004]"
            )
        if order.target_face is not None:
            _appearance(order.target_face, use, today)  # its maps are exported, too
    write = load_writer(to)
    order.report(f"write {to}")
    return export_sealed(
        Path(out), lambda part: write(held, part, order), now, progress=order.progress
    )


MAX_LISTED_MAPS = 6
"""Maximum number of maps in a message."""


def _list_names(names: Sequence[str]) -> str:
    """List the first names, and count the rest.

    Examples
    --------
    >>> _list_names(["melanin"]), _list_names([f"m{n}" for n in range(40)])
    ('melanin', 'm0, m1, m2, m3, m4, m5 and 34 more')
    """
    more = len(names) - MAX_LISTED_MAPS
    listed = ", ".join(names[:MAX_LISTED_MAPS]) or "none"
    return f"{listed} and {more} more" if more > 0 else listed


def _list_usable_formats(appearance: SkinAppearance) -> list[str]:
    """Return the formats that do not require a surface and can hold what the appearance has."""
    spectral = {"melanin", "hemoglobin"} <= set(appearance.maps)
    fitted = bool(describe_parts(appearance))
    return ["maps"] + ["spectral"] * spectral + ["metahuman"] * fitted


def _appearance(path: str | Path, use: str | None, today: date | None) -> SkinAppearance:
    """Read an appearance after a check of its subjects' consent to a use."""
    appearance = store.read(path)
    consent.require_consent(appearance, use, folder=str(path), today=today)
    return appearance


def _session(
    path: str | Path, use: str | None, today: date | None, order: ExportSettings
) -> Session:
    """Open a session after a check of its digests and of its subject's consent to a use."""
    if use is None:
        raise UsageError("--use: got none; name the purpose of the copy [SR-EXP-001]")
    session = Session.open(path)
    session.require_consent(use, today=today)
    found = verify(path, progress=order.progress)
    if not found.ok:
        raise ExportError(
            f"{path}: is damaged, nothing was copied: {found.problems[0]}; restore it from a copy "
            "[SR-EXP-003]"
        )
    return session
