"""Tissues under a fiber probe, by site, rotation of the head and suction."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, TypeAlias

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.subject.person_skin import PersonSkin, PersonSkinError, SiteSkin
from rigsim.subject.pigment import MELANIN_PRESETS
from rigsim.subject.tissue_pressure import INCOMPRESSIBLE_BLOOD_FRACTION, blood_ratio
from rigsim.tissue.skin_layers import (
    ETA,
    SKIN_ANISOTROPY,
    baseline_per_mm,
    blood_per_mm,
    skin_layer_stack,
)
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError

if TYPE_CHECKING:
    from rigsim.fiber.anisotropic_tissue import AnisotropicTissue

Kind: TypeAlias = Literal["homogeneous", "layered", "anisotropic"]

MIN_SIGMA_A_PER_MM: Final = 1e-7
"""Smallest traced absorption, 1/mm: without absorption photons never end. A path of 1 m loses a
ten-thousandth."""

CONTACT_PRESSURE_MBAR: Final = 3.0
"""Pressure under a head without suction, mbar."""

SKIN_WAVELENGTHS_NM: Final = (440.0, 465.0, 490.0, 515.0, 540.0, 560.0, 580.0, 600.0, 620.0, 650.0)
"""Wavelengths that skin is traced at, nm; between them reflectance is linear."""
PHANTOM_WAVELENGTHS_NM: Final = tuple(float(nm) for nm in range(400, 701, 20))
"""Wavelengths of the phantom, nm."""
PHANTOM_DEVIATIONS: Final = (0.8, -0.7)
"""Deviations of the phantom from its certificate, in standard uncertainties: sigma_a, sigma_s'."""


class TissueError(ValueError):
    """Error for invalid parameters of a tissue, or an unknown site."""


@dataclass(frozen=True, slots=True, eq=False)
class TissueOptics:
    """Optical properties under the head."""

    wavelength_nm: tuple[float, ...]
    """Wavelengths of the stacks, nm; empty for a gray tissue, which has one stack."""
    stacks: tuple[LayerStack, ...]
    """Layers at each wavelength, with the smallest amount of the variable absorber."""
    absorber: Float64Array | None
    """Absorption of that absorber in each layer per amount, 1/mm, shape (wavelengths, layers);
    None where none does."""
    amount: float
    """Amount of the absorber above the smallest, >= 0."""


class ProbedTissue(Protocol):
    """Interface of a tissue for the probe's scene."""

    @property
    def kind(self) -> Kind:
        """Return the kind of its ground truth."""

    def optics(self, site: str, angle_deg: float, suction_mbar: float) -> TissueOptics:
        """Return the optical properties; equal stacks for equal sites and angles."""


@dataclass(frozen=True, slots=True)
class HomogeneousTissue:
    """A half space of one material, the same at every site, angle and suction."""

    sigma_a_per_mm: float | tuple[float, ...]
    """Absorption coefficient, 1/mm, >= 0; one for each wavelength, or one for all."""
    sigma_s_prime_per_mm: float | tuple[float, ...]
    """Reduced scattering coefficient, 1/mm, >= 0, likewise."""
    g: float = SKIN_ANISOTROPY
    """Mean cosine of the Henyey-Greenstein phase function, -1 < g < 1."""
    eta: float = ETA
    """Refractive index, 1 to 3."""
    wavelength_nm: tuple[float, ...] = ()
    """Wavelengths, increasing, nm; empty: gray."""

    def __post_init__(self) -> None:
        wanted = max(len(self.wavelength_nm), 1)
        for name, low, high in (
            ("sigma_a_per_mm", 0.0, 1e4),
            ("sigma_s_prime_per_mm", 0.0, 1e4),
            ("g", -0.9999, 0.9999),
            ("eta", 1.0, 3.0),
        ):
            values = np.atleast_1d(getattr(self, name))
            if not ((values >= low) & (values <= high)).all():
                raise TissueError(
                    f"{name}: got {getattr(self, name)}, expected {low:g} to {high:g}"
                )
            if len(values) not in (1, wanted):
                raise TissueError(f"{name}: got {len(values)} numbers, expected 1 or {wanted}")

    @property
    def kind(self) -> Kind:
        """Return "homogeneous"."""
        return "homogeneous"

    def optics(self, site: str, angle_deg: float, suction_mbar: float) -> TissueOptics:
        """Return the material, which is the same everywhere."""
        del site, angle_deg, suction_mbar
        sigma_a, scattering = np.broadcast_arrays(
            np.atleast_1d(self.sigma_a_per_mm), np.atleast_1d(self.sigma_s_prime_per_mm)
        )
        count = max(len(self.wavelength_nm), 1)
        stacks = tuple(
            half_space(float(a), float(s), self.g, self.eta)
            for a, s in zip(np.resize(sigma_a, count), np.resize(scattering, count), strict=True)
        )
        return TissueOptics(self.wavelength_nm, stacks, None, 0.0)


