"""Evaluate skin whose epidermis has a map of thickness, between tables of single thicknesses."""

from collections.abc import Callable
from math import exp, floor
from typing import Final

import numpy as np

from rigsim.arrays import FloatArray
from rigsim.tissue.skin_layers import TissueProperties

LOG_RATIO_STEP: Final = 0.1
"""Distance of the thicknesses that are evaluated, of the logarithm. Linear interpolation of log R
between them errs by up to 0.05 % on medium and 0.11 % on the darkest skin."""
MIN_DEVIATION: Final = 1e-6
"""Maps that deviate less from 1 are even."""


def interpolate_thickness(
    tissue: TissueProperties, ratio: FloatArray, evaluate: Callable[[TissueProperties], FloatArray]
) -> FloatArray:
    """Return the reflectance of skin with a map of thickness.

    Parameters
    ----------
    tissue
        Properties of the skin.
    ratio
        Thickness of the epidermis over `TissueProperties.epidermis_mm`, shape (...).
    evaluate
        Returns the reflectance of skin of one thickness, > 0, shape (..., C).

    Returns
    -------
    ndarray
        Shape (..., C), of the type of `evaluate`'s.

    Examples
    --------
    >>> ratio = np.array([0.9, 1.0])
    >>> found = interpolate_thickness(
    ...     TissueProperties(), ratio, lambda skin: np.full((2, 1), skin.epidermis_mm))
    >>> found.round(6).ravel().tolist()
    [0.081, 0.09]
    """
    position = np.log(ratio) / LOG_RATIO_STEP
    if not position.size or np.abs(position).max() * LOG_RATIO_STEP < MIN_DEVIATION:
        return evaluate(tissue.with_thickness_ratio(1.0))
    first, last = floor(position.min()), floor(position.max()) + 1
    total: FloatArray | float = 0.0
    for node in range(first, last + 1):
        weight = np.maximum(1.0 - np.abs(position - node), 0.0)
        if weight.any():
            found = evaluate(tissue.with_thickness_ratio(exp(node * LOG_RATIO_STEP)))
            total = total + weight[..., None].astype(found.dtype) * np.log(found)
    return np.asarray(np.exp(total))
