"""Which stages fit into a budget at full size, once all were measured at their small one.

Without names `skinrig bench` measures every stage: first at its small size, which takes
1 to 18 seconds, so that none is missing; then, the quickest first, at full size as long as the
budget lasts. Limits are promises about full sizes and are judged at no other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from skinrig.benchmarks.stage import read_descriptions

TIME_SAFETY_FACTOR: Final = 1.25
"""A stage begins if so many times what it should take is left."""
REPORT_RESERVE_S: Final = 20.0
"""What tables and plots take at the end."""
MIN_PACE_SAMPLE_S: Final = 10.0
"""Seconds of full sizes after which the pace of this machine counts as known."""
DEFAULT_STAGE_S: Final = 120.0
"""Seconds of a stage that :data:`FULL_S` lacks."""


@dataclass(slots=True)
class MachinePace:
    """How much longer stages take on this machine than :data:`FULL_S` says."""

    expected_s: float = 0.0
    measured_s: float = 0.0

    def add(self, expected_s: float, measured_s: float) -> None:
        """Count a stage that was measured at full size."""
        self.expected_s += expected_s
        self.measured_s += measured_s

    @property
    def factor(self) -> float:
        """Seconds taken over seconds told; 1 while too little was measured."""
        return self.measured_s / self.expected_s if self.expected_s > MIN_PACE_SAMPLE_S else 1.0

    def fits(self, expected_s: float, left_s: float) -> bool:
        """Return whether a stage will end within ``left_s``, with some to spare.

        Examples
        --------
        >>> MachinePace(expected_s=20.0, measured_s=40.0).fits(10.0, left_s=24.0)
        False
        >>> MachinePace(expected_s=20.0, measured_s=40.0).fits(10.0, left_s=26.0)
        True
        """
        return TIME_SAFETY_FACTOR * self.factor * expected_s <= left_s


def order_small_stages(names: Iterable[str]) -> list[str]:
    """Return stages in the order of their small sizes, those that take about a second first.

    Then a budget that is too small for all leaves the fewest out.

    Examples
    --------
    >>> order_small_stages(["traits", "hdr", "normals"])
    ['hdr', 'normals', 'traits']
    """
    return sorted(names, key=lambda name: SMALL_S.get(name, 1.0))


def order_full_stages(
    names: Iterable[str], seconds: Mapping[str, float]
) -> list[tuple[str, float]]:
    """Return stages with what each should take at full size, the quickest first.

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
"""Processor seconds at small size of the stages that take more than about one."""

FULL_S: Final[dict[str, float]] = {
    name: entry["full_s"] for name, entry in read_descriptions().items() if "full_s" in entry
}
"""About how many seconds each takes at full size on two cores that do nothing else: of a run alone,
the processor seconds of the main thread and half of those of all others, which share two cores.
What errors by melanin band add to that is estimated from small sizes."""
