"""Minimal acquisition: goals, the chosen plan, its forecast and its omissions.

A plan is evaluated by the forecast of its errors, before a capture. Each rig has a forecast of its
own: the Fisher information of its samples, and the part of the error that no sample removes. Each
rig also has settings to choose from. This module parses the goals and reports the choice.
"""

import difflib
import importlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from capture.plan import Plan
from capture.rig import Rig, load_rig
from skinrig.capturing.light_safety import light_figures
from skinrig.capturing.plan_choice import read_plan
from skinrig.console import select_attributes
from skinrig.errors import UsageError, require_choice
from skinrig.planning.led_information import LedInformation, format_information
from skinrig.planning.plan_omissions import list_unmodeled_effects
from skinrig.unit_format import format_quantity

SCHEMA = "skinrig.plan-choice/1"

GOAL_UNITS: Mapping[str, Mapping[str, str]] = {
    "dome": {"normals": "deg", "r_d": "%"},
    "flash": {"melanin": "%", "hemoglobin": "%"},
    "gradient": {"normals": "deg"},
    "probe": {"sigma_tr": "%"},
}
"""Quantities with error goals by rig, with their unit."""

PERCENT_BY_SITE = "percent_by_site"
"""Key of the probe's error of sigma_tr by site, red, green and blue, %."""

_GOAL_PATTERN = re.compile(r"\s*([a-z_]+)\s*<=\s*([0-9.eE+-]+)\s*(deg|%)?\s*")


class PlanningError(ValueError):
    """Unknown goals, or goals that no plan can be made for."""


class PlanOptionsError(PlanningError, UsageError):
    """Malformed goals, or options that exclude each other or do not apply to the rig."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """Predicted median error of one quantity."""

    name: str
    unit: str
    value: float
    """Predicted median error, in `unit`; infinite where every estimate would be masked."""
    interval: tuple[float, float]
    """68 % interval of the measured error, from the deviations of earlier forecasts."""
    wanted: float | None
    """Goal, in `unit`; None: no goal."""

    @property
    def reached(self) -> bool:
        """Whether the predicted error is within the goal."""
        return self.wanted is None or self.value <= self.wanted

    def document(self) -> dict[str, Any]:
        """Return the forecast as JSON values."""
        named = {"name": self.name, "unit": self.unit, "median": self.value}
        return {**named, **select_attributes(self, "interval", "wanted", "reached")}


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Goals and subject of a plan."""

    goals: Mapping[str, float] = field(default_factory=dict)
    """Medians to reach, in the units of :data:`GOAL_UNITS`; empty: the rig's own plan."""
    subject: str = "III"
    """Preset of the simulated subject of the forecast."""
    seed: int = 0
    """Random seed of that subject."""
    min_valid_fraction: float = 0.9
    """Minimum fraction of the whole rig's valid estimates that stays valid."""
    max_lights: int | None = None
    """Maximum number of lights (dome)."""
    budget_s: float | None = None
    """Time from planning to maps, s, within which the error is minimized; None: no limit."""
    leds: tuple[str, ...] = ()
    """Narrow-band LEDs to add (flash), see `capture.plan.led_bands.parse_bands`."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Simulated sessions and calibrations that confirm a choice."""

    targets: Mapping[str, Mapping[str, Any]]
    """Options of each calibration target's session."""
    calibrations: tuple[tuple[str, tuple[str, ...]], ...]
    """Kinds of calibration, each with the targets that it is made from."""
    want: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the subject's session, in addition to the plan."""


