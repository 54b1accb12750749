"""Run each stage at the ends of its domain and check the result against a fixed expectation.

A case runs a stage with extreme inputs in float32 and in float64. The expected result is fixed
beforehand: a value, a bound, a mask or a named error. Any other result fails the case, such as a
NaN without a mask, another exception or a silent clamp.
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

CASE_TABLES = ("extremes.csv", "extremes_solvers.csv")
"""Files below skinrig/data. Stage, name, extreme, danger and expectation of each case, with module
and function of its trial. `one_precision` is the reason why one run counts for both, where inputs
have a fixed precision."""

INPUT_PRECISIONS: Mapping[str, InputPrecision] = {
    "float32": InputPrecision(np.float32),
    "float64": InputPrecision(np.float64),
}
"""Precisions of the inputs of each case."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """Result of one case in one precision."""

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
        """Whether the case passed in every precision."""
        return all(outcome.passed for outcome in self.outcomes.values())


def read_cases() -> tuple[Case, ...]:
    """Read every case from the tables, in their order."""
    folder = resources.files("skinrig").joinpath("data")
    texts = [folder.joinpath(name).read_text(encoding="utf-8") for name in CASE_TABLES]
    return tuple(_case(**row) for text in texts for row in csv.DictReader(text.splitlines()))


def _case(*, run: str, **words: str) -> Case:
    module, _, function = run.rpartition(".")
    return Case(run=getattr(import_module(f"skinrig.extremes.{module}"), function), **words)


def try_case(case: Case) -> CaseResult:
    """Run a case in every precision; an exception becomes its outcome."""
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
        except (
            Exception
        ) as error:  # an unexpected exception fails the case and is listed in the table
            got, passed = f"{type(error).__name__}: {error}", False
        outcomes[name] = CaseOutcome(got, passed, time.perf_counter() - start)
    return CaseResult(case, outcomes)


def run_cases(
    stages: Sequence[str] = (), *, progress: Callable[[str], None] | None = None
) -> list[CaseResult]:
    """Run all cases, or those of selected stages.

    Parameters
    ----------
    stages
        Values of `Case.stage`; empty runs all.
    progress
        Called with each case's name before it runs.

    Raises
    ------
    ValueError
        For a stage without cases.
    """
    cases = read_cases()
    known = sorted({case.stage for case in cases})
    for stage in stages:
        if stage not in known:
            raise ValueError(
                f"stage: got {stage!r}, expected one of {', '.join(known)}; correct the name"
            )
    found = []
    for case in cases:
        if stages and case.stage not in stages:
            continue
        if progress is not None:
            progress(case.name)
        found.append(try_case(case))
    return found


def to_document(results: Iterable[CaseResult]) -> dict[str, Any]:
    """Return the JSON document of a run."""
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
