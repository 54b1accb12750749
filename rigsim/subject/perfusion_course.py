"""Model the course of blood in time after prompts, exercise and alcohol.

A state's vessels are dilated by a fraction of the dilation in `rigsim.subject.perfusion`. Strained
skin presses them by the same fraction of its pressure. This fraction is the state's level: 0 at
rest, 1 in full. It relaxes toward its target, with separate time constants of rise and fall. The
person responds to a prompt after a reaction time that varies between prompts. The flush of exercise
is largest when it ends, and decays; alcohol is absorbed after the drink.
"""

import bisect
import dataclasses
import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.subject.perfusion import STATE_NAMES, Perfusion, StateError
from rigsim.subject.person import SimulatedSubject

EXPRESSION_TAU_S: Final = 0.02
"""Time constant of the blood of an expression, s. Jimenez et al. 2010, section 3.1, observed no
phase between two states at samples 0.25 s apart: mostly, the moving face squeezes its skin."""

REACTION_TIME_S: Final = 0.16
"""Time from a sound to the movement, s; simple reactions to sounds take about 0.16 s."""

REACTION_STD_S: Final = 0.02
"""Standard deviation of the reaction time, s."""

EXERCISE_TAU_S: Final = 40.0
"""Time constant of the flush after exercise, s."""

ALCOHOL_TAU_S: Final = 1200.0
"""Time constant of the flush after a drink, s."""


class CourseError(ValueError):
    """An invalid course of blood."""


class PerfusionCourse(Protocol):
    """Interface of a state's blood in time."""

    @property
    def state(self) -> str:
        """State, one of `rigsim.subject.perfusion.STATE_NAMES`."""

    def prompt(self, now_s: float, state: str) -> None:
        """Prompt the person to show a state, at a world time in s."""

    def level(self, t_s: float) -> float:
        """Return the fraction of the state's dilation at a world time, 0 to 1."""

    def pose(self, t_s: float) -> str:
        """Return the state that the face shows by its movement at a world time."""


@dataclass(slots=True)
class PromptedCourse:
    """Blood of an expression that a person starts and ends at prompts.

    Parameters
    ----------
    state
        The expression; any other prompt requests rest.
    rise_s, fall_s
        Time constants of filling and emptying, s, > 0.
    reaction_s
        Mean time from prompt to movement, s, >= 0.
    reaction_spread_s
        Its standard deviation, s, >= 0; no reaction precedes its prompt.
    seed
        Seed of the reaction times.

    Examples
    --------
    >>> course = PromptedCourse("smile", rise_s=2.0, reaction_s=0.5, reaction_spread_s=0.0)
    >>> course.prompt(10.0, "smile")
    >>> [round(course.level(t), 3) for t in (10.4, 12.5, 100.0)]
    [0.0, 0.632, 1.0]
    >>> course.pose(10.4), course.pose(10.6)
    ('neutral', 'smile')
    """

    state: str
    rise_s: float = EXPRESSION_TAU_S
    fall_s: float = EXPRESSION_TAU_S
    reaction_s: float = REACTION_TIME_S
    reaction_spread_s: float = REACTION_STD_S
    seed: int = 0
    _moves: list[tuple[float, float, float]] = dataclasses.field(default_factory=list)
    """World time of each movement, s; the level at that time; the target level."""

    def __post_init__(self) -> None:
        _check_state(self.state)
        for name in ("rise_s", "fall_s"):
            _require(0 < getattr(self, name) < math.inf, name, getattr(self, name), "seconds > 0")
        for name in ("reaction_s", "reaction_spread_s"):
            _require(0 <= getattr(self, name) < math.inf, name, getattr(self, name), "seconds >= 0")

    def prompt(self, now_s: float, state: str) -> None:
        """Prompt the person at a world time, s."""
        number = len(self._moves)
        rng = np.random.default_rng([self.seed, 90, number])
        late_s = max(0.0, self.reaction_s + self.reaction_spread_s * rng.standard_normal())
        moved_s = now_s + late_s
        if self._moves:
            moved_s = max(moved_s, self._moves[-1][0])
        self._moves.append((moved_s, self.level(moved_s), float(state == self.state)))

    def level(self, t_s: float) -> float:
        """Return the level of the expression's blood at a world time, s: 0 to 1."""
        number = bisect.bisect_right(self._moves, t_s, key=lambda move: move[0]) - 1
        if number < 0:
            return 0.0
        since_s, from_level, to_level = self._moves[number]
        constant_s = self.rise_s if to_level > from_level else self.fall_s
        return to_level + (from_level - to_level) * math.exp(-(t_s - since_s) / constant_s)

    def pose(self, t_s: float) -> str:
        """Return the state that the face shows at a world time, s; movements are instant."""
        number = bisect.bisect_right(self._moves, t_s, key=lambda move: move[0]) - 1
        return self.state if number >= 0 and self._moves[number][2] > 0 else "neutral"


