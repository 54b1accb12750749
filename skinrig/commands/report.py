"""The command that writes the page about what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.commands.options import STDOUT, Json, file_to_write
from skinrig.console import Console
from skinrig.errors import UsageError


def report(
    paths: Annotated[list[Path], typer.Argument(help="Folders that skinrig wrote.")],
    out: Annotated[
        Path,
        typer.Option(
            "-o", "--out", callback=file_to_write, help="The page; - is the standard output."
        ),
    ] = Path("report.html"),
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

    piped = str(out) == STDOUT
    if piped and json:
        raise UsageError("--out: got '-' with --json, whose document goes there; name a file")
    console = Console(json)
    talk = Console(json or piped)  # where the page goes nothing else does
    done = make(paths, compare=compare)
    if piped:
        typer.echo(done.html, nl=False)
    else:
        write_page(out, done.html)
    size = len(done.html.encode())
    if done.compared is None:
        talk.say(done.verdict)
    else:
        talk.say(f"compared {' with '.join(done.compared)}; --no-compare shows all of both")
    if not piped:
        talk.say(f"{out}: {size / 1e6:.2f} MB; open it in a browser")
    missed = sum(not check.passed for check in done.checks)
    console.document(
        "skinrig.report/1",
        {
            "path": out,
            "bytes": size,
            "checks": len(done.checks),
            "missed": missed,
            "compared": done.compared,
        },
    )
