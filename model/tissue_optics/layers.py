"""Compute absorption, scattering and reflectance of layered skin from its chromophores."""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model import spectra
from model.arrays import Float64Array
from model.checks import Checks
from model.fresnel import ETA_SKIN
from model.tissue_optics import adding_doubling, discrete_ordinates, layered_diffusion
from model.tissue_optics.constants import (
    PAPER_CONSTANTS,
    SKIN_CONSTANTS,
    TissueConstants,
    TissueError,
    with_fractions,
)

Tier = Literal["adding_doubling", "diffusion"]

# Jimenez et al. 2010, doi:10.1145/1866158.1866167: Table 1.
C_M_MAX = 0.5  # volume fraction of melanosomes in the epidermis
C_HD_MAX = 0.32  # volume fraction of blood in the dermis

ANISOTROPY_SKIN = 0.8
"""Mean cosine g of scattering in skin: van Gemert et al. 1989, doi:10.1109/10.42108.

The papers' skin model has reduced scattering only, that is g = 0, and this is the default
below. Where absorption is weak it makes little difference. Dark skin scatters only a few times
before it absorbs: with g = 0.8 and the same sigma_s' it reflects less, half at C_m = 0.5.
"""

TIER_NAMES: tuple[Tier, ...] = ("adding_doubling", "diffusion")


_check = Checks(TissueError).within


def blood_absorption(
    wavelength_nm: ArrayLike, *, oxygenation: float = SKIN_CONSTANTS.oxygenation
) -> Float64Array:
    """Return the absorption of whole blood with 150 g/l of hemoglobin.

    Parameters
    ----------
    wavelength_nm
        Wavelengths in nm, any shape, 380 to 780.
    oxygenation
        Fraction of oxygenated hemoglobin in [0, 1].

    Returns
    -------
    ndarray
        Napierian absorption in 1/mm, shaped like the input.

    Examples
    --------
    >>> round(float(blood_absorption(540.0)), 3)
    27.618
    """
    _check("oxygenation", oxygenation, "[0, 1]")
    oxy, deoxy = spectra.hemoglobin_extinction(wavelength_nm)
    molar = spectra.HEMOGLOBIN_IN_BLOOD_G_PER_L / spectra.HEMOGLOBIN_MOLAR_MASS_G_PER_MOL
    per_cm = np.log(10.0) * molar * (oxygenation * oxy + (1.0 - oxygenation) * deoxy)
    return np.asarray(per_cm / 10.0)


