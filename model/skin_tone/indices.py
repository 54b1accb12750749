"""Erythema and melanin indices of dermatology, from reflectance in narrow bands.

Both are 100 times a decadic logarithm of reflectances, with base 10 as in the instruments.
Reflectances include what the instrument measures: contact probes and spheres include the
reflection at the surface, cross-polarized cameras do not, so their indices differ.

References
----------
Diffey, Oliver, Farr 1984, A portable instrument for quantifying erythema induced by ultraviolet
radiation, British Journal of Dermatology 111, 663; Dawson et al. 1980, A theoretical and
experimental study of light absorption and scattering by in vivo skin, Physics in Medicine and
Biology 25, 695; Takiwaki, Overgaard, Serup 1994, Comparison of narrow-band reflectance
spectrophotometric and tristimulus colorimetric measurements of skin color, Skin Pharmacology 7,
217; Takiwaki 1998, Measurement of skin color, Journal of Medical Investigation 44, 121.
"""

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks

GREEN_BAND_NM = 568.0
"""Center of the green band of the DermaSpectrometer, nm: absorption by hemoglobin."""
RED_BAND_NM = 655.0
"""Center of the red band of the DermaSpectrometer, nm: absorption by melanin."""
DAWSON_BANDS_NM = (510.0, 543.0, 560.0, 576.0, 610.0)
"""Wavelengths of Dawson's erythema index, nm."""
DAWSON_WEIGHTS = (-2.0, 1.5, 1.0, 1.5, -2.0)
"""Weights of log10(1/R) at `DAWSON_BANDS_NM`."""
_SCALE = 100.0


def erythema_index(red: ArrayLike, green: ArrayLike) -> Float64Array:
    """Return the erythema index 100 log10(R_red / R_green).

    Parameters
    ----------
    red, green
        Reflectances in a red and a green band, that broadcast; about `RED_BAND_NM` and
        `GREEN_BAND_NM` for the DermaSpectrometer.

    Returns
    -------
    ndarray
        Broadcast shape; NaN where a reflectance is not above 0.

    Examples
    --------
    >>> round(float(erythema_index(0.5, 0.25)), 2)
    30.1
    """
    return _scaled_log(red) - _scaled_log(green)


def erythema_index_stderr(
    red: ArrayLike,
    green: ArrayLike,
    red_stderr: ArrayLike,
    green_stderr: ArrayLike,
    *,
    correlation: float = 0.0,
) -> Float64Array:
    """Return the standard error of `erythema_index`, to first order.

    Parameters
    ----------
    red, green
        Reflectances, as for `erythema_index`.
    red_stderr, green_stderr
        Their standard errors.
    correlation
        Correlation of both errors, in [-1, 1]; an error of the shading has 1 and cancels.

    Returns
    -------
    ndarray
        Broadcast shape.

    Examples
    --------
    >>> round(float(erythema_index_stderr(0.5, 0.25, 0.005, 0.0025)), 2)
    0.61
    """
    Checks().within("correlation", correlation, "[-1, 1]")
    first, second = _relative(red, red_stderr), _relative(green, green_stderr)
    variance = first**2 + second**2 - 2.0 * correlation * first * second
    return np.asarray(_SCALE / np.log(10.0) * np.sqrt(np.maximum(variance, 0.0)))


def melanin_index(red: ArrayLike) -> Float64Array:
    """Return the melanin index 100 log10(1 / R_red).

    Parameters
    ----------
    red
        Reflectance in a red band, about `RED_BAND_NM` for the DermaSpectrometer, any shape.

    Returns
    -------
    ndarray
        Shaped like `red`; high is dark. NaN where the reflectance is not above 0.

    Examples
    --------
    >>> melanin_index([1.0, 0.1]).tolist()
    [-0.0, 100.0]
    """
    return np.asarray(-_scaled_log(red))


def melanin_index_stderr(red: ArrayLike, red_stderr: ArrayLike) -> Float64Array:
    """Return the standard error of `melanin_index`, to first order, broadcast shape.

    Examples
    --------
    >>> round(float(melanin_index_stderr(0.5, 0.005)), 2)
    0.43
    """
    return np.asarray(_SCALE / np.log(10.0) * _relative(red, red_stderr))


def dawson_erythema_index(reflectance: ArrayLike, wavelength_nm: ArrayLike) -> Float64Array:
    """Return Dawson's erythema index: absorption by hemoglobin above a line from 510 to 610 nm.

    Parameters
    ----------
    reflectance
        (..., n), spectra, interpolated linearly.
    wavelength_nm
        The n wavelengths in nm, increasing, at least from 510 to 610.

    Returns
    -------
    ndarray
        (...), 100 times the weighted sum of log10(1/R) with `DAWSON_WEIGHTS`; 0 where log R is a
        straight line in wavelength (within 1.5 % of its change over 100 nm).

    Examples
    --------
    >>> nm = np.arange(400.0, 701.0, 10.0)
    >>> dip = 1.0 - 0.2 * np.exp(-(((nm - 560.0) / 25.0) ** 2))
    >>> round(float(dawson_erythema_index(0.3 * dip, nm)), 1)
    26.9
    """
    values = np.asarray(reflectance, np.float64)
    nodes = np.asarray(wavelength_nm, np.float64)
    Checks().shape("reflectance", values, ("...", nodes.size))
    bands = np.array(DAWSON_BANDS_NM)
    increasing = nodes.ndim == 1 and bool(np.all(np.diff(nodes) > 0.0))
    Checks().require(increasing, "wavelength_nm", nodes.shape, "increasing wavelengths on one axis")
    inside = nodes[0] <= bands[0] and bands[-1] <= nodes[-1]
    Checks().require(inside, "wavelength_nm", f"{nodes[0]} to {nodes[-1]}", "510 to 610 nm or more")
    right = np.clip(np.searchsorted(nodes, bands), 1, nodes.size - 1)
    fraction = (bands - nodes[right - 1]) / (nodes[right] - nodes[right - 1])
    sampled = (1.0 - fraction) * values[..., right - 1] + fraction * values[..., right]
    return np.asarray(-_scaled_log(sampled) @ np.array(DAWSON_WEIGHTS))


def _scaled_log(reflectance: ArrayLike) -> Float64Array:
    values = np.asarray(reflectance, np.float64)
    positive = values > 0.0
    return np.where(positive, _SCALE * np.log10(np.where(positive, values, 1.0)), np.nan)


def _relative(values: ArrayLike, stderr: ArrayLike) -> Float64Array:
    reflectance, error = np.asarray(values, np.float64), np.asarray(stderr, np.float64)
    positive = reflectance > 0.0
    return np.where(positive, error / np.where(positive, reflectance, 1.0), np.nan)
