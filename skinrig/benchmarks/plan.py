"""Select the stages that fit into a time budget at full size.

Without stage names, `skinrig bench` first measures every stage at small size, which takes 1 to 18
seconds each, so that none is missing. It then measures at full size, the quickest first, while the
budget lasts. Limits apply to full sizes and are evaluated at no other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from skinrig.benchmarks.stage import read_descriptions

TIME_SAFETY_FACTOR: Final = 1.25
"""A stage starts if the time left is at least this multiple of its expected time."""
REPORT_RESERVE_S: Final = 20.0
"""Time reserved for tables and plots at the end, s."""
MIN_PACE_SAMPLE_S: Final = 10.0
"""Expected time of measured full-size stages above which the machine's pace is estimated, s."""
DEFAULT_STAGE_S: Final = 120.0
"""Expected time of a stage that :data:`FULL_S` lacks, s."""


@dataclass(slots=True)
class MachinePace:
    """Pace of this machine: measured over expected time (:data:`FULL_S`) of stages."""

    expected_s: float = 0.0
    measured_s: float = 0.0

    def add(self, expected_s: float, measured_s: float) -> None:
        """Add a stage that was measured at full size."""
        self.expected_s += expected_s
        self.measured_s += measured_s

    @property
    def factor(self) -> float:
        """Measured over expected time; 1 below :data:`MIN_PACE_SAMPLE_S`."""
        return self.measured_s / self.expected_s if self.expected_s > MIN_PACE_SAMPLE_S else 1.0

    def fits(self, expected_s: float, left_s: float) -> bool:
        """Return whether a stage is expected to end within ``left_s``, with a safety factor.

        Examples
        --------
        >>> MachinePace(expected_s=20.0, measured_s=40.0).fits(10.0, left_s=24.0)
        False
        >>> MachinePace(expected_s=20.0, measured_s=40.0).fits(10.0, left_s=26.0)
        True
        """
        return TIME_SAFETY_FACTOR * self.factor * expected_s <= left_s


def order_small_stages(names: Iterable[str]) -> list[str]:
    """Return stages ordered by their time at small size, the quickest first.

    A budget that is too small for all of them then omits the fewest.

    Examples
    --------
    >>> order_small_stages(["traits", "hdr", "normals"])
    ['hdr', 'normals', 'traits']
    """
    return sorted(names, key=lambda name: SMALL_S.get(name, 1.0))


def order_full_stages(
    names: Iterable[str], seconds: Mapping[str, float]
) -> list[tuple[str, float]]:
    """Return stages with their expected seconds at full size, the quickest first.

    Examples
    --------
    >>> order_full_stages(["a", "b", "c"], {"a": 2.0, "b": 1.0})
    [('b', 1.0), ('a', 2.0), ('c', 120.0)]
    """
    return sorted(
        ((name, seconds.get(name, DEFAULT_STAGE_S)) for name in names), key=lambda pair: pair[1]
    )


SMALL_S: Final[dict[str, float]] = {
    name: entry["small_s"] for name, entry in read_descriptions().items() if "small_s" in entry
}
"""Processor seconds at small size, of stages that take more than about 1 s."""

FULL_S: Final[dict[str, float]] = {
    name: entry["full_s"] for name, entry in read_descriptions().items() if "full_s" in entry
}
"""Approximate seconds at full size on two otherwise idle cores: processor time of the main thread
plus half of that of all other threads, which run on two cores. The addition for errors by melanin
band is estimated from small sizes."""
