"""`skinrig import`: sessions from photographs, meshes and light lists."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skinrig import errors
from skinrig.command_line.help import Command, ImportCommands
from skinrig.command_line.options import (
    Consent,
    ConsentExpires,
    Json,
    Out,
    check_output_page,
    choice,
    command,
)
from skinrig.console import Console, format_count, select_attributes
from skinrig.next_steps import DEFAULT_WANTS, OPEN_COMMAND, shell_quote

LARGE_IMAGE_PX = 2_000_000
"""Number of pixels of an image above which `import photos` advises to average them."""
ADVISED_WIDTH_PX = 1000
"""Width that it advises."""

if TYPE_CHECKING:
    from reconstruction.pipeline.diagnosed_images import DiagnosedImages

import_app = typer.Typer(
    cls=ImportCommands, help="Import data of other devices.", no_args_is_help=True
)


@import_app.command("photos", cls=Command)
@command
def import_photos(
    directory: Path,
    /,
    out: Out,
    rig: str | None = None,
    target: Annotated[str | None, choice("chart")] = None,
    crop: str | None = None,
    width: int | None = None,
    subject: str = "unnamed",
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    json: Json = False,
) -> None:
    """Convert RAW, TIFF, EXR, PNG or JPEG photographs to a session.

    Files whose names differ only by "parallel" and "crossed" are polarized pairs: faults that
    the two images show are printed.

    Example: skinrig import photos portraits --out session-portraits

    Parameters
    ----------
    directory
        Folder of photographs, one file, or a video, whose frames are read.
    rig
        Rig whose camera took the photographs, so that its calibrations apply; default: none.
    target
        Photographed target, a color chart in the light of the photographs; default: a subject.
    crop
        Part of each photograph: X,Y,WIDTH,HEIGHT in pixels from the upper left, or face, which
        finds the face and keeps only its skin in the maps; default: all.
    width
        Largest width of the imported images, pixels: wider ones are averaged by whole factors.
    subject
        Pseudonym of the subject; none: a thing, which needs no consent.
    """
    from capture.importers import import_photos as bring_in
    from capture.importers.framing import Framing
    from capture.importers.video_frames import open_source
    from capture.rig import load_rig
    from capture.session import Session
    from skinrig.consent import parse_subject

    console = Console(json)
    person = parse_subject(subject, consent, consent_expires)
    with open_source(directory) as source:
        done = bring_in(
            source.path,
            out=out,
            rig=None if rig is None else load_rig(rig),
            kind="chart" if target else "subject",
            subject=person,
            framing=Framing.parse(crop, width),
            source=source,
            progress=console.progress,
        )
    console.print_each("assumed", done.assumed)
    console.print_each("ignored", done.ignored)
    console.print_line(
        f"{done.path}: {format_count(done.frames, 'photograph')}, states {', '.join(done.states)}"
    )
    largest_px = max(v.width_px * v.height_px for v in Session.open(out).rig.all_views)
    if largest_px > LARGE_IMAGE_PX and not (rig or target):
        console.print_line(
            f"advice: images have up to {largest_px / 1e6:.1f} million pixels; import them with "
            f"--width {ADVISED_WIDTH_PX} for faster maps"
        )
    place = shell_quote(out)
    findings = []
    if done.has_pairs and not target:
        from reconstruction.pipeline import recipes

        found = recipes.diagnose(out)
        _print_findings(console, found)
        findings = found.to_json()["findings"]
    if target:
        after = f"calibrate color {place} --out calibration"
    elif done.color_states:
        shown = "neutral" if "neutral" in done.color_states else done.color_states[0]
        state = "" if shown == "neutral" else f" --state {shown}"
        after = f"reconstruct {place} --maps melanin,hemoglobin --out appearance{state}"
    else:
        console.print_line("omitted: melanin and hemoglobin: they need color images, not grayscale")
        after = f"verify {place}"
    console.print_line(f"next: skinrig {after}")
    console.print_document(
        "skinrig.import/1",
        select_attributes(done, "path", "frames", "assumed", "states", "ignored")
        | {"findings": findings},
    )


@command
def photo(
    photograph: Path,
    /,
    out: Out,
    width: int = 480,
    subject: str = "unnamed",
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    json: Json = False,
) -> None:
    """Estimate melanin and hemoglobin of the face in one photograph, and write a report.

    The command finds the face, crops and reduces the photograph, and leaves out what is not skin.

    Example: skinrig photo portrait.jpg --out portrait

    Parameters
    ----------
    photograph
        RAW, TIFF, EXR, PNG or JPEG file.
    width
        Largest width of the cropped image, pixels: a wider one is averaged by a whole factor.
    subject
        Pseudonym of the subject.
    """
    from skinrig.consent import parse_subject
    from skinrig.importing.portraits import analyze_portrait

    console = Console(json)
    person = parse_subject(subject, consent, consent_expires)
    done = analyze_portrait(
        photograph, out, width_px=width, subject=person, progress=console.progress
    )
    console.print_each("assumed", done.assumed)
    console.print_line(f"{done.appearance}: melanin, hemoglobin and the image")
    console.print_line(f"next: {OPEN_COMMAND} {shell_quote(done.report)}")
    values = select_attributes(done, "session", "appearance", "report", "assumed")
    console.print_document("skinrig.photo/1", values)


@import_app.command("mesh", cls=Command)
@command
def import_mesh(
    file: Path,
    /,
    session: Path,
    out: Path | None = None,
    unit: Annotated[str, choice("mm", "cm", "m", "inch")] = "mm",
    json: Json = False,
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
        New folder for a copy of the session; required if the session is closed.
    unit
        Length unit of the file: mm, cm, m or inch.
    """
    from capture.importers.meshes import import_mesh as bring_in

    console = Console(json)
    done = bring_in(file, session=session, out=out, unit=unit)
    size = " x ".join(f"{side:.0f}" for side in done.extent_mm)
    console.print_line(
        f"{done.path}: {done.vertices} vertices, {done.faces} triangles, {size} mm, "
        f"{'with' if done.has_uv else 'without'} texture coordinates"
    )
    after = f"reconstruct {shell_quote(done.path)} --maps normals --out appearance"
    console.print_line(
        f"next: skinrig {after if done.reopened else f'verify {shell_quote(done.path)}'}"
    )
    console.print_document(
        "skinrig.import/1",
        select_attributes(done, "path", "vertices", "faces", "has_uv", "extent_mm", "reopened"),
    )


