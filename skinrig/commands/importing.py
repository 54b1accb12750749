"""The commands below `skinrig import`."""

from pathlib import Path

import typer

from skinrig.commands.help import Command, Subcommands
from skinrig.commands.options import Consent, ConsentExpires, Json, Out, command
from skinrig.console import Console, format_count, select_attributes
from skinrig.next_steps import shell_quote

import_app = typer.Typer(
    cls=Subcommands, help="Bring in what other devices made.", no_args_is_help=True
)


@import_app.command("photos", cls=Command)
@command
def import_photos(
    directory: Path,
    /,
    out: Out,
    rig: str | None = None,
    subject: str = "unnamed",
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    json: Json = False,
) -> None:
    """Turn RAW, TIFF, EXR, PNG or JPEG photographs into a session.

    Example: skinrig import photos portraits --out session-portraits

    Parameters
    ----------
    directory
        Folder of photographs, or one file.
    rig
        Rig whose camera took them, so that its calibrations hold.
    subject
        Pseudonym of the subject.
    """
    from capture.importers import import_photos as bring_in
    from capture.rig import load_rig
    from skinrig.consent import parse_subject

    console = Console(json)
    person = parse_subject(subject, consent, consent_expires)
    done = bring_in(directory, out=out, rig=None if rig is None else load_rig(rig), subject=person)
    console.each("assumed", done.assumed)
    console.each("ignored", done.ignored)
    console.say(
        f"{done.path}: {format_count(done.frames, 'photograph')}, states {', '.join(done.states)}"
    )
    place = shell_quote(out)
    if done.color_states:
        shown = "neutral" if "neutral" in done.color_states else done.color_states[0]
        state = "" if shown == "neutral" else f" --state {shown}"
        after = f"reconstruct {place} --want melanin,hemoglobin --out appearance{state}"
    else:
        console.say("left out: melanin and hemoglobin: gray pictures hold no color to tell them by")
        after = f"verify {place}"
    console.say(f"next: skinrig {after}")
    console.document(
        "skinrig.import/1",
        select_attributes(done, "path", "frames", "assumed", "states", "ignored"),
    )


@import_app.command("mesh", cls=Command)
@command
def import_mesh(
    file: Path, /, session: Path, out: Path | None = None, unit: str = "mm", json: Json = False
) -> None:
    """Attach a scanned mesh to a session.

    Example: skinrig import mesh scan.obj --unit m --session session

    Parameters
    ----------
    file
        Scanned mesh: .obj or .ply.
    session
        Session that gets the mesh.
    out
        New folder for a copy, where it is closed.
    unit
        Unit of the file: mm, cm, m or inch.
    """
    from capture.importers.meshes import import_mesh as bring_in

    console = Console(json)
    done = bring_in(file, session=session, out=out, unit=unit)
    size = " x ".join(f"{side:.0f}" for side in done.extent_mm)
    console.say(
        f"{done.path}: {done.vertices} vertices, {done.faces} triangles, {size} mm, "
        f"{'with' if done.has_uv else 'without'} texture coordinates"
    )
    after = f"reconstruct {shell_quote(done.path)} --want normals --out appearance"
    console.say(f"next: skinrig {after if done.reopened else f'verify {shell_quote(done.path)}'}")
    console.document(
        "skinrig.import/1",
        select_attributes(done, "path", "vertices", "faces", "has_uv", "extent_mm", "reopened"),
    )


@import_app.command("lp", cls=Command)
@command
def import_lp(
    directory: Path,
    /,
    out: Out,
    lights: Path | None = None,
    mask: Path | None = None,
    encoding: str = "auto",
    mm_per_px: float | None = None,
    json: Json = False,
) -> None:
    """Turn pictures of one object under many lights, with their light list, into a session.

    Example: skinrig import lp rti-folder --out session-rti

    Parameters
    ----------
    directory
        Folder of pictures, one a light.
    lights
        .lp, list of directions, or folder of a chrome ball.
    mask
        Picture that is bright at the object.
    encoding
        How 8-bit and PNG values code light: auto, sRGB or linear.
    mm_per_px
        Size of a pixel; then the list's rows are positions in mm.
    """
    from capture.importers import import_light_list

    console = Console(json)
    done = import_light_list(
        directory,
        out=out,
        lights=lights,
        mask=mask,
        encoding=encoding,  # type: ignore[arg-type]
        mm_per_px=mm_per_px,
    )
    console.each("assumed", done.assumed)
    console.say(f"{done.path}: {format_count(done.frames, 'picture')}, lights of {done.lights}")
    console.say(
        f"next: skinrig reconstruct {shell_quote(out)} --want normals,albedo --out appearance"
    )
    console.document(
        "skinrig.import/1",
        select_attributes(done, "path", "frames", "lights", "encoding", "mask", "assumed"),
    )
