"""The table of extremes: run, printed, written, and as a section of the report."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from skinrig.atomic_file import write_atomically
from skinrig.console import Console, to_json_value
from skinrig.extremes.cases import INPUT_PRECISIONS, SCHEMA, run_cases, to_document
from skinrig.reporting import page

__all__ = ["SCHEMA", "run_extremes", "section"]


def run_extremes(
    stages: Sequence[str], *, out: Path | None = None, console: Console
) -> dict[str, Any]:
    """Try every extreme, print the table and return the document.

    Parameters
    ----------
    stages
        As in `skinrig.extremes.cases.run_cases`; empty: all.
    out
        Folder for ``extremes.json``; None writes nothing.
    console
        Output of results and progress.

    Raises
    ------
    ValueError
        If a stage has no cases.
    """
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # fails before the computation if not possible
    document = to_document(
        run_cases(stages, progress=lambda name: console.progress(f"extreme: {name}"))
    )
    for case in document["cases"]:
        console.print_line(
            f"{'held' if case['passed'] else 'FAILED'}: {case['stage']}: {case['name']} "
            f"({case['extreme']}); expected: {case['expected']}"
        )
        for name in INPUT_PRECISIONS:
            if not case["passed"] or name == "float64":
                console.print_line(f"    {name}: {case[name]['got']}")
    failed = sum(not case["passed"] for case in document["cases"])
    console.print_line(f"{len(document['cases'])} extremes, {failed or 'none'} failed")
    if out is not None:
        text = json.dumps(to_json_value(document), indent=1, sort_keys=True)
        write_atomically(out / "extremes.json", text + "\n")
    return document


def section(document: Mapping[str, Any], checks: list[page.Check]) -> Iterator[page.Block]:
    """Yield the table of extreme cases, and add their check."""
    cases = document["cases"]
    failed = sum(not case["passed"] for case in cases)
    again = "skinrig bench --extremes"
    note = f"of {len(cases)}"
    checks.append(page.Check("failed extreme cases", failed, 0, "<=", "", note, command=again))
    rows = [
        (
            f"{case['stage']}: {case['name']}",
            f"{case['extreme']}: {case['danger']}",
            case["expected"],
            *(
                ("" if case[name]["passed"] else "FAILED: ") + case[name]["got"]
                for name in INPUT_PRECISIONS
            ),
        )
        for case in cases
    ]
    yield page.Heading("Extreme cases", level=2)
    yield page.build_table(
        ("case", "extreme and its risk", "expected", *INPUT_PRECISIONS),
        rows,
        caption=f"{len(cases)} cases in both precisions, {failed or 'none'} failed",
    )
