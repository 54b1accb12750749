"""Time constants of blood: recovered, or bounded where the samples are too far apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from model.solver_outcome import outcome_from_scipy
from reconstruction.facial_color import perfusion_likelihood
from reconstruction.facial_color.perfusion_curves import CurveError
from reconstruction.facial_color.perfusion_fit import fit_course, fit_cycle, square_levels
from reconstruction.facial_color.perfusion_samples import CurveSamples, PoseStep

CYCLE_S = 10.0
PHASE = (5.5 * np.arange(22)) % CYCLE_S + 0.007
FINE = (10.25 * np.arange(44)) % CYCLE_S + 0.007


def relaxing(phase, constant_s, delay_s=0.16, fall_s=None):
    """Blood of the hundredth cycle, followed from prompt to prompt."""
    constants = {1.0: constant_s, 0.0: constant_s if fall_s is None else fall_s}
    level, begins = 0.0, {}
    for target in [1.0, 0.0] * 100:
        begins[target] = level
        level = target + (level - target) * np.exp(-5.0 / constants[target])
    since = (np.asarray(phase) - delay_s) % CYCLE_S
    target = np.where(since < 5, 1.0, 0.0)
    begin = np.where(since < 5, begins[1.0], begins[0.0])
    constant = np.where(since < 5, constants[1.0], constants[0.0])
    return target + (begin - target) * np.exp(-(since % 5.0) / constant)


@pytest.mark.long
@pytest.mark.parametrize(("phase", "constant_s"), [(PHASE, 2.0), (FINE, 2.0), (FINE, 0.5)])
def test_a_time_constant_is_recovered_within_its_errors(phase, constant_s):
    rng = np.random.default_rng(0)
    clean = relaxing(phase, constant_s)
    runs, covered, pulls = 24, 0, []
    for _ in range(runs):
        found = fit_cycle(
            phase, 0.03 + 0.01 * clean + 3e-4 * rng.standard_normal(phase.size), cycle_s=CYCLE_S
        )
        assert found.known == "estimated"
        covered += found.interval_s[0] <= constant_s <= found.interval_s[1]
        pulls.append((found.time_constant_s - constant_s) / found.stderr_time_constant_s)
    # of 95 % intervals at least so many hold the truth but for one chance in a thousand
    assert covered >= stats.binom.ppf(0.001, runs, 0.95)
    assert abs(np.mean(pulls)) < 4.0 / np.sqrt(runs) * max(1.0, np.std(pulls))


def test_intervals_of_68_percent_cover_and_extend_above():
    """Where noise is large, a constant is better bounded below: its two sides differ."""
    rng, noise = np.random.default_rng(21), 1e-3
    clean, runs, held, longer = relaxing(PHASE, 1.0), 40, 0, []
    for _ in range(runs):
        found = fit_cycle(
            PHASE, 0.03 + 0.01 * clean + noise * rng.standard_normal(22), cycle_s=CYCLE_S
        )
        low, high = found.interval_68_s
        assert found.interval_s[0] <= low <= found.time_constant_s <= high <= found.interval_s[1]
        if found.known == "estimated":
            assert found.stderr_time_constant_s == pytest.approx(0.5 * (high - low))
        held += low <= 1.0 <= high
        longer.append((high - found.time_constant_s) / (found.time_constant_s - low))
    # both ends, each by one chance in a thousand, of the nominal share
    assert stats.binom.ppf(0.001, runs, 0.6827) <= held <= stats.binom.ppf(0.999, runs, 0.6827)
    assert np.median(longer) > 1.0


def test_planned_instead_of_true_times_miss_time_constant():
    rng = np.random.default_rng(1)
    late = PHASE + np.where(np.arange(22) % 3 == 0, 1.1, 0.0)
    value = 0.03 + 0.01 * relaxing(late, 2.0) + 1e-4 * rng.standard_normal(22)
    true = fit_cycle(late % CYCLE_S, value, cycle_s=CYCLE_S)
    planned = fit_cycle(PHASE, value, cycle_s=CYCLE_S)
    assert true.interval_s[0] <= 2.0 <= true.interval_s[1]
    assert planned.noise[0] > 5 * true.noise[0]


def test_constant_far_below_interval_is_only_bounded():
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(24):
        value = 0.03 + 0.01 * relaxing(PHASE, 0.01) + 3e-4 * rng.standard_normal(22)
        found = fit_cycle(PHASE, value, cycle_s=CYCLE_S)
        held += found.known == "only below"
        assert np.isnan(found.stderr_time_constant_s) == (found.known == "only below")
        assert found.interval_s[1] < 0.5
        assert "below" in str(found) or found.known == "estimated"
    # bounded wherever no chance makes a sample look half way
    assert held >= stats.binom.ppf(0.001, 24, 0.95)


def test_delay_is_known_to_sampling_gap():
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(24):
        value = relaxing(PHASE, 0.01, delay_s=0.7) + 0.02 * rng.standard_normal(22)
        found = fit_cycle(PHASE, value, cycle_s=CYCLE_S)
        low, high = found.delay_interval_s
        held += low <= 0.7 <= high
        assert high - low < 0.6
    assert held >= stats.binom.ppf(0.001, 24, 0.95)


def test_positions_with_common_course_are_estimated_better_jointly():
    rng = np.random.default_rng(4)
    gaps = np.array([0.01, -0.006, 0.002, 0.004, 0.008])
    values = 0.03 + gaps[:, None] * relaxing(FINE, 1.0) + 8e-4 * rng.standard_normal((5, 44))
    alone = fit_cycle(FINE, values[3], cycle_s=CYCLE_S)
    together = fit_cycle(FINE, values, cycle_s=CYCLE_S)
    width = together.interval_s[1] - together.interval_s[0]
    assert width < 0.6 * (alone.interval_s[1] - alone.interval_s[0])
    assert together.interval_s[0] <= 1.0 <= together.interval_s[1]
    pulls = (together.end - together.start - gaps) / np.hypot(
        together.stderr_end, together.stderr_start
    )
    assert (pulls**2).sum() < stats.chi2.ppf(0.999, 5)


def test_levels_are_within_their_errors():
    rng = np.random.default_rng(5)
    chi2 = 0.0
    for _ in range(12):
        value = 0.03 + 0.01 * relaxing(FINE, 0.3) + 3e-4 * rng.standard_normal(44)
        found = fit_cycle(FINE, value, cycle_s=CYCLE_S, stderr=np.full(44, 3e-4))
        chi2 += ((found.start[0] - 0.03) / found.stderr_start[0]) ** 2
        chi2 += ((found.end[0] - 0.04) / found.stderr_end[0]) ** 2
        assert 0.2 < found.chi2 < 3.0
    assert chi2 < stats.chi2.ppf(0.999, 24)


def test_even_blood_leaves_the_constant_unknown():
    rng = np.random.default_rng(6)
    found = fit_cycle(PHASE, 0.03 + 1e-3 * rng.standard_normal(22), cycle_s=CYCLE_S)
    assert found.known == "unknown"
    assert "do not differ" in str(found)
    assert found.interval_s == found.interval_68_s == (0.0, np.inf)
    assert fit_cycle(PHASE, np.full(22, 0.03), cycle_s=CYCLE_S).known == "unknown"


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_units_and_offsets_do_not_matter(scale, offset):
    rng = np.random.default_rng(7)
    curve = relaxing(FINE, 1.5) + 0.02 * rng.standard_normal(44)
    plain = fit_cycle(FINE, curve, cycle_s=CYCLE_S)
    found = fit_cycle(FINE, scale * (offset + curve), cycle_s=CYCLE_S)
    assert found.time_constant_s == pytest.approx(plain.time_constant_s, rel=1e-3)
    assert found.interval_s == pytest.approx(plain.interval_s, rel=1e-2)


def test_missing_samples_are_omitted():
    rng = np.random.default_rng(8)
    value = relaxing(FINE, 1.5) + 0.01 * rng.standard_normal(44)
    value[::7] = np.nan
    found = fit_cycle(FINE, value, cycle_s=CYCLE_S)
    assert found.interval_s[0] <= 1.5 <= found.interval_s[1]
    assert np.isfinite(found.start).all()


def test_exercise_fades_and_alcohol_comes_with_their_constants():
    rng = np.random.default_rng(9)
    minute = 5.5 * np.arange(11)
    hour = 300.0 * np.arange(13)
    held = 0
    for _ in range(24):
        fading = fit_course(
            minute, 0.03 + 0.01 * np.exp(-minute / 20) + 1e-4 * rng.standard_normal(11)
        )
        rising = fit_course(
            hour, 0.03 - 0.01 * np.expm1(-hour / 1200) + 1e-4 * rng.standard_normal(13)
        )
        held += fading.interval_s[0] <= 20 <= fading.interval_s[1]
        held += rising.interval_s[0] <= 1200 <= rising.interval_s[1]
    assert held >= stats.binom.ppf(0.001, 48, 0.95)
    assert fading.start[0] > fading.end[0]
    assert rising.start[0] < rising.end[0]


def test_course_exceeding_observation_is_bounded_from_below():
    time = 5.5 * np.arange(11)
    rng = np.random.default_rng(10)
    found = fit_course(time, 0.03 + 0.01 * np.exp(-time / 4000) + 1e-5 * rng.standard_normal(11))
    assert found.known == "only above"
    assert found.interval_s[0] > 40


def test_too_little_to_fit_is_refused():
    with pytest.raises(CurveError, match="expected >= 5"):
        fit_cycle(PHASE[:4], PHASE[:4], cycle_s=CYCLE_S)
    with pytest.raises(CurveError, match="shape"):
        fit_cycle(PHASE, PHASE[:4], cycle_s=CYCLE_S)


@pytest.mark.parametrize("bent", [-0.2, 0.2])
def test_bent_course_is_found_where_bends_are_allowed(bent):
    """Light absorbed twice bends what is seen of blood, which chance does not cover."""
    time = np.linspace(1.0, 60.0, 12)
    part = 1.0 - np.exp(-time / 20.0)
    seen = 0.044 - 0.015 * (part + bent * part * (1.0 - part))
    seen += 2e-5 * np.random.default_rng(4).standard_normal(time.size)
    low, high = fit_course(time, seen).interval_s
    assert not low <= 20.0 <= high
    found = fit_course(time, seen, bend=0.12)  # 1.7 standard errors off
    assert found.interval_s[0] <= 20.0 <= found.interval_s[1]
    assert found.known == "estimated"
    assert found.stderr_time_constant_s > fit_course(time, seen).stderr_time_constant_s


def test_blood_root_finds_vessel_constant_that_blood_misses():
    """Vessels whose radius fades by 20 s: blood, their cross-section, fades faster at first."""
    time = np.linspace(1.0, 60.0, 12)
    noise = 3e-5 * np.random.default_rng(5).standard_normal(time.size)
    blood = 0.028 * (1.0 + 0.24 * np.exp(-time / 20.0)) ** 2 + noise
    high = fit_course(time, blood).interval_s[1]
    assert high < 20.0
    found = square_levels(fit_course(time, np.sqrt(blood)))
    assert found.interval_s[0] <= 20.0 <= found.interval_s[1]
    for level, stderr, true in (
        (found.start[0], found.stderr_start[0], 0.028 * 1.24**2),
        (found.end[0], found.stderr_end[0], 0.028),
    ):
        assert abs(level - true) < 4 * stderr < 0.05 * true
    assert 0.3 < found.noise[0] / 3e-5 < 3.0


def test_a_bend_adds_to_an_interval_in_squares():
    time = np.linspace(1.0, 60.0, 12)
    rng = np.random.default_rng(6)
    seen = 0.044 - 0.015 * (1.0 - np.exp(-time / 20.0)) + 1e-4 * rng.standard_normal(time.size)
    plain, bent, twice = (fit_course(time, seen, bend=bend) for bend in (0.0, 0.05, 0.1))
    for name, end in (
        ("interval_s", 0),
        ("interval_s", 1),
        ("interval_68_s", 0),
        ("interval_68_s", 1),
    ):
        shares = [
            np.log(getattr(fit, name)[end] / fit.time_constant_s) ** 2
            for fit in (plain, bent, twice)
        ]
        # twice the bend moves constants by twice, but for curvature
        assert shares[2] - shares[0] == pytest.approx(4 * (shares[1] - shares[0]), rel=0.25)


@pytest.mark.parametrize("bend", [-0.1, 1.0, np.nan])
def test_a_bend_outside_its_range_is_refused(bend):
    with pytest.raises(CurveError, match="bend"):
        fit_course(np.arange(8.0), np.arange(8.0), bend=bend)


MOVED = (PHASE > 0.16) & (PHASE < 5.16)


def with_step(rng, *, constant_s, step, noise=2e-4, gap=0.01):
    """Return a curve whose samples of a moved face lie off the others by a step."""
    curve = 0.03 + gap * relaxing(PHASE, constant_s) + step * MOVED
    return curve + noise * rng.standard_normal(PHASE.size)


@pytest.mark.long
@pytest.mark.parametrize("constant_s", [1.0, 4.0])
def test_pose_offset_in_samples_is_not_quick_blood(constant_s):
    """Steps are drawn from their prior: intervals hold the truth, and plain fits do not."""
    rng = np.random.default_rng(11)
    runs, spread, held, plain = 24, 4e-3, 0, 0
    for _ in range(runs):
        value = with_step(rng, constant_s=constant_s, step=spread * rng.standard_normal())
        found = fit_cycle(PHASE, value, cycle_s=CYCLE_S, pose=PoseStep(MOVED, np.array([spread])))
        low, high = found.interval_s
        held += low <= constant_s <= high
        low, high = fit_cycle(PHASE, value, cycle_s=CYCLE_S).interval_s
        plain += low <= constant_s <= high
    assert held >= stats.binom.ppf(0.001, runs, 0.95)
    assert plain < stats.binom.ppf(0.001, runs, 0.95)


def test_steps_and_changes_are_within_their_errors():
    rng = np.random.default_rng(12)
    runs, spread, pulls = 12, 4e-3, []
    for _ in range(runs):
        step = spread * rng.standard_normal()
        found = fit_cycle(
            PHASE,
            with_step(rng, constant_s=1.0, step=step),
            cycle_s=CYCLE_S,
            pose=PoseStep(MOVED, np.array([spread])),
        )
        change = found.end[0] - found.start[0]
        pulls.append(
            [
                (found.step[0] - step) / found.stderr_step[0],
                (change - 0.01) / found.stderr_change[0],
            ]
        )
    squares = np.square(pulls).sum(axis=0)
    assert (squares < stats.chi2.ppf(0.999, runs)).all()
    # the delay is the same in all runs and near the middle of what it may be: less than its error
    assert (squares > 0.05 * runs).all()


def test_pose_step_alone_leaves_constant_unknown():
    """Blood so quick that poses alone show it: as large as poses may make it, it tells nothing."""
    rng = np.random.default_rng(13)
    value = with_step(rng, constant_s=1.0, step=5e-3, gap=0.0)
    found = fit_cycle(PHASE, value, cycle_s=CYCLE_S, pose=PoseStep(MOVED, np.array([4e-3])))
    assert found.known == "unknown"
    assert "the pose step allows" in str(found)
    # six times what a pose may make is blood, and it was quick
    found = fit_cycle(PHASE, value, cycle_s=CYCLE_S, pose=PoseStep(MOVED, np.array([8e-4])))
    assert found.known == "only below"


def test_blood_sets_out_when_the_face_moves():
    rng = np.random.default_rng(14)
    value = with_step(rng, constant_s=2.0, step=0.0)
    found = fit_cycle(PHASE, value, cycle_s=CYCLE_S, pose=PoseStep(MOVED, np.array([4e-3])))
    low, high = found.delay_interval_s
    # the last sample at rest was 0.007 s after the prompt, the first of the smile 0.507 s
    assert 0.007 - 1e-9 <= low <= 0.16 <= high <= 0.507 + 1e-9
    assert low <= found.delay_s <= high


def test_prior_as_sample_covariance_gives_same_squares():
    """Against generalized least squares with the step's variance written out."""
    rng = np.random.default_rng(15)
    value, noise2, spread = with_step(rng, constant_s=2.0, step=3e-3), 4e-8, 1e-3
    shape = relaxing(PHASE, 2.0)
    samples = CurveSamples.of(PHASE, value, None, PoseStep(MOVED, np.array([spread]))).with_prior(
        np.array([noise2])
    )
    covariance = noise2 * np.eye(PHASE.size) + spread**2 * np.outer(MOVED, MOVED)
    inverse = np.linalg.inv(covariance)
    columns = np.stack([np.ones(PHASE.size), shape], axis=-1)
    level, gap = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse @ value)
    left = value - level - gap * shape
    assert samples.residual(shape)[0] / noise2 == pytest.approx(left @ inverse @ left, rel=1e-9)
    assert samples.levels(shape)[1][0] == pytest.approx(gap, rel=1e-9)
    mean = spread**2 * (MOVED @ inverse @ left)  # of a normal step, given the samples
    assert samples.step(shape)[0] == pytest.approx(mean, rel=1e-6)


