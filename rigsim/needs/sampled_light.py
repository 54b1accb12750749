"""Sample the light on a face before anything is rendered, for the sizes of effects.

Every n-th texel receives the direct light of each lamp by a few shadow rays. Interreflection is
computed between coarse patches. Both cost a small part of one image.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, TypeAlias

import numpy as np

from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from rigsim.light.interreflection import (
    Interreflection,
    InterreflectionColor,
    InterreflectionSettings,
    coarse_skin,
)
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.subsurface_radiance import inner_albedo
from rigsim.needs.effects import PixelNoise
from rigsim.render import Caster, visibility
from rigsim.subject import SimulatedSubject
from rigsim.tissue.skin_layers import ETA

SAMPLED_TEXELS: Final = 64
"""Largest number of sampled texels along each side of the texture."""

SHADOW_SAMPLES: Final = 2
"""Shadow rays per sampled texel and lamp."""

MIN_VIEW_COSINE: Final = 0.02
"""Cosine between normal and camera below which a texel is not visible."""

TEXEL_STEP: Final = 16
"""Every n-th texel's reflectance is evaluated for the largest."""

OUTLINE_COSINE: Final = 0.5
"""Cosine between normal and camera below which a texel counts as near the face's outline."""

BOUNCE_CANDIDATES: Final = (0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5)
"""Fractions of the first bounce at which the sum may end, largest first."""

EXACT_BOUNCE_FRACTION: Final = 1e-7
"""Fraction of the first bounce at which the sum is exact in single precision."""


TexelIndex: TypeAlias = tuple[Int64Array, Int64Array]


@dataclass(frozen=True, slots=True)
class SampledLamp:
    """A lamp, as far as the sizes of effects depend on it."""

    position_mm: tuple[float, float, float]
    """Center of its disc, rig frame."""
    radius_mm: float
    """Radius of the disc."""
    weight_mm2: float
    """Irradiance of a facing surface times its squared distance, over that of a white plate."""


@dataclass(frozen=True, eq=False)
class SampledLight:
    """Direct light on a face in K images, on n x n texels of its texture."""

    covered: BoolArray
    """Texels with skin, shape (n, n)."""
    visible: BoolArray
    """Those that face a camera, shape (n, n)."""
    irradiance: Float32Array
    """Irradiance over that of a white plate, with shadows of the mesh, shape (K, n, n)."""
    highlight: Float32Array
    """Surface reflection over a white plate's light, shape (K, n, n)."""
    view_cosine: Float32Array
    """Cosine between the normal and the direction to the first camera, shape (n, n)."""
    position_mm: Float32Array
    """Points of the texels, rig frame, shape (n, n, 3)."""
    images: tuple[tuple[SampledLamp, ...], ...]
    """Lamps of each image."""
    part: tuple[slice, slice]
    """Sampled rows and columns of the face's texture."""

    def neighbors(self) -> Iterator[tuple[TexelIndex, TexelIndex]]:
        """Iterate over pairs of index arrays of neighboring texels: along u, and along v."""
        for axis in (1, 0):
            ahead = np.roll(self.covered, -1, axis) & self.covered
            seen = np.roll(self.visible, -1, axis) | self.visible
            both = ahead & seen
            both[(slice(None),) * axis + (-1,)] = False
            row, column = np.nonzero(both)
            yield (row, column), (row + (axis == 0), column + (axis == 1))


