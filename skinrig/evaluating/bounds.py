"""Cramér-Rao bounds of the standard errors of chromophore maps at the true chromophores."""

import numpy as np

from model import color_table
from model.skin import SkinAppearance
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float64Array


def chromophore_bounds(
    appearance: SkinAppearance, truth: SkinAppearance
) -> dict[str, Float64Array]:
    """Return relative bounds of the standard errors of melanin and hemoglobin, each (H, W).

    The bound is the inverse of the Fisher information of a pixel's three channels about both cube
    roots and the log of the light, at the true chromophores. It includes the noise variance of the
    diffuse image, the model error, and the variance of the light's prior, but not the prior's
    shape, nor unknown optics, which move all pixels of a face together.

    Parameters
    ----------
    appearance
        With the map ``diffuse``, its standard error, and the parameters of its color table.
    truth
        With ``melanin_blurred`` and ``hemoglobin_blurred``.

    Returns
    -------
    dict
        "melanin" and "hemoglobin"; NaN without ground truth or image. Empty if a required map or
        parameter is missing.
    """
    built = appearance.parameters.get("color_table")
    diffuse = appearance.maps.get("diffuse")
    wanted = [truth.maps.get(f"{name}_blurred") for name in ("melanin", "hemoglobin")]
    if not isinstance(built, dict) or diffuse is None or diffuse.stderr is None:
        return {}
    if wanted[0] is None or wanted[1] is None:
        return {}
    table = color_table.build(
        str(built["camera"]),
        str(built["illuminant"]),
        anisotropy=ANISOTROPY_SKIN,
        exact_optics=True,  # common to the face
    )
    c_m, c_hd = (m.values.astype(np.float64) for m in wanted if m is not None)
    with np.errstate(invalid="ignore"):
        usable = (c_m > 0) & (c_m <= table.c_m_max) & (c_hd > 0) & (c_hd <= table.c_hd_max)
        usable &= (diffuse.values > 0).all(axis=-1)
    usable &= intersect_valid(diffuse)
    noise = (diffuse.stderr[usable] / diffuse.values[usable]).astype(np.float64) ** 2
    prior = shading_prior.face_prior().sd
    relative = relative_bounds(table, c_m[usable], c_hd[usable], noise, log_shading_std=prior)
    found = {}
    for name, values in zip(("melanin", "hemoglobin"), relative, strict=True):
        whole = np.full(usable.shape, np.nan)
        whole[usable] = values
        found[name] = whole
    return found


def relative_bounds(
    table: color_table.ColorTable,
    c_m: Float64Array,
    c_hd: Float64Array,
    relative_variance: Float64Array,
    *,
    log_shading_std: float,
    model_scale: float = 1.0,
) -> tuple[Float64Array, Float64Array]:
    """Return the Cramér-Rao bounds of melanin and hemoglobin, relative, each (n,).

    Parameters
    ----------
    table
        Color table; its covariance by unknown optics is included.
    c_m, c_hd
        (n,) true volume fractions, above 0.
    relative_variance
        (n, 3) noise variance of a pixel's channels over their squares.
    log_shading_std
        Prior standard deviation of the log of the light.
    model_scale
        Scale of the model error's variance.
    """
    color = table.lookup(c_m, c_hd)
    # d ln color / d c; multiplied by c it is the derivative by ln c, so that errors are relative
    gradient = table.jacobian(c_m, c_hd) / color[..., None]
    gradient = gradient * np.stack([c_m, c_hd], axis=-1)[:, None, :]
    known = model_scale * model_error.load_covariance() + log_shading_std**2
    known = known + table.log_covariance(c_m, c_hd)
    covariance = relative_variance[..., None] * np.eye(3) + known
    fisher = np.swapaxes(gradient, -1, -2) @ np.linalg.solve(covariance, gradient)
    aa, ab, bb = fisher[:, 0, 0], fisher[:, 0, 1], fisher[:, 1, 1]
    det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    return np.sqrt(bb / det), np.sqrt(aa / det)
