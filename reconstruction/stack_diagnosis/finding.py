"""One fault of a set of images, with what supports it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Axes: TypeAlias = tuple[str, str, str]
"""Components of a row as x, y and z, such as ("-x", "y", "z")."""


_NUMBER_IN_TEXT = re.compile(r"(?<=\bimage )\d+|(?<=\blight )\d+|(?<=\bimages )\d+|(?<= and )\d+")


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
        The measured quantity, in words and numbers; "image 3" and "light 3" count from 1.
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

    def renumber(self, numbers: Sequence[int] | NDArray[np.intp]) -> Finding:
        """Return a finding about some of the images with the numbers of all, also in its text.

        Parameters
        ----------
        numbers
            Of each of these images among all, from 0.

        Examples
        --------
        >>> one = Finding("moved image", (1,), "image 2 is shifted by (3.0, 2.0) pixels", 1, 1, "")
        >>> one.renumber([0, 2, 3]).evidence
        'image 3 is shifted by (3.0, 2.0) pixels'
        """

        def state(match: re.Match[str]) -> str:
            at = int(match[0]) - 1
            return str(int(numbers[at]) + 1) if 0 <= at < len(numbers) else match[0]

        order = None
        if self.order is not None and len(self.order) == len(numbers):
            order = tuple(int(numbers[k]) for k in self.order)
        frames = tuple(int(numbers[k]) for k in self.frames)
        evidence = _NUMBER_IN_TEXT.sub(state, self.evidence)
        return replace(self, frames=frames, order=order, evidence=evidence)

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
