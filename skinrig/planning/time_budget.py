"""Choose the plan with the smallest forecast error within a time from planning to maps."""

import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any, Final

from capture.plan import Plan
from capture.rig import Rig
from skinrig.planning.plans import PlanChoice, PlanningError, PlanOptionsError, PlanRequest

RUN_TIMES_TABLE: Final = resources.files("skinrig").joinpath("data/run_times.toml")
SECONDS_BY_UNIT: Final[Mapping[str, float]] = {"s": 1.0, "min": 60.0}
RUN_PHASES: Final = ("plan", "capture", "calibrate", "reconstruct")
"""Phases from the choice of a plan to its maps, in order."""

Affordable = Callable[[Rig, Plan], bool]
"""Returns whether a plan of a rig, reduced to the plan's lights and views, is within the budget."""
ChoiceGenerator = Callable[[Rig, PlanRequest, Affordable], Iterable[PlanChoice]]
"""Generates affordable plans of a rig with their forecasts, by increasing duration."""

_BUDGET_PATTERN = re.compile(r"\s*([0-9.eE+-]+)\s*(s|min)\s*")


@dataclass(frozen=True, slots=True)
class RunTimes:
    """Seconds of each phase from the choice of a plan to its maps."""

    plan_s: float
    """Processor time of the choice, s."""
    capture_s: float
    """Duration of the capture of the subject on the rig's clock, s."""
    calibrate_s: float
    """Processor time of the calibrations, s; without the capture of their targets."""
    reconstruct_s: float
    """Processor time of the reconstruction, s."""

    @property
    def total_s(self) -> float:
        """Sum of all phases, s."""
        return self.plan_s + self.capture_s + self.calibrate_s + self.reconstruct_s

    def by_phase(self) -> dict[str, float]:
        """Return the seconds of each phase and their sum.

        Examples
        --------
        >>> RunTimes(1.0, 6.0, 0.5, 8.0).by_phase()["total"]
        15.5
        """
        phases = (self.plan_s, self.capture_s, self.calibrate_s, self.reconstruct_s)
        return dict(zip(RUN_PHASES, phases, strict=True)) | {"total": self.total_s}


def parse_budget(text: str) -> float:
    """Parse a time with its unit, s.

    Parameters
    ----------
    text
        Number and unit, "s" or "min".

    Raises
    ------
    PlanOptionsError
        If number or unit is missing.
    PlanningError
        If the time is not positive and finite.

    Examples
    --------
    >>> parse_budget("60s"), parse_budget("1.5 min")
    (60.0, 90.0)
    """
    match = _BUDGET_PATTERN.fullmatch(text)
    if match is None:
        raise PlanOptionsError(
            f"--budget: got {text!r}, expected seconds or minutes such as 60s or 5min; add the unit"
        )
    try:
        seconds = float(match[1]) * SECONDS_BY_UNIT[match[2]]
    except ValueError:
        seconds = math.nan
    if not 0.0 < seconds < math.inf:
        raise PlanningError(f"--budget: got {text.strip()}, expected a time above 0; raise it")
    return seconds


def forecast_run_times(rig: Rig, plan: Plan) -> RunTimes:
    """Forecast the seconds of each phase of a plan.

    Processor times are linear in the pixels of a camera and in those of all frames.

    Parameters
    ----------
    rig
        The rig at the image width of the capture, reduced to the plan's lights and views.
    plan
        The plan.

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash").resized(256)
    >>> times = forecast_run_times(rig, flash_plan(rig))
    >>> times.capture_s, times.reconstruct_s < times.capture_s
    (33.748, True)
    """
    seconds = _read_run_times()[rig.name]
    cameras, frames = measure_megapixels(rig, plan)
    calibrate_s, reconstruct_s = (
        one["fixed_s"] + one["camera_megapixel_s"] * cameras + one["frame_megapixel_s"] * frames
        for one in (seconds["calibrate"], seconds["reconstruct"])
    )
    return RunTimes(seconds["plan_s"], plan.estimate_duration_s(rig), calibrate_s, reconstruct_s)


