"""Coverage of stated intervals over subjects whose pixels have correlated errors.

Errors of one subject's pixels are correlated, so that a subject is one draw. The coverage is the
mean of the subjects' fractions of ground truths inside. Its own interval is Student's for a mean of
that many subjects, however many pixels each has.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from skinrig.arrays import Float64Array

COVERAGE_RANGES: Final = {68: (0.60, 0.76), 95: (0.92, 0.98)}
"""Nominal coverage, %, and the accepted range of the measured coverage."""

FALSE_ALARM_RATE: Final = 0.05
"""Largest probability that a run with correct intervals misses a limit."""

GAUSSIAN_95: Final = 1.959964
"""Half width of a 95 % interval of a Gaussian error over that of its 68.27 % interval."""


@dataclass(frozen=True, slots=True)
class IntervalTrial:
    """Errors of one simulated subject in half widths of its stated intervals, for one quantity."""

    quantity: str
    subject: str
    """Preset or medium, and seed."""
    band: str
    """Band of skin color (`skinrig.evaluating.skin_bands`); "any" for quantities without one."""
    deviation: Float64Array
    """|estimate - truth| over the half width of the stated 68 % interval, (n,)."""
    width: float
    """Median half width of the 68 % interval, in `unit`."""
    unit: str
    factor_95: float
    """Half width of the 95 % interval over that of the 68 % one, as the manual defines it."""
    error: float = float("nan")
    """Median |estimate - truth|, in `unit`; NaN where it is not defined."""

    @property
    def truths(self) -> int:
        """Number of ground truths."""
        return int(self.deviation.size)

    def inside_fraction(self, level: int) -> float:
        """Return the fraction of ground truths inside the intervals of a nominal level, %."""
        reach = {68: 1.0, 95: self.factor_95}[level]
        return float(np.mean(self.deviation <= reach))


class JudgedSubject(Protocol):
    """One subject's errors in one quantity: an `IntervalTrial`, or the record of one."""

    @property
    def quantity(self) -> str:
        """Name of the quantity."""

    @property
    def band(self) -> str:
        """Band of skin color."""

    @property
    def width(self) -> float:
        """Median half width of the 68 % interval, in `unit`."""

    @property
    def unit(self) -> str:
        """Unit of the width."""

    @property
    def truths(self) -> int:
        """Number of ground truths."""

    def inside_fraction(self, level: int) -> float:
        """Return the fraction of ground truths inside the intervals of a nominal level, %."""


@dataclass(frozen=True, slots=True)
class IntervalCoverage:
    """Coverage of the intervals of one quantity, over subjects."""

    quantity: str
    band: str
    level: int
    """Nominal, %."""
    inside_fraction: float
    """Mean of the subjects' fractions inside, i.e. the coverage."""
    interval: tuple[float, float]
    """Confidence interval of the coverage at the requested confidence; (0, 1) for one subject."""
    subjects: int
    width: float
    unit: str

    @property
    def verdict(self) -> str:
        """Verdict: "kept" (coverage in range), "open" (only its interval is) or "missed".

        One subject leaves the coverage open.
        """
        low, high = COVERAGE_RANGES[self.level]
        if self.subjects > 1 and low <= self.inside_fraction <= high:
            return "kept"
        return "open" if self.interval[1] >= low and self.interval[0] <= high else "missed"


