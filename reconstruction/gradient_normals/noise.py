"""Estimate the noise of a gradient sphere's images from their redundancy."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model.checks import Checks
from reconstruction.arrays import Float64Array, FloatArray
from reconstruction.gradient_normals.patterns import (
    PATTERN_NAMES,
    GradientError,
    PatternStack,
    design_matrix,
)

_CHI_MEDIAN = 0.4549364  # median of the square of a standard normal variable


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Variance of a sample as ``read_variance + gain * signal``, in the images' unit.

    Attributes
    ----------
    gain : float
        Variance of a signal of 1 by its photons, >= 0.
    read_variance : float
        Variance without light, >= 0; not both 0.
    """

    gain: float
    read_variance: float

    def __post_init__(self) -> None:
        """Refuse variances below 0 or both 0."""
        check = Checks(GradientError)
        check.settings(self, gain="[0, inf)", read_variance="[0, inf)")
        some = self.gain or self.read_variance
        check.require(some, "SensorNoise", "0 for both", "gain or read_variance")


def estimate_noise(stacks: Mapping[str, PatternStack]) -> SensorNoise | None:
    """Estimate the sensor's noise from the contradictions of patterns and complements.

    Parameters
    ----------
    stacks
        By polarization.

    Returns
    -------
    SensorNoise or None
        None where no images are redundant.

    Notes
    -----
    Pattern plus complement is the full light for any surface. Differences of such sums contain
    the samples' noise alone; their squares, as medians over pixels of similar brightness, are
    fitted by a line on the sum of signals, both its coefficients at least 0.
    """
    light, square, count = [], [], []
    for stack in stacks.values():
        step = max(1, int(np.prod(stack.shape)) // 100_000)
        rows = slice(0, None, max(1, min(step, stack.shape[0] // 16)))
        y = stack.samples(rows, np.float64).reshape(len(PATTERN_NAMES), -1)
        for weights in _contrasts(stack):
            used = [k for k in range(len(PATTERN_NAMES)) if weights[k]]
            good = np.isfinite(y[used]).all(axis=0)
            if good.sum() < 16:
                continue
            some = y[used][:, good]
            w = weights[used]
            # w @ samples has mean 0 and variance sum w_k^2 (read + gain s_k): a line in light
            light.append((w**2) @ some)
            square.append((w @ some) ** 2)
            count.append(np.full(some.shape[1], np.sum(w**2)))
    if not light:
        return None
    x, z, n = np.concatenate(light), np.concatenate(square), np.concatenate(count)
    gain, read = _line(x / n, z / n)
    return SensorNoise(gain, read) if gain > 0.0 or read > 0.0 else None


def _contrasts(stack: PatternStack) -> list[Float64Array]:
    """Return weights (8,) of orthogonal sums of the images that contain noise alone."""
    names: list[str] = [name for name in PATTERN_NAMES if name in stack.images]
    if stack.redundancy < 1:
        return []
    A = design_matrix(names, dark=stack.has_dark)
    left = np.linalg.svd(A)[0][:, A.shape[1] :]
    weights = np.zeros((left.shape[1], len(PATTERN_NAMES)))
    weights[:, [PATTERN_NAMES.index(name) for name in names]] = left.T
    return list(np.where(np.abs(weights) > 1e-9, weights, 0.0))


def _line(signal: FloatArray, square: FloatArray) -> tuple[float, float]:
    """Fit ``square = gain signal + read`` by medians over 16 classes of signal."""
    edges = np.unique(np.quantile(signal, np.linspace(0.0, 1.0, 17)))
    place = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, max(len(edges) - 2, 0))
    s, v, w = [], [], []
    for k in range(max(len(edges) - 1, 1)):
        inside = place == k
        if inside.sum() < 8:
            continue
        s.append(float(signal[inside].mean()))
        v.append(float(np.median(square[inside])) / _CHI_MEDIAN)
        w.append(float(inside.sum()))
    x, y, n = np.array(s), np.array(v), np.array(w)
    if not y.any():
        return 0.0, 0.0
    weight = n / np.maximum(y, 1e-3 * y.max()) ** 2
    best, least = (0.0, float(np.average(y, weights=weight))), np.inf
    mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
    spread = np.sum(weight * (x - mean_x) ** 2)
    slope = np.sum(weight * (x - mean_x) * (y - mean_y)) / spread if spread > 0.0 else 0.0
    through = np.sum(weight * x * y) / max(np.sum(weight * x * x), 1e-300)
    for gain, read in ((slope, mean_y - slope * mean_x), (0.0, mean_y), (max(through, 0.0), 0.0)):
        cost = float(np.sum(weight * (gain * x + read - y) ** 2))
        if gain >= 0.0 and read >= 0.0 and cost < least:
            best, least = (float(gain), float(read)), cost
    return best
