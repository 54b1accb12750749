"""Choose color axes and bin edges for a population of textures.

References
----------
Heeger, Bergen 1995, doi:10.1145/218380.218446, section 3.5 (decorrelated colors).
"""

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks
from model.texture_statistics.histograms import HISTOGRAM_BINS

OPPONENT_AXES = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [1.0, 1.0, -2.0]])
"""Brightness, red less green, yellow less blue: the default axes for colors without variance."""
OPPONENT_AXES /= np.linalg.norm(OPPONENT_AXES, axis=1, keepdims=True)
_RANGE_MARGIN = 0.05


def principal_axes(covariance: Float64Array, unit: float) -> Float64Array:
    """Return eigenvectors as rows by decreasing variance, unique even without variance.

    Parameters
    ----------
    covariance : ndarray, shape (C, C)
    unit : float
        Largest value of the colors; variance at the level of its rounding is ignored.

    Returns
    -------
    ndarray, shape (C, C)
        Orthonormal rows; the largest component of each is positive.

    Raises
    ------
    ValueError
        For a covariance that is not square, or not finite.
    """
    C = len(covariance)
    Checks().within("colors of covariance", C, "[1, inf)")
    Checks().numbers("covariance", covariance, (C, C))
    preferred = OPPONENT_AXES if C == 3 else np.eye(C)
    # orders directions without variance; about float32's rounding variance
    least = 1e-9 * np.trace(covariance) + 1e-13 * unit**2
    ordered = covariance + least * preferred.T @ np.diag(np.arange(C, 0.0, -1.0)) @ preferred
    axes = np.linalg.eigh(ordered)[1].T[::-1]
    # among equal components the first one decides the sign
    largest = axes[np.arange(C), (np.abs(axes) - 1e-3 * np.arange(C)).argmax(axis=1)]
    return np.ascontiguousarray(axes * np.sign(largest)[:, None])


def make_bin_edges(quantiles: ArrayLike, unit: float) -> Float64Array:
    """Return 257 edges: half of the bins uniform in value, half uniform in frequency.

    Parameters
    ----------
    quantiles : array_like
        Even quantiles of the values of every image, with equal weights.
    unit : float
        Largest value of the images, above 0; a range far below it is widened.

    Raises
    ------
    ValueError
        For no values or some that are not finite, and for a `unit` that is not above 0.

    Examples
    --------
    >>> edges = make_bin_edges(np.linspace(0.0, 1.0, 1001), 1.0)
    >>> edges[[0, 128, 256]].round(3).tolist()
    [-0.05, 0.5, 1.05]
    """
    values = np.sort(np.asarray(quantiles, np.float64), axis=None)
    Checks().numbers("quantiles", values, ("n",))
    Checks().within("unit", unit, "(0, inf)")
    low, high = values[0], values[-1]
    room = max(_RANGE_MARGIN * (high - low), 0.5e-4 * unit)
    low, high = low - room, high + room
    at = np.concatenate([[low], values, [high]])
    occurrence = np.concatenate([[0.0], (np.arange(values.size) + 0.5) / values.size, [1.0]])
    share = 0.5 * (at - low) / (high - low) + 0.5 * occurrence
    widths = np.diff(np.interp(np.linspace(0.0, 1.0, HISTOGRAM_BINS + 1), share, at))
    # several edges can coincide at a frequent value: separate them
    least = max(1e-12 * (high - low), 4.0 * float(np.spacing(max(abs(low), abs(high)))))
    widths = np.maximum(widths, least)
    widths *= (high - low) / widths.sum()
    return np.asarray(low + np.concatenate([[0.0], np.cumsum(widths)]))
