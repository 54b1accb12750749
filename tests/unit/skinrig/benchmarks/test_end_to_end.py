"""Whole captures: ratios of forecasts, limits, and the choice of a rig."""

import json

import pytest

from capture.plan import flash_plan
from capture.rig import load_rig
from skinrig.benchmarks import end_to_end
from skinrig.benchmarks.document import to_document
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.benchmarks.table import NO_KNEE, list_knee_rows
from skinrig.cli import main
from skinrig.planning import confirmation, plans
from skinrig.reporting import report

BUDGETS_S = (20.0, 40.0, 80.0, 160.0)


def measured_case(error_factors, time_factor):
    """Return points of people whose errors and times are known multiples of the forecasts."""
    points = {}
    for budget_s in BUDGETS_S:
        point = end_to_end.MeasuredPoint()
        for factor in error_factors:
            expected = 100.0 / budget_s
            seconds = dict.fromkeys(end_to_end.RUN_PHASES, 0.25 * budget_s)
            point.forecast.append({"melanin": expected})
            point.measured.append({"melanin": factor * expected})
            point.inside.append({"melanin": factor < 1.0})
            point.forecast_s.append(seconds | {"total": budget_s})
            longer = {name: time_factor * value for name, value in seconds.items()}
            point.measured_s.append(longer | {"total": time_factor * budget_s})
        points[64, budget_s] = point
    return points


def run(monkeypatch, error_factors, time_factor=1.0):
    monkeypatch.setattr(
        end_to_end, "_measure_case", lambda *_: [measured_case(error_factors, time_factor)]
    )
    stage = BenchmarkStage("end-to-end", selection="flash")
    list(end_to_end.measure_end_to_end(stage))
    return stage.to_benchmark()


def test_forecast_ratio_is_geometric_mean(monkeypatch):
    found = run(monkeypatch, (0.5, 2.0), time_factor=1.1)
    error, seconds = found.limits
    assert error.got == pytest.approx(1.0)
    assert seconds.got == pytest.approx(1.1)
    assert error.passed
    assert seconds.passed


@pytest.mark.parametrize(("factors", "time_factor"), [((1.3, 1.3), 1.0), ((0.7, 0.7), 0.7)])
def test_wrong_forecast_misses_limit_either_way(monkeypatch, factors, time_factor):
    found = run(monkeypatch, factors, time_factor)
    assert not found.limits[0].passed
    assert found.limits[1].passed == (time_factor == 1.0)


def test_wide_forecast_is_judged_by_coverage(monkeypatch):
    case = end_to_end.EndToEndCase((), {}, by_coverage=True)
    monkeypatch.setattr(end_to_end, "CASES", {"flash": case})
    for factors, passed in (((0.5, 2.0), True), ((1.5, 2.0), False)):
        coverage, _ = run(monkeypatch, factors).limits
        assert coverage.got == pytest.approx(0.5 if passed else 0.0)
        assert coverage.passed == passed


def test_points_hold_total_seconds_and_mean_error(monkeypatch):
    found = run(monkeypatch, (0.5, 1.5), time_factor=2.0)
    assert [point.timing.seconds for point in found.points] == [2.0 * b for b in BUDGETS_S]
    first = found.points[0]
    assert first.error == pytest.approx(100.0 / BUDGETS_S[0])
    assert first.error_interval[0] < first.error < first.error_interval[1]
    assert first.extra_values["people"] == 2
    assert first.extra_values["inside the forecast's interval"] == 1
    assert first.extra_values["capture, s"] == pytest.approx(0.5 * BUDGETS_S[0])


