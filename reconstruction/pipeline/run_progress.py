"""Report the progress of a run of stages, and estimate the seconds that are left."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

OTHER_STAGE_S: Final = 0.3
"""Typical seconds of a stage without an entry."""
OVERRUN_FRACTION: Final = 0.25
"""Estimated rest of a stage that takes longer than expected, over its seconds so far."""
MIN_KNOWN_FRACTION: Final = 0.05
"""Fraction of the typical seconds that must be done before the rest is estimated."""


@dataclass(slots=True)
class RunProgress:
    """Progress of a run.

    Attributes
    ----------
    report
        Called with a line of text and the estimated seconds that are left, None where unknown.
        None: nothing is reported.
    typical_seconds
        Seconds of the stages on one machine at one size, by the first word of their names. Only
        their ratios matter.
    clock
        Seconds.
    """

    report: Callable[[str, float | None], None] | None = None
    typical_seconds: Mapping[str, float] = field(default_factory=dict)
    clock: Callable[[], float] = time.perf_counter
    _waiting: dict[str, float] = field(default_factory=dict)
    _total: float = 0.0
    _started_s: float = 0.0
    _stage_started_s: float = 0.0
    _stage: float = 0.0
    _fraction: float = 0.0
    """Fraction of the current stage's tiles that is done."""

    def plan(self, stages: Iterable[str]) -> None:
        """Set the stages that will run."""
        self._waiting = {
            name: self.typical_seconds.get(name.split()[0], OTHER_STAGE_S) for name in stages
        }
        self._total = sum(self._waiting.values())
        self._started_s = self.clock()
        self._stage = self._fraction = 0.0

    def begin_stage(self, name: str) -> None:
        """Report the beginning of a stage."""
        self._stage = self._waiting.pop(name, 0.0)
        self._stage_started_s = self.clock()
        self._fraction = 0.0
        self._report_text(name)

    def begin_tile(self, name: str, number: int, total: int) -> None:
        """Report the beginning of a tile; ``number`` earlier ones are done."""
        self._fraction = number / total
        self._report_text(f"{name}: {number}/{total}" if total > 1 else name)

    def seconds_left(self) -> float | None:
        """Estimate the seconds that are left.

        The pace is that of all stages and tiles that are done. The rest of a stage follows from its
        own tiles, if enough of them are done.
        """
        rest = sum(self._waiting.values())
        before = self._total - rest - self._stage
        now = self.clock()
        elapsed, in_stage = now - self._started_s, now - self._stage_started_s
        if self._fraction >= MIN_KNOWN_FRACTION:
            done = before + self._fraction * self._stage
            pace = elapsed / done if done > 0.0 else 0.0
            return in_stage * (1.0 / self._fraction - 1.0) + pace * rest
        if before < MIN_KNOWN_FRACTION * self._total or before <= 0:
            return None
        pace = (elapsed - in_stage) / before
        if self._stage and in_stage > pace * self._stage:  # slower than the stages before it
            return elapsed / (before + self._stage) * rest + OVERRUN_FRACTION * in_stage
        return pace * (rest + self._stage) - in_stage

    def _report_text(self, text: str) -> None:
        if self.report is not None:
            self.report(text, self.seconds_left())
