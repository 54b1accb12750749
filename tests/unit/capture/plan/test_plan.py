"""Plans: what the flash generators promise, and what a plan file may not say."""

import itertools
import json
import pickle
from collections import Counter

import pytest

from capture.plan import Plan, PlanError, Step, flash_calibration_plan, flash_plan
from capture.rig import load_rig


@pytest.fixture
def flash():
    return load_rig("flash")


def subject_step(identity="S1", **settings):
    return Step(identity, "subject", {"state": "neutral"}, settings, ("cam",))


def test_state_repeat_has_single_parallel_and_crossed_image(flash):
    plan = flash_plan(flash, states=("neutral", "anger", "fear"), repeats=2, darks=3)
    subject = [step for step in plan.steps if step.kind == "subject"]
    seen = Counter((s.index["state"], s.index["repeat"], s.settings["polarizer"]) for s in subject)
    assert set(seen.values()) == {1}
    assert len(seen) == 3 * 2 * 2
    assert [s.kind for s in plan.steps[:3]] == ["dark"] * 3
    assert all(s.index["polarizer"] == s.settings["polarizer"] for s in subject)


def test_analyzer_rotates_once_per_pair(flash):
    plan = flash_plan(flash, states=("a", "b", "c"), repeats=2, darks=0)
    states = [s.settings["polarizer"] for s in plan.steps]
    turns = sum(a != b for a, b in itertools.pairwise(states))
    assert turns == len(states) // 2


def test_darks_fire_no_light(flash):
    plan = flash_calibration_plan(flash, "dark")
    assert {s.kind for s in plan.steps} == {"dark"}
    assert {s.settings["power"] for s in plan.steps} == {0.0}


def test_flats_are_pairs_at_eight_powers_or_more(flash):
    plan = flash_calibration_plan(flash, "flat")
    powers = Counter(s.settings["power"] for s in plan.steps if s.kind == "flat")
    assert len(powers) >= 8
    assert set(powers.values()) == {2}
    assert max(powers) == 1.0


def test_malus_series_spans_180_degrees_in_thirteen_angles(flash):
    plan = flash_calibration_plan(flash, "malus", repeats=1)
    angles = [s.settings["analyzer_deg"] for s in plan.steps if s.kind == "malus"]
    assert angles == [15.0 * k for k in range(13)]


def test_chart_is_imaged_parallel_and_crossed(flash):
    plan = flash_calibration_plan(flash, "chart")
    assert {s.settings["polarizer"] for s in plan.steps if s.kind == "chart"} == {
        "parallel",
        "crossed",
    }


@pytest.mark.parametrize("target", ["dark", "flat", "chart", "malus"])
def test_a_plan_survives_its_json_and_a_pickle(flash, target):
    plan = flash_calibration_plan(flash, target)
    assert Plan.from_json(json.dumps(plan.to_json())) == plan
    assert pickle.loads(pickle.dumps(plan)) == plan


def test_estimate_sums_frame_read_outs_and_rotations_between(flash):
    plan = flash_plan(flash, darks=1, exposure_s=0.5)
    # dark, parallel, crossed: three read-outs and exposures, the analyzer set twice
    assert plan.estimate_duration_s(flash) == pytest.approx(3 * (5.45 + 0.5) + 2 * 0.5)


def test_the_estimate_never_undercuts_the_pop_limit(flash):
    import dataclasses

    quick = dataclasses.replace(
        flash, views=tuple(dataclasses.replace(v, readout_s=0.0) for v in flash.views)
    )
    plan = flash_plan(quick, repeats=10, darks=0)
    assert plan.estimate_duration_s(quick) >= len(plan.steps) * 60 / quick.max_pops_per_min


def test_a_step_is_frozen_down_to_its_settings():
    step = subject_step(power=0.5)
    with pytest.raises(TypeError):
        step.settings["power"] = 1.0


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"power": 1.5}, "0 <= power <= 1"),
        ({"power": float("nan")}, "finite"),
        ({"power": True}, "0 <= power <= 1"),
        ({"polarizer": "cross"}, '"parallel" or "crossed"'),
        ({"exposure_ms": 8.0}, "did you mean exposure_s? (x0.001)"),
        ({"analyser_dg": 8.0}, "did you mean analyzer_deg?"),
        ({"analyzer_deg": 400.0}, "0 <= degrees < 360"),
        ({"exposure_s": 0.0}, "seconds > 0"),
    ],
)
def test_a_setting_that_cannot_be_is_named(settings, expected):
    with pytest.raises(PlanError) as caught:
        subject_step(**settings)
    assert expected in str(caught.value)
    assert f"settings.{next(iter(settings))}" in str(caught.value)


def test_settings_of_other_rigs_are_allowed():
    assert subject_step(zone="X", stretch_mm=0.8).settings["stretch_mm"] == 0.8


@pytest.mark.parametrize("twin", ["S1", "s1"])
def test_steps_with_equal_file_names_are_refused(twin):
    with pytest.raises(PlanError, match=r"steps\[1\].id"):
        Plan("flash", (subject_step("S1"), subject_step(twin)))


@pytest.mark.parametrize("identity", ["../S1", "/S1", "", "a b", "S+1"])
def test_step_id_with_path_traversal_is_refused(identity):
    with pytest.raises(PlanError, match="id: got"):
        subject_step(identity)


def test_an_empty_plan_is_refused():
    with pytest.raises(PlanError, match="at least one step"):
        Plan("flash", ())


def test_all_faults_of_a_plan_file_are_listed(flash):
    data = flash_plan(flash).to_json()
    data["steps"][0]["kind"] = "drak"
    data["steps"][1]["setings"] = {}
    del data["steps"][2]["cameras"]
    with pytest.raises(PlanError) as caught:
        Plan.from_json(data, where="plan.json")
    paths = [fault.path for fault in caught.value.faults]
    assert paths == ["steps[0].kind", "steps[1].setings", "steps[2].cameras"]
    assert "did you mean settings?" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"rig": NaN}', "NaN"),
        ('{"rig": "a", "rig": "b"}', "is twice"),
        ("[" * 100_000, "is not JSON"),
        (b"\xff", "is not JSON"),
        ("", "is not JSON"),
        ("[]", "fault"),
    ],
)
def test_invalid_plan_text_gives_single_error(text, reason):
    with pytest.raises(PlanError, match=reason):
        Plan.from_json(text, where="plan.json")


def test_plan_for_other_rig_or_camera_is_refused(flash):
    plan = Plan("dome", (Step("S1", "subject", {}, {}, ("left",)),))
    with pytest.raises(PlanError) as caught:
        plan.check(flash)
    assert [fault.path for fault in caught.value.faults] == ["rig", "steps[0].cameras"]


def test_an_unknown_step_is_answered_with_the_nearest(flash):
    with pytest.raises(PlanError, match="did you mean S001"):
        flash_plan(flash).step("S01")
