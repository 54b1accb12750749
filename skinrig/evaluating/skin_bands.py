"""Classify skin into bands by individual typology angle and by melanin."""

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model import skin_tone, spectra, tissue_optics
from skinrig.arrays import Float64Array

TYPOLOGY_NAMES: Final = ("very light", "light", "intermediate", "tan", "brown", "dark")
"""Bands of `model.skin_tone.ITA_BANDS`, in words."""


def typology_angle_deg(reflectance: ArrayLike) -> Float64Array:
    """Return the individual typology angle of reflectances.

    Parameters
    ----------
    reflectance
        (..., 3), camera RGB over that of a perfect white, interpreted as linear sRGB.

    Returns
    -------
    ndarray
        (...), degrees; high is light.

    Examples
    --------
    >>> typology_angle_deg([[0.6, 0.45, 0.36], [0.05, 0.03, 0.02]]).round(0).tolist()
    [64.0, -73.0]
    """
    rgb = np.maximum(np.asarray(reflectance, np.float64), 0.0)
    return skin_tone.ita(skin_tone.lab(rgb))


def classify_typology(angle_deg: ArrayLike) -> NDArray[np.str_]:
    """Return the names of the typology bands of angles, degrees.

    Examples
    --------
    >>> classify_typology([60.0, 30.0, -31.0]).tolist()
    ['very light', 'intermediate', 'dark']
    """
    band = skin_tone.ita_band(angle_deg).astype(np.intp)
    return np.array(TYPOLOGY_NAMES)[np.where(band > 0, band, len(TYPOLOGY_NAMES)) - 1]


@dataclass(frozen=True, slots=True)
class MelaninBand:
    """Band of skin by melanin, with a typical simulated person."""

    preset: str
    """Preset of the typical person, of `rigsim.subject.pigment.MELANIN_PRESETS`."""
    melanin: float
    """Melanosome volume fraction of that person's epidermis."""
    melanin_range: tuple[float, float]
    """Range of melanosome volume fractions of the band."""
    sigma_a_per_mm: float
    """Absorption in red light as measured by a fiber probe, 1/mm; higher in dark skin."""
    sigma_s_prime_per_mm: float
    """Reduced scattering in red light, 1/mm."""
    hemoglobin: float
    """Blood volume fraction of that person's dermis."""

    def reflectance(self) -> Float64Array:
        """Return the diffuse albedo of the typical person, (3,), linear sRGB under D65.

        Computed by the layered model of `model.tissue_optics`.
        """
        return _reflectance(self.melanin, self.hemoglobin)

    def to_dict(self) -> dict[str, Any]:
        """Return the band as JSON values."""
        return {
            "melanin": list(self.melanin_range),
            "typical_melanin": self.melanin,
            "typical_preset": self.preset,
            "typical_typology_angle_deg": round(float(typology_angle_deg(self.reflectance())), 1),
        }


MELANIN_BANDS: Final = {
    "light": MelaninBand("II", 0.016, (0.0, 0.026), 0.02, 1.4, 0.011),
    "medium": MelaninBand("IV", 0.0395, (0.026, 0.08), 0.08, 1.2, 0.013),
    "dark": MelaninBand("VI", 0.16, (0.08, 0.51), 0.3, 1.0, 0.018),
}
"""Bands from light to dark; melanin as in `rigsim.subject.pigment`."""


@cache
def _reflectance(melanin: float, hemoglobin: float) -> Float64Array:

    spectrum = tissue_optics.two_layer_reflectance(
        spectra.WAVELENGTH_NM,
        np.array([melanin]),
        np.array([hemoglobin]),
        constants=tissue_optics.SKIN_CONSTANTS,
    )
    found = np.asarray(spectra.band_average(spectrum, spectra.LINEAR_SRGB, "D65")[0], np.float64)
    found.setflags(write=False)
    return found


def classify_melanin(melanin: ArrayLike) -> NDArray[np.str_]:
    """Return the names of the melanin bands of melanosome volume fractions.

    Examples
    --------
    >>> classify_melanin([0.005, 0.03, 0.3]).tolist()
    ['light', 'medium', 'dark']
    """
    edges = [band.melanin_range[0] for band in MELANIN_BANDS.values()][1:]
    values = np.asarray(melanin, np.float64)
    return np.array(list(MELANIN_BANDS))[np.searchsorted(edges, values, side="right")]
