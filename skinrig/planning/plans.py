"""Minimal acquisition: goals, the chosen plan, its forecast and its omissions.

A plan is evaluated by the forecast of its errors, before a capture. Each rig has a forecast of its
own: the Fisher information of its samples, and the part of the error that no sample removes. Each
rig also has settings to choose from. This module parses the goals and reports the choice.
"""

import difflib
import importlib
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from capture.plan import Plan
from capture.rig import Rig, load_rig
from skinrig.capturing.light_safety import light_figures
from skinrig.capturing.plan_choice import read_plan
from skinrig.console import select_attributes
from skinrig.errors import UsageError, one_of
from skinrig.unit_format import format_quantity

SCHEMA = "skinrig.plan-choice/1"

WANTED_UNITS: Mapping[str, Mapping[str, str]] = {
    "dome": {"normals": "deg", "r_d": "%"},
    "flash": {"melanin": "%", "hemoglobin": "%"},
    "gradient": {"normals": "deg"},
    "probe": {"sigma_tr": "%"},
}
"""What can be wanted of each rig, and in which unit."""

PERCENT_BY_SITE = "percent_by_site"
"""Knob of the probe's choices: error of sigma_tr by site, red, green and blue, %."""

OMISSIONS_TABLE = resources.files("skinrig").joinpath("data/left_out.toml")

_WANTED_LIMIT = re.compile(r"\s*([a-z_]+)\s*<=\s*([0-9.eE+-]+)\s*(deg|%)?\s*")


class PlanningError(ValueError):
    """What is wanted is not known, or no plan can be made for it."""


class PlanOptionsError(PlanningError, UsageError):
    """What is wanted cannot be read, or options do not go together, or with the rig."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """The predicted error of one quantity."""

    name: str
    unit: str
    value: float
    """Predicted median error, in the unit; infinite where no estimate would be kept."""
    interval: tuple[float, float]
    """68 % interval of what a capture will show, from how far forecasts were off."""
    wanted: float | None
    """What was asked for; None: nothing."""

    @property
    def reached(self) -> bool:
        """Whether the forecast keeps to what was asked for."""
        return self.wanted is None or self.value <= self.wanted

    def document(self) -> dict[str, Any]:
        """Return this as JSON values."""
        named = {"name": self.name, "unit": self.unit, "median": self.value}
        return {**named, **select_attributes(self, "interval", "wanted", "reached")}


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """What a plan is chosen, or forecast, for."""

    wants: Mapping[str, float] = field(default_factory=dict)
    """Medians to reach, in the units of :data:`WANTED_UNITS`; empty: the rig's own plan."""
    subject: str = "III"
    """Preset of the simulated face that is forecast."""
    seed: int = 0
    """Of that face."""
    valid_share: float = 0.9
    """Of what the whole rig gives an estimate, so much must keep one."""
    most_lights: int | None = None
    """Largest number of lights, of a dome."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """What is simulated, and how it is calibrated, to confirm a choice."""

    targets: Mapping[str, Mapping[str, Any]]
    """Options of each calibration target's session."""
    calibrations: tuple[tuple[str, tuple[str, ...]], ...]
    """Kind, and the targets that it is made from."""
    want: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the subject's session, besides the plan."""


