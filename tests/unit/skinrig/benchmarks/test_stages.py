"""Budget of a run, on stages with a simulated clock."""

import csv
import json
from types import SimpleNamespace

import pytest

from skinrig.benchmarks import plan as bench_plan
from skinrig.benchmarks import stage as bench_stage
from skinrig.benchmarks import stages as bench_stages
from skinrig.benchmarks import table as bench_table
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.console import Console, to_json_value
from skinrig.errors import MissingExtra

NAMES = ("a", "b", "c")


def stage(name, calls, seconds=0.0, error=None):
    def run(stage):
        clock.now += seconds * (0.01 if stage.toy else 1.0)
        calls.append((name, "small" if stage.toy else "full"))
        if error is not None:
            raise error
        for n in (1.0, 2.0, 4.0, 8.0):
            outcome = ErrorEstimate(8 / n**2, (7 / n**2, 9 / n**2), 1 / n)
            s = n + 1.0  # no power of n, so that the front bends
            stage.add({"n": n}, Timing(s, (s, s), 3.0 * n + 1.0, 1.0), outcome)
        stage.limits["kept at full size"] = 2.0 if stage.toy else 0.5

    return run


clock = SimpleNamespace(now=0.0)
costs = {"a": 100.0, "b": 10.0, "c": 50.0}


