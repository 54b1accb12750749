"""Benchmark of whole captures: error of maps against seconds from the choice of a plan to maps.

For each person, each image width and each budget, `skinrig.planning` chooses a plan. It is captured
by the simulated rig, with a calibration per person, and reconstructed. Errors and seconds are
compared with their forecasts.
"""

import math
import shutil
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
from skinrig.errors import require_choice
from skinrig.planning.confirmation import calibrate_simulated, capture_choice
from skinrig.planning.plans import PlanChoice, PlanRequest, Rehearsal, load_planner, load_sized_rig
from skinrig.planning.time_budget import (
    RUN_PHASES,
    RunTimes,
    list_choices_within_budget,
    select_best,
)

PRESET_NAMES: Final = ("I", "II", "III", "IV", "V", "VI")
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
        Budgets from planning to maps, s, by image width, px; None: the rig's own width.
    by_coverage
        Whether the coverage of the forecast's interval is judged instead of its median: one
        calibration's error is common to all fits of a person.
    """

    people: tuple[Person, ...]
    budgets_s: Mapping[int | None, tuple[float, ...]]
    by_coverage: bool = False

    def shorten(self) -> "EndToEndCase":
        """Return the case of the first person at the smallest budget of the first width."""
        width, budgets_s = next(iter(self.budgets_s.items()))
        return EndToEndCase(self.people[:1], {width: (min(budgets_s),)}, self.by_coverage)


CASES: Final[Mapping[str, EndToEndCase]] = {
    # forecasts have their knee at 32 to 34 s: one plan before it, one at it, one beyond
    "dome": EndToEndCase((("II", 755), ("IV", 753)), {320: (25.0, 33.0, 45.0)}),
    "flash": EndToEndCase(
        tuple(zip(PRESET_NAMES, range(621, 627), strict=True)), {256: (30.0, 45.0, 90.0)}
    ),
    "gradient": EndToEndCase((("II", 742), ("V", 743)), {128: (24.8, 24.95, 32.8)}),
    "probe": EndToEndCase(
        (("II", 722), ("IV", 723), ("V", 724)), {None: (55.0, 90.0, 160.0)}, by_coverage=True
    ),
}
CALIBRATION_SEED: Final = 9210
"""Seed of the noise and the poses of the first person's calibration targets."""
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
    inside
        Whether each map's error is inside the forecast's 68 % interval, one per person.
    """

    forecast: list[Mapping[str, float]] = field(default_factory=list)
    measured: list[Mapping[str, float]] = field(default_factory=list)
    forecast_s: list[Mapping[str, float]] = field(default_factory=list)
    measured_s: list[Mapping[str, float]] = field(default_factory=list)
    inside: list[Mapping[str, bool]] = field(default_factory=list)

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
    for rig_name, case in _select_cases(stage).items():
        begin = len(stage.points)
        for points in _measure_case(rig_name, case):
            del stage.points[begin:]  # those of fewer people
            _add_curves(stage, rig_name, points, by_coverage=case.by_coverage)
            yield


def _select_cases(stage: BenchmarkStage) -> Mapping[str, EndToEndCase]:
    """Return the cases by rig: at toy size of one person, and of the flash rig by default."""
    if stage.selection:
        require_choice("--end-to-end", stage.selection, CASES)
    if not stage.toy:
        return {stage.selection: CASES[stage.selection]} if stage.selection else CASES
    name = stage.selection or "flash"
    return {name: TOY_CASE if name == "flash" else CASES[name].shorten()}


def _add_curves(
    stage: BenchmarkStage,
    rig_name: str,
    points: Mapping[tuple[int, float], MeasuredPoint],
    *,
    by_coverage: bool,
) -> None:
    """Add the points of a rig, one per width, budget and map, and its limits."""
    errors: dict[str, list[Float64Array]] = {}
    inside: dict[str, list[bool]] = {}
    for (width, budget_s), point in points.items():
        for name in point.measured[0]:
            errors.setdefault(name, []).append(point.log_error_ratios(name))
            inside.setdefault(name, []).extend(one[name] for one in point.inside)
            _add_point(stage, rig_name, name, width, budget_s, point)
    for name, logs in errors.items():
        if by_coverage:
            stage.limits["inside", rig_name, name] = float(np.mean(inside[name]))
        else:
            stage.limits["error", rig_name, name] = spread_ratio(np.concatenate(logs))
    seconds = np.concatenate([point.log_time_ratios() for point in points.values()])
    stage.limits["seconds", rig_name] = spread_ratio(seconds)


def _measure_case(
    rig_name: str, case: EndToEndCase
) -> Iterator[dict[tuple[int, float], MeasuredPoint]]:
    """Yield the measurements by width and budget, after each person those of one person more."""
    points: dict[tuple[int, float], MeasuredPoint] = {}
    for width, budgets_s in case.budgets_s.items():
        rig = load_sized_rig(rig_name, width)
        for number, person in enumerate(case.people):
            seed = CALIBRATION_SEED + number
            for budget_s, choice, found in measure_person(rig, person, budgets_s, seed):
                key = rig.views[0].width_px, budget_s
                point = points.setdefault(key, MeasuredPoint())
                medians = {one: found.errors[one][0] for one in choice.medians}
                point.forecast.append(choice.medians)
                point.forecast_s.append(choice.run_times)
                point.measured.append(medians)
                point.measured_s.append(found.times.by_phase())
                point.inside.append(
                    {
                        one.name: one.interval[0] <= medians[one.name] <= one.interval[1]
                        for one in choice.forecasts
                    }
                )
            yield points


@dataclass(frozen=True, slots=True)
class MeasuredCapture:
    """Errors and times from planning to maps of one person."""

    errors: Mapping[str, tuple[float, float]]
    """Median error, in the unit of the rig's goals, and valid fraction by map."""
    times: RunTimes


