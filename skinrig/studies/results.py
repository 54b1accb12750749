"""Write the results of a study: a table of cases, coverage by skin type, and a page."""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from rigsim.subject import PRESET_NAMES
from skinrig.atomic_file import write_atomically
from skinrig.benchmarks.intervals.coverage import (
    COVERAGE_RANGES,
    IntervalCoverage,
    corrected_confidence,
    group_by_band,
)
from skinrig.console import to_json_value
from skinrig.studies.cases import JudgedQuantity
from skinrig.studies.description import MEDIUM_TYPE, Case

RESULTS_SCHEMA: Final = "skinrig.study_results/1"
TABLE_FILE: Final = "study.csv"
DOCUMENT_FILE: Final = "study.json"
PAGE_FILE: Final = "report.html"
SKIN_TYPES: Final = (*PRESET_NAMES, MEDIUM_TYPE)
TABLE_COLUMNS: Final = (
    *("case", "rig", "subject", "skin", "seed", "variant", "quantity", "truths"),
    *("median_error", "half_width_68", "unit", "inside_68", "inside_95", "failure"),
)


def write_results(
    title: str,
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
    out: Path,
) -> None:
    """Write ``study.csv``, ``study.json`` and ``report.html``; equal results give equal bytes.

    Parameters
    ----------
    title
        Title of the study.
    cases
        All cases, by key.
    quantities
        Judged quantities of each case that was judged, by key.
    errors
        Message of each case that failed, by key.
    out
        Folder of the files.
    """
    from skinrig.reporting.report import build

    write_atomically(out / TABLE_FILE, format_table(cases, quantities, errors))
    document = summarize(title, cases, quantities, errors)
    text = json.dumps(to_json_value(document), indent=1, sort_keys=True)
    write_atomically(out / DOCUMENT_FILE, f"{text}\n")
    write_atomically(out / PAGE_FILE, build([out / DOCUMENT_FILE], title=title))


def format_table(
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
) -> str:
    """Return the table of cases as CSV: a row per quantity, or one with the failure.

    Parameters are those of `write_results`.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TABLE_COLUMNS)
    for key, case in cases.items():
        head = (key, case.rig, case.subject, case.skin, case.seed, case.variant)
        for row in quantities.get(key, ()):
            figures = (row.error, row.width, row.unit, row.inside_68, row.inside_95)
            cells = (format(one, ".6g") if isinstance(one, float) else one for one in figures)
            writer.writerow((*head, row.quantity, row.truths, *cells, ""))
        if key in errors:
            writer.writerow((*head, *[""] * 7, " ".join(errors[key].split())))
    return stream.getvalue()


def summarize(
    title: str,
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
) -> dict[str, Any]:
    """Return the document of a study: error and coverage of each quantity, by skin type.

    Parameters are those of `write_results`.
    """
    rows = [row for key in cases for row in quantities.get(key, ())]
    return {
        "schema": RESULTS_SCHEMA,
        "title": title,
        "cases": len(cases),
        "failed": [{"case": cases[key].name, "error": text} for key, text in errors.items()],
        "quantities": list(_pool(rows)),
    }


def _pool(rows: Sequence[JudgedQuantity]) -> Iterator[dict[str, Any]]:
    """Yield error and coverage over the cases of each quantity and skin type."""
    ordered = sorted(rows, key=lambda row: SKIN_TYPES.index(row.band))
    confidence = corrected_confidence(ordered)
    levels = {
        level: group_by_band(ordered, level=level, confidence=confidence)
        for level in COVERAGE_RANGES
    }
    for covered in zip(*levels.values(), strict=True):
        first: IntervalCoverage = covered[0]
        own = [
            row
            for row in ordered
            if row.quantity == first.quantity and row.truths and first.band in ("all", row.band)
        ]
        yield {
            "quantity": first.quantity,
            "skin": first.band,
            "cases": first.subjects,
            "unit": first.unit,
            "median_error": float(np.median([row.error for row in own])),
            "half_width": first.width,
            "coverage": {
                str(one.level): {
                    "inside": one.inside_fraction,
                    "low": one.interval[0],
                    "high": one.interval[1],
                    "verdict": one.verdict,
                }
                for one in covered
            },
        }
