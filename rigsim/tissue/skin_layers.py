"""Layers of the simulated skin: absorption and scattering by wavelength.

An epidermis with melanin, denser in its basal third, lies on a semi-infinite dermis with blood. The
coefficients are evaluated independently of the estimators, so that the simulation does not share an
equation with the estimators evaluated on it; only tabulated data are shared.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.spectra import hemoglobin_extinction
from rigsim.arrays import Float64Array
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError

ETA = 1.4  # Donner et al. 2008, doi:10.1145/1409060.1409093, both layers
SKIN_ANISOTROPY = (
    0.8  # Henyey-Greenstein g; van Gemert et al. 1989, doi:10.1109/10.42108: .75-.82 visible
)
DERMIS_SCATTERING_RATIO = 0.5  # of the epidermis's, Donner et al. 2008
BASAL_THICKNESS_FRACTION = 1.0 / 3.0  # of the epidermis, with the melanocytes
BLOOD_G_PER_L, HEMOGLOBIN_G_PER_MOL = 150.0, 64_500.0  # Prahl 1998 (OMLC)

MAX_C_M, MAX_C_HD = 0.5, 0.32  # Jimenez et al. 2010, table 1
REFERENCE_EPIDERMIS_MM: Final = 0.09
"""Thickness of the epidermis to which volume fractions of melanosomes refer, mm."""
REFERENCE_WAVELENGTH_NM: Final = 500.0
"""Wavelength of `TissueProperties.scattering_per_mm`."""


@dataclass(frozen=True, slots=True)
class TissueProperties:
    """Properties of a person's skin except for the amounts of melanin and blood."""

    epidermis_mm: float = REFERENCE_EPIDERMIS_MM
    """Thickness of the epidermis between the regions of the face, mm, 0.03 to 0.4. Sandby-Moller et
    al. 2003, doi:10.1080/00015550310015419: 0.075 on the forearm, 0.097 on the buttock."""
    site_contrast: float = 0.0
    """Contrast of the thickness between regions of the face, 0 to 2; 1 is the published one, see
    `rigsim.subject.thickness`."""
    basal_melanin_fraction: float = BASAL_THICKNESS_FRACTION
    """Fraction of the melanin in the basal third of the epidermis, 1/3 (even) to 0.6."""
    epidermal_blood_ratio: float = 0.0
    """Volume fraction of blood in the epidermis over that in the dermis, 0 to 1. The epidermis has
    no vessels."""
    oxygenation: float = 0.75
    """Fraction of oxygenated hemoglobin, 0 to 1; Donner and Jensen 2006,
    doi:10.2312/EGWR/EGSR06/409-417."""
    scattering_per_mm: float = 9.2
    """Reduced scattering of the epidermis at 500 nm, 1/mm, 2 to 20; the dermis has half of it,
    4.6: the mean of measured skin, Jacques 2013, doi:10.1088/0031-9155/58/11/R37."""
    rayleigh_fraction: float = 0.0
    """Fraction of that scattering that falls with the fourth power of the wavelength, 0 to 1."""
    scattering_slope: float = 1.421
    """Power with which the rest of the scattering falls, 0 to 4; Jacques 2013."""
    baseline_amplitude: float = 1.0
    """Factor of the absorption of bloodless, unpigmented skin, 0.3 to 3."""
    eumelanin_fraction: float = 0.8
    """Fraction of eumelanin; the rest is pheomelanin. Between 0.61 (Donner et al. 2008) and the
    melanosomes of Jacques 2013, 1; measured spectra agree with 0.6 to 0.95 alike."""
    melanin_reference_mm: float = REFERENCE_EPIDERMIS_MM
    """Thickness to which volume fractions of melanosomes refer, mm. Skin of another thickness and
    the same fraction has the same melanin per area."""

    def __post_init__(self) -> None:
        for name, (low, high) in PROPERTY_RANGES.items():
            _require_range(name, getattr(self, name), low, high)
        _require_range("melanin_reference_mm", self.melanin_reference_mm, *_THICKNESS_RANGE_MM)

    def with_thickness_ratio(self, ratio: float) -> "TissueProperties":
        """Return this skin at a site, with the epidermis thicker by a factor, in its range.

        Examples
        --------
        >>> thin = TissueProperties(site_contrast=1.0).with_thickness_ratio(0.9)
        >>> round(thin.epidermis_mm, 4), thin.site_contrast
        (0.081, 0.0)
        """
        low, high = _THICKNESS_RANGE_MM
        return replace(
            self, epidermis_mm=min(max(self.epidermis_mm * ratio, low), high), site_contrast=0.0
        )


_THICKNESS_RANGE_MM: Final = (0.03, 0.4)

