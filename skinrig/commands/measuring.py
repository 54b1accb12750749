"""The commands that measure error against run time, and that say what is installed."""

import os
from pathlib import Path
from typing import Annotated

import typer

from skinrig import errors
from skinrig.benchmarks import table as bench_table
from skinrig.commands import completion
from skinrig.commands.options import Json, command
from skinrig.console import Console, select_attributes
from skinrig.doctor import check_installation
from skinrig.kernel_cache import set_passive_waiting

BUDGET_S = 600.0
"""Seconds of a benchmark that names none."""


@command
def bench(
    more: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", show_default=False, autocompletion=completion.stages),
    ] = None,
    /,
    stage: Annotated[list[str] | None, typer.Option(autocompletion=completion.stages)] = None,
    budget: Annotated[float | None, typer.Option(show_default=False)] = None,
    toy: bool = False,
    extremes: bool = False,
    out: Path | None = None,
    json: Json = False,
) -> None:
    """Measure error against run time; exit code 1 when a limit is missed.

    Without --stage every stage is measured at its small size, and then, the quickest first, at full
    size as long as the budget lasts. Limits are judged at full size alone. Nothing is left to
    chance: every stage draws from seeds of its own, the same each time.

    Example: skinrig bench --json --out bench

    Example: skinrig bench --stage chromophores wrinkles --json

    Example: skinrig bench --extremes

    Parameters
    ----------
    toy
        Smallest sizes, no limits judged.
    extremes
        Try stiff and extreme cases instead.
    out
        Folder for bench.json, a table and plots; or extremes.json.
    more
        Stages, like those of --stage; default all.
    stage
        Stage, or several; repeatable.
    budget
        Seconds to spend, about; default 600.
    """
    console = Console(json)
    # one --stage takes one word, so that what follows it comes as arguments
    stages = [*(stage or ()), *(more or ())] or None
    if extremes and (toy or budget is not None):
        what = "--toy" if toy else "--budget"
        raise errors.UsageError(f"{what}: cases of --extremes have one size each; leave it out")
    budget = BUDGET_S if budget is None else budget
    if not budget > 0:
        raise errors.UnusableError(f"--budget: got {budget:g}, expected seconds above 0")
    if out is not None and out.exists() and not out.is_dir():
        raise errors.UnusableError(
            f"--out: {out} is a file, expected a folder, new or to be replaced"
        )
    set_passive_waiting(
        os.environ
    )  # before numerical libraries are loaded: one stage runs at a time
    if extremes:
        from skinrig.reporting.sections.extremes import run_extremes

        document = run_extremes(stages or (), out=out, console=console)
    else:
        from skinrig.benchmarks.stages import run_stages

        document = run_stages(stages, budget_s=budget, toy=toy, out=out, console=console)
        if out is not None:
            bench_table.write(document, out)
    console.document(document.pop("schema"), document)
    if not document["passed"]:
        raise typer.Exit(errors.LIMIT_MISSED)


def doctor(json: Json = False) -> None:
    """Say what is installed, which renderer runs and why, and how to mend what is not.

    Example: skinrig doctor
    """
    console = Console(json)
    findings = check_installation()
    console.rows(
        ("", "what", "state", "to mend"),
        [("ok" if f.fine else "!!", f.what, f.state, f.mend) for f in findings],
    )
    rows = [select_attributes(f, "what", "state", "fine", "mend") for f in findings]
    console.document("skinrig.doctor/1", {"findings": rows})
    if not all(f.fine for f in findings):
        raise typer.Exit(errors.EXTRA_MISSING)
