"""The least error that maps of chromophores could have had, at the true chromophores."""

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

    Fisher's information of a pixel's three channels about both cube roots and the log of its
    light, at the true chromophores: from the noise that the diffuse picture states, from the
    model error, and from the prior of the light through its variance. What the prior's shape tells
    beyond its variance is not in it.

    Parameters
    ----------
    appearance
        With the map ``diffuse`` and its standard error, and the color table that was used.
    truth
        With ``melanin_blurred`` and ``hemoglobin_blurred``.

    Returns
    -------
    dict
        By "melanin" and "hemoglobin": NaN where there is no truth or no picture. Empty when what
        is needed is not at hand.
    """
    built = appearance.parameters.get("color_table")
    diffuse = appearance.maps.get("diffuse")
    wanted = [truth.maps.get(f"{name}_blurred") for name in ("melanin", "hemoglobin")]
    if not isinstance(built, dict) or diffuse is None or diffuse.stderr is None:
        return {}
    if wanted[0] is None or wanted[1] is None:
        return {}
    table = color_table.build(
        str(built["camera"]), str(built["illuminant"]), anisotropy=ANISOTROPY_SKIN
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
    """Return the smallest relative standard errors of melanin and hemoglobin, each (n,).

    Parameters
    ----------
    table
        Color table.
    c_m, c_hd
        (n,) true volume fractions, above 0.
    relative_variance
        (n, 3) noise variance of a pixel's channels over their squares.
    shading_spread
        Standard deviation of the log of the light that is known beforehand.
    model_scale
        Of the model error's variance.
    """
    color = table.lookup(c_m, c_hd)
    # by the logarithm of each fraction, so that errors come out relative
    gradient = table.jacobian(c_m, c_hd) / color[..., None]
    gradient = gradient * np.stack([c_m, c_hd], axis=-1)[:, None, :]
    known = model_scale * model_error.load_covariance() + log_shading_std**2
    covariance = relative_variance[..., None] * np.eye(3) + known
    fisher = np.swapaxes(gradient, -1, -2) @ np.linalg.solve(covariance, gradient)
    aa, ab, bb = fisher[:, 0, 0], fisher[:, 0, 1], fisher[:, 1, 1]
    det = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    return np.sqrt(bb / det), np.sqrt(aa / det)
