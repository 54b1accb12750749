"""The command line: each command parses, calls one function, prints what it did."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from skinrig import errors
from skinrig.commands import (
    analysing,
    completion,
    dynamic,
    editing,
    export,
    importing,
    planning,
    reflectance,
    rendering,
    report,
    view,
)
from skinrig.commands.help import Commands
from skinrig.commands.options import (
    AllBrackets,
    Angles,
    Captures,
    Consent,
    ConsentExpires,
    Duration,
    Json,
    Out,
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
from skinrig.console import Console

app = typer.Typer(
    name="skinrig",
    cls=Commands,
    help="Capture, calibrate and reconstruct skin appearance, with rigs that can be simulated.",
    epilog="Begin with: skinrig demo",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    add_completion=True,
    rich_markup_mode=None,
)


def _version(shown: bool) -> None:
    if shown:
        from importlib.metadata import version

        typer.echo(f"skinrig {version('skinrig')}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which one.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log details to stderr.")] = False,
) -> None:
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
    )
    if context.invoked_subcommand is None:
        from importlib.metadata import version as version_of

        from skinrig.next_steps import welcome

        typer.echo(welcome(Path(), version_of("skinrig")))


@app.command()
def demo(
    out: Out = Path("demo"),
    rigs: Annotated[
        str,
        typer.Option(
            help="Rigs, joined by commas: flash, dome, gradient, probe; default all.",
            autocompletion=completion.several_rigs,
        ),
    ] = "flash,dome,gradient,probe",
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Simulate, capture, calibrate, reconstruct and report, small; the place to begin.

    Example: skinrig demo --out demo
    """
    from skinrig.demo import run_demo

    console = Console(json)
    console.document("skinrig.demo/1", run_demo(out, rigs.split(","), seed=seed, console=console))


@app.command()
def simulate(
    rig: Rig,
    out: Out,
    size: Annotated[
        str,
        typer.Option(help="Of the pictures: small or full.", autocompletion=completion.sizes),
    ] = "small",
    width: Annotated[
        int | None, typer.Option(help="Pixels across, instead of the size; even but for gradient.")
    ] = None,
    lights: Annotated[
        int | None, typer.Option(help="How many of the dome's lights; default 48, full all 150.")
    ] = None,
    views: Annotated[
        int | None, typer.Option(help="How many of the dome's cameras; default 6, full all 16.")
    ] = None,
    move: Annotated[bool, typer.Option("--move", help="The face in the dome moves.")] = False,
    seed: Seed = 0,
    subject: Annotated[
        str,
        typer.Option(
            help="Preset, I to VI, palest or darkest; of the dome also P01 to P87 of the "
            "simulated population; of the probe also homogeneous:SIGMA_A,SIGMA_S_PRIME[,G] or "
            "anisotropic:SIGMA_A,SIGMA_S_PRIME[,STRENGTH[,AXIS]], 1/mm and degrees.",
            autocompletion=completion.subjects,
        ),
    ] = "III",
    mesh: Annotated[Path | None, typer.Option(help="Face mesh, .npz or .obj.")] = None,
    target: Annotated[
        str | None,
        typer.Option(
            help="A target instead of a face: white, dark; of the flash rig chart, flat, malus; "
            "of the dome charuco, mirror; of the gradient rig ball, flat; of the probe phantom.",
            autocompletion=completion.targets,
        ),
    ] = None,
    site: Site = None,
    sites: Sites = None,
    repeats: Repeats = 1,
    angles: Angles = None,
    all_brackets: AllBrackets = False,
    steps: Steps = None,
    state: Annotated[
        list[str] | None,
        typer.Option(
            help="State of the face, such as smile or exercise; repeatable for the flash rig.",
            autocompletion=completion.states,
        ),
    ] = None,
    movement: Annotated[
        bool,
        typer.Option(
            "--movement/--no-movement",
            help="Whether the face moves and wrinkles with its states, or its blood changes only.",
        ),
    ] = True,
    wrapped: Annotated[
        bool,
        typer.Option(
            "--wrapped",
            help="The dome's scan is a template wrapped onto the face: one texture for all states.",
        ),
    ] = False,
    subsurface: Annotated[
        bool,
        typer.Option(
            "--subsurface",
            help="Light in the dome spreads sideways in the skin, even where no pixel shows it.",
        ),
    ] = False,
    interreflections: Annotated[
        bool,
        typer.Option(
            "--interreflections",
            help="Light in the dome goes from skin to skin, even where no pixel shows it.",
        ),
    ] = False,
    leave_out: Annotated[
        str | None,
        typer.Option(
            help="What a dome's scene does not build although it changes pixels: subsurface, "
            "interreflections, joined by commas."
        ),
    ] = None,
    condition: Annotated[
        list[str] | None,
        typer.Option(
            help="Condition of the face in the dome, NAME or NAME=AMOUNT up to 1: cold, hot, "
            "sweat, lotion, makeup, powder; repeatable.",
            autocompletion=completion.conditions,
        ),
    ] = None,
    plan: Annotated[
        Path | None,
        typer.Option(help="Of the dome: the lights and cameras of a plan by `skinrig plan`."),
    ] = None,
    sequence: Sequence = None,
    prompt_period: PromptPeriod = None,
    shot_period: ShotPeriod = None,
    captures: Captures = None,
    duration: Duration = None,
    relaxation: Annotated[
        float | None,
        typer.Option(
            help="Time constant of a sequence's blood, s; default 0.02, of exercise 40, of "
            "alcohol 1200."
        ),
    ] = None,
    consent: Consent = None,
    consent_expires: ConsentExpires = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session.")] = False,
    json: Json = False,
) -> None:
    """Capture a simulated subject or target through the real drivers into SESSION/.

    Example: skinrig simulate flash --out session-flash --subject IV
    """
    from skinrig.acquisition import (
        amounts_of,
        names_of,
        numbers_of,
        range_of,
        read_plan,
        sequence_of,
    )
    from skinrig.consent import subject_of
    from skinrig.next_steps import after_session
    from skinrig.simulating.simulation import USES, pseudonym, simulate_session

    console = Console(json)
    done = simulate_session(
        rig, out, size=size, width_px=width, seed=seed, subject=subject, mesh=mesh, target=target,
        states=tuple(state or ("neutral",)), resume=resume, lights=lights, views=views, move=move,
        site=site, angles=numbers_of(angles, "--angles"), steps=range_of(steps, "--steps"),
        sites=names_of(sites), repeats=repeats, all_brackets=all_brackets,
        movement=movement, wrapped=wrapped, progress=console.progress,
        person=subject_of(pseudonym(subject, seed), consent or USES, consent_expires),
        sequence=sequence_of(sequence, prompt_period, shot_period, captures, duration),
        relaxation_s=relaxation, subsurface=subsurface, interreflections=interreflections,
        conditions=amounts_of(condition, "--condition"),
        plan=None if plan is None else read_plan(plan), leave_out=names_of(leave_out) or (),
    )  # fmt: skip
    console.say(
        f"{done.session}: {done.frames} frames" + (f", truth in {done.truth}" if done.truth else "")
    )
    console.say(f"next: {after_session(rig, out, target if sequence is None else 'sequence')}")
    console.document("skinrig.simulate/1", done.document())


