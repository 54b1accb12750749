"""Sample the interreflection on a face before anything is rendered, by the scene's own exchange."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from rigsim.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from rigsim.light.interreflection import (
    MIN_REFLECTANCE,
    Interreflection,
    InterreflectionColor,
    InterreflectionSettings,
)
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.subsurface_radiance import inner_albedo
from rigsim.needs.effects import PixelNoise
from rigsim.needs.sampled_light import SampledLight


@dataclass(frozen=True, eq=False)
class SampledBounces:
    """Interreflection on a face between patches, in the image where it is largest."""

    skin: ObservedSkin
    """The face."""
    exchange: Interreflection
    """Exchange between its patches."""
    light: SampledLight
    """Direct light."""
    white: Float64Array
    """Signal of a white plate in each image, full scales, shape (K, 3)."""
    noise: PixelNoise
    """Noise of the sensor."""
    reflectance: Float32Array
    """The face's reflectance, shape (N, N, 3)."""

    @cached_property
    def _reflecting(self) -> tuple[Float32Array, Float32Array]:
        return inner_albedo(self.skin.subject, self.reflectance), self.reflectance

    def _on_patches(self, texels: NDArray[Any]) -> NDArray[Any]:
        """Return the nearest sampled texels of the patches, shape (..., n, n) to (..., P)."""
        covered = self.exchange.atlas.covered
        nearest = np.arange(len(covered)) * texels.shape[-1] // len(covered)
        found: NDArray[Any] = texels[..., nearest[:, None], nearest][..., covered]
        return found

    @cached_property
    def _worst(self) -> tuple[int, Float32Array]:
        """Image in which the first bounce is largest over the noise, and its direct light."""
        direct, r_d = self._on_patches(self.light.irradiance), self._patch_reflectance
        most = -1.0, 0
        for k, lit in enumerate(direct):
            first = self.white[k] * r_d * (self.exchange.exchange @ (r_d[:, 0] * lit))[:, None]
            sigma = self.noise.sigma(first + self.white[k] * r_d * lit[:, None])
            change = (first / sigma)[self._is_visible].max(initial=0.0)
            most = max(most, (float(change), k))
        return most[1], np.ascontiguousarray(direct[most[1]])

    @cached_property
    def _is_visible(self) -> BoolArray:
        return np.asarray(self._on_patches(self.light.visible))

    @cached_property
    def _color(self) -> InterreflectionColor:
        settings = InterreflectionSettings(self.exchange)
        inside = inner_albedo(self.skin.subject, self.reflectance)
        return InterreflectionColor(settings, self.skin, inside, self.reflectance)

    @property
    def _patch_reflectance(self) -> Float32Array:
        """Mean factor of the diffuse term on the patches, (P, 3)."""
        return self._color.r_d

    @cached_property
    def by_channel(self) -> Float32Array:
        """First bounce that enters each patch, each channel as one band, shape (P, 3)."""
        _, direct = self._worst
        return np.asarray(self.exchange.exchange @ (self._patch_reflectance * direct[:, None]))

    @cached_property
    def _by_wavelength(self) -> Float32Array:
        _, direct = self._worst
        return np.asarray(self.exchange.exchange @ (self._color.spectrum * direct[:, None]))

    def by_wavelength(self, step: int = 1) -> Float32Array:
        """Return the first bounce by every ``step``-th wavelength, shape (P, 3)."""
        weights, spectrum = self.skin.band_weights(step), self._color.spectrum[:, ::step]
        channel = np.maximum(spectrum @ weights, MIN_REFLECTANCE)
        return np.asarray((self._by_wavelength[:, ::step] * spectrum) @ weights / channel)

    def over_noise(self, came: FloatArray, other: FloatArray | float = 0.0) -> float:
        """Return the largest change of a pixel over its noise between two bounces, (P, 3) each."""
        k, _ = self._worst
        unit = self.white[k] * self._patch_reflectance
        # pixels are smaller than patches: the darkest neighbor has the least noise
        bright = np.where(self.light.covered, self.light.irradiance[k], np.float32(np.inf))
        darkest = self._on_patches(minimum_filter(bright, size=3, mode="nearest"))
        sigma = self.noise.sigma(unit * (darkest[:, None] + self.by_channel))
        change = np.abs(unit * (came - other)) / sigma
        return float(change[self._is_visible].max(initial=0.0))

    def further_bounces(self) -> Iterator[tuple[float, float]]:
        """Iterate over ends of the sum over bounces.

        Yields
        ------
        fraction, change : float
            Fraction of the first bounce at which the sum ends, and the largest change of a pixel
            over its noise by the next bounce and all that follow it.
        """
        r_d, latest = self._patch_reflectance, self.by_channel
        first = float(latest.max(initial=0.0)) or 1.0
        while True:
            fraction = float(latest.max(initial=0.0)) / first
            latest = self.exchange.exchange @ (r_d * latest)
            ratio = float(latest.max(initial=0.0)) / (fraction * first or 1.0)
            # further bounces decrease at least as fast
            yield fraction, self.over_noise(latest) / max(1.0 - ratio, 1e-3)
