"""Compute length and direction of plane vectors with errors."""

import math

import numpy as np
from scipy import special

from reconstruction.arrays import Float64Array

UNKNOWN_AXIS_RAD = math.pi / math.sqrt(12.0)
"""Standard deviation of a uniformly distributed axis."""


def quadratic_form(vectors: Float64Array, matrices: Float64Array) -> Float64Array:
    """Return v' M v of vectors (B, n) and covariances (B, n, n): at least 0, (B,)."""
    return np.maximum(np.einsum("bi,bij,bj->b", vectors, matrices, vectors), 0.0)


def estimate_length(
    pair: Float64Array, covariance: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the length of vectors, and their standard errors along and across the vectors.

    Parameters
    ----------
    pair : ndarray, shape (B, 2)
        In any unit, which is that of the result.
    covariance : ndarray, shape (B, 2, 2)

    Returns
    -------
    length, along, across : ndarray, shape (B,)
        A vector of length 0 points along the first axis.

    Examples
    --------
    >>> found = estimate_length(np.array([[0.0, 5.0]]), np.diag([9.0, 4.0])[None])
    >>> [values.tolist() for values in found]
    [[5.0], [2.0], [3.0]]
    """
    length = np.hypot(pair[:, 0], pair[:, 1])
    unit = np.where(length[:, None] > 0, pair / np.where(length > 0, length, 1.0)[:, None], 0.0)
    unit[length == 0, 0] = 1.0
    across = np.stack([-unit[:, 1], unit[:, 0]], axis=-1)
    return (
        length,
        np.sqrt(quadratic_form(unit, covariance)),
        np.sqrt(quadratic_form(across, covariance)),
    )


def wrap_angle(angle: Float64Array, period: float) -> Float64Array:
    """Wrap angles to [0, period), in their unit; values that round to the period become 0.

    Examples
    --------
    >>> wrap_angle(np.array([-90.0, 450.0, -1e-30]), 360.0).tolist()
    [270.0, 90.0, 0.0]
    """
    within = np.mod(angle, period)
    return np.where(within >= period, 0.0, within)


def axis_stderr(h: Float64Array, across: Float64Array) -> Float64Array:
    """Return the standard error of half the direction of a vector with normal errors, rad.

    From the mean resultant length of the direction of a vector of length h with standard error
    ``across``: close to across / (2 h) when that is small, `UNKNOWN_AXIS_RAD` at most.

    Parameters
    ----------
    h, across : ndarray, same shape
        In one unit.

    Examples
    --------
    >>> axis_stderr(np.array([1.0, 0.0]), np.array([0.02, 0.02])).round(3).tolist()
    [0.01, 0.907]
    """
    with np.errstate(divide="ignore", over="ignore"):
        z = np.where(across > 0, 0.5 * (h / np.where(across > 0, across, 1.0)), math.inf) ** 2
    far = z > 1e6
    x = np.where(far, 1.0, z)
    length = np.sqrt(0.5 * math.pi * x) * (special.ive(0, x) + special.ive(1, x))
    spread = np.sqrt(-2.0 * np.log(np.clip(length, 1e-300, 1.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.where(far, 0.5 / np.sqrt(z), spread)
    return np.minimum(0.5 * spread, UNKNOWN_AXIS_RAD)
