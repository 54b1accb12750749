"""Check arguments of functions, with one message per kind of error."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Axes: TypeAlias = tuple[int | str | None, ...]
FINITE_RANGE = "(-inf, inf)"
"""Interval of all finite numbers."""


@dataclass(frozen=True, slots=True)
class Checks:
    """Check arguments and raise one class of error.

    Every message has the form "where: got X, expected Y".

    Examples
    --------
    >>> Checks().within("limit", 2.0, "(0, 1]")
    Traceback (most recent call last):
        ...
    ValueError: limit: got 2.0, expected a number in (0, 1]
    """

    error: type[ValueError] = ValueError

    def require(self, condition: Any, name: str, got: Any, expected: str) -> None:
        """Raise the error unless a condition is true."""
        if not condition:
            raise self.error(f"{name}: got {got}, expected {expected}")

    def within(self, name: str, given: Any, interval: str = FINITE_RANGE) -> None:
        """Raise for numbers outside an interval such as ``"(0, 1]"``; "inf)" means finite.

        Parameters
        ----------
        name
            Name of the argument in messages.
        given
            A number or an array; NaN is outside every interval.
        interval
            Two numbers between brackets: square ones include their end, round ones exclude it.
        """
        low, high = (float(end) for end in interval[1:-1].split(","))
        values = np.asarray(given)
        inside = values >= low if interval[0] == "[" else values > low
        inside &= values <= high if interval[-1] == "]" else values < high
        if inside.all():
            return
        what = "finite numbers" if interval == FINITE_RANGE else f"numbers in {interval}"
        if values.ndim == 0:
            raise self.error(f"{name}: got {given}, expected a {what.replace('numbers', 'number')}")
        wrong = values[~inside]
        got = f"{wrong[0]} and {wrong.size - 1} others of {values.size} numbers"
        raise self.error(f"{name}: got {got}, expected {what}")

    def choice(self, name: str, given: Any, allowed: Iterable[Any]) -> None:
        """Raise unless a value is one of some names or numbers."""
        if given not in (names := tuple(allowed)):
            raise self.error(f"{name}: got {given!r}, expected one of {', '.join(map(str, names))}")

    def shape(self, name: str, array: Any, *expected: Axes) -> None:
        """Raise unless an array has one of some shapes.

        Parameters
        ----------
        name
            Name of the argument in messages.
        array
            None passes.
        expected
            Lengths of axes; a name such as "N" means any length of 1 or more, None any length, and
            "..." in the first position any leading axes.
        """
        if array is None or not expected:
            return
        got = np.shape(array)
        if not any(_fits(got, shape) for shape in expected):
            shapes = " or ".join(map(str, expected)).replace("'", "").replace("None", "any")
            raise self.error(f"{name}: got shape {got}, expected {shapes}")

    def numbers(
        self, name: str, given: Any, *expected: Axes, interval: str = FINITE_RANGE
    ) -> NDArray[np.float64]:
        """Return an array in float64; raise for other shapes and numbers outside an interval."""
        array = np.asarray(given, np.float64)
        self.shape(name, array, *expected)
        self.within(name, array, interval)
        return array

    def broadcast_together(
        self, interval: str = "[-inf, inf]", /, **given: Any
    ) -> list[NDArray[np.float64]]:
        """Return arrays in float64 at their common shape; raise for shapes that do not broadcast.

        Parameters
        ----------
        interval
            Interval of all numbers, in the notation of `within`.
        given
            The arrays, by their names in messages.
        """
        arrays = {name: np.asarray(values, np.float64) for name, values in given.items()}
        if interval != "[-inf, inf]":
            for name, array in arrays.items():
                self.within(name, array, interval)
        try:
            return list(np.broadcast_arrays(*arrays.values()))
        except ValueError:
            got = " and ".join(str(array.shape) for array in arrays.values())
            raise self.error(
                f"{', '.join(given)}: got shapes {got}, expected ones that broadcast"
            ) from None

    def broadcast(self, name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Return an array broadcast to a shape; raise where it does not broadcast."""
        try:
            return np.broadcast_to(array, shape)
        except ValueError:
            raise self.error(
                f"{name}: got shape {array.shape}, expected one that broadcasts to {shape}"
            ) from None

    def mask(self, name: str, mask: Any, *expected: Axes) -> None:
        """Raise unless a mask is a bool array of one of some shapes, as in `shape`."""
        kind = np.asarray(mask).dtype
        if kind != np.bool_:
            raise self.error(f"{name}: got {kind} {np.shape(mask)}, expected bool")
        self.shape(name, mask, *expected)

    def settings(self, settings: object, **intervals: str) -> None:
        """Raise for fields of a record outside their intervals, in the notation of `within`."""
        for name, interval in intervals.items():
            self.within(f"{type(settings).__name__}.{name}", getattr(settings, name), interval)


def _fits(got: tuple[int, ...], shape: Axes) -> bool:
    if shape[:1] == ("...",):
        shape = shape[1:]
        got = got[max(len(got) - len(shape), 0) :]
    return len(got) == len(shape) and all(
        length == axis if isinstance(axis, int) else length >= 1 or axis is None
        for length, axis in zip(got, shape, strict=True)
    )
