"""Trials of intervals from synthetic documents: correct ones are kept, halved ones are missed."""

import json

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.probe.stages import ANISOTROPY_FILE, SUBSURFACE_FILE
from skinrig.benchmarks.intervals import probe
from skinrig.benchmarks.intervals.coverage import pool_trials
from skinrig.benchmarks.intervals.trials import TrialSubject

PLACE = {"site": "cheek", "repeat": 0, "angle_deg": 0.0}
CHANNELS = ("red", "green", "blue")
TRUE = 0.2


def appearance(**given):
    return SkinAppearance({}, "simulated", **given)


def medium(rng, *, stated=1.0, identified=True):
    """Fits with errors of 5 % and stated errors of `stated` times that; and their ground truth."""
    fits = []
    for channel in CHANNELS:
        error = 0.05 * rng.standard_normal()
        value, half = TRUE * np.exp(error), stated * 0.05
        fits.append(
            {
                "channel": channel,
                "method": "photon_table",
                "valid": True,
                "coefficients_identified": identified,
                "sigma_tr_per_mm": value,
                "sigma_tr_stderr": value * half,
                "interval_per_mm": [value * np.exp(-half), value * np.exp(half)],
                "sigma_a_per_mm": TRUE * (1 + error),
                "sigma_s_prime_per_mm": TRUE * (1 + error),
                "sigma_a_stderr": TRUE * (1 + error) * half,
                "sigma_s_prime_stderr": TRUE * (1 + error) * half,
            }
        )
    document = {"measurements": [{**PLACE, "fits": fits}]}
    values = [TRUE] * 3
    truth = {
        **PLACE,
        "kind": "homogeneous",
        "sigma_tr_per_mm": values,
        "sigma_a_per_mm": values,
        "sigma_s_prime_per_mm": values,
    }
    return (
        appearance(files={SUBSURFACE_FILE: json.dumps(document).encode()}),
        appearance(parameters={"profiles": [truth]}),
    )


def decays(found, truth, subject):
    return probe.decay_trial("sigma_tr of media", found, truth, TrialSubject(subject))


def absorptions(found, truth, subject):
    return probe.coefficient_trial("sigma_a", found, truth, TrialSubject(subject))


@pytest.mark.parametrize("trial", [decays, absorptions])
def test_medium_intervals_keep_coverage_and_halved_ones_miss(trial):
    """80 media of 3 colors: 240 draws; the fraction is off by 0.08 in 1 % of runs at most."""
    rng = np.random.default_rng(8)
    honest = [trial(*medium(rng), f"{k}") for k in range(80)]
    assert pool_trials(honest, level=68).verdict == "kept"
    assert honest[0].width == pytest.approx(5.0, rel=0.01)
    halved = [trial(*medium(rng, stated=0.5), f"{k}") for k in range(80)]
    assert pool_trials(halved, level=68).verdict == "missed"


def test_indistinguishable_coefficients_are_not_evaluated():
    found, truth = medium(np.random.default_rng(1), identified=False)
    assert absorptions(found, truth, "x").deviation.size == 0
    assert decays(found, truth, "x").deviation.size == 3


def directed(rng, *, axis_deg, stated):
    rows = [
        {
            "channel": channel,
            "valid": True,
            "ratio": 1.2 + 0.01 * rng.standard_normal(),
            "ratio_stderr": 0.01 * stated,
            "axis_stderr_deg": 2.0 * stated,
            "axis_deg": (axis_deg + 2.0 * rng.standard_normal()) % 180.0,
        }
        for channel in CHANNELS
    ]
    angle = np.arange(8) * 45.0
    # 1 / sigma_tr on an ellipse whose axes are as 1.2 to 1
    turn = np.radians(angle - axis_deg)
    decay = np.hypot(np.cos(turn) / 1.2, np.sin(turn))
    profiles = [
        {**PLACE, "angle_deg": float(a), "sigma_tr_per_mm": [float(d)] * 3}
        for a, d in zip(angle, decay, strict=True)
    ]
    return (
        appearance(files={ANISOTROPY_FILE: json.dumps({"sites": rows}).encode()}),
        appearance(parameters={"profiles": profiles}),
    )


@pytest.mark.parametrize("axis_deg", [0.0, 60.0, 179.5])
def test_ellipse_parameters_are_evaluated_at_any_axis_direction(axis_deg):
    rng = np.random.default_rng(3)
    for stated, verdict in ((1.0, "kept"), (0.5, "missed")):
        made = [
            list(
                probe.direction_trials(
                    *directed(rng, axis_deg=axis_deg, stated=stated), axis_deg, TrialSubject(f"{k}")
                )
            )
            for k in range(100)
        ]
        for trials in zip(*made, strict=True):
            assert pool_trials(trials, level=68).verdict == verdict


def test_change_widths_are_reported_over_changing_pixels(rng):
    """Widths relative to a change of zero are infinite."""
    rest = np.full((20, 20), 0.04)
    change = np.where(np.arange(20) < 12, 0.0, 0.01) * np.ones((20, 1))
    found = SkinMap(
        (change + 0.002 * rng.standard_normal(change.shape)).astype(np.float32),
        "1",
        np.full(change.shape, 0.002, np.float32),
        np.ones(change.shape, bool),
    )
    of_map = TrialSubject("II 0", "light").map_trial
    everywhere = np.ones(change.shape, bool)
    alone = of_map("change", found, change, everywhere)
    over = of_map("change", found, change, everywhere, over=rest)
    assert alone.width == np.inf
    assert over.width == pytest.approx(5.0)
    np.testing.assert_array_equal(alone.deviation, over.deviation)
