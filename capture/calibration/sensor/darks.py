"""Reduce frames without light: black level, noise, fixed pattern, dark current, hot pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.arrays import BoolArray, Float64Array, UInt16Array
from capture.calibration.robust import mad_sigma
from capture.calibration.sensor.transfer_curve import extract_cfa_plane

HOT_PIXEL_SIGMAS = 6.0


@dataclass(frozen=True, slots=True)
class DarkStatistics:
    """Statistics of the dark frames of one color.

    Attributes
    ----------
    black_dn : tuple of float
        Mean level of each CFA position, DN.
    black_stderr : float
        Standard error of their mean, DN, with the scatter from frame to frame.
    variance_dn2, dof : float
        Temporal variance of a pixel, DN^2, and its degrees of freedom.
    dsnu_dn : (float, float)
        Standard deviation of the pixels' own levels and its standard error, DN.
    slope_dn_per_s : (float, float) or None
        Growth with exposure time and its standard error; None when all times are equal.
    good : tuple of ndarray of bool
        Pixels that are not hot, per CFA position.
    positions : tuple of (row, column)
        The CFA positions, in the 2 x 2 cell.
    pattern : str
        CFA pattern or "MONO".
    """

    black_dn: tuple[float, ...]
    black_stderr: float
    variance_dn2: float
    dof: float
    dsnu_dn: tuple[float, float]
    slope_dn_per_s: tuple[float, float] | None
    good: tuple[BoolArray, ...]
    positions: tuple[tuple[int, int], ...]
    pattern: str

    @property
    def mean_black_dn(self) -> float:
        """Mean of the positions' black levels."""
        return float(np.mean(self.black_dn))

    @property
    def levels(self) -> tuple[tuple[float, ...], tuple[BoolArray, ...]]:
        """Black level and good pixels of each position."""
        return self.black_dn, self.good

    def planes(self, frame: NDArray) -> list[Float64Array]:
        """Return the pixels of a frame at each position."""
        return [extract_cfa_plane(frame, position, self.pattern) for position in self.positions]


def reduce_darks(
    darks: Sequence[UInt16Array],
    exposures_s: Sequence[float] | None,
    positions: tuple[tuple[int, int], ...],
    pattern: str,
) -> DarkStatistics:
    """Reduce the dark frames of one color.

    Parameters
    ----------
    darks : sequence of ndarray of uint16, shape (H, W)
        At least two frames without light, DN.
    exposures_s : sequence of float or None
        Their exposure times, seconds.
    positions : tuple of (row, column)
        The color's places in the 2 x 2 cell.
    Positions of the color in the 2 x 2 cell.
        CFA pattern or "MONO".

    Returns
    -------
    Darks
    """
    n = len(darks)
    black, good, means = [], [], np.zeros(n)
    squares = dof = 0.0
    spreads = []
    for position in positions:
        stack = np.stack([extract_cfa_plane(dark, position, pattern) for dark in darks])
        level = stack.mean(axis=(1, 2))
        means += level / len(positions)
        residual = stack - level[:, None, None]
        average = residual.mean(axis=0)
        scale = mad_sigma(average - np.median(average))
        ok = np.abs(average - np.median(average)) <= max(HOT_PIXEL_SIGMAS * scale, 1.0)
        black.append(float(stack[:, ok].mean()))
        good.append(ok)
        squares += float(((residual - average) ** 2)[:, ok].sum())
        dof += (n - 1) * (int(ok.sum()) - 1)
        spreads.append(_common_std(residual[0::2].mean(0), residual[1::2].mean(0), ok))
    variance = squares / dof
    pixels = dof / (n - 1)
    error = np.hypot(float(means.std(ddof=1)) / np.sqrt(n), np.sqrt(variance / (n * pixels)))
    slope = None
    if exposures_s is not None and len(set(exposures_s)) > 1:
        t = np.asarray(exposures_s, dtype=np.float64)
        centered = t - t.mean()
        rate = float(centered @ means / (centered @ centered))
        misfit = means - means.mean() - rate * centered
        scatter = float(misfit @ misfit) / max(n - 2, 1)
        sigma2 = max(scatter, variance / pixels)
        slope = (rate, float(np.sqrt(sigma2 / (centered @ centered))))
    return DarkStatistics(
        black_dn=tuple(black),
        black_stderr=float(error),
        variance_dn2=variance,
        dof=dof,
        dsnu_dn=pool_estimates(spreads),
        slope_dn_per_s=slope,
        good=tuple(good),
        positions=positions,
        pattern=pattern,
    )


def _common_std(a: Float64Array, b: Float64Array, ok: BoolArray) -> tuple[float, float]:
    """Return the root of the covariance of two averages, with its error."""
    x, y = a[ok] - a[ok].mean(), b[ok] - b[ok].mean()
    covariance = float(x @ y) / (x.size - 1)
    error = float(np.sqrt((x.var() * y.var() + covariance**2) / x.size))
    if covariance <= 0:
        return 0.0, float(np.sqrt(error))
    spread = float(np.sqrt(covariance))
    return spread, min(error / (2.0 * spread), float(np.sqrt(error)))


def pool_estimates(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the mean of independent (value, standard error) pairs and its standard error.

    Examples
    --------
    >>> pool_estimates([(1.0, 0.3), (3.0, 0.4)])
    (2.0, 0.25)
    """
    v, e = np.array(values).T
    return float(v.mean()), float(np.sqrt((e**2).sum()) / e.size)
