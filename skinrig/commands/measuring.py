"""`skinrig bench`, `skinrig soak`, `skinrig study`, `skinrig doctor`: errors, faults, checks."""

import os
from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.benchmarks import table as bench_table
from skinrig.command_line import completion, options
from skinrig.command_line.options import Json, Out, Seed, command
from skinrig.command_line.renamed_options import FORMER_STAGES, replace_former_values
from skinrig.console import Console, select_attributes
from skinrig.doctor import FIX_KEY, check_controller, check_installation
from skinrig.kernel_cache import set_passive_waiting

BUDGET_S = 600.0
"""Default time of a benchmark."""
END_TO_END_STAGE = "end-to-end"
"""Stage of whole captures."""


@command
def bench(
    more: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME", show_default=False, autocompletion=completion.complete_stages
        ),
    ] = None,
    /,
    stage: Annotated[
        list[str] | None, typer.Option(autocompletion=completion.complete_stages)
    ] = None,
    budget: Annotated[float | None, typer.Option(show_default=False)] = None,
    smoke: bool = False,
    extremes: bool = False,
    end_to_end: str = "",
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Measure error against run time; exit code 1 if a limit is missed.

    Without --stage, all stages run at small size, then at full size, the fastest first, until the
    budget is spent. Limits apply at full size only. Each stage uses fixed seeds of its own, so
    results are reproducible.

    Example: skinrig bench --json --out bench

    Example: skinrig bench --stage chromophores wrinkles --json

    Example: skinrig bench --extremes

    Example: skinrig bench --end-to-end flash --out bench

    Parameters
    ----------
    smoke
        Run the smallest sizes only, without limits.
    extremes
        Run stiff and extreme cases instead of stages.
    end_to_end
        Rig whose errors of maps to measure against seconds from planning to maps: dome,
        flash, gradient or probe; default: none.
    out
        Folder for bench.json, whose finished stages are kept, a table and plots, or for
        extremes.json; default: no files.
    more
        Stages to run, as with --stage; default: all.
    stage
        Stage to run; repeatable, further names may follow; default: all.
    budget
        Approximate time limit, seconds; default 600.
    """
    console = Console(json)
    # --stage takes one word only, so the names that follow it arrive as arguments
    stages = [*(stage or ()), *(more or ())] or None
    stages = replace_former_values(stages, FORMER_STAGES) if stages else None
    if end_to_end:
        if stages:
            raise errors.UsageError("--end-to-end: not an option of --stage; remove one")
        stages = [END_TO_END_STAGE]
    if extremes and (smoke or budget is not None or end_to_end):
        what = "--smoke" if smoke else "--end-to-end" if end_to_end else "--budget"
        raise errors.UsageError(f"{what}: not an option of --extremes; remove it")
    budget = BUDGET_S if budget is None else budget
    if not budget > 0:
        raise errors.UnusableError(f"--budget: got {budget:g}, expected seconds above 0; raise it")
    if out is not None and out.exists() and not out.is_dir():
        raise errors.UnusableError(f"--out: {out} is a file, expected a folder; name another")
    set_passive_waiting(
        os.environ
    )  # before numerical libraries are loaded: one stage runs at a time
    if extremes:
        from skinrig.reporting.sections.extremes import run_extremes

        document = run_extremes(stages or (), out=out, console=console)
    else:
        from skinrig.benchmarks.stages import run_stages
        from skinrig.resources.forecast import forecast_resources, require_resources

        need = forecast_resources("bench small" if smoke else "bench full", {})
        require_resources("bench", need, out or Path())
        document = run_stages(
            stages, budget_s=budget, toy=smoke, out=out, console=console, selection=end_to_end
        )
        if out is not None:
            bench_table.write_tables(document, out)
    missed = [
        name
        for name, found in document.get("stages", {}).items()
        if not all(limit["passed"] for limit in found["limits"])
    ]
    console.print_each("repeat", (f"skinrig bench --stage {name}" for name in missed))
    console.print_document(document.pop("schema"), document)
    if not document["passed"]:
        raise typer.Exit(errors.EXIT_LIMIT_MISSED)


@command
def soak(
    seed: Seed = 0,
    hours: float = 24.0,
    first_day: int = 0,
    budget: Annotated[float | None, typer.Option(show_default=False)] = None,
    json: Json = False,
) -> None:
    """Run simulated rigs under seeded faults; exit code 1 if a promise is broken.

    Hosts, controllers, cameras, lines, disk and clock are simulated in one process. The seed
    determines every fault; a failure names the command that repeats it.

    Example: skinrig soak --seed 7 --hours 240

    Parameters
    ----------
    hours
        Simulated time, hours; whole days with 200 frames each.
    first_day
        Number of the first day; a day depends on the seed and its number alone.
    budget
        Processor time after which no further day begins, seconds; default: no limit.
    """
    from skinrig.soaking.soak import run_soak

    console = Console(json)
    for name, value in (("--seed", seed), ("--hours", hours), ("--first-day", first_day)):
        if not 0 <= value < float("inf"):
            raise errors.UnusableError(f"{name}: got {value:g}, expected 0 or more; raise it")
    if budget is not None and not budget > 0:
        raise errors.UnusableError(f"--budget: got {budget:g}, expected seconds above 0; raise it")
    result = run_soak(
        seed,
        hours=hours,
        first_day=first_day,
        budget_s=float("inf") if budget is None else budget,
        progress=console.progress,
    )
    figures = select_attributes(
        *(result, "seed", "days", "shots", "sessions", "runs", "power_cuts", "digest", "failure"),
        *("processor_s", "codes", "faults"),
    )
    rows = [(name, figures[name]) for name in ("days", "shots", "sessions", "runs", "power_cuts")]
    console.print_table(("what", "number"), [*rows, ("faults", result.faults.total())])
    console.print_line(f"seed {seed}, digest {result.digest}")
    console.print_line(f"BROKEN: {result.failure}" if result.failure else "all promises kept")
    console.print_document("skinrig.soak/1", figures)
    if result.failure:
        raise typer.Exit(errors.EXIT_LIMIT_MISSED)


@command
def study(
    description: Annotated[Path, typer.Argument(metavar="STUDY.toml")],
    /,
    out: Out,
    executor: options.ExecutorName = "threads",
    keep: bool = False,
    json: Json = False,
) -> None:
    """Simulate, reconstruct and judge many cases; write a table and a report by skin type.

    A case that has a result is not computed again, so that an interrupted study continues. A case
    that fails is a row with its error, and runs again with the next command.

    Example: skinrig study study.toml --out study --executor local:4

    Parameters
    ----------
    description
        TOML file of subjects, seeds, rigs and sizes, see docs/how-to/run-a-study.md.
    keep
        Keep sessions, calibrations and maps of the cases; default: they are deleted after judging.
    """
    from skinrig.studies.description import read_study
    from skinrig.studies.study import describe_run, run_study

    console = Console(json)
    described = read_study(description)
    run = run_study(described, out, executor=executor, keep=keep, progress=console.progress)
    figures = describe_run(run)
    console.print_each("failed", (f"{run.cases[k].name}: {e}" for k, e in run.errors.items()))
    names = ("cases", "ran", "reused", "processor_s")
    rows = [(name.replace("_", " "), figures[name]) for name in names]
    console.print_table(("quantity", "number"), [*rows, ("failed", len(run.errors))])
    console.print_line(f"{out}: report.html, study.csv; open the report in a browser")
    console.print_document("skinrig.study_run/1", {"path": out, **figures})


def doctor(
    port: Annotated[
        str, typer.Option(metavar="URL", help="judge the controller at this port instead")
    ] = "",
    json: Json = False,
) -> None:
    """Check the installation: packages, renderer, threads and ports, and how to fix faults.

    With a port it judges the controller there: identity, clock, latency, lease and refusals.

    Example: skinrig doctor --port /dev/ttyUSB0
    """
    console = Console(json)
    findings = check_controller(port) if port else check_installation()
    console.print_table(
        ("", "what", "state", "fix"),
        [("ok" if f.fine else "!!", f.what, f.state, f.fix) for f in findings],
    )
    rows = [{**select_attributes(f, "what", "state", "fine"), FIX_KEY: f.fix} for f in findings]
    console.print_document("skinrig.doctor/2", {"findings": rows})
    if not all(f.fine for f in findings):
        raise typer.Exit(errors.EXIT_DEVICE_FAILED if port else errors.EXIT_EXTRA_MISSING)
