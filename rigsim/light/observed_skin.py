"""Describe the skin of a face for one camera: its colors, and its lateral scattering."""

from dataclasses import dataclass
from weakref import WeakValueDictionary

import numpy as np

from model import spectra
from rigsim.arrays import Float32Array, Float64Array, FloatArray
from rigsim.caching import cached_method
from rigsim.subject import SimulatedSubject
from rigsim.tissue.lateral_kernels import SIGMAS_MM, GaussianSum
from rigsim.tissue.site_thickness import interpolate_thickness
from rigsim.tissue.skin_color import SkinColor, skin_color
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable


@dataclass(frozen=True, eq=False)
class ObservedSkin:
    """A face in a state, for one camera and one light; see `observe_skin`."""

    subject: SimulatedSubject
    state: str
    """State of its blood."""
    camera: str
    """Name of the camera's sensitivity in `model.spectra`."""
    illuminant: str
    """Name of the light's spectrum in `model.spectra`."""

    @property
    def color(self) -> SkinColor:
        """Colors of skin of any pigment, with the epidermis's thickness between the regions."""
        return skin_color(
            self.camera, self.illuminant, self.subject.tissue.with_thickness_ratio(1.0)
        )

    @property
    def blood_volume_fraction(self) -> Float32Array:
        """Blood volume fraction, shape (N, N)."""
        return self.subject.hemoglobin(self.state)

    @cached_method
    def reflectance(self) -> Float32Array:
        """Return the white-balanced reflectance, shape (N, N, 3); callers share it."""
        return self._rgb(self.subject.melanin)

    @cached_method
    def reflectance_without_melanin(self) -> Float32Array:
        """Return `reflectance` of the same skin without melanin; callers share it."""
        return self._rgb(np.zeros_like(self.subject.melanin))

    def _rgb(self, melanin: Float32Array) -> Float32Array:
        blood = self.blood_volume_fraction
        found = interpolate_thickness(
            self.subject.tissue,
            self.subject.thickness_ratio,
            lambda tissue: skin_color(self.camera, self.illuminant, tissue).rgb(melanin, blood),
        )
        return np.asarray(found, np.float32)

    def fractions_of(self, rgb: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return melanin and blood of uniform skin of given colors, each with its own thickness.

        Parameters
        ----------
        rgb
            Reflectance per channel, > 0, shape (N, N, 3); near that of the face.

        Returns
        -------
        melanin, blood : ndarray of float32
            Shape (N, N), see `rigsim.tissue.skin_color.SkinColor.nearest_fractions`.

        Notes
        -----
        Colors are converted to those of the thickness between the regions by the ratio of the
        face's own colors.
        """
        melanin, blood = self.subject.melanin, self.blood_volume_fraction
        even = rgb * (self.color.rgb(melanin, blood) / self.reflectance())
        return self.color.nearest_fractions(even, melanin, blood)

    def spectra(
        self, c_m: Float32Array, c_hd: Float32Array, thickness_ratio: Float32Array
    ) -> FloatArray:
        """Return spectra of this person's skin at `rigsim.tissue.skin_table.WAVELENGTH_NM`.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions of melanosomes and of blood, shape (n,).
        thickness_ratio
            Thickness of the epidermis over that between the regions, shape (n,).

        Returns
        -------
        ndarray
            Diffuse reflectance, shape (n, wavelengths).
        """
        return interpolate_thickness(
            self.subject.tissue,
            thickness_ratio,
            lambda tissue: SkinTable.load(tissue).spectra(c_m, c_hd),
        )

    def covered_chromophores(self) -> tuple[Float32Array, Float32Array]:
        """Return melanin and hemoglobin where the texture covers skin, shape (n,) each."""
        covered = self.subject.atlas.covered
        return self.subject.melanin[covered], self.blood_volume_fraction[covered]

    def band_weights(self, step: int = 1) -> Float64Array:
        """Return each channel's weights at every ``step``-th wavelength of the skin's table."""
        return spectra.band_weights(self.camera, self.illuminant, WAVELENGTH_NM[::step])

    @property
    def table(self) -> SkinTable:
        """Spectra of this person's skin of any pigment, of the thickness between the regions."""
        return SkinTable.load(self.subject.tissue.with_thickness_ratio(1.0))

    @cached_method
    def lateral_kernels(self) -> GaussianSum:
        """Return the lateral profile at the median melanin and hemoglobin, per channel."""
        melanin, blood = (float(np.median(part)) for part in self.covered_chromophores())
        return self.table.lateral_kernels(melanin, blood, self.band_weights()).gaussians(SIGMAS_MM)


_observed: WeakValueDictionary[tuple[object, ...], ObservedSkin] = WeakValueDictionary()


def observe_skin(
    subject: SimulatedSubject, state: str, camera: str, illuminant: str
) -> ObservedSkin:
    """Return a face for one camera and light; the same as long as any caller holds it.

    Parameters
    ----------
    subject, state, camera, illuminant
        Fields of `ObservedSkin`.
    """
    key = id(subject), state, camera, illuminant  # the id stays unique while the skin holds it
    found = _observed.get(key)
    if found is None:
        found = _observed[key] = ObservedSkin(subject, state, camera, illuminant)
    return found