@dataclass(slots=True)
class EventCourse:
    """Blood after a single event, whose end is the prompt.

    Parameters
    ----------
    state
        "exercise", which is largest at the prompt and decays, or "alcohol", which rises; the
        held ones of the other states decay.
    constant_s
        Time constant, s, > 0; None: that of the state.

    Examples
    --------
    >>> course = EventCourse("exercise", constant_s=30.0)
    >>> course.prompt(100.0, "exercise")
    >>> [round(course.level(t), 3) for t in (99.0, 100.0, 130.0)]
    [0.0, 1.0, 0.368]
    """

    state: str
    constant_s: float | None = None
    _over_s: float = math.inf

    def __post_init__(self) -> None:
        _check_state(self.state)
        given = self.constant_s
        _require(given is None or 0 < given < math.inf, "constant_s", given, "seconds > 0")

    @property
    def relaxation_s(self) -> float:
        """Time constant, s."""
        if self.constant_s is not None:
            return self.constant_s
        return ALCOHOL_TAU_S if self.state == "alcohol" else EXERCISE_TAU_S

    def prompt(self, now_s: float, state: str) -> None:
        """End the event at a world time, s; it may be before 0 where a world began later."""
        if state == self.state and math.isinf(self._over_s):
            self._over_s = now_s

    def level(self, t_s: float) -> float:
        """Return the level of the state's blood at a world time, s: 0 to 1."""
        if t_s < self._over_s:
            return 0.0
        left = math.exp(-(t_s - self._over_s) / self.relaxation_s)
        return 1.0 - left if self.state == "alcohol" else left

    def pose(self, t_s: float) -> str:
        """Return "neutral": neither exercise nor alcohol moves the face in an image."""
        return "neutral"


@dataclass(frozen=True, slots=True)
class FixedPerfusion(Perfusion):
    """Vessels at a fraction of one state's change, independent of the displayed state."""

    base: str = "neutral"
    """State of the blood."""
    level: float = 0.0
    """Fraction of its change, 0 to 1."""
    pressure_mbar: Float32Array | None = None
    """Change of the pressure around the vessels at level 1, mbar, shape (...); None: no change."""

    def dilation(self, state: str) -> Float32Array:
        """Return the vascular change of the radius, shape (...); ``state`` is not used."""
        return np.asarray(np.float32(self.level) * Perfusion.dilation(self, self.base))

    def blood(
        self, state: str = "neutral", pressure_mbar: Float32Array | None = None
    ) -> Float32Array:
        """Return the blood volume fraction, shape (...); the arguments are not used."""
        own = self.pressure_mbar
        return Perfusion.blood(self, state, None if own is None else np.float32(self.level) * own)


def fix_blood_level(subject: SimulatedSubject, state: str, level: float) -> SimulatedSubject:
    """Return a face whose blood stays at a level of one state in every displayed state.

    Parameters
    ----------
    subject
        The face.
    state
        State of the blood, one of `rigsim.subject.perfusion.STATE_NAMES`.
    level
        Fraction of the state's dilation of the vessels and of its pressure on them, 0 to 1.

    Raises
    ------
    CourseError
        For another level.
    rigsim.subject.perfusion.StateError
        For an unknown state.

    Examples
    --------
    >>> from rigsim.subject import make_subject
    >>> face = make_subject(size=64)
    >>> half = fix_blood_level(face, "exercise", 0.5).hemoglobin("neutral").mean()
    >>> bool(face.hemoglobin().mean() < half < face.hemoglobin("exercise").mean())
    True
    """
    _check_state(state)
    _require(0.0 <= level <= 1.0, "level", level, "0 to 1")
    own = subject.perfusion
    pressure = subject.tissue_pressure_mbar(state)
    held = FixedPerfusion(
        own.compartments, own.points_mm, own.regions, own.seed, state, level, pressure
    )
    return dataclasses.replace(subject, perfusion=held)


def _check_state(state: str) -> None:
    if state not in STATE_NAMES or state == "neutral":
        expected = ", ".join(name for name in STATE_NAMES if name != "neutral")
        raise StateError(f"state: got {state!r}, expected one of {expected}")


def _require(good: bool, name: str, got: object, expected: str) -> None:
    if not good:
        raise CourseError(f"{name}: got {got!r}, expected {expected}")
