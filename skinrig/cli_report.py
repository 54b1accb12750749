"""The command that writes the page about what was measured."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from skinrig.cli_options import Json
from skinrig.console import Console


def report(
    paths: Annotated[list[Path], typer.Argument(help="Folders that skinrig wrote.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The page.")] = Path("report.html"),
    json: Json = False,
) -> None:
    """Write one self-contained HTML page about what lies at PATHS.

    Example: skinrig report demo -o report.html
    """
    from skinrig.report import build

    console = Console(json)
    page = build(paths)
    out.write_text(page, encoding="utf-8")
    console.say(f"{out}: {len(page) / 1e6:.2f} MB; open it in a browser")
    console.document("skinrig.report/1", {"path": out, "bytes": len(page)})