def measure_person(
    rig: Rig, person: Person, budgets_s: Sequence[float], calibration_seed: int
) -> Iterator[tuple[float, PlanChoice, MeasuredCapture]]:
    """Yield budget, choice and measurement of a person for each budget that has a plan.

    Parameters
    ----------
    rig
        The rig at the image width of the capture.
    person
        Preset and seed of the subject.
    budgets_s
        Budgets from planning to maps, s.
    calibration_seed
        Seed of noise and poses of the calibration targets.
    """
    subject, seed = person
    planner = load_planner(rig.name)
    request = PlanRequest(subject=subject, seed=seed, budget_s=max(budgets_s))
    begun_s = time.process_time()
    choices = list_choices_within_budget(planner.generate_choices, rig, request)
    plan_s = time.process_time() - begun_s
    chosen: list[tuple[float, PlanChoice]] = []
    for budget_s in budgets_s:
        if within := [one for one in choices if one.run_times["total"] <= budget_s]:
            chosen.append((budget_s, select_best(within, request.min_valid_fraction)))
    found = measure_choices(person, [choice for _, choice in chosen], plan_s, calibration_seed)
    for (budget_s, choice), one in zip(chosen, found, strict=True):
        yield budget_s, choice, one


def measure_choices(
    person: Person, choices: Sequence[PlanChoice], plan_s: float, calibration_seed: int
) -> Iterator[MeasuredCapture]:
    """Calibrate, capture and reconstruct plans of a person; yield the measurement of each.

    Parameters
    ----------
    person
        Preset and seed of the subject.
    choices
        Plans of one rig; equal ones are captured once.
    plan_s
        Processor time of their choice, s.
    calibration_seed
        Seed of noise and poses of the calibration targets.
    """
    subject, seed = person
    done: dict[str, MeasuredCapture] = {}
    with tempfile.TemporaryDirectory() as name:
        calibrations = _Calibrations(Path(name), seed, calibration_seed)
        for choice in choices:
            key = str(choice.plan.to_json())
            if key not in done:
                steps = load_planner(choice.rig.name).describe_rehearsal(choice)
                calibration, calibrate_s = calibrations.make(choice.rig, steps)
                own = Path(name) / f"captured-{len(done)}"
                own.mkdir()
                (own / "calibration").symlink_to(calibration)
                found = capture_choice(choice, own, subject=subject, seed=seed)
                times = RunTimes(plan_s, found.capture_s, calibrate_s, found.reconstruct_s)
                done[key] = MeasuredCapture(found.errors, times)
            yield done[key]


@dataclass(slots=True)
class _Calibrations:
    """Calibrations of one rig as built; those of the same targets are made once."""

    folder: Path
    rig_seed: int
    """Seed of the subject, on which the dome and the sphere as built depend."""
    session_seed: int
    """Seed of the targets; others set the constants of forecasts."""
    sessions: dict[str, Path] = field(default_factory=dict)
    made: dict[str, tuple[Path, float]] = field(default_factory=dict)
    warm: set[str] = field(default_factory=set)
    """Kinds of calibration that this person has had."""

    def make(self, rig: Rig, steps: Rehearsal) -> tuple[Path, float]:
        """Return the folder of a plan's calibrations, and their processor seconds."""
        key, total_s, folder = "", 0.0, self.folder / "uncalibrated"
        for kind, used in steps.calibrations:
            key += f"{kind} {[(name, steps.targets[name]) for name in used]} "
            if key not in self.made:
                own = self.folder / f"calibration-{len(self.made)}"
                if folder.exists():  # a calibration reads those before it
                    shutil.copytree(folder, own)
                sessions = [self._simulate(rig, name, steps.targets[name]) for name in used]
                repeats = 1 if kind in self.warm else 2  # the first call imports modules
                self.warm.add(kind)
                call = partial(calibrate, kind, sessions, own)
                seconds = measure_processor_time(call, repeats)[0]
                self.made[key] = own, seconds
            folder, seconds = self.made[key]
            total_s += seconds
        return folder, total_s

    def _simulate(self, rig: Rig, target: str, options: Mapping[str, Any]) -> Path:
        """Return the session of a target."""
        key = f"{target} {options}"
        if key not in self.sessions:
            own = self.folder / f"targets-{len(self.sessions)}"
            drawn = {target: {**options, "session_seed": self.session_seed}}
            calibrate_simulated(rig.name, own, drawn, (), seed=self.rig_seed)
            self.sessions[key] = own / f"session-{target}"
        return self.sessions[key]


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
        "inside the forecast's interval": sum(one[name] for one in point.inside),
        "forecast s": float(np.mean([one["total"] for one in point.forecast_s])),
    }
    half = float(errors.std(ddof=1) / math.sqrt(len(errors))) if len(errors) > 1 else 0.0
    stage.add(
        {"rig": rig_name, "map": name, "width": width, "budget_s": budget_s},
        Timing.single(sum(mean_s.values())),
        ErrorEstimate.nonnegative(float(errors.mean()), half),
        extra,
    )