def sample_light(
    subject: SimulatedSubject,
    caster: Caster,
    images: Sequence[Sequence[SampledLamp]],
    cameras_mm: FloatArray,
) -> SampledLight:
    """Sample the direct light on a face.

    Parameters
    ----------
    subject
        The face in its present pose.
    caster
        Its mesh.
    images
        Lamps of each image.
    cameras_mm
        Positions of the cameras, shape (V, 3); highlights are those of the first.
    """
    atlas = subject.atlas
    step = max(1, -(-atlas.size // SAMPLED_TEXELS))
    middle = slice(step // 2, None, step)
    part = (middle, middle)
    covered = atlas.covered[part]
    where = np.flatnonzero(covered)
    shape = covered.shape

    def pick(texture: Float32Array) -> Float32Array:
        return np.ascontiguousarray(texture[part].reshape(-1, texture.shape[-1])[where])

    position, mesh_normal, normal = (
        pick(texture) for texture in (atlas.position_mm, atlas.normal, subject.normal)
    )
    alpha = np.clip(subject.roughness[part].reshape(-1)[where], *shading.ALPHA_RANGE)
    bare = 1.0 - subject.hair[part].reshape(-1)[where]
    to_cameras = np.asarray(cameras_mm, np.float32)[:, None] - position
    to_cameras /= np.linalg.norm(to_cameras, axis=-1, keepdims=True)
    cosines = np.einsum("vij,ij->vi", to_cameras, mesh_normal)
    light, shine = (np.zeros((len(images), len(where)), np.float32) for _ in range(2))
    for k, lamps in enumerate(images):
        for lamp in lamps:
            seen = visibility(
                caster,
                position,
                mesh_normal,
                lamp.position_mm,
                radius_mm=lamp.radius_mm,
                samples=SHADOW_SAMPLES,
            )
            way = np.asarray(lamp.position_mm, np.float32) - position
            squared = np.einsum("ij,ij->i", way, way)
            way /= np.sqrt(squared)[:, None]
            strength = np.float32(lamp.weight_mm2) / squared * seen
            light[k] += strength * np.clip(np.einsum("ij,ij->i", way, normal), 0.0, None)
            facets = reflect_facets(normal, way, to_cameras[0], alpha)
            shine[k] += strength * bare * facets

    def fill(values: FloatArray) -> Float32Array:
        out = np.zeros((*values.shape[:-1], covered.size), np.float32)
        out[..., where] = values
        return out.reshape(*values.shape[:-1], *shape)

    return SampledLight(
        covered,
        fill((cosines > MIN_VIEW_COSINE).any(axis=0)) > 0.0,
        fill(light),
        fill(shine),
        fill(cosines[0]),
        atlas.position_mm[part],
        tuple(tuple(lamps) for lamps in images),
        part,
    )


def reflect_facets(
    normal: Float32Array, to_light: Float32Array, to_camera: Float32Array, alpha: Float32Array
) -> Float32Array:
    """Return pi times the reflection of GGX facets with its cosine, polarized light doubled.

    Parameters
    ----------
    normal, to_light, to_camera
        Unit vectors, shape (n, 3).
    alpha
        Roughness, shape (n,).

    Returns
    -------
    ndarray of float32
        Shape (n,): over the light of a white plate that faces light and camera. A plate
        depolarizes the light, so that an analyzer transmits half of it, but all of a highlight.

    Examples
    --------
    >>> up = np.float32([[0, 0, 1]])
    >>> shine = reflect_facets(up, up, up, np.float32([0.5]))
    >>> round(float(shine[0]) / (2.0 * (0.4 / 2.4) ** 2 / (4.0 * 0.5**2)), 3)
    1.0
    """
    half = to_light + to_camera
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), np.float32(1e-6))
    nl, nv, nh, lh = (
        np.einsum("ij,ij->i", *pair)
        for pair in ((normal, to_light), (normal, to_camera), (normal, half), (to_light, half))
    )
    lit = (nl > 0.0) & (nv > MIN_VIEW_COSINE)
    nl, nv, lh = (np.clip(part, 1e-3, 1.0) for part in (nl, nv, lh))
    squared = alpha * alpha
    density = squared / (np.pi * (nh * nh * (squared - 1.0) + 1.0) ** 2)
    hidden = [0.5 * (np.sqrt(1.0 + squared * (1.0 / c**2 - 1.0)) - 1.0) for c in (nl, nv)]
    across, along = shading.fresnel_amplitudes(lh.astype(np.float32), ETA)
    fresnel = np.maximum(across**2, along**2)
    found = 2.0 * np.pi * fresnel * density / (4.0 * nv * (1.0 + hidden[0] + hidden[1]))
    return np.where(lit, found, 0.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SampledBounces:
    """Interreflection on a face between coarse patches, in the image where it is largest."""

    skin: ObservedSkin
    """The face."""
    exchange: Interreflection
    """Exchange between its coarse patches."""
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

    @cached_property
    def _direct(self) -> Float32Array:
        """Direct light on the patches, (P, K), and behind it visibility and coverage."""
        light = self.light
        layers = np.concatenate([light.irradiance, light.visible[None], light.covered[None]])
        return self.exchange.coarsen(np.moveaxis(layers * light.covered, 0, -1).astype(np.float32))

    @cached_property
    def _worst(self) -> tuple[int, Float32Array]:
        """Image in which the first bounce is largest over the noise, and its direct light."""
        direct = self._direct[:, :-2] / np.maximum(self._direct[:, -1:], np.float32(1e-6))
        r_d = self._patch_reflectance
        most = -1.0, 0
        first = self.exchange.exchange @ (r_d[:, :1] * direct)
        for k in range(direct.shape[1]):
            signal = self.white[k] * r_d * first[:, k, None]
            lit = signal + self.white[k] * r_d * direct[:, k, None]
            change = (signal / self.noise.sigma(lit))[self._is_visible].max(initial=0.0)
            most = max(most, (float(change), k))
        return most[1], np.ascontiguousarray(direct[:, most[1]])

    @cached_property
    def _is_visible(self) -> BoolArray:
        return np.asarray(self._direct[:, -2] > 0.0)

    @cached_property
    def _coarse(self) -> Float32Array:
        """`rigsim.light.interreflection.coarse_skin` of the face."""
        return coarse_skin(self.exchange, self.skin, *self._reflecting)

    @property
    def _patch_reflectance(self) -> Float32Array:
        """Mean factor of the diffuse term on the patches, (P, 3)."""
        return self._coarse[:, 7:]

    def arriving(self, *, spectral: bool, step: int = 1, last: float = 1e-4) -> Float64Array:
        """Return the interreflected light that enters each patch, shape (P, 3)."""
        how = InterreflectionSettings(self.exchange, spectral, step, last)
        color = InterreflectionColor(how, self.skin, *self._reflecting, self._coarse)
        found = color.indirect_irradiance(self._worst[1])
        return np.asarray(found[self.exchange.atlas.covered], np.float64)

    def over_noise(self, arriving: Float64Array, other: Float64Array | float = 0.0) -> float:
        """Return the largest change of a pixel over its noise between two results of `arriving`."""
        k, direct = self._worst
        unit = self.white[k] * self._patch_reflectance
        sigma = self.noise.sigma(unit * (direct[:, None] + arriving))
        change = np.abs(unit * (arriving - other)) / sigma
        return float(change[self._is_visible].max(initial=0.0))


def scattering_over_noise(
    signal: Float64Array, light: SampledLight, lost: FloatArray, noise: PixelNoise
) -> float:
    """Return the largest change of a pixel by lateral scattering across an edge, over its noise.

    Parameters
    ----------
    signal
        Diffuse light of the texels in one image, full scales, shape (n, n, 3); it may exceed 1.
    light
        The texels.
    lost
        Fraction of a lit pixel's light lost across the edge of a shadow, see
        `rigsim.needs.effect_sizes.edge_loss`, shape (3,).
    noise
        Noise of the sensor.

    Notes
    -----
    Neighboring texels stand for the two sides of an edge. The darker one gains a part of the
    difference, where the noise is least.
    """
    most = 0.0
    for first, second in light.neighbors():
        one, other = signal[first], signal[second]
        gained = np.abs(one - other) * lost
        dark = np.minimum(one, other)
        change = gained / noise.sigma(dark + gained)
        most = max(most, float(change[dark.max(axis=-1) < 1.0].max(initial=0.0)))
    return most


def blur_over_noise(
    signal: Float64Array, light: SampledLight, spilled: FloatArray, noise: PixelNoise
) -> float:
    """Return the largest change of a pixel by blur of the lens, over its noise.

    Parameters
    ----------
    signal
        All light of the texels in one image, full scales, shape (n, n, 3).
    light
        The texels.
    spilled
        Fraction of a pixel's light that falls on others, shape (n, n).
    noise
        Noise of the sensor.

    Notes
    -----
    Two kinds of edges count: between neighboring texels, and between texels near the outline and
    the black background.
    """
    edge = light.visible & (light.view_cosine < OUTLINE_COSINE)
    gained = np.minimum(signal[edge] * spilled[edge][:, None], 1.0)
    most = float((gained / noise.sigma(gained)).max(initial=0.0))
    return max(
        most,
        *(
            _step_over_noise(signal[a], signal[b], np.maximum(spilled[a], spilled[b]), noise)
            for a, b in light.neighbors()
        ),
    )


def _step_over_noise(
    one: Float64Array, other: Float64Array, part: FloatArray, noise: PixelNoise
) -> float:
    dark = np.minimum(one, other)
    gained = np.abs(one - other) * part[:, None]
    change = np.minimum(gained, 1.0) / noise.sigma(dark + gained)
    return float(change.max(initial=0.0))


@dataclass(frozen=True, slots=True, eq=False)
class LitFace:
    """A face under a camera in K images."""

    skin: ObservedSkin
    """The face."""
    reflectance: Float32Array
    """Its reflectance, shape (N, N, 3)."""
    light: SampledLight
    """Direct light on it."""
    white: Float64Array
    """Signal of a white plate under an irradiance of 1, full scales, shape (K, 3)."""

    @classmethod
    def expose(
        cls,
        skin: ObservedSkin,
        light: SampledLight,
        white: Float64Array,
        *,
        to_full_scale: bool = False,
    ) -> LitFace:
        """Return a face under light.

        Parameters
        ----------
        skin, light
            The face and the light.
        white
            Signal of a white plate under an irradiance of 1, shape (3,).
        to_full_scale
            Whether the brightest texel of each image is at full scale instead.
        """
        unit = np.broadcast_to(white, (len(light.images), 3)).astype(np.float64)
        lit = cls(skin, skin.reflectance(), light, unit)
        if not to_full_scale:
            return lit
        peaks = [float(np.max(lit.diffuse(k) + lit.highlight(k))) for k in range(len(unit))]
        return dataclasses.replace(lit, white=unit / np.maximum(peaks, 1e-12)[:, None])

    def diffuse(self, image: int) -> Float64Array:
        """Return the texels' direct light from inside, full scales, shape (n, n, 3)."""
        light = self.light.irradiance[image][..., None] * self.reflectance[self.light.part]
        return np.asarray(self.white[image] * light, np.float64)

    def highlight(self, image: int) -> Float64Array:
        """Return the texels' surface reflection, full scales, shape (n, n, 3)."""
        return np.asarray(self.white[image] * self.light.highlight[image][..., None], np.float64)

    @property
    def peak(self) -> float:
        """Signal of the brightest texel, full scales."""
        images = range(len(self.white))
        return max(float((self.diffuse(k) + self.highlight(k)).max()) for k in images)

    @property
    def brightest(self) -> Float64Array:
        """Largest reflectance in each channel, shape (3,)."""
        covered = self.skin.subject.atlas.covered
        return np.asarray(self.reflectance[covered][::TEXEL_STEP].max(axis=0), np.float64)
