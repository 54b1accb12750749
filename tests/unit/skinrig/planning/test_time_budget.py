"""Choice of a plan within a time from planning to maps."""

import json
from dataclasses import replace

import pytest

from capture.plan import flash_plan
from capture.plan.gradient import gradient_plan
from capture.plan.probe import probe_plan
from capture.rig import load_rig
from skinrig.cli import main
from skinrig.planning import flash, flash_observation, plans, time_budget

REPEATS = (1, 2, 4, 8)
WIDTH_PX = 96


@pytest.fixture(scope="module")
def rig():
    return load_rig("flash").resized(WIDTH_PX)


@pytest.fixture
def generate(rig):
    """Plans whose error halves with each doubling of frames; one has hardly any valid pixel."""

    def generate_choices(rig, request, is_affordable):
        for repeats in REPEATS:
            plan = flash_plan(rig, repeats=repeats)
            error = plans.Forecast("melanin", "%", 8.0 / repeats, (1.0, 9.0), None)
            share = {"melanin": 0.1 if repeats == 4 else 0.9}
            if is_affordable(rig, plan):
                yield plans.PlanChoice(rig, plan, (error,), 0.0, {"valid_share": share}, ())

    return generate_choices


def total_s(rig, repeats):
    return time_budget.forecast_run_times(rig, flash_plan(rig, repeats=repeats)).total_s


@pytest.mark.parametrize("text", ["60", "s", "1h", "60 sec", "-5s", "0s", "1e999s", "--s"])
def test_budget_without_positive_time_is_refused(text):
    with pytest.raises(plans.PlanningError, match="--budget: got"):
        time_budget.parse_budget(text)


@pytest.mark.parametrize(("most", "expected"), [(1, 1), (2, 2), (4, 2), (8, 8)])
def test_choice_has_least_error_within_budget(rig, generate, most, expected):
    # four frames are excluded by their few valid pixels
    request = plans.PlanRequest(budget_s=total_s(rig, most))
    found = time_budget.choose_within_budget(generate, rig, request)
    assert found.medians == {"melanin": 8.0 / expected}
    assert found.run_times["total"] == pytest.approx(total_s(rig, expected))
    assert len(found.path) == REPEATS.index(most) + 1
    assert [step["total_s"] for step in found.path] == sorted(s["total_s"] for s in found.path)


def test_insufficient_budget_error_states_sufficient_one(rig, generate):
    with pytest.raises(plans.PlanningError, match=r"expected at least (\d+) s") as error:
        time_budget.choose_within_budget(generate, rig, plans.PlanRequest(budget_s=1.0))
    least_s = float(str(error.value).split("at least ")[1].split(" ")[0])
    assert least_s - 1.0 < total_s(rig, 1) <= least_s
    assert time_budget.choose_within_budget(generate, rig, plans.PlanRequest(budget_s=least_s))


def test_probe_is_not_advised_narrower_images():
    """The probe's command has no width."""
    for name, advised in (("probe", False), ("flash", True)):
        rig = load_rig(name)

        def offer(rig, _, is_affordable, name=name):
            assert not is_affordable(rig, probe_plan(rig) if name == "probe" else flash_plan(rig))
            return ()

        with pytest.raises(plans.PlanningError, match="raise it") as error:
            time_budget.choose_within_budget(offer, rig, plans.PlanRequest(budget_s=1.0))
        assert str(error.value).endswith("or lower --width") is advised


@pytest.mark.parametrize(("width_px", "states"), [(128, False), (256, False), (1024, True)])
def test_seconds_at_other_widths_are_assumption(width_px, states):
    rig = load_rig("gradient").cropped(width_px)
    error = plans.Forecast("normals", "deg", 1.0, (0.8, 1.2), None)
    one = plans.PlanChoice(rig, gradient_plan(rig), (error,), 0.0, {"valid_share": 1.0}, ())
    found = time_budget.choose_within_budget(lambda *_: [one], rig, plans.PlanRequest(budget_s=1e6))
    assert any("are an assumption" in line for line in plans.format_choice(found)) is states


def test_run_times_are_linear_in_frame_pixels(rig):
    seconds = time_budget._read_run_times()["flash"]["reconstruct"]
    one, two, wide = (
        time_budget.forecast_run_times(sized, flash_plan(sized, repeats=repeats))
        for sized, repeats in ((rig, 1), (rig, 2), (load_rig("flash").resized(2 * WIDTH_PX), 1))
    )
    view = rig.views[0]
    megapixels = view.width_px * view.height_px * 1e-6
    # two more frames per repeat, one per polarization
    more = 2 * megapixels * seconds["frame_megapixel_s"]
    assert two.reconstruct_s - one.reconstruct_s == pytest.approx(more)
    linear = one.reconstruct_s - seconds["fixed_s"]
    assert wide.reconstruct_s - seconds["fixed_s"] == pytest.approx(4.0 * linear)
    assert wide.capture_s == one.capture_s < two.capture_s
    assert one.total_s == pytest.approx(sum(one.by_phase().values()) / 2.0)


@pytest.mark.long
def test_plan_command_keeps_budget(monkeypatch, rig, tmp_path, capsys):
    monkeypatch.setattr(flash_observation, "TEXTURE_TEXELS", 128)
    look = flash.simulate_observation(rig, "III", width_px=WIDTH_PX)
    monkeypatch.setattr(flash, "simulate_observation", lambda *args, **kwargs: look)
    errors, totals = [], []
    for budget in ("30s", "1min"):
        argv = ["plan", "flash", "--budget", budget, "--width", str(WIDTH_PX), "--json"]
        assert main(argv) == 0
        document = json.loads(capsys.readouterr().out)
        errors.append([one["median"] for one in document["forecasts"]])
        totals.append(document["run_times"]["total"])
        assert document["run_times"]["capture"] == pytest.approx(document["seconds"])
        assert all(step["total_s"] <= time_budget.parse_budget(budget) for step in document["path"])
    assert totals[0] <= 30.0 < totals[1] <= 60.0
    # noise of the smallest images is below the error that no frame lowers
    assert all(long <= short for short, long in zip(*errors, strict=True))
    few = replace(look, gain=100.0 * look.gain)
    monkeypatch.setattr(flash, "simulate_observation", lambda *args, **kwargs: few)
    noisy = [
        flash.choose(rig, plans.PlanRequest(budget_s=seconds)).medians["melanin"]
        for seconds in (30.0, 60.0)
    ]
    assert noisy[1] < 0.9 * noisy[0]


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["flash", "--budget", "60s", "--goals", "melanin<=9%"], 2, "together with --goals"),
        (["flash", "--budget", "60s", "--bands", "460"], 2, "together with --bands"),
        (["flash", "--budget", "60"], 2, "add the unit"),
        (["flash", "--budget", "0s"], 3, "above 0"),
        (["dome", "--budget", "60s", "--goals", "normals<=1deg"], 2, "together with --goals"),
    ],
)
def test_plan_command_refuses_unusable_budget(argv, code, words, capsys):
    assert main(["plan", *argv]) == code
    assert words in capsys.readouterr().err
