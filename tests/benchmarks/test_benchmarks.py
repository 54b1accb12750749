"""Each benchmark once at toy size: it runs, and its document holds what the schema promises."""

import itertools
import json

import pytest

from skinrig.bench_stages import STAGES, BenchError, run_stages
from skinrig.console import Console, plain

# simulated sessions, surveys and faces: over 5 s of processor time even when small
HEAVY = {
    "dome-geometry", "editing", "gradient-normals", "probe-session", "render-gradient",
    "sphere-lights", "traits",
}  # fmt: skip


@pytest.mark.parametrize(
    "stage", [pytest.param(s, marks=pytest.mark.long if s in HEAVY else ()) for s in STAGES]
)
def test_a_stage_gives_points_with_errors_and_intervals(stage, tmp_path, capsys):
    document = run_stages([stage], budget_s=60.0, toy=True, out=tmp_path, console=Console(True))
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written == plain(document)
    points = written["stages"][stage]["points"]
    # small sizes have the fewest: a run within any budget shows so many
    assert len(points) >= 4
    front = sorted((p["seconds"], p["error"]) for p in points if p["on_front"])
    assert front
    assert all(a[0] < b[0] and a[1] > b[1] for a, b in itertools.pairwise(front))
    assert written["stages"][stage]["reference"]
    assert written["stages"][stage]["reference_error"] >= 0.0
    for point in points:
        low, high = point["error_interval"]
        assert point["seconds"] > 0
        assert (point["efficiency"] is None) == (not point["cramer_rao_bound"])
        assert low <= point["error"] <= high or point["error"] == pytest.approx(high, rel=0.5)


def test_an_unknown_stage_is_named_with_the_known_ones():
    with pytest.raises(BenchError, match="color-table"):
        run_stages(["tea"], budget_s=1.0, toy=True, out=None, console=Console(True))


def test_a_spent_budget_leaves_stages_out_and_says_so(capsys):
    document = run_stages(None, budget_s=0.0, toy=True, out=None, console=Console(True))
    assert len(document["left_out"]) == len(STAGES)
    assert document["stages"] == {}
