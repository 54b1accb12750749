"""Generate timed plans: a face that changes on a prompt, and shots with their own period.

A camera that needs seconds per image cannot follow a face. It can sample a face that repeats:
prompted to change every ``prompt_period_s``, the face repeats every two prompts, and shots whose
period is not a simple fraction of that cycle sample another phase each time (Jimenez et al. 2010,
section 3.1, doi 10.1145/1866158.1866167). A single change of the blood by an event, exercise or a
drink, is sampled by shots at times after the event.

Periods are taken as the decimals in which they are written, and counted as fractions: the sampled
phases depend on common measures, which rounded numbers do not have.
"""

import math
from collections.abc import Mapping
from fractions import Fraction

from capture.documents import Fault
from capture.plan.flash import flash_plan
from capture.plan.phases import PhaseGrid, Seconds, equivalent_period_s, phase_grid, to_fraction
from capture.plan.steps import Plan, PlanError, Step, Value, require_argument
from capture.rig import Rig

RELEASE_DELAY_S = 0.04
"""Time from a received image to the release of the next one, s: arming camera and controller."""
SEQUENCE_EXPOSURE_S = 0.008
SEQUENCE_ISO = 100
REPEATED_PHASE_FRACTION = Fraction(1, 10)
"""Fraction of the phases that are sampled again by default, to test the repeatability."""


class ReadOutError(PlanError):
    """Raised when shots follow each other faster than the camera can be read out.

    Attributes
    ----------
    equivalent_s : float
        The shortest period, s, that the camera can follow and that samples the same phases; nan
        without such a period.
    """

    equivalent_s: float = math.nan


