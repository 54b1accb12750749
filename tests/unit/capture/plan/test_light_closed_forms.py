"""Dose, light at the eyes and flicker where level, power and distance all differ from one."""

import dataclasses
import math

import numpy as np
import pytest

from capture.plan import Plan, PlanError, Step, flash_plan
from capture.plan.dose import BLUE_LIMIT_J_M2_SR, dose_report, fiber_light, source_energy_ws
from capture.plan.eye_light import EYES_MM, eye_irradiance, radiant_intensity
from capture.plan.flicker import (
    EYE_SAMPLE_S,
    FLICKER_BAND_HZ,
    average_over_flicker_fusion,
    band_rms,
    count_flashes,
    eye_signal,
    flicker_of_rows,
    flicker_report,
)
from capture.plan.probe import probe_plan
from capture.plan.rows import LedRow
from capture.rig import load_rig

DOME, SPHERE, PROBE, FLASH = (load_rig(name) for name in ("dome", "gradient", "probe", "flash"))
FUSED = 15
"""Samples that the eye averages, 1/65 s."""


def with_lights(rig, **values):
    """A rig whose lights differ in these values; a callable gets the light's number."""
    lights = [
        dataclasses.replace(light, **{k: v(n) if callable(v) else v for k, v in values.items()})
        for n, light in enumerate(rig.lights)
    ]
    return dataclasses.replace(rig, lights=tuple(lights))


def dome_steps(*rows):
    """Steps of (light, level, dwell), in one uninterrupted piece."""
    settings = {"exposure_s": 0.01, "iso": 100}
    return tuple(
        Step(
            *(f"S{n}", "olat", {"pass": 0}),
            settings | {"light": light, "level": level, "dwell_s": dwell_s},
            ("C00",),
        )
        for n, (light, level, dwell_s) in enumerate(rows)
    )


# dose -----------------------------------------------------------------------------------------


def test_dose_sums_level_times_time():
    rig = with_lights(DOME, power_w=lambda n: 0.5 + n, radius_mm=5.0, half_intensity_deg=60.0)
    steps = dome_steps(("L001", 0.5, 0.4), ("L002", 0.25, 0.3), ("L001", 0.1, 0.2))
    report = dose_report(Plan("dome", steps), rig)
    on_s = {1: 0.5 * 0.4 + 0.1 * 0.2, 2: 0.25 * 0.3}
    assert (report.led, report.limit_ws) == ("L001", DOME.leds.dose_ws)
    assert report.led_ws == pytest.approx(1.5 * on_s[1])
    # at 60 degrees the lobe is the cosine itself, whose integral over the hemisphere is pi
    radiance = 1.5 / math.pi / (math.pi * 5e-3**2)
    assert report.blue_share == pytest.approx(radiance * on_s[1] / BLUE_LIMIT_J_M2_SR)
    light = eye_irradiance(rig)
    assert report.eye_j_m2 == pytest.approx(light[1] * on_s[1] + light[2] * on_s[2])


def test_largest_energy_may_be_of_shorter_light():
    rig = with_lights(DOME, power_w=lambda n: 2.0 if n == 2 else 0.5)
    report = dose_report(Plan("dome", dome_steps(("L001", 1.0, 0.3), ("L002", 1.0, 0.1))), rig)
    assert (report.led, report.led_ws) == ("L002", pytest.approx(0.2))


def test_rig_without_limits_has_unlimited_dose():
    report = dose_report(flash_plan(FLASH), FLASH)
    assert (report.limit_ws, report.led_ws) == (math.inf, 0.0)
    flicker = flicker_report(flash_plan(FLASH), FLASH)
    assert (flicker.flashes_per_s, flicker.mean_w_m2) == (0.0, 0.0)


def probe_steps(plan, level):
    """The steps of a plan at other levels than one."""
    return dataclasses.replace(
        plan,
        steps=tuple(
            dataclasses.replace(step, settings={**step.settings, "level": level})
            if step.kind != "dark"
            else step
            for step in plan.steps
        ),
    )


