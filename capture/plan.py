"""What shall be captured: frozen steps, and the generators of the flash rig's plans."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Literal, get_args

from pydantic import ConfigDict

from capture.documents import STRICT, Checks, Fault, InputError, near_miss, parse, read_json, shown
from capture.rig import ID_RULE, Rig, is_id

Value = str | int | float | bool
Kind = Literal["dark", "flat", "chart", "malus", "subject"]
Polarizer = Literal["parallel", "crossed"]
Target = Literal["dark", "flat", "chart", "malus"]

KINDS: tuple[str, ...] = get_args(Kind)
POLARIZERS: tuple[str, ...] = get_args(Polarizer)

# powers of the photon transfer series: dense in the shadows, up to full scale
FLAT_POWERS = (0.03125, 0.0625, 0.125, 0.1875, 0.25, 0.375, 0.5, 0.625, 0.75, 1.0)
MALUS_ANGLES_DEG = tuple(15.0 * k for k in range(13))

# settings every rig understands: name -> (types, test, what is expected)
_SETTINGS: Mapping[str, tuple[tuple[type, ...], Any, str]] = {
    "polarizer": ((str,), lambda v: v in POLARIZERS, '"parallel" or "crossed"'),
    "analyser_deg": ((int, float), lambda v: 0 <= v < 360, "0 <= degrees < 360"),
    "power": ((int, float), lambda v: 0 <= v <= 1, "0 <= power <= 1"),
    "exposure_s": ((int, float), lambda v: 0 < v < math.inf, "seconds > 0"),
    "iso": ((int, float), lambda v: 0 < v < math.inf, "> 0"),
}


class PlanError(InputError):
    """A plan, or a plan file, that cannot be carried out."""


@dataclass(frozen=True, slots=True)
class Step:
    """One thing to capture.

    Parameters
    ----------
    id : str
        Unlike every other step's, usable in a file name.
    kind : str
        "dark", "flat", "chart", "malus" or "subject".
    index : mapping of str to str, int or float
        Where the step stands in its series, e.g. ``{"state": "neutral", "repeat": 0}``.
    settings : mapping of str to str, int, float or bool
        ``polarizer`` ("parallel" or "crossed"), ``power`` (0 to 1 of a light's full energy),
        ``exposure_s`` (s), ``iso``; ``analyser_deg`` (rotator reading, degrees; 0 is parallel, 90
        crossed) takes precedence over ``polarizer``. A rig may bring further names.
    cameras : tuple of str
        Views that take a frame.

    Examples
    --------
    >>> Step("S1", "dark", {}, {"exposure": 0.1}, ("cam",))
    Traceback (most recent call last):
        ...
    capture.plan.PlanError: Step 'S1' is not valid
      settings.exposure: got 0.1, expected a known setting; did you mean exposure_s? (in s)
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    id: str
    kind: Kind
    index: Mapping[str, str | int | float]
    settings: Mapping[str, Value]
    cameras: tuple[str, ...]

    def __post_init__(self) -> None:
        checks = Checks(f"Step {self.id!r}", PlanError)
        checks.that("id", self.id, is_id(self.id), ID_RULE)
        checks.that("kind", self.kind, self.kind in KINDS, f"one of {', '.join(KINDS)}")
        for table, types in (("index", (str, int, float)), ("settings", (str, int, float, bool))):
            for key, value in getattr(self, table).items():
                good = isinstance(value, types) and (types[-1] is bool or value is not True)
                good = good and not (isinstance(value, float) and not math.isfinite(value))
                checks.that(f"{table}.{key}", value, good, "a text or a finite number")
        for fault in check_settings(self.settings):
            checks.note(fault)
        differ = len(set(self.cameras)) == len(self.cameras) > 0
        checks.that("cameras", self.cameras, differ, "at least one, none twice")
        for camera in self.cameras:
            checks.that("cameras", camera, is_id(camera), ID_RULE)
        checks.close()
        object.__setattr__(self, "index", MappingProxyType(dict(self.index)))
        object.__setattr__(self, "settings", MappingProxyType(dict(self.settings)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes as plain dictionaries."""
        parts = (self.id, self.kind, dict(self.index), dict(self.settings), self.cameras)
        return (Step, parts)

    def to_json(self) -> dict[str, Any]:
        """Return the step as JSON values."""
        return {
            "id": self.id,
            "kind": self.kind,
            "index": dict(self.index),
            "settings": dict(self.settings),
            "cameras": list(self.cameras),
        }


def check_settings(settings: Mapping[str, Value]) -> list[Fault]:
    """Return the faults of known settings, and of names that are a near miss of a known one."""
    faults = []
    for key, value in settings.items():
        if key in _SETTINGS:
            types, good, expected = _SETTINGS[key]
            if not isinstance(value, types) or isinstance(value, bool) or not good(value):
                faults.append(Fault(f"settings.{key}", shown(value), expected))
        elif hint := near_miss(key, _SETTINGS):
            faults.append(Fault(f"settings.{key}", shown(value), "a known setting", hint))
    return faults


@dataclass(frozen=True, slots=True)
class Plan:
    """Steps in the order of capture, for one rig, with the limits they were planned within.

    Parameters
    ----------
    rig : str
        Name of the rig.
    steps : tuple of Step
        At least one; ids differ, also when upper and lower case are not told apart.
    limits : mapping of str to float
        What the planner kept to, e.g. ``{"max_pops_per_min": 20.0, "recycle_s": 1.5}``.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    rig: str
    steps: tuple[Step, ...]
    limits: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks = Checks("Plan", PlanError)
        checks.that("rig", self.rig, is_id(self.rig), ID_RULE)
        checks.that("steps", self.steps, len(self.steps) > 0, "at least one step")
        seen: dict[str, int] = {}
        for number, step in enumerate(self.steps):
            first = seen.setdefault(step.id.casefold(), number)
            unlike = f"an id unlike that of steps[{first}]"
            checks.that(f"steps[{number}].id", step.id, first == number, unlike)
        for key, value in self.limits.items():
            checks.that(f"limits.{key}", value, math.isfinite(value), "a finite number")
        checks.close()
        object.__setattr__(self, "limits", MappingProxyType(dict(self.limits)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel between processes as plain dictionaries."""
        return (Plan, (self.rig, self.steps, dict(self.limits)))

    def step(self, step_id: str) -> Step:
        """Return the step called ``step_id``."""
        for step in self.steps:
            if step.id == step_id:
                return step
        ids = [step.id for step in self.steps]
        expected = f"one of {len(ids)} ids from {ids[0]} to {ids[-1]}"
        fault = Fault("step", repr(step_id), expected, near_miss(step_id, ids))
        raise PlanError(f"the plan has no step {step_id!r}", faults=[fault])

    def check(self, rig: Rig) -> None:
        """Raise where the plan is for another rig or asks for views the rig does not have."""
        checks = Checks(f"Plan for rig {self.rig!r}", PlanError)
        checks.that("rig", self.rig, self.rig == rig.name, f"the rig's name {rig.name!r}")
        views = [view.name for view in rig.views]
        for number, step in enumerate(self.steps):
            for camera in step.cameras:
                known = camera in views
                path = f"steps[{number}].cameras"
                checks.that(path, camera, known, f"one of {', '.join(views)}")
        checks.close()

    def estimated_s(self, rig: Rig) -> float:
        """Return the least time the plan takes on ``rig``, s.

        Per step the slowest camera's exposure and read-out, or the recycling of the flash where
        that is longer, and the turning of the analyser where its state changes.
        """
        total = 0.0
        state: object = None
        for step in self.steps:
            readout_s = max(rig.view(name).readout_s for name in step.cameras)
            power = float(step.settings.get("power", 0.0))
            pause_s = max(rig.recycle_s * power, 60.0 / rig.max_pops_per_min) if power > 0 else 0.0
            total += max(float(step.settings.get("exposure_s", 0.0)) + readout_s, pause_s)
            asked = step.settings.get("analyser_deg", step.settings.get("polarizer"))
            total += rig.polarizer_move_s if asked not in (state, None) else 0.0
            state = state if asked is None else asked
        return total

    def to_json(self) -> dict[str, Any]:
        """Return the plan as JSON values."""
        return {
            "rig": self.rig,
            "steps": [step.to_json() for step in self.steps],
            "limits": dict(self.limits),
        }

    @staticmethod
    def from_json(data: Mapping[str, Any] | str | bytes, *, where: str = "plan") -> Plan:
        """Build a plan from JSON text or decoded JSON, listing all faults at once.

        Raises
        ------
        PlanError
            With every fault's path, what was found and what was expected.
        """
        if isinstance(data, str | bytes):
            data = read_json(data, where=where, error=PlanError)
        return parse(Plan, data, where=where, error=PlanError)


def flash_plan(
    rig: Rig,
    *,
    states: Sequence[str] = ("neutral",),
    repeats: int = 1,
    darks: int = 4,
    power: float = 1.0,
    exposure_s: float = 0.008,
    iso: int = 100,
) -> Plan:
    """Plan parallel and crossed flash images of a subject in each of several states.

    Parameters
    ----------
    rig : Rig
    states : sequence of str
        Expressions or physiological states, captured one after the other.
    repeats : int
        Image pairs per state, >= 1.
    darks : int
        Frames with no light at the beginning, >= 0.
    power : float
        Flash power, 0 < power <= 1.
    exposure_s : float
        Exposure time, s; it covers the pop.
    iso : int

    Returns
    -------
    Plan
        Darks, then per state and repeat a parallel and a crossed image; the order of the two
        alternates, so that the analyser turns once per pair.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash")
    >>> plan = flash_plan(rig, states=("neutral", "anger"), darks=1)
    >>> [(s.id, s.settings["polarizer"]) for s in plan.steps]  # doctest: +NORMALIZE_WHITESPACE
    [('D000', 'parallel'), ('S000', 'parallel'), ('S001', 'crossed'), ('S002', 'crossed'),
     ('S003', 'parallel')]
    >>> round(plan.estimated_s(rig), 2)
    29.04
    """
    _require(repeats >= 1, "repeats", repeats, ">= 1")
    _require(darks >= 0, "darks", darks, ">= 0")
    _require(0 < power <= 1, "power", power, "0 < power <= 1")
    series = _Series(rig, exposure_s=exposure_s, iso=iso)
    series.darks(darks)
    pair: list[Polarizer] = ["parallel", "crossed"]
    for state in states:
        for repeat in range(repeats):
            for polarizer in pair:
                index: dict[str, str | int | float] = {"state": state, "polarizer": polarizer}
                index["repeat"] = repeat
                series.add("S", "subject", index, polarizer=polarizer, power=power)
            pair.reverse()
    return series.plan()


def flash_calibration_plan(
    rig: Rig,
    target: Target,
    *,
    repeats: int = 2,
    darks: int = 2,
    exposure_s: float = 0.008,
    iso: int = 100,
) -> Plan:
    """Plan the frames of one calibration of the flash rig.

    Parameters
    ----------
    rig : Rig
    target : {"dark", "flat", "chart", "malus"}
        "dark": ``8 * repeats`` frames with the cap on; "flat": 10 flash powers on an even white
        field, ``repeats`` frames each (photon transfer pairs); "chart": ``repeats`` parallel and
        crossed images of a color chart; "malus": 13 analyser angles from 0 to 180 degrees,
        ``repeats`` frames each.
    repeats : int
        Frames per condition, >= 1 (>= 2 for "flat": pairs).
    darks : int
        Frames with no light before all but "dark", >= 0.
    exposure_s, iso
        Exposure time, s, and sensitivity.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> plan = flash_calibration_plan(load_rig("flash"), "malus", repeats=1, darks=0)
    >>> plan.steps[-1].index["analyser_deg"], plan.steps[-1].kind
    (180.0, 'malus')
    """
    targets = get_args(Target)
    _require(target in targets, "target", target, f"one of {', '.join(targets)}")
    least = 2 if target == "flat" else 1
    _require(repeats >= least, "repeats", repeats, f">= {least}")
    _require(darks >= 0, "darks", darks, ">= 0")
    series = _Series(rig, exposure_s=exposure_s, iso=iso)
    series.darks(8 * repeats if target == "dark" else darks)
    conditions: Iterable[tuple[dict[str, str | float], dict[str, Value]]]
    if target == "dark":
        conditions = ()
    elif target == "flat":
        conditions = [({"power": p}, {"polarizer": "parallel", "power": p}) for p in FLAT_POWERS]
    elif target == "chart":
        conditions = [({"polarizer": p}, {"polarizer": p, "power": 1.0}) for p in POLARIZERS]
    else:
        conditions = [
            ({"analyser_deg": a}, {"polarizer": "parallel", "analyser_deg": a, "power": 1.0})
            for a in MALUS_ANGLES_DEG
        ]
    for index, settings in conditions:
        for repeat in range(repeats):
            series.add(target[0].upper(), target, {**index, "repeat": repeat}, **settings)
    return series.plan()


class _Series:
    """Steps being numbered, for all views of one rig at one exposure."""

    def __init__(self, rig: Rig, *, exposure_s: float, iso: int) -> None:
        self._rig = rig
        self._exposure: dict[str, Value] = {"exposure_s": exposure_s, "iso": iso}
        self._steps: list[Step] = []
        self._counts: dict[str, int] = {}

    def add(
        self, letter: str, kind: Kind, index: Mapping[str, str | int | float], **settings: Value
    ) -> None:
        number = self._counts.get(letter, 0)
        self._counts[letter] = number + 1
        cameras = tuple(view.name for view in self._rig.views)
        identity = f"{letter}{number:03d}"
        self._steps.append(Step(identity, kind, index, {**settings, **self._exposure}, cameras))

    def darks(self, count: int) -> None:
        for repeat in range(count):
            self.add("D", "dark", {"repeat": repeat}, polarizer="parallel", power=0.0)

    def plan(self) -> Plan:
        limits = {
            "max_pops_per_min": self._rig.max_pops_per_min,
            "recycle_s": self._rig.recycle_s,
        }
        return Plan(self._rig.name, tuple(self._steps), limits)


def _require(good: bool, name: str, got: object, expected: str) -> None:
    if not good:
        raise PlanError("cannot plan", faults=[Fault(name, shown(got), expected)])