@dataclass(frozen=True, slots=True)
class PlanChoice:
    """A chosen plan with its forecast, omissions and reasons."""

    rig: Rig
    """The rig, reduced to the lights and views of the plan."""
    plan: Plan
    forecasts: tuple[Forecast, ...]
    full_seconds: float
    """Duration of the whole rig's plan, s."""
    knobs: Mapping[str, Any]
    """Chosen settings by name: lights, views, repeats, ..."""
    left_out: tuple[tuple[str, str], ...]
    """Parts of the whole rig's plan that are omitted, with reasons."""
    path: tuple[Mapping[str, float], ...] = ()
    """Settings and predicted errors of each step of the search."""
    reasons: tuple[str, ...] = ()
    """Why a goal is not reached, or assumptions of the forecast."""
    flashes: Mapping[str, Any] = field(default_factory=dict)
    """Light figures of flashes, for rigs without LEDs."""
    information: tuple[LedInformation, ...] = ()
    """Bounds with and without narrow-band LEDs (flash); empty without any."""
    run_times: Mapping[str, float] = field(default_factory=dict)
    """Forecast seconds of each phase and their sum, see `skinrig.planning.time_budget.RunTimes`;
    empty if chosen without a budget."""

    @property
    def medians(self) -> dict[str, float]:
        """Predicted median errors by map."""
        return {one.name: one.value for one in self.forecasts}

    @property
    def seconds(self) -> float:
        """Duration of the capture, s, from the controller's times."""
        return self.plan.estimate_duration_s(self.rig)

    @property
    def light(self) -> Mapping[str, Any]:
        """Flicker and dose, see `skinrig.capturing.light_safety.light_figures`, or `flashes`."""
        leds = self.rig.leds is not None or self.rig.probe is not None
        return light_figures(self.plan, self.rig) if leds else self.flashes

    @property
    def reached(self) -> bool:
        """Whether every forecast is within its goal."""
        return all(one.reached for one in self.forecasts)

    def to_document(self) -> dict[str, Any]:
        """Return the JSON document of the choice."""
        leds = [row.to_document() for row in self.information]
        return {
            "schema": SCHEMA,
            "rig": self.rig.name,
            "reached": self.reached,
            "forecasts": [one.document() for one in self.forecasts],
            **select_attributes(self, "knobs", "seconds", "full_seconds"),
            "saved_seconds": self.full_seconds - self.seconds,
            **select_attributes(self, "left_out", "path", "reasons", "light"),
            "unmodeled": list_unmodeled_effects(self.rig.name),
            **({"leds": leds} if leds else {}),
            **({"run_times": self.run_times} if self.run_times else {}),
        }


