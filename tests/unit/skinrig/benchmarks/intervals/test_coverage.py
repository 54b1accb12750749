"""Coverage over subjects whose pixels have correlated errors."""

import numpy as np
import pytest

from skinrig.benchmarks.intervals.coverage import (
    COVERAGE_RANGES,
    GAUSSIAN_95,
    IntervalTrial,
    group_by_band,
    pool_trials,
)
from skinrig.evaluating.surface import RAYLEIGH_68


def trials_of(rng, *, shared, scale=1.0, subjects=12, band="any"):
    """Draw Gaussian errors with a variance fraction `shared` common to a subject's pixels."""
    made = []
    for k in range(subjects):
        error = np.sqrt(shared) * rng.standard_normal()
        error = error + np.sqrt(1.0 - shared) * rng.standard_normal(2000)
        made.append(IntervalTrial("x", f"{k}", band, np.abs(scale * error), 1.0, "%", GAUSSIAN_95))
    return made


def test_honest_gaussian_intervals_are_kept_at_both_levels(rng):
    made = trials_of(rng, shared=0.0)
    for level in COVERAGE_RANGES:
        found = pool_trials(made, level=level)
        assert found.verdict == "kept"
        assert found.interval[0] < level / 100 + 0.003
        assert found.interval[1] > level / 100 - 0.003


def test_intervals_half_as_wide_as_errors_miss_coverage(rng):
    # it can fail: 38 % are inside
    found = pool_trials(trials_of(rng, shared=0.0, scale=2.0), level=68)
    assert found.verdict == "missed"
    assert found.inside_fraction == pytest.approx(0.383, abs=0.02)


def test_correlated_pixel_errors_widen_coverage_like_subjects(rng):
    """In 300 runs, 90 to 99.5 % of 95 % intervals contain the true coverage: 3.5 sigma."""
    covered = 0
    for _ in range(300):
        low, high = pool_trials(trials_of(rng, shared=0.5), level=68).interval
        covered += low <= 0.6827 <= high
    assert 0.90 < covered / 300 < 0.995
    # with independent pixels the width would be a thousandth
    assert high - low > 0.05


def test_single_subject_gives_no_interval_and_stays_open(rng):
    found = pool_trials(trials_of(rng, shared=0.0, subjects=1), level=68)
    assert found.interval == (0.0, 1.0)
    assert found.inside_fraction == pytest.approx(0.68, abs=0.05)
    assert found.verdict == "open"


def test_bands_are_reported_and_subjects_without_truth_omitted(rng):
    made = trials_of(rng, shared=0.0, band="light") + trials_of(rng, shared=0.0, band="dark")
    made.append(IntervalTrial("x", "masked", "dark", np.empty(0), float("nan"), "%", GAUSSIAN_95))
    rows = group_by_band(made, level=95, confidence=0.95)
    assert [(row.band, row.subjects) for row in rows] == [("all", 24), ("light", 12), ("dark", 12)]
    with pytest.raises(ValueError, match="truths"):
        pool_trials(made, level=68)


def test_angles_of_two_gaussian_components_reach_68_percent(rng):
    angle = np.hypot(*rng.standard_normal((2, 200_000)))
    # 4 sigma of the fraction
    assert np.mean(angle <= RAYLEIGH_68) == pytest.approx(0.6827, abs=0.0042)


def test_few_truths_all_inside_leave_coverage_open():
    """Two subjects with two truths each, all inside, do not prove 95 % or more."""
    trials = [
        IntervalTrial("x", str(k), "any", np.array([0.1, 0.2]), 1.0, "s", 1.96) for k in range(2)
    ]
    row = pool_trials(trials, level=68, confidence=0.95)
    assert row.verdict == "open"
    assert row.interval == pytest.approx((0.025**0.25, 1.0))  # all of four: tail = low^4
    many = [IntervalTrial("x", str(k), "any", np.full(500, 0.1), 1.0, "s", 1.96) for k in range(2)]
    assert pool_trials(many, level=68, confidence=0.95).verdict == "missed"
