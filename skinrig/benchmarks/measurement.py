"""Error against run time: how a stage is measured, and what is kept of it."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np

from skinrig.benchmarks import resident_memory

Made = TypeVar("Made")
Knob = str | int | float | bool
Knobs = dict[str, Knob]

LIMIT_CORES = 2
"""Cores of limits in seconds; processor time does not count other programs on them."""

MAX_TRACED_CALL_S = 0.1
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
    peak_memory_mb: float | None
    """Most memory held during a call, MB; None: not measured."""
    memory_of: Literal["allocated", "resident"] = "allocated"
    """Whether that is what Python and NumPy allocated, or how far the process's resident memory
    rose."""
    no_memory: str = "this system does not tell"
    """Why it was not measured, where it was not."""

    @classmethod
    def single(cls, seconds: float, peak_memory_mb: float | None = None, **memory: Any) -> Timing:
        """Return the timing of a call made a single time: cold and warm are one."""
        return cls(seconds, (seconds, seconds), seconds, peak_memory_mb, **memory)


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
        then how far resident memory rose in a warm call is taken (None on systems that do not
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
    return measure_and_keep(call, repeats=repeats, memory=memory)[0]


def measure_and_keep(
    call: Callable[[], Made], *, repeats: int = 3, memory: bool | None = True
) -> tuple[Timing, Made]:
    """Time a call as `measure` does, and return what its last warm call made as well.

    Examples
    --------
    >>> measure_and_keep(lambda: sum(range(100)))[1]
    4950
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1")
    start = time.perf_counter()
    call()
    cold = time.perf_counter() - start
    seconds: list[float] = []
    made: list[Made] = []
    with resident_memory.watched() as rise:
        for _ in range(repeats):
            made.clear()
            start = time.perf_counter()
            made.append(call())
            seconds.append(time.perf_counter() - start)
    traced = memory is not None and (memory or min(seconds) < MAX_TRACED_CALL_S)
    timing = Timing(
        seconds=float(np.median(seconds)),
        spread_s=(min(seconds), max(seconds)),
        cold_s=cold,
        peak_memory_mb=_allocated_mb(call) if traced else rise.mb,
        memory_of="allocated" if traced else "resident",
    )
    return timing, made[0]


def processor_seconds(call: Callable[[], object], repeats: int = 1) -> float:
    """Return the least processor time of some calls, s.

    Examples
    --------
    >>> 0.0 <= processor_seconds(lambda: sum(range(100)), 2) < 1.0
    True
    """
    seconds = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        seconds.append(time.process_time() - begin)
    return min(seconds)


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
    return Timing.single(seconds, rise.mb, memory_of="resident"), made


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

    knobs: Mapping[str, Knob]
    """What was set; the report labels the point with it."""
    timing: Timing
    error: float
    """Error against the stage's reference, in the stage's unit."""
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Least error that any unbiased estimator could have, same unit; None: not known."""
    also: Mapping[str, Knob] = field(default_factory=dict)
    """What else was measured at this setting; no knob."""

    @classmethod
    def of(
        cls,
        knobs: Mapping[str, Knob],
        timing: Timing,
        told: BandError,
        also: Mapping[str, Knob] | None = None,
    ) -> Point:
        """Return the point of an error with interval and bound."""
        return cls(
            knobs, timing, told.error, told.error_interval, told.cramer_rao_bound, also or {}
        )

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
class BandError:
    """Error in one band of skin, with the setting that is usual."""

    error: float
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Least error that any unbiased estimator could have there; None: not known."""

    @classmethod
    def around(cls, error: float, half: float, bound: float | None = None) -> BandError:
        """Return an error whose interval reaches as far to both sides.

        Examples
        --------
        >>> BandError.around(2.0, 0.5).error_interval
        (1.5, 2.5)
        """
        return cls(error, (error - half, error + half), bound)


@dataclass(frozen=True, slots=True)
class StageBenchmark:
    """All points of one stage."""

    name: str
    error_name: str
    """What the error is, with its unit, for the axis of the plot."""
    reference: str
    """What the error is taken against."""
    reference_error: float = 0.0
    """How far the reference itself may be off, in the error's unit."""
    points: tuple[Point, ...] = ()
    limits: tuple[Limit, ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()
    """What this run did not measure, and why."""
    by_band: Mapping[str, BandError | float] = field(default_factory=dict)
    """Error by melanin band, from light to dark, same unit; see `skinrig.evaluating.skin_bands`."""
    no_bands: str = ""
    """Why errors do not depend on how dark skin is, where there are no bands."""
    condition: tuple[str, ...] = ()
    """Knobs that say what is measured (noise, subject), not with how much effort: each set of their
    values has a front of its own. A point that lacks such a knob is of the condition ``None``."""
    interval_of: str = ""
    """What errors scatter over within their intervals."""
    squared: bool = False
    """Whether errors and bounds are squares (variances), not sizes."""

    @property
    def reference_error_means(self) -> str:
        """What `reference_error` says."""
        if self.reference_error == 0.0:
            return "exact: the truth that the data were made of, or errors are defined by it"
        return "how far the reference itself may be off, in the error's unit"


def measured(
    knobs: Mapping[str, Knob],
    call: Callable[[], Made],
    error: Callable[[Made], BandError],
    *,
    also: Callable[[Made], Mapping[str, Knob]] | None = None,
    repeats: int = 3,
    memory: bool | None = True,
) -> Point:
    """Measure one setting of a stage.

    Parameters
    ----------
    knobs
        What is set.
    call
        What is timed.
    error
        Takes what the call made; returns its error with interval and bound.
    also
        Takes the same; returns what else is reported.
    repeats, memory
        As of :func:`measure`.

    Examples
    --------
    >>> measured({"n": 9}, lambda: sum(range(9)), lambda s: BandError(s - 30.0, (5.0, 7.0))).error
    6.0
    """
    timing, made = measure_and_keep(call, repeats=repeats, memory=memory)
    return Point.of(knobs, timing, error(made), also(made) if also else None)
