"""Trials of time constants count what the fits' own intervals say."""

import numpy as np
import pytest

from reconstruction.perfusion_fit import fit_course
from skinrig.benchmarks.interval_coverage import pooled
from skinrig.benchmarks.interval_trials_sequence import of_fits

CONSTANT_S = 20.0


def fit_of(rng, *, noise, too_sure=1.0):
    """Return the document of a course in noise; `too_sure` halves its interval when 2."""
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
    }


def trials(rng, **more):
    return [
        of_fits(
            "x", [fit_of(rng, **more) for _ in range(5)], CONSTANT_S, subject=f"{k}", band="any"
        )
        for k in range(60)
    ]


def test_time_constants_in_noise_are_held_as_often_as_said(rng):
    """300 fits: 4 sigma of a share of 68 % is 11 points, of 95 % 5."""
    made = trials(rng, noise=4e-4)
    assert abs(pooled(made, level=68).share - 0.683) < 0.11
    assert abs(pooled(made, level=95).share - 0.95) < 0.05


def test_intervals_half_as_wide_are_found_out(rng):
    made = trials(rng, noise=4e-4, too_sure=2.0)
    assert pooled(made, level=68, confidence=0.999).verdict == "missed"
    assert pooled(made, level=95, confidence=0.999).verdict == "missed"


@pytest.mark.parametrize(("low", "high", "held"), [(10.0, None, 1.0), (30.0, 40.0, 0.0)])
def test_an_interval_counts_at_95_percent_as_it_stands(low, high, held):
    fit = {
        "known": "estimated", "time_constant_s": 35.0, "stderr_time_constant_s": 2.0,
        "interval_s": [low, high],
    }  # fmt: skip
    one = of_fits("x", [fit], CONSTANT_S, subject="a", band="any")
    assert one.share(68) == 0.0
    assert one.share(95) == held


def test_bounds_alone_are_left_out():
    fit = {
        "known": "only below", "time_constant_s": 0.1, "stderr_time_constant_s": None,
        "interval_s": [0.0, 1.0],
    }  # fmt: skip
    one = of_fits("x", [fit], CONSTANT_S, subject="a", band="any")
    assert one.deviation.size == 0


@pytest.mark.parametrize(
    ("true_s", "held_68", "held_95"), [(0.16, 1, 1), (0.45, 0, 1), (0.7, 0, 0)]
)
def test_delays_count_by_their_own_interval(true_s, held_68, held_95):
    fit = {
        "known": "estimated", "time_constant_s": 35.0, "stderr_time_constant_s": 2.0,
        "interval_s": [30.0, 40.0], "delay_s": 0.25, "stderr_delay_s": 0.14,
        "delay_interval_s": [0.01, 0.51],
    }  # fmt: skip
    one = of_fits("x", [fit], true_s, subject="a", band="any", delay=True)
    assert (one.share(68), one.share(95)) == (held_68, held_95)
    assert one.width == pytest.approx(100 * 0.14 / true_s)
