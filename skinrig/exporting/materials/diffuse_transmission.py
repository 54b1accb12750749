"""Convert R_d and 1/sigma_tr to glTF's diffuse transmission, and back.

glTF has no subsurface scattering. Its diffuse transmission sends a part of the light that enters
the surface through the body, whose volume attenuates it:

    T(d) = factor color attenuationColor^(d / attenuationDistance)

at thickness d. A thick slab of a scattering medium transmits A exp(-sigma_tr d) by diffusion
theory, so that attenuationColor is exp(-sigma_tr attenuationDistance) and factor times color is A,
with a source at the depth of one transport length and extrapolated boundaries:

    A = alpha' (1 + exp(-2 s b)) exp(-s b) sinh(s (1 + b)),  s = sigma_tr / sigma_t',  b = 2 A_n / 3

References
----------
KHR_materials_diffuse_transmission and KHR_materials_volume of glTF 2.0; Contini, Martelli and
Zaccanti 1997, doi:10.1364/AO.36.004587 (slab, extrapolated boundaries).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel
from skinrig.arrays import Float64Array

TRANSMISSION_EXTENSIONS = ("KHR_materials_diffuse_transmission", "KHR_materials_volume")
MIN_DEFICIT, MAX_DEFICIT = 1e-9, 0.999
MM_PER_M = 1e3


@dataclass(frozen=True, slots=True)
class DiffuseTransmission:
    """Transmission of glTF, lengths in meters.

    Attributes
    ----------
    factor
        Part of the light below the surface that is transmitted, 0 to 1; the rest is reflected by
        the base color.
    color
        (3,), of the transmitted light, 0 to 1.
    attenuation_distance_m
        Distance after which white light has the attenuation color.
    attenuation_color
        (3,), 0 to 1.
    thickness_m
        Of the body, for programs that do not trace rays through it.
    """

    factor: float
    color: Float64Array
    attenuation_distance_m: float
    attenuation_color: Float64Array
    thickness_m: float

    @classmethod
    def of(
        cls,
        translucency_mm: ArrayLike,
        deficit: ArrayLike,
        *,
        eta: float,
        max_factor: float,
        thickness_m: float,
    ) -> DiffuseTransmission:
        """Return the transmission of a medium.

        Parameters
        ----------
        translucency_mm
            (3,), 1/sigma_tr, mm.
        deficit
            (3,), 1 - alpha', clipped to 1e-9 to 0.999.
        eta
            Refractive index.
        max_factor
            Largest factor; light beyond it is lost.
        thickness_m
            See the attribute.
        """
        depth_m = np.asarray(translucency_mm, np.float64) / MM_PER_M
        wanted = amplitude(deficit, eta)
        factor = float(min(wanted.max(), max_factor))
        color = np.clip(wanted / max(factor, 1e-9), 0.0, 1.0)
        distance_m = float(depth_m.mean())
        return cls(factor, color, distance_m, np.exp(-distance_m / depth_m), thickness_m)

    @property
    def translucency_mm(self) -> Float64Array:
        """Return 1/sigma_tr of the medium, (3,), mm: the inverse of `of`."""
        return -MM_PER_M * self.attenuation_distance_m / np.log(self.attenuation_color)

    def transmit(self, thickness_mm: ArrayLike) -> Float64Array:
        """Return the transmitted part of light below the surface, (..., 3), by thickness (...)."""
        depths = np.asarray(thickness_mm, np.float64)[..., None] / self.translucency_mm
        return np.asarray(self.factor * self.color * np.exp(-depths))

    def extensions(self) -> dict[str, Any]:
        """Return the extensions of a glTF material as JSON values."""
        return {
            "KHR_materials_diffuse_transmission": {
                "diffuseTransmissionFactor": self.factor,
                "diffuseTransmissionColorFactor": self.color.tolist(),
            },
            "KHR_materials_volume": {
                "thicknessFactor": self.thickness_m,
                "attenuationDistance": self.attenuation_distance_m,
                "attenuationColor": self.attenuation_color.tolist(),
            },
        }


def amplitude(deficit: ArrayLike, eta: float) -> Float64Array:
    """Return the transmittance of a thick slab times exp(sigma_tr d), by diffusion theory.

    Parameters
    ----------
    deficit
        1 - alpha', clipped to 1e-9 to 0.999, any shape.
    eta
        Refractive index.

    Examples
    --------
    >>> amplitude([0.01, 0.1, 0.5], 1.4).round(3).tolist()
    [0.577, 0.824, 0.855]
    """
    lost = np.clip(np.asarray(deficit, np.float64), MIN_DEFICIT, MAX_DEFICIT)
    s = np.sqrt(3.0 * lost)  # sigma_tr in units of sigma_t'
    boundary = 2.0 * fresnel.boundary_factor(eta) / 3.0
    inner = s * boundary
    found = (1.0 - lost) * (1.0 + np.exp(-2.0 * inner)) * np.exp(-inner) * np.sinh(s + inner)
    return np.asarray(found, np.float64)
