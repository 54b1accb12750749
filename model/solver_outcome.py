"""Report how an iterative solver ended, in the same form for all of them."""

import logging
import math
from dataclasses import dataclass
from typing import Final, Literal, Protocol

import numpy as np

from model.arrays import Float64Array

StopReason = Literal["tolerance", "stalled", "limit"]

UNKNOWN_CONDITION: Final = math.nan
"""Condition number of equations that are never formed, such as those of a search by values."""


@dataclass(frozen=True, slots=True)
class SolverOutcome:
    """Iterations, residual, condition and reason of the end of an iterative solver.

    Attributes
    ----------
    iterations : int
        Number of steps, 0 where the start is the solution.
    residual : float
        The quantity that the solver compares with its tolerance, as the solver's docstring states.
    condition : float
        Estimate of the condition number of the last equations, at least 1; NaN: not estimated.
    stop : {"tolerance", "stalled", "limit"}
        The residual reached its tolerance, no step lowers it any further, or the largest number of
        iterations was reached.
    """

    iterations: int
    residual: float
    condition: float
    stop: StopReason

    @property
    def converged(self) -> bool:
        """Whether the residual reached its tolerance."""
        return self.stop == "tolerance"

    def warn_unless_converged(self, solver: str, log: logging.Logger) -> "SolverOutcome":
        """Log one warning if the solver did not converge; return the outcome.

        Parameters
        ----------
        solver
            Name of the solver in the warning.
        log
            Logger of the solver's module.

        Examples
        --------
        >>> log = logging.getLogger("doctest")
        >>> SolverOutcome(3, 1e-9, 12.0, "tolerance").warn_unless_converged("fit", log).converged
        True
        """
        if not self.converged:
            reason = "reached its largest number of" if self.stop == "limit" else "stalled after"
            log.warning(
                "%s: %s %d iterations, residual %.2g, condition %.2g; the result is the last step",
                solver,
                reason,
                self.iterations,
                self.residual,
                self.condition,
            )
        return self


class SciPyResult(Protocol):
    """Fields of `scipy.optimize.OptimizeResult` that an outcome needs."""

    success: bool
    nfev: int
    message: str


def outcome_from_scipy(
    result: SciPyResult, residual: float, *, condition: float = UNKNOWN_CONDITION
) -> SolverOutcome:
    """Return the outcome of a search by SciPy.

    Parameters
    ----------
    result
        What `scipy.optimize` returned; its function evaluations count as iterations.
    residual
        See `SolverOutcome.residual`.
    condition
        See `SolverOutcome.condition`.

    Examples
    --------
    >>> from scipy.optimize import minimize
    >>> found = minimize(lambda x: float((x[0] - 2.0) ** 2), [0.0], method="Nelder-Mead")
    >>> outcome_from_scipy(found, float(found.fun)).stop
    'tolerance'
    """
    # numbers of states differ between SciPy's methods, these words do not
    words = result.message.lower()
    stop: StopReason = "limit" if "max" in words or "limit" in words else "stalled"
    return SolverOutcome(
        int(result.nfev), residual, condition, "tolerance" if result.success else stop
    )


def estimate_condition(matrix: Float64Array) -> float:
    """Return the condition number of a symmetric matrix whose diagonal is scaled to one.

    Parameters
    ----------
    matrix : ndarray, shape (N, N)
        Finite, positive semidefinite; rows and columns with a zero diagonal are left out.

    Returns
    -------
    float
        At least 1; infinite for a singular matrix, NaN without a row.

    Examples
    --------
    >>> estimate_condition(np.diag([1e6, 1.0]))
    1.0
    """
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    kept = size > 0.0
    if not kept.any():
        return UNKNOWN_CONDITION
    scaled = matrix[np.ix_(kept, kept)] / np.outer(size[kept], size[kept])
    values = np.linalg.eigvalsh(scaled)
    return float(values[-1] / values[0]) if values[0] > 0.0 else math.inf
