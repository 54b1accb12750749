"""Write the results of a study: a table of cases, coverage by part of the cases, and a page."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rigsim.subject import PRESET_NAMES
from skinrig.atomic_file import write_atomically
from skinrig.benchmarks.intervals.coverage import COVERAGE_RANGES, pool_trials, share_confidence
from skinrig.console import to_json_value
from skinrig.studies.cases import JudgedQuantity
from skinrig.studies.description import MEDIUM_TYPE, Case
from skinrig.unit_format import format_csv

RESULTS_SCHEMA: Final = "skinrig.study_results/1"
TABLE_FILE: Final = "study.csv"
SUMMARY_FILE: Final = "summary.csv"
DOCUMENT_FILE: Final = "study.json"
PAGE_FILE: Final = "report.html"
SKIN_TYPES: Final = (*PRESET_NAMES, MEDIUM_TYPE)
TABLE_COLUMNS: Final = (
    *("case", "rig", "subject", "skin", "seed", "setup", "calibration_age_days", "iso_factor"),
    *("quantity", "truths"),
    *("median_error", "half_width_68", "unit", "inside_68", "inside_95", "failure"),
)
CASE_CONDITIONS: Final = ("calibration_age_days", "iso_factor")
"""Fields of a case by which error and coverage are divided, next to the skin type."""
ALL_SKIN: Final = "all"
SUMMARY_COLUMNS: Final = (
    *("quantity", "skin", *CASE_CONDITIONS, "cases", "median_error", "half_width_68", "unit"),
    *(f"{name}_{n}" for n in COVERAGE_RANGES for name in ("inside", "low", "high", "verdict")),
)

JudgedCase = tuple[Case, JudgedQuantity]


@dataclass(frozen=True, slots=True)
class Part:
    """Cases of one quantity that share a property."""

    quantity: str
    skin: str
    """Skin type, or `ALL_SKIN`."""
    conditions: Mapping[str, float]
    """Values of `CASE_CONDITIONS`; a missing one: all values."""
    judged: Sequence[JudgedCase]


def write_results(
    title: str,
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
    out: Path,
) -> None:
    """Write the tables, the document and the page; equal results give equal bytes.

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
    write_atomically(out / SUMMARY_FILE, format_summary(document))
    write_atomically(out / PAGE_FILE, build([out / DOCUMENT_FILE], title=title))


def format_table(
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
) -> str:
    """Return the table of cases as CSV: a row per quantity, or one with the failure.

    Parameters are those of `write_results`.
    """
    rows: list[Sequence[object]] = [TABLE_COLUMNS]
    for key, case in cases.items():
        head = (
            *(key, case.rig, case.subject, case.skin, case.seed, case.setup),
            *(case.calibration_age_days, format(case.iso_factor, "g")),
        )
        for row in quantities.get(key, ()):
            figures = (row.error, row.width, row.unit, row.inside_68, row.inside_95)
            cells = (format(one, ".6g") if isinstance(one, float) else one for one in figures)
            rows.append((*head, row.quantity, row.truths, *cells, ""))
        if key in errors:
            rows.append((*head, *[""] * 7, " ".join(errors[key].split())))
    return format_csv(rows)


def summarize(
    title: str,
    cases: Mapping[str, Case],
    quantities: Mapping[str, Sequence[JudgedQuantity]],
    errors: Mapping[str, str],
) -> dict[str, Any]:
    """Return the document of a study: error and coverage of each quantity, by part of the cases.

    Parameters are those of `write_results`. The parts are all cases, those of a skin type, those of
    an age of the calibration, those of an ISO (`quantities`, which share the rate of false alarms),
    and those of a type with an age and an ISO (`cells`, with bounds of the same confidence).
    """
    judged = [(cases[key], row) for key in cases for row in quantities.get(key, ()) if row.truths]
    parts = list(_list_parts(judged))
    cells = list(_list_cells(judged))
    confidence = share_confidence(len(parts))
    return {
        "schema": RESULTS_SCHEMA,
        "title": title,
        "cases": len(cases),
        "failed": [{"case": cases[key].name, "error": text} for key, text in errors.items()],
        "confidence": confidence,
        "quantities": [_pool(part, confidence) for part in parts],
        "cells": [_pool(cell, confidence) for cell in cells],
    }


