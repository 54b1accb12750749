"""Trials of time constants use the fits' own intervals."""

import numpy as np
import pytest

from reconstruction.facial_color.perfusion_fit import fit_course
from skinrig.benchmarks.intervals.coverage import pool_trials
from skinrig.benchmarks.intervals.sequence import REACTION_RANGE_S, build_request, fit_trial

CONSTANT_S = 20.0


def fit_of(rng, *, noise, too_sure=1.0):
    """Return the document of a fit to a noisy course; `too_sure` divides its intervals."""
    time_s = 5.5 * np.arange(30)
    fit = fit_course(
        time_s, 0.03 - 0.01 * np.exp(-time_s / CONSTANT_S) + noise * rng.standard_normal(30)
    )
    middle = fit.time_constant_s
    return {
        "known": fit.known,
        "time_constant_s": middle,
        "stderr_time_constant_s": fit.stderr_time_constant_s / too_sure,
        "interval_s": [middle + (end - middle) / too_sure for end in fit.interval_s],
        "interval_68_s": [middle + (end - middle) / too_sure for end in fit.interval_68_s],
    }


def trials(rng, **more):
    return [
        fit_trial("x", [fit_of(rng, **more) for _ in range(5)], CONSTANT_S, f"{k}", "any")
        for k in range(60)
    ]


@pytest.mark.long
def test_time_constants_in_noise_have_stated_coverage(rng):
    """300 fits: 4 sigma of a coverage of 68 % is 11 points, of 95 % 5."""
    made = trials(rng, noise=4e-4)
    assert abs(pool_trials(made, level=68).inside_fraction - 0.683) < 0.11
    assert abs(pool_trials(made, level=95).inside_fraction - 0.95) < 0.05


@pytest.mark.long
def test_intervals_half_as_wide_are_found_out(rng):
    made = trials(rng, noise=4e-4, too_sure=2.0)
    assert pool_trials(made, level=68, confidence=0.999).verdict == "missed"
    assert pool_trials(made, level=95, confidence=0.999).verdict == "missed"


def fit_document(known, best, inner, outer):
    return {
        "known": known,
        "time_constant_s": best,
        "interval_68_s": inner,
        "interval_s": outer,
        "stderr_time_constant_s": None,
    }


@pytest.mark.parametrize(
    ("inner", "outer", "held_68", "held_95"),
    [
        ([33.0, 37.0], [10.0, None], 0.0, 1.0),
        ([33.0, 37.0], [30.0, 40.0], 0.0, 0.0),
        ([19.0, 36.0], [10.0, 37.0], 1.0, 1.0),
        # as far off as the longer side reaches, but to the shorter one
        ([33.0, 60.0], [30.0, 90.0], 0.0, 0.0),
    ],
)
def test_each_interval_counts_as_stated(inner, outer, held_68, held_95):
    fit = fit_document("estimated", 35.0, inner, outer)
    one = fit_trial("x", [fit], CONSTANT_S, "a", "any")
    assert one.inside_fraction(68) == held_68
    assert one.inside_fraction(95) == held_95


@pytest.mark.parametrize(
    ("known", "inner", "outer", "held"),
    [
        ("only above", [18.0, None], [15.0, None], (1, 1)),
        ("only above", [28.0, None], [25.0, None], (0, 0)),
        ("only below", [0.0, 5.0], [0.0, 25.0], (0, 1)),
        ("only below", [0.0, 5.0], [0.0, 8.0], (0, 0)),
    ],
)
def test_bounds_are_one_sided_intervals(known, inner, outer, held):
    one = fit_trial(
        "x",
        [fit_document(known, 4.0 if known == "only below" else 90.0, inner, outer)],
        CONSTANT_S,
        subject="a",
        band="any",
    )
    assert (one.inside_fraction(68), one.inside_fraction(95)) == held
    assert np.isnan(one.width)


def test_uninformative_fits_are_omitted():
    fit = fit_document("unknown", 0.1, [0.0, None], [0.0, None])
    assert fit_trial("x", [fit], CONSTANT_S, "a", "any").deviation.size == 0


def test_each_subject_has_individual_reaction_time():
    own = [build_request("smile", seed).reaction_s for seed in range(200)]
    assert build_request("smile", 3).reaction_s == own[3]
    low, high = REACTION_RANGE_S
    assert low <= min(own) < low + 0.05 < high - 0.05 < max(own) <= high
    assert build_request("exercise", 3).reaction_s is None


@pytest.mark.parametrize(
    ("true_s", "held_68", "held_95"), [(0.16, 1, 1), (0.45, 0, 1), (0.7, 0, 0)]
)
def test_delays_count_by_their_own_interval(true_s, held_68, held_95):
    fit = {
        "known": "estimated",
        "time_constant_s": 35.0,
        "stderr_time_constant_s": 2.0,
        "interval_s": [30.0, 40.0],
        "delay_s": 0.25,
        "stderr_delay_s": 0.14,
        "delay_interval_s": [0.01, 0.51],
    }
    one = fit_trial("x", [fit], true_s, "a", "any", delay=True)
    assert (one.inside_fraction(68), one.inside_fraction(95)) == (held_68, held_95)
    assert one.width == pytest.approx(100 * 0.14 / true_s)