@dataclass(frozen=True, slots=True)
class FibrousTissue:
    """A gray half space with aligned fibers, as in abdominal skin; the same at every site."""

    sigma_a_per_mm: float
    """Absorption coefficient, 1/mm, > 0."""
    sigma_s_prime_per_mm: float
    """Reduced scattering coefficient for strength 0, 1/mm, > 0."""
    strength: float = -1.0
    """See `rigsim.fiber.anisotropic_tissue.AnisotropicTissue`; below 0 light goes farther along."""
    axis_deg: float = 0.0
    """Direction of the fibers: the head's angle at which its line lies along them, degrees."""

    def __post_init__(self) -> None:
        try:
            self.medium()
        except TransportError as error:
            raise TissueError(str(error)) from error

    @property
    def kind(self) -> Kind:
        """Return "anisotropic"."""
        return "anisotropic"

    def medium(self) -> "AnisotropicTissue":
        """Return the anisotropic medium for the photon walk."""
        # its kernels load on import, and faces need none
        from rigsim.fiber.anisotropic_tissue import AnisotropicTissue

        return AnisotropicTissue(
            self.sigma_a_per_mm,
            self.sigma_s_prime_per_mm / (1.0 - SKIN_ANISOTROPY),
            SKIN_ANISOTROPY,
            ETA,
            self.strength,
            math.radians(self.axis_deg),
        )

    def optics(self, site: str, angle_deg: float, suction_mbar: float) -> TissueOptics:
        """Return the material without its direction; see `medium` for that."""
        del site, angle_deg, suction_mbar
        stack = half_space(self.sigma_a_per_mm, self.sigma_s_prime_per_mm, SKIN_ANISOTROPY, ETA)
        return TissueOptics((), (stack,), None, 0.0)


def half_space(
    sigma_a_per_mm: float, sigma_s_prime_per_mm: float, g: float, eta: float
) -> LayerStack:
    """Return a half space under air, with `MIN_SIGMA_A_PER_MM` at least.

    Examples
    --------
    >>> layer = half_space(0.0, 1.5, 0.8, 1.4).layers[0]
    >>> layer.sigma_a_per_mm, round(layer.sigma_s_per_mm, 9)
    (1e-07, 7.5)
    """
    sigma_s = sigma_s_prime_per_mm / (1.0 - g)
    return LayerStack((Layer(math.inf, max(sigma_a_per_mm, MIN_SIGMA_A_PER_MM), sigma_s, g, eta),))


class SkinTissue:
    """Skin of a person under the head.

    The layers are those of `rigsim.subject.person_skin`. Pressure under a head displaces part of
    the blood (`rigsim.subject.tissue_pressure.blood_ratio`). The suction is the pressure, for the
    rim's force is the suction times the cup's area and the face's area is about that. A head that
    is only laid on has `CONTACT_PRESSURE_MBAR`.

    Parameters
    ----------
    person
        The person.

    Notes
    -----
    That pressure takes blood out of the skin under a probe is measured (Reif et al. 2008,
    doi:10.1117/1.2870115; Landis 1930, doi:10.1152/ajplegacy.1930.93.2.353, for the pressure in
    capillaries); the law's form is this project's choice.

    Examples
    --------
    >>> skin = SkinTissue(PersonSkin.of_preset("III", seed=1))
    >>> skin.blood("cheek", 60.0) < skin.blood("cheek", 0.0)
    True
    """

    def __init__(self, person: PersonSkin) -> None:
        self.person = person

    @property
    def kind(self) -> Kind:
        """Return "layered"."""
        return "layered"

    def melanin(self, site: str) -> float:
        """Return the volume fraction of melanosomes in the epidermis."""
        return self._at(site).c_m

    def epidermis_mm(self, site: str) -> float:
        """Return the epidermis's thickness, mm."""
        return self._at(site).tissue.epidermis_mm

    def blood(self, site: str, suction_mbar: float) -> float:
        """Return the volume fraction of blood in the dermis under the head."""
        pressure = max(suction_mbar, CONTACT_PRESSURE_MBAR)
        return float(blood_ratio(pressure)) * self._at(site).c_hd

    def optics(self, site: str, angle_deg: float, suction_mbar: float) -> TissueOptics:
        """Return the layers; the blood above what no pressure takes out is the absorber."""
        del angle_deg
        skin = self._at(site)
        least = INCOMPRESSIBLE_BLOOD_FRACTION * skin.c_hd
        stacks = tuple(
            skin_layer_stack(nm, skin.c_m, least, skin.tissue) for nm in SKIN_WAVELENGTHS_NM
        )
        # Blood replaces bloodless tissue.
        dermis = blood_per_mm(
            SKIN_WAVELENGTHS_NM, skin.tissue.oxygenation
        ) - skin.tissue.baseline_amplitude * baseline_per_mm(SKIN_WAVELENGTHS_NM)
        ratios = [skin.tissue.epidermal_blood_ratio] * (len(stacks[0].layers) - 1) + [1.0]
        amount = self.blood(site, suction_mbar) - least
        return TissueOptics(SKIN_WAVELENGTHS_NM, stacks, np.outer(dermis, ratios), amount)

    def _at(self, site: str) -> SiteSkin:
        try:
            return self.person.at(site)
        except PersonSkinError as error:
            raise TissueError(str(error)) from error