PROPERTY_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "epidermis_mm": _THICKNESS_RANGE_MM,
    "site_contrast": (0.0, 2.0),
    "basal_melanin_fraction": (BASAL_THICKNESS_FRACTION, 0.6),
    "epidermal_blood_ratio": (0.0, 1.0),
    "oxygenation": (0.0, 1.0),
    "scattering_per_mm": (2.0, 20.0),
    "rayleigh_fraction": (0.0, 1.0),
    "scattering_slope": (0.0, 4.0),
    "baseline_amplitude": (0.3, 3.0),
    "eumelanin_fraction": (0.0, 1.0),
}
"""Lowest and highest value of each property."""


def _require_range(name: str, value: ArrayLike, low: float, high: float) -> None:
    values = np.asarray(value, np.float64)
    if not np.all((values >= low) & (values <= high)):
        raise TransportError(f"{name}: expected {low:g} <= {name} <= {high:g}, got {value!r}")


TYPICAL_SKIN: Final = TissueProperties()
"""Properties of typical skin. They agree with measured spectra: see `docs/decisions/0019`."""

_DONNER_MIE_PER_MM: Final = 14.74 * REFERENCE_WAVELENGTH_NM**-0.22
_DONNER_RAYLEIGH_PER_MM: Final = 2.2e11 * REFERENCE_WAVELENGTH_NM**-4.0
PAPER_SKIN: Final = TissueProperties(
    epidermis_mm=0.25,
    melanin_reference_mm=0.25,
    epidermal_blood_ratio=0.25,
    eumelanin_fraction=0.61,
    scattering_per_mm=_DONNER_MIE_PER_MM + _DONNER_RAYLEIGH_PER_MM,
    rayleigh_fraction=_DONNER_RAYLEIGH_PER_MM / (_DONNER_MIE_PER_MM + _DONNER_RAYLEIGH_PER_MM),
    scattering_slope=0.22,
)
"""Properties of the papers' model, for comparison with them: an epidermis of 0.25 mm and its
scattering (Donner et al. 2008; public codes vary the Rayleigh constant from 2e11 to 2.22e11), with
a quarter of the dermis's blood (Jimenez et al. 2010, doi:10.1145/1882261.1866167)."""


def melanin_per_mm(wavelength_nm: ArrayLike, eumelanin_fraction: float = 0.8) -> Float64Array:
    """Return the absorption of mixed melanins in 1/mm, shaped like the wavelengths.

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(float(melanin_per_mm(500.0, 0.61)), 2)  # .61 of 67.92 and .39 of 43.88
    58.54
    """
    wavelength = np.asarray(wavelength_nm, np.float64)
    eumelanin = 6.6e10 * wavelength**-3.33
    pheomelanin = 2.9e14 * wavelength**-4.75
    return eumelanin_fraction * eumelanin + (1.0 - eumelanin_fraction) * pheomelanin


def blood_per_mm(wavelength_nm: ArrayLike, oxygenation: float = 0.75) -> Float64Array:
    """Return the absorption of whole blood in 1/mm, shaped like the wavelengths.

    References
    ----------
    S. Prahl, Tabulated molar extinction coefficient for hemoglobin in water, OMLC 1998.

    Examples
    --------
    >>> round(float(blood_per_mm(540.0)), 3)
    27.618
    """
    oxy, deoxy = hemoglobin_extinction(wavelength_nm)
    per_cm_molar = oxygenation * oxy + (1.0 - oxygenation) * deoxy
    molar = BLOOD_G_PER_L / HEMOGLOBIN_G_PER_MOL
    return np.asarray(np.log(10.0) * molar * per_cm_molar / 10.0)


def baseline_per_mm(wavelength_nm: ArrayLike) -> Float64Array:
    """Return the absorption of bloodless, unpigmented skin in 1/mm, shaped like the wavelengths.

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(float(baseline_per_mm(500.0)), 4)
    0.0702
    """
    wavelength = np.asarray(wavelength_nm, np.float64)
    return np.asarray(0.0244 + 8.53 * np.exp(-(wavelength - 154.0) / 66.2))


def epidermis_scattering_per_mm(
    wavelength_nm: ArrayLike, tissue: TissueProperties = TYPICAL_SKIN
) -> Float64Array:
    """Return the reduced scattering of the epidermis in 1/mm; the dermis has half of it.

    References
    ----------
    Jacques 2013, doi:10.1088/0031-9155/58/11/R37, equation 2.

    Examples
    --------
    >>> round(float(epidermis_scattering_per_mm(700.0, PAPER_SKIN)), 3)
    4.404
    """
    ratio = np.asarray(wavelength_nm, np.float64) / REFERENCE_WAVELENGTH_NM
    rayleigh = tissue.rayleigh_fraction
    shape = rayleigh * ratio**-4.0 + (1.0 - rayleigh) * ratio**-tissue.scattering_slope
    return np.asarray(tissue.scattering_per_mm * shape)