@pytest.mark.parametrize(
    ("pose", "named"),
    [
        (PoseStep(MOVED[:5], np.array([1e-3])), "shape"),
        (PoseStep(MOVED, np.array([1e-3, 1e-3])), "shape"),
        (PoseStep(MOVED, np.array([np.nan])), "standard errors"),
    ],
)
def test_steps_mismatching_samples_are_refused(pose, named):
    with pytest.raises(CurveError, match=named):
        fit_cycle(PHASE, relaxing(PHASE, 2.0), cycle_s=CYCLE_S, pose=pose)


def test_residual_of_search_is_spread_over_tolerance(monkeypatch):
    """A square sum of a million at the minimum does not matter to the search."""
    outcomes = []

    def record(found, residual, **more):
        outcomes.append(outcome_from_scipy(found, residual, **more))
        return outcomes[-1]

    monkeypatch.setattr(perfusion_likelihood, "outcome_from_scipy", record)
    grid = np.linspace(0.0, 1.0, 11)
    point = perfusion_likelihood._refined(
        lambda delay, log: 1e6 + (delay - 0.52) ** 2 + (log - 0.48) ** 2,
        np.array([0.5, 0.5]),
        grid,
        grid,
        np.inf,
    )
    assert point == pytest.approx((0.52, 0.48, 1e6), abs=1e-3)
    assert [outcome.converged for outcome in outcomes] == [True]
    assert 0.0 <= outcomes[0].residual <= 1.0
