"""Sample the light on a window of a skin patch before it is rendered, for the sizes of effects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import scipy.fft

from capture.rig import View
from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.as_built.sphere import PATTERN_WEIGHTS, ActualSphere, diffuser_radiance
from rigsim.light.lobe_moments import MicrofacetSurface, sum_led_moments
from rigsim.light.relief_shadow import hidden_sky_fraction, horizon_tangent
from rigsim.light.shadowed_lights import subtract_hidden_led
from rigsim.needs.effects import PixelNoise
from rigsim.render.lens_blur import Lens
from rigsim.skin_patch.microrelief import MicroSkin, lateral_kernel
from rigsim.tissue.skin_layers import ETA

WINDOW_TEXELS: Final = 64
"""Texels along each side of the window."""

MARGIN_TEXELS: Final = 32
"""Texels around the window that hide light from it."""

SEARCHED_TEXELS: Final = 384
"""Texels along each side of the part in which the roughest window is searched."""

HORIZON_SECTORS: Final = 8

SLOPE_GAIN: Final = 1.5
"""Steepening of the relief by compression to 0.7 of its length, as in the usual plan."""

POLARIZER_EXTINCTION: Final = 1e3
"""Extinction ratio of polarizers; the actual one hardly changes the sizes."""

LIT_PATTERNS: Final = tuple(w for name, w in PATTERN_WEIGHTS.items() if name != "dark")


@dataclass(frozen=True, eq=False)
class SampledPatch:
    """Light on a window of a patch, without and with each effect; maps of shape (m, m)."""

    patch: MicroSkin
    """The patch."""
    sphere: ActualSphere
    """The LEDs."""
    view: View
    """The camera."""
    lens: Lens
    """Its lens."""
    corner: tuple[int, int]
    """First row and column of the window in the patch."""

    @classmethod
    def roughest(
        cls, patch: MicroSkin, sphere: ActualSphere, view: View, lens: Lens
    ) -> SampledPatch:
        """Return the window of the camera's field with the steepest slope in its middle."""
        size = len(patch.height_um)
        field = 1e3 * max(view.field_mm) / patch.texel_um
        half = min(size // 2, SEARCHED_TEXELS // 2, math.ceil(0.5 * field))
        down, right = np.gradient(patch.height_um, patch.texel_um)
        slope = np.hypot(down, right)
        middle = slice(size // 2 - half, size // 2 + half)
        row, column = np.unravel_index(np.argmax(slope[middle, middle]), (2 * half, 2 * half))
        last = max(size - WINDOW_TEXELS, 0)
        first = size // 2 - half - WINDOW_TEXELS // 2
        return cls(
            patch,
            sphere,
            view,
            lens,
            tuple(min(max(first + int(at), 0), last) for at in (row, column)),  # type: ignore[arg-type]
        )

    def _cut(self, texture: Float32Array, margin: int = 0) -> Float32Array:
        """Return the window of a texture; beyond the patch its border is repeated."""
        rows, columns = (
            np.clip(np.arange(at - margin, at + WINDOW_TEXELS + margin), 0, len(texture) - 1)
            for at in self.corner
        )
        return np.ascontiguousarray(texture[np.ix_(rows, columns)], np.float32)

    def _height_um(self, margin: int) -> Float32Array:
        """Return the relief as steep as compression makes it, with texels around the window."""
        return np.float32(SLOPE_GAIN) * self._cut(self.patch.height_um, margin)

    @cached_property
    def x_mm(self) -> Float32Array:
        """Positions in the middle of the field, where LEDs and camera are nearly the same."""
        return np.zeros((WINDOW_TEXELS, WINDOW_TEXELS), np.float32)

    @property
    def y_mm(self) -> Float32Array:
        """The same."""
        return self.x_mm

    @cached_property
    def normals(self) -> Float32Array:
        """Unit normals, shape (m, m, 3)."""
        height = self._height_um(1)
        slopes = np.gradient(height, self.patch.texel_um)
        down, right = (np.asarray(part)[1:-1, 1:-1] for part in slopes)
        length = np.sqrt(1.0 + right**2 + down**2)
        return np.stack([-right / length, down / length, 1.0 / length], -1).astype(np.float32)

    @cached_property
    def alpha(self) -> Float32Array:
        """Roughness."""
        return self._cut(self.patch.alpha)

    @cached_property
    def skin(self) -> BoolArray:
        """All texels are skin."""
        return np.ones((WINDOW_TEXELS, WINDOW_TEXELS), np.bool_)

    @cached_property
    def _surface(self) -> MicrofacetSurface:
        alpha = float(np.median(self.alpha))
        return MicrofacetSurface(
            alpha, ETA, self.view.position_mm, self.view.axes[0], POLARIZER_EXTINCTION
        )

    @cached_property
    def _white(self) -> float:
        return float(diffuser_radiance(self.sphere, np.zeros(1), np.zeros(1))[0, 0])

    @cached_property
    def _leds(self) -> tuple[int, ...]:
        return tuple(k for k, (_, _, z) in enumerate(self.sphere.position_mm) if z > 0.0)

    @cached_property
    def _unshadowed(self) -> Float32Array:
        """Moments of facets (12) and of entering light (4), shape (16, m, m)."""
        found = sum_led_moments(
            self.normals.reshape(-1, 3),
            (0.0, 0.0, 0.0),
            self.sphere,
            self._surface,
            leds=self._leds,
            alpha=self.alpha.ravel(),
        )
        packed = found.packed().T.reshape(16, WINDOW_TEXELS, WINDOW_TEXELS)
        return np.ascontiguousarray(packed)

    @cached_property
    def _shadowed(self) -> Float32Array:
        packed = self._unshadowed.copy()
        height = self._height_um(MARGIN_TEXELS)
        inner = slice(MARGIN_TEXELS, -MARGIN_TEXELS)
        tangents = []
        for k in range(HORIZON_SECTORS):
            angle = 2.0 * math.pi * k / HORIZON_SECTORS
            full = horizon_tangent(height, pixel_um=self.patch.texel_um, azimuth_rad=angle)
            tangents.append(np.ascontiguousarray(full[inner, inner]))
        place = self.sphere.position_mm
        turn = np.arctan2(place[:, 1], place[:, 0]) % (2.0 * np.pi)
        turn *= HORIZON_SECTORS / (2.0 * np.pi)
        for led in self._leds:
            k = int(turn[led]) % HORIZON_SECTORS
            pair = (tangents[k], tangents[(k + 1) % HORIZON_SECTORS], float(turn[led] % 1.0))
            subtract_hidden_led(packed, self, pair, self.sphere, led, self._surface)
        return packed

    @cached_property
    def _hidden_sky(self) -> Float32Array:
        hidden = hidden_sky_fraction(
            self._height_um(MARGIN_TEXELS),
            self.normals,
            margin=MARGIN_TEXELS,
            pixel_um=self.patch.texel_um,
            sectors=HORIZON_SECTORS,
            boundaries=True,
        )
        return np.float32(shading.interior_scale(ETA)) * hidden

    @property
    def max_hidden_sky(self) -> float:
        """Largest hidden fraction of the sky through two boundaries, after lateral scattering."""
        hidden = self._filter(self._hidden_sky[None].astype(np.float64), self._lateral_transfer)
        return float(hidden.max())

    @cached_property
    def _lateral_transfer(self) -> Float64Array:
        sigmas, weights = lateral_kernel(self.patch)
        square = 2.0 * np.pi**2 * self._frequency_per_mm[..., None] ** 2
        return np.asarray(np.exp(-(sigmas**2) * square) @ weights)

    def _filter(self, images: Float64Array, transfer: Float64Array) -> Float64Array:
        """Multiply the cosine spectra of images that are mirrored at their borders."""
        return np.asarray(
            scipy.fft.idctn(scipy.fft.dctn(images, axes=(1, 2)) * transfer, axes=(1, 2))
        )

    @cached_property
    def _frequency_per_mm(self) -> Float64Array:
        axis = np.arange(WINDOW_TEXELS) / (2.0 * WINDOW_TEXELS * 1e-3 * self.patch.texel_um)
        return np.hypot(axis[:, None], axis[None, :])

    def images(
        self,
        *,
        shadows: bool = True,
        lateral: bool = True,
        interreflections: bool = True,
        optics: bool = True,
    ) -> Float64Array:
        """Return all patterns behind the parallel and the crossed analyzer, white being 1.

        Shape (2 P, m, m).
        """
        packed = (self._shadowed if shadows else self._unshadowed).astype(np.float64)
        facets, entering = packed[:12].reshape(4, 3, *packed.shape[1:]), packed[12:]
        kernel = self._lateral_transfer if lateral else np.ones_like(self._frequency_per_mm)
        entering = self._filter(entering, kernel)
        albedo = self._cut(self.patch.albedo)
        if interreflections:
            once = float(albedo.mean()) * self._hidden_sky
            entering = entering + self._filter(once * entering, kernel) / (1.0 - once.mean())
        scale = shading.interior_scale(ETA) / math.pi * (1.0 - ((ETA - 1.0) / (ETA + 1.0)) ** 2)
        inside = scale * albedo * entering
        polarized = np.hypot(facets[:, 1], facets[:, 2])
        moments = np.concatenate(
            [inside + facets[:, 0] + polarized, inside + facets[:, 0] - polarized]
        )
        patterns = np.array(LIT_PATTERNS)
        light = np.einsum("pm,kmij->kpij", patterns, moments.reshape(2, 4, *moments.shape[1:]))
        light = light.reshape(-1, *moments.shape[1:]) / self._white
        if optics:
            light = self._filter(light, self.lens.otf(self._frequency_per_mm))
        return np.maximum(light, 0.0)

    def changes_over_noise(
        self, white: float, noise: PixelNoise, built: Mapping[str, bool]
    ) -> dict[str, float]:
        """Return the largest change of a pixel over its noise by the omission of each effect.

        Parameters
        ----------
        white
            Signal of white under all LEDs, full scales; inf: the brightest pixel is at full scale.
        noise
            Noise of the sensor.
        built
            Arguments of `images`; each effect is compared with the others as given.
        """
        images = {built_set: self.images(**dict(built_set)) for built_set in _variants(built)}
        found = {}
        for name in built:
            have, lack = (images[_key({**built, name: part})] for part in (True, False))
            unit = white if math.isfinite(white) else 1.0 / float(have.max())
            have, lack = np.minimum(unit * have, 1.0), np.minimum(unit * lack, 1.0)
            found[name] = float((np.abs(have - lack) / noise.sigma(have)).max())
        return found


def _key(built: Mapping[str, bool]) -> tuple[tuple[str, bool], ...]:
    return tuple(sorted(built.items()))


def _variants(built: Mapping[str, bool]) -> set[tuple[tuple[str, bool], ...]]:
    """Return the arguments with each effect and without."""
    return {_key({**built, name: part}) for name in built for part in (True, False)}
