"""Benchmark of whole captures: error of maps against seconds from the choice of a plan to maps.

For each person, each image width and each budget, `skinrig.planning` chooses a plan. It is captured
by the simulated rig and reconstructed. Errors and seconds are compared with their forecasts.
"""

import math
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import Rig
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Knob, Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.calibrating.calibrate import calibrate
from skinrig.capturing.plan_choice import DefaultPlan
from skinrig.errors import require_choice
from skinrig.planning.confirmation import calibrate_simulated, capture_choice
from skinrig.planning.plans import PlanChoice, PlanRequest, load_planner, load_sized_rig
from skinrig.planning.time_budget import (
    RUN_PHASES,
    RunTimes,
    list_choices_within_budget,
    select_best,
)

Person = tuple[str, int]
"""Preset and seed of a simulated subject."""


@dataclass(frozen=True, slots=True)
class EndToEndCase:
    """People, image widths and budgets of one rig.

    Attributes
    ----------
    people
        Subjects; none of them set a constant of a forecast.
    budgets_s
        Budgets from planning to maps, s, by image width, px.
    """

    people: tuple[Person, ...]
    budgets_s: Mapping[int, tuple[float, ...]]


CASES: Final[Mapping[str, EndToEndCase]] = {
    "flash": EndToEndCase((("II", 611), ("V", 614)), {256: (30.0, 45.0, 90.0)})
}
CALIBRATION_SEED: Final = 9200
"""Seed of the noise and the poses of calibration targets."""
TOY_CASE: Final = EndToEndCase((("III", 600),), {64: (30.0, 45.0)})


@dataclass(slots=True)
class MeasuredPoint:
    """Forecasts and measurements of people at one image width and budget.

    Attributes
    ----------
    forecast, measured
        Median errors by map, one per person.
    forecast_s, measured_s
        Seconds of the phases, one per person.
    """

    forecast: list[Mapping[str, float]] = field(default_factory=list)
    measured: list[Mapping[str, float]] = field(default_factory=list)
    forecast_s: list[Mapping[str, float]] = field(default_factory=list)
    measured_s: list[Mapping[str, float]] = field(default_factory=list)

    def log_error_ratios(self, name: str) -> Float64Array:
        """Return logs of measured over forecast errors of a map, one per person."""
        pairs = zip(self.measured, self.forecast, strict=True)
        ratios = [found[name] / expected[name] for found, expected in pairs]
        return np.asarray(np.log(ratios), np.float64)

    def log_time_ratios(self) -> Float64Array:
        """Return logs of measured over forecast total seconds, one per person."""
        pairs = zip(self.measured_s, self.forecast_s, strict=True)
        ratios = [found["total"] / expected["total"] for found, expected in pairs]
        return np.asarray(np.log(ratios), np.float64)


def spread_ratio(logs: ArrayLike) -> float:
    """Return the geometric mean of ratios, or its inverse if that is larger.

    Examples
    --------
    >>> round(spread_ratio(np.log([0.8, 0.8])), 9)
    1.25
    """
    return math.exp(abs(float(np.mean(np.asarray(logs, np.float64)))))


def measure_end_to_end(stage: BenchmarkStage) -> Iterator[None]:
    """Measure one curve per rig and map, one rig after the other."""
    cases: Mapping[str, EndToEndCase] = {"flash": TOY_CASE} if stage.toy else CASES
    if stage.selection:
        require_choice("--end-to-end", stage.selection, CASES)
        cases = {stage.selection: cases[stage.selection]}
    for rig_name, case in cases.items():
        errors: dict[str, list[Float64Array]] = {}
        seconds: list[Float64Array] = []
        for (width, budget_s), point in _measure_case(rig_name, case).items():
            seconds.append(point.log_time_ratios())
            for name in point.measured[0]:
                errors.setdefault(name, []).append(point.log_error_ratios(name))
                _add_point(stage, rig_name, name, width, budget_s, point)
        for name, logs in errors.items():
            stage.limits["error", rig_name, name] = spread_ratio(np.concatenate(logs))
        stage.limits["seconds", rig_name] = spread_ratio(np.concatenate(seconds))
        yield


