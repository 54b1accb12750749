"""Convert R_d and 1/sigma_tr to the radius of OpenPBR, and back.

OpenPBR takes the reflected color of a medium and its mean free path r. It derives the
single-scattering albedo by Kulla and Conty's fit, which its specification names:
1 - alpha = s(color)^2 for isotropic scattering. Far from its point of entry, light in that medium
decays by k(alpha) / r with the exact k of transport, alpha = k / artanh(k).

The measured medium of alpha' and sigma_tr = sqrt(3 (1 - alpha')) sigma_t' decays by k(alpha')
sigma_t'. The radius is the one with the same decay:

    r = k(alpha) / (k(alpha') sigma_t') = k(alpha) sqrt(3 (1 - alpha')) / (k(alpha') sigma_tr).

Both media have the same color. They differ at the boundary: the renderer's medium has no internal
reflection, thus a lower albedo and a longer path for the same color. Renderers that invert the
color by another fit get another decay.

References
----------
Kulla and Conty 2017, Revisiting Physically Based Shading at Imageworks, SIGGRAPH course;
OpenPBR Surface 1.1, section on subsurface; Case and Zweifel 1967, Linear Transport Theory (k).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from skinrig.arrays import Float64Array

MIN_COLOR, MAX_COLOR = 0.001, 0.999
"""Range to which colors are clipped: at 1, nothing is absorbed and sigma_tr is 0 for any radius."""


def deficit_root(color: ArrayLike) -> Float64Array:
    """Return sqrt(1 - alpha) of the isotropic medium that reflects a color.

    Parameters
    ----------
    color
        Observed reflectance of the half space, 0 to 1, any shape.

    Examples
    --------
    >>> deficit_root([0.001, 0.5, 0.999]).round(3).tolist()
    [0.997, 0.297, 0.0]
    """
    a = np.clip(np.asarray(color, np.float64), MIN_COLOR, MAX_COLOR)
    root = 4.09712 + 4.20863 * a - np.sqrt(9.59217 + 41.6808 * a + 17.7126 * a * a)
    return np.asarray(np.clip(root, 1e-4, 1.0 - 1e-3))


def decay(deficit: ArrayLike) -> Float64Array:
    """Return the exact decay of light over sigma_t, isotropic scattering: alpha = k / artanh k.

    Parameters
    ----------
    deficit
        1 - alpha, clipped to 1e-9 to 0.999.

    Examples
    --------
    >>> decay([1e-6, 0.1, 0.5]).round(4).tolist()
    [0.0017, 0.5254, 0.9575]
    """
    log_deficit, log_artanh = _decay_table()
    held = np.log(np.clip(np.asarray(deficit, np.float64), 1e-9, 0.999))
    return np.asarray(np.tanh(np.exp(np.interp(held, log_deficit, log_artanh))))


def radius_mm(translucency_mm: ArrayLike, color: ArrayLike, deficit: ArrayLike) -> Float64Array:
    """Return the mean free path for OpenPBR.

    Parameters
    ----------
    translucency_mm
        1/sigma_tr of the measured medium, mm.
    color
        Reflected color, 0 to 1.
    deficit
        1 - alpha' of the measured medium; NaN: unknown, the decay is taken as sigma_tr.

    Returns
    -------
    ndarray
        Radius, mm, of the broadcast shape.
    """
    return np.asarray(_per_translucency(color, deficit) * np.asarray(translucency_mm, np.float64))


def translucency_mm(radius: ArrayLike, color: ArrayLike, deficit: ArrayLike) -> Float64Array:
    """Return 1/sigma_tr of a mean free path, mm: the inverse of `radius_mm`.

    Examples
    --------
    >>> float(translucency_mm(radius_mm(3.5, 0.4, 0.2), 0.4, 0.2).round(9))
    3.5
    """
    return np.asarray(np.asarray(radius, np.float64) / _per_translucency(color, deficit))


def _per_translucency(color: ArrayLike, deficit: ArrayLike) -> Float64Array:
    own = np.asarray(deficit, np.float64)
    known = np.isfinite(own) & (own > 0.0)
    safe = np.where(known, np.clip(own, 1e-9, 0.999), 0.1)
    diffusion = np.where(known, np.sqrt(3.0 * safe) / decay(safe), 1.0)
    return np.asarray(decay(deficit_root(color) ** 2) * diffusion)


@lru_cache(maxsize=1)
def _decay_table() -> tuple[Float64Array, Float64Array]:
    """Return log(1 - alpha) and log artanh k, both increasing."""
    t = np.geomspace(1e-5, 2e3, 8001)
    series = t**2 / 3.0 - 2.0 * t**4 / 15.0
    exact = 1.0 - np.tanh(t) / t
    return np.log(np.where(t < 1e-2, series, exact)), np.log(t)
