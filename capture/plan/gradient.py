"""Generate plans of the gradient sphere: strain steps of skin under patterns, and its targets.

A strain step of the skin is a position of the caliper. It is scanned once: some patterns with the
analyzer parallel, the same crossed. Patterns follow one another from bright to dark, and
complementary ones are adjacent, so that the light flickers little and the skin has moved little
between x and -x.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Literal, get_args

import numpy as np

from capture.plan.rows import led_rows, split_passes
from capture.plan.steps import (
    LIGHT_PATTERNS,
    POLARIZER_STATES,
    Index,
    Plan,
    Step,
    StepSeries,
    Value,
    int_if_whole,
    require_argument,
)
from capture.rig import Caliper, LedLimits, Rig

GradientTarget = Literal["ball", "dark", "flat"]

PATTERN_DWELL_S = 0.031
"""Duration of a pattern, s: 16 of them take half a second, and all LEDs stay within a duty of a
quarter, because x and -x together are one full.
"""
PATTERN_EXPOSURE_S = 0.018
"""Exposure that fits into the dwell time with the readout, s."""
SCAN_ORDER = ("full", "z", "x", "-x", "y", "-y", "-z", "dark")
"""Order from bright to dark for an eye next to the patch."""
BALL_SERIES: dict[int, tuple[float, ...]] = {
    0: (0.007, 0.03, 0.12, 0.5),
    80: (0.08, 0.5),
    90: (0.08, 0.5),
    100: (0.08, 0.5),
}
"""Levels of the LEDs for a ball of black glass, by the analyzer's reading, degrees. It mirrors 4 %
of lights that are far brighter than lit skin, but near Brewster's angle a thousandth of that;
readings on both sides of 90 determine the sign of an LED's polarizer rotation.
"""
BALL_DARK_S = 0.4
"""Dark time between two readings, s: eyes nearby then see fewer than three flashes per second."""
FLAT_LEVELS = (0.03, 0.06, 0.11, 0.17, 0.23, 0.34, 0.45, 0.57, 0.7, 0.85)
"""Levels of the photon transfer series: dense in the shadows, and near full scale at the end."""


def state_name(angle_deg: float, step: int) -> str:
    """Return the name of a strain step: the caliper's angle and position.

    Examples
    --------
    >>> state_name(0, 0), state_name(45.0, -2), state_name(0, 3)
    ('a000_n0', 'a045_m2', 'a000_p3')
    """
    letter = "n" if step == 0 else "m" if step < 0 else "p"
    return f"a{round(angle_deg):03d}_{letter}{abs(step)}"


def strain_state(step: Step) -> str | None:
    """Return the strain step of a capture step; None without skin in the caliper.

    Examples
    --------
    >>> index = {"angle": 90, "caliper": 1, "pattern": "x", "polarizer": "crossed"}
    >>> strain_state(Step("s", "gradient", index, {}, ("cam",)))
    'a090_p1'
    """
    if step.kind != "gradient" or "caliper" not in step.index:
        return None
    return state_name(float(step.index["angle"]), int(step.index["caliper"]))


def gradient_plan(
    rig: Rig,
    *,
    angles: Sequence[float] | None = None,
    steps: tuple[int, int] | None = None,
    patterns: Sequence[str] = LIGHT_PATTERNS,
    darks: int = 2,
    exposure_s: float = PATTERN_EXPOSURE_S,
    dwell_s: float = PATTERN_DWELL_S,
    level: float = 1.0,
    iso: int = 100,
) -> Plan:
    """Plan a capture of skin under patterns, stretched and compressed along several axes.

    Parameters
    ----------
    rig : Rig
        Rig with a caliper.
    angles : sequence of float, optional
        Angles of the caliper, degrees, of those it has; all of them by default.
    steps : pair of int, optional
        First (<= 0) and last (>= 0) position; all of the caliper's by default. The limit of the
        skin is found during the capture.
    patterns : sequence of str
        Names of :data:`capture.plan.steps.LIGHT_PATTERNS`.
    darks : int
        Frames without light at the beginning, >= 0, in addition to the "dark" of each scan.
    exposure_s, dwell_s : float
        Exposure, and duration of the light, of each pattern, s.
    level : float
        Level of the LEDs, 0 < level <= 1.
    iso : int

    Returns
    -------
    Plan
        Dark frames, then per angle the neutral state, compression step by step, and stretching step
        by step from neutral; per step every pattern parallel, then crossed. Ids are like
        "a000-m2-par-x".

    Raises
    ------
    PlanError
        When the limits of the rig's LEDs or caliper are exceeded.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("gradient")
    >>> plan = gradient_plan(rig, angles=[0], steps=(-1, 1), darks=0)
    >>> [state for state, _ in group_by_state(plan)], len(plan.steps)
    (['a000_n0', 'a000_m1', 'a000_p1'], 48)
    >>> plan.steps[0].id, plan.steps[-2].id
    ('a000-n0-par-full', 'a000-p1-cro--z')
    """
    caliper = _caliper(rig)
    known = caliper.angles_deg
    chosen = known if angles is None else tuple(float(angle) for angle in angles)
    for angle in chosen:
        require_argument(
            angle in known, "angles", angle, f"of {', '.join(f'{a:g}' for a in known)}"
        )
    require_argument(
        len(set(chosen)) == len(chosen) > 0, "angles", chosen, "at least one, none twice"
    )
    first, last = (caliper.first_step, caliper.last_step) if steps is None else steps
    within = f"{caliper.first_step} to 0, and 0 to {caliper.last_step}"
    good = caliper.first_step <= first <= 0 <= last <= caliper.last_step
    require_argument(good, "steps", (first, last), within)
    ordered = _ordered(patterns)
    require_argument(0 < level <= 1, "level", level, "0 < level <= 1")
    require_argument(darks >= 0, "darks", darks, ">= 0")
    series = _Series(rig, exposure_s=exposure_s, dwell_s=dwell_s, iso=iso)
    series.darks(darks)
    for angle in chosen:
        for position in (0, *range(-1, first - 1, -1), *range(1, last + 1)):
            name = state_name(angle, position).replace("_", "-")
            for polarizer in POLARIZER_STATES:
                for pattern in ordered:
                    light = {"pattern": pattern, "polarizer": polarizer}
                    index: Index = {"angle": int_if_whole(angle), "caliper": position, **light}
                    identity = f"{name}-{polarizer[:3]}-{pattern}"
                    series.add(identity, "gradient", index, **light, level=level)
    return series.plan()


def gradient_calibration_plan(
    rig: Rig,
    target: GradientTarget,
    *,
    repeats: int | None = None,
    darks: int = 2,
    level: float = 1.0,
    exposure_s: float = PATTERN_EXPOSURE_S,
    dwell_s: float = PATTERN_DWELL_S,
    iso: int = 100,
) -> Plan:
    """Plan the frames of one calibration of the gradient sphere, without the caliper.

    Parameters
    ----------
    rig : Rig
        Rig with LEDs.
    target : {"ball", "dark", "flat"}
        "ball": a ball of black glass under "full" at the readings and levels of `BALL_SERIES`, and
        under "dark";
        "flat": an even white field at 10 levels, once after the other (photon transfer pairs);
        "dark": the cap on.
    repeats : int, optional
        Frames per condition: by default 1 of the ball, 2 (>= 2) of the flat, 16 of the dark.
    darks : int
        Frames without light before the flats, >= 0.
    level : float
        Level of the LEDs for the ball, over that of the series, 0 < level <= 1.
    exposure_s, dwell_s, iso
        As in `gradient_plan`.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("gradient")
    >>> plan = gradient_calibration_plan(rig, "ball")
    >>> len(plan.steps), plan.steps[0].kind, dict(plan.steps[-1].index)
    (14, 'ball', {'pattern': 'dark', 'polarizer': 'crossed', 'reading': 100, 'repeat': 0})
    """
    targets = get_args(GradientTarget)
    require_argument(target in targets, "target", target, f"one of {', '.join(targets)}")
    count = {"ball": 1, "flat": 2, "dark": 16}[target] if repeats is None else repeats
    least = 2 if target == "flat" else 1
    require_argument(count >= least, "repeats", count, f">= {least}")
    require_argument(darks >= 0, "darks", darks, ">= 0")
    require_argument(0 < level <= 1, "level", level, "0 < level <= 1")
    series = _Series(rig, exposure_s=exposure_s, dwell_s=dwell_s, iso=iso)
    if target == "dark":
        series.darks(count)
    elif target == "flat":
        series.darks(darks)
        for repeat in range(count):
            for number, power in enumerate(FLAT_LEVELS):
                index: Index = {"level": power, "repeat": repeat, "pass": repeat}
                light = {"pattern": "full", "polarizer": "parallel"}
                series.add(f"F{number}-{repeat:02d}", "flat", index, **light, level=power)
    else:
        for reading, levels in BALL_SERIES.items():
            polarizer = POLARIZER_STATES[round(reading / 90)]
            every: dict[str, Value] = {} if reading in (0, 90) else {"analyzer_deg": reading}
            for number, share in enumerate((*levels, 0.0)):
                pattern = "full" if share else "dark"
                light = {"pattern": pattern, "polarizer": polarizer}
                more = every if share else {**every, "dwell_s": max(dwell_s, BALL_DARK_S)}
                for repeat in range(count):
                    index = {**light, "reading": reading, "repeat": repeat}
                    identity = f"B{reading:03d}-{pattern}{number}-{repeat:02d}"
                    series.add(identity, "ball", index, **light, level=level * share, **more)
    return series.plan()


def group_by_state(plan: Plan) -> Iterator[tuple[str, list[Step]]]:
    """Return the states of a plan in its order, each with its steps."""
    for name, group in groupby(plan.steps, key=strain_state):
        if name is not None:
            yield name, list(group)


def scan_duty(steps: Sequence[Step], rig: Rig) -> float:
    """Return the largest mean level of an LED over the rig's window, of steps without a pause.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("gradient")
    >>> plan = gradient_plan(rig, angles=[0], steps=(0, 0), darks=0)
    >>> round(scan_duty(plan.steps, rig), 3)
    0.248
    """
    limits = rig.leds or LedLimits()
    rows = led_rows(steps, rig)
    levels = np.array([row.light_levels(len(rig.lights)) for row in rows])
    ends = np.zeros(len(rows))
    clock, before = 0.0, None
    for number, (step, row) in enumerate(zip(steps, rows, strict=True)):
        asked = step.settings.get("analyzer_deg", step.settings.get("polarizer"))
        clock += rig.polarizer_move_s if before not in (None, asked) else 0.0
        before = asked
        clock += row.dwell_s
        ends[number] = clock
    starts = ends - [row.dwell_s for row in rows]
    # the moving mean is largest in a window that ends with a row, or begins with one
    edges = np.concatenate([ends, starts + limits.duty_window_s])
    most = 0.0
    for end in edges:
        begin = end - limits.duty_window_s
        inside = np.clip(np.minimum(ends, end) - np.maximum(starts, begin), 0.0, None)
        most = max(most, float((inside @ levels).max()) / limits.duty_window_s)
    return most


def _caliper(rig: Rig) -> Caliper:
    require_argument(rig.caliper is not None, "rig", rig.name, "one with a caliper")
    return rig.caliper  # type: ignore[return-value]


def _ordered(patterns: Sequence[str]) -> list[str]:
    chosen = list(patterns)
    for pattern in chosen:
        require_argument(
            pattern in LIGHT_PATTERNS, "patterns", pattern, f"of {', '.join(LIGHT_PATTERNS)}"
        )
    require_argument(
        len(set(chosen)) == len(chosen) > 0, "patterns", chosen, "at least one, none twice"
    )
    return sorted(chosen, key=SCAN_ORDER.index)


class _Series(StepSeries):
    """Collected steps, for all views of one rig at one exposure."""

    def __init__(self, rig: Rig, *, exposure_s: float, dwell_s: float, iso: int) -> None:
        require_argument(rig.leds is not None, "rig", rig.name, "one with LEDs and their limits")
        limits = rig.leds or LedLimits()
        require_argument(
            0 < dwell_s <= limits.max_on_s, "dwell_s", dwell_s, f"<= {limits.max_on_s:g}"
        )
        readout_s = max(view.readout_s for view in rig.views)
        lag_s = max(view.shutter_lag_s for view in rig.views)
        room_s = dwell_s - limits.settle_s - limits.overlap_s - lag_s
        fits = 0 < exposure_s <= room_s and exposure_s + readout_s + lag_s <= dwell_s
        expected = f"to fit with read-out {readout_s:g} s into {dwell_s:g} s per pattern"
        require_argument(fits, "exposure_s", exposure_s, expected)
        super().__init__(rig, exposure_s=float(exposure_s), dwell_s=float(dwell_s), iso=iso)
        self._limits = limits

    def darks(self, count: int) -> None:
        for repeat in range(count):
            dark: dict[str, Value] = {"pattern": "dark", "polarizer": "parallel", "level": 0.0}
            self.add(f"D{repeat:03d}", "dark", {"repeat": repeat}, **dark)

    def plan(self) -> Plan:
        """Return the plan; raise an error for a piece that exceeds an LED's duty."""
        limits = self._limits
        judged: dict[tuple[object, ...], float] = {}
        for piece in split_passes(self._steps):
            key = tuple((s.settings["pattern"], s.settings["level"]) for s in piece)
            if key not in judged:
                judged[key] = scan_duty(piece, self._rig)
        most = max(judged.values(), default=0.0)
        got = f"{most:.3f} over {limits.duty_window_s:g} s"
        expected = f"at most {limits.max_duty:g}: less level, shorter light or fewer patterns"
        require_argument(most <= limits.max_duty, "duty", got, expected)
        return self.plan_within(
            max_duty=limits.max_duty, max_on_s=limits.max_on_s, dose_ws=limits.dose_ws
        )