def test_energy_of_fiber_is_power_level_time():
    rig = with_lights(PROBE, power_w=0.004)
    plan = probe_plan(rig, sites=["cheek", "chin"], brackets=3)
    lit_s = sum(step.settings["exposure_s"] for step in plan.steps if step.kind != "dark")
    full, half = (fiber_light(probe_steps(plan, level), rig) for level in (1.0, 0.5))
    assert full.led_ws == pytest.approx(0.004 * lit_s)
    assert source_energy_ws(probe_steps(plan, 0.5), rig) == pytest.approx(0.002 * lit_s)
    for one in ("led_ws", "placement_ws", "skin_w_m2"):
        assert getattr(half, one) == pytest.approx(0.5 * getattr(full, one))
    assert half.placement_ws == pytest.approx(0.5 * half.led_ws)
    assert half.stare_s == pytest.approx(2.0 * full.stare_s)


def test_placement_that_returns_adds_its_energy():
    """The cheek, the chin and the cheek again: the skin of the cheek receives twice."""
    plan = probe_plan(PROBE, sites=["cheek", "chin"], brackets=2)
    lit = [step for step in plan.steps if step.kind != "dark"]
    again = [
        dataclasses.replace(step, id=f"again-{step.id}")
        for step in lit
        if step.index["site"] == "cheek"
    ]
    light = fiber_light(Plan("probe", (*lit, *again)), PROBE)
    assert light.placement_ws == pytest.approx(light.led_ws * 2 / 3)


def test_plan_of_darks_alone_has_no_placement():
    plan = probe_plan(PROBE, sites=["cheek"], brackets=2)
    darks = tuple(step for step in plan.steps if step.kind == "dark")
    light = fiber_light(Plan("probe", darks), PROBE)
    assert (light.led_ws, light.placement_ws, light.skin_w_m2) == (0.0, 0.0, 0.0)
    assert light.stare_s == math.inf


def test_dark_step_with_level_gives_no_energy():
    """Only its kind decides: nothing is lit while the sensor's dark is recorded."""
    plan = probe_plan(PROBE, sites=["cheek"], brackets=2)
    lit_darks = tuple(
        dataclasses.replace(step, settings={**step.settings, "level": 1.0})
        for step in plan.steps
        if step.kind == "dark"
    )
    assert source_energy_ws(Plan("probe", lit_darks), PROBE) == 0.0
    with pytest.raises(PlanError, match="rig: got 'dome', expected one with a probe"):
        source_energy_ws(plan, DOME)


# light at the eyes ----------------------------------------------------------------------------


def test_power_leaves_light_over_hemisphere():
    """The integral of intensity over all directions is the power, whatever the lobe."""
    theta = (np.arange(20_000) + 0.5) * 0.5 * math.pi / 20_000
    for half_deg in (20.0, 40.0, 75.0):
        light = dataclasses.replace(DOME.lights[0], power_w=2.5, half_intensity_deg=half_deg)
        lobe = np.cos(theta) ** light.lobe_exponent * np.sin(theta)
        power_w = radiant_intensity(light) * 2.0 * math.pi * lobe.sum() * (theta[1] - theta[0])
        assert power_w == pytest.approx(2.5, rel=1e-6)


def test_light_is_received_by_cosine_to_view():
    """Eyes at the center, so that each light faces them; from behind they receive nothing."""
    rig = with_lights(DOME, power_w=2.5)
    facing = np.array([0.6, 0.0, 0.8])
    found = eye_irradiance(rig, eyes_mm=[(0.0, 0.0, 0.0)], facing=tuple(facing))
    places = np.array([light.position_mm for light in rig.lights])
    distance_m = 1e-3 * np.linalg.norm(places, axis=1)
    cosine = np.clip(places @ facing / np.linalg.norm(places, axis=1), 0.0, None)
    np.testing.assert_allclose(
        found, radiant_intensity(rig.lights[0]) * cosine / distance_m**2, atol=1e-12
    )
    assert 0 < np.count_nonzero(found) < len(found)


