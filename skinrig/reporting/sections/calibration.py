"""Report section on calibrations: quality and validity at capture."""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np

from capture.calibration import store
from capture.calibration.record import Calibration, CalibrationError
from model.skin import SkinAppearance
from skinrig.appearances.contents import hash_file
from skinrig.arrays import Float64Array
from skinrig.console import format_count
from skinrig.reporting import page
from skinrig.reporting.sections.session import SessionFacts

MAX_LISTED_NUMBERS = 12
"""Values up to which a table lists a quantity."""
MAX_LISTED_QUANTITIES = 60
"""Rows beyond which values stay in their file."""


AGGREGATE_BY_NAME: Mapping[str, Callable[[Float64Array], float]] = {
    "largest": lambda values: float(np.max(np.abs(values))),
    "mean": lambda values: float(np.mean(values)),
}
"""Statistics of the values of one device."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One number for the quality of a calibration, for each device that has it."""

    quantity: str
    words: str
    unit: str
    of: Callable[[Float64Array], float]
    factor: float
    worst: Callable[[Sequence[float]], float]


def _quality_figures() -> dict[str, list[Figure]]:
    table = resources.files("skinrig").joinpath("data/calibration_figures.csv")
    found: dict[str, list[Figure]] = {}
    for row in csv.DictReader(table.read_text(encoding="utf-8").splitlines()):
        of = AGGREGATE_BY_NAME[row["of"]]
        worst = {"min": min, "max": max}[row["worst"]]
        words = row["quantity"], row["words"], row["unit"]
        found.setdefault(row["kind"], []).append(Figure(*words, of, float(row["factor"]), worst))
    return found


QUALITY_FIGURES = _quality_figures()
"""Figures of each kind; quantities that a calibration lacks are omitted."""


def section(
    folders: Sequence[Path],
    appearances: Mapping[str, SkinAppearance],
    sessions: Mapping[str, SessionFacts],
    checks: list[page.Check],
) -> Iterator[page.Block]:
    """Yield quality, age at capture and values of calibrations.

    Parameters
    ----------
    folders
        CALIBRATION/ folders.
    appearances
        By name; their inputs name the calibrations.
    sessions
        By name; their days give the age of a calibration.
    checks
        Gets the remaining validity of each folder that was used.

    Notes
    -----
    Ages refer to the day of capture: maps depend on it, and a report of the same input is the
    same on any day.
    """
    if not folders:
        return
    ages: list[tuple[object, ...]] = []
    figures: list[tuple[object, ...]] = []
    values: list[page.Collapsible] = []
    for folder in folders:
        left: list[float] = []
        for path in sorted(folder.glob("*.json")):
            try:
                found = store.load(folder, path.stem)
            except (CalibrationError, ValueError) as error:
                ages.append((f"{folder.name}, {path.stem}", "", "", "", "", "", "", str(error)))
                left.append(float("nan"))
                continue
            days, row = _age(folder.name, path, found, appearances, sessions)
            ages.append(row)
            left += days
            figures += _figures(folder.name, found)
            values.append(_values(folder.name, found))
        if left:
            name = f"{folder.name}: days of validity left at capture"
            checks.append(page.Check(name, float(np.min(left)), 0.0, ">=", "d"))
    yield page.Heading("Calibrations", level=2)
    yield page.build_view("calibrations", ages=ages, figures=figures)
    yield from values


def list_uses(
    path: Path, appearances: Mapping[str, SkinAppearance], sessions: Mapping[str, SessionFacts]
) -> tuple[list[str], list[date]]:
    """Return the maps made with a calibration, and the days of their captures, each once.

    Parameters
    ----------
    path
        File of the calibration, which maps name by its digest.
    appearances, sessions
        By name; days of sessions that are not among them are unknown.
    """
    made_of = hash_file(path)
    users = sorted(
        name
        for name, one in appearances.items()
        if made_of in {str(d).removeprefix("sha256:") for d in one.inputs.values()}
    )
    captured = {
        sessions[str(session)].day
        for name in users
        if (session := appearances[name].parameters.get("session")) in sessions
    }
    return users, sorted(captured)


def _age(
    folder: str,
    path: Path,
    found: Calibration,
    appearances: Mapping[str, SkinAppearance],
    sessions: Mapping[str, SessionFacts],
) -> tuple[list[float], tuple[object, ...]]:
    """Return the days left at each capture, and the row of the table."""
    users, captured = list_uses(path, appearances, sessions)
    days = [count_days_left(found, day) for day in captured]
    if not captured:
        verdict = "date of use unknown"
    elif min(days) < 0:
        verdict = "not valid at capture"
    else:
        verdict = f"valid, {min(days)} days left"
    ages = [(day - found.created).days for day in captured]
    return [float(d) for d in days], (
        f"{folder}, {found.kind}",
        found.created.isoformat(),
        found.valid_until.isoformat(),
        ", ".join(users) or "not used",
        ", ".join(day.isoformat() for day in captured),
        ", ".join(map(str, ages)),
        describe_drift(found.rig, found.kind, max(*ages, 0)) if ages else "",
        f"{verdict}; {found.source}",
    )


