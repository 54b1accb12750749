"""Thickness of the epidermis over a face, relative to that between its regions.

The ratios are in `rigsim/data/face.toml`: means of 118 people by ultrasound (Meng et al. 2022,
doi:10.1186/s12880-022-00839-w, table 2). Ultrasound gives 0.17 to 0.22 mm, twice the thickness by
histology. An offset common to all sites would make the real contrast larger.
"""

from collections.abc import Mapping
from math import log
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.package_data import package_table

_LOG_RATIOS: Final[Mapping[str, float]] = {
    region: log(ratio) for region, ratio in package_table("face")["region_thickness"].items()
}
LOG_RATIO_RANGE: Final = (min(_LOG_RATIOS.values()), max(_LOG_RATIOS.values()))
"""Logarithms of the thinnest and thickest epidermis of a face over that between its regions."""


def thickness_ratio(regions: Mapping[str, Float32Array], contrast: float = 1.0) -> Float32Array:
    """Return the thickness of the epidermis over that between the face's regions.

    Parameters
    ----------
    regions
        Masks of `rigsim.subject.face_regions.region_masks`, shape (...).
    contrast
        Factor of the logarithm of the published ratios, >= 0.

    Returns
    -------
    ndarray of float32
        Shape (...).

    Examples
    --------
    >>> masks = {name: np.zeros(1, np.float32) for name in _LOG_RATIOS}
    >>> masks["forehead"] += 1.0
    >>> f"{thickness_ratio(masks)[0]:.3f}"
    '1.050'
    """
    total = sum(np.float32(step) * regions[name] for name, step in _LOG_RATIOS.items())
    return np.asarray(np.exp(contrast * np.clip(total, *LOG_RATIO_RANGE)), np.float32)
