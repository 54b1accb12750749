"""The gradient sphere's choice of patterns and exposures, on a small patch of simulated skin."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from capture.plan import Plan
from capture.plan.gradient import gradient_plan
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import load_rig
from model.vectors import unit_vectors
from skinrig.cli import main
from skinrig.planning import gradient, plans
from skinrig.planning.gradient import PATTERN_SETS, GradientScanSettings


@pytest.fixture(scope="module")
def rig():
    return load_rig("gradient")


@pytest.fixture(scope="module")
def look(rig):
    return gradient.simulate_observation(rig, "III", side_px=40)


@pytest.fixture
def small(monkeypatch, look):
    monkeypatch.setattr(gradient, "simulate_observation", lambda *args, **kwargs: look)
    monkeypatch.setattr(gradient, "EXPOSURE_CHOICES", (0.25, 1.0))


@pytest.mark.long
def test_complements_and_longer_exposures_lower_the_error(look):
    def median(patterns, exposure_s):
        return gradient.predict(look, GradientScanSettings(patterns, exposure_s, 2)).median_rad

    least = median(PATTERN_SETS[0], 0.009)
    assert median(PATTERN_SETS[0], 0.018) < least
    assert median(PATTERN_SETS[1], 0.009) < least


def test_quickest_scan_reaching_error_is_chosen(small, tmp_path, capsys):
    file = tmp_path / "plan.json"
    assert (
        main(["plan", "gradient", "--goals", "normals<=2.5deg", "--out", str(file), "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    plan = Plan.from_json(file.read_text())
    assert document["reached"]
    assert {step.index["pattern"] for step in plan.steps} < set(LIGHT_PATTERNS)
    assert any("complement" in why for _, why in document["left_out"])
    # what was tried before, and is quicker, did not reach it
    *before, last = document["path"]
    assert last["normals_deg"] <= 2.5
    assert all(one["normals_deg"] > 2.5 and one["seconds"] <= last["seconds"] for one in before)
    assert main(["plan", "gradient", "--forecast", str(file), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["forecasts"][0]["median"] == pytest.approx(last["normals_deg"], rel=1e-9)


@pytest.mark.long
def test_budget_chooses_least_error_within_time(small, rig):
    found = gradient.choose(rig, plans.PlanRequest(budget_s=60.0))
    assert found.run_times["total"] <= 60.0
    assert found.medians["normals"] == pytest.approx(min(p["normals"] for p in found.path))
    least_s = min(path["total_s"] for path in found.path)
    short = gradient.choose(rig, plans.PlanRequest(budget_s=least_s + 0.01))
    assert short.seconds < found.seconds
    assert short.medians["normals"] > found.medians["normals"]


def test_unreachable_error_reports_reason(small, capsys, monkeypatch):
    monkeypatch.setattr(gradient, "PATTERN_SETS", PATTERN_SETS[:1])
    monkeypatch.setattr(gradient, "EXPOSURE_CHOICES", (1.0,))
    assert main(["plan", "gradient", "--goals", "normals<=0.1deg"]) == 1
    said = capsys.readouterr().out
    assert "the best scan leaves" in said
    assert "imaged by the lens" in said


def test_saturating_or_overloading_exposures_are_not_candidates(rig, look):
    bright = replace(look, rates={key: 1000.0 * rate for key, rate in look.rates.items()})
    assert not list(gradient.generate_candidates(rig, bright))
    seconds = [plan.estimate_duration_s(rig) for _, plan in gradient.generate_candidates(rig, look)]
    assert seconds == sorted(seconds)
    assert len(seconds) > 10


def test_patterns_not_determining_gradient_are_refused(rig):
    plan = gradient_plan(rig, angles=[0], steps=(0, 0), patterns=("full", "x", "y"))
    with pytest.raises(plans.PlanningError, match="z or -z"):
        gradient.read_settings(plan)


@pytest.mark.long
def test_normals_from_four_patterns_match_forecast_error(rig, tmp_path):
    from reconstruction.gradient_normals.estimation import estimate_roughness, from_patterns
    from reconstruction.normal_histogram.relief_slopes import slopes
    from reconstruction.normal_integration import integrate_map

    look = gradient.simulate_observation(rig, "III", seed=3, side_px=96)
    setting = GradientScanSettings(PATTERN_SETS[0], 0.018, 0)
    found = gradient.predict(look, setting)
    rng = np.random.default_rng(1)
    gain, floor = look.chip.noise_profile(setting.exposure_s)
    values, variance = {}, {}
    for key in look.rates:
        if key[0] in setting.patterns:
            light = setting.exposure_s * look.rates[key].astype(float)
            variance[key] = gain * np.maximum(light, 0) + floor
            values[key] = light + np.sqrt(variance[key]) * rng.standard_normal(light.shape)
    alpha = estimate_roughness(
        values,
        lights=look.known["lights"],
        view=look.known["view"],
        variance=variance,
        smooth_px=1.0,
    )
    made = from_patterns(values, variance=variance, smoothing="wiener", alpha=alpha, **look.known)
    # the normals of one continuous surface, as sessions have them
    surface = integrate_map(made.normals, valid=made.valid, stderr_rad=made.stderr_rad)
    x, y, _ = slopes(surface.height, pixel=1.0, valid=surface.valid)
    normals = unit_vectors(np.stack([-x, -y, np.ones_like(x)], axis=-1))
    inner = (slice(6, -6),) * 2
    cosine = np.sum(normals[inner] * look.seen[inner], axis=-1)
    error = np.arccos(np.clip(cosine, -1.0, 1.0))[made.valid[inner]]
    # the stated spread of forecasts
    ratio = float(np.median(error)) / found.median_rad
    spread = gradient.FORECAST_RELATIVE_SD["normals"]
    assert 1.0 / (1.0 + spread) < ratio < 1.0 + spread, math.degrees(found.median_rad)
