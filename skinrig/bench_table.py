"""What a benchmark prints and writes beside its JSON: tables, verdicts, one plot a stage."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skinrig.console import Console

_COLUMNS = (
    "seconds", "cold_seconds", "peak_memory_mb", "error", "cramer_rao_bound", "efficiency",
)  # fmt: skip


def show(document: Mapping[str, Any], console: Console) -> None:
    """Print each stage's points and limits, then one line a stage and what was not judged.

    Parameters
    ----------
    document
        ``skinrig.bench/1``, as `skinrig.bench_stages.run_stages` makes it.
    console
        Where it is printed.
    """
    for name, stage in document["stages"].items():
        console.rows(
            (f"{name} ({stage['size']} size)", "seconds", "cold s", "peak MB",
             stage["error_name"], "Cramér-Rao", "efficiency", ""),
            [
                (knobs(point), *(_cell(point[key]) for key in _COLUMNS), _place(point))
                for point in stage["points"]
            ],
        )  # fmt: skip
        for limit in stage["limits"]:
            word = "kept" if limit["passed"] else "MISSED"
            console.say(
                f"{word}: {limit['name']}: {limit['got']:.4g} {limit['unit']} "
                f"({limit['sense']} {limit['bound']:g})"
            )
        for what, why in stage["left_out"]:
            console.say(f"left out: {what}: {why}")
        console.say()
    console.rows(
        ("stage", "size", "points", "least error", "knee", "knee s", "best efficiency", "limits"),
        [_line(name, stage) for name, stage in document["stages"].items()],
    )
    for name, why in document["left_out"]:
        console.say(f"left out: {name}: {why}")
    if document["not_judged"]:
        console.say(
            "limits not judged, since measured at small size: "
            f"{', '.join(document['not_judged'])}; `skinrig bench --stage NAME` judges them"
        )


def write(document: Mapping[str, Any], out: Path) -> None:
    """Write one table of all points, ``bench.csv``, and a plot ``NAME.svg`` for each stage.

    Parameters
    ----------
    document
        ``skinrig.bench/1``.
    out
        Folder; made if it is missing.
    """
    from skinrig import figures

    out.mkdir(parents=True, exist_ok=True)
    with (out / "bench.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            ("stage", "size", "setting", "error is", *_COLUMNS, "low", "high", "front", "knee")
        )
        for name, stage in document["stages"].items():
            for point in stage["points"]:
                table.writerow(
                    (name, stage["size"], knobs(point), stage["error_name"],
                     *(point[key] for key in _COLUMNS), *point["error_interval"],
                     point["on_front"], point["knee"])
                )  # fmt: skip
    for name, stage in document["stages"].items():
        if stage["points"]:
            plot = figures.error_against_seconds(name, stage)
            (out / f"{name}.svg").write_text(plot + "\n", encoding="utf-8")


def knobs(point: Mapping[str, Any]) -> str:
    """Return what a point's knobs were set to, on one line.

    Examples
    --------
    >>> knobs({"knobs": {"lights": 12, "fit": "robust"}})
    'lights=12 fit=robust'
    """
    return " ".join(f"{name}={value}" for name, value in point["knobs"].items())


def _cell(value: float | None) -> float | str:
    return "" if value is None else float(value)


def _place(point: Mapping[str, Any]) -> str:
    if point["knee"]:
        return "front, knee"
    return "front" if point["on_front"] else ""


def _line(name: str, stage: Mapping[str, Any]) -> tuple[object, ...]:
    points = stage["points"]
    bend = next((point for point in points if point["knee"]), None)
    known = [point["efficiency"] for point in points if point["efficiency"] is not None]
    missed = sum(not limit["passed"] for limit in stage["limits"])
    verdict = f"{missed} MISSED" if missed else f"{len(stage['limits'])} kept"
    return (
        name, stage["size"], len(points),
        min((float(point["error"]) for point in points), default=""),
        knobs(bend) if bend else "", bend["seconds"] if bend else "",
        min(known) if known else "", verdict if stage["size"] == "full" else "not judged",
    )  # fmt: skip
