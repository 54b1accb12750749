"""`skinrig export`: write sessions and appearances in the formats of other programs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from skinrig.command_line.options import Json, Out, choice, command
from skinrig.console import Console, format_count, select_attributes
from skinrig.errors import UnusableError, require_choice
from skinrig.exporting.options import ExportSettings, SkinPosition
from skinrig.next_steps import shell_quote

OPEN_ZARR: Final = "in Python: xarray.open_zarr({store!r}, group={group!r}, consolidated=False)"
NEXT_STEP_BY_FORMAT: Final[Mapping[str, str]] = {
    "maps": "read maps.json: units, ranges and frames; maps.mtlx holds the color spaces",
    "ome-zarr": OPEN_ZARR,
    "mtlx": "load skin.mtlx on skin.obj; material.json lists the scene unit and assumptions",
    "gltf": "open skin.glb; in Blender, run skin_in_blender.py for subsurface scattering",
    "usd": "open skin.usdc, in Blender with skin_in_blender.py; usd.json lists assumptions",
    "spectral": "read spectral.json: which bands are measured and which are modeled",
    "metahuman": "read delta_maps.json: layout and encoding of the deltas",
    "mitsuba": "read README.txt: how to load the scene, and where it differs from the session",
    "stokes": "read stokes.json: axis, channels, and components not measured",
    "zarr": OPEN_ZARR,
    "lp": "skinrig import olat {path} --out {path}-session  (reads the folder back)",
}
"""Next step after an export, by format; {path} is its folder, {store} and {group} are in it."""


FORMATS: Final = (
    *("maps", "ome-zarr", "mtlx", "gltf", "usd", "spectral", "metahuman", "merl", "rgl"),
    *("mhl", "frames", "event-model", "lp", "stokes", "zarr", "mitsuba"),
)
"""Formats of appearances, then of sessions; the writers are imported with the chosen one."""


@dataclass(frozen=True, slots=True)
class DeliveryOptions:
    """Options of delivered files.

    Attributes
    ----------
    unit
        Scene unit: m (default), cm or mm (mtlx, usd).
    normal_y
        Sign of green in normal maps: gl (+Y) or dx (-Y, Unreal).
    udim
        UDIM suffix of textures: none, dot (.1001) or underscore (_1001).
    with_errors
        Also write standard uncertainties and masks.
    only
        Names to export, separated by commas: maps (maps), up to three expressions (metahuman) or
        strain steps (stokes); default: all, for metahuman the first three.
    mesh
        Mesh with the maps' texture coordinates and blend shapes, mm.
    target_face
        Target face: APPEARANCE/ folder of a dome session whose texture gets the colors
        (metahuman).
    landmarks
        CSV tables name,x,y: first of the flash image, then of the target face's texture
        (metahuman).
    """

    unit: Annotated[str | None, choice("m", "cm", "mm")] = None
    normal_y: Annotated[str, choice("gl", "dx")] = "gl"
    udim: Annotated[str, choice("none", "dot", "underscore")] = "none"
    with_errors: bool = False
    only: str | None = None
    mesh: Path | None = None
    target_face: Path | None = None
    landmarks: list[Path] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names to export; empty: all."""
        return () if self.only is None else tuple(name.strip() for name in self.only.split(","))

    def delivery(self, **more: Any) -> ExportSettings:
        """Return the options as settings of an export, with `more` of them."""
        same = select_attributes(self, "unit", "normal_y", "udim", "with_errors", "mesh")
        return ExportSettings(
            only=self.names,
            target_face=self.target_face,
            landmarks=tuple(self.landmarks or ()),
            **same,
            **more,
        )


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """Options of a position on the skin whose BRDF is exported.

    Attributes
    ----------
    at
        Also export the BRDF at the texture coordinates U,V, each 0 to 1 (merl, rgl); default: only
        basis BRDFs.
    radius
        Radius around U,V over which the BRDF is averaged, mm (merl, rgl).
    without_diffuse
        Export specular reflection only at U,V (merl, rgl).
    """

    at: str | None = None
    radius: float = 0.0
    without_diffuse: bool = False

    def position(self) -> SkinPosition | None:
        """Return the position; None without --at."""
        if self.at is None:
            return None
        return SkinPosition.parse(self.at, radius_mm=self.radius, diffuse=not self.without_diffuse)


@command
def export(
    source: Path,
    /,
    *,
    to: Annotated[str, choice(*FORMATS, metavar="FORMAT")],
    out: Out,
    use: str | None = None,
    how: DeliveryOptions,
    place: PlaceOptions,
    camera: str | None = None,
    calibration: Path | None = None,
    json: Json = False,
) -> None:
    """Export a session or an appearance to other programs, within the subject's consent.

    An ASC MHL manifest lists all files.

    Example: skinrig export appearance --to gltf --out delivery

    Parameters
    ----------
    source
        APPEARANCE/ or SESSION/ folder.
    to
        Format. Appearance: maps, ome-zarr, mtlx, gltf, usd, spectral, metahuman, merl, rgl.
        Session: mhl, frames, lp, stokes, event-model, zarr, mitsuba (simulated dome, flash,
        gradient).
    use
        Purpose of the copy, such as research, which the subjects' consent must include; required
        for measured data.
    camera
        Camera whose images are exported (lp); default: the frontal one.
    calibration
        CALIBRATION/ folder: lights and cameras (lp) or sensor (stokes).
    """
    from skinrig.exporting import export as exporting

    console = Console(json)
    _check_format(to, source, exporting.APPEARANCE_FORMATS, exporting.SESSION_FORMATS)
    more = {"camera": camera, "calibration": calibration, "progress": console.progress}
    delivery = how.delivery(place=place.position() if to in ("merl", "rgl") else None, **more)
    done = exporting.export(source, out, to, delivery, use=use)
    after = NEXT_STEP_BY_FORMAT.get(
        to, "pass the folder on; `ascmhl verify` checks that it is complete and unchanged"
    )
    group = next((one.parent for one in sorted(done.path.glob("*.zarr/*/zarr.json"))), done.path)
    after = after.format(path=shell_quote(out), store=str(group.parent), group=group.name)
    console.print_omissions(done.left_out)
    console.print_line(
        f"{done.path}: {format_count(done.files, 'file')}, listed in {done.manifest}"
    )
    console.print_line(f"next: {after}")
    document = select_attributes(done, "path", "files", "manifest") | {"to": to, "next": after}
    console.print_document("skinrig.export/1", document | select_attributes(done, "left_out"))


def _check_format(
    to: str, source: Path, of_maps: Iterable[str], of_sessions: Iterable[str]
) -> None:
    """Raise for an unknown format, or one that the source's kind of folder does not have."""
    require_choice("--to", to, (*of_maps, *of_sessions))
    for file, kind, fitting in (
        ("session.json", "a session", of_sessions),
        ("appearance.json", "maps", of_maps),
    ):
        if (source / file).is_file() and to not in fitting:
            raise UnusableError(
                f"--to: got {to!r}, but {source} holds {kind}; expected one of "
                f"{', '.join(fitting)}; choose one [SR-EXP-005]"
            )