@app.command()
def capture(
    rig: Annotated[
        str,
        typer.Argument(help="Name of a rig, or its TOML file.", autocompletion=completion.rigs),
    ],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the session.")] = None,
    port: Annotated[list[str] | None, typer.Option(help="Box: NAME=URL; repeatable.")] = None,
    camera: Annotated[list[str] | None, typer.Option(help="Camera: VIEW=URL; repeatable.")] = None,
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
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a session.")] = False,
    json: Json = False,
) -> None:
    """Run a plan on a rig: real, or served by `skinrig serve`.

    Example: skinrig capture flash --port flash=/dev/ttyUSB0 --camera cam=hotfolder:incoming
    --out session
    """
    from skinrig.acquisition import (
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
        rig, out, ports=port or [], cameras=camera or [], plan=plan, target=target,
        subject=subject_of(subject, consent, consent_expires), dry_run=dry_run,
        plan_out=plan_out, resume=resume, console=console, eyes=eyes_of(eyes),
        force_limit_n=force_limit, angles=numbers_of(angles, "--angles"),
        steps=range_of(steps, "--steps"), sites=names_of(sites), repeats=repeats,
        all_brackets=all_brackets,
        sequence=sequence_of(sequence, prompt_period, shot_period, captures, duration),
        states=tuple(state or ()),
    )  # fmt: skip
    console.document("skinrig.capture/1", done)