def phantom_certificate() -> Mapping[str, Any]:
    """Return the certificate of `PHANTOM_BLOCK`, package data of schema ``skinrig.phantom/1``."""
    path = resources.files("rigsim").joinpath("data", "phantom.json")
    loaded: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return loaded


def make_phantom(
    certificate: Mapping[str, Any], *, deviations: tuple[float, float] = PHANTOM_DEVIATIONS
) -> HomogeneousTissue:
    """Return a block with given deviations from its certificate.

    Parameters
    ----------
    certificate
        Of schema ``skinrig.phantom/1``.
    deviations
        Deviations of sigma_a and sigma_s', in their standard uncertainties.

    Returns
    -------
    HomogeneousTissue
        Spectral; between the certificate's wavelengths both coefficients follow a power.

    Examples
    --------
    >>> paper = phantom_certificate()
    >>> block = make_phantom(paper)
    >>> block.g == paper["g"], block.eta == paper["eta"]
    (True, True)
    """
    x, known = np.log(PHANTOM_WAVELENGTHS_NM), np.log(certificate["wavelength_nm"])
    factor = [
        1.0 + count * certificate["uncertainty"][name]
        for count, name in zip(deviations, ("sigma_a", "sigma_s_prime"), strict=True)
    ]
    sigma_a, scattering = (
        np.exp(np.interp(x, known, np.log(certificate[name]))) * share
        for name, share in zip(("sigma_a_per_mm", "sigma_s_prime_per_mm"), factor, strict=True)
    )
    return HomogeneousTissue(
        tuple(sigma_a.tolist()),
        tuple(scattering.tolist()),
        certificate["g"],
        certificate["eta"],
        PHANTOM_WAVELENGTHS_NM,
    )


def parse_tissue(text: str, *, seed: int = 0) -> ProbedTissue:
    """Return the tissue of a subject's text.

    Parameters
    ----------
    text
        A preset of melanin, "I" to "VI", "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]" or
        "anisotropic:SIGMA_A,SIGMA_S_PRIME[,STRENGTH[,AXIS_DEG]]", in 1/mm.
    seed
        Of what differs between subjects.

    Raises
    ------
    TissueError
        The text names nothing known, or a number is out of range.

    Examples
    --------
    >>> parse_tissue("homogeneous:0.04,1.5").sigma_s_prime_per_mm
    1.5
    >>> parse_tissue("III", seed=2).kind
    'layered'
    """
    name, colon, rest = text.partition(":")
    if not colon and name in MELANIN_PRESETS:
        return SkinTissue(PersonSkin.of_preset(name, seed=seed))
    try:
        numbers = [float(word) for word in rest.split(",")]
    except ValueError:
        numbers = []
    if name == "homogeneous" and len(numbers) in (2, 3):
        sigma_a, scattering, g = (*numbers, SKIN_ANISOTROPY)[:3]
        return HomogeneousTissue(sigma_a, scattering, g)
    if name == "anisotropic" and len(numbers) in (2, 3, 4):
        return FibrousTissue(*numbers)
    raise TissueError(
        f"subject: got {text!r}, expected one of {', '.join(MELANIN_PRESETS)}, "
        "homogeneous:SIGMA_A,SIGMA_S_PRIME[,G] or "
        "anisotropic:SIGMA_A,SIGMA_S_PRIME[,STRENGTH[,AXIS_DEG]] in 1/mm"
    )


PHANTOM_BLOCK: Final = make_phantom(phantom_certificate())
"""The actual solid block in sessions of target "phantom"."""
