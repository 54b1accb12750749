"""`skinrig simulate`: simulated captures, one command per rig."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from skinrig.command_line import completion, options
from skinrig.command_line.help import RigCommand, RigGroup
from skinrig.command_line.options import command, option, target_option
from skinrig.console import Console, format_count, select_attributes
from skinrig.next_steps import suggest_after_session

if TYPE_CHECKING:
    from skinrig.simulating.orders import SimulationOrder

simulate_app = typer.Typer(
    cls=RigGroup,
    subcommand_metavar="RIG [ARGS]...",
    help="Capture a simulated subject or target into SESSION/ with the real drivers.",
)

States = Annotated[
    list[str] | None,
    option(
        "Expression or condition of the face, such as smile or exercise; repeatable; "
        "default: neutral.",
        autocompletion=completion.complete_states,
    ),
]
OneState = Annotated[
    list[str] | None,
    option(
        "Expression or condition of the face, such as smile or exercise; default: neutral.",
        autocompletion=completion.complete_states,
    ),
]


@dataclass(frozen=True, slots=True)
class SimulateOptions:
    """Options of every simulation.

    Attributes
    ----------
    scale
        Scale of the simulation: small (fewer pixels and lights, fast) or full (the complete rig).
    plan
        Plan file of `skinrig plan`, JSON; default: the rig's own plan.
    """

    out: options.Out
    scale: options.Scale = "small"
    seed: options.Seed = 0
    session_seed: options.SessionSeed = None
    days_ago: options.DaysAgo = 0
    plan: Path | None = None
    consent: options.Consent = None
    consent_expires: options.ConsentExpires = None
    resume: options.Resume = False
    json: options.Json = False
    help_all: options.HelpAll = False

    def request_fields(self, subject: str, console: Console) -> dict[str, Any]:
        """Return the fields that requests of all rigs share."""
        from skinrig.capturing.plan_choice import read_plan
        from skinrig.consent import parse_subject
        from skinrig.simulating.orders import SIMULATED_USES
        from skinrig.simulating.subject_records import pseudonym

        # a resumed session keeps its subject record unless an option replaces it
        person = None
        if not self.resume or self.consent or self.consent_expires is not None:
            name = pseudonym(subject, self.seed)
            person = parse_subject(name, self.consent or SIMULATED_USES, self.consent_expires)
        plan = None if self.plan is None else read_plan(self.plan)
        order = {"subject": subject, "plan": plan, "person": person, "progress": console.progress}
        return (
            order
            | select_attributes(self, "out", "seed", "session_seed", "days_ago", "resume")
            | {"size": self.scale}
        )


@dataclass(frozen=True, slots=True)
class SimulatedFaceOptions:
    """Options of a simulated face.

    Attributes
    ----------
    width
        Image width, pixels, even; default: that of the scale.
    mesh
        Face mesh, .npz or .obj; default: the built-in head.
    omit
        Visible effects to omit from the simulation, separated by commas: lateral (or
        subsurface), interreflections, spectral, optics, relief_shadows, thickness, melanin_depth,
        oxygenation, scattering, absorption.
    movement
        Deform the face with its expressions, or change its blood volume only.
    """

    width: int | None = None
    mesh: Path | None = None
    movement: Annotated[bool, typer.Option("--movement/--no-movement")] = True
    omit: str | None = None
    renderer: options.Renderer = "mitsuba"

    def ordered(self) -> dict[str, Any]:
        """Return the fields that requests of faces share."""
        from skinrig.capturing.option_values import parse_names

        order = {"width_px": self.width, "leave_out": parse_names(self.omit) or ()}
        return order | select_attributes(self, "mesh", "movement", "renderer")


@dataclass(frozen=True, slots=True)
class SimulatedScanOptions:
    """Options of the scan of a simulated face.

    Attributes
    ----------
    wrapped
        Scan with a wrapped template mesh, so that all expressions share one texture layout.
    scanner
        Scan with projected stripes instead of an attached mesh; with target charuco, capture them
        on the board too.
    """

    wrapped: bool = False
    scanner: bool = False


@simulate_app.command("flash", cls=RigCommand)
@command
def simulate_flash(
    common: SimulateOptions,
    face: SimulatedFaceOptions,
    sequence: options.SequenceOptions,
    subject: options.Subject = "III",
    target: Annotated[str | None, target_option("flash")] = None,
    repeats: options.Pairs = 1,
    state: States = None,
    camera_offset_mm: float = 0.0,
    relaxation: float | None = None,
    bands: options.Bands = None,
    site: Annotated[
        str | None,
        options.choice(
            "forehead", "cheek", "chin", text="Site of renderer reference; default: cheek."
        ),
    ] = None,
) -> None:
    """Simulate the flash rig: expressions of a face, a time sequence, or a target.

    Example: skinrig simulate flash --out session-flash --subject IV

    Parameters
    ----------
    relaxation
        Time constant of blood volume in a sequence, s; default 0.02, exercise 40, alcohol 1200.
    camera_offset_mm
        Offset of the face from the white reference towards the camera, mm; negative: away.
    """
    from capture.plan.led_bands import parse_bands
    from skinrig.simulating.orders import FlashOrder

    console = Console(common.json)
    order = FlashOrder(
        **common.request_fields(subject, console),
        **face.ordered(),
        target=target,
        states=tuple(state or ("neutral",)),
        repeats=repeats,
        nearer_mm=camera_offset_mm,
        sequence=sequence.order(),
        relaxation_s=relaxation,
        bands=parse_bands(bands) if bands else (),
        site=site,
    )
    _simulate(order, console, "sequence" if order.sequence is not None else target)


@simulate_app.command("dome", cls=RigCommand)
@command
def simulate_dome(
    common: SimulateOptions,
    face: SimulatedFaceOptions,
    scan: SimulatedScanOptions,
    subject: Annotated[str, typer.Option(autocompletion=completion.complete_subjects)] = "III",
    target: Annotated[str | None, target_option("dome")] = None,
    lights: int | None = None,
    views: int | None = None,
    move: bool = False,
    state: OneState = None,
    subsurface: bool = False,
    interreflections: bool = False,
    condition: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME[=AMOUNT]", autocompletion=completion.complete_conditions),
    ] = None,
) -> None:
    """Simulate the dome: a face with one expression and its scan, or a target.

    With --plan, targets are captured with the lights and cameras of the plan.

    Example: skinrig simulate dome --out session-dome --subject IV --condition sweat=0.5

    Parameters
    ----------
    lights
        Number of lights; default 48, at full scale all 150.
    views
        Number of cameras; default 6, at full scale all 16.
    move
        Simulate head motion during the capture.
    subsurface
        Simulate subsurface scattering even if its effect is not visible.
    interreflections
        Simulate interreflection of skin even if its effect is not visible.
    subject
        Simulated subject: preset I to VI, palest or darkest, ita:DEGREES, monk:N, a file
        NAME.toml, or P01 to P87 of the simulated population.
    condition
        Surface condition with amount 0 to 1, default 1: cold, hot, sweat, lotion, makeup, powder;
        repeatable.
    """
    from skinrig.capturing.option_values import parse_amounts
    from skinrig.simulating.orders import DomeOrder

    console = Console(common.json)
    order = DomeOrder(
        **common.request_fields(subject, console),
        **face.ordered(),
        target=target,
        lights=lights,
        views=views,
        move=move,
        states=tuple(state or ("neutral",)),
        **select_attributes(scan, "wrapped", "scanner"),
        subsurface=subsurface,
        interreflections=interreflections,
        conditions=parse_amounts(condition or (), "--condition", default=1.0),
    )
    _simulate(order, console, target)


@simulate_app.command("gradient", cls=RigCommand)
@command
def simulate_gradient(
    common: SimulateOptions,
    subject: options.Subject = "III",
    target: Annotated[str | None, target_option("gradient")] = None,
    width: options.Width = None,
    site: options.Site = None,
    angles: options.Angles = None,
    steps: options.Steps = None,
    omit: str | None = None,
    renderer: options.Renderer = "mitsuba",
) -> None:
    """Simulate the gradient sphere: a patch of skin in a caliper, or a target.

    Example: skinrig simulate gradient --out session-gradient --site cheek --angles 0,90

    Parameters
    ----------
    omit
        Visible effects to omit from the simulation, separated by commas: shadows, lateral,
        interreflections, optics, thickness, melanin_depth, oxygenation, scattering, absorption.
    """
    from skinrig.capturing.option_values import parse_floats, parse_names, parse_range
    from skinrig.simulating.orders import GradientOrder

    console = Console(common.json)
    order = GradientOrder(
        **common.request_fields(subject, console),
        target=target,
        width_px=width,
        site=site,
        angles=parse_floats(angles, "--angles"),
        steps=parse_range(steps, "--steps"),
        leave_out=parse_names(omit) or (),
        renderer=cast(Any, renderer),
    )
    _simulate(order, console, target)


@simulate_app.command("probe", cls=RigCommand)
@command
def simulate_probe(
    common: SimulateOptions,
    subject: Annotated[str, typer.Option(autocompletion=completion.complete_subjects)] = "III",
    target: Annotated[str | None, target_option("probe")] = None,
    sites: options.Sites = None,
    repeats: options.Placements = 1,
    angles: options.Directions = None,
    all_brackets: options.AllBrackets = False,
    omit: str | None = None,
    renderer: options.Renderer = "mitsuba",
) -> None:
    """Simulate the fiber probe: tissue at several sites, or a target.

    Example: skinrig simulate probe --out session-probe --sites cheek

    Parameters
    ----------
    subject
        Simulated subject: preset I to VI, palest or darkest, ita:DEGREES, monk:N, a file
        NAME.toml, or a medium, homogeneous:A,S[,G] or anisotropic:A,S[,STRENGTH[,AXIS]] with
        A = sigma_a and S = sigma_s', 1/mm, and AXIS in degrees.
    omit
        Visible effects to omit from the simulation, separated by commas: crosstalk, wings,
        dark_current, thickness, melanin_depth, oxygenation, scattering, absorption.
    """
    from skinrig.capturing.option_values import parse_floats, parse_names
    from skinrig.simulating.orders import ProbeOrder

    console = Console(common.json)
    order = ProbeOrder(
        **common.request_fields(subject, console),
        target=target,
        sites=parse_names(sites),
        repeats=repeats,
        angles=parse_floats(angles, "--angles"),
        all_brackets=all_brackets,
        leave_out=parse_names(omit) or (),
        renderer=cast(Any, renderer),
    )
    _simulate(order, console, target)


def _simulate(order: SimulationOrder, console: Console, target: str | None) -> None:
    """Simulate a request; print the outputs and the next step."""
    from skinrig.simulating.simulation import simulate

    done = simulate(order)
    truth = f", ground truth in {done.truth}" if done.truth else ""
    console.print_line(f"{done.session}: {format_count(done.frames, 'frame')}{truth}")
    console.print_line(f"next: {suggest_after_session(order.rig, order.out, target)}")
    console.print_document("skinrig.simulate/1", done.document())
