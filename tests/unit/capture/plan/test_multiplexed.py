"""Sequences in time: which phases shots meet, and what a slow camera cannot do."""

from __future__ import annotations

import dataclasses
import math
import pickle
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.plan import Plan, PlanError, flash_plan
from capture.plan.multiplexed import (
    ReadOutError,
    course_plan,
    min_shot_interval_s,
    multiplexed_plan,
)
from capture.plan.phases import equivalent_period_s, phase_coverage, phase_grid, timed_steps
from capture.rig import load_rig

FLASH = load_rig("flash")


def fast_camera(readout_s: float):
    views = tuple(dataclasses.replace(view, readout_s=readout_s) for view in FLASH.views)
    return dataclasses.replace(FLASH, views=views)


def test_captures_22_meet_20_phases_half_second_apart():
    found = phase_coverage(multiplexed_plan(FLASH, prompt_period_s=5.0, shot_period_s=5.5))
    assert (found.captures, found.distinct, found.interval_s) == (22, 20, 0.5)
    assert found.largest_gap_s == 0.5
    assert sorted(found.repeats) == [1] * 18 + [2, 2]


def test_captures_44_meet_40_phases_quarter_second_apart():
    found = phase_coverage(multiplexed_plan(FLASH, prompt_period_s=5.0, shot_period_s=10.25))
    assert (found.captures, found.distinct, found.interval_s) == (44, 40, 0.25)
    # the paper's own period, on a camera that could keep it
    found = phase_coverage(multiplexed_plan(fast_camera(5.0), shot_period_s=5.25))
    assert (found.captures, found.distinct, found.interval_s) == (44, 40, 0.25)


def test_period_below_read_out_is_refused_with_equivalent():
    with pytest.raises(ReadOutError, match=r"10\.25 s meets the same 40 phases") as caught:
        multiplexed_plan(FLASH, shot_period_s=5.25)
    assert caught.value.equivalent_s == 10.25
    assert isinstance(caught.value, PlanError)
    again = multiplexed_plan(FLASH, shot_period_s=caught.value.equivalent_s)
    wanted = multiplexed_plan(FLASH, shot_period_s=5.25, read_out_s=1.0)
    assert phase_coverage(again).covered_s == phase_coverage(wanted).covered_s
    assert isinstance(pickle.loads(pickle.dumps(caught.value)), ReadOutError)


def test_read_out_can_be_stated_if_rig_lacks():
    with pytest.raises(ReadOutError):
        multiplexed_plan(FLASH, shot_period_s=6.5, read_out_s=7)
    assert len(multiplexed_plan(FLASH, shot_period_s=5.25, read_out_s=5.25, darks=0).steps) == 44


def test_rig_camera_needs_5_5_seconds_per_image():
    assert 5.49 < min_shot_interval_s(FLASH, 0.008) <= Fraction("5.5")
    with pytest.raises(ReadOutError):
        multiplexed_plan(FLASH, shot_period_s=5.49)


@given(
    prompt=st.fractions(Fraction(1, 2), 30, max_denominator=20),
    shot=st.fractions(Fraction(1, 10), 40, max_denominator=20),
    read_out=st.fractions(0, 60, max_denominator=20),
)
def test_equivalent_period_meets_same_phase_count_and_shortest(prompt, shot, read_out):
    grid = phase_grid(prompt, shot)
    instead = equivalent_period_s(prompt, shot, read_out)
    assert instead >= read_out
    assert phase_grid(prompt, instead).distinct == grid.distinct
    assert (instead - shot) % prompt == 0
    shorter = instead - prompt
    if shorter >= max(shot, read_out):
        assert phase_grid(prompt, shorter).distinct != grid.distinct


@given(
    prompt=st.fractions(Fraction(1, 2), 20, max_denominator=12),
    shot=st.fractions(Fraction(1, 2), 20, max_denominator=12),
)
def test_phase_grid_matches_counting(prompt, shot):
    grid = phase_grid(prompt, shot)
    met = sorted({k * shot % (2 * prompt) for k in range(grid.distinct + 3)})
    assert len(met) == grid.distinct
    gaps = {b - a for a, b in zip(met, [*met[1:], met[0] + 2 * prompt], strict=True)}
    assert gaps == {grid.interval_s}