def format_summary(document: Mapping[str, Any]) -> str:
    """Return the document of `summarize` as CSV: a row per quantity and part of the cases."""
    rows: list[Sequence[object]] = [SUMMARY_COLUMNS]
    for row in [*document["quantities"], *document["cells"]]:
        figures = [row[name] for name in ("median_error", "half_width")]
        cells = [format(one, ".4g") for one in figures] + [row["unit"]]
        for one in row["coverage"].values():
            cells += [format(one[name], ".3f") for name in ("inside", "low", "high")]
            cells.append(one["verdict"])
        keys = (
            ALL_SKIN if row[name] is None else format(row[name], "g") for name in CASE_CONDITIONS
        )
        rows.append((row["quantity"], row["skin"], *keys, row["cases"], *cells))
    return format_csv(rows)


def _list_parts(judged: Sequence[JudgedCase]) -> Iterator[Part]:
    """Yield all cases of each quantity, and its cases by one property that has several values."""
    for quantity, own in _group(judged, lambda case, row: row.quantity).items():
        types = _group(own, lambda case, row: case.skin)
        common = ALL_SKIN if len(types) > 1 else next(iter(types))
        yield Part(quantity, common, {}, own)
        if len(types) > 1:
            ordered = sorted(types, key=SKIN_TYPES.index)
            yield from (Part(quantity, skin, {}, types[skin]) for skin in ordered)
        for name in CASE_CONDITIONS:
            values: dict[Any, list[JudgedCase]] = {}
            for case, row in own:
                values.setdefault(getattr(case, name), []).append((case, row))
            if len(values) > 1:
                for value in sorted(values):
                    yield Part(quantity, common, {name: value}, values[value])


def _list_cells(judged: Sequence[JudgedCase]) -> Iterator[Part]:
    """Yield the cases of each type, age and ISO of the quantities that have several conditions."""
    for quantity, own in _group(judged, lambda case, row: row.quantity).items():
        conditions = _group(own, lambda case, row: tuple(getattr(case, n) for n in CASE_CONDITIONS))
        if len(conditions) == 1:
            continue
        for values in sorted(conditions):
            types = _group(conditions[values], lambda case, row: case.skin)
            for skin in sorted(types, key=SKIN_TYPES.index):
                named = dict(zip(CASE_CONDITIONS, values, strict=True))
                yield Part(quantity, skin, named, types[skin])


def _group(
    judged: Iterable[JudgedCase], key: Callable[[Case, JudgedQuantity], Any]
) -> dict[Any, list[JudgedCase]]:
    found: dict[Any, list[JudgedCase]] = {}
    for case, row in judged:
        found.setdefault(key(case, row), []).append((case, row))
    return found


def _average_people(judged: Sequence[JudgedCase]) -> list[JudgedQuantity]:
    """Return one row per rig, subject and seed: repeats of one person are correlated."""
    people = _group(judged, lambda case, row: (case.rig, case.subject, case.seed))
    return [_average([row for _, row in own]) for own in people.values()]


def _average(rows: Sequence[JudgedQuantity]) -> JudgedQuantity:
    """Return one person's mean fractions inside; its truths are those of the largest case."""
    return replace(
        rows[0],
        truths=max(row.truths for row in rows),
        error=float(np.median([row.error for row in rows])),
        width=float(np.median([row.width for row in rows])),
        inside_68=float(np.mean([row.inside_68 for row in rows])),
        inside_95=float(np.mean([row.inside_95 for row in rows])),
    )


def _pool(part: Part, confidence: float) -> dict[str, Any]:
    """Return error and coverage over the cases of a part; a coverage is a mean over people."""
    rows = [row for _, row in part.judged]
    people = _average_people(part.judged)
    covered = [pool_trials(people, level=n, confidence=confidence) for n in COVERAGE_RANGES]
    return {
        "quantity": part.quantity,
        "skin": part.skin,
        **{name: part.conditions.get(name) for name in CASE_CONDITIONS},
        "cases": len(rows),
        "unit": rows[0].unit,
        "median_error": float(np.median([row.error for row in rows])),
        "half_width": float(np.median([row.width for row in rows])),
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
