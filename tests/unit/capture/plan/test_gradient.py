"""Plans of the gradient sphere: their order, their light and dose, and what they refuse."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from capture.plan import Plan, PlanError
from capture.plan.dose import dose_report
from capture.plan.flicker import flicker_report
from capture.plan.gradient import (
    BALL_SERIES,
    FLAT_LEVELS,
    SCAN_ORDER,
    gradient_calibration_plan,
    gradient_plan,
    group_by_state,
    scan_duty,
    state_name,
    strain_state,
)
from capture.plan.rows import led_rows, pattern_weights, split_passes
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import load_rig

RIG = load_rig("gradient")
PLACES = [light.position_mm for light in RIG.lights]


# patterns -------------------------------------------------------------------------------------


def test_complementary_patterns_sum_to_full():
    for axis in "xyz":
        both = pattern_weights(PLACES, axis) + pattern_weights(PLACES, f"-{axis}")
        np.testing.assert_allclose(both, pattern_weights(PLACES, "full"), atol=1e-15)
    assert not pattern_weights(PLACES, "dark").any()


def test_pattern_is_brightest_on_side_in_its_name():
    way = np.array(PLACES) / np.linalg.norm(PLACES, axis=1)[:, None]
    for axis, pattern in enumerate("xyz"):
        light = int(np.argmax(way[:, axis]))
        assert int(np.argmax(pattern_weights(PLACES, pattern))) == light
        assert int(np.argmin(pattern_weights(PLACES, f"-{pattern}"))) == light
    assert pattern_weights([(0.0, 7.0, 0.0)], "y").tolist() == [1.0]  # +y is up


def test_mean_light_direction_is_recovered_from_four_patterns():
    """Sums over LEDs of x, y, z and full give the first moments: 2 x - full weighs with the way."""
    way = np.array(PLACES) / np.linalg.norm(PLACES, axis=1)[:, None]
    response = np.random.default_rng(1).random(len(way))
    full = pattern_weights(PLACES, "full") @ response
    moments = [2.0 * pattern_weights(PLACES, axis) @ response - full for axis in "xyz"]
    np.testing.assert_allclose(moments, response @ way, atol=1e-12)


def test_an_unknown_pattern_is_refused():
    with pytest.raises(PlanError, match="pattern"):
        pattern_weights(PLACES, "w")


# order ----------------------------------------------------------------------------------------


def test_angle_runs_neutral_then_compressed_then_stretched_stepwise():
    plan = gradient_plan(RIG)
    names = [name for name, _ in group_by_state(plan)]
    assert len(names) == 4 * 13
    assert names[:7] == [
        "a000_n0",
        "a000_m1",
        "a000_m2",
        "a000_m3",
        "a000_m4",
        "a000_p1",
        "a000_p2",
    ]
    assert [name for name in names if name.endswith("n0")] == [
        "a000_n0",
        "a045_n0",
        "a090_n0",
        "a135_n0",
    ]


def test_state_is_eight_parallel_and_eight_crossed_patterns():
    plan = gradient_plan(RIG, angles=[45], steps=(-2, 3))
    for name, steps in group_by_state(plan):
        assert [s.settings["polarizer"] for s in steps] == ["parallel"] * 8 + ["crossed"] * 8
        assert [s.settings["pattern"] for s in steps] == list(SCAN_ORDER) * 2
        assert {strain_state(s) for s in steps} == {name}
        for step in steps:
            index, settings = dict(step.index), step.settings
            assert index["pattern"] == settings["pattern"]
            assert index["polarizer"] == settings["polarizer"]
            assert state_name(index["angle"], index["caliper"]) == name
    assert sorted(SCAN_ORDER) == sorted(LIGHT_PATTERNS)
    assert plan.step("a045-m2-par-x").index["caliper"] == -2
    assert plan.step("a045-p3-cro--z").settings["pattern"] == "-z"


def test_any_patterns_may_be_asked_for():
    plan = gradient_plan(RIG, angles=[0], steps=(0, 0), patterns=["x", "full", "y"], darks=0)
    assert [s.settings["pattern"] for s in plan.steps] == ["full", "x", "y"] * 2


def test_a_plan_survives_its_file():
    plan = gradient_plan(RIG, angles=[0, 90], steps=(-1, 1))
    assert Plan.from_json(plan.to_json()) == plan


# light ----------------------------------------------------------------------------------------


def test_state_takes_half_second_of_light_within_duty():
    plan = gradient_plan(RIG, angles=[0], steps=(-1, 1), darks=0)
    for _, steps in group_by_state(plan):
        assert sum(s.settings["dwell_s"] for s in steps) == pytest.approx(0.5, rel=0.02)
        assert 0.24 < scan_duty(steps, RIG) <= RIG.leds.max_duty


@pytest.mark.parametrize("led", [0, 60, 131])
def test_duty_matches_light_summed_in_small_time_steps(led):
    steps = next(iter(group_by_state(gradient_plan(RIG, angles=[0], steps=(0, 0)))))[1]
    one = dataclasses.replace(RIG, lights=(RIG.lights[led],))
    signal = []
    for number, row in enumerate(led_rows(steps, one)):
        signal += [0.0] * (1500 if number == 8 else 0)  # the analyzer turns for 0.15 s
        signal += [row.light_levels(1)[0]] * round(row.dwell_s * 1e4)
    padded = np.r_[np.zeros(10_000), signal, np.zeros(10_000)]
    total = np.cumsum(padded)
    assert scan_duty(steps, one) == pytest.approx((total[10_000:] - total[:-10_000]).max() / 1e4)


def test_brightness_order_flickers_less_than_name_order():
    plan = gradient_plan(RIG, angles=[0], steps=(0, 0), darks=0)
    halves = [plan.steps[:8], plan.steps[8:]]
    by_name = [
        sorted(half, key=lambda s: LIGHT_PATTERNS.index(s.settings["pattern"])) for half in halves
    ]
    other = Plan(plan.rig, tuple(step for half in by_name for step in half), plan.limits)
    assert flicker_report(plan, RIG).flashes_per_s < flicker_report(other, RIG).flashes_per_s
    assert flicker_report(plan, RIG).flashes_per_s < RIG.leds.max_flashes_per_s


def test_states_are_pieces_of_their_own():
    plan = gradient_plan(RIG, angles=[0, 90], steps=(-1, 1), darks=1)
    assert [len(piece) for piece in split_passes(plan.steps)] == [1] + [16] * 6


def test_led_dose_is_its_fraction_of_state_light():
    plan = gradient_plan(RIG, angles=[0], darks=0)
    report = dose_report(plan, RIG)
    # of 16 patterns 2 are full and 12 complete each other in pairs
    assert report.led_ws == pytest.approx(13 * (2 + 6) * 0.031, rel=1e-9)
    whole = dose_report(gradient_plan(RIG), RIG)
    assert whole.led_ws < 0.3 * whole.limit_ws


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"dwell_s": 0.04, "exposure_s": 0.018}, "duty: got '0.320"),
        ({"angles": [30]}, "angles"),
        ({"angles": [0, 0]}, "none twice"),
        ({"angles": []}, "at least one"),
        ({"steps": (-5, 0)}, "steps"),
        ({"steps": (1, 2)}, "steps"),
        ({"steps": (-1, 9)}, "steps"),
        ({"patterns": ["x", "x"]}, "none twice"),
        ({"patterns": []}, "at least one"),
        ({"patterns": ["up"]}, "patterns"),
        ({"level": 0.0}, "level"),
        ({"level": 1.5}, "level"),
        ({"darks": -1}, "darks"),
        ({"exposure_s": 0.025}, "read-out"),
        ({"dwell_s": 0.6}, "dwell_s"),
    ],
)
def test_plan_beyond_rig_limits_is_refused(more, match):
    with pytest.raises(PlanError, match=match):
        gradient_plan(RIG, **more)


def test_a_rig_without_a_caliper_is_refused():
    with pytest.raises(PlanError, match="caliper"):
        gradient_plan(load_rig("dome"))


def test_plan_time_is_sum_of_light_rotations_moves():
    plan = gradient_plan(RIG, angles=[0], steps=(-2, 1), darks=0)
    light = 4 * 16 * 0.031 + 4 * 0.15
    # 0.4 s a step of the jaws: one, one, three back across neutral; the analyzer turns meanwhile
    moves = 0.4 * (1 + 1 + 3) + 4 * RIG.caliper.settle_s
    places_mm = np.linspace(-3.6, 6.8, 20_001)  # of the jaws before homing, at 1 mm/s
    homing = np.abs(places_mm).mean()
    assert plan.estimate_duration_s(RIG) == pytest.approx(light + moves + homing, rel=1e-4)


# targets --------------------------------------------------------------------------------------


def test_flats_are_pairs_at_levels_up_to_full():
    plan = gradient_calibration_plan(RIG, "flat")
    counts = Counter(s.settings["level"] for s in plan.steps if s.kind == "flat")
    assert counts == dict.fromkeys(FLAT_LEVELS, 2)
    assert sum(s.kind == "dark" for s in plan.steps) == 2


def test_ball_is_lit_faint_to_bright_around_crossed():
    plan = gradient_calibration_plan(RIG, "ball", repeats=3)
    lit = [s for s in plan.steps if s.index["pattern"] == "full"]
    seen = Counter((s.index["reading"], s.settings["level"]) for s in lit)
    assert seen == {(r, v): 3 for r, levels in BALL_SERIES.items() for v in levels}
    turned = {s.settings.get("analyzer_deg") for s in lit if s.index["polarizer"] == "crossed"}
    assert turned == {80, None, 100}
    assert {s.settings["polarizer"] for s in lit if s.index["reading"] == 0} == {"parallel"}
    dark = [s for s in plan.steps if s.index["pattern"] == "dark"]
    assert len(dark) == 3 * len(BALL_SERIES)
    assert {s.kind for s in plan.steps} == {"ball"}
    half = gradient_calibration_plan(RIG, "ball", level=0.5)
    assert max(s.settings["level"] for s in half.steps) == 0.25


def test_the_dark_has_no_light():
    plan = gradient_calibration_plan(RIG, "dark")
    assert len(plan.steps) == 16
    assert dose_report(plan, RIG).led_ws == 0.0


@pytest.mark.parametrize(
    ("target", "more", "match"),
    [
        ("chart", {}, "target"),
        ("flat", {"repeats": 1}, "repeats"),
        ("ball", {"level": 2}, "level"),
        ("dark", {"repeats": 0}, "repeats"),
        ("flat", {"darks": -1}, "darks"),
    ],
)
def test_a_wrong_target_is_refused(target, more, match):
    with pytest.raises(PlanError, match=match):
        gradient_calibration_plan(RIG, target, **more)
