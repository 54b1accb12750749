"""Errors of a predicted state against its ground truth, and those of simpler animation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.checks import Checks


@dataclass(frozen=True, slots=True)
class PredictionErrors:
    """Root mean square errors of one state's hemoglobin, volume fraction."""

    predicted: float
    """Error of the prediction."""
    neutral_kept: float
    """Of the neutral map, unchanged (Jimenez2010, fig. 12, bottom row)."""
    one_gain: float
    """Of the neutral map times the best single factor (which fails, observation 5)."""
    gain: float
    """The factor, by least squares."""
    pixels: int
    """Number of compared pixels."""


def compare_prediction(
    predicted: ArrayLike, truth: ArrayLike, neutral: ArrayLike, *, valid: BoolArray | None = None
) -> PredictionErrors:
    """Compare a predicted state with its ground truth and with two predictions without a rig.

    Parameters
    ----------
    predicted, truth, neutral
        (H, W), volume fraction, on the neutral, unmoved face.
    valid
        (H, W) bool; None: where all three are finite.

    Returns
    -------
    PredictionErrors

    Raises
    ------
    ValueError
        For shapes that differ, or when no pixel is left.

    Examples
    --------
    >>> neutral = np.array([[0.02, 0.04]])
    >>> found = compare_prediction(1.5 * neutral, 1.5 * neutral, neutral)
    >>> found.predicted, round(found.gain, 6), round(found.neutral_kept, 6)
    (0.0, 1.5, 0.015811)
    """
    h, t, n = (np.asarray(image, np.float64) for image in (predicted, truth, neutral))
    Checks().shape("predicted", h, n.shape)
    Checks().shape("truth", t, n.shape)
    used = np.isfinite(h) & np.isfinite(t) & np.isfinite(n)
    if valid is not None:
        used &= valid
    h, t, n = h[used], t[used], n[used]
    if not h.size:
        raise ValueError("valid: got no pixel to compare, expected some")
    power = float(n @ n)
    gain = float(t @ n) / power if power > 0.0 else 1.0

    def rms(error: Float64Array) -> float:
        return float(np.sqrt(np.mean(error**2)))

    return PredictionErrors(rms(h - t), rms(n - t), rms(gain * n - t), gain, int(h.size))
