"""`skinrig plan`: minimal acquisitions for required errors, one command per rig."""

import json as json_text
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.atomic_file import write_atomically
from skinrig.command_line.help import RigCommand, RigGroup
from skinrig.command_line.options import Bands, Json, Subject, check_output_file, command, option
from skinrig.console import Console, select_attributes
from skinrig.next_steps import shell_quote
from skinrig.unit_format import format_quantity

plan_app = typer.Typer(
    cls=RigGroup,
    subcommand_metavar="RIG [ARGS]...",
    help="Choose the smallest plan that reaches given errors, and list what it omits.",
)


def _goals_option(example: str) -> typer.models.OptionInfo:
    """Return the option --goals of a rig."""
    return option(
        f"Median errors to reach: {example}; default: forecast the errors of the complete rig, "
        "or of --forecast."
    )


PlanWidth = Annotated[
    int | None, option("Image width of the cameras, pixels; default: the rig's own.", "--width")
]


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """Options of every choice of a plan.

    Attributes
    ----------
    budget
        Minimize the error within this time from planning to maps, seconds or minutes, such as 60s
        or 5min; default: no limit.
    min_valid_fraction
        Minimum fraction of the complete rig's valid pixels that stay valid, above 0, at most 1.
    forecast
        Forecast the errors of this plan file, JSON, instead of choosing a plan.
    confirm
        Simulate and reconstruct the plan in this folder, and compare with the forecast.
    seed
        Random seed of the simulated face.
    out
        Plan file to write, JSON; default: print only.
    """

    subject: Subject = "III"
    budget: str = ""
    min_valid_fraction: float = 0.9
    forecast: Path | None = None
    out: Annotated[Path | None, typer.Option("--out", callback=check_output_file)] = None
    confirm: Path | None = None
    seed: int = 0
    json: Json = False


@plan_app.command("dome", cls=RigCommand)
@command
def plan_dome(
    common: PlanOptions,
    goals: Annotated[str, _goals_option("normals<=1deg,r_d<=3%")] = "",
    width: PlanWidth = None,
    max_lights: int | None = None,
) -> None:
    """Choose the fewest lights and cameras of the dome that reach given errors.

    Example: skinrig plan dome --goals "normals<=1deg,r_d<=3%" --out plan.json

    Example: skinrig plan dome --forecast plan.json

    Example: skinrig plan dome --budget 60s --width 200

    Parameters
    ----------
    max_lights
        Maximum number of lights; default: all.
    """
    _plan("dome", common, goals, width, max_lights)


@plan_app.command("flash", cls=RigCommand)
@command
def plan_flash(
    common: PlanOptions,
    goals: Annotated[str, _goals_option("melanin<=12%,hemoglobin<=25%")] = "",
    width: PlanWidth = None,
    bands: Bands = None,
) -> None:
    """Choose the fewest image pairs and flash powers of the flash rig that reach given errors.

    With --bands, a table lists what each LED adds on light, medium and dark skin.

    Example: skinrig plan flash --goals "melanin<=12%,hemoglobin<=25%" --subject II

    Example: skinrig plan flash --bands 450,580,600 --out plan.json

    Example: skinrig plan flash --budget 60s --width 640
    """
    from capture.plan.led_bands import parse_bands

    _plan("flash", common, goals, width, leds=parse_bands(bands) if bands else ())


@plan_app.command("gradient", cls=RigCommand)
@command
def plan_gradient(
    common: PlanOptions,
    goals: Annotated[str, _goals_option("normals<=2deg")] = "",
    width: PlanWidth = None,
) -> None:
    """Choose the shortest scan of the gradient sphere that reaches given errors.

    Example: skinrig plan gradient --goals "normals<=2.5deg" --out plan.json
    """
    _plan("gradient", common, goals, width)


@plan_app.command("probe", cls=RigCommand)
@command
def plan_probe(
    common: PlanOptions, goals: Annotated[str, _goals_option("sigma_tr<=3%")] = ""
) -> None:
    """Choose the fewest sites, placements and brackets of the probe that reach given errors.

    Example: skinrig plan probe --goals "sigma_tr<=4%" --out plan.json
    """
    _plan("probe", common, goals)


def _plan(
    rig: str,
    common: PlanOptions,
    goals: str,
    width: int | None = None,
    max_lights: int | None = None,
    leds: tuple[str, ...] = (),
) -> None:
    """Choose a plan, print its forecast and write it."""
    from skinrig.planning.plans import choose, format_choice
    from skinrig.planning.time_budget import parse_budget
    from skinrig.simulating.subject_records import find_unused_subject_keys

    console = Console(common.json)
    subject, seed = common.subject, common.seed
    if not 0 < common.min_valid_fraction <= 1:
        raise errors.UnusableError(
            f"--min-valid-fraction: got {common.min_valid_fraction:g}, expected above 0 and at "
            "most 1; give 0.9, for example"
        )
    unused = find_unused_subject_keys(subject, rig, console.progress)
    asked = select_attributes(common, "subject", "seed", "forecast")
    choice = choose(
        rig,
        goals,
        width_px=width,
        max_lights=max_lights,
        min_valid_fraction=common.min_valid_fraction,
        budget_s=parse_budget(common.budget) if common.budget else None,
        leds=leds,
        **asked,
    )
    for line in format_choice(choice):
        console.print_line(line)
    document = choice.to_document()
    if unused:
        document["subject_unused"] = list(unused)
    reached = choice.reached
    if common.confirm is not None:
        from skinrig.planning.confirmation import confirm_choice

        found = confirm_choice(
            choice, common.confirm, subject=subject, seed=seed, progress=console.progress
        )
        document["confirmation"] = found
        for row in found:
            console.print_line(
                f"measured: {row['name']}"
                f" {format_quantity(format(row['median'], '.3g'), row['unit'])}, "
                f"{'within' if row['within'] else 'OUTSIDE'} the forecast's interval"
            )
    if (out := common.out) is not None:
        write_atomically(out, json_text.dumps(choice.plan.to_json(), indent=1) + "\n")
        console.print_line(f"next: skinrig capture {rig} --plan {shell_quote(out)} --out session")
    console.print_document(document.pop("schema"), document)
    if not reached:
        raise typer.Exit(errors.EXIT_LIMIT_MISSED)
