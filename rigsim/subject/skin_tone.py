"""Find the melanin of a person from the tone of the skin."""

from functools import lru_cache
from typing import Final

import numpy as np
from scipy.optimize import brentq

from model import spectra
from rigsim.subject.person_skin import MELANIN_RANGE
from rigsim.subject.pigment import typical_blood
from rigsim.tissue.skin_layers import TYPICAL_SKIN, TissueProperties
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable

ITA_PREFIX: Final = "ita:"
MONK_PREFIX: Final = "monk:"
MONK_ITA_DEG: Final = (83.0, 80.2, 71.7, 64.7, 50.3, 10.9, -20.1, -55.4, -78.3, -84.3)
"""Individual typology angles of the ten published colors of the Monk Skin Tone Scale, degrees."""
SPHERE_SPECULAR: Final = (0.4 / 2.4) ** 2
"""Reflectance of the surface that an instrument of sphere geometry includes, index 1.4."""
_SRGB_TO_XYZ: Final = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
"""IEC 61966-2-1, D65."""


class SkinToneError(ValueError):
    """A skin tone that is malformed, or that no skin has."""


def is_skin_tone(text: str) -> bool:
    """Return whether a subject's text is a skin tone.

    Examples
    --------
    >>> is_skin_tone("ita:27"), is_skin_tone("monk:5"), is_skin_tone("IV")
    (True, True, False)
    """
    return text.startswith((ITA_PREFIX, MONK_PREFIX))


def typology_angle_deg(melanin: float, tissue: TissueProperties = TYPICAL_SKIN) -> float:
    """Return the individual typology angle of skin with a melanosome volume fraction.

    Parameters
    ----------
    melanin
        Volume fraction of melanosomes, 0.001 to 0.45.
    tissue
        All other properties of the skin.

    Returns
    -------
    float
        Degrees, D65, for an instrument that includes the specular reflection. Between the face's
        regions; Chardon et al. 1991, doi:10.1111/j.1467-2494.1991.tb00561.x.

    Examples
    --------
    >>> round(typology_angle_deg(0.0255))
    35
    """
    diffuse = SkinTable.load(tissue).spectra(melanin, typical_blood(melanin))
    spectrum = diffuse + SPHERE_SPECULAR
    rgb = spectrum @ spectra.band_weights(spectra.LINEAR_SRGB, "D65", WAVELENGTH_NM)
    matrix = np.array(_SRGB_TO_XYZ)
    _, y, z = np.cbrt(rgb @ matrix.T / matrix.sum(axis=1))
    return float(np.degrees(np.arctan2(116.0 * y - 66.0, 200.0 * (y - z))))


@lru_cache(maxsize=64)
def melanin_of_tone(text: str, tissue: TissueProperties = TYPICAL_SKIN) -> float:
    """Return the melanosome volume fraction of a person of a skin tone.

    Parameters
    ----------
    text
        "ita:DEGREES", an individual typology angle, or "monk:N", the tone 1 to 10 of the Monk Skin
        Tone Scale. A person of a Monk tone has the angle of its color. The colors 1 to 3 and 10
        lie beyond skin, so the nearest possible angle is taken.
    tissue
        All other properties of the skin. The range of angles is that of typical skin; where this
        skin has a smaller one, its end is taken.

    Raises
    ------
    SkinToneError
        The text is malformed, or no typical skin has the angle.

    Examples
    --------
    >>> round(typology_angle_deg(melanin_of_tone("ita:27")), 3)
    27.0
    >>> melanin_of_tone("monk:7") > melanin_of_tone("monk:5")
    True
    """
    low, high = (typology_angle_deg(melanin) for melanin in reversed(MELANIN_RANGE))
    prefix, _, number = text.partition(":")
    try:
        angle = float(number)
    except ValueError:
        angle = float("nan")
    if prefix == "monk":
        if angle not in range(1, len(MONK_ITA_DEG) + 1):
            raise SkinToneError(f"subject: got {text!r}, expected monk:1 to monk:10")
        angle = min(max(MONK_ITA_DEG[int(angle) - 1], low), high)
    if not low <= angle <= high:
        raise SkinToneError(
            f"subject: got {text!r}, expected ita:DEGREES from {low:.0f} to {high:.0f}"
        )

    def difference(log_melanin: float) -> float:
        return typology_angle_deg(float(np.exp(log_melanin)), tissue) - angle

    pale, dark = np.log(MELANIN_RANGE)
    if difference(pale) <= 0.0:
        return MELANIN_RANGE[0]
    if difference(dark) >= 0.0:
        return MELANIN_RANGE[1]
    return float(np.clip(np.exp(brentq(difference, pale, dark, xtol=1e-9)), *MELANIN_RANGE))
