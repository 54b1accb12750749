"""`skinrig capture`, `serve`, `verify` and `session`: sessions of rigs and their checks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skinrig import errors
from skinrig.command_line import options
from skinrig.command_line.help import Command, Commands, RigCommand, RigFileGroup
from skinrig.command_line.options import choice, command, target_option
from skinrig.console import Console, format_count, select_attributes

if TYPE_CHECKING:
    from skinrig.capturing.acquisition import CaptureOrder

capture_app = typer.Typer(
    cls=RigFileGroup,
    subcommand_metavar="RIG [ARGS]...",
    help="Run a plan on a rig, given by name or TOML file: real, or served by `skinrig serve`.",
)
serve_app = typer.Typer(
    cls=RigFileGroup,
    subcommand_metavar="RIG [ARGS]...",
    help="Serve a simulated rig, given by name or TOML file, to any client.",
)

session_app = typer.Typer(cls=Commands, help="Work on a captured session.", no_args_is_help=True)

Eyes = Annotated[str, choice("open", "closed", "shielded")]


@dataclass(frozen=True, slots=True)
class CaptureOptions:
    """Options of every capture.

    Attributes
    ----------
    out
        SESSION/ folder to write; without it, the plan is only printed.
    plan
        Plan file, JSON; default: the rig's own plan.
    subject
        Pseudonym of the subject.
    dry_run
        Print the plan without capturing.
    plan_out
        New file to write the plan to, JSON.
    port
        Address of a controller; repeatable.
    camera
        Address of a camera; repeatable.
    """

    out: Path | None = None
    port: Annotated[list[str] | None, typer.Option(metavar="NAME=URL")] = None
    camera: Annotated[list[str] | None, typer.Option(metavar="VIEW=URL")] = None
    plan: Path | None = None
    subject: str = "anonymous"
    consent: options.Consent = None
    consent_expires: options.ConsentExpires = None
    dry_run: bool = False
    plan_out: Path | None = None
    resume: options.Resume = False
    json: options.Json = False

    def order(self, **more: Any) -> CaptureOrder:
        """Return the options as a request for a capture, with a rig's own options `more`."""
        from skinrig.capturing.acquisition import CaptureOrder
        from skinrig.capturing.addresses import parse_addresses
        from skinrig.consent import parse_subject

        return CaptureOrder(
            out=self.out,
            boxes=parse_addresses(self.port or (), "--port"),
            cameras=parse_addresses(self.camera or (), "--camera"),
            subject=parse_subject(self.subject, self.consent, self.consent_expires),
            **select_attributes(self, "dry_run", "plan_out", "resume"),
            **more,
        )


@capture_app.command("flash", cls=RigCommand)
@command
def capture_flash(
    context: typer.Context,
    common: CaptureOptions,
    sequence: options.SequenceOptions,
    target: Annotated[str | None, target_option("flash")] = None,
    state: list[str] | None = None,
    repeats: options.Pairs = 1,
    bands: options.Bands = None,
) -> None:
    """Capture with a flash rig: expressions of a face, a time sequence, or a target.

    Example: skinrig capture flash --port flash=/dev/ttyUSB0 --camera cam=hotfolder:incoming
    --out session

    Parameters
    ----------
    state
        Expression or condition of the face, such as smile; repeatable; default: neutral.
    """
    from capture.plan.led_bands import parse_bands

    chosen = {
        "repeats": repeats,
        "sequence": sequence.order(),
        "states": tuple(state or ()),
        "bands": parse_bands(bands) if bands else (),
    }
    _capture(context, common, common.order(), target, **chosen)


@capture_app.command("dome", cls=RigCommand)
@command
def capture_dome(
    context: typer.Context,
    common: CaptureOptions,
    target: Annotated[str | None, target_option("dome")] = None,
    eyes: Eyes = "open",
    scanner: bool = False,
) -> None:
    """Capture with a dome: a face under one light at a time (OLAT), or a target.

    Example: skinrig capture dome --dry-run

    Parameters
    ----------
    eyes
        Subject's eyes, as confirmed by the operator; flicker above its limit requires closed or
        shielded.
    scanner
        Scan the face, or the board of target charuco, with the rig's scanner of stripes.
    """
    from skinrig.capturing.option_values import parse_eye_state

    order = common.order(eyes=parse_eye_state(eyes))
    _capture(context, common, order, target, scanner)


@capture_app.command("gradient", cls=RigCommand)
@command
def capture_gradient(
    context: typer.Context,
    common: CaptureOptions,
    target: Annotated[str | None, target_option("gradient")] = None,
    eyes: Eyes = "open",
    force_limit: float | None = None,
    angles: options.Angles = None,
    steps: options.Steps = None,
) -> None:
    """Capture with a gradient sphere: a patch of skin in a caliper, or a target.

    Example: skinrig capture gradient --angles 0,90 --dry-run

    Parameters
    ----------
    eyes
        Subject's eyes, as confirmed by the operator; flicker above its limit requires closed or
        shielded.
    force_limit
        Maximum force of the caliper on this skin, N; required with a caliper.
    """
    from skinrig.capturing.option_values import parse_eye_state, parse_floats, parse_range

    order = common.order(eyes=parse_eye_state(eyes), force_limit_n=force_limit)
    chosen = {"angles": parse_floats(angles, "--angles"), "steps": parse_range(steps, "--steps")}
    _capture(context, common, order, target, **chosen)


