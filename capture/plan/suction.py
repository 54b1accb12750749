"""Divide the steps of a placement into periods of suction and rests of the skin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from capture.rig import Probe

WIRE_SLACK_S = 0.1
"""Time for commands and camera in addition to exposure and readout, s."""
PUMP_TIME_S = 2.0
"""Typical time until a pump reaches its suction, s."""


class ProbeStep(Protocol):
    """Attributes of a plan's step that this module needs."""

    @property
    def kind(self) -> str:
        """Kind of capture."""

    @property
    def index(self) -> Mapping[str, str | int | float]:
        """Position in its series."""

    @property
    def settings(self) -> Mapping[str, str | int | float | bool]:
        """Settings by name."""


@dataclass(frozen=True, slots=True)
class HeadPlacement:
    """Placement of the head by a person; another repeat is another placement."""

    site: str
    angle_deg: float
    repeat: int

    def __str__(self) -> str:
        again = f", repeat {self.repeat}" if self.repeat else ""
        return f"{self.site} at {self.angle_deg:g} degrees{again}"


def step_placement(step: ProbeStep) -> HeadPlacement | None:
    """Return the placement of the head for a step; None when it does not matter.

    Examples
    --------
    >>> from capture.plan import Step
    >>> index = {"site": "cheek", "repeat": 0, "angle": 22.5, "bracket": 3}
    >>> str(step_placement(Step("s", "fibers", index, {}, ("cam",))))
    'cheek at 22.5 degrees'
    """
    if step.kind == "mask":
        return HeadPlacement("phantom", 0.0, 0)
    if step.kind not in ("fibers", "phantom"):
        return None
    index = step.index
    return HeadPlacement(str(index["site"]), float(index["angle"]), int(index["repeat"]))


def exposure_time_per_suction_s(probe: Probe) -> float:
    """Return the time for exposures and their readout in one suction, s.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> exposure_time_per_suction_s(load_rig("probe").probe)
    57.0
    """
    return probe.max_suction_s - PUMP_TIME_S - probe.settle_s


def split_into_suctions(seconds: Sequence[float], probe: Probe) -> list[range]:
    """Return the exposures of a placement that share a suction, each with its readout, s.

    Examples
    --------
    >>> from capture.plan.probe import exposure_series_s
    >>> from capture.rig import load_rig
    >>> split_into_suctions([t + 0.3 for t in exposure_series_s()], load_rig("probe").probe)
    [range(0, 21), range(21, 23)]
    """
    found: list[range] = []
    first, used_s = 0, 0.0
    for number, one_s in enumerate(seconds):
        if number > first and used_s + one_s + WIRE_SLACK_S > exposure_time_per_suction_s(probe):
            found.append(range(first, number))
            first, used_s = number, 0.0
        used_s += one_s + WIRE_SLACK_S
    return [*found, range(first, len(seconds))] if seconds else found


def suction_overhead_s(steps: Sequence[ProbeStep], seconds: Sequence[float], probe: Probe) -> float:
    """Return the time that suction and rests add to a plan's steps with given durations, s."""
    count, held, group = 0, None, list[float]()
    for step, one_s in zip(steps, seconds, strict=True):
        place = step_placement(step) if "suction_mbar" in step.settings else None
        if place != held:
            count += len(split_into_suctions(group, probe))
            held, group = place, []
        if place is not None:
            group.append(one_s)
    count += len(split_into_suctions(group, probe))
    # the skin rests between two suctions, also of different placements
    return count * (PUMP_TIME_S + probe.settle_s) + max(count - 1, 0) * probe.rest_s