@dataclass(frozen=True, slots=True)
class PlanChoice:
    """A plan, why it is as it is, and what it will give."""

    rig: Rig
    """With the lights and views of the plan only."""
    plan: Plan
    forecasts: tuple[Forecast, ...]
    full_seconds: float
    """Of the rig's whole plan."""
    knobs: Mapping[str, Any]
    """What was chosen: lights, views, repeats, ..."""
    left_out: tuple[tuple[str, str], ...]
    """What the plan leaves out of the rig's whole plan, and why."""
    path: tuple[Mapping[str, float], ...] = ()
    """What each step of the choice bought."""
    reasons: tuple[str, ...] = ()
    """Why what is wanted is not reached, or what the forecast rests on."""
    flashes: Mapping[str, Any] = field(default_factory=dict)
    """Figures of flashes, where the rig has no LEDs."""

    @property
    def seconds(self) -> float:
        """Time of the capture, as the box's times add up."""
        return self.plan.estimate_duration_s(self.rig)

    @property
    def light(self) -> Mapping[str, Any]:
        """Flicker and dose, see `skinrig.capturing.light_safety.light_figures`, or flashes."""
        leds = self.rig.leds is not None or self.rig.probe is not None
        return light_figures(self.plan, self.rig) if leds else self.flashes

    @property
    def reached(self) -> bool:
        """Whether every forecast keeps to what was asked for."""
        return all(one.reached for one in self.forecasts)

    def to_document(self) -> dict[str, Any]:
        """Return the JSON document of the choice."""
        return {
            "schema": SCHEMA,
            "rig": self.rig.name,
            "reached": self.reached,
            "forecasts": [one.document() for one in self.forecasts],
            **select_attributes(self, "knobs", "seconds", "full_seconds"),
            "saved_seconds": self.full_seconds - self.seconds,
            **select_attributes(self, "left_out", "path", "reasons", "light"),
        }


def parse_wants(text: str, rig: str) -> dict[str, float]:
    """Read what is wanted of a rig.

    Parameters
    ----------
    text
        Such as ``"normals<=1deg,r_d<=3%"``; empty: nothing, the forecast of the plan is asked for.
    rig
        Name of the rig.

    Returns
    -------
    dict
        Error by name, in the unit of :data:`WANTED_UNITS`.

    Raises
    ------
    OptionsError
        Naming the part that cannot be read, and what can be wanted.
    PlanningError
        Naming what the rig does not give, or a number out of range.

    Examples
    --------
    >>> parse_wants("normals<=1deg, r_d <= 3%", "dome")
    {'normals': 1.0, 'r_d': 3.0}
    """
    units = WANTED_UNITS[one_of("rig", rig, WANTED_UNITS, PlanningError)]
    known = ", ".join(f"{name}<=NUMBER{unit}" for name, unit in units.items())
    wants: dict[str, float] = {}
    for part in filter(str.strip, text.split(",")):
        match = _WANTED_LIMIT.fullmatch(part)
        if match is None:
            raise PlanOptionsError(
                f"--goals: got {part.strip()!r}, expected {known}; correct it [SR-PLN-001]"
            )
        name, number, unit = match.groups()
        if name not in units:
            close = difflib.get_close_matches(name, units, 1)
            hint = f"; did you mean {close[0]}?" if close else ""
            others = [other for other, gives in WANTED_UNITS.items() if name in gives]
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
    """Return the forecasts of medians by name, each off by a relative spread."""
    return tuple(
        Forecast(
            name,
            WANTED_UNITS[rig][name],
            value,
            forecast_interval(value, relative_sd[name]),
            request.wants.get(name),
        )
        for name, value in medians.items()
    )


def list_omissions(rig: str, *rows: tuple[Any, ...]) -> tuple[tuple[str, str], ...]:
    """Return what a plan leaves out and why.

    Parameters
    ----------
    rig
        Its name.
    rows
        Whether it is left out, its name in `data/left_out.toml`, and what fills its braces.
    """
    table = tomllib.loads(OMISSIONS_TABLE.read_text(encoding="utf-8"))[rig]
    named = [(table[name], words) for left, name, *words in rows if left]
    return tuple((row["what"].format(*words), row["why"].format(*words)) for row, words in named)


def explain_less_light(reasons: Sequence[str]) -> str:
    """Return why less light will do, where there are reasons why the wish is out of reach."""
    if reasons:
        return "what is left errs by at most a twentieth more"
    return "what is left reaches what is wanted"


