"""Plans of sequences in time: a face that changes by a sound, shots with a period of their own.

A camera that needs seconds for an image cannot follow a face. Where the face does the same again
and again, it can: prompted to change every ``prompt_period_s``, it repeats every two prompts, and
shots whose period is no whole share of that cycle meet it at another phase each time (Jimenez et
al. 2010, section 3.1, doi 10.1145/1866158.1866167). What an event does to the blood once, exercise
or a drink, is followed by shots at times after the event.

Periods are taken as the decimals they are written with, and counted as fractions: which phases a
sequence meets is a question of common measures, which rounded numbers do not have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

from capture.documents import Fault, shown
from capture.plan.flash import flash_plan
from capture.plan.steps import Plan, PlanError, Step, Value, require
from capture.rig import Rig

Seconds = int | float | str | Decimal | Fraction
"""A time; numbers count as the decimals that they are printed as."""

RELEASE_DELAY_S = 0.04
"""Time from an image at hand to the release of the next one, s: arming camera and box."""
REPEATED_PHASE_FRACTION = Fraction(1, 10)
"""Part of the phases that are met again by default, to see whether they repeat."""
MIN_PHASES = 8
"""With fewer, four in each half of the cycle, nothing can be said of what lies between."""
_MAX_PERIOD_DENOMINATOR = 10**6
"""Largest denominator of a period in s; finer ones are rounded to it."""


class ReadOutError(PlanError):
    """Shots follow each other faster than the camera can be read out.

    Attributes
    ----------
    equivalent_s : float
        The shortest period, s, that the camera can keep and that meets the same phases; nan where
        there is none.
    """

    equivalent_s: float = math.nan


@dataclass(frozen=True, slots=True)
class PhaseGrid:
    """Which phases of a cycle a train of shots can meet."""

    cycle_s: Fraction
    """Time after which the subject does the same again, s."""
    shot_period_s: Fraction
    """Time from shot to shot, s."""
    distinct: int
    """Number of phases; from there on they repeat."""
    interval_s: Fraction
    """Time between neighbouring phases, all of them met, s: the effective sampling interval."""

    @property
    def aliased(self) -> bool:
        """Whether so few phases are met that what lies between the states cannot be seen."""
        return self.distinct < MIN_PHASES


def exact(value: Seconds) -> Fraction:
    """Return a time as the fraction that its decimal notation means.

    Examples
    --------
    >>> exact(5.25), exact("0.1") + exact(0.2)
    (Fraction(21, 4), Fraction(3, 10))

    Raises
    ------
    PlanError
        For what is no finite number.
    """
    try:
        number = Fraction(value if isinstance(value, Fraction) else str(value))
    except (ValueError, ZeroDivisionError) as exc:
        fault = Fault("seconds", shown(value), "a finite number")
        raise PlanError("cannot plan", faults=[fault]) from exc
    return number.limit_denominator(_MAX_PERIOD_DENOMINATOR)


def phase_grid(prompt_period_s: Seconds, shot_period_s: Seconds) -> PhaseGrid:
    """Return the phases that shots meet of a subject who changes with every prompt.

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
    prompt, shot = exact(prompt_period_s), exact(shot_period_s)
    require(prompt > 0, "prompt_period_s", prompt_period_s, "seconds > 0")
    require(shot > 0, "shot_period_s", shot_period_s, "seconds > 0")
    cycle = 2 * prompt
    interval = _common_measure(cycle, shot)
    return PhaseGrid(cycle, shot, int(cycle / interval), interval)