def test_eye_behind_a_light_receives_nothing_from_it():
    """On its axis, where rounding may carry the cosine below -1."""
    for number, light in enumerate(DOME.lights[:30]):
        behind = tuple(2.0 * np.array(light.position_mm))
        towards = tuple(np.array(light.position_mm) / np.linalg.norm(light.position_mm))
        for facing in (towards, tuple(-np.array(towards))):
            assert eye_irradiance(DOME, eyes_mm=[behind], facing=facing)[number] == 0.0


@pytest.mark.parametrize(("rig", "eyes_mm"), [(DOME, EYES_MM), (SPHERE, [(0.0, 0.0, 0.0)])])
def test_default_eyes_are_those_of_rig(rig, eyes_mm):
    np.testing.assert_array_equal(eye_irradiance(rig), eye_irradiance(rig, eyes_mm=eyes_mm))
    assert np.isfinite(eye_irradiance(rig)).all()


# flicker --------------------------------------------------------------------------------------


def test_signal_integrates_rows_within_samples():
    """Rows that begin and end inside a sample light a part of it."""
    rows = [LedRow((0,), 0.5, 2.5 * EYE_SAMPLE_S), LedRow((1,), 0.25, 1.25 * EYE_SAMPLE_S)]
    signal = eye_signal(rows, np.array([4.0, 8.0]))
    first = round(1.0 / EYE_SAMPLE_S)
    np.testing.assert_allclose(signal[first : first + 4], [2.0, 2.0, 2.0, 1.5], atol=1e-6)
    assert signal.sum() == pytest.approx(2.0 * 2.5 + 2.0 * 1.25)
    assert signal.size == 2 * first + 4


def test_pulse_is_spread_over_fusion_time():
    pulse = np.zeros(101)
    pulse[50] = 3.0
    seen = average_over_flicker_fusion(pulse)
    assert np.count_nonzero(seen) == FUSED == round(1.0 / 65.0 / EYE_SAMPLE_S)
    np.testing.assert_allclose(seen[seen > 0], 3.0 / FUSED)
    np.testing.assert_allclose(seen, seen[::-1])


def test_small_steps_are_not_turns():
    """Light that rises and falls in steps of half the change, with dips, turns twice: one flash."""
    rise = np.repeat(np.linspace(0.0, 1.0, 21), 3)
    rise[4::6] -= 0.04
    assert count_flashes(np.r_[rise, rise[::-1]], min_change=0.1) == 1.0
    assert count_flashes(rise, min_change=0.1) == 0.5
    assert count_flashes(1.0 - rise, min_change=0.1) == 0.5


def test_change_is_counted_from_last_extreme():
    """From 1 by 0.06 down, up to 1.02, and 0.1 down: the turn is at the end, from the extreme."""
    signal = np.r_[0.0, 1.0, 0.94, 1.02, np.full(20, 0.925)]
    assert count_flashes(signal, min_change=0.1) == 0.5
    assert count_flashes(np.r_[signal, 0.915], min_change=0.1) == 1.0
    assert count_flashes(1.0 - np.r_[signal, 0.915], min_change=0.1) == 1.0


@pytest.mark.parametrize(("between", "flashes"), [(999, 1.0), (1000, 0.5)])
def test_turns_one_second_apart_are_of_two(between, flashes):
    signal = np.r_[np.zeros(10), np.ones(between), np.zeros(10)]
    assert count_flashes(signal, min_change=0.1) == flashes


