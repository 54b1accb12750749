"""Scales of skin tone: individual typology angle and Monk skin tone."""

from collections.abc import Callable
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike

from model import metrics
from model.arrays import Float64Array, UInt8Array
from model.checks import Checks
from model.skin_tone.lab import lab

ITA_BANDS = ("I", "II", "III", "IV", "V", "VI")
"""Bands of the typology angle: very light, light, intermediate, tan, brown, dark."""
ITA_EDGES_DEG = (55.0, 41.0, 28.0, 10.0, -30.0)
"""Lower edges of all bands but the last, degrees; an edge belongs to the darker band.

Chardon et al. 1991, doi:10.1111/j.1467-2494.1991.tb00561.x; the edge at -30 divides brown from
dark: Del Bino and Bernerd 2013, doi:10.1111/bjd.12529.
"""
MONK_TONES = 10
_SRGB_LINEAR_END = 0.04045  # IEC 61966-2-1:1999


def ita(lab_color: ArrayLike) -> Float64Array:
    """Return the individual typology angle, arctan((L* - 50) / b*), in degrees.

    Parameters
    ----------
    lab_color
        (..., 3), CIE L*a*b* under D65.

    Returns
    -------
    ndarray
        (...), degrees; high is light.

    References
    ----------
    Chardon, Cretois, Hourseau 1991, doi:10.1111/j.1467-2494.1991.tb00561.x.

    Examples
    --------
    >>> ita([[65.0, 8.0, 15.0], [30.0, 10.0, 20.0]]).tolist()
    [45.0, -45.0]
    """
    color = np.asarray(lab_color, np.float64)
    Checks().shape("lab_color", color, ("...", 3))
    return metrics.individual_typology_angle_deg(color[..., 0], color[..., 2])


def ita_stderr(lab_color: ArrayLike, covariance: ArrayLike) -> Float64Array:
    """Return the standard error of `ita` in degrees, to first order.

    Parameters
    ----------
    lab_color
        (..., 3), as for `ita`.
    covariance
        (..., 3, 3), of L*, a*, b*, as `lab_covariance` returns it.

    Returns
    -------
    ndarray
        (...), degrees; at most 104, that of an angle without information. First order holds
        where it is small against 45 degrees.

    Examples
    --------
    >>> round(float(ita_stderr([65.0, 8.0, 15.0], np.diag([0.5, 0.4, 0.5]) ** 2)), 2)
    1.35
    """
    color = np.asarray(lab_color, np.float64)
    Checks().shape("lab_color", color, ("...", 3))
    given = np.asarray(covariance, np.float64)
    Checks().shape("covariance", given, ("...", 3, 3))
    height, b_star = color[..., 0] - 50.0, color[..., 2]
    square = height**2 + b_star**2
    variance = (
        b_star**2 * given[..., 0, 0]
        - 2.0 * height * b_star * given[..., 0, 2]
        + height**2 * given[..., 2, 2]
    )
    known = square > 0.0
    uniform = np.radians(360.0 / np.sqrt(12.0))  # of an angle anywhere in the circle
    deviation = np.sqrt(np.maximum(variance, 0.0)) / np.where(known, square, 1.0)
    return np.degrees(np.minimum(np.where(known, deviation, uniform), uniform))


def ita_band(ita_deg: ArrayLike) -> UInt8Array:
    """Return the band of typology angles: 1 to 6 for `ITA_BANDS`, 0 where the angle is NaN.

    Examples
    --------
    >>> ita_band([60.0, 55.0, 30.0, 0.0, -40.0, np.nan]).tolist()
    [1, 2, 3, 5, 6, 0]
    """
    angle = np.asarray(ita_deg, np.float64)
    place = 1 + np.searchsorted(-np.array(ITA_EDGES_DEG), -angle, side="right")
    return np.where(np.isnan(angle), 0, place).astype(np.uint8)


@cache
def _monk_table() -> Float64Array:
    path = resources.files("model").joinpath("data", "monk_skin_tones.csv")
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line[:1].isdigit()]
    code = np.array([list(bytes.fromhex(line.split(",")[1])) for line in lines]) / 255.0
    linear = np.where(code > _SRGB_LINEAR_END, ((code + 0.055) / 1.055) ** 2.4, code / 12.92)
    found = lab(linear)
    found.setflags(write=False)
    return found


def monk_colors() -> Float64Array:
    """Return CIE L*a*b* under D65 of the ten Monk skin tones, (10, 3), from light to dark.

    References
    ----------
    Monk 2023, The Monk Skin Tone Scale, doi:10.31235/osf.io/pdf4c.

    Examples
    --------
    >>> monk_colors()[[0, 9], 0].round(1).tolist()
    [94.2, 14.6]
    """
    return _monk_table().copy()


def monk(
    lab_color: ArrayLike, color_difference: Callable[[Float64Array, Float64Array], Float64Array]
) -> UInt8Array:
    """Return the Monk skin tone whose reference color is nearest.

    Parameters
    ----------
    lab_color
        (..., 3), CIE L*a*b* under D65.
    color_difference
        CIEDE2000 of two arrays of L*a*b*, such as `capture.calibration.color.colorimetry`'s
        `delta_e_2000`; this package does not import one.

    Returns
    -------
    ndarray of uint8
        (...), 1 (lightest) to 10; 0 where the color is not finite.

    Notes
    -----
    The reference colors are those of a screen, where exposure makes faces lighter than their
    reflectance factors. Of 15,255 measured spectra 76 % are nearest to tone 6, 13 % to 7, 8 %
    to 5, 3 % to 8 and 9; none is nearest to 1 to 4 or to 10.

    References
    ----------
    Monk 2023, The Monk Skin Tone Scale, doi:10.31235/osf.io/pdf4c.

    Examples
    --------
    >>> distance = lambda a, b: np.linalg.norm(a - b, axis=-1)
    >>> monk([[77.8, 2.9, 23.7], [15.0, 1.0, 2.0]], distance).tolist()
    [5, 10]
    """
    color = np.asarray(lab_color, np.float64)
    Checks().shape("lab_color", color, ("...", 3))
    known = np.isfinite(color).all(axis=-1)
    flat = color[known]
    nearest = np.full(len(flat), np.inf)
    tone = np.zeros(len(flat), np.uint8)
    for number, reference in enumerate(_monk_table(), 1):
        distance = color_difference(flat, np.broadcast_to(reference, flat.shape))
        closer = distance < nearest
        nearest[closer], tone[closer] = distance[closer], number
    found = np.zeros(known.shape, np.uint8)
    found[known] = tone
    return found