def min_shot_interval_s(rig: Rig, exposure_s: float) -> Fraction:
    """Return the shortest time from shot to shot of a rig's slowest camera, s.

    Shutter lag, exposure, readout and the release of the next image.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> round(float(min_shot_interval_s(load_rig("flash"), 0.008)), 3)
    5.498
    """
    slowest = max(
        to_fraction(view.shutter_lag_s) + to_fraction(view.readout_s) for view in rig.views
    )
    return slowest + to_fraction(exposure_s) + to_fraction(RELEASE_DELAY_S)


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
) -> Plan:
    """Plan crossed flash images of a subject who changes between two states on a prompt.

    Parameters
    ----------
    rig : Rig
    state, rest : str
        Expressions of even and of odd prompts.
    prompt_period_s
        Time from prompt to prompt, s; the cycle is twice as long and begins with ``state``.
    shot_period_s
        Time from shot to shot, s.
    captures : int, optional
        Number of shots. By default every phase once and a tenth of them twice.
    cycles : int, optional
        Alternative to ``captures``: shots for this number of cycles.
    read_out_s
        Shortest time from shot to shot, s; by default that of the rig's slowest camera.
    lead_cycles : int
        Cycles of prompts before the first shot, so that the subject follows the rhythm, >= 0.
    darks : int
        Frames with no light at the beginning, >= 0.
    power
        See `capture.plan.flash_plan`.

    Returns
    -------
    Plan
        Dark frames, then the shots. Each has ``start_s`` among its settings: s after the prompt
        that ends the lead; and in its index ``state`` (last prompt), ``phase_s`` (s since the last
        prompt of ``state``), ``number``, and ``repeat`` (number of earlier samples of the phase).
        The analyzer stays crossed: it cannot turn between shots.

    Raises
    ------
    ReadOutError
        When the camera is too slow; the message offers a period that samples the same phases.
    PlanError
        When the flash is too slow, or an argument is not as expected.

    Examples
    --------
    >>> from capture.plan.phases import phase_coverage
    >>> from capture.rig import load_rig
    >>> plan = multiplexed_plan(load_rig("flash"), darks=0)
    >>> len(plan.steps), phase_coverage(plan).distinct, phase_coverage(plan).interval_s
    (22, 20, 0.5)
    >>> [(s.settings["start_s"], s.index["phase_s"]) for s in plan.steps[:3]]
    [(0.0, 0.0), (5.5, 5.5), (11.0, 1.0)]
    """
    grid = phase_grid(prompt_period_s, shot_period_s)
    require_argument(state != rest, "state", state, f"not {rest!r}, which it changes with")
    require_argument(
        captures is None or cycles is None, "captures, cycles", (captures, cycles), "one only"
    )
    require_argument(captures is None or captures >= 1, "captures", captures, ">= 1")
    require_argument(cycles is None or cycles >= 1, "cycles", cycles, ">= 1")
    require_argument(lead_cycles >= 0, "lead_cycles", lead_cycles, ">= 0")
    shortest = (
        min_shot_interval_s(rig, SEQUENCE_EXPOSURE_S)
        if read_out_s is None
        else to_fraction(read_out_s)
    )
    if grid.shot_period_s < shortest:
        raise _readout_error(grid, shortest)
    _check_flash(rig, grid.shot_period_s, power)
    if cycles is not None:
        captures = math.ceil(cycles * grid.cycle_s / grid.shot_period_s)
    count = captures or grid.distinct + math.ceil(grid.distinct * REPEATED_PHASE_FRACTION)
    begun = flash_plan(rig, darks=darks, exposure_s=SEQUENCE_EXPOSURE_S, iso=SEQUENCE_ISO)
    common = _settings(power)
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
) -> Plan:
    """Plan crossed flash images at times after an event that changes the blood once.

    Jimenez et al. 2010 follow exercise for one minute and alcohol for an hour.

    Parameters
    ----------
    rig : Rig
    state : str
        Name of the event; the operator is prompted for it, and time 0 is when he reports its end:
        of the exercise, or of the drink.
    duration_s
        Time of the last shot, s, at most.
    shot_period_s
        Time from shot to shot, s.
    before : int
        Shots of ``rest`` before the event, >= 1.
    rest : str
        State before the event.
    read_out_s, darks, power
        See :func:`multiplexed_plan`.

    Returns
    -------
    Plan
        Dark frames, shots of ``rest``, and shots with ``start_s``, s after the event.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = course_plan(load_rig("flash"), darks=0)
    >>> [s.settings.get("start_s") for s in plan.steps[:4]], plan.steps[-1].settings["start_s"]
    ([None, None, 0.0, 5.5], 55.0)
    """
    period, duration = to_fraction(shot_period_s), to_fraction(duration_s)
    require_argument(state != rest, "state", state, f"not {rest!r}, which comes before")
    require_argument(period > 0, "shot_period_s", shot_period_s, "seconds > 0")
    require_argument(duration >= period, "duration_s", duration_s, f">= {float(period):g} s")
    require_argument(before >= 1, "before", before, ">= 1")
    shortest = (
        min_shot_interval_s(rig, SEQUENCE_EXPOSURE_S)
        if read_out_s is None
        else to_fraction(read_out_s)
    )
    if period < shortest:
        raise ReadOutError(
            "the camera is too slow",
            faults=[_period_fault(period, shortest)],
            advice=f"Take an image every {float(shortest):g} s or slower.",
        )
    _check_flash(rig, period, power)
    begun = flash_plan(rig, darks=darks, exposure_s=SEQUENCE_EXPOSURE_S, iso=SEQUENCE_ISO)
    common = _settings(power)
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


def _period_fault(period: Fraction, shortest: Fraction) -> Fault:
    return Fault("shot_period_s", f"{float(period):g}", f">= {float(shortest):g} s, the read-out")


def _readout_error(grid: PhaseGrid, shortest: Fraction) -> ReadOutError:
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
    require_argument(0 < power <= 1, "power", power, "0 < power <= 1")
    slowest = max(rig.recycle_s * power, 60.0 / rig.max_pops_per_min)
    expected = f">= {slowest:g} s, what the flash needs to recycle"
    require_argument(
        period >= to_fraction(slowest), "shot_period_s", f"{float(period):g}", expected
    )


def _settings(power: float) -> dict[str, Value]:
    return {
        "polarizer": "crossed",
        "power": power,
        "exposure_s": SEQUENCE_EXPOSURE_S,
        "iso": SEQUENCE_ISO,
    }


def _shot(
    rig: Rig, number: int, index: Mapping[str, str | int | float], settings: Mapping[str, Value]
) -> Step:
    cameras = tuple(view.name for view in rig.views)
    return Step(f"S{number:03d}", "subject", index, settings, cameras)
