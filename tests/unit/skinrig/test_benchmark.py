import pytest

from skinrig.benchmark import (
    Limit,
    Point,
    StageBenchmark,
    Timing,
    knee,
    measure,
    pareto_front,
    to_document,
)


def point(seconds, error):
    return Point({"n": 1}, Timing(seconds, (seconds, seconds), seconds, 0.0), error, (error, error))


def test_the_front_holds_what_nothing_beats_in_both():
    points = (point(1, 8), point(2, 9), point(2, 4), point(4, 4), point(8, 1))
    assert pareto_front(points) == (0, 2, 4)


def test_the_knee_is_where_the_front_bends_most():
    points = (point(1, 100), point(2, 2), point(100, 1))
    assert knee(points) == 1


def test_two_points_have_no_knee():
    assert knee((point(1, 2), point(2, 1))) is None


def test_the_first_call_is_timed_apart_from_the_warm_ones():
    calls = []
    timing = measure(lambda: calls.append(1), repeats=4)
    assert len(calls) == 1 + 4 + 1
    assert timing.spread_s[0] <= timing.seconds <= timing.spread_s[1]


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
