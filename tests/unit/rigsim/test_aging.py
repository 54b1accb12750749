"""An aged rig against closed forms: decay of LEDs, their temperature, and the frame's expansion."""

import math

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.aging import (
    EXPANSION_PER_K,
    LED_DECAY_PER_H,
    LED_FLUX_PER_K,
    OPERATING_H_PER_DAY,
    ROOM_DEVIATION_K,
    AgeError,
    RigAge,
    age_dome,
    age_sphere,
    draw_rig_age,
)
from rigsim.as_built.dome import build_dome
from rigsim.as_built.sphere import build_sphere

DOME, SPHERE = load_rig("dome"), load_rig("gradient")


def test_today_is_the_rig_as_built():
    dome, sphere = build_dome(DOME, seed=1), build_sphere(SPHERE, seed=1)
    today = draw_rig_age(0, seed=1)
    assert age_dome(dome, today, seed=1) is dome
    assert age_sphere(sphere, today, seed=1) is sphere


def test_leds_lose_three_tenths_in_36000_hours():
    days = round(36_000 / OPERATING_H_PER_DAY)
    names = [f"L{k}" for k in range(400)]
    flux = RigAge(days, 0.0).led_factors(names, seed=0)
    # brighter in the past: the mean logarithm is that of 1 / 0.7
    assert np.log(flux).mean() == pytest.approx(-math.log(0.7), rel=0.08)
    assert np.log(flux).std() > 0.1
    assert days * OPERATING_H_PER_DAY * LED_DECAY_PER_H == pytest.approx(-math.log(0.7))


def test_warm_room_dims_all_leds_alike():
    warm = RigAge(1, 60.0).led_factors(["a", "b"], seed=0)
    cold = RigAge(1, 0.0).led_factors(["a", "b"], seed=0)
    np.testing.assert_allclose(warm / cold, math.exp(60.0 * LED_FLUX_PER_K))


def test_frame_expands_about_the_center():
    dome = age_dome(build_dome(DOME, seed=1), RigAge(1, 10.0), seed=1)
    built = build_dome(DOME, seed=1).rig
    ratio = np.array(dome.rig.lights[3].position_mm) / built.lights[3].position_mm
    np.testing.assert_allclose(ratio, 1.0 + 10.0 * EXPANSION_PER_K)
    ratio = np.array(dome.rig.views[2].position_mm) / built.views[2].position_mm
    np.testing.assert_allclose(ratio, 1.0 + 10.0 * EXPANSION_PER_K)


def test_room_temperature_varies_as_stated_between_days():
    drawn = np.array([draw_rig_age(day, seed=2).warmer_k for day in range(1, 400)])
    assert drawn.std() == pytest.approx(ROOM_DEVIATION_K, rel=0.1)
    assert draw_rig_age(30, seed=2) == draw_rig_age(30, seed=2)


def test_future_day_is_refused():
    with pytest.raises(AgeError, match="days_ago: got -1, expected 0 or more"):
        draw_rig_age(-1, seed=0)
