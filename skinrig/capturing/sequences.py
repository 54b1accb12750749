"""Describe and plan sequences in time on the flash rig: prompted expressions and events."""

from dataclasses import dataclass
from typing import Any

from capture.plan import Plan
from capture.plan.multiplexed import course_plan, multiplexed_plan
from capture.plan.phases import phase_coverage
from capture.rig import Rig

EVENT_STATES = ("exercise", "alcohol")
"""States that follow an event instead of prompts."""
EVENT_DURATIONS_S = {"exercise": "60", "alcohol": "3600"}
"""Default duration of the observation, s: Jimenez et al. 2010, section 3."""
EVENT_SHOT_PERIODS_S = {"exercise": "5.5", "alcohol": "300"}
"""Default time from shot to shot, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SequenceOrder:
    """Options of a sequence; times are kept as the decimal text that the user typed."""

    state: str
    """An expression that prompts start and end, or one of :data:`EVENT_STATES`."""
    prompt_period_s: str = "5"
    """Time from prompt to prompt, s."""
    shot_period_s: str | None = None
    """Time from shot to shot, s; None: 5.5, or as :data:`EVENT_SHOT_PERIODS_S`."""
    captures: int | None = None
    """Shots of a prompted sequence; None: every phase, a tenth of them twice."""
    duration_s: str | None = None
    """Duration of the observation after an event, s; None: as :data:`EVENT_DURATIONS_S`."""
    reaction_s: float | None = None
    """Mean reaction time from prompt to movement, s, of the simulated subject; None: the
    simulator's default. Not used with a real subject."""

    @property
    def is_prompted(self) -> bool:
        """Whether prompts, not an event, control the sequence."""
        return self.state not in EVENT_STATES

    def document(self) -> dict[str, Any]:
        """Return the sequence as JSON values."""
        values: dict[str, Any] = {
            "state": self.state,
            "prompt_period_s": self.prompt_period_s if self.is_prompted else None,
            "shot_period_s": self.shot_period_s,
            "captures": self.captures,
            "duration_s": self.duration_s,
        }
        return values if self.reaction_s is None else values | {"reaction_s": self.reaction_s}


def sequence_plan(rig: Rig, order: SequenceOrder, *, darks: int = 4) -> Plan:
    """Return the plan of a sequence.

    Raises
    ------
    PlanError
        If it cannot be planned: `capture.plan.multiplexed.ReadOutError` for too slow a camera.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = sequence_plan(load_rig("flash"), SequenceOrder(state="alcohol"), darks=0)
    >>> plan.steps[-1].settings["start_s"]
    3600.0
    """
    if order.is_prompted:
        return multiplexed_plan(
            rig,
            state=order.state,
            prompt_period_s=order.prompt_period_s,
            shot_period_s=order.shot_period_s or "5.5",
            captures=order.captures,
            darks=darks,
        )
    return course_plan(
        rig,
        state=order.state,
        duration_s=order.duration_s or EVENT_DURATIONS_S[order.state],
        shot_period_s=order.shot_period_s or EVENT_SHOT_PERIODS_S[order.state],
        darks=darks,
    )


def sequence_lines(plan: Plan) -> list[str]:
    """Describe the phase coverage of a prompted sequence in one line; empty for other plans.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> lines = sequence_lines(sequence_plan(load_rig("flash"), SequenceOrder(state="smile")))
    >>> lines[0].partition(":")[0]
    '22 captures meet 20 distinct phases of the 10 s cycle, 2 of them again'
    """
    if plan.limits.get("prompt_period_s", 0.0) > 0:
        return [str(phase_coverage(plan))]
    return []
