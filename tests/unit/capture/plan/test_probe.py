"""Plans of the fiber probe: series, rests, darks, light."""

import dataclasses
import itertools

import numpy as np
import pytest

from capture.plan import Plan, PlanError, Step
from capture.plan.dose import fiber_light
from capture.plan.probe import (
    MAX_MASK_EXPOSURE_S,
    exposure_series_s,
    group_by_series,
    probe_calibration_plan,
    probe_plan,
)
from capture.plan.suction import (
    WIRE_SLACK_S,
    exposure_time_per_suction_s,
    split_into_suctions,
    step_placement,
)
from capture.rig import load_rig

RIG = load_rig("probe")
PROBE = RIG.probe


def test_series_has_23_exposures_lasting_88_seconds():
    steps = [s for s in probe_plan(RIG, sites=["cheek"]).steps if s.kind == "fibers"]
    seconds = np.array([step.settings["exposure_s"] for step in steps])
    assert len(seconds) == 23
    np.testing.assert_allclose(np.diff(np.log2(seconds)), 2.0 / 3.0, rtol=1e-12)
    assert seconds[-1] == 30.0
    # Weyrich et al. 2006, section 8: about 88 s
    assert 87.0 < (seconds + RIG.views[0].readout_s).sum() < 89.0
    assert [step.index["bracket"] for step in steps] == list(range(23))
    assert {step.settings["suction_mbar"] for step in steps} == {PROBE.suction_mbar}


def test_brackets_span_more_than_four_exposure_decades():
    seconds = exposure_series_s()
    assert seconds[-1] / seconds[0] > 10**4.4


def test_sites_repeats_and_angles_have_own_placement_series():
    plan = probe_plan(RIG, sites=["forehead", "chin"], repeats=2, angles=3, brackets=4)
    places = [placement for placement, _ in group_by_series(plan)]
    assert [(p.site, p.repeat, p.angle_deg) for p in places] == [
        (site, repeat, angle)
        for site in ("forehead", "chin")
        for repeat in (0, 1)
        for angle in (0.0, 120.0, 240.0)
    ]
    assert {len(steps) for _, steps in group_by_series(plan)} == {4}


def test_sixteen_directions_go_all_round_in_equal_steps():
    plan = probe_plan(RIG, sites=["cheek"], angles=16, brackets=2)
    angles = [placement.angle_deg for placement, _ in group_by_series(plan)]
    np.testing.assert_allclose(np.diff(angles), 22.5)
    assert angles[0] == 0.0
    assert angles[-1] == 337.5
    assert len({step.id for step in plan.steps}) == len(plan.steps)


def test_darks_come_first_at_shortest_middle_longest_exposure():
    plan = probe_plan(RIG, darks=2)
    kinds = [step.kind for step in plan.steps]
    count = kinds.count("dark")
    assert kinds[:count] == ["dark"] * count
    darks = plan.steps[:count]
    times = {step.settings["exposure_s"] for step in darks}
    series = exposure_series_s()
    assert len(times) == 3
    assert {min(times), max(times)} == {series[0], series[-1]}
    assert times <= set(series)
    assert {step.settings["level"] for step in darks} == {0.0}
    assert not any("suction_mbar" in step.settings for step in darks)


def test_suction_stays_within_skin_limit_and_never_truncated():
    rng = np.random.default_rng(5)
    for _ in range(50):
        seconds = rng.uniform(0.3, 30.3, rng.integers(1, 40)).tolist()
        found = split_into_suctions(seconds, PROBE)
        assert [k for span in found for k in span] == list(range(len(seconds)))
        for span in found:
            used_s = sum(seconds[k] + WIRE_SLACK_S for k in span)
            assert used_s <= exposure_time_per_suction_s(PROBE) or len(span) == 1
        for one, other in itertools.pairwise(found):
            both_s = sum(seconds[k] + WIRE_SLACK_S for k in one) + seconds[other[0]] + WIRE_SLACK_S
            assert both_s > exposure_time_per_suction_s(PROBE)


def test_the_estimate_counts_exposures_pumping_and_rests():
    plan = probe_plan(RIG, sites=["cheek"], darks=0)
    frames_s = sum(s.settings["exposure_s"] + RIG.views[0].readout_s for s in plan.steps)
    held_s = 2 * (PROBE.settle_s + 2.0) + PROBE.rest_s
    assert plan.estimate_duration_s(RIG) == pytest.approx(frames_s + held_s)
    twice = probe_plan(RIG, sites=["cheek", "chin"], darks=0)
    both_s = 2 * plan.estimate_duration_s(RIG) + PROBE.rest_s
    assert twice.estimate_duration_s(RIG) == pytest.approx(both_s)