def choose(
    rig_name: str,
    want: str,
    *,
    width_px: int | None = None,
    forecast: Path | None = None,
    **request: Any,
) -> PlanChoice:
    """Choose the smallest plan of a rig that reaches what is wanted.

    Parameters
    ----------
    rig_name
        Out of :data:`WANTED_UNITS`.
    want
        See `parse_wants`.
    width_px
        Pixels across the cameras; None: the rig's own.
    forecast
        A plan, JSON, of which only the forecast is asked for.
    request
        Fields of `PlanRequest`.

    Raises
    ------
    PlanningError
        For what cannot be read or planned.
    """
    asked = PlanRequest(parse_wants(want, rig_name), **request)
    most_lights = asked.most_lights
    own = load_planner(rig_name)
    rig = load_rig(rig_name)
    if width_px is not None:
        if rig_name == "probe":
            raise PlanOptionsError(
                "--width: the probe's spots lie on its camera as it is; leave it"
            )
        # the gradient sphere keeps its pixels' size and gives up field, as its simulation does
        rig = rig.cropped(width_px) if rig_name == "gradient" else rig.resized(width_px)
    if most_lights is not None and most_lights < 1:
        raise PlanningError(f"--max-lights: got {most_lights}, expected 1 or more")
    if most_lights is not None and rig_name != "dome":
        raise PlanOptionsError(f"--max-lights: is for the dome, not the {rig_name} rig")
    if forecast is not None:
        plan = read_plan(forecast)
        if plan.rig != rig.name:
            raise PlanningError(
                f"{forecast}: got a plan of {plan.rig!r}, expected {rig.name!r}; name a plan of "
                "this rig [SR-PLN-003]"
            )
        found: PlanChoice = own.forecast(rig, plan, asked)
    else:
        found = own.choose(rig, asked)
    return found


def load_planner(rig_name: str) -> Any:
    """Return the module that plans for a rig.

    It has `choose`, `forecast`, and for a confirmation `rehearsal` and `measured`.
    """
    return importlib.import_module(f"skinrig.planning.{rig_name}")


def forecast_interval(value: float, relative_sd: float) -> tuple[float, float]:
    """Return the interval of a forecast that is off by a relative spread.

    Examples
    --------
    >>> forecast_interval(1.2, 0.2)
    (1.0, 1.44)
    """
    return value / (1.0 + relative_sd), value * (1.0 + relative_sd)


def median_magnitude(scale: ArrayLike) -> float:
    """Return the median magnitude of a mixture of normal errors; infinite for none.

    Parameters
    ----------
    scale : array_like
        Their standard deviations, each as often as another.

    Examples
    --------
    >>> round(median_magnitude([1.0, 1.0]), 4)
    0.6745
    """
    from scipy.special import erf

    s = np.maximum(np.asarray(scale, np.float64).reshape(-1), 1e-300)
    if not s.size:
        return math.inf
    low, high = 0.0, 2.0 * float(s.max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = float(np.mean(erf(middle / (math.sqrt(2.0) * s))))
        low, high = (middle, high) if below < 0.5 else (low, middle)
    return 0.5 * (low + high)


def format_choice(choice: PlanChoice) -> list[str]:
    """Return a choice as lines for people."""
    out = []
    for one in choice.forecasts:
        asked = (
            "" if one.wanted is None else f", wanted {format_quantity(f'{one.wanted:g}', one.unit)}"
        )
        if not math.isfinite(one.value):
            out.append(
                f"forecast: {one.name} keeps no estimate anywhere on this subject{asked}"
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
    out += [f"left out: {what} ({why})" for what, why in choice.left_out]
    out += [
        f"light: {name.replace('_', ' ')} {_format_knob(v)}" for name, v in choice.light.items()
    ]
    return out


def _format_site_errors(errors: Mapping[str, Sequence[float]]) -> str:
    """Return the errors of sites as people read them, each of its color.

    Parameters
    ----------
    errors
        Percent by site, red, green and blue; infinite where it is unknown.

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
    """Return a figure as people read it: four digits, names with their values.

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
