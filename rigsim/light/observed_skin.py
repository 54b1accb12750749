"""Describe the skin of a face for one camera: its colors, and its lateral scattering."""

from dataclasses import dataclass

import numpy as np

from model import spectra
from rigsim.arrays import Float32Array, Float64Array
from rigsim.subject import SimulatedSubject
from rigsim.tissue.lateral_kernels import SIGMAS_MM, GaussianSum
from rigsim.tissue.skin_color import SkinColor, skin_color
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable


@dataclass(frozen=True, slots=True, eq=False)
class ObservedSkin:
    """A face in a state, for one camera and one light."""

    subject: SimulatedSubject
    state: str
    """State of its blood."""
    camera: str
    """Name of the camera's sensitivity in `model.spectra`."""
    illuminant: str
    """Name of the light's spectrum in `model.spectra`."""

    @property
    def color(self) -> SkinColor:
        """Colors of skin of any pigment in the camera's channels."""
        return skin_color(self.camera, self.illuminant, self.subject.tissue)

    @property
    def blood_volume_fraction(self) -> Float32Array:
        """Blood volume fraction, shape (N, N)."""
        return self.subject.hemoglobin(self.state)

    def reflectance(self) -> Float32Array:
        """Return the white-balanced reflectance, shape (N, N, 3)."""
        return self.color.rgb(self.subject.melanin, self.blood_volume_fraction)

    def reflectance_without_melanin(self) -> Float32Array:
        """Return the reflectance of the same skin without melanin, shape (N, N, 3)."""
        return self.color.rgb(np.zeros_like(self.subject.melanin), self.blood_volume_fraction)

    def covered_chromophores(self) -> tuple[Float32Array, Float32Array]:
        """Return melanin and hemoglobin where the texture covers skin, shape (n,) each."""
        covered = self.subject.atlas.covered
        return self.subject.melanin[covered], self.blood_volume_fraction[covered]

    def band_weights(self, step: int = 1) -> Float64Array:
        """Return each channel's weights at every ``step``-th wavelength of the skin's table."""
        return spectra.band_weights(self.camera, self.illuminant, WAVELENGTH_NM[::step])

    @property
    def table(self) -> SkinTable:
        """Spectra of this person's skin of any pigment."""
        return SkinTable.load(self.subject.tissue)

    def lateral_kernels(self) -> GaussianSum:
        """Return the lateral profile at the median melanin and hemoglobin, per channel."""
        melanin, blood = (float(np.median(part)) for part in self.covered_chromophores())
        return self.table.lateral_kernels(melanin, blood, self.band_weights()).gaussians(SIGMAS_MM)
