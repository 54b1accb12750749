"""Stiff and extreme cases: what is expected of each stage at the ends of its domain, and the check.

A case hands a stage what is hardest for it, once in float32 and once in float64, and holds what
comes back against an expectation that was written down before: a value, a bound, a mask or a named
error. Nothing else counts as held: a NaN without a mask, a traceback of another kind or a silent
clamp fails the case.
"""

import csv
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module, resources
from typing import Any

import numpy as np

from skinrig.extremes.expectations import Case, ExpectationError
from skinrig.extremes.inputs import InputPrecision

SCHEMA = "skinrig.extremes.cases/1"

CASES_TABLE = resources.files("skinrig").joinpath("data/extremes.csv")
"""Name, stage, extreme, danger and expectation of each case, with module and function of its trial;
`one_precision` says why one run stands for both, where a trial has no precision to choose."""

INPUT_PRECISIONS: Mapping[str, InputPrecision] = {
    "float32": InputPrecision(np.float32),
    "float64": InputPrecision(np.float64),
}
"""What the inputs of each case are given in."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """What one precision of one case did."""

    got: str
    passed: bool
    seconds: float


@dataclass(frozen=True, slots=True)
class CaseResult:
    """A case with its outcomes by precision."""

    case: Case
    outcomes: Mapping[str, CaseOutcome]

    @property
    def passed(self) -> bool:
        """Whether every precision held."""
        return all(outcome.passed for outcome in self.outcomes.values())


def read_cases() -> tuple[Case, ...]:
    """Return every case, in the order of the light: transport, images, surface, motion."""
    rows = csv.DictReader(CASES_TABLE.read_text(encoding="utf-8").splitlines())
    return tuple(_case(**row) for row in rows)


def _case(*, run: str, **words: str) -> Case:
    module, function = run.split(".")
    return Case(run=getattr(import_module(f"skinrig.extremes.{module}"), function), **words)


def try_case(case: Case) -> CaseResult:
    """Run a case in every precision; whatever it raises becomes its outcome."""
    outcomes: dict[str, CaseOutcome] = {}
    for name, real in INPUT_PRECISIONS.items():
        if case.one_precision and outcomes:
            outcomes[name] = next(iter(outcomes.values()))
            continue
        start = time.perf_counter()
        try:
            with np.errstate(all="ignore"):
                got, passed = case.run(real), True
        except ExpectationError as error:
            got, passed = str(error), False
        except Exception as error:  # any other error is what the table is to show
            got, passed = f"{type(error).__name__}: {error}", False
        outcomes[name] = CaseOutcome(got, passed, time.perf_counter() - start)
    return CaseResult(case, outcomes)


def run_cases(
    stages: Sequence[str] = (), *, progress: Callable[[str], None] | None = None
) -> list[CaseResult]:
    """Run all cases, or those of some stages.

    Parameters
    ----------
    stages
        Names as in `Case.stage`; empty runs all.
    progress
        Is told each case's name before it runs.

    Raises
    ------
    ValueError
        For a stage without cases.
    """
    cases = read_cases()
    known = sorted({case.stage for case in cases})
    for stage in stages:
        if stage not in known:
            raise ValueError(f"stage: got {stage!r}, expected one of {', '.join(known)}")
    found = []
    for case in cases:
        if stages and case.stage not in stages:
            continue
        if progress is not None:
            progress(case.name)
        found.append(try_case(case))
    return found


def to_document(results: Iterable[CaseResult]) -> dict[str, Any]:
    """Return the machine-readable table of a run."""
    rows = [
        {
            "name": result.case.name,
            "stage": result.case.stage,
            "extreme": result.case.extreme,
            "danger": result.case.danger,
            "expected": result.case.expected,
            "passed": result.passed,
            "one_precision": result.case.one_precision or None,
            **{
                name: {"got": one.got, "passed": one.passed, "seconds": one.seconds}
                for name, one in result.outcomes.items()
            },
        }
        for result in results
    ]
    return {"schema": SCHEMA, "cases": rows, "passed": all(row["passed"] for row in rows)}
