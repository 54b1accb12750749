"""Maps with value 0 where they are invalid."""

import numpy as np

from model.skin import SkinMap
from reconstruction.arrays import BoolArray, FloatArray


def masked_map(
    values: FloatArray,
    stderr: FloatArray | None,
    valid: BoolArray,
    unit: str = "1",
    description: str = "",
) -> SkinMap:
    """Return a map whose values and standard errors are 0 where not ``valid``.

    Parameters
    ----------
    values, stderr
        (H, W) or (H, W, C); arbitrary numbers where not ``valid``.
    valid
        (H, W).
    unit, description
        Unit and description of the map.

    Examples
    --------
    >>> masked_map(np.array([[1.0, np.nan]]), None, np.array([[True, False]])).values.tolist()
    [[1.0, 0.0]]
    """
    keep = valid if values.ndim == 2 else valid[..., None]
    error = None if stderr is None else np.where(keep, stderr, 0.0)
    return SkinMap(np.where(keep, values, 0.0), unit, error, valid, description)
