"""How often stated intervals hold the truth, over subjects whose pixels share their errors.

Pixels of one subject err together: a subject is one draw. The coverage is the mean of the
subjects' shares, and its own interval is that of a mean of so many subjects (Student), however many
pixels each has.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skinrig.arrays import Float64Array

COVERAGE_RANGES: Final = {68: (0.60, 0.76), 95: (0.92, 0.98)}
"""Nominal coverage, %, and the range that a stage's coverage is to lie in."""

GAUSSIAN_95: Final = 1.959964
"""Half width of a 95 % interval of a Gaussian error over that of its 68.27 % interval."""


@dataclass(frozen=True, slots=True)
class IntervalTrial:
    """What one simulated subject says about the intervals of one quantity."""

    quantity: str
    subject: str
    """Preset or medium, and its seed."""
    band: str
    """Band of skin color (`skinrig.evaluating.skin_bands`); "any" where the quantity needs none."""
    deviation: Float64Array
    """|estimate - truth| over the half width of the stated 68 % interval, (n,)."""
    width: float
    """Median half width of the 68 % interval, in `unit`."""
    unit: str
    factor_95: float
    """Half width of the 95 % interval over that of the 68 % one, as users are told to form it."""

    def inside_fraction(self, level: int) -> float:
        """Return the share of truths in the intervals of a nominal level, %."""
        reach = {68: 1.0, 95: self.factor_95}[level]
        return float(np.mean(self.deviation <= reach))


@dataclass(frozen=True, slots=True)
class IntervalCoverage:
    """Coverage of the intervals of one quantity, over subjects."""

    quantity: str
    band: str
    level: int
    """Nominal, %."""
    inside_fraction: float
    """Mean of the subjects' shares."""
    interval: tuple[float, float]
    """Of the share, at the confidence that it was asked for; (0, 1) of a single subject."""
    subjects: int
    width: float
    unit: str

    @property
    def verdict(self) -> str:
        """Whether the share is in its range: "kept", "open" (its interval is) or "missed"."""
        low, high = COVERAGE_RANGES[self.level]
        if low <= self.inside_fraction <= high:
            return "kept"
        return "open" if self.interval[1] >= low and self.interval[0] <= high else "missed"


def pool_trials(
    trials: Sequence[IntervalTrial], *, level: int, confidence: float = 0.95
) -> IntervalCoverage:
    """Return the coverage of the trials of one quantity.

    Parameters
    ----------
    trials
        At least one; of one quantity, a subject each.
    level
        68 or 95, %.
    confidence
        Of the interval of the share, two-sided.

    Raises
    ------
    ValueError
        Without trials, for trials of several quantities, or a subject without truths.

    Examples
    --------
    >>> ones = [IntervalTrial("x", str(k), "any", np.array([0.5, 0.9, 2.5]), 1.0, "", 1.96)
    ...         for k in range(3)]
    >>> round(pool_trials(ones, level=68).inside_fraction, 3), pool_trials(ones, level=68).verdict
    (0.667, 'kept')
    """
    quantities = {trial.quantity for trial in trials}
    if len(quantities) != 1 or not all(trial.deviation.size for trial in trials):
        raise ValueError(
            f"trials: got {len(trials)} of {sorted(quantities)}, expected at least one, all of one "
            "quantity and each with truths"
        )
    shares = np.array([trial.inside_fraction(level) for trial in trials])
    bands = {trial.band for trial in trials}
    return IntervalCoverage(
        trials[0].quantity,
        bands.pop() if len(bands) == 1 else "all",
        level,
        float(shares.mean()),
        _interval(shares, np.array([trial.deviation.size for trial in trials]), confidence),
        len(shares),
        float(np.median([trial.width for trial in trials])),
        trials[0].unit,
    )


def _interval(
    fractions: Float64Array, truths: Float64Array, confidence: float
) -> tuple[float, float]:
    """Return the interval of the mean share, no narrower than if truths had nothing in common.

    Subjects with a truth or two each may agree by chance: their scatter alone tells nothing then.
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
    trials: Sequence[IntervalTrial], *, level: int, confidence: float
) -> list[IntervalCoverage]:
    """Return the coverage of every quantity: over all subjects, then band by band.

    Parameters
    ----------
    trials
        Of any quantities and subjects; those without truths are left out.
    level, confidence
        As of `pool_trials`.
    """
    rows: list[IntervalCoverage] = []
    counted = [trial for trial in trials if trial.deviation.size]
    for quantity in dict.fromkeys(trial.quantity for trial in counted):
        of_it = [trial for trial in counted if trial.quantity == quantity]
        bands = dict.fromkeys(trial.band for trial in of_it)
        of_bands = [[trial for trial in of_it if trial.band == band] for band in bands]
        groups = [of_it, *of_bands] if len(bands) > 1 else [of_it]
        rows += [pool_trials(group, level=level, confidence=confidence) for group in groups]
    return rows