@capture_app.command("probe", cls=RigCommand)
@command
def capture_probe(
    context: typer.Context,
    common: CaptureOptions,
    target: Annotated[str | None, target_option("probe")] = None,
    sites: options.Sites = None,
    repeats: options.Placements = 1,
    angles: options.Directions = None,
    all_brackets: options.AllBrackets = False,
) -> None:
    """Capture with a fiber probe: skin at several sites, or a target.

    Example: skinrig capture probe --sites cheek --dry-run
    """
    from skinrig.capturing.option_values import parse_floats, parse_names

    chosen = {
        "sites": parse_names(sites),
        "repeats": repeats,
        "angles": parse_floats(angles, "--angles"),
    }
    _capture(context, common, common.order(all_brackets=all_brackets), target, **chosen)


def _capture(
    context: typer.Context,
    common: CaptureOptions,
    order: CaptureOrder,
    target: str | None,
    scanner: bool = False,
    /,
    **chosen: Any,
) -> None:
    """Capture with the rig's own plan or the plan of a file."""
    from capture.rig import load_rig
    from skinrig.capturing.acquisition import capture_session
    from skinrig.capturing.plan_choice import choose_plan

    console = Console(common.json)
    rig = load_rig(str(context.info_name))
    rig = rig.with_scanner() if scanner else rig
    plan = choose_plan(rig, common.plan, target, **chosen)
    console.print_document("skinrig.capture/1", capture_session(rig, plan, order, console))


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Options of every served rig.

    Attributes
    ----------
    pty
        Serve each controller on a pseudo terminal.
    tcp
        Address of cameras and, without --pty, of controllers, on this machine only; port 0: any
        free port.
    scale
        Scale of the simulation: small (fast) or full (the complete rig); gradient: small only.
    resume
        Interrupted session captured from an earlier server with this rig and seed; new shots
        continue its noise sequence and differ from those on disk.
    """

    pty: bool = False
    tcp: str = "127.0.0.1:0"
    subject: options.Subject = "III"
    scale: options.Scale = "small"
    seed: options.Seed = 0
    session_seed: options.SessionSeed = None
    renderer: options.Renderer = "mitsuba"
    resume: Path | None = None
    json: options.Json = False


@serve_app.command("flash", cls=RigCommand)
@command
def serve_flash(context: typer.Context, common: ServeOptions) -> None:
    """Serve a simulated flash rig; the first lines are the addresses.

    Controllers and cameras are on TCP; with --pty, each controller is on a pseudo terminal. With
    --json, the document lists the addresses and is printed when they accept connections.

    Example: skinrig serve flash --pty
    """
    _serve(context, common)


@serve_app.command("dome", cls=RigCommand)
@command
def serve_dome(context: typer.Context, common: ServeOptions, scanner: bool = False) -> None:
    """Serve a simulated dome with all its lights and cameras; the first lines are the addresses.

    Example: skinrig serve dome --subject II

    Parameters
    ----------
    scanner
        Serve the scanner's controller and cameras, too.
    """
    _serve(context, common, scanner=scanner)


@serve_app.command("gradient", cls=RigCommand)
@command
def serve_gradient(context: typer.Context, common: ServeOptions, site: options.Site = None) -> None:
    """Serve a simulated gradient sphere at small scale; the first lines are the addresses.

    Example: skinrig serve gradient --site cheek
    """
    _serve(context, common, site)


@serve_app.command("probe", cls=RigCommand)
@command
def serve_probe(context: typer.Context, common: ServeOptions) -> None:
    """Serve a simulated fiber probe on skin; the first lines are the addresses.

    Example: skinrig serve probe --subject IV
    """
    _serve(context, common)


def _serve(
    context: typer.Context, common: ServeOptions, site: str | None = None, scanner: bool = False
) -> None:
    """Serve a simulated rig until interrupted."""
    from skinrig.simulating.serving import ServeOrder, serve_rig

    options = ("pty", "tcp", "subject", "seed", "session_seed", "renderer", "resume")
    order = ServeOrder(
        site=site, scanner=scanner, size=common.scale, **select_attributes(common, *options)
    )
    serve_rig(str(context.info_name), order, Console(common.json))


@command
def verify(session: Path, /, json: options.Json = False) -> None:
    """Check the digests of all files of a session; exit code 3 if one is damaged or missing.

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
    console.print_each("damaged", found.problems)
    state = "sound" if found.ok else "DAMAGED" if found.complete else "INCOMPLETE"
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
