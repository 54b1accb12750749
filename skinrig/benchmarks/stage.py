"""Combine the description of a stage in `data/benchmarks.toml` with the results of a run."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any

from skinrig.benchmarks.measurement import Made, measure_and_keep, measure_once
from skinrig.benchmarks.results import (
    SECONDS_NAME,
    ErrorEstimate,
    Knob,
    Limit,
    Point,
    StageBenchmark,
    Timing,
)
from skinrig.evaluating.skin_bands import MELANIN_BANDS, MelaninBand

STAGES_TABLE = resources.files("skinrig").joinpath("data/benchmarks.toml")

LimitValues = dict[str | tuple[Any, ...], float | tuple[float, float]]
"""Measured values of limits by their keys in the table. Further parts of a key fill the numbered
braces of the limit's name. A pair is the value and its bound, for bounds that the run sets."""


@cache
def read_descriptions() -> dict[str, dict[str, Any]]:
    """Read the description of every stage, by name, in the order of the table."""
    return tomllib.loads(STAGES_TABLE.read_text(encoding="utf-8"))


@dataclass(slots=True)
class BenchmarkStage:
    """Results of a stage at one size, which its function fills."""

    name: str
    toy: bool = False
    """Whether sizes are small; limits are then not evaluated and may be missing."""
    smoke: bool = False
    """Whether to call each function once only, as a check that it runs."""
    selection: str = ""
    """Rig to measure, for the stage of whole captures; empty: all rigs."""
    points: list[Point] = field(default_factory=list)
    """Measured settings, in the order of the report."""
    limits: LimitValues = field(default_factory=dict)
    """Measured values; a limit without one is not evaluated."""
    by_band: dict[str, ErrorEstimate] = field(default_factory=dict)
    """Error at the default setting by melanin band."""
    omitted: list[tuple[str, str]] = field(default_factory=list)
    """Settings that this run did not measure, with reasons; the table lists those of every run."""
    reference_error: float | None = None
    """Error of the reference, in the stage's unit; None takes the table's, or 0."""
    description_values: dict[str, object] = field(default_factory=dict)
    """Values for the named braces of the description."""

    def time(
        self, call: Callable[[], Made], *, repeats: int | None = None, memory: bool | None = True
    ) -> tuple[Timing, Made]:
        """Time a call with `measure_and_keep`, and return timing and result.

        Parameters
        ----------
        call
            Takes no argument.
        repeats
            Warm calls; None: three, at small size one. A smoke run has a single call instead.
        memory
            As in `skinrig.benchmarks.measurement.measure`.
        """
        if self.smoke:
            return measure_once(call)
        warm = (1 if self.toy else 3) if repeats is None else repeats
        return measure_and_keep(call, repeats=warm, memory=memory)

    def add(
        self,
        knobs: Mapping[str, Knob],
        timing: Timing,
        outcome: ErrorEstimate,
        extra_values: Mapping[str, Knob] | None = None,
    ) -> ErrorEstimate:
        """Add a point with its additional measured values, and return its error."""
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
        """Time a call, evaluate its result and add the point; return the error.

        Parameters
        ----------
        knobs
            Settings of the point.
        call
            Function to time, without arguments.
        error
            Function of the call's result.
        extra_values
            Further values to report.
        repeats, memory
            As in `time`.

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
        """Return the first point whose knobs have these values."""
        return next(point for point in self.points if knobs.items() <= point.knobs.items())

    def measure_bands(self, error: Callable[[MelaninBand], ErrorEstimate]) -> None:
        """Evaluate the error on skin of each melanin band."""
        self.by_band |= {name: error(band) for name, band in MELANIN_BANDS.items()}

    def to_benchmark(self) -> StageBenchmark:
        """Return the results so far together with the stage's description."""
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
            entry.get("seconds_name", SECONDS_NAME),
        )

    def _limit(self, table: Mapping[str, Mapping[str, Any]], key: str | tuple[Any, ...]) -> Limit:
        first, *parts = (key,) if isinstance(key, str) else key
        entry, found = table[first], self.limits[key]
        name, unit = entry["name"].format(*parts, **self.description_values), entry.get("unit", "")
        got, bound = found if isinstance(found, tuple) else (found, None)
        if "at_most" in entry:
            return Limit(name, got, entry["at_most"] if bound is None else bound, "<=", unit)
        return Limit(name, got, entry["at_least"] if bound is None else bound, ">=", unit)