def skin_layers(
    wavelength_nm: ArrayLike,
    c_m: ArrayLike,
    c_hd: ArrayLike,
    *,
    constants: TissueConstants = PAPER_CONSTANTS,
    beta_m: float | None = None,
    c_he: ArrayLike | None = None,
    oxygenation: float | None = None,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the optical properties of epidermis and dermis.

    Parameters
    ----------
    wavelength_nm
        Wavelengths in nm, shape (n,) or scalar, 380 to 780.
    c_m, c_hd
        Volume fractions of melanin (epidermis) and blood (dermis), broadcast together.
    constants
        Thickness, oxygenation, scattering and pigment; `PAPER_CONSTANTS` by default;
        `SKIN_CONSTANTS` agree with measured skin.
    beta_m, oxygenation
        Fractions of eumelanin and of oxygenated hemoglobin, in [0, 1]; None: the constants'.
    c_he
        Volume fraction of blood in the epidermis; None: by the constants' ratio to c_hd.

    Returns
    -------
    tuple of ndarray
        sigma_a and sigma_s' in 1/mm and the thickness in mm, each of shape
        (*fractions, *wavelength, 2): epidermis, dermis.

    Raises
    ------
    TissueError
        When a fraction is negative, not finite, or fractions of one layer exceed 1 together.

    References
    ----------
    Donner et al. 2008, doi:10.1145/1409060.1409093.
    """
    melanin, dermal = np.asarray(c_m, dtype=np.float64), np.asarray(c_hd, dtype=np.float64)
    constants = with_fractions(constants, beta_m, oxygenation)
    for name, share in (("c_m", melanin), ("c_hd", dermal)):
        _check(name, share, "[0, 1]")
    ratio = constants.epidermal_blood_ratio
    epidermal = ratio * dermal if c_he is None else np.asarray(c_he, dtype=np.float64)
    _check("c_he", epidermal, "[0, 1]")
    melanin, dermal, epidermal = np.broadcast_arrays(melanin, dermal, epidermal)
    _check("c_m + c_he", melanin + epidermal, "[0, 1]")
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    spread = melanin.shape + (1,) * wavelength.ndim
    melanin, dermal, epidermal = (x.reshape(spread) for x in (melanin, dermal, epidermal))
    blood = blood_absorption(wavelength, oxygenation=constants.oxygenation)
    baseline = constants.baseline_factor * spectra.baseline_absorption(wavelength)
    pigment = constants.melanin_absorption(wavelength)
    sigma_a_epidermis = (
        melanin * pigment + epidermal * blood + (1.0 - melanin - epidermal) * baseline
    )
    sigma_a_dermis = dermal * blood + (1.0 - dermal) * baseline
    sigma_a = np.stack(np.broadcast_arrays(sigma_a_epidermis, sigma_a_dermis), axis=-1)
    scattering = constants.epidermal_scattering(wavelength)
    sigma_s = np.stack([scattering, constants.dermis_scattering * scattering], axis=-1)
    thickness = np.array([constants.epidermis_mm, np.inf])
    return (
        sigma_a,
        np.broadcast_to(sigma_s, sigma_a.shape),
        np.broadcast_to(thickness, sigma_a.shape),
    )


def two_layer_reflectance(
    wavelength_nm: ArrayLike,
    c_m: ArrayLike,
    c_hd: ArrayLike,
    *,
    constants: TissueConstants = PAPER_CONSTANTS,
    beta_m: float | None = None,
    c_he: ArrayLike | None = None,
    oxygenation: float | None = None,
    eta: float = ETA_SKIN,
    tier: Tier = "adding_doubling",
    anisotropy: float = 0.0,
    directions: int | None = None,
) -> Float64Array:
    """Return the diffuse reflectance of skin: an epidermis on a deep dermis.

    Parameters
    ----------
    wavelength_nm
        Wavelengths in nm, shape (n,) or scalar, 380 to 780.
    c_m, c_hd
        Volume fractions of melanin (epidermis) and blood (dermis), broadcast together; Jimenez
        2010, Table 1 has 0 to 0.5 and 0 to 0.32.
    constants
        Thickness, oxygenation, scattering and pigment; `PAPER_CONSTANTS` by default;
        `SKIN_CONSTANTS` agree with measured skin.
    beta_m, oxygenation
        Fractions of eumelanin and of oxygenated hemoglobin, in [0, 1]; None: the constants'.
    c_he
        Volume fraction of blood in the epidermis; None: by the constants' ratio to c_hd.
    eta
        Refractive index of skin relative to air.
    tier
        "adding_doubling" (exact transport) or "diffusion" (closed form, about a thousand times
        faster, off by -2 to +21 percent of transport with g = 0 over Table 1).
    anisotropy, directions
        As in `layer_stack_reflectance`; skin has `ANISOTROPY_SKIN`.

    Returns
    -------
    ndarray
        Shape (*fractions, *wavelength): diffuse reflectance for light at normal incidence without
        the specular part, in [0, 1).

    Raises
    ------
    TissueError
        As `skin_layers`, or for an unknown tier.

    References
    ----------
    Jimenez et al. 2010, doi:10.1145/1866158.1866167; Donner et al. 2008,
    doi:10.1145/1409060.1409093.

    Examples
    --------
    >>> r = two_layer_reflectance([450.0, 550.0, 650.0], 0.02, 0.02)
    >>> r.round(2).tolist()
    [0.17, 0.2, 0.34]
    """
    sigma_a, sigma_s_prime, thickness = skin_layers(
        wavelength_nm,
        c_m,
        c_hd,
        constants=with_fractions(constants, beta_m, oxygenation),
        c_he=c_he,
    )
    return layer_stack_reflectance(
        sigma_a,
        sigma_s_prime,
        thickness,
        eta=eta,
        tier=tier,
        anisotropy=anisotropy,
        directions=directions,
    )


def layer_stack_reflectance(
    sigma_a_per_mm: ArrayLike,
    sigma_s_prime_per_mm: ArrayLike,
    thickness_mm: ArrayLike,
    *,
    eta: float = ETA_SKIN,
    tier: Tier = "adding_doubling",
    anisotropy: float | tuple[float, ...] = 0.0,
    directions: int | None = None,
) -> Float64Array:
    """Return the diffuse reflectance of plane layers at normal incidence.

    Parameters
    ----------
    sigma_a_per_mm, sigma_s_prime_per_mm, thickness_mm
        Absorption and reduced scattering in 1/mm and thickness in mm, at least 0, broadcast
        together; layers on the last axis, top first. The last thickness may be infinite; under a
        finite stack is air.
    eta
        Refractive index of all layers relative to air, at least 1.
    tier
        "adding_doubling" (exact transport) or "diffusion" (closed form).
    anisotropy
        Mean cosine g of the Henyey-Greenstein phase function, 0 to 0.999, one for all layers or one
        a layer; the scattering is sigma_s'/(1 - g). At 0 it is isotropic. Diffusion ignores it.
    directions
        Directions of adding-doubling in half a sphere, even. None: as many as keep the relative
        error below 1e-4, rising with g from 12 to 38 at the index of skin, see
        `discrete_ordinates.default_directions`; g is at most 0.99 then.

    Returns
    -------
    ndarray
        Shape (...): power leaving through the top as a fraction of the incident, without the
        reflection of the beam at the first surface; in [0, 1]. Adding-doubling includes the beam's
        reflection at the back surface of a finite stack, scattered or not, which
        `rigsim.tissue.tissue_mc` counts as specular.

    Raises
    ------
    TissueError
        When a property is negative or not a number, an infinite layer is not the last one, the
        tier is unknown, or g is above 0.99 without `directions`.

    Examples
    --------
    >>> round(float(layer_stack_reflectance([0.17], [0.88], [np.inf], eta=1.3)), 3)
    0.21
    """
    Checks(TissueError).choice("tier", tier, TIER_NAMES)
    sigma_a, sigma_s, thickness = Checks(TissueError).broadcast_together(
        sigma_a_per_mm=sigma_a_per_mm,
        sigma_s_prime_per_mm=sigma_s_prime_per_mm,
        thickness_mm=thickness_mm,
    )
    Checks(TissueError).shape("layers", sigma_a, ("...", "layers"))
    _check("sigma_a_per_mm", sigma_a, "[0, inf)")
    _check("sigma_s_prime_per_mm", sigma_s, "[0, inf)")
    _check("thickness_mm", thickness, "[0, inf]")
    if np.isinf(thickness[..., :-1]).any():
        raise TissueError("thickness_mm: only the last layer may be infinite")
    g = np.asarray(anisotropy, dtype=np.float64)
    _check("anisotropy", g, f"[0, {discrete_ordinates.MAX_ANISOTROPY}]")
    if tier == "diffusion":
        return layered_diffusion.reflectance(sigma_a, sigma_s, thickness, eta=eta)
    layers = sigma_a.shape[-1]
    widest = float(g.max(initial=0.0))
    try:
        count = discrete_ordinates.choose_directions(eta, widest, directions)
    except ValueError as error:
        raise TissueError(str(error)) from error
    result = adding_doubling.reflectance(
        sigma_a.reshape(-1, layers),
        sigma_s.reshape(-1, layers),
        thickness.reshape(-1, layers),
        eta=eta,
        anisotropy=anisotropy,
        directions=count,
    )
    return result.reshape(sigma_a.shape[:-1])
