"""Extreme cases and checks of their results."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skinrig.arrays import Float64Array
from skinrig.extremes.inputs import InputPrecision


class ExpectationError(AssertionError):
    """Result of a stage that differs from the expectation; the message states both."""


@dataclass(frozen=True, slots=True)
class Case:
    """One extreme case of a stage."""

    name: str
    stage: str
    """Stage under test."""
    extreme: str
    """Extreme input."""
    danger: str
    """Reason why the input can fail."""
    expected: str
    """Expected behavior."""
    run: Callable[[InputPrecision], str]
    """Function that runs the case with inputs of a precision. It returns a description of the
    result or raises `ExpectationError`."""
    one_precision: str = ""
    """Reason why the inputs have a fixed precision and one run counts for both; empty otherwise."""


def expect_near(
    got: ArrayLike, expected: ArrayLike, *, relative: float = 0.0, absolute: float = 0.0
) -> str:
    """Return the value as text if it is within the tolerances, else raise `ExpectationError`."""
    value, target = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    away = np.abs(value - target)
    if not np.all(away <= absolute + relative * np.abs(target)):
        raise ExpectationError(f"got {_short(value)}, expected {_short(target)}")
    return _short(value)


def expect_within(got: ArrayLike, low: float, high: float, *, label: str = "values") -> str:
    """Return the range of the values if all are finite and within the bounds, else raise."""
    value = np.asarray(got, np.float64)
    if not np.all(np.isfinite(value)) or value.size == 0:
        raise ExpectationError(f"{label}: got {_short(value)}, expected finite values")
    if np.min(value) < low or np.max(value) > high:
        raise ExpectationError(
            f"{label}: got {np.min(value):.6g} to {np.max(value):.6g}, expected {low:g} to {high:g}"
        )
    return f"{label} {np.min(value):.4g} to {np.max(value):.4g}"


def expect_rising(got: ArrayLike, *, strictly: bool = True, label: str = "values") -> str:
    """Return the first and last value if the values are finite and rise, else raise."""
    value = np.asarray(got, np.float64)
    steps = np.diff(value)
    if not np.all(np.isfinite(value)) or np.any(steps < 0) or (strictly and np.any(steps == 0)):
        raise ExpectationError(f"{label}: got {_short(value)}, expected values that rise")
    return f"{label} rise from {value[0]:.4g} to {value[-1]:.4g}"


def expect_error(call: Callable[[], object], error: type[BaseException], *words: str) -> str:
    """Return the message if the call raises this error and its text has these words, else raise."""
    try:
        got = call()
    except error as caught:
        text = str(caught)
        for word in words:
            if word not in text:
                raise ExpectationError(f"got {text!r}, expected an error with {word!r}") from caught
        return f"{type(caught).__name__}: {text}"
    except Exception as caught:
        raise ExpectationError(
            f"got {type(caught).__name__}: {caught}, expected {error.__name__}"
        ) from None
    raise ExpectationError(f"got {type(got).__name__}, expected {error.__name__}")


def expect_valid_fraction(
    valid: ArrayLike, *, fraction_range: tuple[float, float] = (0.0, 0.0)
) -> str:
    """Return the valid fraction as text if it is in the range, else raise."""
    kept = float(np.mean(np.asarray(valid, np.float64)))
    if not fraction_range[0] <= kept <= fraction_range[1]:
        raise ExpectationError(
            f"valid: got a fraction of {kept:.3g}, expected {fraction_range[0]:g} to"
            f" {fraction_range[1]:g}"
        )
    return f"{100 * kept:.3g} % valid"


def expect_finite(values: ArrayLike, valid: ArrayLike, *, label: str = "values") -> str:
    """Return a confirmation if every valid value is finite, else raise."""
    kept = np.asarray(values)[np.asarray(valid, np.bool_)]
    if not np.all(np.isfinite(kept)):
        raise ExpectationError(f"{label}: got NaN or infinity in a valid entry, expected a number")
    return f"{label} finite where valid"


def _short(value: Float64Array) -> str:
    if value.size <= 4:
        return ", ".join(f"{v:.6g}" for v in value.ravel())
    return f"{value.size} values from {np.nanmin(value):.4g} to {np.nanmax(value):.4g}"
