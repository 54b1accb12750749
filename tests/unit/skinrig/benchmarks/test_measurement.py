import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinrig.benchmarks import resident_memory
from skinrig.benchmarks import table as bench_table
from skinrig.benchmarks.document import find_knee, pareto_front, to_document
from skinrig.benchmarks.measurement import measure
from skinrig.benchmarks.results import ErrorEstimate, Limit, Point, StageBenchmark, Timing


def point(seconds, error):
    return Point({"n": 1}, Timing(seconds, (seconds, seconds), seconds, 1.0), error, (error, error))


def test_front_contains_all_undominated_points():
    points = (point(1, 8), point(2, 9), point(2, 4), point(4, 4), point(8, 1))
    assert pareto_front(points) == (0, 2, 4)


def test_the_knee_is_where_the_front_bends_most():
    points = (point(1, 100), point(2, 2), point(100, 1))
    assert find_knee(points) == 1


def test_two_points_have_no_knee():
    assert find_knee((point(1, 2), point(2, 1))) is None


def test_flat_curve_has_knee_at_quickest_point():
    wide = Point({"n": 1}, Timing(3.0, (3.0, 3.0), 3.0, 1.0), 0.9, (0.7, 1.1))
    assert find_knee((point(1, 1), point(2, 1.2), wide)) == 0
    assert find_knee((point(1, 1), point(2, 1), point(3, 1))) == 0


def test_curve_without_bend_ends_before_useless_time():
    steep = (point(1, 8), point(2, 7), point(3, 1))  # above the chord between its ends
    assert find_knee(steep) is None
    assert find_knee((*steep, point(9, 2))) == 2


def test_first_call_is_timed_separately_from_warm_ones():
    calls = []
    timing = measure(lambda: calls.append(1), repeats=4)
    assert len(calls) == 1 + 4 + 1
    assert timing.range_s[0] <= timing.seconds <= timing.range_s[1]


def test_measuring_nothing_is_refused():
    with pytest.raises(ValueError, match="repeats"):
        measure(lambda: None, repeats=0)


@pytest.mark.parametrize(
    ("sense", "got", "passed"),
    [("<=", 1.0, True), ("<=", 1.1, False), (">=", 0.9, False), (">=", float("nan"), False)],
)
def test_a_missed_limit_fails_the_document(sense, got, passed):
    stage = StageBenchmark(
        "s", "error, %", "closed form", 0.0, (point(1, 1),), (Limit("l", got, 1.0, sense),)
    )
    document = to_document([stage])
    assert document["passed"] is passed
    assert document["stages"]["s"]["points"][0]["on_front"] is True


errors_and_seconds = st.lists(
    st.tuples(
        st.floats(1e-9, 1e9) | st.sampled_from([1.0, 2.0]),
        st.floats(0.0, 1e9) | st.sampled_from([1.0, 2.0, float("nan"), float("inf")]),
    ),
    max_size=30,
)


@given(errors_and_seconds)
def test_along_a_front_error_falls_as_seconds_rise(drawn):
    points = tuple(point(*one) for one in drawn)
    front = [points[k] for k in pareto_front(points)]
    seconds = [p.timing.seconds for p in front]
    errors = [p.error for p in front]
    assert all(a < b for a, b in itertools.pairwise(seconds))
    assert all(a > b for a, b in itertools.pairwise(errors))
    for p in points:
        if np.isfinite(p.error):
            assert any(f.timing.seconds <= p.timing.seconds and f.error <= p.error for f in front)


def test_efficiency_is_the_ratio_of_variances():
    timing = Timing(1.0, (1.0, 1.0), 1.0, 0.0)
    one = Point({}, timing, 3.0, (2.0, 4.0), 2.0)
    assert one.efficiency() == (2.25, 1.0, 4.0)
    assert one.efficiency(squared=True) == (1.5, 1.0, 2.0)
    assert point(1, 1).efficiency() is None
    document = to_document([StageBenchmark("s", "rms, %", "truth", 0.0, (one,))])
    written = document["stages"]["s"]["points"][0]
    assert (written["efficiency"], written["efficiency_interval"]) == (2.25, [1.0, 4.0])


def test_reference_error_is_distinguished_from_exact_truth():
    means = [
        StageBenchmark("s", "rms", "r", error, (point(1, 1),)).reference_error_means
        for error in (0.0, 0.1)
    ]
    assert means[0].startswith("exact")
    assert not means[1].startswith("exact")


def test_memory_of_slow_calls_is_process_growth(monkeypatch):
    monkeypatch.setattr("skinrig.benchmarks.measurement.MAX_TRACED_CALL_S", 0.0)
    with resident_memory.track_peak() as seen:
        pass
    if seen.mb is None:
        pytest.skip("this system does not count resident memory")
    timing = measure(lambda: np.ones(10_000_000).sum(), repeats=1, memory=False)
    assert timing.memory_kind == "resident"
    assert 60.0 < timing.peak_memory_mb < 160.0


def test_memory_of_quick_calls_is_their_allocation():
    timing = measure(lambda: np.ones(100_000).sum(), repeats=1, memory=False)
    assert timing.memory_kind == "allocated"
    assert 0.8 <= timing.peak_memory_mb < 0.9


def test_each_condition_has_own_front_and_knee():
    timing = {s: Timing(s, (s, s), s, 1.0) for s in (1.0, 2.0, 4.0)}
    points = [
        Point({"noise": noise, "steps": s}, timing[s], error, (error, error))
        for noise, errors in (("low", (8.0, 1.0, 0.5)), ("high", (80.0, 10.0, 10.0)))
        for s, error in zip(timing, errors, strict=True)
    ]
    alone = StageBenchmark("s", "rms", "r", 0.0, tuple(points), condition=("noise",))
    written = to_document([alone])["stages"]["s"]
    assert written["fronts"] == [
        {"condition": {"noise": "low"}, "points": [0, 1, 2], "knee": 1},
        {"condition": {"noise": "high"}, "points": [3, 4], "knee": 4},
    ]
    assert [p["on_front"] for p in written["points"]] == [True] * 5 + [False]
    # in one front for all, what is measured with much noise would look like too little effort
    mixed = to_document([StageBenchmark("s", "rms", "r", 0.0, tuple(points))])["stages"]["s"]
    assert [p["on_front"] for p in mixed["points"]] == [True] * 3 + [False] * 3


def test_document_reports_error_ratio_on_dark_skin():
    stage = StageBenchmark(
        "s",
        "rms, %",
        "truth",
        0.0,
        (point(1, 1),),
        by_band={
            "light": ErrorEstimate(2.0, (1.0, 4.0)),
            "dark": ErrorEstimate(6.0, (4.0, 8.0), 3.0),
        },
    )
    written = to_document([stage])["stages"]["s"]
    assert [one["band"] for one in written["by_band"]] == ["light", "dark"]
    assert written["darkest_over_lightest"] == {"ratio": 3.0, "interval": [1.0, 8.0]}
    assert [row[1:7] for row in bench_table.list_band_rows({"stages": {"s": written}})] == [
        ("light", 2.0, 1.0, 4.0, "", 1.0),
        ("dark", 6.0, 4.0, 8.0, 3.0, 3.0),
    ]


def test_memory_that_was_not_measured_has_its_reason():
    timing = Timing(1.0, (1.0, 1.0), 1.0, None, no_memory_reason="extrapolated")
    stage = StageBenchmark("s", "rms", "r", 0.0, (Point({}, timing, 1.0, (1.0, 1.0)),))
    written = to_document([stage])["stages"]["s"]["points"][0]
    assert (written["peak_memory_mb"], written["no_memory"]) == (None, "extrapolated")