DRIFT_SIGMAS: Final = 3.0
"""Least change of a calibration, in its standard errors, that is stated."""


@cache
def _drifts() -> list[tuple[str, str, int, float, float]]:
    """Return rig, kind, age in days, typical change in standard errors or 0, and median in %."""
    text = resources.files("skinrig").joinpath("data/calibration_drift.csv").read_text()
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    return [
        (
            row["rig"],
            row["kind"],
            int(row["days"]),
            float(row["sigmas"] or 0.0),
            float(row["percent"]),
        )
        for row in rows
    ]


def describe_drift(rig: str, kind: str, age_days: int) -> str:
    """Return how far calibrations of simulated rigs have moved at an age, in words.

    Parameters
    ----------
    rig, kind
        Of the calibration.
    age_days
        At capture, >= 0; that of the next longer measured age is given, or of the longest.

    Returns
    -------
    str
        Empty for kinds that were not measured. One pair of calibrations was measured per age, so
        that a change below `DRIFT_SIGMAS` standard errors is none.

    Examples
    --------
    >>> describe_drift("dome", "lights", 400)
    '1.5 %, 8.5 standard errors, in 365 days'
    >>> describe_drift("probe", "fiber", 400)
    'none beyond noise'
    >>> describe_drift("flash", "color", 3)
    ''
    """
    ages = sorted(row[2:] for row in _drifts() if row[:2] == (rig, kind))
    if not ages:
        return ""
    days, sigmas, percent = next((row for row in ages if row[0] >= age_days), ages[-1])
    if sigmas < DRIFT_SIGMAS:
        return "none beyond noise"
    return f"{percent:g} %, {sigmas:g} standard errors, in {format_count(days, 'day')}"


def count_days_left(found: Calibration, day: date) -> int:
    """Return days until validity ends; negative, too, before it began."""
    before = (day - found.created).days
    return before if before < 0 else (found.valid_until - day).days


def _figures(folder: str, found: Calibration) -> list[tuple[object, ...]]:
    calibration = f"{folder}, {found.kind}"
    rows: list[tuple[object, ...]] = []
    for figure in QUALITY_FIGURES.get(found.kind, ()):
        held = {
            serial: (np.asarray(names[figure.quantity].value, float), names[figure.quantity].stderr)
            for serial, names in sorted(found.values.items())
            if figure.quantity in names
        }
        values = {
            serial: figure.factor * figure.of(value)
            for serial, (value, _) in held.items()
            if np.isfinite(value).all()
        }
        if not values or (found.kind == "white" and not any(values.values())):
            continue  # a white reference without smoothing has no residual
        errors = [
            figure.factor * float(np.max(stderr))
            for _, stderr in held.values()
            if stderr is not None and np.isfinite(stderr).all()
        ]
        median, worst = float(np.median(list(values.values()))), figure.worst(list(values.values()))
        device = next(serial for serial, value in values.items() if value == worst)
        of_all = len(values), median, worst, device, max(errors) if errors else ""
        rows.append((calibration, figure.words, figure.unit, *of_all))
    valid = {
        serial: np.asarray(names["valid"].value, bool).all()
        for serial, names in sorted(found.values.items())
        if "valid" in names
    }
    if valid:
        flagged = [serial for serial, good in valid.items() if not good]
        count = float(len(flagged))
        of_all = len(valid), count, count, ", ".join(flagged[:6]), ""
        rows.append((calibration, "devices marked invalid", "", *of_all))
    return rows


def _values(folder: str, found: Calibration) -> page.Collapsible:
    rows = [
        (serial, name, _numbers(quantity.value), _numbers(quantity.stderr))
        for serial, names in sorted(found.values.items())
        for name, quantity in sorted(names.items())
        if np.size(quantity.value) <= MAX_LISTED_NUMBERS
    ]
    listed: page.Block
    if len(rows) > MAX_LISTED_QUANTITIES:
        listed = page.build_note(f"{found.kind}.json lists {len(rows)} quantities of its devices.")
    else:
        listed = page.build_table(
            ("device", "quantity", "value", "standard uncertainty"),
            rows,
            caption=f"Values of {folder}, {found.kind}, {found.created}",
        )
    noted = page.build_facts_table(
        dict(sorted(found.notes.items())), caption="Notes of the calibration"
    )
    return page.Collapsible(f"{folder}, {found.kind}: notes and values", [noted, listed])


def _numbers(values: object) -> str:
    if values is None:
        return ""
    return ", ".join(f"{v:.4g}" for v in np.asarray(values, float).ravel())
