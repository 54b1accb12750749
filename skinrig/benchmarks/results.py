"""What a benchmark keeps of a stage: points with errors and times, limits, errors by skin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Knob = str | int | float | bool
Knobs = dict[str, Knob]


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds and memory of one call."""

    seconds: float
    """Median of the warm calls, s."""
    range_s: tuple[float, float]
    """Fastest and slowest warm call, s."""
    cold_s: float
    """The first call, with compilation and caches to fill, s."""
    peak_memory_mb: float | None
    """Most memory held during a call, MB; None: not measured."""
    memory_kind: Literal["allocated", "resident"] = "allocated"
    """Whether that is what Python and NumPy allocated, or how far the process's resident memory
    rose."""
    no_memory_reason: str = "this system does not tell"
    """Why it was not measured, where it was not."""

    @classmethod
    def single(cls, seconds: float, peak_memory_mb: float | None = None, **memory: Any) -> Timing:
        """Return the timing of a call made a single time: cold and warm are one."""
        return cls(seconds, (seconds, seconds), seconds, peak_memory_mb, **memory)


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
    extra_values: Mapping[str, Knob] = field(default_factory=dict)
    """What else was measured at this setting; no knob."""

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
class ErrorEstimate:
    """Error in one band of skin, with the setting that is usual."""

    error: float
    error_interval: tuple[float, float]
    """68 % interval of ``error``."""
    cramer_rao_bound: float | None = None
    """Least error that any unbiased estimator could have there; None: not known."""

    @classmethod
    def symmetric(cls, error: float, half: float, bound: float | None = None) -> ErrorEstimate:
        """Return an error whose interval reaches as far to both sides.

        Examples
        --------
        >>> ErrorEstimate.symmetric(2.0, 0.5).error_interval
        (1.5, 2.5)
        """
        return cls(error, (error - half, error + half), bound)

    @classmethod
    def nonnegative(cls, size: float, half: float) -> ErrorEstimate:
        """Return the same of a size, which is never below 0.

        Examples
        --------
        >>> ErrorEstimate.nonnegative(2.0, 2.5).error_interval
        (0.0, 4.5)
        """
        return cls(size, (max(size - half, 0.0), size + half))


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
    omitted: tuple[tuple[str, str], ...] = ()
    """What this run did not measure, and why."""
    by_band: Mapping[str, ErrorEstimate] = field(default_factory=dict)
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
