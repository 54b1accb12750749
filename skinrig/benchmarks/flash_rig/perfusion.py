"""Benchmark of time curves of blood: the time constant of five regions, against SciPy's fit."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.optimize import OptimizeWarning, curve_fit

from capture.plan.multiplexed import multiplexed_plan
from capture.plan.phases import phase_coverage
from capture.rig import load_rig
from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.facial_color.perfusion_curves import (
    TRANSITION_FALSE_ALARM_RATE,
    find_transition,
)
from reconstruction.facial_color.perfusion_fit import RelaxationFit, fit_cycle
from rigsim.subject.perfusion_course import PromptedCourse
from skinrig.arrays import Float64Array
from skinrig.benchmarks.flash_rig.efficiency import differentiate
from skinrig.benchmarks.measurement import measure_processor_seconds
from skinrig.benchmarks.resampling import gaussian_rms
from skinrig.benchmarks.results import ErrorEstimate
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MELANIN_BANDS

PROMPT_S = 5.0
CYCLE_S = 2 * PROMPT_S
TIME_CONSTANT_S = 2.0
REACTION_S = 0.16
REST_BLOOD, BLOOD_NOISE = 0.03, 4e-4
BLOOD_CHANGES = (0.0065, -0.002, 0.001, 0.004, 0.009)
"""Change of blood in the five regions; the noise is that of a disc of 12 px in a small image."""


@dataclass(frozen=True, slots=True)
class ShotSequence:
    """Shots of a capture sequence at a constant period."""

    captures: int
    shot_period_s: float

    @property
    def phase_s(self) -> Float64Array:
        """Phases of the shots, s."""
        return np.asarray((np.arange(self.captures) * self.shot_period_s) % CYCLE_S + 0.007)

    def levels(self, constant_s: float, reaction_s: float = REACTION_S) -> Float64Array:
        """Return the simulated relative level of blood at each shot, in the steady cycle."""
        course = PromptedCourse(
            "smile",
            rise_s=constant_s,
            fall_s=constant_s,
            reaction_s=reaction_s,
            reaction_spread_s=0.0,
        )
        for number in range(40):
            course.prompt(PROMPT_S * number, "smile" if number % 2 == 0 else "neutral")
        settled_s = 10 * CYCLE_S
        return np.array([course.level(settled_s + phase) for phase in self.phase_s])

    def draw(
        self, constant_s: float, rng: np.random.Generator, noise: float = BLOOD_NOISE
    ) -> Float64Array:
        """Draw noisy curves of the five regions, (5, captures)."""
        clean = REST_BLOOD + np.outer(BLOOD_CHANGES, self.levels(constant_s))
        return np.asarray(clean + noise * rng.standard_normal(clean.shape))

    def time_constant_bound_s(self) -> float:
        """Return the Cramér-Rao bound of the time constant, s, with unknown delay and levels."""
        # Parameters: time constant, delay, then rest level and change of each region. The
        # information matrix is scaled to a unit diagonal before the inversion.
        step = 1e-4
        slope = (self.levels(TIME_CONSTANT_S + step) - self.levels(TIME_CONSTANT_S - step)) / (
            2 * step
        )
        level = self.levels(TIME_CONSTANT_S)
        shift = self.levels(TIME_CONSTANT_S, REACTION_S + step)
        shift = (shift - self.levels(TIME_CONSTANT_S, REACTION_S - step)) / (2 * step)
        size = 2 + 2 * len(BLOOD_CHANGES)
        information = np.zeros((size, size))
        for region, gap in enumerate(BLOOD_CHANGES):
            rows = np.zeros((size, self.captures))
            rows[0], rows[1] = gap * slope, gap * shift
            rows[2 + 2 * region], rows[3 + 2 * region] = 1.0, level
            information += rows @ rows.T / BLOOD_NOISE**2
        scale = np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information / np.outer(scale, scale))
        return float(np.sqrt(covariance[0, 0]) / scale[0])


def fit_with_scipy(phase_s: Float64Array, value: Float64Array) -> tuple[float, float]:
    """Return time constant and standard error of one curve, s, by SciPy's curve_fit."""

    def model(
        phase: Float64Array, low: float, gap: float, delay: float, constant: float
    ) -> Float64Array:
        # steady cycle: the level at the start, b, falls to itself over the other half cycle,
        # b = (1 - b) q with q = exp(-T / tau), hence b = q / (1 + q)
        elapsed = (phase - delay) % CYCLE_S
        decay = np.exp(-PROMPT_S / constant)
        begin = decay / (1.0 + decay)
        rising = 1.0 - (1.0 - begin) * np.exp(-elapsed / constant)
        falling = (1.0 - begin) * np.exp(-(elapsed - PROMPT_S) / constant)
        return np.asarray(low + gap * np.where(elapsed < PROMPT_S, rising, falling))

    start = (float(value.min()), float(np.ptp(value)), 0.1, 1.0)
    bounds = ([-1.0, -1.0, 0.0, 1e-2], [1.0, 1.0, 2.5, 40.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OptimizeWarning)
        found, covariance = curve_fit(model, phase_s, value, p0=start, bounds=bounds)
    return float(found[3]), float(np.sqrt(covariance[3, 3]))


def measure_curve_fits(stage: BenchmarkStage) -> None:
    """Measure fits over the number of shots, of five regions or the best one, and by SciPy."""
    trains = [ShotSequence(22, 5.5), ShotSequence(44, 10.25)]
    if not stage.toy:
        trains = [ShotSequence(11, 5.5), *trains, ShotSequence(88, 10.25)]
    runs = 3 if stage.toy else 30
    for train in trains:
        phase = train.phase_s
        for way in ("five regions", "best region", "best region, scipy"):
            rng = np.random.default_rng(0)
            draws = [train.draw(TIME_CONSTANT_S, rng) for _ in range(runs)]

            def fitted_s(values: Float64Array) -> float:
                if way == "best region, scipy":
                    return fit_with_scipy(phase, values[-1])[0]
                curves = values if way == "five regions" else values[-1]
                return fit_cycle(phase, curves, cycle_s=CYCLE_S).time_constant_s

            off = np.array([fitted_s(values) for values in draws]) - TIME_CONSTANT_S
            outcome = gaussian_rms(
                off, bound=train.time_constant_bound_s() if way == "five regions" else None
            )
            timing, _ = stage.time(lambda: fitted_s(draws[0]))
            knobs = {"captures": train.captures, "every s": train.shot_period_s, "fit": way}
            stage.add(knobs, timing, outcome)
    stage.by_band |= {name: _on_skin(factor, runs) for name, factor in noise_by_band().items()}
    if not stage.toy:
        stage.limits = _limits(stage, runs)


def noise_by_band() -> dict[str, float]:
    """Return the noise of blood by melanin band, relative to light skin, at equal exposure.

    From the Cramér-Rao bound of hemoglobin at equal electrons of a white pixel.
    """
    table = color_table.build(
        "Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )
    found = {}
    for name, band in MELANIN_BANDS.items():
        at = np.array([band.melanin, band.hemoglobin])
        color = table.lookup(*at)
        slopes = differentiate(lambda p: table.lookup(*p).reshape(3), at)
        # shot noise: the variance is proportional to the signal, so that J^T diag(1 / c) J
        information = slopes.T @ (slopes / color.reshape(3, 1))
        found[name] = float(np.sqrt(np.linalg.inv(information)[1, 1]))
    least = found["light"]
    return {name: value / least for name, value in found.items()}


def _on_skin(noise_factor: float, runs: int) -> ErrorEstimate:
    """Return the error of five regions in 44 captures, at a multiple of the noise."""
    train, rng = ShotSequence(44, 10.25), np.random.default_rng(0)
    found = []
    for _ in range(runs):
        values = train.draw(TIME_CONSTANT_S, rng, noise_factor * BLOOD_NOISE)
        found.append(fit_cycle(train.phase_s, values, cycle_s=CYCLE_S).time_constant_s)
    return gaussian_rms(
        np.array(found) - TIME_CONSTANT_S, bound=noise_factor * train.time_constant_bound_s()
    )


def _limits(stage: BenchmarkStage, runs: int) -> LimitValues:
    rig = load_rig("flash")
    half, quarter = (
        phase_coverage(multiplexed_plan(rig, shot_period_s=s)) for s in ("5.5", "10.25")
    )
    rng = np.random.default_rng(1)
    coarse, fine = ShotSequence(22, 5.5), ShotSequence(44, 10.25)
    quick: list[RelaxationFit] = []
    alarms = held = 0
    for _ in range(runs):
        values = coarse.draw(0.01, rng)
        quick.append(fit_cycle(coarse.phase_s, values, cycle_s=CYCLE_S))
        found = find_transition(coarse.phase_s, values[-1], cycle_s=CYCLE_S)
        alarms += found.seen
        slow = fit_cycle(fine.phase_s, fine.draw(TIME_CONSTANT_S, rng), cycle_s=CYCLE_S)
        held += slow.interval_s[0] <= TIME_CONSTANT_S <= slow.interval_s[1]
    again = fine.draw(TIME_CONSTANT_S, rng)
    spent_s = measure_processor_seconds(lambda: fit_cycle(fine.phase_s, again, cycle_s=CYCLE_S))
    five, _, by_scipy = (p.error for p in stage.points if p.knobs["captures"] == 44)
    # three binomial standard deviations beyond the stated rates
    beyond = 3 * float(
        np.sqrt(TRANSITION_FALSE_ALARM_RATE * (1 - TRANSITION_FALSE_ALARM_RATE) / runs)
    )
    return {
        "phases_22": half.distinct,
        "phases_44": quarter.distinct,
        "quick": max(fit.interval_s[1] for fit in quick),
        "alarms": (alarms / runs, TRANSITION_FALSE_ALARM_RATE + beyond),
        "held": (held / runs, 0.95 - beyond),
        "over_bound": (five / fine.time_constant_bound_s(), 1.0 + 3 / float(np.sqrt(2 * runs))),
        "over_scipy": five / by_scipy,
        "seconds": spent_s,
    }
