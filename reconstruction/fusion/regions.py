"""Summarize the colors of texels by regions of a face."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Float64Array
from reconstruction.fusion.person import UNKNOWN_VARIANCE, Regions
from reconstruction.fusion.signals import FusionError
from reconstruction.fusion.texels import OffsetModel, RigColors

TEXELS_PER_ERROR: Final = 64.0
"""Number of neighboring texels that share one error of noise, position and normals."""
FREE_LIGHT_VARIANCE: Final = 100.0
"""Variance of log light that leaves brightness without weight."""
MIN_TEXELS: Final = 20
"""Fewer valid texels of a rig do not make a region."""


def summarize_regions(
    colors: Sequence[RigColors], labels: NDArray[np.integer], errors: OffsetModel
) -> tuple[Regions, NDArray[np.intp]]:
    """Return median log colors of regions with their covariances.

    Where several rigs have enough texels in common, these are used. Region 0 is the whole face,
    whose usual light is known to each rig; in the others a rig without calibrated light gives the
    color alone.

    Parameters
    ----------
    colors
        Colors of N texels by one or more rigs.
    labels
        (N,): number of each texel's region, from 0; negative: in none.
    errors
        Covariances of the signals' errors, of all S signals.

    Returns
    -------
    regions : Regions
        Those with a color; signals without one have `UNKNOWN_VARIANCE`.
    kept : ndarray
        Their numbers in `labels`.

    Raises
    ------
    FusionError
        If no region has `MIN_TEXELS` texels of one rig.
    """
    size = len(errors.local)
    values, covariances, kept = [], [], []
    for label in range(int(labels.max(initial=-1)) + 1):
        inside = labels == label
        shared = inside.copy()
        for one in colors:
            shared &= one.valid
        value, covariance = np.zeros(size), errors.local.copy()
        unknown = np.ones(size, bool)
        for one in colors:
            chosen = shared if shared.sum() >= MIN_TEXELS else inside & one.valid
            count = int(chosen.sum())
            if count < MIN_TEXELS:
                continue
            at = slice(3 * one.rig, 3 * one.rig + 3)
            value[at] = np.median(one.log_rgb[chosen], axis=0)
            own = np.median(one.covariance[chosen], axis=0) * (TEXELS_PER_ERROR / count)
            light = 0.0
            if one.brightness_variance > 0.0:
                light = one.brightness_variance / count if label == 0 else FREE_LIGHT_VARIANCE
            covariance[at, at] += own + light
            unknown[at] = False
        if unknown.all():
            continue
        values.append(value)
        covariances.append(hide_signals(covariance, unknown))
        kept.append(label)
    if not kept:
        raise FusionError(
            f"labels: got no region with {MIN_TEXELS} valid texels of a rig, expected one or more"
        )
    return Regions(np.array(values), np.array(covariances)), np.array(kept, np.intp)


def hide_signals(covariance: Float64Array, unknown: NDArray[np.bool_]) -> Float64Array:
    """Return a covariance (S, S) with `UNKNOWN_VARIANCE` for some signals.

    Parameters
    ----------
    covariance
        (S, S).
    unknown
        (S,): signals that were not measured.

    Examples
    --------
    >>> hide_signals(np.ones((2, 2)), np.array([False, True])).tolist()
    [[1.0, 0.0], [0.0, 1000000.0]]
    """
    hidden = np.where(unknown[:, None] | unknown[None], 0.0, covariance)
    return np.asarray(hidden + UNKNOWN_VARIANCE * np.diag(unknown.astype(np.float64)))
