"""The command that writes the page about what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands.options import Json, Page
from skinrig.console import Console


def report(
    paths: Annotated[list[Path], typer.Argument(help="Folders that skinrig wrote.")],
    out: Page = Path("report.html"),
    compare: Annotated[
        bool | None,
        typer.Option(
            "--compare/--no-compare",
            help="Put two runs side by side; default: where PATHS are exactly two of one kind.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Write one self-contained HTML page about what lies at PATHS.

    Two sets of maps, two benchmarks, two folders of pictures or two of runs are compared; truths
    beside them serve both. Anything else is shown one after the other.

    Example: skinrig report demo -o report.html

    Example: skinrig report monday tuesday -o difference.html
    """
    from skinrig.report import make
    from skinrig.reporting.folders import write_page

    console = Console(json)
    done = make(paths, compare=compare)
    write_page(out, done.html)
    size = len(done.html.encode())
    if done.compared is None:
        console.say(done.verdict)
    else:
        console.say(f"compared {' with '.join(done.compared)}; --no-compare shows all of both")
    console.say(f"{out}: {size / 1e6:.2f} MB; open it in a browser")
    missed = sum(not check.passed for check in done.checks)
    console.document(
        "skinrig.report/1",
        {
            "path": out, "bytes": size, "checks": len(done.checks), "missed": missed,
            "compared": done.compared,
        },
    )  # fmt: skip
