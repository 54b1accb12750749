"""Robust statistics of residuals: scale by the median, and Huber's weights."""

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Float64Array

HUBER_SIGMAS = 2.5
"""Robust standard deviations beyond which a residual is down-weighted."""
SIGMA_PER_MAD = 1.4826
"""Standard deviation of normal residuals over the median of their absolute values."""


def mad_sigma(residuals: NDArray) -> float:
    """Return the standard deviation of residuals by the median of their absolute values.

    Examples
    --------
    >>> round(mad_sigma(np.array([-1.0, 0.0, 1.0, 50.0])), 4)
    1.4826
    """
    return SIGMA_PER_MAD * float(np.median(np.abs(residuals)))


def huber_weights(sizes: Float64Array) -> Float64Array:
    """Return Huber's weights of residuals whose sizes are given in standard deviations.

    Examples
    --------
    >>> huber_weights(np.array([1.0, 5.0])).tolist()
    [1.0, 0.5]
    """
    outside = HUBER_SIGMAS / np.maximum(sizes, HUBER_SIGMAS)
    return np.asarray(np.where(sizes > HUBER_SIGMAS, outside, 1.0))
