"""Checks of settings and arrays that estimators have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Checks:
    """Refuses, with one kind of error, what a function was given.

    Every message says where, what it got and what it expected.

    Examples
    --------
    >>> Checks(ValueError).within("limit", 2.0, "(0, 1]")
    Traceback (most recent call last):
        ...
    ValueError: limit: got 2.0, expected a number in (0, 1]
    """

    error: type[ValueError]

    def require(self, holds: Any, name: str, got: Any, expected: str) -> None:
        """Refuse what does not hold."""
        if not holds:
            raise self.error(f"{name}: got {got}, expected {expected}")

    def within(self, name: str, given: Any, interval: str) -> None:
        """Refuse numbers outside an interval such as ``"(0, 1]"``; "inf" at an end means finite.

        Parameters
        ----------
        name
            What messages call it.
        given
            A number or an array; NaN lies in no interval.
        interval
            Two numbers between brackets: a square one holds its end, a round one does not.
        """
        low, high = (float(end) for end in interval[1:-1].split(","))
        values = np.asarray(given)
        inside = values >= low if interval[0] == "[" else values > low
        inside &= values <= high if interval[-1] == "]" else values < high
        if values.ndim == 0:
            self.require(inside, name, given, f"a number in {interval}")
        elif not inside.all():
            wrong = values[~inside]
            got = f"{wrong[0]} and {wrong.size - 1} others of {values.size} numbers"
            raise self.error(f"{name}: got {got}, expected numbers in {interval}")

    def shape(self, name: str, array: Any, *expected: tuple[int | str, ...]) -> None:
        """Refuse an array of none of some shapes.

        Parameters
        ----------
        name
            What messages call it.
        array
            None passes.
        expected
            Lengths of axes; a name such as "N" stands for any length of 1 or more, and "..." in
            the first place for any leading axes.
        """
        if array is None:
            return
        got = np.shape(array)
        if not any(_fits(got, shape) for shape in expected):
            shapes = " or ".join(str(shape).replace("'", "") for shape in expected)
            raise self.error(f"{name}: got shape {got}, expected {shapes}")

    def mask(self, name: str, mask: Any, *expected: tuple[int | str, ...]) -> None:
        """Refuse what is no bool array of one of some shapes, as `shape` takes them."""
        kind = np.asarray(mask).dtype
        self.require(kind == np.bool_, name, f"{kind} of shape {np.shape(mask)}", "bool")
        self.shape(name, mask, *expected)

    def settings(self, settings: object, **intervals: str) -> None:
        """Refuse fields of a record that lie outside their intervals, as `within` takes them."""
        for name, interval in intervals.items():
            self.within(f"{type(settings).__name__}.{name}", getattr(settings, name), interval)


def _fits(got: tuple[int, ...], shape: tuple[int | str, ...]) -> bool:
    if shape[:1] == ("...",):
        shape = shape[1:]
        got = got[max(len(got) - len(shape), 0) :]
    return len(got) == len(shape) and all(
        length >= 1 if isinstance(axis, str) else length == axis
        for length, axis in zip(got, shape, strict=True)
    )
