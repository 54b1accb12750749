"""Report section on a study: error and coverage of each map by part of the cases."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from skinrig.benchmarks.intervals.coverage import COVERAGE_RANGES, FALSE_ALARM_RATE
from skinrig.drawing import figures
from skinrig.reporting import page
from skinrig.unit_format import format_unit

SCHEMA_FAMILY: Final = "skinrig.study_results"


def is_study(document: Mapping[str, Any]) -> bool:
    """Return whether a document is that of a study."""
    return str(document.get("schema", "")).startswith(f"{SCHEMA_FAMILY}/")


def section(document: Mapping[str, Any], checks: list[page.Check]) -> Iterator[page.Block]:
    """Yield figures and tables of a study, and add its coverages to the checks.

    Parameters
    ----------
    document
        ``skinrig.study_results/1``.
    checks
        Checks of the report.
    """
    yield page.Heading(str(document["title"]), level=2)
    rows = document["quantities"]
    failed = document["failed"]
    yield page.Paragraph(
        f"{document['cases']} cases, {len(failed) or 'none'} failed. {_count_verdicts(rows)}"
    )
    yield page.Paragraph(
        "A coverage is the mean, over cases, of the fraction of ground truths inside the stated "
        f"intervals. {_describe_ranges()} Verdicts: kept, the coverage is in its range; open, only "
        "a part of its interval is, as cases are few; missed, the whole interval is outside. If "
        "all intervals are correct, any verdict is missed with a probability of "
        f"{100 * FALSE_ALARM_RATE:g} % at most."
    )
    for row in rows:
        _check_coverage(row, checks)
    by_quantity: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_quantity.setdefault(row["quantity"], []).append(row)
    for quantity, own in by_quantity.items():
        yield page.Plots(_draw(quantity, own))
    yield page.build_table(
        ("map", "cases of", "cases", "median error", "half width", "unit", *_coverage_titles()),
        [_table_row(row) for row in rows],
        caption="Error and coverage by skin type, age of the calibration and ISO",
    )
    if failed:
        table = page.build_table(
            ("case", "error"), [(one["case"], one["error"]) for one in failed], caption="Failures"
        )
        yield page.Collapsible(f"{len(failed)} cases failed", [table])


def _count_verdicts(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on the verdicts of all coverages."""
    found = Counter(one["verdict"] for row in rows for one in row["coverage"].values())
    return (
        f"Of {found.total()} coverages, {found['kept']} are kept, {found['open']} open and "
        f"{found['missed']} missed."
    )


def _describe_ranges() -> str:
    """Return a sentence on the accepted ranges."""
    ranges = (
        f"{100 * low:.0f} to {100 * high:.0f} % for {level} % intervals"
        for level, (low, high) in COVERAGE_RANGES.items()
    )
    return f"Accepted ranges: {', '.join(ranges)}."


def describe_part(row: Mapping[str, Any]) -> str:
    """Return the part of the cases that a row of a study covers.

    Examples
    --------
    >>> describe_part({"skin": "IV", "calibration_age_days": None, "iso_factor": None})
    'IV'
    >>> describe_part({"skin": "all", "calibration_age_days": 30, "iso_factor": None})
    '30 days'
    """
    age, factor = row["calibration_age_days"], row["iso_factor"]
    parts = [
        "" if row["skin"] == "all" and (age, factor) != (None, None) else str(row["skin"]),
        "" if age is None else f"{age:g} days",
        "" if factor is None else f"ISO x {factor:g}",
    ]
    return ", ".join(filter(None, parts))


def _coverage_titles() -> Iterator[str]:
    for level in COVERAGE_RANGES:
        yield f"coverage of {level} % intervals, %"
        yield f"at {level} %: verdict"


def _table_row(row: Mapping[str, Any]) -> tuple[object, ...]:
    cells: list[object] = [row["quantity"], describe_part(row), row["cases"]]
    cells += [_number(row["median_error"]), _number(row["half_width"]), format_unit(row["unit"])]
    for one in row["coverage"].values():
        inside, low, high = (100.0 * _number(one[key]) for key in ("inside", "low", "high"))
        cells += [f"{inside:.0f} ({low:.0f} to {high:.0f})", one["verdict"]]
    return tuple(cells)


def _check_coverage(row: Mapping[str, Any], checks: list[page.Check]) -> None:
    """Add two checks: the coverage's interval reaches the accepted range from both sides."""
    for level, (least, most) in COVERAGE_RANGES.items():
        one = row["coverage"][str(level)]
        part = describe_part(row)
        shown = "" if part == "all" else f", {part}"
        name = f"coverage of {level} % intervals, {row['quantity']}{shown}"
        ends = 100.0 * _number(one["high"]), 100.0 * _number(one["low"])
        checks.append(page.Check(f"{name}, upper bound", ends[0], 100 * least, ">=", "%"))
        checks.append(page.Check(f"{name}, lower bound", ends[1], 100 * most, "<=", "%"))


def _draw(quantity: str, rows: list[Mapping[str, Any]]) -> list[str]:
    """Return the drawings of error and coverage over parts of the cases; their number is below."""
    labels = [f"{describe_part(row)}\n{row['cases']}" for row in rows]
    error = {"error": [_number(row["median_error"]) for row in rows]}
    error["half width of 68 %"] = [_number(row["half_width"]) for row in rows]
    unit = format_unit(rows[0]["unit"])

    def percent(level: int, key: str) -> list[float]:
        return [100.0 * _number(row["coverage"][str(level)][key]) for row in rows]

    covered = [
        figures.IntervalSeries(
            f"{level} % intervals",
            percent(level, "inside"),
            percent(level, "low"),
            percent(level, "high"),
            (100.0 * accepted[0], 100.0 * accepted[1]),
        )
        for level, accepted in COVERAGE_RANGES.items()
    ]
    return [
        figures.draw_bars(f"{quantity}: median error", labels, error, unit=unit or "1"),
        figures.draw_intervals(f"{quantity}: coverage", labels, covered, unit="%"),
    ]


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