def equivalent_period_s(
    prompt_period_s: Seconds, shot_period_s: Seconds, read_out_s: Seconds
) -> Fraction:
    """Return the shortest period a camera can keep that meets the same phases as another one, s.

    Half cycles are added until the camera can follow: a whole number of them lets the phases meet
    in another order at most; an odd one may change their number, and is passed over where it does.

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
    grid, shortest = phase_grid(prompt_period_s, shot_period_s), exact(read_out_s)
    half = grid.cycle_s / 2
    halves = max(0, math.ceil((shortest - grid.shot_period_s) / half))
    for more in (halves, halves + 1):
        period = grid.shot_period_s + more * half
        if phase_grid(prompt_period_s, period).distinct == grid.distinct:
            return period
    raise AssertionError("a whole cycle more meets the same phases")  # pragma: no cover


def period_for(prompt_period_s: Seconds, interval_s: Seconds, read_out_s: Seconds) -> Fraction:
    """Return the shortest period a camera can keep that samples a cycle every ``interval_s``, s.

    Examples
    --------
    >>> float(period_for(5, 0.5, 5.5)), float(period_for(5, "0.25", 5.5))
    (5.5, 5.75)

    Raises
    ------
    PlanError
        Where the interval is no whole part of the cycle.
    """
    cycle, interval = 2 * exact(prompt_period_s), exact(interval_s)
    whole = interval > 0 and (cycle / interval).denominator == 1
    require(whole, "interval_s", interval_s, f"a whole part of the cycle of {float(cycle):g} s")
    phases = int(cycle / interval)
    steps = max(1, math.ceil(exact(read_out_s) / interval))
    while math.gcd(steps, phases) != 1:
        steps += 1
    return steps * interval


def image_s(rig: Rig, exposure_s: float) -> Fraction:
    """Return the shortest time from shot to shot of a rig's slowest camera, s.

    Shutter lag, exposure, read-out and the release of the next image.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> round(float(image_s(load_rig("flash"), 0.008)), 3)
    5.498
    """
    slowest = max(exact(view.shutter_lag_s) + exact(view.readout_s) for view in rig.views)
    return slowest + exact(exposure_s) + exact(RELEASE_DELAY_S)


def multiplexed_plan(
    rig: Rig,
    *,
    state: str = "smile",
    rest: str = "neutral",
    prompt_period_s: Seconds = 5.0,
    shot_period_s: Seconds = 5.5,
    captures: int | None = None,
    cycles: int | None = None,
    read_out_s: Seconds | None = None,
    lead_cycles: int = 1,
    darks: int = 4,
    power: float = 1.0,
    exposure_s: float = 0.008,
    iso: int = 100,
) -> Plan:
    """Plan crossed flash images of a subject who changes between two states by a sound.

    Parameters
    ----------
    rig : Rig
    state, rest : str
        The expression that even prompts ask for, and what odd prompts ask for.
    prompt_period_s
        Time from prompt to prompt, s; the cycle is twice as long and begins with ``state``.
    shot_period_s
        Time from shot to shot, s.
    captures : int, optional
        Number of shots. By default every phase once and a tenth of them twice.
    cycles : int, optional
        Instead: shots for so many cycles.
    read_out_s
        Shortest time from shot to shot, s; by default what the rig's cameras need.
    lead_cycles : int
        Cycles of prompts before the first shot, so that the subject is in the rhythm, >= 0.
    darks : int
        Frames with no light at the beginning, >= 0.
    power, exposure_s, iso
        See `capture.plan.flash_plan`.

    Returns
    -------
    Plan
        Darks, then the shots. Each has ``start_s`` among its settings: s after the prompt that
        ends the lead; and in its index ``state`` (what was asked for last), ``phase_s`` (s since
        the last prompt of ``state``), ``number``, and ``repeat`` (how often the phase was met
        before). The analyser stays crossed: it cannot turn between shots.

    Raises
    ------
    ReadOutError
        When the camera is too slow; the message offers a period that meets the same phases.
    PlanError
        When the flash is too slow, or an argument is not as expected.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = multiplexed_plan(load_rig("flash"), darks=0)
    >>> len(plan.steps), phases(plan).distinct, phases(plan).interval_s
    (22, 20, 0.5)
    >>> [(s.settings["start_s"], s.index["phase_s"]) for s in plan.steps[:3]]
    [(0.0, 0.0), (5.5, 5.5), (11.0, 1.0)]
    """
    grid = phase_grid(prompt_period_s, shot_period_s)
    require(state != rest, "state", state, f"not {rest!r}, which it changes with")
    require(captures is None or cycles is None, "captures, cycles", (captures, cycles), "one only")
    require(captures is None or captures >= 1, "captures", captures, ">= 1")
    require(cycles is None or cycles >= 1, "cycles", cycles, ">= 1")
    require(lead_cycles >= 0, "lead_cycles", lead_cycles, ">= 0")
    shortest = image_s(rig, exposure_s) if read_out_s is None else exact(read_out_s)
    if grid.shot_period_s < shortest:
        raise _too_slow(grid, shortest)
    _check_flash(rig, grid.shot_period_s, power)
    if cycles is not None:
        captures = math.ceil(cycles * grid.cycle_s / grid.shot_period_s)
    count = captures or grid.distinct + math.ceil(grid.distinct * REPEATED_PHASE_FRACTION)
    begun = _darks(rig, darks, exposure_s=exposure_s, iso=iso)
    common: dict[str, Value] = {
        "polarizer": "crossed",
        "power": power,
        "exposure_s": exposure_s,
        "iso": iso,
    }
    shots = []
    for number in range(count):
        start = number * grid.shot_period_s
        phase = start % grid.cycle_s
        index: dict[str, str | int | float] = {
            "state": state if phase < grid.cycle_s / 2 else rest,
            "polarizer": "crossed",
            "number": number,
            "phase_s": float(phase),
            "repeat": number // grid.distinct,
        }
        settings = {**common, "start_s": float(start)}
        shots.append(_shot(rig, number, index, settings))
    limits = {
        **begun.limits,
        "prompt_period_s": float(grid.cycle_s / 2),
        "shot_period_s": float(grid.shot_period_s),
        "read_out_s": float(shortest),
        "lead_s": float(lead_cycles * grid.cycle_s),
    }
    return Plan(rig.name, (*(s for s in begun.steps if s.kind == "dark"), *shots), limits)


def course_plan(
    rig: Rig,
    *,
    state: str = "exercise",
    duration_s: Seconds = 60,
    shot_period_s: Seconds = 5.5,
    before: int = 2,
    rest: str = "neutral",
    read_out_s: Seconds | None = None,
    darks: int = 4,
    power: float = 1.0,
    exposure_s: float = 0.008,
    iso: int = 100,
) -> Plan:
    """Plan crossed flash images at times after an event that changes the blood once.

    Jimenez et al. 2010 follow exercise for one minute and alcohol for an hour.

    Parameters
    ----------
    rig : Rig
    state : str
        What the event is; the operator is asked for it, and time 0 is when he says it is over:
        the exercise, or the drink.
    duration_s
        Time of the last shot, s, at most.
    shot_period_s
        Time from shot to shot, s.
    before : int
        Shots of ``rest`` before the event, >= 1.
    rest : str
        The state before.
    read_out_s, darks, power, exposure_s, iso
        See :func:`multiplexed_plan`.

    Returns
    -------
    Plan
        Darks, shots of ``rest``, and shots with ``start_s``, s after the event.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = course_plan(load_rig("flash"), darks=0)
    >>> [s.settings.get("start_s") for s in plan.steps[:4]], plan.steps[-1].settings["start_s"]
    ([None, None, 0.0, 5.5], 55.0)
    """
    period, duration = exact(shot_period_s), exact(duration_s)
    require(state != rest, "state", state, f"not {rest!r}, which comes before")
    require(period > 0, "shot_period_s", shot_period_s, "seconds > 0")
    require(duration >= period, "duration_s", duration_s, f">= {float(period):g} s")
    require(before >= 1, "before", before, ">= 1")
    shortest = image_s(rig, exposure_s) if read_out_s is None else exact(read_out_s)
    if period < shortest:
        raise ReadOutError(
            "the camera is too slow",
            faults=[_period_fault(period, shortest)],
            advice=f"Take an image every {float(shortest):g} s or slower.",
        )
    _check_flash(rig, period, power)
    begun = _darks(rig, darks, exposure_s=exposure_s, iso=iso)
    common: dict[str, Value] = {
        "polarizer": "crossed",
        "power": power,
        "exposure_s": exposure_s,
        "iso": iso,
    }
    steps = [s for s in begun.steps if s.kind == "dark"]
    for number in range(before + math.floor(duration / period) + 1):
        after = number - before
        index: dict[str, str | int | float] = {
            "state": rest if after < 0 else state,
            "polarizer": "crossed",
            "number": number,
        }
        at: dict[str, Value] = {} if after < 0 else {"start_s": float(after * period)}
        steps.append(_shot(rig, number, index, {**common, **at}))
    limits = {**begun.limits, "shot_period_s": float(period), "read_out_s": float(shortest)}
    return Plan(rig.name, tuple(steps), limits)


@dataclass(frozen=True, slots=True)
class Phases:
    """Which phases of its cycle a sequence covers."""

    cycle_s: float
    """Time after which the subject does the same again, s."""
    covered_s: tuple[float, ...]
    """Distinct phases that are met, s, in order."""
    repeats: tuple[int, ...]
    """How often each is met, >= 1."""
    captures: int
    """Number of shots."""
    possible: int
    """How many phases such a train of shots would meet if it went on."""
    interval_s: float
    """Time between neighbours of those, s."""
    largest_gap_s: float
    """Longest stretch of the cycle without a shot, s."""

    @property
    def distinct(self) -> int:
        """Number of phases that are met."""
        return len(self.covered_s)

    @property
    def aliased(self) -> bool:
        """Whether shot and prompt periods meet too few phases, however long the sequence is."""
        return self.possible < MIN_PHASES

    def __str__(self) -> str:
        again = self.captures - self.distinct
        text = (
            f"{self.captures} captures meet {self.distinct} distinct phases of the "
            f"{self.cycle_s:g} s cycle, {again} of them again: sampled every {self.interval_s:g} s,"
            f" largest gap {self.largest_gap_s:g} s"
        )
        if self.aliased:
            text += (
                f"; the periods alias: only {self.possible} phases can be met, "
                "choose a shot period that has less in common with the cycle"
            )
        return text


def phases(plan: Plan) -> Phases:
    """Return which phases of its cycle the shots of a multiplexed plan meet.

    Raises
    ------
    PlanError
        For a plan without prompts.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> print(phases(multiplexed_plan(load_rig("flash"), shot_period_s=10.25)))
    44 captures meet 40 distinct phases of the 10 s cycle, 4 of them again: sampled every 0.25 s, \
