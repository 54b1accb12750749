"""Each benchmark at toy size; its document has the fields of docs/reference/benchmarks.md."""

import copy
import itertools
import json
import math

import pytest

from skinrig.benchmarks.document import SCHEMA
from skinrig.benchmarks.dome.people import QUANTITY_NAMES, REGION_LANDMARKS, TOY_PEOPLE
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.benchmarks.stages import STAGES, BenchError, run_stages
from skinrig.console import Console, to_json_value
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.simulating import probe

# less than a second of processor time at toy size
QUICK = {
    "anisotropy",
    "color-table",
    "diffuse-albedo",
    "facial-color",
    "hdr",
    "layered-reflectance",
    "light-order",
    "lumitexels",
    "microstructure",
    "microstructure-passes",
    "normals",
    "subsurface-batch",
    "texture-fill",
    "translucency",
    "wrinkle-storage",
    "wrinkle-weights",
}
MIN_POINTS = 4


def problems(stage):
    """List the errors in a stage's part of a document."""
    points, fronts = stage["points"], stage["fronts"]
    found = []

    def expect(condition, problem):
        if not condition:
            found.append(problem)

    # small sizes have the fewest points: a run within any budget has as many
    expect(len(points) >= MIN_POINTS, f"{len(points)} points")
    expect(stage["error_name"] and stage["reference"], "no reference")
    expect(stage["reference_error"] >= 0.0, "no reference error")
    expect(stage["reference_error_means"], "a reference error without a meaning")
    expect(stage["interval_of"], "intervals without a population")
    for number, point in enumerate(points):
        low, high = point["error_interval"]
        expect(point["seconds"] > 0.0, f"{number}: no seconds")
        expect(point["cold_seconds"] > 0.0, f"{number}: no cold seconds")
        fast, slow = point["seconds_spread"]
        expect(fast <= point["seconds"] <= slow, f"{number}: seconds outside their range")
        # the estimate is inside the interval within rounding
        slack = 1e-9 * abs(point["error"])
        expect(low - slack <= point["error"] <= high + slack, f"{number}: error outside interval")
        expect(
            (point["peak_memory_mb"] is None) == bool(point["no_memory"])
            and (point["peak_memory_mb"] is None)
            != (point["memory_of"] in {"allocated", "resident"}),
            f"{number}: neither memory nor a reason",
        )
        expect(
            (point["efficiency"] is None) == (not point["cramer_rao_bound"]),
            f"{number}: efficiency without bound, or the reverse",
        )
    expect(fronts, "no front")
    assigned = []
    for front in fronts:
        names = front["condition"]
        own = [
            n for n, p in enumerate(points) if all(p["knobs"].get(k) == v for k, v in names.items())
        ]
        assigned += own
        expect(set(front["points"]) <= set(own), f"{names}: a front of other conditions")
        along = [(points[n]["seconds"], points[n]["error"]) for n in front["points"]]
        expect(
            all(a[0] < b[0] and a[1] > b[1] for a, b in itertools.pairwise(along)),
            f"{names}: error does not fall as seconds rise",
        )
        for n in own:
            here = points[n]["seconds"], points[n]["error"]
            expect(
                any(s <= here[0] and e <= here[1] for s, e in along),
                f"{names}: point {n} is not dominated by the front",
            )
    expect(sorted(assigned) == list(range(len(points))), "points without one condition")
    marked = {n for front in fronts for n in front["points"]}
    expect(marked == {n for n, p in enumerate(points) if p["on_front"]}, "marks of other fronts")
    bands = [one["band"] for one in stage["by_band"]]
    expect(bool(bands) != bool(stage["no_bands"]), "neither bands of skin nor a reason")
    expect(bands in ([], list(MELANIN_BANDS)), f"bands {bands}")
    for one in stage["by_band"]:
        low, high = one["error_interval"]
        expect(low <= one["error"] <= high, f"{one['band']}: error outside its interval")
        expect(math.isfinite(one["error"]), f"{one['band']}: no error")
    return found


