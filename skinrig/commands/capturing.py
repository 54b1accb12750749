"""`skinrig capture` and `skinrig serve`: sessions of rigs, real or simulated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from skinrig.command_line import options
from skinrig.command_line.help import RigCommand, RigFileGroup
from skinrig.command_line.options import choice, command, target_option
from skinrig.console import Console, select_attributes

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
