"""One fault of a set of images, with what supports it."""

from __future__ import annotations

from dataclasses import dataclass


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
    cost_deg
        Median change of the normals by the fault, degrees; None where it was not computed.
    order
        Row of the list for each image, if the finding proposes another order.
    """

    fault: str
    frames: tuple[int, ...]
    evidence: str
    measured: float
    limit: float
    remedy: str
    cost_deg: float | None = None
    order: tuple[int, ...] | None = None

    @property
    def strength(self) -> float:
        """The measured quantity over its limit, at least 1; larger is more certain."""
        return self.measured / self.limit