@import_app.command("olat", cls=Command)
@command
def import_olat(
    directory: Path,
    /,
    out: Out,
    lights: str | None = None,
    camera: Path | None = None,
    mask: Path | None = None,
    encoding: Annotated[str, choice("auto", "sRGB", "linear")] = "auto",
    mm_per_px: float | None = None,
    subject: str = "unnamed",
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    json: Json = False,
) -> None:
    """Convert images of one object, one light at a time, to a session.

    Example: skinrig import olat rti-folder --out session-rti

    Parameters
    ----------
    directory
        Folder of images, or a video, one per light.
    lights
        Light list: .lp, text, JSON or NumPy file, or folder of a chrome ball's images; estimate:
        from the images alone; default: found in the folder.
    camera
        transforms.json, or COLMAP's images.txt, in whose frame the list is; default: the list is in
        the camera's own frame.
    mask
        Image whose bright pixels are the object; default: the folder's *mask* file, else all.
    encoding
        Transfer function of 8-bit and PNG values: auto, sRGB or linear.
    mm_per_px
        Pixel size on the object, mm; the light list then gives positions in mm.
    subject
        Pseudonym of the subject; none: a thing, which needs no consent.
    """
    from capture.importers import import_light_list
    from capture.importers.video_frames import open_source
    from skinrig.consent import parse_subject
    from skinrig.importing.light_stacks import find_lights, require_list_of_video

    console = Console(json)
    person = parse_subject(subject, consent, consent_expires)
    require_list_of_video(directory, lights)
    with open_source(directory) as source:
        found = find_lights(
            source.path,
            lights=lights,
            mask=mask,
            encoding=encoding,  # type: ignore[arg-type]
            camera=camera,
            mm_per_px=mm_per_px,
        )
        done = import_light_list(
            source.path,
            out=out,
            lights=found.lights,
            mask=mask,
            encoding=encoding,  # type: ignore[arg-type]
            resolved_encoding=found.encoding,
            mm_per_px=mm_per_px,
            subject=person,
            assumed=(*source.assumed, *found.assumed),
            video=source.video,
        )
    console.print_each("assumed", done.assumed)
    console.print_line(
        f"{done.path}: {format_count(done.frames, 'picture')}, lights of {done.lights}"
    )
    console.print_line(f"next: skinrig diagnose {shell_quote(out)}")
    console.print_document(
        "skinrig.import/1",
        select_attributes(done, "path", "frames", "lights", "encoding", "mask", "assumed"),
    )


@command
def diagnose(
    session: Path,
    /,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", callback=check_output_page, show_default=False)
    ] = None,
    json: Json = False,
) -> None:
    """Find what is wrong with a session's images; exit code 1 if anything is.

    The images themselves show it. Under listed lights: lists in another order, swapped or wrong
    lights, flipped axes, a wrong transfer curve, ambient light, near lights, drift, and empty,
    repeated, moved or clipped images. Of polarized pairs: exchanged or unequally exposed images. Of
    gradient patterns: exchanged, missing, empty or inconsistent images. `reconstruct` uses the
    order and leaves out the images that this command names; its maps name all other faults.

    Example: skinrig diagnose session-rti --out diagnosis.html

    Parameters
    ----------
    session
        Session of `skinrig import olat`, of the gradient rig, or with polarized pairs.
    out
        HTML file that shows the images in question, with balls under their lights.
    """
    from reconstruction.pipeline import recipes

    console = Console(json)
    console.progress("read the images and compare them with each other")
    found = recipes.diagnose(session)
    console.print_each("assumed", found.assumed)
    if not _print_findings(console, found):
        console.print_line(f"{session}: no fault was found in {len(found.names)} images")
    if out is not None:
        from skinrig.atomic_file import write_atomically
        from skinrig.reporting.diagnosis_page import build_diagnosis_page

        write_atomically(out, build_diagnosis_page(str(session), found))
        console.print_line(f"{out}: open it in a browser")
    maps = recipes.list_maps(session)
    usual = (names for names in DEFAULT_WANTS.values() if set(names.split(",")) <= set(maps))
    wanted = next(usual, ",".join(maps[:2]))
    after = f"reconstruct {shell_quote(session)} --maps {wanted} --out appearance"
    console.print_line(f"next: skinrig {after}")
    console.print_document(
        "skinrig.diagnosis/1", {"page": out, "session": session} | found.to_json()
    )
    if found.findings:
        raise typer.Exit(errors.EXIT_LIMIT_MISSED)


def _print_findings(console: Console, found: "DiagnosedImages") -> bool:
    """Print a table of faults; return whether there are any."""
    rows = [
        (one.fault, found.name_images(one), one.ratio_to_limit, one.evidence, one.remedy)
        for one in found.findings
    ]
    if rows:
        head = ("fault", "images", "over its limit", "evidence", "remedy")
        console.print_table(head, rows)
    return bool(rows)