@pytest.mark.parametrize(
    ("shot_period_s", "distinct"), [(10, 1), (20, 1), (15, 2), (12.5, 4), (6, 5)]
)
def test_periods_with_large_common_divisor_alias_and_report(shot_period_s, distinct):
    found = phase_coverage(multiplexed_plan(FLASH, shot_period_s=shot_period_s, captures=30))
    assert found.distinct == found.possible == distinct
    assert found.is_aliased
    assert "alias" in str(found)
    assert not phase_coverage(multiplexed_plan(FLASH)).is_aliased


def test_decimal_periods_do_not_suffer_from_binary_rounding():
    # 0.1 + 0.2 is no tenth in binary; 5.1 has 51 tenths in common with nothing but a tenth
    found = phase_coverage(
        multiplexed_plan(FLASH, prompt_period_s=5, shot_period_s=6.1, captures=110)
    )
    assert (found.distinct, found.interval_s) == (100, 0.1)


def test_cycles_or_captures_set_the_length():
    assert len(timed_steps(multiplexed_plan(FLASH, cycles=12))) == 22
    assert len(timed_steps(multiplexed_plan(FLASH, captures=7))) == 7
    with pytest.raises(PlanError, match="one only"):
        multiplexed_plan(FLASH, cycles=2, captures=3)


def test_shots_record_state_and_phase():
    plan = multiplexed_plan(FLASH, state="anger", shot_period_s=5.5)
    for step in timed_steps(plan):
        start = float(step.settings["start_s"])
        assert step.index["phase_s"] == pytest.approx(math.fmod(start, 10.0))
        assert step.index["state"] == ("anger" if step.index["phase_s"] < 5 else "neutral")
    assert Plan.from_json(plan.to_json()) == plan


def test_flash_recycling_slower_than_shots_is_refused():
    slow = dataclasses.replace(fast_camera(0.1), recycle_s=4.0)
    with pytest.raises(PlanError, match="recycle"):
        multiplexed_plan(slow, shot_period_s=3.5)
    with pytest.raises(PlanError, match="recycle"):
        course_plan(fast_camera(0.1), shot_period_s=2.0)  # 20 pops a minute at most


@pytest.mark.parametrize(
    "wrong",
    [
        {"shot_period_s": 0},
        {"shot_period_s": "often"},
        {"prompt_period_s": -1},
        {"prompt_period_s": float("nan")},
        {"captures": 0},
        {"power": 0.0},
        {"state": "neutral"},
        {"lead_cycles": -1},
    ],
)
def test_impossible_multiplexed_plan_is_refused_by_name(wrong):
    with pytest.raises(PlanError):
        multiplexed_plan(FLASH, **wrong)


def test_course_follows_exercise_for_minute_alcohol_for_hour():
    minute = [s.settings["start_s"] for s in timed_steps(course_plan(FLASH))]
    assert minute == [5.5 * k for k in range(11)]
    hour = course_plan(FLASH, state="alcohol", duration_s=3600, shot_period_s=300, before=3)
    assert [s.settings["start_s"] for s in timed_steps(hour)] == [300.0 * k for k in range(13)]
    assert [s.index["state"] for s in hour.steps if s.kind == "subject"][:4] == [
        "neutral",
        "neutral",
        "neutral",
        "alcohol",
    ]
    with pytest.raises(ReadOutError):
        course_plan(FLASH, shot_period_s=5.25)


def test_interleaved_state_repeats_have_all_others_between():
    states = ("neutral", "anger", "fear")
    plan = flash_plan(FLASH, states=states, repeats=3, darks=0, interleave=True)
    shown = [step.index["state"] for step in plan.steps[::2]]
    assert shown == list(states) * 3
    together = flash_plan(FLASH, states=states, repeats=3, darks=0)
    taken, wanted = (sorted(tuple(s.index.values()) for s in p.steps) for p in (plan, together))
    assert taken == wanted
    turns = [s.settings["polarizer"] for s in plan.steps]
    assert sum(a != b for a, b in pairwise(turns)) == len(plan.steps) // 2


def test_sequence_lasts_from_lead_to_last_shot():
    plan = multiplexed_plan(FLASH, darks=0)
    assert plan.estimate_duration_s(FLASH) == pytest.approx(10.0 + 21 * 5.5 + 5.458)
