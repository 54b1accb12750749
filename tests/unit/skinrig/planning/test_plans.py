"""Targets of a plan, and the dome's own choice."""

import dataclasses
import json
import math

import numpy as np
import pytest

from capture.plan import Plan, flash_plan
from capture.rig import load_rig
from reconstruction.photometric_stereo import light_selection
from skinrig.cli import main
from skinrig.planning import dome, dome_observation, plans


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("normal<=1deg", "did you mean normals"),
        ("normals<1", "NUMBERdeg"),
        ("normals<=1%", "expected deg"),
        ("normals<=0deg", "above 0"),
        ("normals<=--deg", "above 0"),
        ("normals<=1deg,normals<=2deg", "twice"),
    ],
)
def test_invalid_want_is_reported(text, word):
    with pytest.raises(plans.PlanningError, match=word):
        plans.parse_goals(text, "dome")


def test_invalid_wanted_number_is_reported_as_written():
    with pytest.raises(plans.PlanningError, match="got melanin<=0%, expected above 0"):
        plans.parse_goals("melanin<=0%", "flash")


def test_errors_by_site_are_reported_with_colors():
    rig = load_rig("flash")
    knobs = {plans.PERCENT_BY_SITE: {"chin": [0.444, 1.399, math.inf]}}
    choice = plans.PlanChoice(rig, flash_plan(rig), (), 2.0, knobs, ())
    told = plans.format_choice(choice)
    assert "percent by site: chin red 0.444 %, green 1.4 %, blue unknown" in told


def test_rig_without_own_plans_is_reported(capsys):
    assert main(["plan", "moon", "--goals", "normals<=1deg"]) == 3
    assert "expected one of dome" in capsys.readouterr().err


def test_quantity_without_estimate_is_reported_without_infinite_error():
    rig = load_rig("flash")
    told = plans.Forecast("hemoglobin", "%", math.inf, (math.inf, math.inf), 20.0)
    choice = plans.PlanChoice(rig, flash_plan(rig), (told,), 2.0, {}, ())
    first = plans.format_choice(choice)[0]
    assert "inf" not in first
    assert "hemoglobin has no valid estimate" in first
    assert "wanted 20 %: NOT REACHED" in first


@pytest.fixture(scope="module")
def rig():
    return load_rig("dome").resized(320)


@pytest.fixture(scope="module")
def look(rig):
    return dome_observation.simulate_observation(rig, "III", points=300)


def test_backlights_reach_no_point_facing_forward(rig, look):
    ahead = look.normals[:, 2] > 0.95
    behind = [k for k, light in enumerate(rig.lights) if light.position_mm[2] < -300]
    told = look.information(range(len(rig.views))).weight
    assert behind
    assert not told[np.ix_(ahead, behind)].any()
    assert told[ahead].any()


def test_darker_skin_and_fewer_cameras_raise_error(rig, look):
    dark = dome_observation.simulate_observation(rig, "VI", points=300)
    every = look.information(range(16)).weight.sum()
    assert dark.information(range(16)).weight.sum() < every
    assert look.information(range(4)).weight.sum() < every


@pytest.mark.long
def test_albedo_forecast_uses_subject_detail_and_specular(rig, look):
    """Coarser pixels and darker skin, where the same gloss is more, leave more error."""
    every = range(len(rig.views)), range(len(rig.lights))

    def forecast(sight):
        told = light_selection.predict_errors(sight.information(every[0]), every[1], min_lights=10)
        return dome._r_d_error(told, sight)

    assert look.unresolved.shape == look.r_d.shape == (300, 3)
    assert 0.015 < forecast(look) < 0.03
    assert forecast(dome_observation.simulate_observation(rig, "VI", points=300)) > 1.1 * forecast(
        look
    )
    fine = dome_observation.simulate_observation(rig.resized(1300), "III", points=300)
    assert np.abs(fine.unresolved).mean() < 0.6 * np.abs(look.unresolved).mean()
    assert forecast(fine) < 0.75 * forecast(look)
    even = dataclasses.replace(look, unresolved=0.0 * look.unresolved)
    assert forecast(even) < 0.6 * forecast(look)


def test_median_of_offset_errors_matches_draws(rng):
    offset, sigma = rng.normal(0.0, 0.02, (400, 3)), rng.uniform(0.005, 0.03, (400, 3))
    drawn = np.abs(offset + sigma * rng.standard_normal((500, 400, 3)))
    assert plans.median_magnitude(sigma, offset) == pytest.approx(np.median(drawn), rel=0.01)


@pytest.mark.long
def test_plan_keeps_promised_error_and_reports_omissions(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(dome_observation, "FACE_POINTS", 300)
    file = tmp_path / "plan.json"
    code = main(
        [
            "plan",
            "dome",
            "--goals",
            "normals<=1.5deg",
            "--width",
            "320",
            "--out",
            str(file),
            "--json",
        ]
    )
    document = json.loads(capsys.readouterr().out)
    assert code == 0
    assert document["schema"] == plans.SCHEMA
    assert document["reached"]
    plan = Plan.from_json(file.read_text())
    lit = {step.index["light"] for step in plan.steps if step.kind == "olat"}
    assert lit == set(document["knobs"]["lights"])
    assert len(lit) < 150
    assert document["saved_seconds"] > 0
    assert any("lights" in what for what, _ in document["left_out"])
    assert any("% of the light" in size for _, size in document["unmodeled"])
    assert document["light"]["flashes_per_s"] < 3
    # the inverse question gives the same answer
    assert main(["plan", "dome", "--forecast", str(file), "--width", "320", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    for one, other in zip(document["forecasts"], again["forecasts"], strict=True):
        assert other["median"] == pytest.approx(one["median"], rel=1e-9)


def test_unreachable_target_reports_reason(capsys, monkeypatch):
    monkeypatch.setattr(dome_observation, "FACE_POINTS", 200)
    assert (
        main(
            ["plan", "dome", "--goals", "normals<=0.05deg", "--width", "320", "--max-lights", "25"]
        )
        == 1
    )
    said = capsys.readouterr().out
    assert "NOT REACHED" in said
    assert "use more pixels" in said