def parse_goals(text: str, rig: str) -> dict[str, float]:
    """Parse error goals of a rig.

    Parameters
    ----------
    text
        Goals such as ``"normals<=1deg,r_d<=3%"``; empty: no goal, only a forecast.
    rig
        Name of the rig.

    Returns
    -------
    dict
        Maximum error by name, in the unit of :data:`GOAL_UNITS`.

    Raises
    ------
    PlanOptionsError
        If a part is malformed; the message lists the goals of the rig.
    PlanningError
        If the rig does not estimate a quantity, or a number is out of range.

    Examples
    --------
    >>> parse_goals("normals<=1deg, r_d <= 3%", "dome")
    {'normals': 1.0, 'r_d': 3.0}
    """
    units = GOAL_UNITS[require_choice("rig", rig, GOAL_UNITS, PlanningError)]
    known = ", ".join(f"{name}<=NUMBER{unit}" for name, unit in units.items())
    wants: dict[str, float] = {}
    for part in filter(str.strip, text.split(",")):
        match = _GOAL_PATTERN.fullmatch(part)
        if match is None:
            raise PlanOptionsError(
                f"--goals: got {part.strip()!r}, expected {known}; correct it [SR-PLN-001]"
            )
        name, number, unit = match.groups()
        if name not in units:
            close = difflib.get_close_matches(name, units, 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            others = [other for other, gives in GOAL_UNITS.items() if name in gives]
            if others:
                hint = f"; {name} is planned for {', '.join(others)}"
            raise PlanningError(
                f"--goals: got {name!r} of rig {rig!r}, expected {known}{hint}; choose a map of "
                "this rig [SR-PLN-002]"
            )
        if unit not in (None, units[name]):
            raise PlanOptionsError(f"--goals: got {name} in {unit}, expected {units[name]}")
        try:
            value = float(number)
        except ValueError:
            value = -1.0
        if not 0.0 < value < 1e6:
            raise PlanningError(
                f"--goals: got {name}<={number}{unit or ''}, expected above 0 and below 1e6"
            )
        if name in wants:
            raise PlanOptionsError(f"--goals: got {name} twice, expected it once")
        wants[name] = value
    return wants


def build_forecasts(
    medians: Mapping[str, float], relative_sd: Mapping[str, float], request: PlanRequest, rig: str
) -> tuple[Forecast, ...]:
    """Return forecasts of median errors, with intervals from their relative standard deviations."""
    return tuple(
        Forecast(
            name,
            GOAL_UNITS[rig][name],
            value,
            forecast_interval(value, relative_sd[name]),
            request.goals.get(name),
        )
        for name, value in medians.items()
    )


def choose(
    rig_name: str,
    want: str,
    *,
    width_px: int | None = None,
    forecast: Path | None = None,
    **request: Any,
) -> PlanChoice:
    """Choose the smallest plan of a rig that reaches the goals, or forecast a given plan.

    Parameters
    ----------
    rig_name
        Name of a rig, a key of :data:`GOAL_UNITS`.
    want
        Goals as text, see `parse_goals`.
    width_px
        Image width of the cameras, px; None: the rig's own.
    forecast
        Plan file (JSON) to forecast instead of choosing one.
    request
        Fields of `PlanRequest`.

    Raises
    ------
    PlanningError
        If goals, options or the plan are invalid.
    """
    asked = PlanRequest(parse_goals(want, rig_name), **request)
    most_lights, own = asked.max_lights, load_planner(rig_name)
    rig = load_sized_rig(rig_name, width_px)
    if most_lights is not None and most_lights < 1:
        raise PlanningError(f"--max-lights: got {most_lights}, expected 1 or more")
    if most_lights is not None and rig_name != "dome":
        raise PlanOptionsError(
            f"--max-lights: is an option of the dome, not of the {rig_name} rig; remove it"
        )
    others = {"--goals": asked.goals, "--forecast": forecast, "--bands": asked.leds}
    for other in (name for name, given in others.items() if given and asked.budget_s is not None):
        raise PlanOptionsError(f"--budget: got it together with {other}; remove one")
    if forecast is not None:
        plan = read_plan(forecast)
        if plan.rig != rig.name:
            raise PlanningError(
                f"{forecast}: got a plan of {plan.rig!r}, expected {rig.name!r}; name a plan of "
                "this rig [SR-PLN-003]"
            )
        found: PlanChoice = own.forecast(rig, plan, asked)
        return found
    found = own.choose(rig, asked)
    return found


def load_sized_rig(rig_name: str, width_px: int | None) -> Rig:
    """Return a rig at an image width, px; None: its own."""
    rig = load_rig(rig_name)
    if width_px is None:
        return rig
    if rig_name == "probe":
        raise PlanOptionsError(
            "--width: not an option of the probe, whose spots have fixed pixels; remove it"
        )
    # the gradient sphere keeps its pixel size and loses field of view, as in its simulation
    return rig.cropped(width_px) if rig_name == "gradient" else rig.resized(width_px)


def load_planner(rig_name: str) -> Any:
    """Return the planning module of a rig.

    It has `choose` and `forecast`, and for a confirmation `describe_rehearsal` and
    `measure_errors`.
    """
    return importlib.import_module(f"skinrig.planning.{rig_name}")


def forecast_interval(value: float, relative_sd: float) -> tuple[float, float]:
    """Return the 68 % interval of a forecast from its relative standard deviation.

    Examples
    --------
    >>> forecast_interval(1.2, 0.2)
    (1.0, 1.44)
    """
    return value / (1.0 + relative_sd), value * (1.0 + relative_sd)


def median_magnitude(scale: ArrayLike, offset: ArrayLike = 0.0) -> float:
    """Return the median magnitude of a mixture of normal errors; infinite if empty.

    Parameters
    ----------
    scale : array_like
        Standard deviations of the components, which have equal weights.
    offset : array_like
        Means of the components, broadcast to the shape of `scale`.

    Examples
    --------
    >>> round(median_magnitude([1.0, 1.0]), 4), round(median_magnitude([1e-3, 1e-3], -2.0), 2)
    (0.6745, 2.0)
    """
    from scipy.special import ndtr

    s = np.maximum(np.asarray(scale, np.float64), 1e-300)
    if not s.size:
        return math.inf
    o = np.broadcast_to(np.asarray(offset, np.float64), s.shape)
    low, high = 0.0, float(np.max(np.abs(o) + 2.0 * s))
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = np.mean(ndtr((middle - o) / s) - ndtr((-middle - o) / s))
        low, high = (middle, high) if below < 0.5 else (low, middle)
    return 0.5 * (low + high)


def format_choice(choice: PlanChoice) -> list[str]:
    """Format a choice as lines of text."""
    out = []
    for one in choice.forecasts:
        asked = (
            "" if one.wanted is None else f", wanted {format_quantity(f'{one.wanted:g}', one.unit)}"
        )
        if not math.isfinite(one.value):
            out.append(
                f"forecast: {one.name} has no valid estimate on this subject{asked}"
                f"{'' if one.reached else ': NOT REACHED'}"
            )
            continue
        out.append(
            f"forecast: {one.name} {format_quantity(f'{one.value:.3g}', one.unit)} in the median "
            f"({one.interval[0]:.3g} to {one.interval[1]:.3g}{asked}"
            f"{'' if one.reached else ': NOT REACHED'})"
        )
    out += [f"why: {reason}" for reason in choice.reasons]
    for name, value in choice.knobs.items():
        if name == PERCENT_BY_SITE:
            out.append(f"percent by site: {_format_site_errors(value)}")
            continue
        shown = f"{len(value)}: {', '.join(map(str, value))}" if isinstance(value, list) else ""
        out.append(f"{name.replace('_', ' ')}: {shown or _format_knob(value)}")
    out.append(
        f"capture: {choice.seconds:.1f} s, {choice.full_seconds - choice.seconds:.1f} s less than "
        "the whole rig's plan"
    )
    if times := choice.run_times:
        phases = ", ".join(f"{name} {value:.1f} s" for name, value in times.items())
        out.append(f"seconds from planning to maps: {phases}")
    out += [f"omitted: {what} ({why})" for what, why in choice.left_out]
    out += [f"not modeled: {what} ({why})" for what, why in list_unmodeled_effects(choice.rig.name)]
    out += [
        f"light: {name.replace('_', ' ')} {_format_knob(v)}" for name, v in choice.light.items()
    ]
    return out + format_information(choice.information)


def _format_site_errors(errors: Mapping[str, Sequence[float]]) -> str:
    """Format the errors of sites, each with its color.

    Parameters
    ----------
    errors
        Errors by site, percent, red, green and blue; infinite: unknown.

    Examples
    --------
    >>> _format_site_errors({"chin": (0.444, 1.399, math.inf), "cheek": (0.5, 1.0, 2.0)})
    'chin red 0.444 %, green 1.4 %, blue unknown; cheek red 0.5 %, green 1 %, blue 2 %'
    """
    return "; ".join(
        f"{site} "
        + ", ".join(
            f"{color} " + (f"{one:.3g} %" if math.isfinite(one) else "unknown")
            for color, one in zip(("red", "green", "blue"), row, strict=True)
        )
        for site, row in errors.items()
    )


def _format_knob(value: Any) -> str:
    """Format a figure with four digits; mappings as names with values.

    Examples
    --------
    >>> _format_knob(0.05926277112717791), _format_knob({"melanin": 1.0, "r_d": 0.98765})
    ('0.05926', 'melanin 1, r_d 0.9877')
    >>> _format_knob(True)
    'yes'
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_format_knob(item)}" for key, item in value.items())
    return str(value)