def every_region_has_values(made):
    assert len(made.points) == len(REGION_LANDMARKS) * len(QUANTITY_NAMES)
    assert {point.extra_values["people"] for point in made.points} == {TOY_PEOPLE}
    assert min(point.extra_values["mean"] for point in made.points) > 0.0
    (pull,) = (limit for limit in made.limits if limit.name.startswith("largest mean error"))
    assert pull.got < pull.bound


def more_lobes_predict_held_out_lights_better(made):
    lobes = [point for point in made.points if point.knobs["part"] == "lobes"]
    error = {point.knobs["rank"]: point.error for point in lobes}
    assert error[1] > 1.5 * error[4]
    assert made.limits[0].passed
    texture = [point.knobs for point in made.points if point.knobs["part"] == "texture"]
    assert len({knobs["levels"] for knobs in texture}) > 1
    assert len({knobs["iterations"] for knobs in texture}) > 1


RESULTS = {
    "brdf-people": every_region_has_values,
    "reflectance": more_lobes_predict_held_out_lights_better,
}
"""Checks of results that hold at toy size, too; a run at toy size evaluates no limits."""


@pytest.mark.parametrize(
    "stage", [pytest.param(s, marks=() if s in QUICK else pytest.mark.long) for s in STAGES]
)
def test_stage_result_satisfies_schema(stage, tmp_path, capsys, monkeypatch):
    # a quarter of the probe's own: how accurate its sessions are, other tests say
    monkeypatch.setitem(probe.TRUTH_PHOTONS, "small", 15_000)
    made, to_benchmark = [], BenchmarkStage.to_benchmark
    monkeypatch.setattr(
        BenchmarkStage, "to_benchmark", lambda self: made.append(to_benchmark(self)) or made[-1]
    )
    document = run_stages([stage], budget_s=60.0, toy=True, out=tmp_path, console=Console(True))
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written == to_json_value(document)
    assert written["schema"] == SCHEMA
    assert written["skin_bands"].keys() == MELANIN_BANDS.keys()
    assert list(written["stages"]) == [stage]
    assert problems(written["stages"][stage]) == []
    if stage in RESULTS:
        RESULTS[stage](made[-1])


@pytest.fixture(scope="module")
def sound():
    document = run_stages(
        ["subsurface-batch"], budget_s=60.0, toy=True, out=None, console=Console(True)
    )
    return to_json_value(document)["stages"]["subsurface-batch"]


def slower_and_worse(stage):
    extra = {**stage["points"][0], "seconds": 1e3, "error": 1e3, "on_front": True}
    extra |= {"seconds_spread": [1e3, 1e3], "error_interval": [1e3, 1e3]}
    stage["points"].append(extra)
    stage["fronts"][0]["points"].append(len(stage["points"]) - 1)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda s: s.update(points=[], fronts=[]), "0 points"),
        (slower_and_worse, "error does not fall"),
        (lambda s: s.update(fronts=[]), "no front"),
        (lambda s: s["fronts"].pop(), "points without one condition"),
        (lambda s: s.update(reference_error=-1.0), "no reference error"),
        (lambda s: s["points"][0].update(peak_memory_mb=None), "neither memory nor a reason"),
        (lambda s: s["points"][0].update(error_interval=[0.0, 0.0]), "outside interval"),
        (lambda s: s.update(by_band=[]), "neither bands of skin nor a reason"),
        (lambda s: s["by_band"].reverse(), "bands "),
        (lambda s: s["points"][0].update(efficiency=None), "efficiency without bound"),
    ],
)
def test_check_finds_corrupted_results(sound, spoil, expected):
    assert problems(sound) == []
    broken = copy.deepcopy(sound)
    spoil(broken)
    assert any(expected in problem for problem in problems(broken))


def test_unknown_stage_error_lists_valid_stages():
    with pytest.raises(BenchError, match="color-table"):
        run_stages(["tea"], budget_s=1.0, toy=True, out=None, console=Console(True))


def test_spent_budget_skips_stages_and_reports_them(capsys):
    document = run_stages(None, budget_s=0.0, toy=True, out=None, console=Console(True))
    assert len(document["left_out"]) == len(STAGES)
    assert document["stages"] == {}
