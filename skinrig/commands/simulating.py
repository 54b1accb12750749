"""The command that simulates captures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands import completion
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
from skinrig.console import Console, counted


def simulate(
    rig: Rig,
    out: Out,
    size: Annotated[
        str, typer.Option(help="Of the pictures: small or full.", autocompletion=completion.sizes)
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
            help="Preset, I to VI, palest or darkest, or a file NAME.toml; of the dome also P01 to "
            "P87 of the simulated population; of the probe also a medium, "
            "homogeneous:A,S[,G] or anisotropic:A,S[,STRENGTH[,AXIS]] with A sigma_a and S "
            "sigma_s', 1/mm, and AXIS in degrees.",
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
            help="What a scene of skin does not build although it changes pixels, joined by "
            "commas. Flash rig: lateral, interreflections, spectral, optics, relief_shadows; dome: "
            "subsurface for lateral, and the same; gradient rig: shadows, lateral, "
            "interreflections, optics."
        ),
    ] = None,
    condition: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=AMOUNT]",
            help="Condition of the face in the dome, by up to 1 of it: cold, hot, "
            "sweat, lotion, makeup, powder; repeatable.",
            autocompletion=completion.conditions,
        ),
    ] = None,
    nearer: Annotated[
        float,
        typer.Option(
            metavar="MM",
            help="How much nearer to the flash rig's camera than the white tile the face stands, "
            "mm; below 0 farther.",
        ),
    ] = 0.0,
    plan: Annotated[
        Path | None,
        typer.Option(
            help="What is captured of the subject, by `skinrig plan`; its lights and cameras are "
            "also those of the dome's targets."
        ),
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
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a session that was interrupted.")
    ] = False,
    json: Json = False,
) -> None:
    """Capture a simulated subject or target through the real drivers into SESSION/.

    Example: skinrig simulate flash --out session-flash --subject IV
    """
    from skinrig.capturing.acquisition import (
        amounts_of,
        names_of,
        numbers_of,
        range_of,
        read_plan,
        sequence_of,
    )
    from skinrig.consent import subject_of
    from skinrig.next_steps import after_session
    from skinrig.simulating.orders import USES
    from skinrig.simulating.simulation import simulate_session
    from skinrig.simulating.subject_records import pseudonym

    console = Console(json)
    # a resumed session keeps what it was begun with, unless something else is said
    said = not resume or consent or consent_expires is not None
    done = simulate_session(
        rig,
        out,
        size=size,
        width_px=width,
        seed=seed,
        subject=subject,
        mesh=mesh,
        target=target,
        states=tuple(state or ("neutral",)),
        resume=resume,
        lights=lights,
        views=views,
        move=move,
        site=site,
        angles=numbers_of(angles, "--angles"),
        steps=range_of(steps, "--steps"),
        sites=names_of(sites),
        repeats=repeats,
        all_brackets=all_brackets,
        movement=movement,
        wrapped=wrapped,
        progress=console.progress,
        person=subject_of(pseudonym(subject, seed), consent or USES, consent_expires)
        if said
        else None,
        sequence=sequence_of(sequence, prompt_period, shot_period, captures, duration),
        relaxation_s=relaxation,
        subsurface=subsurface,
        interreflections=interreflections,
        conditions=amounts_of(condition, "--condition"),
        plan=None if plan is None else read_plan(plan),
        leave_out=names_of(leave_out) or (),
        nearer_mm=nearer,
    )
    console.say(
        f"{done.session}: {counted(done.frames, 'frame')}"
        + (f", truth in {done.truth}" if done.truth else "")
    )
    console.say(f"next: {after_session(rig, out, target if sequence is None else 'sequence')}")
    console.document("skinrig.simulate/1", done.document())