largest gap 0.25 s
    """
    shots = timed_steps(plan)
    cycle = 2 * exact(plan.limits.get("prompt_period_s", 0.0))
    require(cycle > 0 and bool(shots), "plan", plan.rig, "a plan of multiplexed_plan")
    grid = phase_grid(cycle / 2, exact(plan.limits["shot_period_s"]))
    met: dict[Fraction, int] = {}
    for step in shots:
        phase = exact(float(step.settings["start_s"])) % cycle
        met[phase] = met.get(phase, 0) + 1
    covered = sorted(met)
    around = [*covered[1:], covered[0] + cycle]
    return Phases(
        cycle_s=float(cycle),
        covered_s=tuple(float(phase) for phase in covered),
        repeats=tuple(met[phase] for phase in covered),
        captures=len(shots),
        possible=grid.distinct,
        interval_s=float(grid.interval_s),
        largest_gap_s=float(max(b - a for a, b in zip(covered, around, strict=True))),
    )


def timed_steps(plan: Plan) -> tuple[Step, ...]:
    """Return the steps of a plan that are to be taken at a time."""
    return tuple(step for step in plan.steps if "start_s" in step.settings)


def reorder(plan: Plan, *, phases_s: Mapping[str, float] | None = None) -> tuple[Step, ...]:
    """Return the shots of a multiplexed plan in the order of their phases.

    Parameters
    ----------
    plan : Plan
    phases_s : mapping of str to float, optional
        Phase, s, at which each step was really taken, by its id; steps that it lacks are left
        out. Without it, as planned.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = multiplexed_plan(load_rig("flash"))
    >>> [(s.index["number"], s.index["phase_s"]) for s in reorder(plan)[:4]]
    [(0, 0.0), (20, 0.0), (11, 0.5), (2, 1.0)]
    """
    shots: Sequence[Step] = timed_steps(plan)
    if phases_s is not None:
        known = [step for step in shots if step.id in phases_s]
        return tuple(sorted(known, key=lambda step: phases_s[step.id]))
    return tuple(sorted(shots, key=lambda step: float(step.index["phase_s"])))


def _common_measure(a: Fraction, b: Fraction) -> Fraction:
    """Return the greatest time of which both are whole multiples."""
    numerator = math.gcd(a.numerator * b.denominator, b.numerator * a.denominator)
    return Fraction(numerator, a.denominator * b.denominator)


def _period_fault(period: Fraction, shortest: Fraction) -> Fault:
    return Fault("shot_period_s", f"{float(period):g}", f">= {float(shortest):g} s, the read-out")


def _too_slow(grid: PhaseGrid, shortest: Fraction) -> ReadOutError:
    instead = equivalent_period_s(grid.cycle_s / 2, grid.shot_period_s, shortest)
    error = ReadOutError(
        "the camera is too slow",
        faults=[_period_fault(grid.shot_period_s, shortest)],
        advice=f"A period of {float(instead):g} s meets the same {grid.distinct} phases of the "
        f"{float(grid.cycle_s):g} s cycle, {float(grid.interval_s):g} s apart.",
    )
    error.equivalent_s = float(instead)
    return error


def _check_flash(rig: Rig, period: Fraction, power: float) -> None:
    require(0 < power <= 1, "power", power, "0 < power <= 1")
    slowest = max(rig.recycle_s * power, 60.0 / rig.max_pops_per_min)
    require(
        period >= exact(slowest),
        "shot_period_s",
        f"{float(period):g}",
        f">= {slowest:g} s, what the flash needs to recycle",
    )


def _darks(rig: Rig, count: int, *, exposure_s: float, iso: int) -> Plan:
    return flash_plan(rig, darks=count, exposure_s=exposure_s, iso=iso)


def _shot(
    rig: Rig, number: int, index: Mapping[str, str | int | float], settings: Mapping[str, Value]
) -> Step:
    cameras = tuple(view.name for view in rig.views)
    return Step(f"S{number:03d}", "subject", index, settings, cameras)
