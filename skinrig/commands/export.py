"""The command that hands captures and appearances to other programs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from skinrig.commands.options import Json, Out, command
from skinrig.console import Console, format_count, select_attributes
from skinrig.errors import UnusableError, one_of
from skinrig.exporting.options import ExportSettings, SkinPosition

NEXT_STEP_BY_FORMAT: Final[Mapping[str, str]] = {
    "maps": "read maps.json: units, ranges and frames; maps.mtlx holds the color spaces",
    "mtlx": "load skin.mtlx on skin.obj; material.json has the scene unit and what was assumed",
    "gltf": "open skin.glb; in Blender, run skin_in_blender.py for the light below the surface",
    "usd": "open skin.usdc, in Blender by skin_in_blender.py; usd.json has what was assumed",
    "spectral": "read spectral.json: what is measured and what is modelled",
    "metahuman": "read delta_maps.json: layout and coding of the deltas",
    "stokes": "read stokes.json: axis, channels, and what was not measured",
    "lp": "skinrig import lp DIR --out SESSION reads the folder back",
}
"""What to do with each format."""


@dataclass(frozen=True, slots=True)
class DeliveryOptions:
    """How an appearance is delivered.

    Attributes
    ----------
    unit
        Scene unit: m (default), cm or mm (mtlx, usd).
    normal_y
        Green of normal maps: gl is +Y up, dx is -Y (Unreal).
    udim
        Names of textures: none, dot (.1001) or underscore (_1001).
    with_errors
        Standard errors and masks beside the values.
    only
        Names of maps (maps), of up to three states (metahuman), of states (stokes).
    mesh
        Mesh with the maps' texture coordinates and blend shapes, in mm.
    onto
        Dome's maps whose texture gets the colors (metahuman).
    landmarks
        Tables name,x,y of the flash picture, then of that texture.
    """

    unit: str | None = None
    normal_y: str = "gl"
    udim: str = "none"
    with_errors: bool = False
    only: str | None = None
    mesh: Path | None = None
    onto: Path | None = None
    landmarks: list[Path] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is written; none: all that there are."""
        return () if self.only is None else tuple(name.strip() for name in self.only.split(","))

    def delivery(self, **more: Any) -> ExportSettings:
        """Return the same as an export takes it, with what other options say."""
        same = select_attributes(self, "unit", "normal_y", "udim", "with_errors", "mesh", "onto")
        return ExportSettings(
            only=self.names, landmarks=tuple(self.landmarks or ()), **same, **more
        )


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """The place on the skin whose BRDF is exported.

    Attributes
    ----------
    at
        Place on the skin, U,V in 0 to 1: its BRDF too (merl, rgl).
    radius
        Average around the place, mm.
    without_diffuse
        The place's surface alone.
    """

    at: str | None = None
    radius: float = 0.0
    without_diffuse: bool = False

    def named(self) -> SkinPosition | None:
        """Return the place; None without one."""
        if self.at is None:
            return None
        return SkinPosition.parse(self.at, radius_mm=self.radius, diffuse=not self.without_diffuse)


@command
def export(
    source: Path,
    /,
    *,
    to: str,
    out: Out,
    use: str | None = None,
    how: DeliveryOptions,
    place: PlaceOptions,
    camera: str | None = None,
    calibration: Path | None = None,
    json: Json = False,
) -> None:
    """Hand a session or an appearance on to other programs, within the subject's consent.

    All files are listed in an ASC MHL manifest.

    Example: skinrig export appearance --to gltf --out delivery

    Parameters
    ----------
    source
        APPEARANCE/ or SESSION/ folder.
    to
        Of an appearance: maps, mtlx, gltf, usd, spectral, metahuman, merl, rgl. Of a session: mhl,
        frames, lp, stokes, event-model.
    use
        What the copy is for; the subjects' consent must cover it.
    camera
        Whose pictures (lp); default: the one in front.
    calibration
        CALIBRATION/ folder of lights and cameras (lp), of the sensor (stokes).
    """
    from skinrig.exporting import export as exporting

    console = Console(json)
    _check_format(to, source, exporting.APPEARANCE_FORMATS, exporting.SESSION_FORMATS)
    of_session = {"camera": camera, "calibration": calibration}
    delivery = how.delivery(place=place.named() if to in ("merl", "rgl") else None, **of_session)
    done = exporting.export(source, out, to, delivery, use=use)
    after = NEXT_STEP_BY_FORMAT.get(
        to, "hand the folder on; `ascmhl verify` tells whether it is still whole"
    )
    console.left_out(done.left_out)
    console.say(f"{done.path}: {format_count(done.files, 'file')}, listed in {done.manifest}")
    console.say(f"next: {after}")
    document = select_attributes(done, "path", "files", "manifest") | {"to": to, "next": after}
    console.document("skinrig.export/1", document | select_attributes(done, "left_out"))


def _check_format(
    to: str, source: Path, of_maps: Iterable[str], of_sessions: Iterable[str]
) -> None:
    """Raise for a format that there is not, or that is not of what the source holds."""
    one_of("--to", to, (*of_maps, *of_sessions))
    for file, kind, fitting in (
        ("session.json", "a session", of_sessions),
        ("appearance.json", "maps", of_maps),
    ):
        if (source / file).is_file() and to not in fitting:
            raise UnusableError(
                f"--to: got {to!r}, but {source} holds {kind}; expected one of {', '.join(fitting)}"
            )
