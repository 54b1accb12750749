"""Fit the map of differences of normals, the alternative to partial derivatives.

With the zone weights of a wrinkle fit, an expression adds D_e(x) = s_e(x) W(x) to the neutral
normals, s_e being the strength of the zones: W, of three channels, is linear in the data. This fit
minimizes the squared difference of normals before they are normalized.

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1 (section 1.2.1). ISBN 978-1-56881-718-7
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from model import texture_resampling as resampling
from model.checks import Checks
from model.wrinkles import WrinkleError
from model.wrinkles.differences import NormalDifference
from model.wrinkles.expressions import clamp_sums, zone_sums
from reconstruction.arrays import Float64Array
from reconstruction.normal_maps import NormalMaps
from reconstruction.wrinkles.fit import WrinkleFit, differences
from reconstruction.wrinkles.texels import fit_texels


def fit_difference_map(
    found: WrinkleFit,
    neutral: ArrayLike | NormalMaps,
    expressions: Mapping[str, ArrayLike | NormalMaps],
) -> NormalDifference:
    """Fit a map of differences of normals to the expressions of a wrinkle fit.

    Parameters
    ----------
    found : WrinkleFit
        Fit to the same normals; gives masks, weights and the size of the map.
    neutral, expressions : array_like (H, W, 3), or NormalMaps
        Tangent-space unit normals of the face at rest and of the expressions.

    Returns
    -------
    NormalDifference
        Of the wrinkle map's size; 0.5 where not valid.

    Raises
    ------
    WrinkleError
        For an expression that the fit lacks, or a mismatched size.
    """
    base = _normals(neutral)
    shape = (base.shape[0], base.shape[1])
    masks = np.asarray(found.layer.masks, np.float64)
    weight, covered, product = np.zeros(shape), np.zeros(shape), np.zeros((*shape, 3))
    measured = differences(found.base, expressions)
    for name, given in expressions.items():
        normals, pixels = _normals(given), measured[name].weight.astype(np.float64)
        Checks(WrinkleError).shape(name, normals, base.shape)
        sums = clamp_sums(zone_sums({name: 1.0}, found.layer.table), found.clamp)
        strength = resampling.resample(np.tensordot(sums, masks, axes=1), shape)
        scaled = pixels * strength
        weight += scaled * strength
        with np.errstate(invalid="ignore"):
            step = np.where((pixels > 0)[..., None], normals - base, 0.0)
        product += scaled[..., None] * step
        covered = np.maximum(covered, pixels > 0)
    texels = fit_texels(
        weight, product, np.zeros_like(product), covered, found.layer.wrinkle.shape[:2]
    )
    encoded = 0.5 + 0.5 * texels.values
    beyond = texels.valid & ((encoded < 0) | (encoded > 1)).any(axis=2)
    count = int(np.count_nonzero(texels.valid))
    return NormalDifference(
        np.clip(encoded, 0.0, 1.0).astype(np.float32),
        texels.valid,
        float(np.count_nonzero(beyond)) / count if count else 0.0,
    )


def _normals(given: ArrayLike | NormalMaps) -> Float64Array:
    return np.asarray(given.normals if isinstance(given, NormalMaps) else given, np.float64)
