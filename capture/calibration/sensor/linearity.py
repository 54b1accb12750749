"""Linearity: mean signal of flats against the amount of light."""

from collections.abc import Sequence

import numpy as np

from capture.arrays import UInt16Array
from capture.calibration.sensor.darks import Darks
from capture.calibration.sensor.transfer_curve import FlatPair, plane


def fit_linearity(
    pairs: Sequence[FlatPair], positions: tuple[tuple[int, int], ...], pattern: str, dark: Darks
) -> tuple[float, float, float, float]:
    """Fit the response of one color to the amount of light.

    ``signal / light = a (1 + q light / light_max)``; the scatter is taken from the two frames of
    the pairs and from the residuals, so that a light source that does not repeat well is honest.

    Parameters
    ----------
    pairs : sequence of FlatPair
        Unsaturated flats.
    positions : tuple of (row, column)
        The color's places in the 2 x 2 cell.
    pattern : str
        CFA pattern or "MONO".
    dark : Darks
        Of the same color.

    Returns
    -------
    nonlinearity, stderr : float
        q and its standard error, relative.
    deviation, deviation_stderr : float
        Largest relative deviation of one level from a straight line through zero, and the
        scatter of one level.
    """
    light = np.array([pair.light for pair in pairs])
    cells = tuple(zip(positions, dark.black_dn, dark.good, strict=True))

    def level(frame: UInt16Array) -> float:
        parts = [plane(frame, at, pattern)[ok].mean() - black for at, black, ok in cells]
        return float(np.mean(parts))

    signals = np.array([[level(pair.first), level(pair.second)] for pair in pairs])
    response = signals.mean(axis=1) / light
    half_difference = (signals[:, 0] - signals[:, 1]) / (2.0 * signals.mean(axis=1))
    design = np.stack([np.ones_like(light), light / light.max()], axis=1)
    # an error of the black level weighs on the dark levels most
    weight = 1.0 / (
        1.0 + (dark.black_stderr / (signals.mean(axis=1) * max(half_difference.std(), 1e-6))) ** 2
    )
    normal = design.T @ (design * weight[:, None])
    coefficients = np.linalg.solve(normal, design.T @ (weight * response))
    misfit = response / (design @ coefficients) - 1.0
    dof = (len(pairs) - 2) + len(pairs)
    scatter = float((weight * misfit**2).sum() + (half_difference**2).sum()) / dof
    a, q = float(coefficients[0]), float(coefficients[1] / coefficients[0])
    covariance = np.linalg.inv(normal) * scatter * a**2
    gradient = np.array([-q / a, 1.0 / a])
    q_error = float(np.sqrt(gradient @ covariance @ gradient))
    straight = float((weight * response).sum() / weight.sum())
    deviation = float(np.abs(response / straight - 1.0).max())
    return q, q_error, deviation, float(np.sqrt(scatter))
