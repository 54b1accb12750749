"""Blood that follows prompts and events: known at every time."""

from __future__ import annotations

import numpy as np
import pytest

from rigsim.scenes.flash.course import BLOOD_LEVELS, blood_level_weights
from rigsim.subject.perfusion import StateError
from rigsim.subject.perfusion_course import (
    CourseError,
    EventCourse,
    PromptedCourse,
    fix_blood_level,
)
from rigsim.subject.person import make_subject


def prompted(course, period_s=5.0, count=10):
    for number in range(count):
        course.prompt(period_s * number, course.state if number % 2 == 0 else "neutral")
    return course


def test_blood_relaxes_with_separate_rise_and_fall_constants():
    course = PromptedCourse("smile", rise_s=1.0, fall_s=0.5, reaction_s=0.0, reaction_spread_s=0.0)
    prompted(course, 50.0)
    for since in (0.1, 1.0, 3.0):
        assert course.level(100.0 + since) == pytest.approx(1 - np.exp(-since), abs=1e-9)
        assert course.level(150.0 + since) == pytest.approx(np.exp(-since / 0.5), abs=1e-9)


def test_level_is_continuous_and_between_rest_and_full():
    course = prompted(PromptedCourse("anger", rise_s=4.0, fall_s=2.0, seed=3))
    levels = np.array([course.level(t) for t in np.arange(0.0, 60.0, 0.01)])
    assert levels.min() >= 0.0
    assert levels.max() <= 1.0
    assert np.abs(np.diff(levels)).max() < 0.01 / 2.0


def test_past_levels_do_not_depend_on_later_prompts():
    course = PromptedCourse("smile", rise_s=2.0)
    course.prompt(0.0, "smile")
    before = course.level(1.0)
    course.prompt(5.0, "neutral")
    assert course.level(1.0) == before


def test_reactions_follow_their_prompts_each_a_little_otherwise():
    course = PromptedCourse("smile", reaction_s=0.2, reaction_spread_s=0.05, seed=1)
    prompted(course, 5.0, 200)
    times = np.array([entry[0] for entry in course._moves]) - 5.0 * np.arange(200)
    assert times.min() >= 0.0
    assert abs(times.mean() - 0.2) < 4 * 0.05 / np.sqrt(200)
    assert 0.04 < times.std() < 0.06
    assert course.pose(5.0 * 2 + times[2] - 1e-3) == "neutral"
    assert course.pose(5.0 * 2 + times[2] + 1e-3) == "smile"


def test_exercise_fades_from_peak_and_alcohol_rises():
    exercise, alcohol = EventCourse("exercise"), EventCourse("alcohol")
    for course in (exercise, alcohol):
        course.prompt(100.0, "neutral")
        assert course.level(150.0) == 0.0
        course.prompt(200.0, course.state)
        course.prompt(300.0, course.state)  # said twice, happened once
    assert exercise.level(200.0) == 1.0
    assert exercise.level(260.0) == pytest.approx(np.exp(-60 / 40))
    assert alcohol.level(200.0) == 0.0
    assert alcohol.level(3800.0) == pytest.approx(1 - np.exp(-3))


def test_partial_blood_is_between_rest_and_state_inclusive():
    face = make_subject(size=64)
    rest, full = face.hemoglobin("neutral"), face.hemoglobin("smile")
    np.testing.assert_array_equal(fix_blood_level(face, "smile", 0.0).hemoglobin("smile"), rest)
    np.testing.assert_array_equal(fix_blood_level(face, "smile", 1.0).hemoglobin("neutral"), full)
    half = fix_blood_level(face, "smile", 0.5).hemoglobin()
    assert np.all((half - rest) * (full - half) >= -1e-9)


def test_parabola_is_exact_for_blood_quadratic_in_radius():
    level = 0.37
    values = [(1 + 0.3 * node) ** 2 for node in BLOOD_LEVELS]
    assert np.dot(blood_level_weights(level), values) == pytest.approx((1 + 0.3 * level) ** 2)
    assert sum(blood_level_weights(level)) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [{"rise_s": 0.0}, {"fall_s": -1.0}, {"reaction_s": np.nan}])
def test_a_course_that_cannot_be_is_refused(wrong):
    with pytest.raises(CourseError):
        PromptedCourse("smile", **wrong)


def test_unknown_states_and_levels_are_refused():
    with pytest.raises(StateError):
        PromptedCourse("neutral")
    with pytest.raises(CourseError):
        fix_blood_level(make_subject(size=64), "smile", 1.5)
