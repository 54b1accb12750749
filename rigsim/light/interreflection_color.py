"""The color of light that went from skin to skin: reflected twice or more, so redder than once.

A camera's channel is a sum over wavelengths. What is reflected once may be summed before, as its
channel's mean reflectance; a product of two reflectances may not: in skin's red channel, which
blood and melanin make uneven, the mean of the square is larger than the square of the mean.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light.interreflection import DEFAULT_LAST_BOUNCE, Interreflection
from rigsim.light.seen_skin import SeenSkin
from rigsim.tissue.skin_table import SkinTable

WAVELENGTH_STEPS: Final = (5, 3, 2)
"""Every how many of the table's wavelengths may be summed at, the most first: the ends stay."""

MIN_REFLECTANCE: Final = 1e-6
"""Reflectance and cover below which a patch has no color."""


@dataclass(frozen=True, slots=True, eq=False)
class Bounces:
    """How light goes from skin to skin."""

    exchange: Interreflection
    """From patch to patch."""
    spectral: bool = True
    """Whether wavelengths are told apart; without, each channel is taken as one."""
    step: int = 1
    """Every how many of the table's wavelengths are summed at, 1 or one of `WAVELENGTH_STEPS`."""
    enough: float = DEFAULT_LAST_BOUNCE
    """Share of the first bounce below which further ones are left out."""


class InterreflectionColor:
    """How light goes from skin to skin on one face in one state, seen by one camera.

    Parameters
    ----------
    bounces
        How light goes from patch to patch.
    skin
        The face.
    r_d
        Factor of the diffuse term per channel with what covers the skin, shape (N, N, 3).
    reflectance
        White-balanced reflectance of the skin per channel, shape (N, N, 3).
    """

    def __init__(
        self, bounces: Bounces, skin: SeenSkin, r_d: Float32Array, reflectance: Float32Array
    ) -> None:
        self._bounce, self._enough = bounces.exchange, bounces.enough
        subject = skin.subject
        covered = subject.atlas.covered.astype(np.float32)
        factor = r_d / np.maximum(reflectance, np.float32(MIN_REFLECTANCE))
        layers = np.dstack([covered, subject.melanin, skin.blood, factor, r_d])
        coarse = self._bounce.coarsen(np.asarray(layers * covered[..., None], np.float32))
        coarse[:, 1:] /= np.maximum(coarse[:, :1], np.float32(MIN_REFLECTANCE))
        self._r_d = np.ascontiguousarray(coarse[:, 6:])
        self._weights: Float32Array | None = None
        if bounces.spectral:
            weights = skin.band_weights(bounces.step)
            spectra = SkinTable.load().spectra(coarse[:, 1], coarse[:, 2])[:, :: bounces.step]
            cover = coarse[:, 3:6].mean(axis=1, keepdims=True)
            self._spectrum = np.asarray(spectra * cover, np.float32)
            self._channel = np.maximum(self._spectrum @ weights, MIN_REFLECTANCE).astype(np.float32)
            self._weights = np.asarray(weights, np.float32)

    def entering(self, direct: Float32Array) -> Float32Array:
        """Return the light that enters by way of other skin.

        Parameters
        ----------
        direct
            Light that enters each patch directly, shape (P,).

        Returns
        -------
        ndarray of float32
            As the coarse texture, shape (n, n, 3), same unit: multiplied by the patch's reflectance
            in a channel it gives what leaves in that channel.
        """
        if self._weights is None:
            return self._bounce.indirect(direct, self._r_d, enough=self._enough)
        each = self._bounce.indirect(direct, self._spectrum, enough=self._enough)
        covered = self._bounce.atlas.covered
        out = np.zeros((*covered.shape, self._weights.shape[1]), np.float32)
        out[covered] = ((each[covered] * self._spectrum) @ self._weights) / self._channel
        return out

    def on_texture(self, direct: Float32Array, size: int) -> Float32Array:
        """Return `entering` on a texture of so many texels a side, shape (size, size, 3)."""
        coarse = self.entering(direct)
        filled = dilate_texture(coarse, self._bounce.atlas.covered, steps=2)
        middle = (np.arange(size, dtype=np.float32) + np.float32(0.5)) / np.float32(size)
        u, v = np.meshgrid(middle, middle[::-1])
        uv = np.ascontiguousarray(np.stack([u, v], axis=-1))
        return sample(filled, uv, np.ones((size, size), np.bool_))


def color_error(skin: SeenSkin) -> Float64Array:
    """Return by how much each channel's mean of R^2 is off the square of its mean, shape (3,).

    Of typical skin.
    """
    weights = skin.band_weights()
    typical = SkinTable.load().spectra(*(np.median(part) for part in skin.covered()))
    return np.asarray(np.abs((typical**2 @ weights) / (typical @ weights) ** 2 - 1.0), np.float64)


def step_error(skin: SeenSkin, step: int) -> Float64Array:
    """Return by how much each channel of light from skin to skin is off at fewer wavelengths.

    Parameters
    ----------
    skin
        The face.
    step
        Every how many of the table's wavelengths are summed at.

    Returns
    -------
    ndarray
        Relative, shape (3,): the most for light that goes between any two of the face's extremes
        and middles of melanin and blood, by its mean of products over its mean.
    """
    ends = [[part.min(), np.median(part), part.max()] for part in skin.covered()]
    melanin, blood = (axis.ravel() for axis in np.meshgrid(*ends))
    spectra = SkinTable.load().spectra(melanin, blood)

    def bounced(every: int) -> Float64Array:
        some, weights = spectra[:, ::every], skin.band_weights(every)
        twice = np.einsum("al,bl,lc->abc", some, some, weights)
        return np.asarray(twice / (some @ weights)[None], np.float64)

    return np.asarray(np.abs(bounced(step) / bounced(1) - 1.0).max(axis=(0, 1)), np.float64)
