"""The simulated gradient rig as it is asked for: targets, refusals, what is said of its light."""

import pytest

from capture.plan.gradient import gradient_calibration_plan, gradient_plan
from capture.rig import load_rig
from capture.session import verify
from rigsim.mitsuba.variant import choose_renderer
from skinrig.capturing.light_safety import light_figures, light_lines
from skinrig.capturing.option_values import parse_floats, parse_range
from skinrig.capturing.plan_choice import choose_plan, needed_boxes
from skinrig.errors import UsageError
from skinrig.simulating.driving import record_renderer
from skinrig.simulating.gradient import make_scene
from skinrig.simulating.orders import SimulationError
from skinrig.simulating.simulation import simulate_session

RIG = load_rig("gradient")


def test_patterns_on_skin_require_closed_or_shielded_eyes():
    plan = gradient_plan(RIG, angles=[0])
    figures = light_figures(plan, RIG)
    assert figures["flashes_per_s"] < RIG.leds.max_flashes_per_s
    assert figures["open_eyes"] == "refused"
    assert figures["state_s"] == pytest.approx(0.5, rel=0.02)
    assert figures["duty"] <= RIG.leds.max_duty
    first, _, last = light_lines(plan, RIG)
    assert first.endswith("eyes must be closed or shielded: the patch may be next to an eye")
    assert last.startswith("patterns: 0.50 s of light per strain step")


def test_sphere_targets_may_be_viewed_with_open_eyes():
    for target in ("ball", "flat", "dark"):
        figures = light_figures(gradient_calibration_plan(RIG, target), RIG)
        assert figures["open_eyes"] == "allowed", target
        assert "state_s" not in figures


def test_skin_plan_needs_both_controllers_target_plan_sphere():
    assert needed_boxes(RIG, choose_plan(RIG, None, None)) == ("gradient_sphere", "caliper")
    assert needed_boxes(RIG, choose_plan(RIG, None, "ball")) == ("gradient_sphere",)


def test_angles_and_steps_are_parsed_from_command_line():
    plan = choose_plan(
        RIG, None, None, angles=parse_floats("0,90", ""), steps=parse_range("-1..2", "")
    )
    assert {(s.index["angle"], s.index["caliper"]) for s in plan.steps if s.kind != "dark"} == {
        (angle, step) for angle in (0, 90) for step in range(-1, 3)
    }
    assert parse_floats(None, "") is parse_range(None, "") is None


@pytest.mark.parametrize("text", ["-2", "2..", "a..b", "..", "1,2"])
def test_invalid_range_is_usage_error(text):
    with pytest.raises(UsageError, match=r"--steps: got .* expected FIRST\.\.LAST"):
        parse_range(text, "--steps")


@pytest.mark.parametrize("text", ["", "x", "0,,90", "0;90"])
def test_invalid_angles_are_usage_error(text):
    with pytest.raises(UsageError, match="--angles"):
        parse_floats(text, "--angles")


def test_angles_are_for_skin_in_a_caliper_only(tmp_path):
    with pytest.raises(UsageError, match="--angles"):
        choose_plan(load_rig("dome"), None, None, angles=(0.0,))
    with pytest.raises(UsageError, match="--angles"):
        choose_plan(RIG, None, "ball", steps=(0, 1))
    with pytest.raises(UsageError, match="--angles"):
        choose_plan(RIG, tmp_path / "plan.json", None, steps=(0, 1))


@pytest.mark.parametrize(
    ("width", "renderer", "found", "why"),
    [
        (32, "mitsuba", choose_renderer("mitsuba").renderer, ""),
        (32, "fast", "fast", "requested"),
        (640, "mitsuba", "fast", "shadow rays per state exceed"),
    ],
)
def test_wide_skin_falls_back_to_fast_renderer(width, renderer, found, why):
    rig = RIG.cropped(width)
    scene = make_scene(rig, plan=gradient_plan(rig, angles=[0]), renderer=renderer)
    record = record_renderer(scene)
    assert record["name"] == found
    assert why in record["why"]


def test_skin_patch_covers_field_in_every_state():
    rig = RIG.cropped(32)
    one = make_scene(rig, plan=gradient_plan(rig, angles=[0]))
    every = make_scene(rig, plan=gradient_plan(rig))
    field_mm = rig.views[0].field_mm[0]
    assert field_mm / 0.7 < one.subject.size_mm <= every.subject.size_mm


@pytest.mark.parametrize("target", ["flat", "dark"])
def test_targets_are_simulated_without_a_truth(target, tmp_path):
    done = simulate_session("gradient", tmp_path / "session-t", target=target, width_px=32)
    assert done.truth is None
    assert verify(done.session).ok


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"target": "chart"}, "target"),
        ({"states": ("smile",)}, "states"),
        ({"move": True}, "move"),
        ({"lights": 5}, "lights"),
        ({"target": "flat", "site": "chin"}, "site"),
        ({"site": "nose"}, "site"),
        ({"angles": (30.0,)}, "angles"),
        ({"steps": (1, 2)}, "steps"),
    ],
)
def test_options_unknown_to_rig_are_refused_at_once(more, match, tmp_path):
    out = tmp_path / "session-no"
    with pytest.raises(ValueError, match=match):
        simulate_session("gradient", out, width_px=32, **more)
    assert not out.exists()


@pytest.mark.parametrize(
    ("rig", "more"), [("flash", {"site": "chin"}), ("dome", {"steps": (0, 1)})]
)
def test_other_rigs_refuse_caliper_options(rig, more, tmp_path):
    with pytest.raises(SimulationError, match="not an option of"):
        simulate_session(rig, tmp_path / "session-no", **more)
