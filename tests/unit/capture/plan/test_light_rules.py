"""Dose, light at the eyes and flicker of plans, by closed forms."""

import dataclasses
import math

import numpy as np
import pytest

from capture.plan import Plan, PlanError
from capture.plan.dome import add_scan, dome_plan
from capture.plan.dose import BLUE_LIMIT_J_M2_SR, SKIN_APERTURE_MM, dose_report, fiber_light
from capture.plan.eye_light import eye_irradiance, radiant_intensity
from capture.plan.flicker import (
    DARK_PADDING_S,
    EYE_SAMPLE_S,
    MIN_RMS_DURATION_S,
    FlickerReport,
    average_over_flicker_fusion,
    band_rms,
    count_flashes,
    eye_signal,
    flicker_of_rows,
    flicker_report,
)
from capture.plan.gradient import gradient_plan
from capture.plan.probe import probe_plan
from capture.plan.rows import LedRow
from capture.rig import load_rig

DOME = load_rig("dome")
PROBE = load_rig("probe")


def change_light(rig, number, **values):
    lights = list(rig.lights)
    lights[number] = dataclasses.replace(lights[number], **values)
    return dataclasses.replace(rig, lights=tuple(lights))


def test_strongest_light_has_largest_energy():
    """One light of twice the power of the others, with the same seconds."""
    plan = dome_plan(DOME, tracking_interval=0)
    power_w = DOME.lights[7].power_w
    strong = change_light(DOME, 7, power_w=2.0 * power_w)
    report = dose_report(plan, strong)
    assert report.led == DOME.lights[7].name
    assert report.led_ws == pytest.approx(2.0 * dose_report(plan, DOME).led_ws)
    assert report.blue_share == pytest.approx(2.0 * dose_report(plan, DOME).blue_share)
    assert report.limit_ws == DOME.leds.dose_ws
    seen = int(np.argmax(eye_irradiance(DOME)))
    dark = change_light(DOME, seen, power_w=None, energy_ws=1.0)
    assert dose_report(plan, dark).eye_j_m2 < dose_report(plan, DOME).eye_j_m2


def test_lights_without_power_have_no_led_dose():
    """Flash tubes have an energy per pop, not a power."""
    tubes = [dataclasses.replace(one, power_w=None, energy_ws=1.0) for one in DOME.lights]
    rig = dataclasses.replace(DOME, lights=tuple(tubes))
    assert dose_report(dome_plan(DOME, tracking_interval=0), rig).led_ws == 0.0


def test_narrow_light_has_radiance_of_its_area():
    plan = dome_plan(DOME, tracking_interval=0)
    small = change_light(DOME, 7, radius_mm=DOME.lights[7].radius_mm / 3.0)
    whole = dose_report(plan, DOME).blue_share
    assert dose_report(plan, small).blue_share == pytest.approx(9.0 * whole)


def test_fiber_light_has_closed_forms():
    plan = probe_plan(PROBE, sites=["cheek", "chin"], brackets=4)
    light = fiber_light(plan, PROBE)
    power_w = PROBE.lights[0].power_w * max(step.settings["level"] for step in plan.steps)
    lit = [step.settings for step in plan.steps if step.kind != "dark"]
    given_ws = sum(PROBE.lights[0].power_w * one["level"] * one["exposure_s"] for one in lit)
    assert light.led == PROBE.lights[0].name
    assert light.led_ws == pytest.approx(given_ws)
    assert light.placement_ws == pytest.approx(given_ws / 2)
    assert light.limit_ws == PROBE.leds.dose_ws
    area_m2 = math.pi / 4 * (1e-3 * SKIN_APERTURE_MM) ** 2
    assert light.skin_w_m2 == pytest.approx(power_w / area_m2)
    core_m2 = math.pi / 4 * (1e-3 * PROBE.probe.source_core_mm) ** 2
    cone_sr = math.pi * PROBE.probe.source_numerical_aperture**2
    assert light.stare_s == pytest.approx(BLUE_LIMIT_J_M2_SR * core_m2 * cone_sr / power_w)


def test_dark_source_gives_no_dose():
    dark = change_light(PROBE, 0, power_w=None, energy_ws=1.0)
    light = fiber_light(probe_plan(PROBE, sites=["cheek"], brackets=4), dark)
    assert (light.led_ws, light.placement_ws, light.skin_w_m2) == (0.0, 0.0, 0.0)
    assert light.stare_s == math.inf


