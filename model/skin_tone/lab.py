"""CIE 1976 L*a*b* of skin under D65 and the CIE 1931 observer, with its covariance."""

import numpy as np
from numpy.typing import ArrayLike

from model import spectra
from model.arrays import Float64Array
from model.checks import Checks

_CUBE_ROOT_START = (6.0 / 29.0) ** 3  # CIE 15:2004, threshold of the cube root
_LINEAR_SLOPE = 1.0 / (3.0 * (6.0 / 29.0) ** 2)  # below it
_LAB_FROM_ROOTS = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])


def lab(linear_srgb: ArrayLike) -> Float64Array:
    """Return CIE L*a*b* of linear sRGB under D65.

    Parameters
    ----------
    linear_srgb
        (..., 3), reflectance factors: a perfect white is (1, 1, 1). Noise may make them negative.

    Returns
    -------
    ndarray
        (..., 3): L*, a*, b*.

    References
    ----------
    CIE 015:2018 Colorimetry, doi:10.25039/TR.015.2018; IEC 61966-2-1:1999.

    Examples
    --------
    >>> lab([0.5, 0.32, 0.24]).round(1).tolist()
    [65.9, 9.9, 14.7]
    """
    roots = _roots(_xyz_ratio(_colors("linear_srgb", linear_srgb)))
    return np.asarray(roots @ _LAB_FROM_ROOTS.T - np.array([16.0, 0.0, 0.0]))


def lab_covariance(linear_srgb: ArrayLike, covariance: ArrayLike) -> Float64Array:
    """Propagate the covariance of linear sRGB to that of L*a*b*, to first order.

    Parameters
    ----------
    linear_srgb
        (..., 3), as for `lab`.
    covariance
        (..., 3, 3), of linear sRGB; for independent channels a diagonal matrix of variances.

    Returns
    -------
    ndarray
        (..., 3, 3), covariance of L*, a*, b*.

    Examples
    --------
    >>> found = lab_covariance([0.5, 0.32, 0.24], 0.005**2 * np.eye(3))
    >>> np.sqrt(np.diagonal(found)).round(2).tolist()
    [0.29, 0.71, 0.79]
    """
    rgb = _colors("linear_srgb", linear_srgb)
    given = np.asarray(covariance, np.float64)
    Checks().shape("covariance", given, ("...", 3, 3))
    ratio = _xyz_ratio(rgb)
    above = np.maximum(ratio, _CUBE_ROOT_START)
    slope = np.where(ratio > _CUBE_ROOT_START, 1.0 / (3.0 * np.cbrt(above) ** 2), _LINEAR_SLOPE)
    jacobian = _LAB_FROM_ROOTS * slope[..., None, :] @ _ratio_matrix()
    return np.asarray(jacobian @ given @ np.swapaxes(jacobian, -1, -2))


def lab_of_spectra(
    reflectance: ArrayLike, wavelength_nm: ArrayLike = spectra.WAVELENGTH_NM
) -> Float64Array:
    """Return CIE L*a*b* of reflectance spectra under D65.

    Parameters
    ----------
    reflectance
        (..., n), 1 for a perfect white.
    wavelength_nm
        The n wavelengths in nm, increasing; only their range is integrated.

    Returns
    -------
    ndarray
        (..., 3): L*, a*, b*.

    Examples
    --------
    >>> round(float(lab_of_spectra(np.full(31, 0.184187))[0]), 2)
    50.0
    """
    return lab(
        spectra.band_average(reflectance, spectra.LINEAR_SRGB, "D65", wavelength_nm=wavelength_nm)
    )


def hue_chroma(lab_color: ArrayLike) -> tuple[Float64Array, Float64Array]:
    """Return the hue angle in degrees, 0 to 360, and the chroma of L*a*b*, each (...).

    Examples
    --------
    >>> hue, chroma = hue_chroma([60.0, 10.0, 10.0])
    >>> float(hue), round(float(chroma), 2)
    (45.0, 14.14)
    """
    color = _colors("lab_color", lab_color)
    hue = np.degrees(np.arctan2(color[..., 2], color[..., 1])) % 360.0
    return np.asarray(hue), np.hypot(color[..., 1], color[..., 2])


def _ratio_matrix() -> Float64Array:
    """Return the matrix from linear sRGB to XYZ over that of the white, (3, 3)."""
    matrix = np.linalg.inv(spectra.XYZ_TO_LINEAR_SRGB)
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


def _xyz_ratio(linear_srgb: Float64Array) -> Float64Array:
    return np.asarray(linear_srgb @ _ratio_matrix().T)


def _roots(ratio: Float64Array) -> Float64Array:
    line = _LINEAR_SLOPE * ratio + 4.0 / 29.0
    return np.where(ratio > _CUBE_ROOT_START, np.cbrt(ratio), line)


def _colors(name: str, values: ArrayLike) -> Float64Array:
    color = np.asarray(values, np.float64)
    Checks().shape(name, color, ("...", 3))
    return color
