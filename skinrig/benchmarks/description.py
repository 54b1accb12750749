"""What stages measure and promise, as `data/benchmarks.toml` has it, with what a run found."""

import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import resources
from typing import Any

from skinrig.benchmarks.results import BandError, Limit, Point, StageBenchmark

STAGES_TABLE = resources.files("skinrig").joinpath("data/benchmarks.toml")

Findings = dict[str | tuple[Any, ...], float | tuple[float, float]]
"""What was found of limits, by their keys in the table. What follows a key's first part fills the
numbered braces of the limit's name; beside a value may stand its bound, where the run sets it."""


@cache
def descriptions() -> dict[str, dict[str, Any]]:
    """Return the description of every stage by its name, in the order of the table."""
    return tomllib.loads(STAGES_TABLE.read_text(encoding="utf-8"))


def described(
    name: str,
    points: Iterable[Point],
    limits: Mapping[Any, float | tuple[float, float]] | None = None,
    *,
    by_band: Mapping[str, BandError] | None = None,
    reference_error: float | None = None,
    left_out: Iterable[tuple[str, str]] = (),
    **words: object,
) -> StageBenchmark:
    """Return what a run found of a stage with the stage's description.

    Parameters
    ----------
    name
        Of the stage.
    points
        In the order in which they are shown.
    limits
        What was found of its limits; those without are not judged.
    by_band
        Errors by melanin band.
    reference_error
        How far the reference may be off; None: as described, or not at all.
    left_out
        What this run did not measure, and why, beside what no run does.
    words
        Fill the braces of the description.
    """
    entry = descriptions()[name]
    return StageBenchmark(
        name,
        entry["error_name"],
        entry["reference"].format(**words),
        entry.get("reference_error", 0.0) if reference_error is None else reference_error,
        tuple(points),
        tuple(_limit(entry["limits"], key, found, words) for key, found in (limits or {}).items()),
        (*((what, why) for what, why in entry.get("left_out", ())), *left_out),
        by_band or {},
        entry.get("no_bands", ""),
        tuple(entry.get("condition", ())),
        entry["interval_of"],
        entry.get("squared", False),
    )


def _limit(
    table: Mapping[str, Mapping[str, Any]],
    key: str | tuple[Any, ...],
    found: float | tuple[float, float],
    words: Mapping[str, object],
) -> Limit:
    first, *parts = (key,) if isinstance(key, str) else key
    entry = table[first]
    name, unit = entry["name"].format(*parts, **words), entry.get("unit", "")
    got, bound = found if isinstance(found, tuple) else (found, None)
    if "at_most" in entry:
        return Limit(name, got, entry["at_most"] if bound is None else bound, "<=", unit)
    return Limit(name, got, entry["at_least"] if bound is None else bound, ">=", unit)
