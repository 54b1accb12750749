"""Optical constants of skin with a homogeneous epidermis on a deep dermis."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model import spectra
from model.arrays import Float64Array
from model.checks import Checks

SCATTERING_WAVELENGTH_NM: Final = 500.0
"""Wavelength of `TissueConstants.scattering_per_mm`, as in Jacques 2013."""

OPTICAL_DEPTH_NM: Final = 550.0
"""Wavelength of the melanin optical depth."""


class TissueError(ValueError):
    """Error for a chromophore or an optical property outside the range of tissue."""


@dataclass(frozen=True, slots=True)
class TissueConstants:
    """Constants of two-layer skin that a color does not determine.

    Reduced scattering is a (f (w/500)^-4 + (1 - f) (w/500)^-b) at w nm, Jacques 2013, eq. (2).
    """

    epidermis_mm: float
    """Thickness of the epidermis, mm."""
    epidermal_blood_ratio: float
    """Blood volume fraction of the epidermis over that of the dermis, 0 to 1."""
    oxygenation: float
    """Fraction of oxygenated hemoglobin, 0 to 1."""
    scattering_per_mm: float
    """Reduced scattering of the epidermis at 500 nm, a, 1/mm."""
    rayleigh_fraction: float
    """Fraction f of Rayleigh scattering at 500 nm, 0 to 1."""
    scattering_slope: float
    """Exponent b of the other scattering."""
    dermis_scattering: float
    """Reduced scattering of the dermis over that of the epidermis."""
    baseline_factor: float
    """Absorption without melanin and blood over that of `spectra.baseline_absorption`."""
    eumelanin_fraction: float
    """Fraction of eumelanin in melanin, 0 to 1."""

    def __post_init__(self) -> None:
        """Refuse constants outside the range of tissue."""
        check = Checks(TissueError)
        for name in ("epidermis_mm", "scattering_per_mm", "dermis_scattering"):
            check.within(name, getattr(self, name), "(0, 100]")
        for name in (
            "epidermal_blood_ratio",
            "oxygenation",
            "rayleigh_fraction",
            "eumelanin_fraction",
        ):
            check.within(name, getattr(self, name), "[0, 1]")
        check.within("scattering_slope", self.scattering_slope, "[-4, 4]")
        check.within("baseline_factor", self.baseline_factor, "[0, 100]")

    def epidermal_scattering(self, wavelength_nm: ArrayLike) -> Float64Array:
        """Return the reduced scattering of the epidermis in 1/mm, shaped like the wavelengths.

        Examples
        --------
        >>> SKIN_CONSTANTS.epidermal_scattering([500.0, 600.0]).round(2).tolist()
        [9.2, 7.1]
        """
        ratio = np.asarray(wavelength_nm, dtype=np.float64) / SCATTERING_WAVELENGTH_NM
        rayleigh = self.rayleigh_fraction * ratio**-4.0
        return np.asarray(
            self.scattering_per_mm
            * (rayleigh + (1.0 - self.rayleigh_fraction) * ratio**-self.scattering_slope)
        )

    def melanin_absorption(self, wavelength_nm: ArrayLike) -> Float64Array:
        """Return the absorption of melanosomes in 1/mm, shaped like the wavelengths.

        Examples
        --------
        >>> round(float(SKIN_CONSTANTS.melanin_absorption(550.0)), 1)
        45.1
        """
        fraction = self.eumelanin_fraction
        return np.asarray(
            fraction * spectra.eumelanin_absorption(wavelength_nm)
            + (1.0 - fraction) * spectra.pheomelanin_absorption(wavelength_nm)
        )

    @property
    def melanin_depth_factor(self) -> float:
        """Optical depth of melanin at 550 nm over its volume fraction."""
        return self.epidermis_mm * float(self.melanin_absorption(OPTICAL_DEPTH_NM))


SKIN_CONSTANTS: Final = TissueConstants(
    epidermis_mm=0.09,
    epidermal_blood_ratio=0.0,
    oxygenation=0.75,
    scattering_per_mm=9.2,
    rayleigh_fraction=0.0,
    scattering_slope=1.421,
    dermis_scattering=0.5,
    baseline_factor=1.0,
    eumelanin_fraction=0.8,
)
"""Round values near the literature that fit measured reflectance spectra of skin (ISSA).

Thickness: 0.075 to 0.096 mm at three sites (Sandby-Moller 2003, doi:10.1080/00015550310015419),
0.1 mm in a meta-analysis (Xu 2017, doi:10.1016/j.jaad.2017.06.009). The epidermis has no vessels.
Oxygenation: Donner et al. 2008, doi:10.1145/1409060.1409093. Scattering: the dermis has 4.6/mm at
500 nm with slope 1.421, mean of skin in Jacques 2013, doi:10.1088/0031-9155/58/11/R37; twice that
in the epidermis (Donner et al. 2008). Eumelanin: between the mixture of Donner and Jensen 2006
(0.61) and the melanosomes of Jacques (1); measured spectra fit equally well from 0.6 to 0.95.
"""

PAPER_CONSTANTS: Final = TissueConstants(
    epidermis_mm=0.25,
    epidermal_blood_ratio=0.25,
    oxygenation=0.75,
    scattering_per_mm=float(spectra.reduced_scattering(SCATTERING_WAVELENGTH_NM)),
    rayleigh_fraction=float(
        spectra.RAYLEIGH_FACTOR_PER_MM
        * SCATTERING_WAVELENGTH_NM**spectra.RAYLEIGH_EXPONENT
        / spectra.reduced_scattering(SCATTERING_WAVELENGTH_NM)
    ),
    scattering_slope=-spectra.MIE_EXPONENT,
    dermis_scattering=0.5,
    baseline_factor=1.0,
    eumelanin_fraction=0.61,
)
"""Constants of the papers, for comparison with them.

Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417; Donner et al. 2008,
doi:10.1145/1409060.1409093; Jimenez et al. 2010, doi:10.1145/1866158.1866167. Of measured skin they
explain 0.021 to 0.029 of reflectance poorly, against 0.005 to 0.019 with `SKIN_CONSTANTS` (RMS).
"""


def with_fractions(
    constants: TissueConstants, eumelanin_fraction: float | None, oxygenation: float | None
) -> TissueConstants:
    """Return the constants with other fractions of pigment; None leaves one as it is.

    Examples
    --------
    >>> with_fractions(SKIN_CONSTANTS, None, 0.5).oxygenation
    0.5
    """
    given = {"eumelanin_fraction": eumelanin_fraction, "oxygenation": oxygenation}
    return replace(constants, **{k: float(v) for k, v in given.items() if v is not None})
