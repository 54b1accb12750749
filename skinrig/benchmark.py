"""Error against run time: how a stage is measured, and the one JSON schema for all stages."""

from __future__ import annotations

import json
import math
import os
import platform
import time
import tracemalloc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np

from skinrig import resident_memory

Made = TypeVar("Made")

SCHEMA = "skinrig.bench/1"
TRACED_S = 0.1
"""Calls that are quicker are run once more for their memory, asked or not."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds and memory of one call."""

    seconds: float
    """Median of the warm calls, s."""
    spread_s: tuple[float, float]
    """Fastest and slowest warm call, s."""
    cold_s: float
    """The first call, with compilation and caches to fill, s."""
    peak_memory_mb: float
    """Most memory held during a call, MB; 0: not measured."""
    memory_of: Literal["allocated", "resident"] = "allocated"
    """Whether that is what Python and NumPy allocated, or how far the process's resident memory
    rose."""


def measure(call: Callable[[], Any], *, repeats: int = 3, memory: bool | None = True) -> Timing:
    """Time ``call``: once cold, ``repeats`` times warm, and once more for its memory.

    Parameters
    ----------
    call
        Takes no argument; its result is dropped.
    repeats
        Warm calls, at least 1.
    memory
        False spares a call that takes long the extra one in which its allocations are traced:
        then how far resident memory rose in a warm call is taken (0 MB on systems that do not
        tell). None never traces: for calls into the renderer, whose own threads free what Python
        allocated, which tracing does not survive (one process in ten or so ends).

    Returns
    -------
    Timing

    Examples
    --------
    >>> measure(lambda: sum(range(100)), repeats=3).seconds < 1.0
    True
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1")
    start = time.perf_counter()
    call()
    cold = time.perf_counter() - start
    seconds = []
    with resident_memory.watched() as rise:
        for _ in range(repeats):
            start = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - start)
    traced = memory is not None and (memory or min(seconds) < TRACED_S)
    return Timing(
        seconds=float(np.median(seconds)),
        spread_s=(min(seconds), max(seconds)),
        cold_s=cold,
        peak_memory_mb=_allocated_mb(call) if traced else rise.mb or 0.0,
        memory_of="allocated" if traced else "resident",
    )


def once(call: Callable[[], Made]) -> tuple[Timing, Made]:
    """Make something a single time, for a call too long to repeat: cold and warm are one.

    Returns
    -------
    timing : Timing
    made
        What the call returned.

    Examples
    --------
    >>> once(lambda: sum(range(100)))[1]
    4950
    """
    with resident_memory.watched() as rise:
        start = time.perf_counter()
        made = call()
        seconds = time.perf_counter() - start
    return Timing(seconds, (seconds, seconds), seconds, rise.mb or 0.0, "resident"), made


def _allocated_mb(call: Callable[[], Any]) -> float:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


@dataclass(frozen=True, slots=True)
class Point:
    """One setting of a stage's effort knobs."""

    knobs: Mapping[str, str | int | float | bool]
    """What was set; the report labels the point with it."""
    timing: Timing
    error: float
    """Error against the stage's reference, in the stage's unit."""
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Least error that any unbiased estimator could have, same unit; None: not known."""

    def efficiency(self, *, squared: bool = False) -> tuple[float, float, float] | None:
        """Return variance over the least variance, with its 68 % interval; None without a bound.

        1 is perfect. Where the error is a median or a mean the bound is that of a normal error,
        so that the ratio of squares holds too.

        Parameters
        ----------
        squared
            Whether error and bound are squares already.
        """
        if self.cramer_rao_bound is None or not self.cramer_rao_bound > 0.0:
            return None
        low, high = self.error_interval
        value, low, high = (
            (error / self.cramer_rao_bound) ** (1 if squared else 2)
            for error in (self.error, max(low, 0.0), high)
        )
        return value, low, high


@dataclass(frozen=True, slots=True)
class Limit:
    """A promise about a stage that this run checked."""

    name: str
    got: float
    bound: float
    sense: Literal["<=", ">="]
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether ``got`` keeps to ``bound``; NaN does not."""
        return self.got <= self.bound if self.sense == "<=" else self.got >= self.bound


