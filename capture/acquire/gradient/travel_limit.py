"""How far skin lets itself be moved: it buckles, comes off, or meets the force limit."""

from dataclasses import dataclass
from typing import Literal

from capture.devices.caliper import MoveReport
from capture.rig import Caliper

EndKind = Literal["buckled", "detached", "force"]

BUCKLING_FORCE_RATIO = 0.7
"""Skin whose push grows by less than this part of its growth a step before has buckled."""
PLATEAU_FORCE_RATIO = 0.05
"""Below this part the step before had reached the plateau already."""

_END_DESCRIPTIONS: dict[EndKind, str] = {
    "buckled": "the skin buckled: its push grew no more",
    "detached": "the skin came off the tape",
    "force": "the force limit was met",
}


@dataclass(frozen=True, slots=True)
class End:
    """Where a way ended."""

    kind: EndKind
    position: int
    """First position that is not to be had."""
    reading_mm: float
    """Distance of the jaws when this was found, mm."""
    force_n: float
    """Force then, N."""


class EndOfSkin(Exception):
    """Skin cannot be moved further this way.

    Attributes
    ----------
    end : End
    """

    def __init__(self, end: End) -> None:
        super().__init__(
            f"{_END_DESCRIPTIONS[end.kind]} at {end.reading_mm:.2f} mm ({end.force_n:+.3f} N)"
        )
        self.end = end


class ForceWatch:
    """Follows the force step by step one way from neutral.

    Parameters
    ----------
    caliper
        For the readings.
    direction
        -1 compresses, +1 stretches.
    at_rest_n
        Force at neutral, N.

    Notes
    -----
    Compressed skin pushes the jaws apart, about in proportion, until it buckles out of its plane;
    from then on its push stays. A position whose push has grown by less than `BUCKLING_FORCE_RATIO`
    of the mean growth a step is behind the onset. Where it has not grown at all the position before
    was behind it, too, by less than what would have shown then: it is given up as well.
    """

    def __init__(self, caliper: Caliper, direction: int, *, at_rest_n: float) -> None:
        self._caliper = caliper
        self._direction = direction
        self._pushes = [-at_rest_n]

    def check(self, position: int, report: MoveReport, force_n: float) -> None:
        """Note a position that was reached.

        Raises
        ------
        EndOfSkin
            Where this is one too far.
        """
        if report.ended == "detached":
            raise EndOfSkin(End("detached", position, report.reading_mm, report.force_n))
        if report.ended == "force":
            raise EndOfSkin(End("force", position, report.reading_mm, report.force_n))
        if self._direction > 0:
            return
        pushes = self._pushes
        pushes.append(-force_n)
        if len(pushes) < 3:
            return
        growth = pushes[-1] - pushes[-2]
        before = (pushes[-2] - pushes[0]) / (len(pushes) - 2)
        if growth >= BUCKLING_FORCE_RATIO * before:
            return
        # of two steps the first may already be on the plateau
        early = growth < PLATEAU_FORCE_RATIO * before and len(pushes) > 3
        first = position + 1 if early else position
        raise EndOfSkin(End("buckled", first, report.reading_mm, force_n))
