"""Light that came out of a world's boxes: what has ended, and what still shines."""

import dataclasses
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import TypeVar

from rigsim.boxes.dome import LedPulse
from rigsim.boxes.flash import FlashPop
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.boxes.probe import SourceLight

SwitchedLight = LedPulse | PatternLight | SourceLight
"""A stretch of steady light: of an LED, of a pattern, or out of a fibre."""

Light = FlashPop | SwitchedLight
"""Light out of a box: a pop of the flash, or a stretch of an LED's, a pattern's or a fibre's."""

_Switched = TypeVar("_Switched", bound=SwitchedLight)


def _none(now: float) -> list[_Switched]:
    return []


class LightRecord:
    """All light so far, of each kind in the order in which it ended.

    Attributes
    ----------
    pops : list of FlashPop
        All pops.
    pulses, patterns, sources : list of LedPulse, PatternLight, SourceLight
        Stretches of light that have ended.
    pulses_now, patterns_now, sources_now : callable
        Given the world's time in s, the stretches that have not, as given so far; the boxes that
        switch them put them here.
    """

    def __init__(self) -> None:
        self.pops: list[FlashPop] = []
        self.pulses: list[LedPulse] = []
        self.patterns: list[PatternLight] = []
        self.sources: list[SourceLight] = []
        self.pulses_now: Callable[[float], Sequence[LedPulse]] = _none
        self.patterns_now: Callable[[float], Sequence[PatternLight]] = _none
        self.sources_now: Callable[[float], Sequence[SourceLight]] = _none

    def between(self, start: float, end: float, *, now: float) -> tuple[Light, ...]:
        """Return pops from `start` to `end`, both included, and other light clipped to them, s.

        Parameters
        ----------
        start, end
            World times, s.
        now
            The world's time, s: up to then what still shines has shone.
        """
        return (
            *self.pops_between(start, end),
            *_clipped(self.pulses, self.pulses_now(now), start, end),
            *_clipped(self.patterns, self.patterns_now(now), start, end),
            *_clipped(self.sources, self.sources_now(now), start, end),
        )

    def pops_between(self, start: float, end: float) -> tuple[FlashPop, ...]:
        """Return the pops from `start` to `end`, both included, in s."""
        return tuple(pop for pop in self.pops if start <= pop.t_s <= end)


def _clipped(
    ended: Sequence[_Switched], going_on: Sequence[_Switched], start: float, end: float
) -> list[_Switched]:
    """Return light, in the order in which it ended, clipped to what lies from start to end."""
    first = bisect_right(ended, start, key=lambda light: light.t_off_s)
    return [
        dataclasses.replace(light, t_on_s=max(light.t_on_s, start), t_off_s=min(light.t_off_s, end))
        for light in [*ended[first:], *going_on]
        if light.t_on_s < end and light.t_off_s > start
    ]