def pool_trials(
    trials: Sequence[JudgedSubject], *, level: int, confidence: float = 0.95
) -> IntervalCoverage:
    """Return the coverage of the trials of one quantity.

    Parameters
    ----------
    trials
        At least one trial; all of one quantity, one per subject.
    level
        68 or 95, %.
    confidence
        Two-sided confidence of the coverage's interval.

    Raises
    ------
    ValueError
        Without trials, for trials of several quantities, or a subject without ground truths.

    Examples
    --------
    >>> ones = [IntervalTrial("x", str(k), "any", np.array([0.5, 0.9, 2.5]), 1.0, "", 1.96)
    ...         for k in range(3)]
    >>> round(pool_trials(ones, level=68).inside_fraction, 3), pool_trials(ones, level=68).verdict
    (0.667, 'kept')
    """
    quantities = {trial.quantity for trial in trials}
    if len(quantities) != 1 or not all(trial.truths for trial in trials):
        raise ValueError(
            f"trials: got {len(trials)} of {sorted(quantities)}, expected at least one, all of one "
            "quantity and each with ground truths; omit trials without any"
        )
    fractions = np.array([trial.inside_fraction(level) for trial in trials])
    bands = {trial.band for trial in trials}
    return IntervalCoverage(
        trials[0].quantity,
        bands.pop() if len(bands) == 1 else "all",
        level,
        float(fractions.mean()),
        _interval(fractions, np.array([trial.truths for trial in trials]), confidence),
        len(fractions),
        float(np.median([trial.width for trial in trials])),
        trials[0].unit,
    )


def _interval(
    fractions: Float64Array, truths: Float64Array, confidence: float
) -> tuple[float, float]:
    """Return the interval of the mean fraction, no narrower than that of independent truths.

    Subjects with one or two truths each may agree by chance, and their standard deviation is then
    too small. The binomial interval of all truths is the lower limit of the width.
    """
    from scipy.stats import beta, t

    if fractions.size < 2:
        return 0.0, 1.0
    middle = float(fractions.mean())
    reach = t.ppf(0.5 + confidence / 2.0, fractions.size - 1)
    error = float(reach * fractions.std(ddof=1) / math.sqrt(fractions.size))
    count, held = float(truths.sum()), float((fractions * truths).sum())
    tail = (1.0 - confidence) / 2.0  # Clopper and Pearson 1934, doi:10.1093/biomet/26.4.404
    low = beta.ppf(tail, held, count - held + 1.0) if held > 0.5 else 0.0
    high = beta.ppf(1.0 - tail, held + 1.0, count - held) if held < count - 0.5 else 1.0
    return max(min(middle - error, float(low)), 0.0), min(max(middle + error, float(high)), 1.0)


def group_by_band(
    trials: Sequence[JudgedSubject], *, level: int, confidence: float
) -> list[IntervalCoverage]:
    """Return the coverage of every quantity: over all subjects, then band by band.

    Parameters
    ----------
    trials
        Of any quantities and subjects; those without ground truths are omitted.
    level, confidence
        As in `pool_trials`.
    """
    rows: list[IntervalCoverage] = []
    counted = [trial for trial in trials if trial.truths]
    for quantity in dict.fromkeys(trial.quantity for trial in counted):
        of_it = [trial for trial in counted if trial.quantity == quantity]
        bands = dict.fromkeys(trial.band for trial in of_it)
        of_bands = [[trial for trial in of_it if trial.band == band] for band in bands]
        groups = [of_it, *of_bands] if len(bands) > 1 else [of_it]
        rows += [pool_trials(group, level=level, confidence=confidence) for group in groups]
    return rows


def corrected_confidence(trials: Sequence[JudgedSubject]) -> float:
    """Return the confidence of each coverage at which all share one `FALSE_ALARM_RATE`.

    Parameters
    ----------
    trials
        As in `group_by_band`.

    Notes
    -----
    See `share_confidence`.
    """
    return share_confidence(len(group_by_band(trials, level=68, confidence=0.95)))


def share_confidence(count: int) -> float:
    """Return the confidence of each of `count` coverages that share one `FALSE_ALARM_RATE`.

    Notes
    -----
    Bonferroni: each coverage is judged at two levels, each with two one-sided limits.

    Examples
    --------
    >>> round(share_confidence(1), 6), round(share_confidence(10), 6)
    (0.975, 0.9975)
    """
    return 1.0 - 2.0 * FALSE_ALARM_RATE / (4 * max(count, 1))