@dataclass(frozen=True, slots=True, eq=False)
class SkinCoefficients:
    """Absorption and reduced scattering of each layer, 1/mm, arrays of one shape."""

    upper: Float64Array
    """Absorption of the upper two thirds of the epidermis."""
    basal: Float64Array
    """Absorption of the basal third of the epidermis."""
    dermis: Float64Array
    """Absorption of the dermis."""
    scattering: Float64Array
    """Reduced scattering of the epidermis; the dermis has `DERMIS_SCATTERING_RATIO` of it."""


def skin_coefficients(
    wavelength_nm: ArrayLike,
    c_m: ArrayLike,
    c_hd: ArrayLike,
    tissue: TissueProperties = TYPICAL_SKIN,
) -> SkinCoefficients:
    """Return the absorption and scattering of skin.

    Parameters
    ----------
    wavelength_nm, c_m, c_hd
        As in `skin_layer_stack`, broadcast together.
    tissue
        All other properties.

    Raises
    ------
    rigsim.tissue.tissue_mc.TransportError
        When a fraction is outside its range.
    """
    _require_range("c_m", c_m, 0.0, MAX_C_M)
    _require_range("c_hd", c_hd, 0.0, MAX_C_HD)
    wavelength, melanosomes, blood = np.broadcast_arrays(
        np.asarray(wavelength_nm, np.float64), np.asarray(c_m, float), np.asarray(c_hd, float)
    )
    melanin = melanin_per_mm(wavelength, tissue.eumelanin_fraction)
    whole_blood = blood_per_mm(wavelength, tissue.oxygenation)
    baseline = tissue.baseline_amplitude * baseline_per_mm(wavelength)
    c_he = tissue.epidermal_blood_ratio * blood
    melanosomes = melanosomes * (tissue.melanin_reference_mm / tissue.epidermis_mm)
    basal = melanosomes * tissue.basal_melanin_fraction / BASAL_THICKNESS_FRACTION
    upper = melanosomes * (1.0 - tissue.basal_melanin_fraction) / (1.0 - BASAL_THICKNESS_FRACTION)

    def epidermis(local: Float64Array) -> Float64Array:
        bloodless = np.maximum(1.0 - local - c_he, 0.0)  # melanin of a thin epidermis may fill it
        return local * melanin + c_he * whole_blood + bloodless * baseline

    return SkinCoefficients(
        upper=epidermis(upper),
        basal=epidermis(basal),
        dermis=blood * whole_blood + (1.0 - blood) * baseline,
        scattering=epidermis_scattering_per_mm(wavelength, tissue),
    )


def skin_layer_stack(
    wavelength_nm: float, c_m: float, c_hd: float, tissue: TissueProperties = TYPICAL_SKIN
) -> LayerStack:
    """Return the layers of skin at one wavelength.

    Parameters
    ----------
    wavelength_nm
        Wavelength in nm, 380 to 780.
    c_m
        Volume fraction of melanosomes in an epidermis of `TissueProperties.melanin_reference_mm`,
        0 to 0.5.
    c_hd
        Volume fraction of blood in the dermis, 0 to 0.32.
    tissue
        All other properties.

    Returns
    -------
    LayerStack
        Epidermis on a semi-infinite dermis, index 1.4, g 0.8, under air; the epidermis is one layer
        where its melanin is even, else its upper two thirds and its basal third.

    Raises
    ------
    TransportError
        When a fraction is outside its range.

    Examples
    --------
    >>> stack = skin_layer_stack(500.0, 0.1, 0.04, PAPER_SKIN)
    >>> [round(layer.sigma_a_per_mm, 3) for layer in stack.layers]
    [6.029, 0.515]
    """
    found = skin_coefficients(wavelength_nm, c_m, c_hd, tissue)
    sigma_s = float(found.scattering) / (1.0 - SKIN_ANISOTROPY)
    upper, basal = float(found.upper), float(found.basal)
    thickness = tissue.epidermis_mm
    parts = [(thickness, upper)]
    if tissue.basal_melanin_fraction > BASAL_THICKNESS_FRACTION:
        basal_mm = BASAL_THICKNESS_FRACTION * thickness
        parts = [(thickness - basal_mm, upper), (basal_mm, basal)]
    epidermis = [Layer(mm, sigma_a, sigma_s, SKIN_ANISOTROPY, ETA) for mm, sigma_a in parts]
    dermis = Layer(
        inf, float(found.dermis), DERMIS_SCATTERING_RATIO * sigma_s, SKIN_ANISOTROPY, ETA
    )
    return LayerStack((*epidermis, dermis))