@pytest.mark.parametrize(
    ("frequency_hz", "counts"),
    [(2.9, False), (3.0, True), (20.0, True), (65.0, True), (65.1, False)],
)
def test_band_has_its_ends(frequency_hz, counts):
    assert FLICKER_BAND_HZ == (3.0, 65.0)
    t_s = np.arange(10_000) * EYE_SAMPLE_S
    wave = np.sin(2.0 * math.pi * frequency_hz * t_s)
    for mean in (0.5, 4.0):
        expected = 0.3 / mean / math.sqrt(2.0) if counts else 0.0
        assert band_rms(mean + 0.3 * wave) == pytest.approx(expected, abs=1e-9)


def test_darkness_has_no_band_but_noise():
    assert band_rms(-np.ones(100)) == 0.0
    assert band_rms(np.full(5000, 2.0)) == pytest.approx(0.0, abs=1e-12)


def test_dim_flash_counts_from_tenth_of_brightest():
    """Flashes of the ninth and of the eleventh part of the brightest light."""
    for part, flashes in ((9.0, 2.0), (11.0, 1.0)):
        levels = (1.0, 0.0, 1.0 / part, 0.0)
        rows = [LedRow((0,) if level else (), level, 0.2) for level in levels]
        assert flicker_of_rows(rows, np.array([2.0])).flashes_per_s == flashes


def test_rms_has_no_rests():
    """Steady light of 3 s: the plan does not flicker, although dark precedes and follows it."""
    rows = [LedRow((0,), 0.5, 1.5), LedRow((0,), 0.5, 1.5)]
    report = flicker_of_rows(rows, np.array([4.0]))
    assert report.rms == pytest.approx(0.0, abs=1e-9)
    assert (report.seconds, report.mean_w_m2) == (3.0, pytest.approx(2.0))
    assert report.flashes_per_s == 0.5 * 1.0 + 0.5 * 0.0


def test_plan_has_worst_figures_of_its_pieces():
    """A bright steady piece and a dim flickering one, which other exposures divide."""
    rig = with_lights(DOME, power_w=2.5)
    seen = rig.lights[int(np.argmax(eye_irradiance(rig)))].name
    irradiance = float(eye_irradiance(rig).max())
    steady = dome_steps((seen, 1.0, 1.0), (seen, 1.0, 2.0))
    flashing = tuple(
        dataclasses.replace(
            step, id=f"F{step.id}", settings={**step.settings, "exposure_s": 0.02, "iso": 200}
        )
        for step in dome_steps(*[(seen, 0.5 * (n % 2), 0.1) for n in range(20)])
    )
    alone = flicker_report(Plan("dome", flashing), rig)
    both = flicker_report(Plan("dome", (*steady, *flashing)), rig)
    assert (both.flashes_per_s, both.rms) == (alone.flashes_per_s, alone.rms)
    assert (alone.flashes_per_s, alone.rms > 0.5) == (5.0, True)
    assert both.seconds == pytest.approx(3.0 + 2.0)
    mean = (3.0 * irradiance + 2.0 * 0.25 * irradiance) / 5.0
    assert both.mean_w_m2 == pytest.approx(mean, rel=1e-3)


@pytest.mark.parametrize("setting", ["analyzer_deg", "polarizer"])
def test_analyzer_rotates_between_patterns_alone(setting):
    """By angle or by name; steps of the dome have no patterns and no rotation."""
    asked = (0.0, 90.0, 90.0) if setting == "analyzer_deg" else ("parallel", "crossed", "crossed")
    settings = {"exposure_s": 0.01, "dwell_s": 0.2, "iso": 100, "level": 0.5}
    for extra, turns in (({"pattern": "full"}, 1), ({"light": "none"}, 0)):
        steps = tuple(
            Step(f"S{n}", "gradient", {}, settings | extra | {setting: one}, ("cam",))
            for n, one in enumerate(asked)
        )
        report = flicker_report(Plan("gradient", steps), SPHERE)
        assert report.seconds == pytest.approx(0.6 + turns * SPHERE.polarizer_move_s)