@dataclass(frozen=True, slots=True)
class StageBenchmark:
    """All points of one stage."""

    name: str
    error_name: str
    """What the error is, with its unit, for the axis of the plot."""
    reference: str
    """What the error is taken against."""
    reference_error: float
    """How far the reference itself may be off, in the error's unit."""
    points: tuple[Point, ...]
    limits: tuple[Limit, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    """What this run did not measure, and why."""
    by_band: Mapping[str, float] = field(default_factory=dict)
    """Error by melanin band, same unit."""
    squared: bool = False
    """Whether errors and bounds are squares (variances), not sizes."""

    @property
    def reference_error_means(self) -> str:
        """What `reference_error` says."""
        if self.reference_error == 0.0:
            return "exact: the truth that the data were made of, or errors are defined by it"
        return "how far the reference itself may be off, in the error's unit"


def pareto_front(points: tuple[Point, ...]) -> tuple[int, ...]:
    """Return the indices of points that no other beats in both seconds and error.

    A point whose error is not finite is on no front.

    Examples
    --------
    >>> pareto_front(())
    ()
    """
    front = []
    best = np.inf
    told = [i for i, point in enumerate(points) if math.isfinite(point.error)]
    for index in sorted(told, key=lambda i: (points[i].timing.seconds, points[i].error)):
        if points[index].error < best:
            best = points[index].error
            front.append(index)
    return tuple(front)


def knee(points: tuple[Point, ...]) -> int | None:
    """Return the front point after which more seconds buy least, or None below 3 points.

    The point of the front that lies farthest below the straight line between its ends, on
    log-log axes.
    """
    front = pareto_front(points)
    if len(front) < 3:
        return None
    log_s = np.log([max(points[i].timing.seconds, 1e-9) for i in front])
    log_e = np.log([max(points[i].error, 1e-300) for i in front])
    line = log_e[0] + (log_s - log_s[0]) * (log_e[-1] - log_e[0]) / (log_s[-1] - log_s[0])
    return front[int(np.argmax(line - log_e))]


def machine() -> dict[str, Any]:
    """Say what ran the benchmark, without naming the machine."""
    return {
        "python": platform.python_version(),
        "numpy": np.__version__,
        "architecture": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
    }


def to_document(stages: list[StageBenchmark]) -> dict[str, Any]:
    """Return the JSON document of a run."""
    document: dict[str, Any] = {"schema": SCHEMA, "machine": machine(), "stages": {}}
    for stage in stages:
        front = pareto_front(stage.points)
        bend = knee(stage.points)
        efficiency: list[Any] = [p.efficiency(squared=stage.squared) for p in stage.points]
        document["stages"][stage.name] = {
            "error_name": stage.error_name,
            "reference": stage.reference,
            "reference_error": stage.reference_error,
            "reference_error_means": stage.reference_error_means,
            "points": [
                {
                    "knobs": dict(point.knobs),
                    "seconds": point.timing.seconds,
                    "seconds_spread": list(point.timing.spread_s),
                    "cold_seconds": point.timing.cold_s,
                    "peak_memory_mb": point.timing.peak_memory_mb or None,
                    "memory_of": point.timing.memory_of,
                    "error": point.error,
                    "error_interval": list(point.error_interval),
                    "cramer_rao_bound": point.cramer_rao_bound,
                    "efficiency": efficiency[index] and efficiency[index][0],
                    "efficiency_interval": efficiency[index] and list(efficiency[index][1:]),
                    "on_front": index in front,
                    "knee": index == bend,
                }
                for index, point in enumerate(stage.points)
            ],
            "knee": bend,
            "limits": [
                {
                    "name": limit.name,
                    "got": limit.got,
                    "bound": limit.bound,
                    "sense": limit.sense,
                    "unit": limit.unit,
                    "passed": limit.passed,
                }
                for limit in stage.limits
            ],
            "left_out": [list(item) for item in stage.left_out],
            "by_band": dict(stage.by_band),
        }
    document["passed"] = all(limit.passed for stage in stages for limit in stage.limits)
    json.dumps(document, allow_nan=True)  # a value that is no JSON fails here, not at a reader
    return document