def test_fiber_light_of_dome_is_refused():
    with pytest.raises(PlanError, match="probe"):
        fiber_light(dome_plan(DOME), DOME)


def test_even_light_has_intensity_of_whole_sphere():
    light = dataclasses.replace(DOME.lights[0], half_intensity_deg=None, power_w=3.0)
    assert radiant_intensity(light) == pytest.approx(3.0 / (4.0 * math.pi))
    assert radiant_intensity(dataclasses.replace(light, power_w=None, energy_ws=1.0)) == 0.0


def test_eyes_receive_mean_of_both():
    one, other = ((dx, 25.0, 80.0) for dx in (-32.0, 32.0))
    each = [eye_irradiance(DOME, eyes_mm=[eye]) for eye in (one, other)]
    both = eye_irradiance(DOME, eyes_mm=[one, other])
    np.testing.assert_allclose(both, np.mean(each, axis=0))
    assert np.ptp(np.divide(*each, where=both > 0, out=np.ones_like(both))) > 0.1


def test_oblique_light_falls_by_lobe_and_distance():
    """A light 700 mm ahead of the center, and eyes 350 mm to its side."""
    rig = change_light(DOME, 0, position_mm=(0.0, 0.0, 700.0), half_intensity_deg=30.0)
    cosine = 700.0 / math.hypot(700.0, 350.0)
    exponent = math.log(0.5) / math.log(math.cos(math.radians(30.0)))
    on_axis = radiant_intensity(rig.lights[0])
    expected = on_axis * cosine ** (exponent + 1.0) / (0.7**2 + 0.35**2)
    assert eye_irradiance(rig, eyes_mm=[(350.0, 0.0, 0.0)])[0] == pytest.approx(expected)


WEIGHTS = np.array([3.0, 1.0])


def test_signal_has_light_of_rows_between_rests():
    """0.2 s of the first light and 0.1 s of the second, which begins 0.05 s earlier."""
    rows = [LedRow((0,), 1.0, 0.2), LedRow((1,), 0.5, 0.1)]
    signal = eye_signal(rows, WEIGHTS, overlap_s=0.05)
    times_s = (np.arange(signal.size) + 0.5) * EYE_SAMPLE_S - DARK_PADDING_S
    expected = 3.0 * ((times_s > 0.0) & (times_s < 0.2)) + 0.5 * (
        (times_s > 0.15) & (times_s < 0.3)
    )
    np.testing.assert_allclose(signal, expected, atol=1e-9)
    assert signal.size == math.ceil((0.3 + 2.0 * DARK_PADDING_S) / EYE_SAMPLE_S)


def test_no_rows_give_no_light():
    assert eye_signal([], WEIGHTS).size == 0
    assert flicker_of_rows([], WEIGHTS) == FlickerReport(0.0, 0.0, 0, 0.0)


def test_dark_rows_give_no_flicker():
    rows = [LedRow((), 0.0, 1.5), LedRow((0,), 0.0, 1.0)]
    assert flicker_of_rows(rows, WEIGHTS) == FlickerReport(0.0, 0.0, 2.5, 0.0)
    assert band_rms(np.zeros(100)) == 0.0
    assert band_rms(np.zeros(0)) == 0.0


def test_one_flash_of_dim_light_counts():
    rows = [LedRow((), 0.0, 0.5), LedRow((1,), 0.1, 0.5), LedRow((), 0.0, 0.5)]
    assert flicker_of_rows(rows, WEIGHTS).flashes_per_s == 1.0


def test_scan_alone_has_no_flicker():
    """Stripes of the projector are no rows of LEDs."""
    rig = DOME.with_scanner()
    steps = add_scan(dome_plan(rig), rig).steps
    scan = Plan("dome", tuple(step for step in steps if step.kind == "stripes"))
    assert flicker_report(scan, rig) == FlickerReport(0.0, 0.0, 0.0, 0.0)


def test_mean_light_of_plan_gives_its_exposure():
    rig = load_rig("gradient")
    plan = gradient_plan(rig)
    report = flicker_report(plan, rig)
    exposure = dose_report(plan, rig).eye_j_m2
    assert report.mean_w_m2 * report.seconds == pytest.approx(exposure, rel=5e-3)


