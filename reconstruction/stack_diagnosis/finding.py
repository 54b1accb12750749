"""One fault of a set of images, with what supports it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

Axes: TypeAlias = tuple[str, str, str]
"""Components of a row as x, y and z, such as ("-x", "y", "z")."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault of images under listed lights.

    Attributes
    ----------
    fault
        Kind, such as "swapped lights".
    frames
        Numbers of the images concerned, from 0 in the order of the list; empty: all of them.
    evidence
        The measured quantity, in words and numbers.
    measured, limit
        The measured quantity, and the value from which it counts as a fault.
    remedy
        What the user does.
    order
        Row of the list for each image, if the finding proposes another order.
    axes
        Components of a row, if the finding proposes others.
    """

    fault: str
    frames: tuple[int, ...]
    evidence: str
    measured: float
    limit: float
    remedy: str
    order: tuple[int, ...] | None = None
    axes: Axes | None = None

    @property
    def ratio_to_limit(self) -> float:
        """The measured quantity over its limit, at least 1; larger is more certain."""
        return self.measured / self.limit

    def to_json(self) -> dict[str, Any]:
        """Return the finding with numbers of images from 1, as they are written."""
        return {
            "fault": self.fault,
            "images": [number + 1 for number in self.frames],
            "evidence": self.evidence,
            "measured": self.measured,
            "limit": self.limit,
            "remedy": self.remedy,
        }
