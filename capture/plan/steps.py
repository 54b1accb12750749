"""Frozen steps and plans of a capture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

from capture.documents import (
    Document,
    Fault,
    FaultCollector,
    InputError,
    parse_document,
    read_json,
    short_repr,
    suggest_key,
)
from capture.former_names import translate_names
from capture.plan.suction import suction_overhead_s
from capture.rig import ID_RULE, Rig, is_id
from capture.scanner import STRIPE_AXES

Value = str | int | float | bool
Index = Mapping[str, str | int | float]
FlashKind = Literal["dark", "flat", "chart", "malus", "subject"]
DomeKind = Literal["olat", "tracking", "charuco", "mirror", "white", "stripes"]
Kind = Literal[FlashKind, DomeKind, "gradient", "ball", "fibers", "phantom", "mask"]
Polarizer = Literal["parallel", "crossed"]

Pattern = Literal["full", "x", "y", "z", "-x", "-y", "-z", "dark"]
"""Light of the gradient sphere: 1, or (1 + w)/2 with w a coordinate of the way to the light."""

LIGHT_PATTERNS: tuple[str, ...] = get_args(Pattern)
STEP_KINDS: tuple[str, ...] = get_args(Kind)
POLARIZER_STATES: tuple[str, ...] = get_args(Polarizer)

# settings every rig understands: name -> (types, test, expected value)
_SETTING_RULES: Mapping[str, tuple[tuple[type, ...], Any, str]] = {
    "polarizer": ((str,), lambda v: v in POLARIZER_STATES, '"parallel" or "crossed"'),
    "analyzer_deg": ((int, float), lambda v: 0 <= v < 360, "0 <= degrees < 360"),
    "power": ((int, float), lambda v: 0 <= v <= 1, "0 <= power <= 1"),
    "exposure_s": ((int, float), lambda v: 0 < v < math.inf, "seconds > 0"),
    "iso": ((int, float), lambda v: 0 < v < math.inf, "> 0"),
    "level": ((int, float), lambda v: 0 <= v <= 1, "0 <= level <= 1"),
    "light": ((str,), lambda v: is_id(v), "a light's name, or none"),
    "leds": ((str,), lambda v: all(is_id(name) for name in v.split("+")), "names joined by +"),
    "pattern": ((str,), lambda v: v in LIGHT_PATTERNS, f"one of {', '.join(LIGHT_PATTERNS)}"),
    "dwell_s": ((int, float), lambda v: 0 < v < math.inf, "seconds > 0"),
    "suction_mbar": ((int, float), lambda v: 0 < v < math.inf, "mbar > 0"),
    "fiber": ((int,), lambda v: v >= 0, "a fiber's number >= 0, or none for all"),
    "projector": ((str,), lambda v: is_id(v), "a projector's name"),
    "axis": ((str,), lambda v: v in STRIPE_AXES, f"one of {', '.join(STRIPE_AXES)}"),
    "stripes": ((int,), lambda v: v >= 0, "a pattern's number >= 0"),
    "start_s": ((int, float), lambda v: 0 <= v < math.inf, "seconds >= 0"),
}


class PlanError(InputError):
    """Raised for a plan, or a plan file, that cannot be carried out."""


@dataclass(frozen=True, slots=True)
class Step(Document):
    """One step of a capture.

    Parameters
    ----------
    id : str
        Unique in the plan, usable in a file name.
    kind : str
        Of the flash rig "flat", "chart", "malus" or "subject"; of the dome "olat" (one light at a
        time), "tracking" (several at once), "charuco", "mirror", "white" or "stripes" (a pattern
        of the scanner); of the gradient sphere
        "gradient" (skin) or "ball" (a ball of black glass); of the fiber probe "fibers" (skin),
        "phantom" (a block of known optics) or "mask" (the same with all fibers covered but one); of
        all "dark".
    index : mapping of str to str, int or float
        Indices of the step in its series, e.g. ``{"state": "neutral", "repeat": 0}``.
    settings : mapping of str to str, int, float or bool
        ``polarizer`` ("parallel" or "crossed"), ``power`` (0 to 1 of a light's full energy),
        ``exposure_s`` (s), ``iso``; ``analyzer_deg`` (rotator reading, degrees; 0 is parallel, 90
        crossed) takes precedence over ``polarizer``. On the dome ``light`` (its name), or ``leds``
        (names joined by +), at ``level`` (0 to 1) for ``dwell_s``; of the scanner ``projector``
        (its name), ``axis`` ("columns" or "rows") and ``stripes`` (number of the pattern); in the
        gradient sphere
        ``pattern`` instead of lights; of the fiber probe ``suction_mbar`` and ``fiber`` (number of
        the only uncovered fiber). In a sequence ``start_s``, s after its beginning. Rigs may
        define further names.
    cameras : tuple of str
        Views that take a frame.

    Examples
    --------
    >>> Step("S1", "dark", {}, {"exposure": 0.1}, ("cam",))
    Traceback (most recent call last):
        ...
    capture.plan.steps.PlanError: Step 'S1' is not valid
      settings.exposure: got 0.1, expected a known setting; did you mean exposure_s? (in s)
    """

    id: str
    kind: Kind
    index: Index
    settings: Mapping[str, Value]
    cameras: tuple[str, ...]

    def __post_init__(self) -> None:
        checks = FaultCollector(f"Step {self.id!r}", PlanError)
        checks.check("id", self.id, is_id(self.id), ID_RULE)
        checks.check("kind", self.kind, self.kind in STEP_KINDS, f"one of {', '.join(STEP_KINDS)}")
        for table, types in (("index", (str, int, float)), ("settings", (str, int, float, bool))):
            for key, value in getattr(self, table).items():
                good = isinstance(value, types) and (types[-1] is bool or value is not True)
                good = good and not (isinstance(value, float) and not math.isfinite(value))
                checks.check(f"{table}.{key}", value, good, "a text or a finite number")
        for fault in _check_settings(self.settings):
            checks.note(fault)
        differ = len(set(self.cameras)) == len(self.cameras) > 0
        checks.check("cameras", self.cameras, differ, "at least one, none twice")
        for camera in self.cameras:
            checks.check("cameras", camera, is_id(camera), ID_RULE)
        checks.close()
        object.__setattr__(self, "index", MappingProxyType(dict(self.index)))
        object.__setattr__(self, "settings", MappingProxyType(dict(self.settings)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the dictionaries from which the object is rebuilt in another process."""
        parts = (self.id, self.kind, dict(self.index), dict(self.settings), self.cameras)
        return (Step, parts)


def _check_settings(settings: Mapping[str, Value]) -> list[Fault]:
    """Return the faults of known settings, and of names that are a near miss of a known one."""
    faults = []
    for key, value in settings.items():
        if key in _SETTING_RULES:
            types, good, expected = _SETTING_RULES[key]
            if not isinstance(value, types) or isinstance(value, bool) or not good(value):
                faults.append(Fault(f"settings.{key}", short_repr(value), expected))
        elif hint := suggest_key(key, _SETTING_RULES):
            faults.append(Fault(f"settings.{key}", short_repr(value), "a known setting", hint))
    return faults


@dataclass(frozen=True, slots=True)
class Plan(Document):
    """Steps in the order of capture, for one rig, with the limits that were planned for.

    Parameters
    ----------
    rig : str
        Name of the rig.
    steps : tuple of Step
        At least one; ids are unique, also when upper and lower case are equivalent.
    limits : mapping of str to float
        Limits observed by the planner, e.g. ``{"max_pops_per_min": 20.0, "recycle_s": 1.5}``.
    """

    rig: str
    steps: tuple[Step, ...]
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks = FaultCollector("Plan", PlanError)
        checks.check("rig", self.rig, is_id(self.rig), ID_RULE)
        checks.check("steps", self.steps, len(self.steps) > 0, "at least one step")
        seen: dict[str, int] = {}
        for number, step in enumerate(self.steps):
            first = seen.setdefault(step.id.casefold(), number)
            unlike = f"an id unlike that of steps[{first}]"
            checks.check(f"steps[{number}].id", step.id, first == number, unlike)
        for key, value in self.limits.items():
            checks.check(f"limits.{key}", value, math.isfinite(value), "a finite number")
        checks.close()
        object.__setattr__(self, "limits", MappingProxyType(dict(self.limits)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the dictionaries from which the object is rebuilt in another process."""
        return (Plan, (self.rig, self.steps, dict(self.limits)))

    def step(self, step_id: str) -> Step:
        """Return the step called ``step_id``."""
        for step in self.steps:
            if step.id == step_id:
                return step
        ids = [step.id for step in self.steps]
        expected = f"one of {len(ids)} ids from {ids[0]} to {ids[-1]}"
        fault = Fault("step", repr(step_id), expected, suggest_key(step_id, ids))
        raise PlanError(f"the plan has no step {step_id!r}", faults=[fault])

    @property
    def max_cameras(self) -> int:
        """Largest number of cameras of one step."""
        return max(len(step.cameras) for step in self.steps)

    def check(self, rig: Rig) -> None:
        """Raise an error when the plan is for another rig, or names views that it lacks."""
        checks = FaultCollector(f"Plan for rig {self.rig!r}", PlanError)
        checks.check("rig", self.rig, self.rig == rig.name, f"the rig's name {rig.name!r}")
        views = [view.name for view in rig.all_views]
        for number, step in enumerate(self.steps):
            for camera in step.cameras:
                known = camera in views
                path = f"steps[{number}].cameras"
                checks.check(path, camera, known, f"one of {', '.join(views)}")
        checks.close()

    def estimate_duration_s(self, rig: Rig) -> float:
        """Return the duration of the plan on ``rig``, s, without talk on the lines.

        Per step the slowest camera's exposure and readout, or the recycling of the flash or the
        duration of the light when that is longer, and the turning of the analyzer when its state
        changes. When a caliper's position changes its travel, and the time of the skin's creep; the
        mean time of its homing, as the jaws' place before is not known;
        when a head is held by suction, pumping and rests, and all exposures of a series, though
        some may turn out to be unnecessary. For a sequence its lead and its last time. The time of
        a person who tapes the caliper or places the head is not included.
        """
        total, last_s = self.limits.get("lead_s", 0.0), 0.0
        each_s: list[float] = []
        state: object = None
        held: tuple[object, int] = (None, 0)
        if rig.caliper is not None and any("caliper" in step.index for step in self.steps):
            total += rig.caliper.mean_homing_s
        for step in self.steps:
            readout_s = max(rig.view(name).readout_s for name in step.cameras)
            power = float(step.settings.get("power", 0.0))
            pause_s = max(rig.recycle_s * power, 60.0 / rig.max_pops_per_min) if power > 0 else 0.0
            pause_s = max(pause_s, float(step.settings.get("dwell_s", 0.0)))
            each_s.append(max(float(step.settings.get("exposure_s", 0.0)) + readout_s, pause_s))
            if "start_s" in step.settings:  # the times of a sequence determine its duration
                last_s = max(last_s, float(step.settings["start_s"]) + each_s[-1])
                continue
            total += each_s[-1]
            asked = step.settings.get("analyzer_deg", step.settings.get("polarizer"))
            turn_s = rig.polarizer_move_s if asked not in (state, None) else 0.0
            state = state if asked is None else asked
            move_s = 0.0
            if rig.caliper is not None and "caliper" in step.index:
                now = (step.index.get("angle"), int(step.index["caliper"]))
                if now != held:
                    # a turned caliper is taped on again, at step 0
                    way = abs(now[1] - (held[1] if now[0] == held[0] else 0))
                    move_s = way * rig.caliper.step_mm / rig.caliper.speed_mm_per_s
                    move_s += rig.caliper.settle_s
                held = now
            total += max(turn_s, move_s)  # the analyzer turns while the jaws move
        return (
            total
            + last_s
            + (0.0 if rig.probe is None else suction_overhead_s(self.steps, each_s, rig.probe))
        )

    @staticmethod
    def from_json(data: Mapping[str, Any] | str | bytes, *, where: str = "plan") -> Plan:
        """Build a plan from JSON text or decoded JSON, listing all faults at once.

        Raises
        ------
        PlanError
            With every fault's path, the value found and the value expected.
        """
        if isinstance(data, str | bytes):
            data = read_json(data, where=where, error=PlanError)
        advice = "Correct these entries of the plan."
        code = "SR-PLN-004"
        data = translate_names(data)
        return parse_document(Plan, data, where=where, error=PlanError, advice=advice, code=code)


class StepSeries:
    """Collected steps, for all views of one rig.

    Parameters
    ----------
    rig
        The rig.
    **every
        Default settings of every step.
    """

    def __init__(self, rig: Rig, **every: Value) -> None:
        self._rig, self._every = rig, every
        self._cameras = tuple(view.name for view in rig.views)
        self._steps: list[Step] = []

    def add(self, identity: str, kind: Kind, index: Index, **settings: Value) -> None:
        """Add a step with settings of its own."""
        settings = {**self._every, **settings}
        self._steps.append(Step(identity, kind, index, settings, self._cameras))

    def plan_within(self, **limits: float) -> Plan:
        """Return the plan of the steps."""
        return Plan(self._rig.name, tuple(self._steps), limits)


def int_if_whole(angle_deg: float) -> int | float:
    """Return an angle as a whole number when it is one."""
    return int(angle_deg) if float(angle_deg).is_integer() else float(angle_deg)


MAX_REPEATS = 1000
"""Most repeats of a plan: a face is held still for minutes, not for days."""


def require_repeats(repeats: int) -> None:
    """Raise for a number of repeats that no plan has."""
    require_argument(1 <= repeats <= MAX_REPEATS, "repeats", repeats, f"1 to {MAX_REPEATS}")


def require_argument(condition: bool, name: str, got: object, expected: str) -> None:
    """Raise `PlanError` when an argument of a plan generator is not as expected."""
    if not condition:
        raise PlanError("cannot plan", faults=[Fault(name, short_repr(got), expected)])
