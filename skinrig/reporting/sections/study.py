"""Report section on a study: error and coverage of each map by part of the cases."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from skinrig.benchmarks.intervals.coverage import COVERAGE_RANGES, FALSE_ALARM_RATE
from skinrig.drawing import figures
from skinrig.reporting import page
from skinrig.unit_format import format_unit

SCHEMA_FAMILY: Final = "skinrig.study_results"
PART_COLUMNS: Final = (
    *("cases of", "cases", "median error", "half width", "unit"),
    *(
        title
        for level in COVERAGE_RANGES
        for title in (f"coverage of {level} % intervals, %", f"at {level} %: verdict")
    ),
)


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
        "A coverage is the mean, over people, of the fraction of ground truths inside the stated "
        f"intervals. {_describe_ranges()} Verdicts: kept, the coverage of two people or more is in "
        "its range; open, only a part of its interval is, as people are few; missed, the whole "
        "interval is outside. If "
        "all intervals are correct, any verdict is missed with a probability of "
        f"{100 * FALSE_ALARM_RATE:g} % at most. Numbers below the figures count cases."
    )
    by_quantity: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_quantity.setdefault(row["quantity"], []).append(row)
    for own in by_quantity.values():
        _check_coverage(own, checks)
    yield page.build_table(
        ("map", *PART_COLUMNS[1:]),
        [(quantity, *_cells(own[0])) for quantity, own in by_quantity.items()],
        caption="Error and coverage over all cases; coverages with bounds, %",
    )
    for quantity, own in by_quantity.items():
        yield page.Heading(quantity, level=3)
        yield page.Plots(_draw(quantity, own))
        if len(own) > 1:
            rows_of_parts = [(describe_part(x), *_cells(x)) for x in own]
            caption = f"{quantity} by skin type, age of the calibration and ISO"
            yield page.build_table(PART_COLUMNS, rows_of_parts, caption=caption)
    if failed:
        cases = [(one["case"], one["error"]) for one in failed]
        yield page.build_table(("case", "error"), cases, caption=f"{len(failed)} cases failed")


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


def _cells(row: Mapping[str, Any]) -> tuple[object, ...]:
    """Return the cells of a row below `PART_COLUMNS`, without the part."""
    cells: list[object] = [row["cases"], _number(row["median_error"]), _number(row["half_width"])]
    cells.append(format_unit(row["unit"]))
    for one in row["coverage"].values():
        cells += [_format_coverage(one), one["verdict"]]
    return tuple(cells)


def _format_coverage(one: Mapping[str, Any]) -> str:
    inside, low, high = (100.0 * _number(one[key]) for key in ("inside", "low", "high"))
    return f"{inside:.0f} ({low:.0f} to {high:.0f})"


def _check_coverage(rows: Sequence[Mapping[str, Any]], checks: list[page.Check]) -> None:
    """Add a check per level: no part of the cases misses the range; the farthest one is named."""
    for level, (least, most) in COVERAGE_RANGES.items():
        covered = [row["coverage"][str(level)] for row in rows]
        missed = [one["verdict"] == "missed" for one in covered]
        gaps = [max(least - one["high"], one["low"] - most) for one in covered]
        farthest = max(range(len(rows)), key=lambda k: (missed[k], gaps[k]))
        shown = f"{describe_part(rows[farthest])}: {_format_coverage(covered[farthest])} %"
        checks.append(
            page.Check(
                f"{rows[0]['quantity']}: parts that miss the coverage of {level} % intervals",
                sum(missed),
                0.0,
                "<=",
                note=f"of {len(rows)} parts; accepted: {100 * least:.0f} to {100 * most:.0f} %",
                coverage=_number(covered[0]["inside"]) if level == 68 else float("nan"),
                worst=shown if any(missed) else "",
            )
        )


def _draw(quantity: str, rows: list[Mapping[str, Any]]) -> list[str]:
    """Return the drawings of error and coverage over parts of the cases."""
    labels = ["\n".join([*describe_part(row).split(" ", 1), str(row["cases"])]) for row in rows]
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
