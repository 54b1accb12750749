"""Stiff and extreme cases: what is expected of each stage at the ends of its domain, and the check.

A case hands a stage what is hardest for it, once in float32 and once in float64, and holds what
comes back against an expectation that was written down before: a value, a bound, a mask or a named
error. Nothing else counts as held: a NaN without a mask, a traceback of another kind or a silent
clamp fails the case.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

SCHEMA = "skinrig.extremes.cases/1"

Real = type[np.float32] | type[np.float64]
PRECISIONS: Mapping[str, Real] = {"float32": np.float32, "float64": np.float64}
"""What the inputs of each case are given in."""


class Unexpected(AssertionError):
    """A stage did something else than it should; the text says what."""


@dataclass(frozen=True, slots=True)
class Case:
    """One extreme."""

    name: str
    stage: str
    """Module that is put to the test."""
    extreme: str
    """What is extreme."""
    danger: str
    """Why that can break."""
    expected: str
    """The behavior that holds."""
    run: Callable[[Real], str]
    """Tries it with inputs of a precision; returns what happened, or raises `Unexpected`."""
    one_precision: str = ""
    """Why its inputs have no precision to choose, so that one run stands for both; empty: they
    have."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one precision of one case did."""

    got: str
    passed: bool
    seconds: float


@dataclass(frozen=True, slots=True)
class Result:
    """A case with its outcomes by precision."""

    case: Case
    outcomes: Mapping[str, Outcome]

    @property
    def passed(self) -> bool:
        """Whether every precision held."""
        return all(outcome.passed for outcome in self.outcomes.values())


def all_cases() -> tuple[Case, ...]:
    """Return every case, in the order of the light: transport, pictures, surface, motion."""
    from skinrig.extremes import (
        arrays,
        domains,
        interior,
        motion,
        photons,
        reflectance,
        rendering,
        transport,
    )
    from skinrig.extremes import images as pictures
    from skinrig.extremes import surface as extremes_surface

    groups = (
        transport, photons, rendering, pictures, extremes_surface,
        reflectance, interior, motion, arrays, domains,
    )  # fmt: skip
    return tuple(case for group in groups for case in group.CASES)


def try_case(case: Case) -> Result:
    """Run a case in every precision; whatever it raises becomes its outcome."""
    outcomes: dict[str, Outcome] = {}
    for name, real in PRECISIONS.items():
        if case.one_precision and outcomes:
            outcomes[name] = next(iter(outcomes.values()))
            continue
        start = time.perf_counter()
        try:
            with np.errstate(all="ignore"):
                got, passed = case.run(real), True
        except Unexpected as error:
            got, passed = str(error), False
        except Exception as error:  # any other error is what the table is to show
            got, passed = f"{type(error).__name__}: {error}", False
        outcomes[name] = Outcome(got, passed, time.perf_counter() - start)
    return Result(case, outcomes)


def run_cases(
    stages: Sequence[str] = (), *, progress: Callable[[str], None] | None = None
) -> list[Result]:
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
    cases = all_cases()
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


def to_document(results: Iterable[Result]) -> dict[str, Any]:
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


INTEGERS = "pictures of a sensor are integers"
RENDERER = "rays are cast in the renderer's own single precision"
"""Of cases whose inputs have one precision."""

# what cases say of their results


def near(
    got: ArrayLike, expected: ArrayLike, *, relative: float = 0.0, absolute: float = 0.0
) -> str:
    """Return the value where it is as near as said, else raise."""
    value, target = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    away = np.abs(value - target)
    if not np.all(away <= absolute + relative * np.abs(target)):
        raise Unexpected(f"got {_short(value)}, expected {_short(target)}")
    return _short(value)


def within(got: ArrayLike, low: float, high: float, *, what: str = "values") -> str:
    """Return the range of the values where all are finite and within the bounds, else raise."""
    value = np.asarray(got, np.float64)
    if not np.all(np.isfinite(value)) or value.size == 0:
        raise Unexpected(f"{what}: got {_short(value)}, expected finite values")
    if np.min(value) < low or np.max(value) > high:
        raise Unexpected(
            f"{what}: got {np.min(value):.6g} to {np.max(value):.6g}, expected {low:g} to {high:g}"
        )
    return f"{what} {np.min(value):.4g} to {np.max(value):.4g}"


def rising(got: ArrayLike, *, strictly: bool = True, what: str = "values") -> str:
    """Return the ends of the values where they are finite and rise, else raise."""
    value = np.asarray(got, np.float64)
    steps = np.diff(value)
    if not np.all(np.isfinite(value)) or np.any(steps < 0) or (strictly and np.any(steps == 0)):
        raise Unexpected(f"{what}: got {_short(value)}, expected values that rise")
    return f"{what} rise from {value[0]:.4g} to {value[-1]:.4g}"


def refused(call: Callable[[], object], error: type[BaseException], *words: str) -> str:
    """Return the message where the call raises this error and says these words, else raise."""
    try:
        got = call()
    except error as caught:
        text = str(caught)
        for word in words:
            if word not in text:
                raise Unexpected(f"the error does not say {word!r}: {text}") from caught
        return f"{type(caught).__name__}: {text}"
    except Exception as caught:
        raise Unexpected(f"{type(caught).__name__} instead of {error.__name__}: {caught}") from None
    raise Unexpected(f"got {type(got).__name__}, expected {error.__name__}")


def masked(valid: ArrayLike, *, share: tuple[float, float] = (0.0, 0.0)) -> str:
    """Return how much is valid where that share lies in the range, else raise."""
    kept = float(np.mean(np.asarray(valid, np.float64)))
    if not share[0] <= kept <= share[1]:
        raise Unexpected(f"valid: got a share of {kept:.3g}, expected {share[0]:g} to {share[1]:g}")
    return f"{100 * kept:.3g} % valid"


def clean(values: ArrayLike, valid: ArrayLike, *, what: str = "values") -> str:
    """Return that every valid value is finite, else raise."""
    shown = np.asarray(values)[np.asarray(valid, np.bool_)]
    if not np.all(np.isfinite(shown)):
        raise Unexpected(f"{what}: got NaN or infinity at a valid place")
    return f"{what} finite where valid"


def as_real(values: ArrayLike, real: Real) -> NDArray[Any]:
    """Return values as an array of a precision."""
    return np.asarray(values, real)


def _short(value: NDArray[np.float64]) -> str:
    if value.size <= 4:
        return ", ".join(f"{v:.6g}" for v in value.ravel())
    return f"{value.size} values from {np.nanmin(value):.4g} to {np.nanmax(value):.4g}"