@pytest.fixture
def calls(monkeypatch):
    made = []
    functions = {name: stage(name, made, costs[name]) for name in NAMES}
    clock.now = 0.0
    monkeypatch.setattr(bench_stages.time, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(bench_stages, "STAGES", {n: f"x.{n}" for n in NAMES})
    monkeypatch.setattr(
        bench_stages,
        "import_module",
        lambda _: SimpleNamespace(**{n: lambda stage, n=n: functions[n](stage) for n in NAMES}),
    )
    limits = {"kept at full size": {"name": "kept", "at_most": 1.0}}
    entry = {"error_name": "rms, %", "reference": "truth", "interval_of": "", "limits": limits}
    monkeypatch.setattr(bench_stage, "read_descriptions", lambda: dict.fromkeys(NAMES, entry))
    monkeypatch.setattr(bench_plan, "FULL_S", costs)
    made.append(functions)
    return made


def run(budget_s, names=None, toy=False, out=None):
    return bench_stages.run_stages(
        names, budget_s=budget_s, toy=toy, out=out, console=Console(True)
    )


def test_stages_run_small_first_then_quickest_full_size(calls, capsys):
    document = run(150.0)
    small = [(name, "small") for name in NAMES]
    assert calls[1:] == [*small, ("b", "full"), ("c", "full")]
    assert {n: s["size"] for n, s in document["stages"].items()} == {
        "a": "small",
        "b": "full",
        "c": "full",
    }
    assert document["not_judged"] == ["a"]
    assert document["stages"]["a"]["limits"] == []
    assert document["passed"]
    assert "limits not evaluated, measured at small size: a;" in capsys.readouterr().err


def test_sufficient_budget_runs_all_full_size_recording_compilation(calls, capsys):
    document = run(400.0)
    assert document["not_judged"] == []
    assert document["stages"]["a"]["compile_seconds"] == pytest.approx(2.0 * (1 + 2 + 4 + 8))


def test_a_slow_machine_is_noticed(calls, monkeypatch, capsys):
    monkeypatch.setattr(bench_plan, "FULL_S", {"a": 40.0, "b": 1.0, "c": 12.0})
    # c takes 50 s instead of 12: then a, with 40 s expected, would not end in time
    assert run(150.0)["not_judged"] == ["a"]


def test_requested_stage_runs_full_size_at_once(calls, capsys):
    document = run(1.0, ["a"])
    assert calls[1:] == [("a", "full")]
    assert document["stages"]["a"]["limits"][0]["passed"]


def test_toy_runs_are_not_evaluated_by_limits(calls, capsys):
    document = run(600.0, toy=True)
    assert calls[1:] == [(name, "small") for name in NAMES]
    assert document["passed"]
    assert document["not_judged"] == list(NAMES)


def test_stage_missing_optional_part_is_skipped_unless_requested(calls, capsys):
    calls[0]["a"] = stage("a", calls, error=MissingExtra("this", "peers"))
    document = run(600.0)
    assert [name for name, _ in document["left_out"]] == ["a"]
    assert list(document["stages"]) == ["b", "c"]
    with pytest.raises(MissingExtra):
        run(600.0, ["a"])


def test_interrupted_run_keeps_measured_results(calls, tmp_path, capsys):
    calls[0]["b"] = stage("b", calls, error=KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(600.0, ["a", "b", "c"], out=tmp_path)
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert list(kept["stages"]) == ["a"]
    assert kept["left_out"] == [[name, bench_stages.INTERRUPTED_REASON] for name in ("b", "c")]
    calls[0]["b"] = stage("b", calls)
    run(600.0, ["a", "b", "c"], out=tmp_path)
    whole = json.loads((tmp_path / "bench.json").read_text())
    assert set(whole["stages"]) == set(NAMES)
    assert whole["left_out"] == []


def test_interrupted_long_stage_keeps_measured_results(calls, tmp_path, capsys):
    whole = stage("b", calls)

    def in_parts(stage):
        whole(stage)
        kept = stage.points[2:]
        del stage.points[2:]
        yield
        if stopped:
            raise KeyboardInterrupt
        stage.points += kept

    calls[0]["b"], stopped = in_parts, True
    with pytest.raises(KeyboardInterrupt):
        run(600.0, ["a", "b"], out=tmp_path)
    kept = json.loads((tmp_path / "bench.json").read_text())
    assert [len(kept["stages"][name]["points"]) for name in ("a", "b")] == [4, 2]
    assert kept["left_out"] == [["b", bench_stages.INTERRUPTED_REASON]]
    stopped = False
    document = run(600.0, ["a", "b"], out=tmp_path)
    assert [len(document["stages"][name]["points"]) for name in ("a", "b")] == [4, 4]
    assert document["left_out"] == []


def test_later_run_keeps_finished_stages(calls, tmp_path, capsys):
    for name in ("a", "b", "a"):
        run(600.0, [name], out=tmp_path)
    document = run(600.0, out=tmp_path)
    again = [("c", "small"), ("c", "full")]  # of all stages, the unmeasured one alone
    assert calls[1:] == [("a", "full"), ("b", "full"), ("a", "full"), *again]
    assert list(document["stages"]) == list(NAMES)
    assert json.loads((tmp_path / "bench.json").read_text()) == to_json_value(document)
    bench_table.write_tables(document, tmp_path)


def test_finished_stage_survives_run_without_budget(calls, tmp_path, capsys):
    for budget_s, names in ((600.0, ["a"]), (-1.0, ["a", "b"]), (-1.0, None)):
        document = run(budget_s, names, out=tmp_path)
        assert document["stages"]["a"]["size"] == "full"
    assert [name for name, _ in document["left_out"]] == ["b", "c"]
    run(600.0, out=tmp_path)
    assert [call for call in calls[1:] if call[0] == "a"] == [("a", "full")]


def test_interrupted_stage_is_measured_again(calls, tmp_path, capsys):
    calls[0]["c"] = stage("c", calls, error=KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(60.0, out=tmp_path)
    calls[0]["c"] = stage("c", calls, costs["c"])
    del calls[1:]
    document = run(60.0, out=tmp_path)
    assert calls[1:] == [("c", "small"), ("b", "full")]
    assert document["left_out"] == []
    assert document["not_judged"] == ["a", "c"]


@pytest.mark.parametrize("changed", [{"code": "x"}, {"toy": True}, {"machine": {}}, None])
def test_incomparable_document_is_replaced_with_notice(changed, calls, tmp_path, capsys):
    run(600.0, ["a"], out=tmp_path)
    path = tmp_path / "bench.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed) if changed else "{")
    capsys.readouterr()
    assert list(run(600.0, ["b"], out=tmp_path)["stages"]) == ["b"]
    assert "this run replaces it" in capsys.readouterr().err


def test_uncreatable_folder_is_reported_before_measuring(calls, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        run(600.0, ["a"], out=tmp_path / "file" / "bench")
    assert calls[1:] == []


def test_stage_named_twice_is_measured_once(calls, capsys):
    run(600.0, ["a", "b", "a"])
    assert calls[1:] == [("a", "full"), ("b", "full")]


def test_table_of_points_and_stage_plots_are_written(calls, tmp_path, capsys):
    document = run(150.0, out=tmp_path)
    bench_table.write_tables(document, tmp_path)
    with (tmp_path / "bench.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * len(NAMES)
    assert rows[0]["setting"] == "n=1.0"
    assert float(rows[-1]["efficiency"]) == pytest.approx(1.0)
    assert {p.name for p in tmp_path.glob("*.svg")} == {"a.svg", "b.svg", "c.svg"}
    assert "small size" in (tmp_path / "a.svg").read_text()
    assert "(knee)" in (tmp_path / "c.svg").read_text()


def test_stage_seconds_are_given_only_for_existing_stages():
    assert set(bench_plan.FULL_S) <= set(bench_stages.STAGES)
