"""What a fibre probe sits on: tissues by site, turn of the head and suction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rigsim.skin_layers import ANISOTROPY, ETA
from rigsim.tissue_mc import Layer, LayerStack

FloatArray = NDArray[np.float64]
Kind: TypeAlias = Literal["homogeneous", "layered", "anisotropic"]

LEAST_SIGMA_A_PER_MM: Final = 1e-7
"""Absorption that a medium without any is traced with, 1/mm: else photons wander for ever. A path
of 1 m loses a ten-thousandth."""


class TissueError(ValueError):
    """A tissue is described wrongly or asked for a site that it has not."""


@dataclass(frozen=True, slots=True, eq=False)
class TissueOptics:
    """What light meets under the head."""

    wavelength_nm: tuple[float, ...]
    """Wavelengths of the stacks, nm; empty for a gray tissue, which has one stack."""
    stacks: tuple[LayerStack, ...]
    """Layers at each wavelength, with the least of the absorber that comes and goes."""
    absorber: FloatArray | None
    """Absorption of that absorber in each layer per amount, 1/mm, shape (wavelengths, layers);
    None where none does."""
    amount: float
    """How much of it there is above the least, >= 0."""


class ProbedTissue(Protocol):
    """What the probe's scene wants to know of a tissue."""

    @property
    def kind(self) -> Kind:
        """What its truth is."""

    def optics(self, site: str, angle_deg: float, suction_mbar: float) -> TissueOptics:
        """Return what light meets; equal stacks for equal sites and angles."""


@dataclass(frozen=True, slots=True)
class HomogeneousTissue:
    """A half space of one material, the same at every site, angle and suction."""

    sigma_a_per_mm: float | tuple[float, ...]
    """Absorption coefficient, 1/mm, >= 0; one for each wavelength, or one for all."""
    sigma_s_prime_per_mm: float | tuple[float, ...]
    """Reduced scattering coefficient, 1/mm, >= 0, likewise."""
    g: float = ANISOTROPY
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
        """Return the material; nothing changes it."""
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


def half_space(
    sigma_a_per_mm: float, sigma_s_prime_per_mm: float, g: float, eta: float
) -> LayerStack:
    """Return a half space under air, with `LEAST_SIGMA_A_PER_MM` at least.

    Examples
    --------
    >>> layer = half_space(0.0, 1.5, 0.8, 1.4).layers[0]
    >>> layer.sigma_a_per_mm, round(layer.sigma_s_per_mm, 9)
    (1e-07, 7.5)
    """
    sigma_s = sigma_s_prime_per_mm / (1.0 - g)
    return LayerStack(
        (Layer(math.inf, max(sigma_a_per_mm, LEAST_SIGMA_A_PER_MM), sigma_s, g, eta),)
    )


def parse_subject(text: str, *, seed: int = 0) -> ProbedTissue:
    """Return the tissue that a subject's text names.

    Parameters
    ----------
    text
        "homogeneous:SIGMA_A,SIGMA_S_PRIME" or "homogeneous:SIGMA_A,SIGMA_S_PRIME,G", in 1/mm.
    seed
        Of what differs between subjects.

    Raises
    ------
    TissueError
        The text names nothing known, or a number is out of range.

    Examples
    --------
    >>> parse_subject("homogeneous:0.04,1.5").sigma_s_prime_per_mm
    1.5
    """
    del seed
    name, colon, rest = text.partition(":")
    if name == "homogeneous" and colon:
        try:
            numbers = [float(word) for word in rest.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) in (2, 3):
            sigma_a, scattering, g = (*numbers, ANISOTROPY)[:3]
            return HomogeneousTissue(sigma_a, scattering, g)
    raise TissueError(f"subject: got {text!r}, expected homogeneous:SIGMA_A,SIGMA_S_PRIME[,G]")
