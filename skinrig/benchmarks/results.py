"""Results of a benchmark stage: points with errors and times, limits, errors by melanin band."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

Knob = str | int | float | bool
Knobs = dict[str, Knob]

SECONDS_NAME: Final = "median seconds per warm call"
"""Meaning of the seconds of most stages."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds and memory of one call."""

    seconds: float
    """Median of the warm calls, s."""
    range_s: tuple[float, float]
    """Shortest and longest warm call, s."""
    cold_s: float
    """First call, which compiles kernels and fills caches, s."""
    peak_memory_mb: float | None
    """Peak memory of a call, MB; None: not measured."""
    memory_kind: Literal["allocated", "resident"] = "allocated"
    """Kind of the peak: allocations of Python and NumPy, or growth of the process's resident
    memory."""
    no_memory_reason: str = "this system does not report it"
    """Reason, where memory was not measured."""

    @classmethod
    def single(cls, seconds: float, peak_memory_mb: float | None = None, **memory: Any) -> Timing:
        """Return the timing of a single call, which counts as cold and as warm."""
        return cls(seconds, (seconds, seconds), seconds, peak_memory_mb, **memory)


@dataclass(frozen=True, slots=True)
class Point:
    """One setting of a stage's effort knobs."""

    knobs: Mapping[str, Knob]
    """Settings; they label the point in the report."""
    timing: Timing
    error: float
    """Error against the stage's reference, in the stage's unit."""
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Cramér-Rao bound: least error of an unbiased estimator, same unit; None: unknown."""
    extra_values: Mapping[str, Knob] = field(default_factory=dict)
    """Further values measured at this setting, which are not knobs."""

    def efficiency(self, *, squared: bool = False) -> tuple[float, float, float] | None:
        """Return variance over the Cramér-Rao bound with its 68 % interval; None without a bound.

        1 is optimal. For a median or a mean of errors the bound is that of a normal error, so that
        the ratio of squares applies as well.

        Parameters
        ----------
        squared
            Whether error and bound are squares (variances) already.
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
    """Limit of a stage that a run evaluated."""

    name: str
    got: float
    bound: float
    sense: Literal["<=", ">="]
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether ``got`` satisfies ``bound``; NaN does not."""
        return self.got <= self.bound if self.sense == "<=" else self.got >= self.bound


@dataclass(frozen=True, slots=True)
class ErrorEstimate:
    """Error with its 68 % interval and its Cramér-Rao bound."""

    error: float
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Least error of an unbiased estimator, same unit; None: unknown."""

    @classmethod
    def symmetric(cls, error: float, half: float, bound: float | None = None) -> ErrorEstimate:
        """Return an error whose interval is symmetric, of half width ``half``.

        Examples
        --------
        >>> ErrorEstimate.symmetric(2.0, 0.5).error_interval
        (1.5, 2.5)
        """
        return cls(error, (error - half, error + half), bound)

    @classmethod
    def nonnegative(cls, size: float, half: float) -> ErrorEstimate:
        """Return an error with a symmetric interval that is clipped at 0.

        Examples
        --------
        >>> ErrorEstimate.nonnegative(2.0, 2.5).error_interval
        (0.0, 4.5)
        """
        return cls(size, (max(size - half, 0.0), size + half))


@dataclass(frozen=True, slots=True)
class StageBenchmark:
    """Description and results of one stage."""

    name: str
    error_name: str
    """Quantity and unit of the error, for the axis of the plot."""
    reference: str
    """Reference of the error."""
    reference_error: float = 0.0
    """Error of the reference itself, in the error's unit."""
    points: tuple[Point, ...] = ()
    limits: tuple[Limit, ...] = ()
    omitted: tuple[tuple[str, str], ...] = ()
    """Settings that were not measured, with reasons."""
    by_band: Mapping[str, ErrorEstimate] = field(default_factory=dict)
    """Error by melanin band, from light to dark, same unit (`skinrig.evaluating.skin_bands`)."""
    no_bands: str = ""
    """Reason why errors do not depend on melanin, for stages without bands."""
    condition: tuple[str, ...] = ()
    """Knobs of the measured case (noise, subject) as opposed to its effort. Each set of their
    values has its own front; a point without such a knob has the condition ``None``."""
    interval_of: str = ""
    """Population over which errors vary within their intervals."""
    squared: bool = False
    """Whether errors and bounds are squares (variances), not sizes."""
    seconds_name: str = SECONDS_NAME
    """Meaning of the seconds, for the axis of the plot."""

    @property
    def reference_error_means(self) -> str:
        """Meaning of `reference_error`, for the report."""
        if self.reference_error == 0.0:
            return "exact: the ground truth of the data, or the errors are defined by it"
        return "error of the reference itself, in the error's unit"
