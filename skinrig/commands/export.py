"""The command that hands captures and appearances to other programs."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from skinrig.commands.options import Json, Out, argument, expand, option
from skinrig.console import Console, counted, picked
from skinrig.errors import UnusableError, one_of
from skinrig.exporting.options import Delivery, Place

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
    """How an appearance is delivered."""

    unit: Annotated[str | None, option("Scene unit: m (default), cm or mm (mtlx, usd).")] = None
    normal_y: Annotated[str, option("Green of normal maps: gl is +Y up, dx is -Y (Unreal).")] = "gl"
    udim: Annotated[str, option("Names of textures: none, dot (.1001) or underscore (_1001).")] = (
        "none"
    )
    with_errors: Annotated[
        bool, option("Standard errors and masks beside the values.", "--with-errors")
    ] = False
    only: Annotated[
        str | None,
        option("Names of maps (maps), of up to three states (metahuman), of states (stokes)."),
    ] = None
    mesh: Annotated[
        Path | None, option("Mesh with the maps' texture coordinates and blend shapes, in mm.")
    ] = None
    onto: Annotated[
        Path | None, option("Dome's maps whose texture gets the colors (metahuman).")
    ] = None
    landmarks: Annotated[
        list[Path] | None, option("Tables name,x,y of the flash picture, then of that texture.")
    ] = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is written; none: all that there are."""
        return () if self.only is None else tuple(name.strip() for name in self.only.split(","))

    def delivery(self, **more: Any) -> Delivery:
        """Return the same as an export takes it, with what other options say."""
        same = picked(self, "unit", "normal_y", "udim", "with_errors", "mesh", "onto")
        return Delivery(only=self.names, landmarks=tuple(self.landmarks or ()), **same, **more)


@dataclass(frozen=True, slots=True)
class PlaceOptions:
    """The place on the skin whose BRDF is exported."""

    at: Annotated[
        str | None, option("Place on the skin, U,V in 0 to 1: its BRDF too (merl, rgl).")
    ] = None
    radius: Annotated[float, option("Average around the place, mm.")] = 0.0
    without_diffuse: Annotated[bool, option("The place's surface alone.", "--without-diffuse")] = (
        False
    )

    def named(self) -> Place | None:
        """Return the place; None without one."""
        if self.at is None:
            return None
        return Place.named(self.at, radius_mm=self.radius, diffuse=not self.without_diffuse)


@expand
def export(
    source: Annotated[Path, argument("APPEARANCE/ or SESSION/ folder.")],
    to: Annotated[
        str,
        option(
            "Of an appearance: maps, mtlx, gltf, usd, spectral, metahuman, merl, rgl. "
            "Of a session: mhl, frames, lp, stokes, event-model."
        ),
    ],
    out: Out,
    *,
    use: Annotated[
        str | None, option("What the copy is for; the subjects' consent must cover it.")
    ] = None,
    how: DeliveryOptions,
    place: PlaceOptions,
    camera: Annotated[str | None, option("Whose pictures (lp); default: the one in front.")] = None,
    calibration: Annotated[
        Path | None,
        option("CALIBRATION/ folder of lights and cameras (lp), of the sensor (stokes)."),
    ] = None,
    json: Json = False,
) -> None:
    """Hand a session or an appearance on to other programs, within the subject's consent.

    All files are listed in an ASC MHL manifest.

    Example: skinrig export appearance --to gltf --out delivery
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
    console.say(f"{done.path}: {counted(done.files, 'file')}, listed in {done.manifest}")
    console.say(f"next: {after}")
    document = picked(done, "path", "files", "manifest") | {"to": to, "next": after}
    console.document("skinrig.export/1", document | picked(done, "left_out"))


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