def measure_megapixels(rig: Rig, plan: Plan) -> tuple[float, float]:
    """Return the megapixels of a plan's cameras, and those of all its frames.

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("flash").resized(1000)
    >>> cameras, frames = measure_megapixels(rig, flash_plan(rig))
    >>> round(frames / cameras)  # parallel, crossed and four dark frames
    6
    """
    megapixels = {view.name: view.width_px * view.height_px * 1e-6 for view in rig.all_views}
    used = {name for step in plan.steps for name in step.cameras}
    frames = sum(megapixels[name] for step in plan.steps for name in step.cameras)
    return sum(megapixels[name] for name in used), frames


def combine_errors(medians: Mapping[str, float]) -> float:
    """Return the geometric mean of median errors, which ranks plans for any units.

    Parameters
    ----------
    medians
        Median errors by map; infinite: no valid estimate.

    Examples
    --------
    >>> combine_errors({"melanin": 4.0, "hemoglobin": 9.0})
    6.0
    """
    return math.prod(medians.values()) ** (1.0 / len(medians))


def choose_within_budget(
    generate_choices: ChoiceGenerator, rig: Rig, request: PlanRequest
) -> PlanChoice:
    """Choose the plan with the smallest forecast error whose forecast time is within the budget.

    Plans with fewer valid estimates than the request allows, relative to the most of any plan
    within the budget, are excluded. Of equal plans the quickest is chosen.

    Parameters
    ----------
    generate_choices
        Generator of the rig's plans.
    rig
        The rig at the image width of the capture.
    request
        Subject and budget; goals are ignored.

    Raises
    ------
    PlanningError
        If the shortest plan exceeds the budget; the message gives its time.
    """
    choices = list_choices_within_budget(generate_choices, rig, request)
    best = select_best(choices, request.min_valid_fraction)
    path = tuple(
        {"total_s": one.run_times["total"], "capture_s": one.seconds, **one.medians}
        for one in sorted(choices, key=lambda one: one.run_times["total"])
    )
    return replace(best, path=path, reasons=(*best.reasons, *_list_assumptions(best.rig)))


def _list_assumptions(rig: Rig) -> Iterator[str]:
    """Yield what the forecast of a rig's seconds assumes."""
    width_px = rig.views[0].width_px
    set_px = _read_run_times()[rig.name].get("set_width_px", width_px)
    if not 0.5 * set_px <= width_px <= 2.0 * set_px:
        yield (
            f"seconds of calibration and reconstruction were set on images {set_px} pixels wide; "
            f"those at {width_px} pixels are an assumption"
        )


def select_best(choices: Sequence[PlanChoice], min_valid_fraction: float) -> PlanChoice:
    """Return the choice with the smallest error that keeps enough valid estimates.

    Parameters
    ----------
    choices
        Choices with their run times, at least one.
    min_valid_fraction
        Minimum fraction of the most valid estimates of any choice.
    """
    most = max(least_valid_share(one) for one in choices)
    enough = [one for one in choices if least_valid_share(one) >= min_valid_fraction * most]
    return min(enough, key=lambda one: (combine_errors(one.medians), one.run_times["total"]))


def list_choices_within_budget(
    generate_choices: ChoiceGenerator, rig: Rig, request: PlanRequest
) -> list[PlanChoice]:
    """Return the plans whose forecast time is within the budget, with their times.

    Parameters
    ----------
    generate_choices, rig, request
        As in `choose_within_budget`.
    """
    budget_s = math.inf if request.budget_s is None else request.budget_s
    totals_s: list[float] = []

    def is_affordable(small: Rig, plan: Plan) -> bool:
        totals_s.append(forecast_run_times(small, plan).total_s)
        return totals_s[-1] <= budget_s

    choices = [
        replace(one, run_times=forecast_run_times(one.rig, one.plan).by_phase())
        for one in generate_choices(rig, request, is_affordable)
    ]
    if not choices:
        narrower = "" if rig.name == "probe" else " or lower --width"
        raise PlanningError(
            f"--budget: got {budget_s:g} s, expected at least {math.ceil(min(totals_s))} s for the "
            f"quickest plan of the {rig.name} rig and its maps; raise it{narrower}"
        )
    return choices


def least_valid_share(choice: PlanChoice) -> float:
    """Return the least valid fraction over the maps of a choice."""
    share = choice.knobs["valid_share"]
    return float(min(share.values()) if isinstance(share, Mapping) else share)


@cache
def _read_run_times() -> dict[str, dict[str, Any]]:
    return tomllib.loads(RUN_TIMES_TABLE.read_text(encoding="utf-8"))
