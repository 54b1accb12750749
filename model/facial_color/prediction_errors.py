"""How far a predicted state is from its truth, beside what simpler animation would give."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.checks import Checks


@dataclass(frozen=True, slots=True)
class PredictionErrors:
    """Root mean square errors of one state's hemoglobin, volume fraction."""

    predicted: float
    """Of the prediction."""
    neutral_kept: float
    """Of the neutral map shown in the state (Jimenez2010, fig. 12, bottom row)."""
    one_gain: float
    """Of the neutral map times the best single factor (observation 5 says that it fails)."""
    gain: float
    """That factor, by least squares."""
    pixels: int
    """That were compared."""


def compare_prediction(
    predicted: ArrayLike, truth: ArrayLike, neutral: ArrayLike, *, valid: BoolArray | None = None
) -> PredictionErrors:
    """Compare a predicted state with its truth, and with two ways to do without a rig.

    Parameters
    ----------
    predicted, truth, neutral
        (H, W), volume fraction, on the neutral, unmoved face.
    valid
        (H, W) bool; None: where all three are finite.

    Returns
    -------
    BloodErrors

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
