"""Solvers state how they ended, and warn once if they did not converge."""

import logging
import math

import numpy as np
import pytest
from scipy.optimize import minimize

from model.solver_outcome import SolverOutcome, estimate_condition, outcome_from_scipy
from reconstruction.normal_integration import IntegrationSettings, integrate_map
from reconstruction.normal_integration.discontinuities import (
    BilateralSettings,
    integrate_with_discontinuities,
)

LOG = logging.getLogger("solver")


def bumpy_normals(rng, side=48):
    slopes = rng.normal(scale=0.2, size=(side, side, 2))
    return np.concatenate([slopes, np.ones((side, side, 1))], axis=-1)


def rosenbrock(p):
    return float((1.0 - p[0]) ** 2 + 100.0 * (p[1] - p[0] ** 2) ** 2)


@pytest.mark.parametrize(("stop", "warnings"), [("tolerance", 0), ("limit", 1), ("stalled", 1)])
def test_outcome_warns_once_unless_converged(stop, warnings, caplog):
    outcome = SolverOutcome(7, 0.1, math.nan, stop)
    assert outcome.warn_unless_converged("a fit", LOG) is outcome
    assert outcome.converged == (warnings == 0)
    assert len(caplog.records) == warnings
    assert all("a fit" in r.getMessage() and "7" in r.getMessage() for r in caplog.records)


@pytest.mark.parametrize("method", ["Nelder-Mead", "L-BFGS-B"])
@pytest.mark.parametrize(("most", "stop"), [(3, "limit"), (2000, "tolerance")])
def test_scipy_search_with_few_steps_is_limited(method, most, stop):
    found = minimize(rosenbrock, [-1.0, 1.0], method=method, options={"maxiter": most})
    assert outcome_from_scipy(found, float(found.fun)).stop == stop


def test_condition_is_of_scaled_matrix():
    """Eigenvalues of [[1, c], [c, 1]] are 1 + c and 1 - c, whatever the rows' units."""
    units = np.diag([1.0, 1e6])
    matrix = units @ np.array([[1.0, 0.5], [0.5, 1.0]]) @ units
    assert estimate_condition(matrix) == pytest.approx(3.0)
    assert math.isnan(estimate_condition(np.zeros((2, 2))))
    assert estimate_condition(np.ones((2, 2))) > 1e12


def test_integration_reports_condition_and_limit(rng):
    normals = bumpy_normals(rng)
    solved = integrate_map(normals, method="multigrid").convergence
    assert (solved.stop, solved.converged) == ("tolerance", True)
    assert 1.0 <= solved.condition < 10.0  # a multigrid's cycle is nearly the inverse
    settings = IntegrationSettings(tolerance=1e-12, iterations=1)
    stopped = integrate_map(normals, method="multigrid", settings=settings).convergence
    assert (stopped.stop, stopped.iterations) == ("limit", 1)


def test_bilateral_integration_warns_at_its_limit(rng, caplog):
    settings = BilateralSettings(rounds=2, stop=0.0)
    found = integrate_with_discontinuities(bumpy_normals(rng), settings=settings)
    assert found.outcome.stop == "limit"
    assert ["bilateral integration" in r.getMessage() for r in caplog.records] == [True]