@app.command()
def serve(
    rig: Rig,
    pty: Annotated[bool, typer.Option("--pty", help="Boxes on a pseudo terminal.")] = False,
    tcp: Annotated[str, typer.Option(help="Address for boxes and cameras.")] = "127.0.0.1:0",
    anywhere: Annotated[
        bool, typer.Option("--allow-remote", help="Let other machines connect.")
    ] = False,
    subject: Annotated[str, typer.Option(help="Preset of the simulated face.")] = "III",
    site: Site = None,
    size: Annotated[str, typer.Option(help="small or full.")] = "small",
    seed: Seed = 0,
) -> None:
    """Serve a simulated rig to any client; the first lines are the addresses.

    Example: skinrig serve flash --pty
    """
    from skinrig.serving import serve_rig

    serve_rig(
        rig, pty=pty, tcp=tcp, allow_remote=anywhere, subject=subject, size=size, seed=seed,
        site=site,
    )  # fmt: skip


@app.command()
def calibrate(
    kind: Annotated[
        str,
        typer.Argument(
            help="Of the flash rig sensor, color, polarization, white; of the dome geometry, "
            "lights; of the gradient sphere sensor, lights, polarization; of the probe fibre.",
            autocompletion=completion.calibrations,
        ),
    ],
    sessions: Annotated[list[Path], typer.Argument(help="Sessions of the target.")],
    out: Out = Path("calibration"),
    square_mm: Annotated[
        float, typer.Option(help="Side of the squares of geometry's board, mm.")
    ] = 36.0,
    sphere_mm: Annotated[
        float, typer.Option(help="Radius of the mirror sphere of lights, mm.")
    ] = 50.0,
    phantom: Annotated[
        Path | None, typer.Option(help="Certificate (JSON) of the block fibre was measured on.")
    ] = None,
    json: Json = False,
) -> None:
    """Make a calibration from sessions of a target and say how it drifted.

    Example: skinrig calibrate sensor session-flat --out calibration
    """
    from skinrig.calibrating.calibrate import calibrate as make
    from skinrig.calibrating.dome import dome_targets

    console = Console(json)
    done = make(kind, sessions, out, targets=dome_targets(square_mm, sphere_mm), phantom=phantom)
    console.rows(("quantity", "value"), done.summary)
    for text in done.findings:
        console.say(f"found: {text}")
    for change in done.drift:
        if change.change and (change.sigmas is None or abs(change.sigmas) > 2):
            console.say(f"drift: {change}")
    console.say(f"{done.path}: valid until {done.calibration.valid_until}")
    console.document(
        "skinrig.calibrate/1",
        {"path": done.path, "values": dict(done.summary), "findings": done.findings,
         "drift": [str(d) for d in done.drift]},
    )  # fmt: skip


app.command()(planning.plan)
app.command()(rendering.render)
app.command()(editing.edit)
app.command()(report.report)
app.command()(view.view)
app.command()(export.export)
dynamic.fit_app.command("traits")(editing.fit_traits)
app.add_typer(importing.import_app, name="import")
dynamic.fit_app.command("reflectance")(reflectance.fit_reflectance)
app.add_typer(dynamic.fit_app, name="fit")
app.add_typer(dynamic.apply_app, name="apply")
analysing.analyse_app.command("albedo")(editing.analyse_albedo)
app.add_typer(analysing.analyse_app, name="analyse")


@app.command()
def reconstruct(
    session: Annotated[Path, typer.Argument(help="SESSION/ folder.")],
    want: Annotated[
        str,
        typer.Option(
            help="Maps, separated by commas; a wrong name lists those there are.",
            autocompletion=completion.wants,
        ),
    ],
    out: Out,
    calibration: Annotated[Path | None, typer.Option(help="CALIBRATION/ folder.")] = None,
    state: Annotated[str, typer.Option(help="State of the subject.")] = "neutral",
    scan: Annotated[
        Path | None, typer.Option(help="Mesh of the face, PLY in mm, instead of a dome session's.")
    ] = None,
    basis: Annotated[
        Path | None, typer.Option(help="Folder of MERL tables to fit a dome's lobes with.")
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="Table name,x,y of a probe's sites in pixels of its 256 x 256 map."),
    ] = None,
    hold_out: Annotated[
        str | None,
        typer.Option(help="A dome's frames that no fit sees: lights=L007,L023,views=C03."),
    ] = None,
    rank: Annotated[
        int | None, typer.Option(help="Lobes that a dome's points share; default 4.")
    ] = None,
    json: Json = False,
) -> None:
    """Make maps of a session; computes only what is wanted and not there yet.

    Example: skinrig reconstruct session --want melanin,hemoglobin --out appearance
    """
    from reconstruction import pipeline
    from skinrig.demo import truth_beside

    console = Console(json)
    truth = truth_beside(session)
    done = pipeline.reconstruct(
        session, want=[w.strip() for w in want.split(",") if w.strip()], out=out,
        calibration=calibration, state=state, scan=scan, basis=basis, landmarks=landmarks,
        progress=console.progress, truth=truth.name if truth else "", hold_out=hold_out, rank=rank,
    )  # fmt: skip
    for text in done.assumed:
        console.say(f"assumed: {text}")
    console.say(f"run: {', '.join(done.ran) or 'nothing'}")
    console.say(f"reused: {', '.join(done.reused) or 'nothing'}")
    for what, why in done.left_out:
        console.say(f"left out: {what} ({why})")
    console.say(f"next: skinrig report {out}")
    console.document(
        "skinrig.reconstruct/1",
        {"path": out, "ran": done.ran, "reused": done.reused, "left_out": done.left_out,
         "assumed": done.assumed, "work": [dict(w) for w in done.work]},
    )  # fmt: skip


