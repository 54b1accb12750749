"""The flash rig's choice of frames, light and darks, on a small simulated face."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from capture.plan import Plan, flash_plan
from capture.rig import load_rig
from reconstruction.pipeline.flash.stages import load_skin_colors
from skinrig.cli import main
from skinrig.planning import flash, flash_observation, plans


@pytest.fixture(scope="module")
def rig():
    return load_rig("flash")


@pytest.fixture(scope="module")
def look(rig):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flash_observation, "TEXTURE_TEXELS", 128)
        return flash.simulate_observation(rig, "III", width_px=96)


@pytest.fixture
def small(monkeypatch, look):
    monkeypatch.setattr(flash, "simulate_observation", lambda *args, **kwargs: look)


@pytest.mark.long
def test_more_frames_and_darks_lower_error_to_model(look):
    def median(**settings):
        return flash.predict(look, **settings).median("melanin")

    dim = median(repeats=1, power=0.0625, darks=1)
    assert median(repeats=1, power=0.0625, darks=4) < dim
    assert median(repeats=4, power=0.0625, darks=1) < dim
    assert median(repeats=1, power=1.0, darks=1) < dim
    still = replace(look, gain=0.0, floor=0.0)
    floor = flash.predict(still, repeats=1, power=1.0, darks=0).median("melanin")
    assert floor < median(repeats=16, power=1.0, darks=4) < 1.2 * floor


@pytest.mark.long
def test_common_error_is_that_of_image(rig):
    table, _ = load_skin_colors(
        rig.views[0].spectral_sensitivity, rig.lights[0].illuminant, has_white=True
    )
    skin = np.ones((24, 24), bool)
    rng = np.random.default_rng(2)
    truth = {
        "melanin": 0.03 * np.exp(0.15 * rng.standard_normal(skin.shape)),
        "hemoglobin": 0.02 * np.exp(0.15 * rng.standard_normal(skin.shape)),
    }
    light = 0.7 * np.exp(0.1 * rng.standard_normal((*skin.shape, 1)))
    colors = light * table.lookup(truth["melanin"], truth["hemoglobin"])
    noise = 2e-3 * colors

    def common_error(seen, known):
        return flash_observation.estimate_face_bias(seen, noise, known, skin, rig)

    own = common_error(colors, truth)
    # a truth that is a tenth lower, and an image that is too yellow
    lower = common_error(colors, {name: 0.9 * value for name, value in truth.items()})
    assert lower["melanin"] == pytest.approx((1.0 + own["melanin"]) / 0.9 - 1.0)
    yellow = common_error(colors * [1.0, 1.0, 0.9], truth)
    assert yellow["melanin"] > own["melanin"] + 0.03


@pytest.mark.long
def test_four_frames_halve_noise_error(look):
    still = replace(look, gain=0.0, floor=0.0)

    def noise(repeats):
        every = {"power": 1.0, "darks": 0, "repeats": repeats}
        whole = flash.predict(look, **every)
        rest = flash.predict(still, **every)
        both = whole.valid["melanin"] & rest.valid["melanin"]
        return np.sqrt(whole.sigma["melanin"][both] ** 2 - rest.sigma["melanin"][both] ** 2)

    # noise and model error share their bound, so that a sum of squares holds only about
    assert np.median(noise(1) / noise(4)) == pytest.approx(2.0, rel=0.05)


@pytest.mark.long
def test_plan_omits_exposures_unneeded_for_wanted_errors(small, tmp_path, capsys):
    file = tmp_path / "plan.json"
    want = "melanin<=8%,hemoglobin<=20%"
    assert main(["plan", "flash", "--goals", want, "--out", str(file), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    plan = Plan.from_json(file.read_text())
    assert {step.index["polarizer"] for step in plan.steps} == {"crossed"}
    assert document["knobs"]["power"] < 1.0
    assert document["saved_seconds"] > 20.0
    assert all(one["median"] <= one["wanted"] for one in document["forecasts"])
    told = plans.format_choice(plans.choose("flash", want))  # figures as people read them
    assert not any(re.search(r"\d\.\d{5}|[{}_]", line) for line in told), told
    # half the light would not have been enough
    look = flash.simulate_observation(None, "III")
    power = document["knobs"]["power"] / 2
    dimmer = flash.predict(look, repeats=1, power=power, darks=0)
    assert dimmer.median("melanin") > 0.08 or dimmer.median("hemoglobin") > 0.2
    assert main(["plan", "flash", "--forecast", str(file), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    for one, other in zip(document["forecasts"], again["forecasts"], strict=True):
        assert other["median"] == pytest.approx(one["median"], rel=1e-9)


@pytest.mark.long
def test_dominant_model_error_does_not_request_more_frames(small, capsys):
    assert main(["plan", "flash", "--goals", "melanin<=1%"]) == 1
    said = capsys.readouterr().out
    assert "more frames will not help" in said
    assert "NOT REACHED" in said


@pytest.mark.long
def test_undetermined_hemoglobin_does_not_count_as_reached(small, rig, monkeypatch):
    seen = flash.predict

    def blind(*args, **settings):
        found = seen(*args, **settings)
        none = np.zeros_like(found.valid["hemoglobin"])
        return replace(found, valid={**found.valid, "hemoglobin": none})

    monkeypatch.setattr(flash, "predict", blind)
    told = flash.choose(rig, plans.PlanRequest({"hemoglobin": 20.0}))
    assert told.knobs["power"] == 1.0
    assert told.reasons
    assert not any("reaches" in why for _, why in told.left_out)


@pytest.mark.long
def test_plan_without_crossed_frames_or_foreign_is_refused(rig, small, tmp_path, capsys):
    whole = flash_plan(rig)
    bare = replace(
        whole, steps=tuple(s for s in whole.steps if s.index.get("polarizer") != "crossed")
    )
    with pytest.raises(plans.PlanningError, match="no crossed-polarized frame"):
        flash.forecast(rig, bare, plans.PlanRequest())
    file = tmp_path / "plan.json"
    file.write_text(json.dumps(whole.to_json()))
    assert main(["plan", "gradient", "--forecast", str(file)]) == 3
    assert "expected 'gradient'" in capsys.readouterr().err
    assert main(["plan", "flash", "--max-lights", "3"]) == 2


@pytest.mark.long
def test_chromophores_are_reconstructed_from_crossed_frames_alone(rig, tmp_path):
    from model import store
    from reconstruction.pipeline import recipes as pipeline
    from skinrig.calibrating.calibrate import calibrate
    from skinrig.simulating.simulation import simulate_session

    plan = flash.build_crossed_plan(rig, repeats=1, power=1.0, darks=0)
    simulate_session("flash", tmp_path / "session-white", target="white", width_px=128)
    calibrate("white", [tmp_path / "session-white"], tmp_path / "calibration")
    simulate_session("flash", tmp_path / "session-face", subject="II", width_px=128, plan=plan)
    pipeline.reconstruct(
        tmp_path / "session-face",
        want=("melanin",),
        out=tmp_path / "appearance",
        calibration=tmp_path / "calibration",
    )
    made = store.read(tmp_path / "appearance").maps["melanin"]
    assert made.valid.mean() > 0.1
    # the preset's melanin is 0.014; a face varies by tan, freckles and lips
    assert 0.005 < np.median(made.values[made.valid]) < 0.03
