"""Frames under narrow-band LEDs: bands as typed, and their place in a plan."""

import pytest

from capture.plan import flash_plan
from capture.plan.led_bands import add_led_frames, led_names, parse_bands
from capture.plan.steps import PlanError
from capture.rig import load_rig


@pytest.mark.parametrize("text", ["", "590nm", "419", "681", "590:4", "590:51", "590,590", "59"])
def test_wrong_bands_are_one_error(text):
    with pytest.raises(PlanError, match=r"--bands: got '.*', expected centers of 420 to 680 nm"):
        parse_bands(text)


def test_led_frames_follow_each_crossed_frame():
    leds = parse_bands("450,580:12")
    plan = flash_plan(load_rig("flash"), states=("neutral", "smile"), repeats=2, leds=leds)
    shots = [step for step in plan.steps if step.kind == "subject"]
    crossed = [step for step in shots if step.index.get("polarizer") == "crossed"]
    for step in crossed:
        k = shots.index(step)
        assert [s.index["light"] for s in shots[k + 1 : k + 3]] == list(leds)
        assert all(s.settings["polarizer"] == "crossed" for s in shots[k + 1 : k + 3])
        assert all(s.index["state"] == step.index["state"] for s in shots[k + 1 : k + 3])
    assert len(shots) == 4 * len(crossed)
    assert led_names(plan) == leds


def test_plan_without_leds_is_unchanged():
    plan = flash_plan(load_rig("flash"))
    assert add_led_frames(plan, ()) == plan
    assert led_names(plan) == ()
