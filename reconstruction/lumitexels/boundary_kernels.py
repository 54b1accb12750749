"""Compiled Fresnel transmittance of the skin's boundary for light and view of each sample.

`model.fresnel.reflectance` is the NumPy equivalent, equal to the last bit; it needs a dozen passes
over arrays of millions of samples instead of one.
"""

import math

import numpy as np
from numba import njit

from model.checks import Checks
from model.fresnel import ETA_SKIN
from reconstruction.arrays import Float64Array, FloatArray


def boundary_transmittance(
    cos_light: FloatArray, cos_view: FloatArray, eta: float = ETA_SKIN
) -> Float64Array:
    """Return F_t(light) F_t(view) of a smooth boundary.

    Parameters
    ----------
    cos_light, cos_view
        Cosines of light and view, of the same shape; values outside 0 to 1 are clamped.
    eta
        Refractive index behind the surface over that before it, finite and above 0.

    Returns
    -------
    ndarray of float64
        Transmittance of that shape, in [0, 1]; NaN where a cosine is NaN.

    Raises
    ------
    ValueError
        For cosines of different shapes, or an invalid index.

    Examples
    --------
    >>> boundary_transmittance(np.array([1.0, 0.0]), np.array([1.0, 1.0])).round(4).tolist()
    [0.9452, 0.0]
    """
    Checks().shape("cos_light", cos_light, np.shape(cos_view))
    Checks().within("eta", eta, "(0, inf)")
    out = np.empty(np.shape(cos_light), np.float64)
    _transmitted(
        np.ascontiguousarray(cos_light).reshape(-1),
        np.ascontiguousarray(cos_view).reshape(-1),
        float(eta),
        out.reshape(-1),
    )
    return out


@njit(inline="always")
def boundary_reflectance(cosine, eta):  # type: ignore[no-untyped-def]
    """Return the reflectance of a smooth boundary for unpolarized light; NaN for NaN."""
    # Fresnel: r_s = (mu_i - eta mu_t) / (mu_i + eta mu_t), r_p = (eta mu_i - mu_t) / (eta mu_i +
    # mu_t), R = (r_s^2 + r_p^2) / 2; NaN passes both comparisons unchanged
    mu_i = 0.0 if cosine < 0.0 else (1.0 if cosine > 1.0 else cosine)
    sin2_t = (1.0 - mu_i * mu_i) / eta / eta
    if sin2_t >= 1.0:
        return 1.0 if eta != 1.0 else 0.0
    mu_t = math.sqrt(1.0 - sin2_t)
    sum_s = mu_i + eta * mu_t
    sum_p = eta * mu_i + mu_t
    r_s = (mu_i - eta * mu_t) / (sum_s if sum_s > 0.0 else 1.0)
    r_p = (eta * mu_i - mu_t) / (sum_p if sum_p > 0.0 else 1.0)
    return 0.5 * (r_s * r_s + r_p * r_p)


@njit(nogil=True, cache=True, error_model="numpy")
def _transmitted(cos_light, cos_view, eta, out):  # type: ignore[no-untyped-def]
    for k in range(out.size):
        inside = 1.0 - boundary_reflectance(np.float64(cos_light[k]), eta)
        out[k] = inside * (1.0 - boundary_reflectance(np.float64(cos_view[k]), eta))
