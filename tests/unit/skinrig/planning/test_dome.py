"""Plans of the dome within a time: nested sets of lights and cameras, and their forecasts."""

import dataclasses
import itertools

import numpy as np
import pytest

from capture.plan.dome import DOME_EXPOSURES_S, dome_plan
from capture.plan.rows import step_lights
from capture.rig import load_rig
from skinrig.planning import dome, dome_observation, plans, time_budget
from skinrig.simulating.dome import plan_capture
from skinrig.simulating.orders import DomeOrder

WIDTH_PX = 200
LONG_S, SHORT_S = DOME_EXPOSURES_S


@pytest.fixture(scope="module")
def rig():
    return load_rig("dome").resized(WIDTH_PX)


@pytest.fixture(scope="module")
def look(rig):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dome_observation, "TEXTURE_TEXELS", 128)
        return dome_observation.simulate_observation(rig, "III", points=150)


@pytest.fixture
def small(monkeypatch, look):
    """Few candidates, on a face of few points."""
    monkeypatch.setattr(dome, "simulate_observation", lambda *args, **kwargs: look)
    monkeypatch.setattr(dome, "LIGHT_COUNTS", (12, 24, 48))
    monkeypatch.setattr(dome, "VIEW_COUNTS", (4, 8))


def test_longer_time_buys_lights_and_lowers_error(small, rig):
    everything = dome.choose(rig, plans.PlanRequest(budget_s=1e4))
    totals = [step["total_s"] for step in everything.path]
    short = dome.choose(rig, plans.PlanRequest(budget_s=float(np.quantile(totals, 0.4))))
    assert len(everything.path) == 12  # 3 numbers of lights, 2 of cameras, 1 or 2 exposures
    assert 0 < len(short.path) < 6
    assert short.run_times["total"] <= np.quantile(totals, 0.4)
    assert short.run_times["capture"] == pytest.approx(short.seconds)
    assert len(short.rig.lights) < len(everything.rig.lights)
    assert all(median < short.medians[name] for name, median in everything.medians.items())
    offered = list(dome.generate_choices(rig, plans.PlanRequest(), lambda *_: True))
    most = max(one.knobs["valid_share"] for one in offered)
    enough = [one for one in offered if one.knobs["valid_share"] >= 0.9 * most]
    assert len(enough) < len(offered)
    least = min(time_budget.combine_errors(one.medians) for one in enough)
    assert time_budget.combine_errors(everything.medians) == pytest.approx(least)
    assert any("exceeds the budget" in why for _, why in short.left_out)


def test_candidates_are_nested_and_match_their_plans(small, rig, look):
    found = list(dome.generate_candidates(rig, look))
    frames = [len(setting.lights) * len(setting.exposures_s) for setting, _, _ in found]
    assert frames == sorted(frames)
    for setting, reduced, plan in found:
        olat = [step for step in plan.steps if step.kind == "olat"]
        assert {name for step in olat for name in step_lights(step)} == {
            rig.lights[k].name for k in setting.lights
        }
        assert set(olat[0].cameras) == {rig.views[k].name for k in setting.views}
        assert {step.settings["exposure_s"] for step in olat} == set(setting.exposures_s)
        # the order of the lights is that of the least flicker, also where it is reused
        assert plan == dome_plan(reduced, exposures_s=setting.exposures_s)
    for kind in ("lights", "views"):
        sets = sorted({frozenset(getattr(setting, kind)) for setting, _, _ in found}, key=len)
        assert all(few < many for few, many in itertools.pairwise(sets))


def test_maximum_number_of_lights_is_kept(small, rig, look):
    most = max(len(one[0].lights) for one in dome.generate_candidates(rig, look, 20))
    assert most == 20


def test_first_cameras_observe_most_points_in_pairs(look):
    """Two cameras alone observe most points; a third observes the most samples, but alone."""
    seen = np.zeros((10, 4), bool)
    seen[:6, [1, 3]] = True
    seen[6:, [0]] = True
    seen[6:8, [2]] = True
    usable = np.zeros((10, 5, 4), bool)
    usable[:, :, 0] = True
    usable[:6, :, 1] = usable[:6, :, 3] = True
    ranked = dome.rank_views(dataclasses.replace(look, seen=seen, usable=usable))
    assert set(ranked[:2]) == {1, 3}
    assert sorted(ranked) == [0, 1, 2, 3]
    # without pairs the number of samples decides
    alone = dataclasses.replace(look, seen=np.eye(10, 4, dtype=bool), usable=usable)
    assert dome.rank_views(alone)[0] == 0


def test_information_adds_over_exposures_and_cameras(look):
    """Shot and read noise in closed form, and an error per light that cameras share."""
    views = [k for k in range(16) if look.usable[..., k].any()][:5]
    weight = look.information(views, (LONG_S,)).weight
    point, light = np.argwhere(weight > 0)[7]
    cameras = look.usable[point, light, views].sum()
    electrons = look.rate[point, light] * LONG_S * look.full_well_e
    noise = (electrons + look.read_noise_e**2) / electrons**2 / cameras
    assert weight[point, light] == pytest.approx(1.0 / (noise + dome.LIGHT_ERROR**2))
    both = look.information(views).weight
    lit = weight > 0
    assert (both[lit] > weight[lit]).all()
    assert (look.information(views[:3], (LONG_S,)).weight[lit] <= weight[lit]).all()
    # too bright for the long exposure: the short one alone has information
    bright = dataclasses.replace(look, rate=look.rate * 0.96 / LONG_S / look.rate[point, light])
    assert bright.information(views, (LONG_S,)).weight[point, light] == 0.0
    assert bright.information(views).weight[point, light] > 0.0


def test_forecast_of_plan_uses_its_exposures(small, rig):
    names = [light.name for light in rig.lights if light.position_mm[2] > 0.0][:24]
    reduced = rig.subset(lights=names, views=[view.name for view in rig.views[:4]])
    errors = {}
    for exposures_s in ((LONG_S,), (SHORT_S,), DOME_EXPOSURES_S):
        plan = dome_plan(reduced, exposures_s=exposures_s)
        found = dome.forecast(rig, plan, plans.PlanRequest())
        assert found.knobs["exposures_s"] == list(exposures_s)
        errors[exposures_s] = found.medians["normals"]
    assert errors[DOME_EXPOSURES_S] < errors[LONG_S,] < errors[SHORT_S,]


def test_confirmation_calibrates_all_cameras_with_planned_lights(small, rig, tmp_path):
    """Cameras of a small plan need not share a pose of the board."""
    choice = dome.choose(rig, plans.PlanRequest(budget_s=1e4))
    few = {view.name for view in choice.rig.views}
    assert len(few) < len(rig.views)
    cameras = {}
    for target, options in dome.describe_rehearsal(choice).targets.items():
        order = DomeOrder(out=tmp_path / "session-target", target=target, **options)
        targets, plan = plan_capture(order)
        assert targets.views[0].width_px == WIDTH_PX
        cameras[target] = {name for step in plan.steps for name in step.cameras}
    assert cameras == {"charuco": {view.name for view in rig.views}, "mirror": few, "white": few}


def test_plan_of_few_lights_is_refused(rig):
    reduced = rig.subset(lights=[light.name for light in rig.lights[:9]])
    with pytest.raises(plans.PlanningError, match="got 9 lights and 16 cameras"):
        dome.forecast(rig, dome_plan(reduced), plans.PlanRequest())
    with pytest.raises(plans.PlanningError, match="got 9 lights"):
        dome.choose(reduced, plans.PlanRequest(budget_s=60.0))
