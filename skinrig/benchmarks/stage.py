"""What stages measure and promise, as `data/benchmarks.toml` has it, with what a run finds."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

from skinrig.benchmarks.measurement import Made, measure_and_keep
from skinrig.benchmarks.results import ErrorEstimate, Knob, Limit, Point, StageBenchmark, Timing
from skinrig.evaluating.skin_bands import MELANIN_BANDS, MelaninBand

STAGES_TABLE = resources.files("skinrig").joinpath("data/benchmarks.toml")

LimitValues = dict[str | tuple[Any, ...], float | tuple[float, float]]
"""What was found of limits, by their keys in the table. What follows a key's first part fills the
numbered braces of the limit's name; beside a value may stand its bound, where the run sets it."""


@cache
def read_descriptions() -> dict[str, dict[str, Any]]:
    """Return the description of every stage by its name, in the order of the table."""
    return tomllib.loads(STAGES_TABLE.read_text(encoding="utf-8"))


@dataclass(slots=True)
class BenchmarkStage:
    """A stage at one size, to which its function adds what it measures."""

    name: str
    toy: bool = False
    """Whether sizes are small: limits are then judged by nobody, and need not be found."""
    points: list[Point] = field(default_factory=list)
    """In the order in which they are shown."""
    limits: LimitValues = field(default_factory=dict)
    """Those without a finding are not judged."""
    by_band: dict[str, ErrorEstimate] = field(default_factory=dict)
    """Errors by melanin band."""
    omitted: list[tuple[str, str]] = field(default_factory=list)
    """What this run did not measure, and why, beside what no run does."""
    reference_error: float | None = None
    """How far the reference may be off; None: as described, or not at all."""
    description_values: dict[str, object] = field(default_factory=dict)
    """Fill the braces of the description."""

    def time(
        self, call: Callable[[], Made], *, repeats: int | None = None, memory: bool | None = True
    ) -> tuple[Timing, Made]:
        """Time a call as `measure_and_keep` does, and return what it made as well.

        Parameters
        ----------
        call
            Takes no argument.
        repeats
            Warm calls; None: three, of small sizes one.
        memory
            As of `measure`.
        """
        warm = (1 if self.toy else 3) if repeats is None else repeats
        return measure_and_keep(call, repeats=warm, memory=memory)

    def add(
        self,
        knobs: Mapping[str, Knob],
        timing: Timing,
        outcome: ErrorEstimate,
        extra_values: Mapping[str, Knob] | None = None,
    ) -> ErrorEstimate:
        """Add a point, with what else was measured at its setting, and return its error."""
        low_to_high, bound = outcome.error_interval, outcome.cramer_rao_bound
        self.points.append(
            Point(knobs, timing, outcome.error, low_to_high, bound, extra_values or {})
        )
        return outcome

    def measure(
        self,
        knobs: Mapping[str, Knob],
        call: Callable[[], Made],
        error: Callable[[Made], ErrorEstimate],
        *,
        extra_values: Mapping[str, Knob] | None = None,
        repeats: int | None = None,
        memory: bool | None = True,
    ) -> ErrorEstimate:
        """Time a call, take its error and add the point; return the error.

        Parameters
        ----------
        knobs
            What is set.
        call
            What is timed.
        error
            Takes what the call made.
        also
            What else is reported.
        repeats, memory
            As of `time`.

        Examples
        --------
        >>> stage = BenchmarkStage("hdr", toy=True)
        >>> stage.measure({"n": 9}, lambda: sum(range(9)),
        ...     lambda s: ErrorEstimate.symmetric(s - 30.0, 1))
        ErrorEstimate(error=6.0, error_interval=(5.0, 7.0), cramer_rao_bound=None)
        """
        timing, made = self.time(call, repeats=repeats, memory=memory)
        return self.add(knobs, timing, error(made), extra_values)

    def find_point(self, **knobs: Knob) -> Point:
        """Return the first point whose knobs are set to these."""
        return next(point for point in self.points if knobs.items() <= point.knobs.items())

    def measure_bands(self, error: Callable[[MelaninBand], ErrorEstimate]) -> None:
        """Take the error on skin of each melanin band."""
        self.by_band |= {name: error(band) for name, band in MELANIN_BANDS.items()}

    def to_benchmark(self) -> StageBenchmark:
        """Return what was found so far with the stage's description."""
        entry, error = read_descriptions()[self.name], self.reference_error
        return StageBenchmark(
            self.name,
            entry["error_name"],
            entry["reference"].format(**self.description_values),
            entry.get("reference_error", 0.0) if error is None else error,
            tuple(self.points),
            tuple(self._limit(entry["limits"], key) for key in self.limits),
            (*((what, why) for what, why in entry.get("left_out", ())), *self.omitted),
            dict(self.by_band),
            entry.get("no_bands", ""),
            tuple(entry.get("condition", ())),
            entry["interval_of"],
            entry.get("squared", False),
        )

    def _limit(self, table: Mapping[str, Mapping[str, Any]], key: str | tuple[Any, ...]) -> Limit:
        first, *parts = (key,) if isinstance(key, str) else key
        entry, found = table[first], self.limits[key]
        name, unit = entry["name"].format(*parts, **self.description_values), entry.get("unit", "")
        got, bound = found if isinstance(found, tuple) else (found, None)
        if "at_most" in entry:
            return Limit(name, got, entry["at_most"] if bound is None else bound, "<=", unit)
        return Limit(name, got, entry["at_least"] if bound is None else bound, ">=", unit)
