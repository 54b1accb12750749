"""Build the JSON document of a benchmark run: Pareto fronts, knees, melanin bands."""

import json
import math
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from skinrig.benchmarks.results import ErrorEstimate, Point, StageBenchmark
from skinrig.evaluating import skin_bands

SCHEMA: Final = "skinrig.bench/2"

MIN_BEND: Final = 1e-9
"""Log distance below the chord of a front that rounding does not cause."""


def pareto_front(points: tuple[Point, ...]) -> tuple[int, ...]:
    """Return the indices of points that no other point beats in both seconds and error.

    Points with a non-finite error are excluded.

    Examples
    --------
    >>> pareto_front(())
    ()
    """
    front = []
    best = np.inf
    finite = [i for i, point in enumerate(points) if math.isfinite(point.error)]
    for index in sorted(finite, key=lambda i: (points[i].timing.seconds, points[i].error)):
        if points[index].error < best:
            best = points[index].error
            front.append(index)
    return tuple(front)


def find_knee(points: tuple[Point, ...]) -> int | None:
    """Return the index of the knee of the Pareto front, or None below 3 points.

    The knee is the front's point farthest below the chord between its ends, on log-log axes. If
    none is below it, the knee is the quickest point with an error within the 68 % interval of the
    least, unless no point takes longer: the error may then decrease further.
    """
    front = pareto_front(points)
    if len(points) < 3 or not front:
        return None
    log_s = np.log([max(points[i].timing.seconds, 1e-9) for i in front])
    log_e = np.log([max(points[i].error, 1e-300) for i in front])
    if len(front) > 2:
        # chord: log e = log e_0 + (log s - log s_0) (log e_n - log e_0) / (log s_n - log s_0)
        line = log_e[0] + (log_s - log_s[0]) * (log_e[-1] - log_e[0]) / (log_s[-1] - log_s[0])
        below = line - log_e
        if below.max() > MIN_BEND:
            return front[int(np.argmax(below))]
    most = points[front[-1]].error_interval[1]
    quickest = next(i for i in front if points[i].error <= max(most, points[front[-1]].error))
    longest_s = max(point.timing.seconds for point in points)
    return quickest if points[quickest].timing.seconds < longest_s else None


def find_fronts(stage: StageBenchmark) -> list[dict[str, Any]]:
    """Return the Pareto front and the knee of each condition of a stage.

    Returns
    -------
    list of dict
        ``condition``: knobs whose values its points have in common; ``points``: indices of the
        points on its front, the quickest first; ``knee``: one of these indices, or None.
    """
    groups: dict[tuple[Any, ...], list[int]] = {}
    for number, point in enumerate(stage.points):
        key = tuple(point.knobs.get(name) for name in stage.condition)
        groups.setdefault(key, []).append(number)
    found = []
    for key, numbers in groups.items():
        some = tuple(stage.points[n] for n in numbers)
        bend = find_knee(some)
        found.append(
            {
                "condition": dict(zip(stage.condition, key, strict=True)),
                "points": [numbers[k] for k in pareto_front(some)],
                "knee": None if bend is None else numbers[bend],
            }
        )
    return found


def describe_machine() -> dict[str, Any]:
    """Return versions, architecture and core count, without the machine's name."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "architecture": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
    }


def to_document(stages: Iterable[StageBenchmark]) -> dict[str, Any]:
    """Return the JSON document of a run."""
    stages = list(stages)
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "machine": describe_machine(),
        "skin_bands": {name: band.to_dict() for name, band in skin_bands.MELANIN_BANDS.items()},
        "stages": {stage.name: _stage(stage) for stage in stages},
    }
    document["passed"] = all(limit.passed for stage in stages for limit in stage.limits)
    json.dumps(
        document, allow_nan=True
    )  # fail here, not in a reader, on a value without a JSON form
    return document


def _stage(stage: StageBenchmark) -> dict[str, Any]:
    found = find_fronts(stage)
    on_front = {number for front in found for number in front["points"]}
    knees = {front["knee"] for front in found}
    names = ("error_name", "seconds_name", "reference", "reference_error", "reference_error_means")
    return {
        **{name: getattr(stage, name) for name in (*names, "interval_of")},
        "points": [
            {
                **_point(point, squared=stage.squared),
                "on_front": number in on_front,
                "knee": number in knees,
            }
            for number, point in enumerate(stage.points)
        ],
        "fronts": found,
        "limits": [asdict(limit) | {"passed": limit.passed} for limit in stage.limits],
        "left_out": [list(item) for item in stage.omitted],
        "by_band": [_band(name, error) for name, error in stage.by_band.items()],
        "darkest_over_lightest": _dark_to_light_ratio(stage.by_band),
        "no_bands": stage.no_bands or None,
    }


def _point(point: Point, *, squared: bool) -> dict[str, Any]:
    efficiency = point.efficiency(squared=squared)
    memory = point.timing.peak_memory_mb
    return {
        "knobs": dict(point.knobs),
        "also": dict(point.extra_values),
        "seconds": point.timing.seconds,
        "seconds_spread": list(point.timing.range_s),
        "cold_seconds": point.timing.cold_s,
        "peak_memory_mb": memory,
        "memory_of": point.timing.memory_kind if memory is not None else None,
        "no_memory": None if memory is not None else point.timing.no_memory_reason,
        "error": point.error,
        "error_interval": list(point.error_interval),
        "cramer_rao_bound": point.cramer_rao_bound,
        "efficiency": efficiency and efficiency[0],
        "efficiency_interval": efficiency and list(efficiency[1:]),
    }


def _band(name: str, error: ErrorEstimate) -> dict[str, Any]:
    return {"band": name, **asdict(error), "error_interval": list(error.error_interval)}


def _dark_to_light_ratio(by_band: Mapping[str, ErrorEstimate]) -> dict[str, Any] | None:
    """Return the last band's error over the first's, with the range that both intervals allow."""
    skins = list(by_band.values())
    if len(skins) < 2 or not skins[0].error > 0.0:
        return None
    (light_low, light_high), (dark_low, dark_high) = (
        skins[0].error_interval,
        skins[-1].error_interval,
    )
    return {
        "ratio": skins[-1].error / skins[0].error,
        "interval": [
            max(dark_low, 0.0) / light_high,
            dark_high / light_low if light_low > 0.0 else math.inf,
        ],
    }
