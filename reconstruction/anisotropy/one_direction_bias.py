"""What a single direction of anisotropic tissue is off from the mean over all directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.anisotropy import diffusion_ellipse
from reconstruction.anisotropy.estimation import Anisotropy, AnisotropyError
from reconstruction.arrays import Float64Array


@dataclass(frozen=True, slots=True)
class OneDirectionBias:
    """What a fit along one direction of anisotropic tissue is off from the mean over directions.

    Attributes
    ----------
    bias, stderr : ndarray, shape (K, ...)
        sigma_tr along each direction asked, over its mean, minus 1; and its standard error.
    lowest, highest : ndarray, shape (...)
        Least and greatest bias of any direction.
    rms : ndarray, shape (...)
        Root mean square over all directions: what a head set down at random is off.
    """

    bias: Float64Array
    stderr: Float64Array
    lowest: Float64Array
    highest: Float64Array
    rms: Float64Array


def one_direction_bias(found: Anisotropy, angle_rad: ArrayLike) -> OneDirectionBias:
    """Say how far sigma_tr along single directions is from its mean over all directions.

    Parameters
    ----------
    found : Anisotropy
        Where it is not `valid` biases are 0, with infinite standard errors.
    angle_rad : array_like, shape (K,)
        Directions in which the head would be set down, rad.

    Returns
    -------
    OneDirectionBias

    Raises
    ------
    AnisotropyError
        For directions that are not finite.

    Examples
    --------
    >>> from reconstruction.anisotropy.estimation import estimate
    >>> angle = np.deg2rad(np.arange(16) * 22.5)
    >>> found = estimate(angle, np.hypot(np.cos(angle) / 1.2, np.sin(angle)))
    >>> bias = one_direction_bias(found, [0.0, np.pi / 2])
    >>> bias.bias.round(3).tolist(), round(float(bias.rms), 3)
    ([-0.093, 0.089], 0.064)
    """
    angle = np.atleast_1d(np.asarray(angle_rad, np.float64))
    if angle.ndim != 1 or not np.isfinite(angle).all():
        raise AnisotropyError(f"angle_rad: got shape {angle.shape}, expected (K,), all finite")
    shape = found.valid.shape
    told = found.valid.reshape(-1)
    p = found.parameters.reshape(-1, 3)
    covariance = np.where(told[:, None, None], found.covariance.reshape(-1, 3, 3), 0.0)
    flat = np.column_stack([np.zeros(len(p)), p[:, 1:]])
    mean, mean_by = diffusion_ellipse.mean_over_directions(flat)
    values, by_uv = diffusion_ellipse.relative_sigma_tr(angle, p[:, 1:])
    ratio = values / mean[:, None]
    by = (
        by_uv / mean[:, None, None]
        - (values / mean[:, None] ** 2)[..., None] * (mean_by[:, None, 1:])
    )
    variance = np.einsum("bki,bij,bkj->kb", by, covariance[:, 1:, 1:], by)
    h = np.hypot(p[:, 1], p[:, 2])
    every = diffusion_ellipse.all_directions()
    around = diffusion_ellipse.relative_sigma_tr(every, p[:, 1:])[0] / mean[:, None]
    stderr = np.where(told, np.sqrt(np.maximum(variance, 0.0)), math.inf)
    return OneDirectionBias(
        bias=(ratio - 1.0).T.reshape((-1, *shape)),
        stderr=stderr.reshape((-1, *shape)),
        lowest=(np.exp(-0.5 * h) / mean - 1.0).reshape(shape),
        highest=(np.exp(0.5 * h) / mean - 1.0).reshape(shape),
        rms=np.sqrt(((around - 1.0) ** 2).mean(axis=1)).reshape(shape),
    )
