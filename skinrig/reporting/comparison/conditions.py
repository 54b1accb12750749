"""What two runs were made with, as far as it differs: settings, calibrations, times."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from capture.calibration import store as calibrations
from capture.calibration.record import CalibrationError
from skinrig.benchmarks import figures as bench_figures
from skinrig.benchmarks.document import SCHEMA
from skinrig.reporting import folders as report_folders
from skinrig.reporting import page, provenance
from skinrig.reporting.comparison.runs import Pair, Run

MAX_LISTED_DRIFTS = 3
"""Quantities told of each kind of calibration."""


def settings(a: Run, b: Run, pair: Pair) -> Iterator[page.Block]:
    """Yield what the two were made with, as far as it differs."""
    sides = []
    for side in (pair.a, pair.b):
        told = {f"parameter {k}": v for k, v in provenance.flattened(side.parameters).items()}
        told |= {f"input {k}": provenance.short(v) for k, v in side.inputs.items()}
        told |= {f"version of {k}": v for k, v in side.versions.items()}
        told |= {"source": side.source, "seed": str(side.seed)}
        told |= {f"left out: {what}": why for what, why in side.left_out}
        sides.append(told)
    rows = unequal(*sides)
    stages = [row for row in rows if row[0].startswith("parameter stages.")]
    rest = [row for row in rows if not row[0].startswith("parameter stages.")]
    yield page.Heading("What differs in the making")
    if not rows:
        yield page.note("Parameters, inputs, versions and seeds are the same.")
        return
    if rest:
        yield page.table(("what", a.label, b.label), rest, caption="Settings that are not equal")
    if stages:
        names = ", ".join(row[0].removeprefix("parameter stages.") for row in stages)
        yield page.note(f"Stages whose code, settings or inputs differ: {names}.")


def unequal(a: Mapping[str, str], b: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Return the entries that differ, with a dash where one lacks them."""
    return [
        (key, a.get(key, "–"), b.get(key, "–"))
        for key in sorted({*a, *b})
        if a.get(key) != b.get(key)
    ]


def benchmarks(a: Run, b: Run) -> Iterator[page.Block]:
    """Yield seconds and errors of settings that both measured, and a plot a stage."""
    documents = [_bench_of(run) for run in (a, b)]
    if documents[0] is None or documents[1] is None:
        return
    rows, plots = [], []
    for name, stage in documents[0]["stages"].items():
        other = documents[1]["stages"].get(name)
        if other is None or stage.get("size") != other.get("size"):
            continue
        rows += _settings_of_stage(name, stage, other)
        if stage["points"] and other["points"]:
            plots.append(bench_figures.compared_fronts(name, (a.label, stage), (b.label, other)))
    if not rows:
        return
    machines = unequal(
        *(provenance.flattened(document.get("machine", {})) for document in documents if document)
    )
    yield page.Heading("Error against run time", level=2)
    yield page.Plots(plots)
    if machines:
        yield page.table(
            ("machine", a.label, b.label),
            machines,
            caption="Measured on different machines: seconds compare those, too",
        )
    yield page.view("compared_benchmarks", settings=rows)


def _bench_of(run: Run) -> dict[str, Any] | None:
    for path in run.found.documents:
        document = report_folders.read_json(path)
        if document["schema"] == SCHEMA:
            return document
    return None


def _settings_of_stage(
    name: str, stage: Mapping[str, Any], other: Mapping[str, Any]
) -> list[tuple[object, ...]]:
    known = {str(point["knobs"]): point for point in other["points"]}
    rows: list[tuple[object, ...]] = []
    for point in stage["points"]:
        match = known.get(str(point["knobs"]))
        if match is not None:
            (low, high), (low_b, high_b) = point["error_interval"], match["error_interval"]
            rows.append((name, point, match, high < low_b or high_b < low))
    return rows


def seconds(a: Run, b: Run) -> Iterator[page.Block]:
    """Yield the seconds that documents of both, such as a demo's, tell by step."""
    sides = [dict(_steps(run)) for run in (a, b)]
    common = [step for step in sides[0] if step in sides[1]]
    if not common:
        return
    rows: list[tuple[object, ...]] = [
        (step, sides[0][step], sides[1][step], sides[1][step] - sides[0][step]) for step in common
    ]
    total = [sum(side[step] for step in common) for side in sides]
    rows.append(("all of these", total[0], total[1], total[1] - total[0]))
    yield page.Heading("Seconds", level=2)
    yield page.table(
        ("step", a.label, b.label, "difference"),
        rows,
        caption="Wall-clock seconds of steps that both tell; other work of the machine is in them",
    )


def _steps(run: Run) -> Iterator[tuple[str, float]]:
    for path in run.found.documents:
        for entry in report_folders.read_json(path).get("tables", ()):
            if list(entry["head"]) == ["step", "seconds"]:
                yield from ((str(step), float(seconds)) for step, seconds in entry["rows"])


def moved_calibrations(a: Run, b: Run) -> Iterator[page.Block]:
    """Yield what moved most between calibrations of the same folder and kind."""
    folders: dict[str, Path] = {path.name: path for path in b.found.calibrations}
    rows: list[tuple[object, ...]] = []
    for folder in a.found.calibrations:
        if folder.name not in folders:
            continue
        for path in sorted(folder.glob("*.json")):
            try:
                old = calibrations.load(folder, path.stem)
                new = calibrations.load(folders[folder.name], path.stem)
                moved = [one for one in calibrations.drift(old, new) if one.change != 0.0]
            except (CalibrationError, ValueError) as error:
                rows.append((f"{folder.name}, {path.stem}", "", "", "", "", "", str(error)))
                continue
            for one in moved[:MAX_LISTED_DRIFTS]:
                apart = float("nan") if one.sigmas is None else one.sigmas
                moves = (one.serial, one.name, one.old, one.new, apart, f"{len(moved)} moved")
                rows.append((f"{folder.name}, {path.stem}", *moves))
    if not rows:
        return
    yield page.Heading("Calibrations that moved", level=2)
    yield page.table(
        ("calibration", "device", "quantity", "A", "B", "in combined standard errors", "remark"),
        rows,
        caption="The farthest of each kind",
    )