def test_other_rigs_take_the_time_that_they_took():
    rig = dataclasses.replace(RIG, probe=None)
    step = Step("a", "dark", {}, {"exposure_s": 1.0}, ("cam",))
    assert Plan(rig.name, (step,)).estimate_duration_s(rig) == pytest.approx(1.3)


def test_calibration_has_whole_series_and_each_fiber_uncovered():
    plan = probe_calibration_plan(RIG)
    kinds = {kind: [s for s in plan.steps if s.kind == kind] for kind in ("phantom", "mask")}
    assert [s.settings["exposure_s"] for s in kinds["phantom"]] == list(exposure_series_s())
    by_fiber = {}
    for step in kinds["mask"]:
        assert step.settings["fiber"] == step.index["fiber"]
        by_fiber.setdefault(step.settings["fiber"], []).append(step.settings["exposure_s"])
    assert sorted(by_fiber) == list(range(28))
    for seconds in by_fiber.values():
        np.testing.assert_allclose(np.diff(np.log2(seconds)), 2.0)
        assert MAX_MASK_EXPOSURE_S / 4 < seconds[-1] <= MAX_MASK_EXPOSURE_S
        assert set(seconds) <= set(exposure_series_s())
    # one placement serves the series and all covers
    assert {step_placement(s) for s in (*kinds["phantom"], *kinds["mask"])} == {
        step_placement(kinds["phantom"][0])
    }
    assert {s.kind for s in probe_calibration_plan(RIG, "dark").steps} == {"dark"}


def test_a_plan_goes_through_json_unchanged():
    plan = probe_calibration_plan(RIG, brackets=3)
    assert Plan.from_json(plan.to_json()) == plan
    plan.check(RIG)


def test_light_is_power_by_time_narrow_cone_worse():
    plan = probe_plan(RIG, sites=["cheek", "chin"], darks=3)
    light = fiber_light(plan, RIG)
    given_ws = 2 * sum(exposure_series_s()) * RIG.lights[0].power_w
    assert light.led_ws == pytest.approx(given_ws)
    assert light.placement_ws == pytest.approx(given_ws / 2)
    narrow = dataclasses.replace(
        RIG, probe=dataclasses.replace(PROBE, source_numerical_aperture=0.11)
    )
    assert fiber_light(plan, narrow).stare_s == pytest.approx(light.stare_s / 4)
    dim = probe_plan(RIG, sites=["cheek", "chin"], darks=3, level=0.5)
    assert fiber_light(dim, RIG).led_ws == pytest.approx(given_ws / 2)
    assert fiber_light(dim, RIG).stare_s == pytest.approx(2 * light.stare_s)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ({"sites": []}, "at least one"),
        ({"sites": ["cheek", "cheek"]}, "none twice"),
        ({"sites": ["phantom"]}, "not 'phantom'"),
        ({"sites": ["left cheek"]}, "a name"),
        ({"repeats": 0}, "repeats: got 0"),
        ({"angles": 0}, "angles: got 0"),
        ({"brackets": 1}, "brackets: got 1"),
        ({"max_exposure_s": 31.0}, "max_exposure_s: got 31"),
        ({"max_exposure_s": 0.0}, "max_exposure_s: got 0"),
        ({"step_ev": 0.0}, "step_ev: got 0"),
        ({"level": 0.0}, "level: got 0"),
        ({"darks": -1}, "darks: got -1"),
    ],
)
def test_impossible_probe_plan_is_refused_by_name(words, match):
    with pytest.raises(PlanError, match=match):
        probe_plan(RIG, **words)


def test_other_rigs_have_no_such_plan():
    with pytest.raises(PlanError, match="one with a probe"):
        probe_plan(load_rig("flash"))
    with pytest.raises(PlanError, match="expected one of phantom, dark"):
        probe_calibration_plan(RIG, "white")


def test_limited_pump_time_bounds_longest_exposure():
    weak = dataclasses.replace(RIG, probe=dataclasses.replace(PROBE, max_suction_s=20.0))
    with pytest.raises(PlanError, match="one suction of 20 s has room for"):
        probe_plan(weak)
    plan = probe_plan(weak, sites=["cheek"], max_exposure_s=15.0, darks=0)
    assert (
        len(split_into_suctions([s.settings["exposure_s"] + 0.3 for s in plan.steps], weak.probe))
        > 2
    )