@app.command()
def bench(
    stage: Annotated[
        list[str] | None,
        typer.Option(help="Stage; repeatable; default all.", autocompletion=completion.stages),
    ] = None,
    budget: Annotated[float, typer.Option(help="Seconds to spend, about.")] = 600.0,
    toy: Annotated[bool, typer.Option("--toy", help="Smallest sizes, no limits judged.")] = False,
    extremes: Annotated[
        bool, typer.Option("--extremes", help="Try stiff and extreme cases instead.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for bench.json, a table and plots; or extremes.json."),
    ] = None,
    json: Json = False,
) -> None:
    """Measure error against run time; exit code 1 when a limit is missed.

    Without --stage every stage is measured at its small size, and then, the quickest first, at full
    size as long as the budget lasts. Limits are judged at full size alone.

    Example: skinrig bench --json --out bench

    Example: skinrig bench --stage chromophores --json

    Example: skinrig bench --extremes
    """
    console = Console(json)
    if extremes:
        from skinrig.reporting.extremes import run_extremes

        document = run_extremes(stage or (), out=out, console=console)
    else:
        from skinrig.benchmarks import table as bench_table
        from skinrig.benchmarks.stages import run_stages

        document = run_stages(stage, budget_s=budget, toy=toy, out=out, console=console)
        if out is not None:
            bench_table.write(document, out)
    console.document(document.pop("schema"), document)
    if not document["passed"]:
        raise typer.Exit(errors.LIMIT_MISSED)


@app.command()
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
        f"{session}: {'sound' if found.ok else 'DAMAGED'}, {found.frames} frames, "
        f"{found.bytes / 1e6:.1f} MB"
    )
    console.document(
        "skinrig.verify/1",
        {"ok": found.ok, "problems": found.problems, "warnings": found.warnings,
         "frames": found.frames, "bytes": found.bytes},
    )  # fmt: skip
    if not found.ok:
        raise typer.Exit(errors.BAD_INPUT)


@app.command()
def doctor(json: Json = False) -> None:
    """Say what is installed, which renderer runs and why, and how to mend what is not.

    Example: skinrig doctor
    """
    from skinrig.doctor import examine

    console = Console(json)
    findings = examine()
    console.rows(
        ("", "what", "state", "to mend"),
        [("ok" if f.fine else "!!", f.what, f.state, f.mend) for f in findings],
    )
    rows: list[dict[str, Any]] = [
        {"what": f.what, "state": f.state, "fine": f.fine, "mend": f.mend} for f in findings
    ]
    console.document("skinrig.doctor/1", {"findings": rows})
    if not all(f.fine for f in findings):
        raise typer.Exit(errors.EXTRA_MISSING)


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return the exit code; no traceback reaches the user."""
    if os.environ.get("SKINRIG_TRACEBACK"):
        app(args=argv, standalone_mode=False)
        return errors.DONE
    try:
        result = app(args=argv, standalone_mode=False)
    except (typer.Exit, SystemExit) as stop:
        code = getattr(stop, "exit_code", None)
        return int(code if code is not None else getattr(stop, "code", 0) or 0)
    except typer.Abort:
        print(f"skinrig: {errors.sentence(KeyboardInterrupt())}", file=sys.stderr)
        return errors.INTERRUPTED
    except KeyboardInterrupt as stop:
        print(f"skinrig: {errors.sentence(stop)}", file=sys.stderr)
        return errors.INTERRUPTED
    except Exception as error:
        if hasattr(error, "exit_code") and hasattr(error, "show"):  # a usage error of Typer's
            error.show()
            return errors.USAGE
        print(f"skinrig: {errors.sentence(error)}", file=sys.stderr)
        return errors.exit_code(error)
    return int(result or 0)


def run() -> None:
    """Entry point of the console script."""
    sys.exit(main())


if __name__ == "__main__":
    run()
