"""Sample the light on a face before anything is rendered, for the sizes of effects.

Every n-th texel receives the direct light of each lamp by a few shadow rays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from rigsim.light.observed_skin import ObservedSkin
from rigsim.mitsuba.olat import RAY_OFFSET_MM
from rigsim.needs.effects import PixelNoise
from rigsim.render import Caster
from rigsim.subject import SimulatedSubject
from rigsim.tissue.skin_layers import ETA

SAMPLED_TEXELS: Final = 64
"""Largest number of sampled texels along each side of the texture."""

SHADOW_RADII: Final = (-0.7, 0.7)
"""Points on a lamp's disc for shadow rays, in radii off its center."""

MIN_VIEW_COSINE: Final = 0.02
"""Cosine between normal and camera below which a texel is not visible."""

TEXEL_STEP: Final = 16
"""Every n-th texel's reflectance is evaluated for the largest."""

OUTLINE_COSINE: Final = 0.5
"""Cosine between normal and camera below which a texel counts as near the face's outline."""

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

    def radius(self) -> Float64Array:
        """Return a radius of the disc, mm, shape (3,)."""
        across = np.cross(self.position_mm, np.eye(3)[int(np.argmin(np.abs(self.position_mm)))])
        return np.asarray(self.radius_mm / float(np.linalg.norm(across)) * across, np.float64)

    def direction_and_falloff(self, position_mm: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return unit vectors from points to the lamp, and the inverse squared distance, 1/mm2."""
        way = np.asarray(self.position_mm, np.float32) - position_mm
        squared = np.einsum("ij,ij->i", way, way)
        return way / np.sqrt(squared)[:, None], np.float32(1.0) / squared


@dataclass(frozen=True, eq=False)
class SampledLight:
    """Direct light on a face in K images, on n x n texels of its texture."""

    covered: BoolArray
    """Texels with skin, shape (n, n)."""
    facing: Float32Array
    """Largest cosine between the mesh's normal and a camera that sees the texel, shape (n, n); 0:
    no camera sees it."""
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

    @property
    def visible(self) -> BoolArray:
        """Texels that a camera sees, shape (n, n)."""
        return self.facing > 0.0

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
    # a camera sees the points that it would light
    eyes = [SampledLamp((float(x), float(y), float(z)), 0.0, 1.0) for x, y, z in cameras_mm]
    shown = visible_fractions(caster, position, mesh_normal, eyes) > 0.0
    shown &= cosines > MIN_VIEW_COSINE
    light, shine = (np.zeros((len(images), len(where)), np.float32) for _ in range(2))
    each = [(k, lamp) for k, lamps in enumerate(images) for lamp in lamps]
    parts = visible_fractions(caster, position, mesh_normal, [lamp for _, lamp in each])
    for (k, lamp), seen in zip(each, parts, strict=True):
        way, falloff = lamp.direction_and_falloff(position)
        strength = np.float32(lamp.weight_mm2) * falloff * seen
        light[k] += strength * np.clip(np.einsum("ij,ij->i", way, normal), 0.0, None)
        shine[k] += strength * bare * reflect_facets(normal, way, to_cameras[0], alpha)

    def fill(values: FloatArray) -> Float32Array:
        out = np.zeros((*values.shape[:-1], covered.size), np.float32)
        out[..., where] = values
        return out.reshape(*values.shape[:-1], *shape)

    return SampledLight(
        covered,
        fill(np.where(shown, cosines, 0.0).max(axis=0)),
        fill(light),
        fill(shine),
        fill(cosines[0]),
        atlas.position_mm[part],
        tuple(tuple(lamps) for lamps in images),
        part,
    )


def visible_fractions(
    caster: Caster, position_mm: Float32Array, normal: Float32Array, lamps: Sequence[SampledLamp]
) -> Float32Array:
    """Return the visible fraction of lamps from points of a mesh, shape (L, n), by few rays.

    Parameters
    ----------
    caster
        The mesh.
    position_mm, normal
        Points and normals of the mesh, shape (n, 3).
    lamps
        The lamps, whose discs face the rig's origin.
    """
    start = position_mm + np.float32(RAY_OFFSET_MM) * normal
    targets = [lamp.position_mm + r * lamp.radius() for lamp in lamps for r in SHADOW_RADII]
    ways = np.asarray(targets, np.float32)[:, None] - start
    lengths = np.linalg.norm(ways, axis=-1)
    ways /= lengths[..., None]
    out = np.einsum("lij,ij->li", ways, normal) > 0.0
    starts = np.broadcast_to(start, ways.shape)[out]
    out[out] = ~caster.is_blocked(starts, ways[out], np.float32(0.999) * lengths[out])
    return out.reshape(len(lamps), len(SHADOW_RADII), -1).mean(axis=1, dtype=np.float32)


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
