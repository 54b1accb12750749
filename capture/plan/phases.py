"""Phases of a cycle that a series of shots samples.

Periods are taken as the decimals in which they are written, and counted as fractions: the sampled
phases depend on common measures, which rounded numbers do not have.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from capture.documents import Fault, short_repr
from capture.plan.steps import Plan, PlanError, Step, require_argument

Seconds = int | float | str | Decimal | Fraction
"""A time; numbers count as the decimals in which they are printed."""


MIN_PHASES = 8
"""Minimum number of phases, four in each half of the cycle; fewer alias."""


_MAX_PERIOD_DENOMINATOR = 10**6
"""Largest denominator of a period in s; finer ones are rounded to it."""


@dataclass(frozen=True, slots=True)
class PhaseGrid:
    """Phases of a cycle that a series of shots can sample."""

    cycle_s: Fraction
    """Duration of the cycle, s."""
    shot_period_s: Fraction
    """Time from shot to shot, s."""
    distinct: int
    """Number of distinct phases; after that they repeat."""
    interval_s: Fraction
    """Time between neighboring phases, all of them sampled, s: the effective sampling interval."""

    @property
    def is_aliased(self) -> bool:
        """Whether too few phases are sampled to resolve the course between the states."""
        return self.distinct < MIN_PHASES


def to_fraction(value: Seconds) -> Fraction:
    """Return a time as the fraction of its decimal notation.

    Examples
    --------
    >>> to_fraction(5.25), to_fraction("0.1") + to_fraction(0.2)
    (Fraction(21, 4), Fraction(3, 10))

    Raises
    ------
    PlanError
        For a value that is not a finite number.
    """
    try:
        number = Fraction(value if isinstance(value, Fraction) else str(value))
    except (ValueError, ZeroDivisionError) as exc:
        fault = Fault("seconds", short_repr(value), "a finite number")
        raise PlanError("cannot plan", faults=[fault]) from exc
    return number.limit_denominator(_MAX_PERIOD_DENOMINATOR)


def phase_grid(prompt_period_s: Seconds, shot_period_s: Seconds) -> PhaseGrid:
    """Return the phases that shots sample of a subject who changes with every prompt.

    Parameters
    ----------
    prompt_period_s
        Time from prompt to prompt, s, > 0; the cycle is twice as long.
    shot_period_s
        Time from shot to shot, s, > 0.

    Examples
    --------
    >>> [phase_grid(5, period).distinct for period in (5.5, 10.25, 5, 10)]
    [20, 40, 2, 1]
    >>> float(phase_grid(5, 10.25).interval_s)
    0.25
    """
    prompt, shot = to_fraction(prompt_period_s), to_fraction(shot_period_s)
    require_argument(prompt > 0, "prompt_period_s", prompt_period_s, "seconds > 0")
    require_argument(shot > 0, "shot_period_s", shot_period_s, "seconds > 0")
    cycle = 2 * prompt
    interval = _common_measure(cycle, shot)
    return PhaseGrid(cycle, shot, int(cycle / interval), interval)


def equivalent_period_s(
    prompt_period_s: Seconds, shot_period_s: Seconds, read_out_s: Seconds
) -> Fraction:
    """Return the shortest feasible period that samples the same phases as another one, s.

    Half cycles are added until the camera can follow. A whole number of cycles changes only the
    order of the phases; an odd number of half cycles may change their number, and is skipped when
    it does.

    Parameters
    ----------
    prompt_period_s, shot_period_s
        See :func:`phase_grid`.
    read_out_s
        Shortest time from shot to shot, s.

    Examples
    --------
    >>> float(equivalent_period_s(5, 5.25, 5.5)), float(equivalent_period_s(5, 2.5, 5.5))
    (10.25, 7.5)
    """
    grid, shortest = phase_grid(prompt_period_s, shot_period_s), to_fraction(read_out_s)
    half = grid.cycle_s / 2
    halves = max(0, math.ceil((shortest - grid.shot_period_s) / half))
    for more in (halves, halves + 1):
        period = grid.shot_period_s + more * half
        if phase_grid(prompt_period_s, period).distinct == grid.distinct:
            return period
    raise AssertionError("a whole cycle more meets the same phases")  # pragma: no cover


@dataclass(frozen=True, slots=True)
class PhaseCoverage:
    """Phases of its cycle that a sequence covers."""

    cycle_s: float
    """Duration of the cycle, s."""
    covered_s: tuple[float, ...]
    """Distinct sampled phases, s, in order."""
    repeats: tuple[int, ...]
    """Number of samples of each, >= 1."""
    captures: int
    """Number of shots."""
    possible: int
    """Number of phases that an endless series of these shots would sample."""
    interval_s: float
    """Time between neighbors of those, s."""
    largest_gap_s: float
    """Longest stretch of the cycle without a shot, s."""

    @property
    def distinct(self) -> int:
        """Number of sampled phases."""
        return len(self.covered_s)

    @property
    def is_aliased(self) -> bool:
        """Whether shot and prompt periods sample too few phases, however long the sequence is."""
        return self.possible < MIN_PHASES

    def __str__(self) -> str:
        again = self.captures - self.distinct
        text = (
            f"{self.captures} captures meet {self.distinct} distinct phases of the "
            f"{self.cycle_s:g} s cycle, {again} of them again: sampled every {self.interval_s:g} s,"
            f" largest gap {self.largest_gap_s:g} s"
        )
        if self.is_aliased:
            text += (
                f"; the periods alias: only {self.possible} phases can be met, "
                "choose a shot period that has less in common with the cycle"
            )
        return text


def phase_coverage(plan: Plan) -> PhaseCoverage:
    """Return the phases of its cycle that the shots of a multiplexed plan sample.

    Raises
    ------
    PlanError
        For a plan without prompts.

    Examples
    --------
    >>> from capture.plan.multiplexed import multiplexed_plan
    >>> from capture.rig import load_rig
    >>> print(phase_coverage(multiplexed_plan(load_rig("flash"), shot_period_s=10.25)))
    44 captures meet 40 distinct phases of the 10 s cycle, 4 of them again: sampled every 0.25 s, \
largest gap 0.25 s
    """
    shots = timed_steps(plan)
    cycle = 2 * to_fraction(plan.limits.get("prompt_period_s", 0.0))
    require_argument(cycle > 0 and bool(shots), "plan", plan.rig, "a plan of multiplexed_plan")
    grid = phase_grid(cycle / 2, to_fraction(plan.limits["shot_period_s"]))
    met: dict[Fraction, int] = {}
    for step in shots:
        phase = to_fraction(float(step.settings["start_s"])) % cycle
        met[phase] = met.get(phase, 0) + 1
    covered = sorted(met)
    around = [*covered[1:], covered[0] + cycle]
    return PhaseCoverage(
        cycle_s=float(cycle),
        covered_s=tuple(float(phase) for phase in covered),
        repeats=tuple(met[phase] for phase in covered),
        captures=len(shots),
        possible=grid.distinct,
        interval_s=float(grid.interval_s),
        largest_gap_s=float(max(b - a for a, b in zip(covered, around, strict=True))),
    )


def timed_steps(plan: Plan) -> tuple[Step, ...]:
    """Return the steps of a plan that have a time."""
    return tuple(step for step in plan.steps if "start_s" in step.settings)


def _common_measure(a: Fraction, b: Fraction) -> Fraction:
    """Return the greatest time of which both are whole multiples."""
    numerator = math.gcd(a.numerator * b.denominator, b.numerator * a.denominator)
    return Fraction(numerator, a.denominator * b.denominator)
