"""`skinrig verify`, `skinrig session`: check, seal, anonymize and copy sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.command_line import options
from skinrig.command_line.help import Command, Commands
from skinrig.command_line.options import command
from skinrig.console import Console, format_count, select_attributes

session_app = typer.Typer(cls=Commands, help="Work on a captured session.", no_args_is_help=True)


@command
def verify(session: Path, /, json: options.Json = False) -> None:
    """Check the digests of all files of a session; exit code 3 if one is damaged or missing.

    Where SKINRIG_CONSENT_KEY is set, also exit code 3 if the consent's seal is missing or wrong.

    Example: skinrig verify session

    Parameters
    ----------
    session
        SESSION/ folder.
    """
    from capture.session import verify as check

    console = Console(json)
    found = check(session, progress=console.progress)
    console.print_each("warning", found.warnings)
    console.print_each("refused", [found.refused_seal] if found.refused_seal else [])
    console.print_each("damaged", found.damage)
    state = "sound" if found.ok else "SEAL REFUSED"
    if found.damage:
        state = "DAMAGED" if found.complete else "INCOMPLETE"
    console.print_line(
        f"{session}: {state}, {format_count(found.frames, 'frame')}, {found.bytes / 1e6:.1f} MB"
    )
    if found.ok:
        console.print_line(f"{session}: consent {found.consent_seal}")
    figures = select_attributes(
        *(found, "ok", "complete", "problems", "warnings", "frames", "bytes", "consent_seal")
    )
    console.print_document("skinrig.verify/1", figures)
    if not found.ok:
        raise typer.Exit(errors.EXIT_BAD_INPUT)


@session_app.command("seal", cls=Command)
@command
def seal(session: Path, /, json: options.Json = False) -> None:
    """Seal the consent of a session with the lab's key, so that no one without it can widen it.

    The variable SKINRIG_CONSENT_KEY names the file of the key. Where it is set, new sessions are
    sealed as they are made. Compare the printed consent with the signed form.

    Example: skinrig session seal session

    Parameters
    ----------
    session
        SESSION/ folder.
    """
    from capture.session.folder import seal_consent
    from skinrig.consent import format_consent

    console = Console(json)
    found = seal_consent(session)
    (line,) = format_consent([found.manifest.to_json()["subject"]])
    console.print_line(f"{session}: consent {found.consent_seal}: {line}")
    figures = {"path": str(session), "consent_seal": found.consent_seal, "consent": line}
    console.print_document("skinrig.session.seal/1", figures)


@session_app.command("anonymize", cls=Command)
@command
def anonymize(
    session: Path,
    /,
    out: Annotated[Path, typer.Option(metavar="SESSION")],
    landmarks: Annotated[list[str] | None, typer.Option(metavar="VIEW=FILE")] = None,
    radius: float = 0.05,
    drop_images: bool = False,
    pseudonym: str | None = None,
    json: options.Json = False,
) -> None:
    """Copy a session without eyes and landmarks, or without images; the original is unchanged.

    The copy has a seal of its own and the same consent. What still identifies the subject is
    printed.

    Example: skinrig session anonymize session --landmarks cam=landmarks.csv --out anonymous

    Example: skinrig session anonymize session --drop-images --out anonymous

    Parameters
    ----------
    session
        SESSION/ folder, closed.
    out
        New SESSION/ folder.
    landmarks
        CSV table name,x,y in pixels of a view's maps; black discs cover them; repeatable.
    radius
        Radius of the discs, fraction of the image's width.
    drop_images
        Keep plan, rig and consent, and no frame.
    pseudonym
        New pseudonym of the subject; default: unchanged.
    """
    from skinrig.capturing.addresses import parse_addresses
    from skinrig.capturing.anonymization import AnonymizationOrder, anonymize_session

    console = Console(json)
    tables = parse_addresses(landmarks or (), "--landmarks")
    order = AnonymizationOrder(
        landmarks={view: Path(file) for view, file in tables.items()},
        radius=radius,
        drop_images=drop_images,
        pseudonym=pseudonym,
    )
    found = anonymize_session(session, out, order, console.progress)
    console.print_each("removed", found.removed)
    console.print_each("still identifies", found.identifiable)
    console.print_line(
        f"{out}: {format_count(found.frames, 'frame')}, {found.blackened} with black discs"
    )
    figures = select_attributes(found, "path", "frames", "blackened", "removed", "identifiable")
    console.print_document("skinrig.session.anonymize/1", figures)


@session_app.command("copy", cls=Command)
@command
def copy(
    session: Path,
    copy: Path,
    /,
    use: str | None = None,
    verify: bool = False,
    json: options.Json = False,
) -> None:
    """Copy a session to another disk, byte for byte; the same command continues after a stop.

    Every file is checked while it is read; exit code 3 if one is damaged, in the session or in the
    copy. The copy has the same id, consent and content hash.

    Example: skinrig session copy session /mnt/backup/session --use research --verify

    Parameters
    ----------
    session
        SESSION/ folder, closed, or open as far as its frames are committed.
    copy
        New SESSION/ folder.
    use
        Purpose of the copy, which the subject's unexpired consent must include.
    verify
        Read the copy back from its disk and check every byte.
    """
    from skinrig.capturing.second_copy import copy_with_consent

    console = Console(json)
    found = copy_with_consent(session, copy, use=use, read_back=verify, progress=console.progress)
    state = "verified" if found.verified else "written"
    console.print_line(
        f"{copy}: {state}, {format_count(found.frames, 'frame')}, {found.bytes / 1e6:.1f} MB"
    )
    if found.kept:
        console.print_line(f"{format_count(found.kept, 'file')} of an interrupted copy were sound")
    names = ("frames", "bytes", "kept", "verified", "content_hash")
    console.print_document("skinrig.session.copy/1", select_attributes(found, *names))
