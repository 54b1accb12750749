"""The fiber probe's choice of exposures, placements and sites, on a simulated medium."""

import json
from dataclasses import replace

import numpy as np
import pytest

from capture.plan import Plan
from capture.plan.probe import exposure_series_s, probe_plan
from capture.rig import load_rig
from skinrig.cli import main
from skinrig.planning import plans, probe, probe_forecast, probe_observation
from skinrig.planning.probe import ProbeSettings

SITES = ("forehead", "cheek")


@pytest.fixture(scope="module")
def rig():
    return load_rig("probe")


@pytest.fixture(scope="module")
def look(rig):
    return probe.simulate_observation(rig, "homogeneous:0.05,1.2", sites=SITES)


@pytest.fixture
def small(monkeypatch, look):
    monkeypatch.setattr(probe, "simulate_observation", lambda *args, **kwargs: look)
    monkeypatch.setattr(probe, "BRACKET_CHOICES", (3, 6))
    monkeypatch.setattr(probe, "LONGEST_EXPOSURE_CHOICES_S", (0.5, 4.0))


@pytest.mark.long
def test_longer_exposures_and_placements_approach_common_error(look):
    def sigma(*exposures_s, repeats=1, darks=2):
        found = probe.predict(look, ProbeSettings(SITES, exposures_s, repeats, darks))
        assert (found.sigma >= found.common).all()
        return np.median(found.sigma)

    short = sigma(0.00115, 0.01)
    assert sigma(0.00115, 0.01, 0.1) < short
    assert sigma(0.00115, 0.01, repeats=4) < short
    assert sigma(0.00115, 0.01, darks=1) > short


@pytest.mark.long
def test_fits_shared_by_plans_keep_forecast_bit_exactly(look):
    memory = {}
    settings = [
        ProbeSettings(SITES, exposures_s, repeats, darks)
        for exposures_s in ((0.00115, 0.01), (0.00115, 0.1))
        for repeats in (1, 4)
        for darks in (1, 2)
    ]
    for setting in settings:
        alone, shared = (probe.predict(look, setting, memory=kept) for kept in (None, memory))
        for name in ("sigma", "common", "misfit", "valid"):
            np.testing.assert_array_equal(getattr(shared, name), getattr(alone, name))
    # placements share all fits, and fits without noise those of all darks and times
    assert len(memory) < len(settings)


def test_interval_is_wide_when_fits_share_error():
    shape = (12, 3)
    every, one = np.ones(shape, bool), np.full(shape, 0.01)
    told = (one, every, np.ones(12, bool))

    def ends(shared):
        sigma, valid, measured = told
        still = np.zeros(shape)
        found = probe.ProbePrediction(("x",) * 12, sigma, still, shared, sigma, valid, measured)
        return np.array(found.interval()) / found.median

    # one error alone: |z| over its median 0.6745, of which 68 % lie between 0.299 and 2.083
    # (|z| of 0.2019 and 1.4051), and what is not known of it beforehand
    known = np.log(1.0 + probe_forecast.FORECAST_RELATIVE_SD)
    exact = np.exp([-1.0, 1.0] * np.hypot(np.log([0.2019 / 0.6745, 1.4051 / 0.6745]), known))
    np.testing.assert_allclose(ends(one[None]), exact, rtol=0.04)
    low, high = ends(np.zeros((0, *shape)))
    assert 0.7 < low < 1.0 < high < 1.4


@pytest.mark.long
def test_reading_variance_follows_photons_and_saturation(look):
    series = exposure_series_s()
    skin = look.reflectance[0]
    assert np.isfinite(probe_observation.reading_variance(look, skin, series, 2, 1.0)).all()
    # shorter than the shortest exposure would be needed for so much light
    assert np.isinf(probe_observation.reading_variance(look, 1e3 * skin, series, 2, 1.0)).any()
    dim, four = (
        np.sqrt(probe_observation.reading_variance(look, share * skin, series[:6], 2, 1.0)) / share
        for share in (0.01, 0.04)
    )
    # four times the light: twice as precise by photons, four times by read noise
    assert (dim / four > 1.99).all()
    assert (dim / four < 4.01).all()


@pytest.mark.long
def test_quickest_plan_reaching_error_omits_exposures(small, tmp_path, capsys):
    file = tmp_path / "plan.json"
    assert main(["plan", "probe", "--goals", "sigma_tr<=4%", "--out", str(file), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    plan = Plan.from_json(file.read_text())
    assert document["reached"]
    assert document["saved_seconds"] > 60.0
    assert any("exposures" in what for what, _ in document["left_out"])
    assert document["path"][-1]["seconds"] <= plan.estimate_duration_s(load_rig("probe")) + 1e-6
    assert main(["plan", "probe", "--forecast", str(file), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["forecasts"][0]["median"] == pytest.approx(document["forecasts"][0]["median"])


@pytest.mark.long
def test_budget_lowers_error_and_keeps_time(small, rig):
    times = []
    for budget_s in (40.0, 60.0, 120.0):
        found = probe.choose(rig, plans.PlanRequest(budget_s=budget_s))
        assert found.run_times["total"] <= budget_s
        assert found.run_times["capture"] == pytest.approx(found.seconds)
        assert found.medians["sigma_tr"] == pytest.approx(min(p["sigma_tr"] for p in found.path))
        times.append((found.medians["sigma_tr"], found.seconds))
    assert times[0][0] > times[-1][0]
    assert times[0][1] < times[-1][1]


@pytest.mark.long
def test_certificate_limit_reports_more_exposures_will_not_help(small, capsys):
    assert main(["plan", "probe", "--goals", "sigma_tr<=0.001%"]) == 1
    said = capsys.readouterr().out
    assert "will not help" in said
    assert "certificate" in said


@pytest.mark.long
def test_site_is_omitted_only_if_others_determine_quantity(look):
    setting = ProbeSettings(SITES, exposure_series_s(), 1, 2)
    plan = probe_plan(load_rig("probe"), sites=SITES)

    def least(limit):
        def good(found):
            left = found.sigma[~found.measured]
            return not left.size or float(np.median(left)) <= limit

        return probe.remove_sites(look, setting, plan, good)

    kept, whole = least(1e-3)
    assert kept.sites == SITES
    assert len(whole.steps) == len(plan.steps)
    kept, fewer = least(10.0)
    assert len(kept.sites) == 1
    assert probe.read_settings(fewer).sites == kept.sites


@pytest.mark.long
def test_plans_without_skin_or_darks_are_refused(rig):
    plan = probe_plan(rig, sites=SITES)
    for kind, word in (("fibers", "no series on skin"), ("dark", "no dark frame")):
        some = replace(plan, steps=tuple(s for s in plan.steps if s.kind != kind))
        with pytest.raises(plans.PlanningError, match=word):
            probe.read_settings(some)
