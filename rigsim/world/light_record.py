"""Record light that a world's controllers emitted: ended intervals and light in progress."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

from rigsim.boxes.contact_probe.source_shutter import SourceLight
from rigsim.boxes.flash import FlashPop
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.boxes.led_table import LedPulse
from rigsim.boxes.scanner import ProjectorLight

SwitchedLight = LedPulse | PatternLight | SourceLight | ProjectorLight
Light = FlashPop | SwitchedLight


class LightRecord:
    """All light so far, ordered by end time.

    Attributes
    ----------
    pops : list of FlashPop
        All pops.
    switched : list of SwitchedLight
        Intervals of light that have ended.
    """

    def __init__(self) -> None:
        self.pops: list[FlashPop] = []
        self.switched: list[SwitchedLight] = []

    def add(self, light: Light) -> None:
        """Record a pop, or an interval of light that has ended."""
        if isinstance(light, FlashPop):
            self.pops.append(light)
        else:
            self.switched.append(light)

    def between(
        self, start: float, end: float, ongoing: Sequence[SwitchedLight]
    ) -> tuple[Light, ...]:
        """Return pops from `start` to `end`, both included, and other light clipped to them, s.

        Parameters
        ----------
        start, end
            World times, s.
        ongoing
            Intervals of light that have not ended, as emitted so far.
        """
        first = bisect_right(self.switched, start, key=lambda light: light.t_off_s)
        clipped = (
            replace(light, t_on_s=max(light.t_on_s, start), t_off_s=min(light.t_off_s, end))
            for light in [*self.switched[first:], *ongoing]
            if light.t_on_s < end and light.t_off_s > start
        )
        return (*self.pops_between(start, end), *clipped)

    def pops_between(self, start: float, end: float) -> tuple[FlashPop, ...]:
        """Return the pops from `start` to `end`, both included, in s."""
        return tuple(pop for pop in self.pops if start <= pop.t_s <= end)
