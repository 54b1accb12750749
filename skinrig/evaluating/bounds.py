"""Cramér-Rao bounds of the standard errors of chromophore maps at the true chromophores."""

import numpy as np

from model import color_table
from model.skin import SkinAppearance
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.table_fit.fitting import POPULATION_LOG_SD
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float64Array


def chromophore_bounds(
    appearance: SkinAppearance, truth: SkinAppearance
) -> dict[str, Float64Array]:
    """Return relative bounds of the standard errors of melanin and hemoglobin, each (H, W).

    The bound has two parts. That of a pixel is the inverse of the Fisher information of its three
    channels about both cube roots and the log of the light, at the true chromophores. It includes
    the noise variance of the diffuse image, the model error, and the variance of the light's prior,
    but not the prior's shape. That of the face is the error by unknown optics, which all pixels
    have in common: the same information of the face's median color, without noise, with the light
    known as for a white reference, and with the prior of both chromophores over people.

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
        exact_optics=True,
    )
    c_m, c_hd = (m.values.astype(np.float64) for m in wanted if m is not None)
    with np.errstate(invalid="ignore"):
        usable = (c_m > 0) & (c_m <= table.c_m_max) & (c_hd > 0) & (c_hd <= table.c_hd_max)
        usable &= (diffuse.values > 0).all(axis=-1)
    usable &= intersect_valid(diffuse)
    noise = (diffuse.stderr[usable] / diffuse.values[usable]).astype(np.float64) ** 2
    prior = shading_prior.face_prior().sd
    relative = relative_bounds(table, c_m[usable], c_hd[usable], noise, log_shading_std=prior)
    if not usable.any():
        return {}
    of_face = relative_bounds(
        color_table.build(table.camera, table.illuminant, anisotropy=ANISOTROPY_SKIN),
        np.median(c_m[usable], keepdims=True),
        np.median(c_hd[usable], keepdims=True),
        np.zeros((1, 3)),
        log_shading_std=shading_prior.LOG_SHADING_SOFTNESS,
        prior_log_std=POPULATION_LOG_SD,
    )
    found = {}
    for name, values, common in zip(("melanin", "hemoglobin"), relative, of_face, strict=True):
        whole = np.full(usable.shape, np.nan)
        whole[usable] = np.hypot(values, common)
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
    prior_log_std: tuple[float, float] | None = None,
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
    prior_log_std
        Standard deviations of the logs of melanin and hemoglobin over people. None: no prior.
    """
    color = table.lookup(c_m, c_hd)
    # d ln color / d c; multiplied by c it is the derivative by ln c, so that errors are relative
    gradient = table.jacobian(c_m, c_hd) / color[..., None]
    gradient = gradient * np.stack([c_m, c_hd], axis=-1)[:, None, :]
    known = model_scale * model_error.load_covariance() + log_shading_std**2
    known = known + table.log_covariance(c_m, c_hd)
    covariance = relative_variance[..., None] * np.eye(3) + known
    fisher = np.swapaxes(gradient, -1, -2) @ np.linalg.solve(covariance, gradient)
    if prior_log_std is not None:
        fisher = fisher + np.diag(np.square(1.0 / np.array(prior_log_std)))
    aa, ab, bb = fisher[:, 0, 0], fisher[:, 0, 1], fisher[:, 1, 1]
    det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    return np.sqrt(bb / det), np.sqrt(aa / det)
