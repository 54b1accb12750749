"""Parse and resolve the held-out lights and views that evaluate a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from model.checks import Checks

FIELD_NAMES = ("lights", "views")


class HoldOutError(ValueError):
    """Held-out names that are malformed or not in the session."""


@dataclass(frozen=True, slots=True)
class HoldOut:
    """Names of lights and views whose frames are excluded from every fit.

    Attributes
    ----------
    lights, views
        Names or, before `resolve`, indices in the session's order, counted from 0.
    """

    lights: tuple[str, ...] = ()
    views: tuple[str, ...] = ()

    @staticmethod
    def parse(text: str) -> HoldOut:
        """Parse ``lights=L007,L023,views=C03``; a word without = continues the list before it.

        Raises
        ------
        HoldOutError
            For any other field, and for empty lists.

        Examples
        --------
        >>> HoldOut.parse("lights=L007,23,views=C03")
        HoldOut(lights=('L007', '23'), views=('C03',))
        """
        lists: dict[str, list[str]] = {}
        field, check = "", Checks(HoldOutError)
        expected = "lights=NAMES,views=NAMES, each at most once, names or numbers joined by commas"
        for word in text.split(","):
            name, equals, first = word.partition("=")
            if equals:
                field, word = name.strip(), first
                known = field in FIELD_NAMES and field not in lists
                check.require(known, "hold-out", f"{field!r} in {text!r}", expected)
                lists[field] = []
            check.require(field and word.strip(), "hold-out", repr(text), expected)
            lists[field].append(word.strip())
        return HoldOut(tuple(lists.get("lights", ())), tuple(lists.get("views", ())))

    def resolve(self, lights: Sequence[str], views: Sequence[str]) -> HoldOut:
        """Resolve names and indices to names in the session's order.

        Parameters
        ----------
        lights, views
            Names of lights and views with frames in the session.

        Raises
        ------
        HoldOutError
            For names and indices that the session lacks.
        """
        return HoldOut(_found("lights", self.lights, lights), _found("views", self.views, views))

    def __bool__(self) -> bool:
        """Return whether any light or view is held out."""
        return bool(self.lights or self.views)

    def is_held_out(self, light: str, view: str) -> bool:
        """Return whether a frame of this light and view is excluded from the fits."""
        return light in self.lights or view in self.views

    def record(self) -> dict[str, list[str]]:
        """Return the held-out names as JSON values."""
        return {"lights": list(self.lights), "views": list(self.views)}


NO_HOLD_OUT = HoldOut()
"""All frames enter the fits."""


def _found(field: str, asked: Sequence[str], there: Sequence[str]) -> tuple[str, ...]:
    known_names = f"names out of {', '.join(there)}"
    expected = f"{known_names} or numbers from 0 to {len(there) - 1}; choose some of these"
    chosen = set()
    for word in asked:
        number = int(word) if word.isascii() and word.isdigit() else len(there)
        known = word in there or number < len(there)
        Checks(HoldOutError).require(known, "hold-out", f"{word!r} among the {field}", expected)
        chosen.add(word if word in there else there[number])
    return tuple(name for name in there if name in chosen)