def _measure_case(rig_name: str, case: EndToEndCase) -> dict[tuple[int, float], MeasuredPoint]:
    """Return the measurements of each width and budget."""
    points: dict[tuple[int, float], MeasuredPoint] = {}
    for width, budgets_s in case.budgets_s.items():
        rig = load_sized_rig(rig_name, width)
        with tempfile.TemporaryDirectory() as name:
            calibrate_s = _calibrate(rig, Path(name))
            for person in case.people:
                for budget_s, measured in _measure_person(
                    rig, Path(name), person, budgets_s, calibrate_s
                ):
                    point = points.setdefault((width, budget_s), MeasuredPoint())
                    for one, values in zip(
                        (point.forecast, point.forecast_s, point.measured, point.measured_s),
                        measured,
                        strict=True,
                    ):
                        one.append(values)
    return points


def _calibrate(rig: Rig, folder: Path) -> float:
    """Simulate the targets, calibrate, and return the processor seconds of the calibration."""
    planner = load_planner(rig.name)
    whole = PlanChoice(rig, DefaultPlan().of(rig), (), 0.0, {}, ())
    steps = planner.describe_rehearsal(whole)
    drawn = {"session_seed": CALIBRATION_SEED}  # others set the constants of forecasts
    targets = {name: {**how, **drawn} for name, how in steps.targets.items()}
    calibrate_simulated(rig.name, folder, targets, (), seed=0)
    seconds = 0.0
    for kind, used in steps.calibrations:
        sessions = [folder / f"session-{target}" for target in used]
        # the first call imports modules
        seconds += measure_processor_time(
            partial(calibrate, kind, sessions, folder / "calibration"), 2
        )[0]
    return seconds


def _measure_person(
    rig: Rig, folder: Path, person: Person, budgets_s: Sequence[float], calibrate_s: float
) -> Iterator[tuple[float, tuple[Mapping[str, float], ...]]]:
    """Yield forecasts and measurements of a person for each budget."""
    subject, seed = person
    request = PlanRequest(subject=subject, seed=seed, budget_s=max(budgets_s))
    begun_s = time.process_time()
    choices = list_choices_within_budget(load_planner(rig.name).generate_choices, rig, request)
    plan_s = time.process_time() - begun_s
    done: dict[str, Any] = {}
    for budget_s in budgets_s:
        within = [one for one in choices if one.run_times["total"] <= budget_s]
        if not within:
            continue
        choice = select_best(within, request.min_valid_fraction)
        key = str(choice.plan.to_json())
        if key not in done:
            with tempfile.TemporaryDirectory() as name:
                (Path(name) / "calibration").symlink_to(folder / "calibration")
                done[key] = capture_choice(choice, Path(name), subject=subject, seed=seed)
        found = done[key]
        times = RunTimes(plan_s, found.capture_s, calibrate_s, found.reconstruct_s)
        errors = {one: found.errors[one][0] for one in choice.medians}
        yield budget_s, (choice.medians, choice.run_times, errors, times.by_phase())


def _add_point(
    stage: BenchmarkStage,
    rig_name: str,
    name: str,
    width: int,
    budget_s: float,
    point: MeasuredPoint,
) -> None:
    """Add the mean error over people of a map at a width and budget."""
    errors = np.array([one[name] for one in point.measured])
    forecasts = np.array([one[name] for one in point.forecast])
    mean_s = {
        phase: float(np.mean([one[phase] for one in point.measured_s])) for phase in RUN_PHASES
    }
    ratios = np.exp(point.log_error_ratios(name))
    extra: dict[str, Knob] = {f"{phase}, s": round(value, 3) for phase, value in mean_s.items()}
    extra |= {
        "people": len(errors),
        "forecast error": float(forecasts.mean()),
        "least measured over forecast": float(ratios.min()),
        "largest measured over forecast": float(ratios.max()),
        "forecast s": float(np.mean([one["total"] for one in point.forecast_s])),
    }
    half = float(errors.std(ddof=1) / math.sqrt(len(errors))) if len(errors) > 1 else 0.0
    stage.add(
        {"rig": rig_name, "map": name, "width": width, "budget_s": budget_s},
        Timing.single(sum(mean_s.values())),
        ErrorEstimate.nonnegative(float(errors.mean()), half),
        extra,
    )
