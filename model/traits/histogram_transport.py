"""Describe histograms by quantiles, and shift histograms by changes of their quantiles.

The mean of two unimodal histograms can be bimodal; the mean of their quantile functions is one mode
between them (the barycenter of optimal transport on a line). A change of quantiles moves the mass
of any histogram to other values, never makes a fraction negative, and is undone by the opposite
change.

References
----------
Villani 2003, Topics in Optimal Transportation, section 2.2 (the line), doi:10.1090/gsm/058
"""

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

N_QUANTILES = 256
"""Number of quantiles of a histogram, at levels (k + 1/2) / 256."""


class HistogramTransportError(ValueError):
    """Error for histograms, edges or changes that do not fit each other."""


def quantile_levels() -> Float64Array:
    """Return the levels of the quantiles, (256,)."""
    return (np.arange(N_QUANTILES) + 0.5) / N_QUANTILES


def quantiles(histograms: ArrayLike, edges: ArrayLike) -> Float64Array:
    """Return the quantiles of histograms with a uniform density in each bin.

    Parameters
    ----------
    histograms
        (..., bins), at least 0, each of sum 1.
    edges
        (..., bins + 1), increasing; the same leading axes.

    Returns
    -------
    ndarray of float64, shape (..., 256)
        Increasing, in the unit of the edges.

    Examples
    --------
    >>> even = quantiles([0.25] * 4, [0.0, 1.0, 2.0, 3.0, 4.0])
    >>> even[[0, 128, -1]].tolist()
    [0.0078125, 2.0078125, 3.9921875]
    """
    h, e = _checked(histograms, edges)
    at = quantile_levels()
    out = np.empty((len(h), N_QUANTILES))
    for k in range(len(h)):
        filled, place = _rising(np.concatenate([[0.0], np.cumsum(h[k])]), e[k])
        out[k] = np.interp(at, filled / filled[-1], place)
    return out.reshape(*np.shape(histograms)[:-1], N_QUANTILES)


def widen_edges(histograms: ArrayLike, edges: ArrayLike, change: ArrayLike) -> Float64Array:
    """Return edges widened so that shifted quantiles stay inside.

    Parameters
    ----------
    histograms, edges, change
        As of `shift_quantiles`.

    Returns
    -------
    ndarray of float64, shape (..., bins + 1)
        The edges themselves where all quantiles stay inside.
    """
    h, e = _checked(histograms, edges)
    by = _change(histograms, change)
    out = e.copy()
    for k in range(len(h)):
        if not by[k].any():
            continue
        counted = np.flatnonzero(h[k])
        low = min(e[k, 0], e[k, counted[0]] + by[k, 0])
        high = max(e[k, -1], e[k, counted[-1] + 1] + by[k, -1])
        if low < e[k, 0] or high > e[k, -1]:
            out[k] = low + (e[k] - e[k, 0]) * ((high - low) / (e[k, -1] - e[k, 0]))
    return out.reshape(np.shape(edges))


def shift_quantiles(
    histograms: ArrayLike,
    edges: ArrayLike,
    change: ArrayLike,
    *,
    target_edges: ArrayLike | None = None,
) -> Float64Array:
    """Return histograms after a change of their quantiles.

    Parameters
    ----------
    histograms, edges
        As of `quantiles`.
    change
        (..., 256): shift of each quantile, in the unit of the edges.
    onto
        Edges of the result, the histograms' own by default.

    Returns
    -------
    ndarray of float64, shape (..., bins)
        At least 0, each of sum 1. Values whose order a change would swap are merged; mass beyond
        the edges is counted in the last bin. A change of 0 is the identity.

    Examples
    --------
    >>> shift_quantiles([0.0, 1.0, 0.0], [0.0, 1.0, 2.0, 3.0], np.full(256, 0.5)).round(3).tolist()
    [0.0, 0.5, 0.5]
    """
    h, e = _checked(histograms, edges)
    to = e if target_edges is None else _checked(histograms, target_edges)[1]
    by = _change(histograms, change)
    out = np.empty_like(h)
    at = quantile_levels()
    for k in range(len(h)):
        if not by[k].any() and to is e:
            out[k] = h[k]
            continue
        filled = np.concatenate([[0.0], np.cumsum(h[k])])
        filled /= filled[-1]
        # both ends of an empty interval move with their neighboring quantiles
        place = np.maximum.accumulate(e[k] + np.interp(filled, at, by[k]))
        span = e[k][-1] - e[k][0]
        apart = place + 1e-12 * span * np.arange(len(place))
        cumulated = np.interp(to[k], apart, filled, left=0.0, right=1.0)
        cumulated[0], cumulated[-1] = 0.0, 1.0
        out[k] = np.diff(cumulated)
    return out.reshape(np.shape(histograms))


def _change(histograms: ArrayLike, change: ArrayLike) -> Float64Array:
    shape = (*np.shape(histograms)[:-1], N_QUANTILES)
    by = np.broadcast_to(np.asarray(change, np.float64), shape).reshape(-1, N_QUANTILES)
    Checks(HistogramTransportError).within("change", by)
    return by


def _checked(histograms: ArrayLike, edges: ArrayLike) -> tuple[Float64Array, Float64Array]:
    given = np.asarray(histograms, np.float64)
    over = np.asarray(edges, np.float64)
    Checks(HistogramTransportError).shape("histograms", given, ("...", "bins"))
    Checks(HistogramTransportError).shape("edges", over, (*given.shape[:-1], given.shape[-1] + 1))
    h = given.reshape(-1, given.shape[-1])
    if not np.isfinite(h).all() or h.min() < 0 or not np.allclose(h.sum(axis=1), 1.0, atol=1e-5):
        raise HistogramTransportError("histograms: got negative shares or a sum that is not 1")
    return h, over.reshape(-1, given.shape[-1] + 1)


def _rising(filled: Float64Array, place: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Omit repeated levels, so that an empty interval contains no quantiles.

    Of a run of equal levels both ends are kept, the second slightly increased.
    """
    step = np.diff(filled) > 0
    keep = np.concatenate([[step[0]], step[:-1] | step[1:], [step[-1]]])
    filled, place = filled[keep], place[keep]
    return filled + 1e-15 * np.arange(len(filled)), place
