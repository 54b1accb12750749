"""Two-layer skin of the simulated subjects: absorption and scattering by wavelength.

An epidermis with melanin and a little blood lies on a semi-infinite dermis with blood. The
coefficients are evaluated independently of the estimators, so that the simulation does not share an
equation with the estimators evaluated on it; only tabulated data are shared.
"""

from math import exp, inf, isfinite, log

from model.spectra import hemoglobin_extinction
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError

EPIDERMIS_MM = 0.25  # Donner et al. 2008, doi:10.1145/1409060.1409093
ETA = 1.4  # Donner et al. 2008, both layers
SKIN_ANISOTROPY = (
    0.8  # Henyey-Greenstein g; van Gemert et al. 1989, doi:10.1109/10.42108: .75-.82 visible
)
EUMELANIN_FRACTION = 0.61  # beta_m, Donner et al. 2008; the rest is pheomelanin
EPIDERMAL_BLOOD_RATIO = 0.25  # C_he / C_hd, Jimenez et al. 2010, doi:10.1145/1882261.1866167
BLOOD_OXYGENATION = 0.75  # S, Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417
BLOOD_G_PER_L, HEMOGLOBIN_G_PER_MOL = 150.0, 64_500.0  # Prahl 1998 (OMLC)

MAX_C_M, MAX_C_HD = 0.5, 0.32  # Jimenez et al. 2010, table 1


def melanin_per_mm(wavelength_nm: float) -> float:
    """Return the absorption of the mixed melanins in 1/mm.

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(melanin_per_mm(500.0), 2)  # .61 of 67.92 and .39 of 43.88
    58.54
    """
    eumelanin = 6.6e10 * wavelength_nm**-3.33
    pheomelanin = 2.9e14 * wavelength_nm**-4.75
    return EUMELANIN_FRACTION * eumelanin + (1.0 - EUMELANIN_FRACTION) * pheomelanin


def blood_per_mm(wavelength_nm: float) -> float:
    """Return the absorption of whole blood in 1/mm at the oxygenation of `BLOOD_OXYGENATION`.

    References
    ----------
    S. Prahl, Tabulated molar extinction coefficient for hemoglobin in water, OMLC 1998.

    Examples
    --------
    >>> round(blood_per_mm(540.0), 3)
    27.618
    """
    oxy, deoxy = hemoglobin_extinction(wavelength_nm)
    per_cm_molar = BLOOD_OXYGENATION * float(oxy) + (1.0 - BLOOD_OXYGENATION) * float(deoxy)
    molar = BLOOD_G_PER_L / HEMOGLOBIN_G_PER_MOL
    return log(10.0) * molar * per_cm_molar / 10.0


def baseline_per_mm(wavelength_nm: float) -> float:
    """Return the absorption of bloodless, unpigmented skin in 1/mm.

    References
    ----------
    Donner and Jensen 2006, doi:10.2312/EGWR/EGSR06/409-417.

    Examples
    --------
    >>> round(baseline_per_mm(500.0), 4)
    0.0702
    """
    return 0.0244 + 8.53 * exp(-(wavelength_nm - 154.0) / 66.2)


def epidermis_scattering_per_mm(wavelength_nm: float) -> float:
    """Return the reduced scattering of the epidermis in 1/mm; the dermis has half of it.

    References
    ----------
    Donner et al. 2008, doi:10.1145/1409060.1409093. The Rayleigh constant is 2.2e11 here;
    public codes vary from 2e11 to 2.22e11.

    Examples
    --------
    >>> round(epidermis_scattering_per_mm(700.0), 3)
    4.404
    """
    return 14.74 * wavelength_nm**-0.22 + 2.2e11 * wavelength_nm**-4.0


def skin_layer_stack(wavelength_nm: float, c_m: float, c_hd: float) -> LayerStack:
    """Return the layers of skin at one wavelength.

    Parameters
    ----------
    wavelength_nm
        Wavelength in nm, 380 to 780.
    c_m
        Volume fraction of melanosomes in the epidermis, 0 to 0.5.
    c_hd
        Volume fraction of blood in the dermis, 0 to 0.32; the epidermis has a quarter of it.

    Returns
    -------
    LayerStack
        Epidermis of 0.25 mm on a semi-infinite dermis, index 1.4, g 0.8, under air.

    Raises
    ------
    TransportError
        When a fraction is outside its range.

    Examples
    --------
    >>> stack = skin_layer_stack(500.0, 0.1, 0.04)
    >>> [round(layer.sigma_a_per_mm, 3) for layer in stack.layers]
    [6.029, 0.515]
    """
    for name, value, limit in (("c_m", c_m, MAX_C_M), ("c_hd", c_hd, MAX_C_HD)):
        if not (isfinite(value) and 0.0 <= value <= limit):
            raise TransportError(f"{name}: expected 0 <= {name} <= {limit}, got {value}")
    melanin = melanin_per_mm(wavelength_nm)
    blood = blood_per_mm(wavelength_nm)
    baseline = baseline_per_mm(wavelength_nm)
    c_he = EPIDERMAL_BLOOD_RATIO * c_hd
    epidermis = c_m * melanin + c_he * blood + (1.0 - c_m - c_he) * baseline
    dermis = c_hd * blood + (1.0 - c_hd) * baseline
    sigma_s = epidermis_scattering_per_mm(wavelength_nm) / (1.0 - SKIN_ANISOTROPY)
    return LayerStack(
        (
            Layer(EPIDERMIS_MM, epidermis, sigma_s, SKIN_ANISOTROPY, ETA),
            Layer(inf, dermis, 0.5 * sigma_s, SKIN_ANISOTROPY, ETA),
        )
    )
