"""The commands that drive rigs, serve simulated ones and check what was captured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.commands import completion
from skinrig.commands.options import (
    AllBrackets,
    Angles,
    Captures,
    Consent,
    ConsentExpires,
    Duration,
    Json,
    PromptPeriod,
    Repeats,
    Rig,
    Seed,
    Sequence,
    ShotPeriod,
    Site,
    Sites,
    Steps,
)
from skinrig.console import Console, counted


def capture(
    rig: Annotated[
        str, typer.Argument(help="Name of a rig, or its TOML file.", autocompletion=completion.rigs)
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the session.")] = None,
    port: Annotated[
        list[str] | None, typer.Option(metavar="NAME=URL", help="Address of a box; repeatable.")
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option(metavar="VIEW=URL", help="Address of a camera; repeatable.")
    ] = None,
    plan: Annotated[Path | None, typer.Option(help="Plan, JSON; default: the rig's own.")] = None,
    target: Annotated[
        str | None, typer.Option(help="Plan of a calibration target, named as for simulate.")
    ] = None,
    subject: Annotated[str, typer.Option(help="Pseudonym of the subject.")] = "anonymous",
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print the plan.")] = False,
    plan_out: Annotated[Path | None, typer.Option(help="New file for the plan, JSON.")] = None,
    eyes: Annotated[
        str, typer.Option(help="The subject's eyes among LEDs: open, closed or shielded.")
    ] = "open",
    force_limit: Annotated[
        float | None,
        typer.Option(help="Greatest force of the caliper on this skin, newton; no default."),
    ] = None,
    state: Annotated[
        list[str] | None,
        typer.Option(help="State of the face before the flash rig, such as smile; repeatable."),
    ] = None,
    sites: Sites = None,
    repeats: Repeats = 1,
    angles: Angles = None,
    all_brackets: AllBrackets = False,
    steps: Steps = None,
    sequence: Sequence = None,
    prompt_period: PromptPeriod = None,
    shot_period: ShotPeriod = None,
    captures: Captures = None,
    duration: Duration = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a session that was interrupted.")
    ] = False,
    json: Json = False,
) -> None:
    """Run a plan on a rig: real, or served by `skinrig serve`.

    Example: skinrig capture flash --port flash=/dev/ttyUSB0 --camera cam=hotfolder:incoming
    --out session
    """
    from skinrig.capturing.acquisition import (
        capture_session,
        eyes_of,
        names_of,
        numbers_of,
        range_of,
        sequence_of,
    )
    from skinrig.consent import subject_of

    console = Console(json)
    done = capture_session(
        rig,
        out,
        ports=port or [],
        cameras=camera or [],
        plan=plan,
        target=target,
        subject=subject_of(subject, consent, consent_expires),
        dry_run=dry_run,
        plan_out=plan_out,
        resume=resume,
        console=console,
        eyes=eyes_of(eyes),
        force_limit_n=force_limit,
        angles=numbers_of(angles, "--angles"),
        steps=range_of(steps, "--steps"),
        sites=names_of(sites),
        repeats=repeats,
        all_brackets=all_brackets,
        sequence=sequence_of(sequence, prompt_period, shot_period, captures, duration),
        states=tuple(state or ()),
    )
    console.document("skinrig.capture/1", done)


def serve(
    rig: Rig,
    pty: Annotated[bool, typer.Option("--pty", help="Boxes on a pseudo terminal.")] = False,
    tcp: Annotated[
        str, typer.Option(help="Address for cameras and, without --pty, boxes; port 0: a free one.")
    ] = "127.0.0.1:0",
    anywhere: Annotated[
        bool, typer.Option("--allow-remote", help="Let other machines connect.")
    ] = False,
    subject: Annotated[
        str, typer.Option(help="Whose skin: a preset, I to VI, or a file NAME.toml.")
    ] = "III",
    site: Site = None,
    size: Annotated[str, typer.Option(help="small or full.")] = "small",
    seed: Seed = 0,
    resume: Annotated[
        Path | None,
        typer.Option(
            help="Session that was captured from an earlier server of this rig and seed and is to "
            "be gone on with: noise of its shots does not come again."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Serve a simulated rig to any client; the first lines are the addresses.

    Boxes and cameras are on TCP, with --pty boxes on a pseudo terminal each. With --json the
    addresses are the one document, printed as soon as they can be opened.

    Example: skinrig serve flash --pty
    """
    from skinrig.simulating.serving import serve_rig

    serve_rig(
        rig,
        pty=pty,
        tcp=tcp,
        allow_remote=anywhere,
        subject=subject,
        size=size,
        seed=seed,
        site=site,
        resume=resume,
        as_json=json,
    )


def verify(
    session: Annotated[Path, typer.Argument(help="SESSION/ folder.")], json: Json = False
) -> None:
    """Check every byte of a session; exit code 3 names what is damaged.

    Example: skinrig verify session
    """
    from capture.session import verify as check

    console = Console(json)
    found = check(session)
    for text in found.warnings:
        console.say(f"warning: {text}")
    for text in found.problems:
        console.say(f"damaged: {text}")
    console.say(
        f"{session}: {'sound' if found.ok else 'DAMAGED'}, {counted(found.frames, 'frame')}, "
        f"{found.bytes / 1e6:.1f} MB"
    )
    console.document(
        "skinrig.verify/1",
        {
            "ok": found.ok,
            "problems": found.problems,
            "warnings": found.warnings,
            "frames": found.frames,
            "bytes": found.bytes,
        },
    )
    if not found.ok:
        raise typer.Exit(errors.BAD_INPUT)
