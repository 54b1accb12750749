"""Curves of blood: discs, repeats, whether anything lies between two levels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from reconstruction.facial_color.perfusion_curves import (
    FACE_SITES,
    CurveError,
    average_discs,
    estimate_reproducibility,
    find_transition,
    group_by_phase,
    standard_positions,
)

CYCLE_S = 10.0
PHASE = (5.5 * np.arange(22)) % CYCLE_S + 0.007


def relaxing(phase, constant_s, *, delay_s=0.16):
    """Blood of the hundredth cycle, followed step by step from prompt to prompt."""
    level, levels = 0.0, []
    for target in [1.0, 0.0] * 100:
        levels.append((level, target))
        level = target + (level - target) * np.exp(-5.0 / constant_s)
    out = []
    for p in phase:
        since = (p - delay_s) % CYCLE_S
        begin, target = levels[-2] if since < 5 else levels[-1]
        out.append(target + (begin - target) * np.exp(-(since % 5.0) / constant_s))
    return np.array(out)


def test_disc_mean_is_mean_of_valid_pixels():
    rng = np.random.default_rng(0)
    maps = rng.random((3, 20, 30))
    valid = rng.random(maps.shape) > 0.3
    stderr = rng.random(maps.shape)
    found = average_discs(maps, {"a": (7.2, 9.9)}, 3.0, stderr=stderr, valid=valid)
    y, x = np.mgrid[0:20, 0:30]
    disc = (x - 7.2) ** 2 + (y - 9.9) ** 2 <= 9.0
    for k in range(3):
        here = disc & valid[k]
        assert found.mean[0, k] == pytest.approx(maps[k][here].mean())
        assert found.stderr[0, k] == pytest.approx(
            np.sqrt((stderr[k][here] ** 2).sum()) / here.sum()
        )
        assert found.pixels[0, k] == here.sum()


def test_disc_without_valid_pixels_masked_smallest_keeps_single():
    maps = np.ones((2, 9, 9))
    valid = np.ones(maps.shape, bool)
    valid[1] = False
    found = average_discs(maps, {"a": (4, 4)}, 0.01, valid=valid)
    assert found.pixels.tolist() == [[1, 0]]
    assert found.valid.tolist() == [[True, False]]
    assert np.isnan(found.mean[0, 1])


@pytest.mark.parametrize(
    ("place", "radius", "what"), [((40, 3), 2, "expected within"), ((3, 3), 0, "radius_px")]
)
def test_a_disc_beyond_the_map_is_refused(place, radius, what):
    with pytest.raises(CurveError, match=what):
        average_discs(np.ones((1, 9, 9)), {"a": place}, radius)


def test_default_face_positions_are_on_face_and_ordered():
    y, x = np.mgrid[0:200, 0:300]
    face = ((x - 150) / 60) ** 2 + ((y - 100) / 90) ** 2 < 1
    places = standard_positions(face)
    assert tuple(places) == FACE_SITES
    assert all(face[round(v), round(u)] for u, v in places.values())
    assert places["forehead"][1] < places["temple"][1] < places["nose"][1] < places["chin"][1]
    assert places["temple"][0] < places["cheek"][0] < places["nose"][0]
    with pytest.raises(CurveError, match="skin"):
        standard_positions(np.zeros((4, 4), bool))


def test_same_phase_shots_group_across_cycle_end():
    phase = np.concatenate([PHASE, [9.99, 10.01]])  # 9.99 and 0.007 are one phase
    groups = group_by_phase(phase, cycle_s=CYCLE_S)
    assert len(np.unique(groups)) == 20
    assert groups[0] == groups[20] == groups[22] == groups[23]


def test_reproducibility_is_the_scatter_of_repeats_only():
    rng = np.random.default_rng(1)
    phase = np.tile(np.arange(10.0), 60)
    value = 5.0 * phase + 0.3 * rng.standard_normal(phase.size)
    found = estimate_reproducibility(np.arange(phase.size) * 11.0, phase, value, cycle_s=CYCLE_S)
    assert found.repeats == 590
    low, high = stats.chi2.ppf([0.001, 0.999], 590)
    assert low < 590 * found.sd**2 / 0.09 < high
    once = estimate_reproducibility(PHASE[:9], PHASE[:9], PHASE[:9], cycle_s=CYCLE_S)
    assert once.repeats == 0
    assert np.isnan(once.sd)


def test_quick_course_transition_rate_stays_at_stated_rate():
    rng = np.random.default_rng(2)
    clean = relaxing(PHASE, 0.02)
    alarms, runs = 0, 400
    for _ in range(runs):
        value = 0.03 + 0.01 * clean + 5e-4 * rng.standard_normal(clean.size)
        found = find_transition(PHASE, value, cycle_s=CYCLE_S, false_alarm=0.05)
        alarms += found.seen
        assert found.decided
    # at most the stated rate; one-sided, at a thousandth
    assert alarms <= stats.binom.ppf(0.999, runs, 0.05)


@pytest.mark.parametrize("constant_s", [0.6, 1.0])
def test_a_slow_course_shows_its_transition(constant_s):
    rng = np.random.default_rng(3)
    clean = relaxing(PHASE, constant_s)
    found = find_transition(
        PHASE, 0.03 + 0.01 * clean + 3e-4 * rng.standard_normal(22), cycle_s=CYCLE_S
    )
    assert found.seen
    assert found.high > found.low
    assert all(0.05 < clean[k] < 0.95 for k in found.where)


def test_noisy_curve_is_reported_as_undecided():
    rng = np.random.default_rng(4)
    value = 0.03 + 0.01 * relaxing(PHASE, 1.0) + 1e-2 * rng.standard_normal(22)
    found = find_transition(PHASE, value, cycle_s=CYCLE_S)
    assert not found.decided
    assert found.power < 0.2


def test_blood_drop_is_transition_like_rise():
    rng = np.random.default_rng(5)
    value = 0.03 - 0.01 * relaxing(PHASE, 0.8) + 2e-4 * rng.standard_normal(22)
    found = find_transition(PHASE, value, cycle_s=CYCLE_S)
    assert found.seen
    assert found.high < found.low


def test_known_errors_are_not_undercut_by_lucky_scatter():
    value = 0.03 + 0.01 * relaxing(PHASE, 1.0)
    sure = find_transition(PHASE, value, cycle_s=CYCLE_S)
    unsure = find_transition(PHASE, value, cycle_s=CYCLE_S, stderr=np.full(22, 0.01))
    assert sure.seen
    assert not unsure.seen


def test_exact_levels_have_no_transition_and_full_power():
    found = find_transition(PHASE, (PHASE < 5).astype(float), cycle_s=CYCLE_S)
    assert not found.seen
    assert found.power == 1.0


def test_too_few_shots_of_a_level_are_refused():
    with pytest.raises(CurveError, match="fewer than 3"):
        find_transition(PHASE[:8], PHASE[:8], cycle_s=CYCLE_S)
