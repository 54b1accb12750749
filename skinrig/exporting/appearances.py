"""Appearances handed to other programs: the formats, the consent, and the sealed folder."""

from collections.abc import Callable, Mapping
from datetime import date, datetime
from importlib import import_module
from pathlib import Path
from typing import Final

from model import store
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.exporting import brdfs
from skinrig.exporting.options import Delivery
from skinrig.exporting.sealing import Exported, ExportError, fresh, sealed

Write = Callable[[SkinAppearance, Path, Delivery], list[tuple[str, str]]]

APPEARANCE_FORMATS: Final[Mapping[str, str]] = {
    "maps": "maps",
    "mtlx": "materials.materialx",
    "gltf": "materials.gltf",
    "usd": "materials.usd",
    "spectral": "sessions.spectral",
    "metahuman": "packs.delta_maps",
}
"""Format to the module of this package whose ``write`` makes it: each imports its own libraries."""


SURFACE_FORMATS: Final = ("mtlx", "gltf", "usd")
"""Formats of a surface in space, which a dome's maps hold and a photograph's do not."""
_DOME_MAPS: Final = ("position", "normals", "normals_refined", "r_d")
"""Maps of which a dome's reconstruction holds one at least."""


def writer(to: str) -> Write:
    """Return what writes a format of `APPEARANCE_FORMATS`.

    Examples
    --------
    >>> {writer(to).__name__ for to in APPEARANCE_FORMATS}
    {'write'}
    """
    write: Write = import_module(f"skinrig.exporting.{APPEARANCE_FORMATS[to]}").write
    return write


def export_appearance(
    appearance_path: str | Path,
    out: str | Path,
    *,
    to: str,
    delivery: Delivery | None = None,
    use: str | None = None,
    today: date | None = None,
    now: datetime | None = None,
) -> Exported:
    """Write an appearance for another program, sealed by an ASC MHL manifest; all, or nothing.

    Parameters
    ----------
    appearance_path
        APPEARANCE/ folder.
    out
        New folder.
    to
        One of `APPEARANCE_FORMATS`.
    delivery
        Scene unit, tiles, green of normals, errors, mesh; None: as `Delivery()`.
    use
        What the copy is for. Must lie within the consent of every measured subject; may be None
        where all was simulated.
    today, now
        Day on which consent is judged, and time in the manifest; None: the present.

    Returns
    -------
    Exported

    Raises
    ------
    capture.session.ConsentError
        Where a subject has not agreed to the use, or not any more.
    ExportError
        For an unknown format, one of surfaces for maps of none, or a folder that exists.
    model.store.StoreError
        For a folder that is none of maps, or damaged.
    ValueError
        Of the format, for maps that it cannot be made of.
    """
    if to not in APPEARANCE_FORMATS:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(APPEARANCE_FORMATS)}")
    target = fresh(out)
    appearance = allowed(appearance_path, use, today=today)
    if to in SURFACE_FORMATS and not any(name in appearance.maps for name in _DOME_MAPS):
        others = ", ".join(name for name in APPEARANCE_FORMATS if name not in SURFACE_FORMATS)
        raise ExportError(
            f"to: got {to!r}, which is of a dome's maps (position, normals, r_d, lobes), but "
            f"{appearance_path} holds {', '.join(appearance.maps) or 'none'}; expected {others}"
        )
    order = delivery or Delivery()
    if order.onto is not None:
        allowed(order.onto, use, today=today)  # its maps are handed on, too
    write = writer(to)
    return sealed(target, lambda part: write(appearance, part, order), now)


def export_brdfs(
    appearance_path: str | Path,
    out: str | Path,
    *,
    to: str,
    place: brdfs.Place | None = None,
    use: str | None = None,
    today: date | None = None,
    now: datetime | None = None,
) -> Exported:
    """Write an appearance's lobes, and the BRDF of a place, for other programs; all, or nothing.

    Parameters
    ----------
    appearance_path
        APPEARANCE/ folder of a dome, or a fitted MODEL.
    out
        New folder.
    to
        "merl" or "rgl", see :func:`skinrig.exporting.brdfs.write_brdfs`.
    place
        Where on the skin; None: lobes alone.
    use, today, now
        See :func:`export_appearance`.

    Raises
    ------
    capture.session.ConsentError
        Where a subject has not agreed to the use, or not any more.
    ExportError
        For an unknown format, or a folder that exists.
    """
    if to not in brdfs.BRDF_SUFFIXES:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(brdfs.BRDF_SUFFIXES)}")
    target = fresh(out)
    appearance = allowed(appearance_path, use, today=today)
    return sealed(target, lambda part: brdfs.write_brdfs(appearance, part, to=to, place=place), now)


def allowed(path: str | Path, use: str | None, *, today: date | None = None) -> SkinAppearance:
    """Read an appearance whose subjects agreed to a use; see :func:`export_appearance`."""
    appearance = store.read(path)
    consent.require(appearance, use, where=str(path), today=today)
    return appearance
