"""The seconds that are left follow from the pace of the stages that are done."""

import pytest

from reconstruction.pipeline.run_progress import RunProgress

TYPICAL = {"frames": 1.0, "fit": 6.0, "draw": 3.0}


class Clock:
    """A clock that is set."""

    now = 50.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize("pace", [0.5, 2.0])
def test_run_at_steady_pace_counts_down_exactly(pace):
    clock, reports = Clock(), []
    run = RunProgress(lambda text, left_s: reports.append((text, left_s)), TYPICAL, clock)
    run.plan(["frames all", "fit", "draw"])
    run.begin_stage("frames all")
    clock.now += 1.0 * pace
    run.begin_stage("fit")
    for number in range(3):
        run.begin_tile("fit", number, 3)
        clock.now += 2.0 * pace
    run.begin_stage("draw")
    assert [text for text, _ in reports] == [
        "frames all",
        "fit",
        "fit: 0/3",
        "fit: 1/3",
        "fit: 2/3",
        "draw",
    ]
    assert reports[0][1] is None  # nothing is known of the pace
    left = [seconds / pace for _, seconds in reports[1:]]
    assert left == pytest.approx([9.0, 9.0, 7.0, 5.0, 3.0])


def test_slow_stage_without_tiles_raises_the_rest():
    clock, reports = Clock(), []
    run = RunProgress(lambda text, left_s: reports.append(left_s), TYPICAL, clock)
    run.plan(TYPICAL)
    run.begin_stage("frames")
    clock.now += 1.0
    run.begin_stage("fit")
    clock.now += 24.0  # four times the pace of the first stage
    run.begin_tile("fit", 0, 1)
    assert reports[1] == pytest.approx(9.0)
    assert reports[2] == pytest.approx(25.0 / 7.0 * 3.0 + 0.25 * 24.0)


def test_rest_of_a_stage_follows_its_tiles():
    clock, reports = Clock(), []
    run = RunProgress(lambda text, left_s: reports.append(left_s), {"normals": 0.3}, clock)
    run.plan(["normals", "fit"])
    run.begin_stage("normals")
    for number in range(10):  # a first stage, and one whose typical seconds are 100 times too small
        run.begin_tile("normals", number, 10)
        clock.now += 3.0
    assert reports[:2] == [None, None]
    paces = [30.0] * 9  # both stages are expected to take as long
    left = [30.0 - 3.0 * number + pace for number, pace in zip(range(1, 10), paces, strict=True)]
    assert reports[2:] == pytest.approx(left)