def test_turning_analyzer_adds_darkness_between_patterns():
    """The face is dark while the analyzer turns; eyes may count that darkness as a flash."""
    rig = load_rig("gradient")
    lit = next(step for step in gradient_plan(rig).steps if step.settings["pattern"] == "full")
    asked = ("parallel", "crossed", "crossed", "parallel")
    steps = tuple(
        dataclasses.replace(lit, id=f"S{k}", settings={**lit.settings, "polarizer": one})
        for k, one in enumerate(asked)
    )
    expected_s = 4 * lit.settings["dwell_s"] + 2 * rig.polarizer_move_s
    assert flicker_report(Plan("gradient", steps), rig).seconds == pytest.approx(expected_s)


def test_mean_light_excludes_rests():
    rows = [LedRow((0,), 1.0, 1.0), LedRow((1,), 1.0, 1.0)]
    assert flicker_of_rows(rows, WEIGHTS).mean_w_m2 == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(("change", "flashes"), [(0.4, 5.0), (0.5, 5.0), (0.6, 0.0)])
def test_change_counts_from_threshold_on(change, flashes):
    signal = np.tile(np.r_[np.zeros(100), np.full(100, 0.5)], 10)
    assert count_flashes(signal, min_change=change) == flashes


def test_flashes_count_within_one_second():
    """Turns 0.4 s apart: three fall into a second, whose ends do not both belong to it."""
    half = round(0.5 / EYE_SAMPLE_S)
    signal = np.tile(np.r_[np.zeros(half), np.ones(half)], 4)
    assert count_flashes(signal, min_change=0.1) == 1.0
    short = round(0.4 / EYE_SAMPLE_S)
    assert count_flashes(np.tile(np.r_[np.zeros(short), np.ones(short)], 4), min_change=0.1) == 1.5


def test_light_that_only_ends_is_half_a_flash():
    """The first sample belongs to the signal: one turn from light to dark, none before it."""
    assert count_flashes(np.r_[1.0, np.zeros(50)], min_change=0.1) == 0.5
    assert count_flashes(np.r_[0.0, np.ones(50)], min_change=0.1) == 0.5
    assert count_flashes(np.ones(1), min_change=0.1) == 0.0


def test_flashes_at_their_limit_are_too_many():
    limits = dataclasses.replace(DOME.leds, max_flashes_per_s=3.0, max_flicker_rms=0.1)
    assert FlickerReport(2.5, 0.1, 1.0, 1.0).within(limits)
    assert not FlickerReport(3.0, 0.1, 1.0, 1.0).within(limits)
    assert not FlickerReport(2.5, 0.101, 1.0, 1.0).within(limits)


def test_average_over_fusion_keeps_steady_light():
    seen = average_over_flicker_fusion(np.full(200, 3.0))
    np.testing.assert_allclose(seen[50:150], 3.0)


def test_flicker_of_shortest_judged_duration_counts():
    """Halves of light and dark at 5 Hz, as long as the rms requires, and one sample less."""
    count = round(MIN_RMS_DURATION_S / 0.1)
    rows = [LedRow((0,), float(n % 2), 0.1) for n in range(count)]
    rows[-1] = dataclasses.replace(
        rows[-1], dwell_s=MIN_RMS_DURATION_S - sum(row.dwell_s for row in rows[:-1])
    )
    assert flicker_of_rows(rows, WEIGHTS).rms > 0.3
    rows[-1] = dataclasses.replace(rows[-1], dwell_s=rows[-1].dwell_s - EYE_SAMPLE_S)
    assert flicker_of_rows(rows, WEIGHTS).rms == 0.0


def test_overlap_of_lights_adds_to_their_exposure():
    """LEDs that come on before their row: each row but a piece's first is longer by that."""
    plan = dome_plan(DOME, tracking_interval=0)
    means = {
        overlap_s: flicker_report(
            plan,
            dataclasses.replace(
                DOME, leds=dataclasses.replace(DOME.leds, overlap_s=overlap_s, settle_s=0.01)
            ),
        ).mean_w_m2
        for overlap_s in (0.0, 0.004, 0.008)
    }
    added = means[0.004] - means[0.0]
    assert added > 0.0
    assert means[0.008] - means[0.0] == pytest.approx(2.0 * added, rel=1e-3)


def test_steady_light_has_no_flash():
    assert count_flashes(np.ones(500), min_change=0.1) == 0.0
    assert count_flashes(np.zeros(0), min_change=0.1) == 0.0
