"""Print and write the tables, verdicts and plots of a benchmark."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from skinrig.atomic_file import write_atomically
from skinrig.console import Console
from skinrig.unit_format import format_csv

_POINT_COLUMNS = (
    "seconds",
    "cold_seconds",
    "peak_memory_mb",
    "error",
    "cramer_rao_bound",
    "efficiency",
)

BAND_COLUMNS = (
    "stage",
    "skin",
    "error",
    "68 % low",
    "68 % high",
    "Cramér-Rao bound",
    "over lightest",
    "quantity",
)
"""Columns of the errors by band; "over lightest" is the error over that of the lightest band."""

KNEE_COLUMNS = ("stage", "curve", "points", "knee", "seconds", "error")
"""Columns of the knees of curves of error against seconds."""

MIN_KNEE_POINTS = 3
"""Fewest points of a curve that can have a knee."""

NO_KNEE = "none: the error decreases up to the longest time"

FRONT_MEANS = (
    "Pareto front: no other setting is both faster and more accurate; knee: more time beyond it "
    "improves the error least"
)


def print_tables(document: Mapping[str, Any], console: Console) -> None:
    """Print each stage's points and limits, a summary line per stage, and omitted stages.

    Parameters
    ----------
    document
        Schema ``skinrig.bench/2``, from `skinrig.benchmarks.stages.run_stages`.
    console
        Receives the tables.
    """
    for name, stage in document["stages"].items():
        console.print_table(
            (
                f"{name} ({stage['size']} size)",
                "seconds",
                "cold s",
                "peak MB",
                stage["error_name"],
                "Cramér-Rao",
                "efficiency",
                "",
            ),
            [
                (format_knobs(point), *(_cell(point[key]) for key in _POINT_COLUMNS), _place(point))
                for point in stage["points"]
            ],
        )
        for limit in stage["limits"]:
            word = "kept" if limit["passed"] else "MISSED"
            console.print_line(
                f"{word}: {limit['name']}: {limit['got']:.4g} {limit['unit']} "
                f"({limit['sense']} {limit['bound']:g})"
            )
        for what, why in stage["left_out"]:
            console.print_line(f"omitted: {what}: {why}")
        console.print_line()
    console.print_table(
        (
            "stage",
            "size",
            "points",
            "fronts",
            "least error",
            "knee",
            "knee s",
            "best efficiency",
            "limits",
        ),
        [_line(name, stage) for name, stage in document["stages"].items()],
    )
    if any(stage["fronts"] for stage in document["stages"].values()):
        console.print_line(FRONT_MEANS)
    if found := list_band_rows(document):
        console.print_line()
        console.print_table(BAND_COLUMNS, found)
    for name, why in document["left_out"]:
        console.print_line(f"omitted: {name}: {why}")
    if document["not_judged"]:
        console.print_line(
            "limits not evaluated, measured at small size: "
            f"{', '.join(document['not_judged'])}; run `skinrig bench --stage NAME` to evaluate "
            "them"
        )


def list_band_rows(document: Mapping[str, Any]) -> list[tuple[object, ...]]:
    """Return rows of :data:`BAND_COLUMNS`: errors of each stage, from light to dark skin."""
    rows: list[tuple[object, ...]] = []
    for name, stage in document["stages"].items():
        first = stage["by_band"][0]["error"] if stage["by_band"] else None
        for one in stage["by_band"]:
            low, high = one["error_interval"] or (None, None)
            of_light = one["error"] / first if first else None
            rows.append(
                (
                    name,
                    one["band"],
                    one["error"],
                    _cell(low),
                    _cell(high),
                    _cell(one["cramer_rao_bound"]),
                    _cell(of_light),
                    stage["error_name"],
                )
            )
    return rows


def list_knee_rows(document: Mapping[str, Any]) -> list[tuple[object, ...]]:
    """Return rows of :data:`KNEE_COLUMNS`: the knee of each condition with 3 points or more."""
    rows: list[tuple[object, ...]] = []
    for name, stage in document["stages"].items():
        for front in stage["fronts"]:
            condition = front["condition"]
            of_it = [p for p in stage["points"] if condition.items() <= p["knobs"].items()]
            if len(of_it) < MIN_KNEE_POINTS:
                continue
            curve = (name, format_knobs({"knobs": condition}), len(of_it))
            if front["knee"] is None:
                rows.append((*curve, NO_KNEE, "", ""))
                continue
            bend = stage["points"][front["knee"]]
            effort = {k: v for k, v in bend["knobs"].items() if k not in condition}
            setting = format_knobs({"knobs": effort})
            rows.append((*curve, setting, bend["seconds"], bend["error"]))
    return rows


def write_tables(document: Mapping[str, Any], out: Path) -> None:
    """Write the table of all points, the table by melanin band, and one plot per stage.

    Parameters
    ----------
    document
        ``skinrig.bench/2``.
    out
        Folder for ``bench.csv``, ``bench-bands.csv`` and ``NAME.svg``; created if missing.
    """
    from skinrig.benchmarks import figures as bench_figures

    out.mkdir(parents=True, exist_ok=True)
    rows = [
        (
            name,
            stage["size"],
            format_knobs(point),
            stage["error_name"],
            *(point[key] for key in _POINT_COLUMNS),
            *point["error_interval"],
            point["on_front"],
            point["knee"],
        )
        for name, stage in document["stages"].items()
        for point in stage["points"]
    ]
    head = ("stage", "size", "setting", "error is", *_POINT_COLUMNS, "low", "high", "front", "knee")
    write_atomically(out / "bench.csv", format_csv([head, *rows]))
    write_atomically(out / "bench-bands.csv", format_csv([BAND_COLUMNS, *list_band_rows(document)]))
    for name, stage in document["stages"].items():
        if stage["points"]:
            plot = bench_figures.plot_error_against_time(name, stage)
            write_atomically(out / f"{name}.svg", plot + "\n")


def format_knobs(point: Mapping[str, Any]) -> str:
    """Format the settings of a point on one line.

    Examples
    --------
    >>> format_knobs({"knobs": {"lights": 12, "fit": "robust"}})
    'lights=12 fit=robust'
    """
    return " ".join(f"{name}={value}" for name, value in point["knobs"].items())


def _cell(value: float | None) -> float | str:
    return "" if value is None else float(value)


def _place(point: Mapping[str, Any]) -> str:
    if point["knee"]:
        return "Pareto front, knee"
    return "Pareto front" if point["on_front"] else ""


def _line(name: str, stage: Mapping[str, Any]) -> tuple[object, ...]:
    points = stage["points"]
    knees = [point for point in points if point["knee"]]
    bend = knees[0] if len(knees) == 1 else None
    known = [point["efficiency"] for point in points if point["efficiency"] is not None]
    missed = sum(not limit["passed"] for limit in stage["limits"])
    verdict = f"{missed} MISSED" if missed else f"{len(stage['limits'])} kept"
    count = f"{len(knees)}, one per condition" if len(knees) > 1 else ""
    return (
        name,
        stage["size"],
        len(points),
        len(stage["fronts"]),
        min((float(point["error"]) for point in points), default=""),
        format_knobs(bend) if bend else count,
        bend["seconds"] if bend else "",
        min(known) if known else "",
        verdict if stage["size"] == "full" else "not evaluated",
    )
