"""Fit the polarizers of a sphere of lights to the reflections of each light in a glass ball.

Glass reflects along and across the plane of incidence by Fresnel's amplitudes, which rotates the
polarization of each light by a known angle. The light behind the analyzer at two or more readings
then separates three causes of leakage: the analyzer's zero, common to all lights; the extinction of
the polarizers; and each light's own axis. From these causes follows the leakage of another surface,
skin, in each direction, which differs from that of the glass.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import BoolArray, Float64Array
from capture.calibration.led_sphere.arrow_system import ArrowSystem
from capture.calibration.polarization import PolarizationError
from capture.calibration.polarization.polarized_reflection import FacetReflection

_log = logging.getLogger(__name__)

MAX_ANALYZER_ZERO_DEG = 30  # of the analyzer, searched
TYPICAL_LEAK = 3e-4  # of a polarizer, extinction 1e3 to 1e4
LOG_LEAK_SCATTER = 1.5  # of its logarithm
TYPICAL_AXIS_ERROR_RAD = np.radians(1.0)
AXIS_ERROR_RANGE_RAD = (np.radians(0.02), np.radians(5.0))
AXIS_T_DOF = 4.0  # degrees of freedom of Student's t for the lights' own axes: some may be far off
MAX_POLARIZER_STEPS = 200
POLARIZER_STEP_TOL = 1e-6
POLARIZER_DERIVATIVE_STEP = 1e-5
STEP_PARTS = (1.0, 0.5, 0.25, 0.1, 0.02, 0.0)  # of a light's step, tried
MAX_TURN_STEP_RAD = 0.1
# widths of the axes' scatter within which a light may have a second solution
MODE_SCATTER_WIDTHS = 6.0
MAX_MODE_AXIS_ERROR_RAD = np.radians(30.0)
N_MODE_GRID = 41
N_MODE_ITERATIONS = 5
MAX_MODE_ROUNDS = 6
MODE_TOL_RAD = np.radians(0.01)
MIN_POLARIZED_LIGHTS = 6


@dataclass(frozen=True, slots=True, eq=False)
class PolarizerFit:
    """Polarizers fitted to the spots of all lights and readings.

    Attributes
    ----------
    strength, strength_stderr : ndarray of float64, shape (L,)
        Flux of each light at an ideal mirror without an analyzer, per second at level 1.
    axis_error_rad, axis_error_stderr_rad : ndarray of float64, shape (L,)
        Deviation of each light's axis; shrunk to 0 where the readings leave its sign open.
    zero_rad, zero_stderr_rad : float
        True angle of the analyzer minus its reading.
    light_leak, analyzer_leak : float
        Inverse extinction ratios.
    covariance : ndarray of float64, shape (L, 4, 4)
        Covariance of rotation, zero and the logarithms of both leaks, for each light.
    axis_scatter_rad : float
        Scatter of the lights' axes about their nominal angles.
    chi2_per_dof : float
        Above 1 the errors have been scaled up.
    """

    strength: Float64Array
    strength_stderr: Float64Array
    axis_error_rad: Float64Array
    axis_error_stderr_rad: Float64Array
    zero_rad: float
    zero_stderr_rad: float
    light_leak: float
    analyzer_leak: float
    covariance: Float64Array
    axis_scatter_rad: float
    chi2_per_dof: float

    @property
    def leak_stderr(self) -> tuple[float, float]:
        """Standard errors of the lights' and of the analyzer's leak."""
        a, b = np.sqrt(self.covariance[0, 2, 2]), np.sqrt(self.covariance[0, 3, 3])
        return float(self.light_leak * a), float(self.analyzer_leak * b)


def fit_polarizers(
    readings_rad: ArrayLike,
    rates: Float64Array,
    variance: Float64Array,
    good: BoolArray,
    reflection: FacetReflection,
) -> PolarizerFit:
    """Fit the polarizers and the intensities of the lights to the spots' fluxes.

    Parameters
    ----------
    readings_rad : array_like, shape (E,)
        Reading of the analyzer in each exposure; at least two that differ modulo pi.
    rates, variance : ndarray of float64, shape (E, L)
        Flux of each spot, per second at level 1, and its variance.
    good : ndarray of bool, shape (E, L)
        False where it must not be used (saturated, cut).
    reflection : Reflection
        Reflection by the ball's glass.

    Returns
    -------
    FilmFit
        Lights without two good readings have strength, rotation 0 with the errors of the prior.

    Raises
    ------
    PolarizationError
        If the readings or the lights do not suffice.

    Notes
    -----
    Least squares with priors: the lights' axes scatter about their nominal angles by Student's t (4
    degrees of freedom) of a fitted width, and the polarizers leak 1e-5 to 1e-2. With readings 0 and
    90 only, the sign of a light's own rotation follows from the rotation by the glass itself, and
    is open where that is smaller; readings on both sides of 90 determine it.
    """
    readings = np.asarray(readings_rad, np.float64)
    if len(np.unique(np.round(np.exp(2j * readings), 6))) < 2:
        raise PolarizationError(
            f"analyzer: got readings {np.degrees(readings).round(2).tolist()} degrees, expected "
            "two that differ, parallel and crossed"
        )
    seen = np.array([len(np.unique(np.round(np.exp(2j * readings[ok]), 6))) >= 2 for ok in good.T])
    if seen.sum() < MIN_POLARIZED_LIGHTS:
        raise PolarizationError(
            f"polarizers: {int(seen.sum())} lights have two readings that are not saturated, "
            f"expected {MIN_POLARIZED_LIGHTS} or more; add a shorter exposure"
        )
    weight = np.where(good & seen, 1.0 / np.where(variance > 0, variance, 1.0), 0.0)
    values = np.where(weight > 0, rates, 0.0)
    fits = [
        _PolarizerProblem(readings, values, weight, reflection, zero).solve_all_modes()
        for zero in _starts(readings, values, weight, reflection)
    ]
    return min(fits, key=lambda fit: fit.cost).result(seen)


def leakage(fit: PolarizerFit, reflection: FacetReflection) -> tuple[Float64Array, Float64Array]:
    """Return crossed over parallel for specular reflection by a surface, with standard errors.

    Parameters
    ----------
    fit : FilmFit
    reflection : Reflection
        Reflection by the surface in question, for example skin, whose facets mirror each light into
        the camera.

    Returns
    -------
    leakage, stderr : ndarray of float64, shape (L,)
        Ratio of readings 90 and 0. The mean over the errors of the polarizers, not the value for
        the best fit: leakage is quadratic in the angles, so that errors of either sign add to it.
    """
    count = len(fit.axis_error_rad)
    shared = (fit.zero_rad, np.log(fit.light_leak), np.log(fit.analyzer_leak))
    at = np.stack([fit.axis_error_rad, *(np.full(count, x) for x in shared)], axis=-1)
    root = np.linalg.cholesky(fit.covariance + 1e-18 * np.eye(4))
    values = []
    # cubature of third degree: 2 n points at sqrt(n) standard deviations
    for column in range(4):
        for sign in (2.0, -2.0):
            turn, zero, light, analyzer = (at + sign * root[:, :, column]).T
            both = reflection.transmit_through_analyzer(
                [0.0, np.pi / 2], turn, zero, np.exp(light), np.exp(analyzer)
            )
            values.append(both[1] / both[0])
    table = np.array(values)
    return table.mean(axis=0), table.std(axis=0, ddof=1)


def _starts(
    readings: Float64Array, values: Float64Array, weight: Float64Array, reflection: FacetReflection
) -> list[float]:
    """Return the two best zeros of the analyzer for lights at their nominal axes, rad."""
    # the axes deviate from nominal: the spots differ from the model by some thousandths
    slack = (3e-3 * np.abs(values).max(axis=0)) ** 2
    soft = np.where(weight > 0, weight / (1.0 + weight * slack), 0.0)
    zeros = np.radians(np.arange(-MAX_ANALYZER_ZERO_DEG, MAX_ANALYZER_ZERO_DEG + 1.0, 1.0))
    cost = []
    for zero in zeros:
        u = reflection.transmit_through_analyzer(readings, 0.0, zero, TYPICAL_LEAK, TYPICAL_LEAK)
        power = np.sum(soft * u**2, axis=0)
        strength = np.sum(soft * u * values, axis=0) / np.where(power > 0, power, 1.0)
        cost.append(float(np.sum(soft * (values - strength * u) ** 2)))
    padded = np.pad(cost, 1, constant_values=np.inf)
    least = [i for i in range(len(cost)) if padded[i] > cost[i] <= padded[i + 2]]
    return [float(zeros[i]) for i in sorted(least, key=lambda i: cost[i])[:2]]


class _PolarizerProblem:
    """One descent: intensities and rotations of the lights, and three common parameters.

    The normal matrix has arrow form: a 2 x 2 block for each light, and a border of three. The
    blocks are eliminated one by one (Schur complement), so that a step costs O(L).
    """

    def __init__(
        self,
        readings: Float64Array,
        values: Float64Array,
        weight: Float64Array,
        reflection: FacetReflection,
        zero: float,
    ) -> None:
        self.readings, self.values, self.weight = readings, values, weight
        self.reflection = reflection
        self.lit = (weight > 0).any(axis=0)
        count = values.shape[1]
        self.turn = np.zeros(count)
        self.shared = np.array([zero, np.log(TYPICAL_LEAK), np.log(TYPICAL_LEAK)])
        self.scatter = float(TYPICAL_AXIS_ERROR_RAD)
        self.pull = np.ones(count)  # weight of each light's turn among all, from Student's t
        self.strength, _ = self._fit_strength(self.turn, self.shared)

    def _fit_strength(
        self, turn: Float64Array, shared: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return each light's best intensity and its weighted squared misfit."""
        u = self._transmitted(turn, shared)
        power = np.sum(self.weight * u**2, axis=0)
        strength = np.sum(self.weight * u * self.values, axis=0) / np.where(power > 0, power, 1.0)
        return strength, np.sum(self.weight * (self.values - strength * u) ** 2, axis=0)

    def _transmitted(self, turn: Float64Array, shared: Float64Array) -> Float64Array:
        zero, light, analyzer = shared
        return self.reflection.transmit_through_analyzer(
            self.readings, turn, zero, np.exp(light), np.exp(analyzer)
        )

    def _objective(self, strength: Float64Array, turn: Float64Array, shared: Float64Array) -> float:
        miss = self.values - strength * self._transmitted(turn, shared)
        beyond = (shared[1:] - np.log(TYPICAL_LEAK)) / LOG_LEAK_SCATTER
        return float(
            np.sum(self.weight * miss**2)
            + np.sum(self.pull * turn**2) / self.scatter**2
            + np.sum(beyond**2)
        )

    @property
    def cost(self) -> float:
        """Return minus twice the logarithm of the posterior, up to a constant."""
        data = self._objective(self.strength, self.turn, self.shared)
        data -= float(np.sum(self.pull * self.turn**2)) / self.scatter**2
        tails = np.log1p(self.turn[self.lit] ** 2 / (AXIS_T_DOF * self.scatter**2))
        return data + float(
            (AXIS_T_DOF + 1) * tails.sum() + 2 * self.lit.sum() * np.log(self.scatter)
        )

    def _normal(self) -> tuple[ArrowSystem, ArrowSystem]:
        """Return the equations of Gauss and Newton, and those with each light's curvature."""
        h = POLARIZER_DERIVATIVE_STEP
        u = self._transmitted(self.turn, self.shared)
        above = self._transmitted(self.turn + h, self.shared)
        below = self._transmitted(self.turn - h, self.shared)
        by_turn = (above - below) / (2 * h)
        by_shared = [
            (
                self._transmitted(self.turn, self.shared + e)
                - self._transmitted(self.turn, self.shared - e)
            )
            / (2 * h)
            for e in h * np.eye(3)
        ]
        local = np.stack([u, self.strength * by_turn], axis=-1)  # (E, L, 2)
        shared = self.strength[:, None] * np.stack(by_shared, axis=-1)  # (E, L, 3)
        miss = self.values - self.strength * u
        w = self.weight
        block = np.einsum("ek,eki,ekj->kij", w, local, local)
        border = np.einsum("ek,eki,ekj->kij", w, local, shared)
        corner = np.einsum("ek,eki,ekj->ij", w, shared, shared)
        one = np.einsum("ek,eki,ek->ki", w, local, miss)
        other = np.einsum("ek,eki,ek->i", w, shared, miss)
        block[:, 1, 1] += self.pull / self.scatter**2
        one[:, 1] -= self.pull * self.turn / self.scatter**2
        block[~self.lit, 0, 0] = 1.0
        corner[1:, 1:] += np.eye(2) / LOG_LEAK_SCATTER**2
        other[1:] -= (self.shared[1:] - np.log(TYPICAL_LEAK)) / LOG_LEAK_SCATTER**2
        # crossed light is quadratic in the turn: without its curvature, steps halve the distance
        bend = (above - 2.0 * u + below) / h**2
        curved = block.copy()
        curved[:, 1, 1] -= np.sum(w * miss * self.strength * bend, axis=0)
        curved[:, 0, 1] -= np.sum(w * miss * by_turn, axis=0)
        curved[:, 1, 0] = curved[:, 0, 1]
        bent = np.linalg.det(curved) <= 1e-3 * np.linalg.det(block)
        curved[bent] = block[bent]
        rest = border, corner, one, other
        return ArrowSystem(block, *rest), ArrowSystem(curved, *rest)

    def solve(self) -> _PolarizerProblem:
        """Descend with Marquardt's damping; between steps fit the scatter of the axes."""
        damping = 1e-3
        now = self._objective(self.strength, self.turn, self.shared)
        for _ in range(MAX_POLARIZER_STEPS):
            plain, curved = self._normal()
            while True:
                local, shared = curved.solve(damping, plain)
                trial = self._stepped(local, self.shared + np.clip(shared, -0.5, 0.5))
                cost = self._objective(*trial)
                if cost <= now or damping > 1e8:
                    break
                damping *= 10
            gain = now - cost
            if gain >= 0:
                self.strength, self.turn, self.shared = trial
            damping = max(damping / 10, 1e-9)
            wider = self._scatter(plain.covariance()[0][:, 1, 1])
            # Weight of a residual z under Student's t with nu degrees of freedom: (nu + 1) / (nu +
            # z^2), the expectation step of its scale mixture of normals.
            self.pull = np.where(
                self.lit, (AXIS_T_DOF + 1) / (AXIS_T_DOF + (self.turn / wider) ** 2), 1.0
            )
            settled = abs(wider / self.scatter - 1) < 1e-3
            self.scatter = wider
            now = self._objective(self.strength, self.turn, self.shared)
            if settled and gain < POLARIZER_STEP_TOL:
                break
        else:
            _log.warning(
                "axes of polarizers: not converged after %d steps, last gain %.2g of %.2g",
                MAX_POLARIZER_STEPS,
                gain,
                now,
            )
        return self

    def _stepped(
        self, local: Float64Array, shared: Float64Array
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Return the parameters after a step that each light shortens until its own cost falls."""
        best = np.full(len(self.turn), np.inf)
        strength, turn = self.strength, self.turn
        for part in STEP_PARTS:
            trial = self.turn + part * np.clip(local[:, 1], -MAX_TURN_STEP_RAD, MAX_TURN_STEP_RAD)
            level, cost = self._fit_strength(trial, shared)
            cost += self.pull * trial**2 / self.scatter**2
            lower = cost < best
            best = np.where(lower, cost, best)
            strength, turn = np.where(lower, level, strength), np.where(lower, trial, turn)
        return strength, turn, shared

    def solve_all_modes(self) -> _PolarizerProblem:
        """Descend, then again from better solutions of single lights on the other side."""
        self.solve()
        for _ in range(MAX_MODE_ROUNDS):
            modes, cost = self._modes()
            better = self.lit & (cost[0] < self._light_cost(self.turn)[0] - 1e-2)
            if not better.any():
                break
            self.turn = np.where(better, modes[0], self.turn)
            self.strength = np.where(better, self._light_cost(self.turn)[1], self.strength)
            self.solve()
        else:
            _log.warning("axes of polarizers: still change sides after %d rounds", MAX_MODE_ROUNDS)
        return self

    def _light_cost(self, turn: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return each light's own part of the cost at its best intensity, and that intensity."""
        strength, miss = self._fit_strength(turn, self.shared)
        tail = (AXIS_T_DOF + 1) * np.log1p(turn**2 / (AXIS_T_DOF * self.scatter**2))
        return miss + tail, strength

    def _modes(self) -> tuple[Float64Array, Float64Array]:
        """Return the two best rotations of each light and their costs, shapes (2, L)."""
        even = np.linspace(-1.0, 1.0, N_MODE_GRID)
        # closely where most axes are, coarsely where one far off may be
        grid = np.unique(
            np.append(MODE_SCATTER_WIDTHS * self.scatter * even, MAX_MODE_AXIS_ERROR_RAD * even)
        )
        steps = np.maximum(np.diff(grid, prepend=grid[0]), np.diff(grid, append=grid[-1]))
        cost = np.array([self._light_cost(np.full_like(self.turn, g))[0] for g in grid])
        padded = np.pad(cost, ((1, 1), (0, 0)), constant_values=np.inf)
        valley = (padded[:-2] > cost) & (cost <= padded[2:])
        order = np.argsort(np.where(valley, cost, np.inf), axis=0)[:2]
        found = []
        for turn, width in zip(grid[order], steps[order], strict=True):
            at = turn
            for _ in range(N_MODE_ITERATIONS):
                near = at + width * np.linspace(-1, 1, 9)[:, None]
                costs = np.array([self._light_cost(t)[0] for t in near])
                best = np.argmin(costs, axis=0)
                at = np.take_along_axis(near, best[None], axis=0)[0]
                width = width / 4
            found.append((at, self._light_cost(at)[0]))
        modes, costs = (np.array(part) for part in zip(*found, strict=True))
        first = np.argsort(costs, axis=0)
        modes, costs = (np.take_along_axis(part, first, axis=0) for part in (modes, costs))
        # one minimum only, or both descents into the same one
        single = (valley.sum(axis=0) < 2) | (np.abs(modes[0] - modes[1]) < MODE_TOL_RAD)
        costs[1, single] = np.inf
        return modes, costs

    def _scatter(self, variance: Float64Array) -> float:
        """Return the width of the axes' scatter: one step of expectation and maximization."""
        square = (self.pull * (self.turn**2 + variance))[self.lit].mean()
        return float(np.clip(np.sqrt(square), *AXIS_ERROR_RANGE_RAD))

    def result(self, observed: BoolArray) -> PolarizerFit:
        """Return the fit, with errors scaled up where the residuals exceed the noise."""
        # information of the scattered axes: slope and variance of their pull (a sandwich estimate),
        # since weights that follow the residuals would count their own scatter as information
        z = self.turn[self.lit] / self.scatter
        slope = ((AXIS_T_DOF + 1) * (AXIS_T_DOF - z**2) / (AXIS_T_DOF + z**2) ** 2).sum()
        spread = ((self.pull[self.lit] * z) ** 2).sum()
        known = np.clip(slope**2 / max(spread, 1e-9) / len(z), 0.2, 1.0)
        self.pull = np.full_like(self.pull, known)
        local, both, shared = self._normal()[0].covariance()
        u = self._transmitted(self.turn, self.shared)
        chi2 = float(np.sum(self.weight * (self.values - self.strength * u) ** 2))
        # information from the data, not from the prior of the axes: 1 - posterior / prior variance
        from_data = 1.0 - self.pull * local[:, 1, 1] / self.scatter**2
        free = float(np.sum(self.weight > 0) - self.lit.sum() - from_data[self.lit].sum() - 3)
        per_dof = chi2 / max(free, 1.0)
        wide = max(per_dof, 1.0)
        # a rotation to the other side gives the same crossed light: compute its probability
        modes, costs = self._modes()
        other = np.exp(-0.5 * np.clip(costs[1] - costs[0], 0.0, 700.0))
        other = np.where(self.lit, other / (1.0 + other), 0.0)
        doubt = other * (1.0 - other)
        apart = np.where(doubt > 0, modes[1] - modes[0], 0.0)
        local[:, 1, 1] += doubt * apart**2 / wide
        shared[0, 0] += 4 * doubt[self.lit].mean() * self.scatter**2 / wide
        count = len(self.turn)
        covariance = np.empty((count, 4, 4))
        covariance[:, 0, 0] = local[:, 1, 1]
        covariance[:, 0, 1:] = covariance[:, 1:, 0] = both[:, 1]
        covariance[:, 1:, 1:] = shared
        covariance *= wide
        return PolarizerFit(
            strength=np.where(observed, self.strength, 0.0),
            strength_stderr=np.where(observed, np.sqrt(wide * local[:, 0, 0]), 0.0),
            axis_error_rad=self.turn,
            axis_error_stderr_rad=np.sqrt(covariance[:, 0, 0]),
            zero_rad=float(self.shared[0]),
            zero_stderr_rad=float(np.sqrt(covariance[0, 1, 1])),
            light_leak=float(np.exp(self.shared[1])),
            analyzer_leak=float(np.exp(self.shared[2])),
            covariance=covariance,
            axis_scatter_rad=self.scatter,
            chi2_per_dof=per_dof,
        )
