"""Appearances handed to other programs: the formats, the consent, and the sealed folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import date, datetime
from pathlib import Path
from typing import Final

from model import store
from model.skin import SkinAppearance
from skinrig import consent
from skinrig.exporting import brdfs
from skinrig.exporting.options import Delivery
from skinrig.exporting.sealing import Exported, ExportError, fresh, sealed

Write = Callable[[SkinAppearance, Path, Delivery], list[tuple[str, str]]]


def _maps() -> Write:
    from skinrig.exporting import maps

    return maps.write


def _materialx() -> Write:
    from skinrig.exporting import materialx

    return materialx.write


def _gltf() -> Write:
    from skinrig.exporting import gltf

    return gltf.write


def _usd() -> Write:
    from skinrig.exporting import usd

    return usd.write


def _spectral() -> Write:
    from skinrig.exporting import spectral

    return spectral.write


def _metahuman() -> Write:
    from skinrig.exporting import delta_maps

    return delta_maps.write


# each format imports its own libraries only
FORMATS: Final[Mapping[str, Callable[[], Write]]] = {
    "maps": _maps,
    "mtlx": _materialx,
    "gltf": _gltf,
    "usd": _usd,
    "spectral": _spectral,
    "metahuman": _metahuman,
}


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
        One of `FORMATS`.
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
        For an unknown format, or a folder that exists.
    model.store.StoreError
        For a folder that is none of maps, or damaged.
    ValueError
        Of the format, for maps that it cannot be made of.
    """
    if to not in FORMATS:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(FORMATS)}")
    target = fresh(out)
    appearance = allowed(appearance_path, use, today=today)
    order = delivery or Delivery()
    if order.onto is not None:
        allowed(order.onto, use, today=today)  # its maps are handed on, too
    write = FORMATS[to]()
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
    if to not in brdfs.SUFFIX:
        raise ExportError(f"to: got {to!r}, expected one of {', '.join(brdfs.SUFFIX)}")
    target = fresh(out)
    appearance = allowed(appearance_path, use, today=today)
    return sealed(target, lambda part: brdfs.write_brdfs(appearance, part, to=to, place=place), now)


def allowed(path: str | Path, use: str | None, *, today: date | None = None) -> SkinAppearance:
    """Read an appearance whose subjects agreed to a use; see :func:`export_appearance`."""
    appearance = store.read(path)
    consent.require(appearance, use, where=str(path), today=today)
    return appearance
