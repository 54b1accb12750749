"""Plans of the dome: their order, their flicker and dose, and what they refuse."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from capture.plan import Plan, PlanError
from capture.plan.dome import choose_tracking_lights, dome_calibration_plan, dome_plan, to_box_rows
from capture.plan.dose import BLUE_LIMIT_J_M2_SR, dose_report
from capture.plan.eye_light import EYES_MM, eye_irradiance, radiant_intensity
from capture.plan.flicker import (
    EYE_SAMPLE_S,
    average_over_flicker_fusion,
    band_rms,
    count_flashes,
    eye_signal,
    flicker_of_rows,
    flicker_report,
)
from capture.plan.light_order import LIGHT_ORDERS, best_order, compare_orders
from capture.plan.rows import LedRow, led_rows, split_passes, step_lights
from capture.rig import LedLimits, Light, RigError, load_rig

DOME = load_rig("dome")
LED = Light(name="a", position_mm=(0, 0, 700), radius_mm=10, power_w=1.0, half_intensity_deg=60)


# light at the eyes ----------------------------------------------------------------------------


def test_intensity_over_the_hemisphere_is_the_power():
    for half_deg in (10.0, 40.0, 60.0, 80.0):
        led = dataclasses.replace(LED, half_intensity_deg=half_deg)
        angle = np.linspace(0.0, np.pi / 2, 20_001)
        lobe = np.array([led.intensity(float(a)) for a in angle[::20]])
        ring = 2.0 * np.pi * np.sin(angle[::20])
        total = np.trapezoid(lobe * ring, angle[::20]) * radiant_intensity(led)
        assert total == pytest.approx(1.0, rel=1e-4)


def test_light_ahead_follows_inverse_square_behind_gives_nothing():
    def at(z_mm):
        light = dataclasses.replace(LED, position_mm=(0.0, 25.0, z_mm), half_intensity_deg=None)
        rig = dataclasses.replace(DOME, lights=(light,))
        return float(eye_irradiance(rig, eyes_mm=[(0.0, 25.0, 80.0)])[0])

    assert at(1080.0) == pytest.approx(1.0 / (4.0 * np.pi))
    assert at(580.0) == pytest.approx(4.0 * at(1080.0))
    assert at(-700.0) == 0.0


def test_eye_light_is_even_left_and_right():
    light = eye_irradiance(DOME)
    places = np.array([led.position_mm for led in DOME.lights])
    for number, place in enumerate(places):
        mirrored = np.linalg.norm(places - place * [-1, 1, 1], axis=1)
        twin = int(np.argmin(mirrored))
        if mirrored[twin] < 1.0:
            assert light[number] == pytest.approx(light[twin], rel=2e-3, abs=1e-9)
    assert EYES_MM[0][0] == -EYES_MM[1][0]


# flicker --------------------------------------------------------------------------------------


def alternating(hz, seconds=4.0):
    half_s = 0.5 / hz
    rows = [LedRow((0,) if k % 2 else (1,), 1.0, half_s) for k in range(round(seconds / half_s))]
    return rows, np.array([0.0, 1.0])


@pytest.mark.parametrize("hz", [4.0, 8.0, 12.5, 20.0])
def test_alternating_light_flashes_at_rate_with_square_rms(hz):
    rows, weights = alternating(hz)
    report = flicker_of_rows(rows, weights)
    assert report.flashes_per_s == pytest.approx(hz, abs=1.0)
    # harmonics 1, 3, 5.. of a square wave between 0 and twice its mean, up to 65 Hz
    orders = [k for k in range(1, 99, 2) if 3.0 <= k * hz <= 65.0]
    expected = np.sqrt(sum((4.0 / (np.pi * k)) ** 2 / 2.0 for k in orders))
    assert report.rms == pytest.approx(expected, rel=0.03)


def test_steady_light_does_not_flicker():
    rows = [LedRow((k % 2,), 1.0, 0.08) for k in range(60)]
    report = flicker_of_rows(rows, np.array([0.7, 0.7]), overlap_s=1e-4)
    assert report.flashes_per_s <= 0.5  # on and off again, once
    assert report.rms < 0.02


def test_light_above_fusion_rate_is_not_flashing():
    signal = np.tile([0.0, 2.0], 4000)  # 500 Hz
    seen = average_over_flicker_fusion(signal)
    assert np.ptp(seen[100:-100]) < 0.2 * 2.0
    assert count_flashes(seen[100:-100], min_change=0.2 * 2.0) == 0.0
    assert band_rms(signal) < 1e-6


def test_light_at_eyes_integrates_to_row_output():
    rng = np.random.default_rng(3)
    weights = rng.random(20)
    rows = [
        LedRow((int(k),), float(level), 0.0317)
        for k, level in zip(rng.integers(0, 20, 50), rng.random(50), strict=True)
    ]
    signal = eye_signal(rows, weights, overlap_s=0.0)
    given = sum(row.level * row.dwell_s * weights[row.leds[0]] for row in rows)
    assert signal.sum() * EYE_SAMPLE_S == pytest.approx(given, rel=1e-9)
    longer = eye_signal(rows, weights, overlap_s=1e-3).sum() * EYE_SAMPLE_S
    extra = sum(row.level * 1e-3 * weights[row.leds[0]] for row in rows[1:])
    assert longer - given == pytest.approx(extra, rel=1e-6)


def test_dark_gaps_and_bad_orders_flicker_chosen_not():
    dwell_s = 1.0 / 12.0
    found = compare_orders(DOME, dwell_s=dwell_s)
    gaps = []
    for light in LIGHT_ORDERS["spiral"](DOME):
        gaps += [LedRow((light,), 1.0, 0.7 * dwell_s), LedRow((), 0.0, 0.3 * dwell_s)]
    with_gaps = flicker_of_rows(gaps, eye_irradiance(DOME))
    assert with_gaps.rms > 2.0 * found["spiral"].rms
    assert with_gaps.flashes_per_s > 6.0
    best = found["rise and fall"]
    assert best.rms < 0.06 < found["nearest"].rms
    assert best.flashes_per_s <= 0.5
    assert not found["name"].within(DOME.leds)
    assert best_order(DOME, dwell_s=dwell_s) == LIGHT_ORDERS["rise and fall"](DOME)


@pytest.mark.parametrize("name", LIGHT_ORDERS)
def test_an_order_shows_every_light_once(name):
    for rig in (DOME, DOME.subset(lights=["L003", "L070"]), DOME.subset(lights=["L003"])):
        assert sorted(LIGHT_ORDERS[name](rig)) == list(range(len(rig.lights)))


def test_slower_rate_alone_leaves_bad_order_flickering():
    slow = compare_orders(DOME, dwell_s=0.25)["name"]
    assert slow.rms > 0.25


# plans ----------------------------------------------------------------------------------------


def test_plan_gives_lights_both_exposures_within_25_s():
    plan = dome_plan(DOME)
    seen = Counter((s.index["light"], s.index["exposure"]) for s in plan.steps if s.kind == "olat")
    assert len(seen) == 300
    assert set(seen.values()) == {1}
    passing = [s for s in plan.steps if s.index.get("pass") is not None]
    assert 25.0 <= sum(s.settings["dwell_s"] for s in passing) <= 26.5
    exposures = {s.index["exposure"]: s.settings["exposure_s"] for s in plan.steps}
    assert exposures[0] == pytest.approx(4.0 * exposures[1])
    assert all(s.cameras == tuple(v.name for v in DOME.views) for s in plan.steps)


def test_light_keeps_same_position_in_every_pass():
    plan = dome_plan(DOME)
    order: dict[int, list[str]] = {0: [], 1: []}
    for step in plan.steps:
        if step.kind == "olat":
            order[step.index["pass"]].append(step.index["light"])
    assert order[0] == order[1]


def test_tracking_frames_recur_regularly_and_are_not_flashes():
    plan = dome_plan(DOME, tracking_interval=25)
    after = [s.index["after"] for s in plan.steps if s.kind == "tracking"]
    assert after == [0, 25, 50, 75, 100, 125, 150] * 2
    report = flicker_report(plan, DOME)
    assert report.flashes_per_s <= 1.0
    assert report.within(DOME.leds)
    # lit at full instead, they would be: the test can fail
    bright = [
        dataclasses.replace(s, settings={**s.settings, "level": 1.0}) if s.kind == "tracking" else s
        for s in plan.steps
    ]
    assert flicker_report(Plan("dome", tuple(bright)), DOME).rms > 2.0 * report.rms


def test_tracking_lights_are_spread_in_front():
    lights = choose_tracking_lights(DOME)
    places = np.array([DOME.lights[k].position_mm for k in lights])
    assert (places[:, 2] > 0).all()
    way = places / np.linalg.norm(places, axis=1)[:, None]
    angles = np.degrees(np.arccos(np.clip(way @ way.T, -1, 1)))
    assert angles[~np.eye(len(lights), dtype=bool)].min() > 40.0


def test_plan_piece_ends_where_camera_or_target_changes():
    assert [len(piece) for piece in split_passes(dome_plan(DOME).steps)] == [2, 157, 2, 157]
    board = dome_calibration_plan(DOME, "charuco", poses=3, darks=1)
    assert [len(piece) for piece in split_passes(board.steps)] == [1, 1, 1, 1]
    ball = dome_calibration_plan(DOME, "mirror", spheres=2, darks=1)
    assert [len(piece) for piece in split_passes(ball.steps)] == [1, 19, 1, 19]


def test_a_plan_survives_its_file():
    plan = dome_plan(DOME)
    again = Plan.from_json(plan.to_json())
    assert again == plan
    assert led_rows(again.steps, DOME) == led_rows(plan.steps, DOME)


@pytest.mark.parametrize(
    ("target", "steps", "kinds"),
    [
        ("charuco", 2 + 14, {"dark", "charuco"}),
        ("mirror", 4 * 20, {"mirror"}),
        ("white", 2 + 7 * 151, {"dark", "white"}),
        ("dark", 32, {"dark"}),
    ],
)
def test_calibration_plan_contains_steps_required_by_target(target, steps, kinds):
    plan = dome_calibration_plan(DOME, target)
    assert len(plan.steps) == steps
    assert {step.kind for step in plan.steps} == kinds
    assert flicker_report(plan, DOME).within(DOME.leds)
    for step in plan.steps:
        assert (step.kind == "dark") == (step_lights(step) == ())


@pytest.mark.parametrize(
    ("more", "match"),
    [
        ({"exposures_s": (0.07,)}, "to fit with read-out"),
        ({"frames_per_s": 1.5}, "frames_per_s"),
        ({"frames_per_s": 0.0}, "frames_per_s"),
        ({"level": 1.5}, "level"),
        ({"order": [0, 1]}, "every light once"),
        ({"tracking_interval": -1}, "tracking_interval"),
        ({"darks": -1}, "darks"),
        ({"frames_per_s": 3.0}, "level x dwell"),
    ],
)
def test_infeasible_plan_is_refused(more, match):
    with pytest.raises(PlanError, match=match):
        dome_plan(DOME, **more)


def test_a_rig_without_leds_has_no_dome_plan():
    with pytest.raises(PlanError, match="one with LEDs"):
        dome_plan(load_rig("flash"))


def test_an_unknown_light_in_a_plan_is_named():
    plan = dome_plan(DOME)
    with pytest.raises(RigError, match="no light 'L020'"):
        led_rows(plan.steps, DOME.subset(lights=["L001"]))


def test_rows_are_counted_as_by_controller():
    step = dome_plan(DOME).steps[2]
    ((leds, level, dwell_us),) = to_box_rows(led_rows([step], DOME))
    assert leds == tuple(choose_tracking_lights(DOME))
    assert level == round(1000 * step.settings["level"])
    assert dwell_us == 83_333


# dose and limits ------------------------------------------------------------------------------


def test_dose_is_light_time_multiplied_by_level():
    plan = dome_plan(DOME, tracking_interval=0)
    report = dose_report(plan, DOME)
    assert report.led_ws == pytest.approx(2 * 83_333e-6)
    half = dose_report(dome_plan(DOME, tracking_interval=0, level=0.5), DOME)
    assert half.led_ws == pytest.approx(0.5 * report.led_ws)
    assert half.eye_j_m2 == pytest.approx(0.5 * report.eye_j_m2)


def test_the_blue_light_bound_is_radiance_times_time():
    report = dose_report(dome_plan(DOME, tracking_interval=0), DOME)
    led = DOME.lights[0]
    radiance = radiant_intensity(led) / (np.pi * (1e-3 * led.radius_mm) ** 2)
    assert report.blue_share == pytest.approx(radiance * report.led_ws / BLUE_LIMIT_J_M2_SR)


@pytest.mark.parametrize(
    "change",
    [
        {"max_on_s": 0.0},
        {"max_duty": 1.5},
        {"thermal_trip": 1.0},
        {"max_at_once": 1},
        {"overlap_s": 0.1},
        {"max_rows": 0},
        {"dose_ws": float("nan")},
    ],
)
def test_limits_that_make_no_sense_are_refused(change):
    with pytest.raises(RigError):
        LedLimits(**change)


def test_a_rig_with_leds_needs_their_limits():
    with pytest.raises(RigError, match="limits of the LEDs"):
        dataclasses.replace(DOME, leds=None)