@pytest.mark.parametrize("is_flat", [True, False])
def test_knee_of_each_curve_is_in_report(monkeypatch, tmp_path, is_flat):
    points = measured_case((0.5, 1.5), 1.0)
    if is_flat:  # from 80 s on; before, the error is inverse to the seconds
        points[64, 160.0].measured = points[64, 80.0].measured
    monkeypatch.setattr(end_to_end, "_measure_case", lambda *_: [points])
    stage = BenchmarkStage("end-to-end", selection="flash")
    list(end_to_end.measure_end_to_end(stage))
    document = to_document([stage.to_benchmark()])
    ((name, curve, count, knee, *_),) = list_knee_rows(document)
    assert (name, curve, count) == ("end-to-end", "rig=flash map=melanin", len(BUDGETS_S))
    assert knee == ("width=64 budget_s=80.0" if is_flat else NO_KNEE)
    document["stages"][name]["size"] = "full"
    (tmp_path / "bench.json").write_text(json.dumps(document))
    page = report.build([tmp_path / "bench.json"])
    assert f">{knee}<" in page
    assert "seconds from planning to maps" in page


@pytest.mark.parametrize("rig", end_to_end.CASES)
def test_smoke_run_measures_selected_rig(monkeypatch, rig):
    asked = []

    def measure_case(name, case):
        asked.append((name, len(case.people), [len(one) for one in case.budgets_s.values()]))
        return [measured_case((0.5,), 1.0)]

    monkeypatch.setattr(end_to_end, "_measure_case", measure_case)
    stage = BenchmarkStage("end-to-end", toy=True, smoke=True, selection=rig)
    list(end_to_end.measure_end_to_end(stage))
    assert asked == [(rig, 1, [2 if rig == "flash" else 1])]
    assert stage.to_benchmark().points[0].knobs["rig"] == rig


def test_interrupted_run_keeps_persons_measured_before(monkeypatch):
    one, two = measured_case((0.5,), 1.0), measured_case((0.5, 1.5), 1.0)
    monkeypatch.setattr(end_to_end, "_measure_case", lambda *_: iter([one, two]))
    stage = BenchmarkStage("end-to-end", selection="flash")
    people = [
        [point.extra_values["people"] for point in stage.points]
        for _ in end_to_end.measure_end_to_end(stage)
    ]
    assert people == [[1] * len(BUDGETS_S), [2] * len(BUDGETS_S)]


def test_calibration_is_of_persons_own_rig(monkeypatch):
    """The dome and the sphere as built depend on the seed of the person."""
    calibrated, captured = [], []

    def calibrate_simulated(rig, folder, targets, kinds, *, seed):
        calibrated.append((rig, seed, {one["session_seed"] for one in targets.values()}))

    def capture_choice(choice, folder, *, subject, seed):
        captured.append((subject, seed))
        return confirmation.RehearsedCapture({"melanin": (4.0, 1.0)}, 6.0, 7.0)

    monkeypatch.setattr(end_to_end, "calibrate_simulated", calibrate_simulated)
    monkeypatch.setattr(end_to_end, "calibrate", lambda *args: None)
    monkeypatch.setattr(end_to_end, "capture_choice", capture_choice)
    rig = load_rig("flash").resized(64)
    one, other = (
        plans.PlanChoice(rig, flash_plan(rig, repeats=count), (), 0.0, {}, ()) for count in (1, 2)
    )
    found = list(end_to_end.measure_choices(("IV", 37), [one, other, one], 5.0, 9))
    # its three targets once each, for both plans
    assert calibrated == [("flash", 37, {9})] * 3
    assert captured == [("IV", 37)] * 2  # equal plans once
    assert [row.times.plan_s for row in found] == [5.0] * 3
    assert found[0] is found[2]


def test_bench_command_measures_selected_rig(monkeypatch, capsys):
    asked = {}

    def measured(names, **options):
        asked.update(names=names, **options)
        return {"schema": "skinrig.bench/2", "passed": True}

    monkeypatch.setattr("skinrig.benchmarks.stages.run_stages", measured)
    assert main(["bench", "--end-to-end", "flash"]) == 0
    assert (asked["names"], asked["selection"]) == (["end-to-end"], "flash")
    assert main(["bench", "--end-to-end", "flash", "--stage", "hdr"]) == 2
    assert main(["bench", "--end-to-end", "flash", "--extremes"]) == 2


def test_unknown_rig_is_reported_with_known_ones(capsys):
    assert main(["bench", "--end-to-end", "moon"]) == 3
    assert "flash" in capsys.readouterr().err
