"""The command that hands captures and appearances to other programs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

import typer

from skinrig.commands.options import Json, Out
from skinrig.console import Console, counted
from skinrig.errors import UnusableError
from skinrig.exporting.options import Delivery

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


def export(
    source: Annotated[Path, typer.Argument(help="APPEARANCE/ or SESSION/ folder.")],
    to: Annotated[
        str,
        typer.Option(
            help="Of an appearance: maps, mtlx, gltf, usd, spectral, metahuman, merl, rgl. "
            "Of a session: mhl, frames, lp, stokes, event-model."
        ),
    ],
    out: Out,
    use: Annotated[
        str | None, typer.Option(help="What the copy is for; the subjects' consent must cover it.")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Scene unit: m (default), cm or mm (mtlx, usd).")
    ] = None,
    normal_y: Annotated[
        str, typer.Option(help="Green of normal maps: gl is +Y up, dx is -Y (Unreal).")
    ] = "gl",
    udim: Annotated[
        str, typer.Option(help="Names of textures: none, dot (.1001) or underscore (_1001).")
    ] = "none",
    with_errors: Annotated[
        bool, typer.Option("--with-errors", help="Standard errors and masks beside the values.")
    ] = False,
    only: Annotated[
        str | None,
        typer.Option(
            help="Names of maps (maps), of up to three states (metahuman), of states (stokes)."
        ),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(help="Mesh with the maps' texture coordinates and blend shapes, in mm."),
    ] = None,
    onto: Annotated[
        Path | None, typer.Option(help="Dome's maps whose texture gets the colors (metahuman).")
    ] = None,
    landmarks: Annotated[
        list[Path] | None,
        typer.Option(help="Tables name,x,y of the flash picture, then of that texture."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(help="Place on the skin, U,V in 0 to 1: its BRDF too (merl, rgl).")
    ] = None,
    radius: Annotated[float, typer.Option(help="Average around the place, mm.")] = 0.0,
    without_diffuse: Annotated[
        bool, typer.Option("--without-diffuse", help="The place's surface alone.")
    ] = False,
    camera: Annotated[
        str | None, typer.Option(help="Whose pictures (lp); default: the one in front.")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="CALIBRATION/ folder of lights and cameras (lp), of the sensor (stokes)."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Hand a session or an appearance on to other programs, within the subject's consent.

    All files are listed in an ASC MHL manifest.

    Example: skinrig export appearance --to gltf --out delivery
    """
    from skinrig.exporting import appearances, brdfs
    from skinrig.exporting.sessions import handing as sessions
    from skinrig.exporting.sessions import light_lists, stokes

    console = Console(json)
    known = (
        *appearances.APPEARANCE_FORMATS,
        *brdfs.BRDF_SUFFIXES,
        *sessions.SESSION_FORMATS,
        light_lists.LIGHT_LIST_FORMAT,
        stokes.STOKES_FORMAT,
    )
    if to not in known:
        raise UnusableError(f"--to: got {to!r}, expected one of {', '.join(known)}")
    of_maps = (*appearances.APPEARANCE_FORMATS, *brdfs.BRDF_SUFFIXES)
    of_sessions = tuple(name for name in known if name not in of_maps)
    for file, kind, fitting in (
        ("session.json", "a session", of_sessions),
        ("appearance.json", "maps", of_maps),
    ):
        if (source / file).is_file() and to not in fitting:
            raise UnusableError(
                f"--to: got {to!r}, but {source} holds {kind}; expected one of {', '.join(fitting)}"
            )
    names = () if only is None else tuple(name.strip() for name in only.split(","))
    if to in brdfs.BRDF_SUFFIXES:
        place = brdfs.place_of(at, radius_mm=radius, diffuse=not without_diffuse)
        done = appearances.export_brdfs(source, out, to=to, place=place, use=use)
    elif to in appearances.APPEARANCE_FORMATS:
        delivery = Delivery(
            unit=unit,
            normal_y=normal_y,
            udim=udim,
            with_errors=with_errors,
            only=names,
            mesh=mesh,
            onto=onto,
            landmarks=tuple(landmarks or ()),
        )
        done = appearances.export_appearance(source, out, to=to, delivery=delivery, use=use)
    elif to == light_lists.LIGHT_LIST_FORMAT:
        done = light_lists.export_light_list(
            source, out, use=sessions.require_use(use), camera=camera, calibration=calibration
        )
    elif to == stokes.STOKES_FORMAT:
        done = stokes.export_stokes(
            source,
            out,
            use=sessions.require_use(use),
            only=names,
            with_errors=with_errors,
            calibration=calibration,
        )
    else:
        done = sessions.export_session(source, out, to=to, use=sessions.require_use(use))
    after = NEXT_STEP_BY_FORMAT.get(
        to, "hand the folder on; `ascmhl verify` tells whether it is still whole"
    )
    for what, why in done.left_out:
        console.say(f"left out: {what}: {why}")
    console.say(f"{done.path}: {counted(done.files, 'file')}, listed in {done.manifest}")
    console.say(f"next: {after}")
    console.document(
        "skinrig.export/1",
        {
            "path": done.path,
            "files": done.files,
            "manifest": done.manifest,
            "to": to,
            "next": after,
            "left_out": [list(row) for row in done.left_out],
        },
    )
