"""Compute interreflection between coarse patches of a face.

Light that leaves the interior of one patch reaches another, enters it and leaves again. Patches are
the texels of a coarse texture. The exchange between two mutually visible patches is that of two
points, each with the boundary's transmittance at its own angle. The series over bounces is summed
until the remainder is below `DEFAULT_MIN_BOUNCE_FRACTION`.

Interreflected light has been reflected at least twice, so it is redder than direct light. A
camera's channel is a sum over wavelengths. For one reflection the channel's mean reflectance
suffices. A product of two reflectances requires the sum over wavelengths: in skin's red channel,
where blood and melanin vary the spectrum, the mean of the square exceeds the square of the mean.

Notes
-----
Only subsurface light is exchanged, and it enters interiors only. Highlights of lit skin on skin,
and specular reflections of lit skin, are omitted (a few percent of a few percent).
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final
from weakref import WeakValueDictionary

import numpy as np
from numba import njit, prange
from scipy import sparse

from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import Atlas, dilate_texture, sample, unwrap
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.surface_brdf import transmittance
from rigsim.mitsuba.olat import RAY_OFFSET_MM
from rigsim.render import Caster

DEFAULT_MIN_BOUNCE_FRACTION: Final = 1e-3
"""Fraction of the first bounce below which further bounces are omitted."""

MAX_BOUNCES: Final = 30

PATCHES_PER_SIDE: Final = 96
"""Texels along each side of the coarse texture. On a pale head under one light, interreflection is
1 % of all light; against Mitsuba it is 16 % low with 64, 6 % with 96 and 4 % with 128."""

MIN_TRANSFER: Final = 1e-6
"""Exchange of two patches below which it is omitted: a fifth of all pairs of a face, which carry
0.1 % of the exchanged light."""


class Interreflection:
    """Light exchange between the patches of one face.

    Parameters
    ----------
    caster
        The face's mesh.
    patches
        Texels along each side of the coarse texture, >= 8.
    """

    def __init__(self, caster: Caster, *, patches: int = PATCHES_PER_SIDE) -> None:
        self.mesh = caster.mesh
        self.atlas = unwrap(caster.mesh, patches)
        covered = self.atlas.covered
        self._covered = covered
        point = self.atlas.position_mm[covered]
        normal = self.atlas.normal[covered]
        self._area_mm2 = _texel_area(self.atlas)[covered]
        self.exchange = _exchange(caster, point, normal, self._area_mm2)
        """Light entering a row's patch per light that has entered a column's patch and leaves it
        with R_d 1, shape (P, P), sparse."""

    def coarsen(self, texture: Float32Array) -> Float32Array:
        """Average a texture over the patches, shape (P, C), from shape (N, N, C)."""
        size, coarse = texture.shape[0], self.atlas.size
        row = np.arange(size) * coarse // size
        if size >= coarse:
            first = np.searchsorted(row, np.arange(coarse))
            count = np.diff(np.append(first, size)).astype(np.float64)
            sums = np.add.reduceat(texture, first, axis=0, dtype=np.float64)
            sums = np.add.reduceat(sums, first, axis=1)
            mean = sums / (count[:, None] * count)[..., None]
            return np.asarray(mean[self._covered], np.float32)
        sums = np.zeros((coarse, coarse, texture.shape[2]), np.float64)
        count = np.zeros((coarse, coarse), np.float64)
        np.add.at(sums, (row[:, None], row[None, :]), texture)
        np.add.at(count, (row[:, None], row[None, :]), 1.0)
        mean = sums / np.maximum(count, 1.0)[..., None]
        return np.asarray(mean[self._covered], np.float32)

    def surface(self) -> tuple[Float32Array, Float32Array]:
        """Return the patches' centers in mm and their normals, shape (1, P, 3) each."""
        return (self.atlas.position_mm[self._covered][None], self.atlas.normal[self._covered][None])

    def indirect_irradiance(
        self,
        entered: Float32Array,
        r_d: Float32Array,
        *,
        min_bounce_fraction: float = DEFAULT_MIN_BOUNCE_FRACTION,
    ) -> Float32Array:
        """Return the light that enters after interreflection.

        Parameters
        ----------
        entered
            Light that enters each patch directly, shape (P,).
        r_d
            Factor of the diffuse term, shape (P, C).
        min_bounce_fraction
            Fraction of the first bounce below which further bounces are omitted.

        Returns
        -------
        ndarray of float32
            Light that enters after one or more bounces, same unit, on the coarse texture, shape
            (N, N, C), 0 where the texture has no surface.
        """
        # Neumann series over bounces: sum of (X R)^n E for n >= 1, with X the exchange and R the
        # R_d.
        latest = self.exchange @ (r_d * entered[:, None])
        total = latest.copy()
        least = min_bounce_fraction * float(np.abs(latest).max(initial=0.0))
        for _ in range(MAX_BOUNCES):
            if not float(np.abs(latest).max(initial=0.0)) > least:
                break
            latest = self.exchange @ (r_d * latest)
            total += latest
        out = np.zeros((*self._covered.shape, r_d.shape[1]), np.float32)
        out[self._covered] = total
        return out


_living: WeakValueDictionary[int, Interreflection] = WeakValueDictionary()
_latest: deque[Interreflection] = deque(maxlen=2)
"""The last exchanges: scenes of one face follow each other, and an exchange takes 0.8 s."""
MAX_KEPT_PAIRS: Final = 4_000_000
"""Pairs of patches, 8 bytes each, of an exchange that outlives its scene; a face has 2 million."""


def interreflection_for(caster: Caster) -> Interreflection:
    """Return the exchange on a mesh: the same while it is held, and until two later ones exist."""
    found = _living.get(id(caster.mesh))  # the id stays unique while the exchange holds the mesh
    if found is None:
        found = _living[id(caster.mesh)] = Interreflection(caster)
        if found.exchange.nnz <= MAX_KEPT_PAIRS:
            _latest.append(found)
    return found


def _texel_area(atlas: Atlas) -> Float32Array:
    cross = np.cross(atlas.dp_du_mm, atlas.dp_dv_mm)
    return np.asarray(np.linalg.norm(cross, axis=-1) / atlas.size**2, np.float32)


def _exchange(
    caster: Caster, point: Float32Array, normal: Float32Array, area: Float32Array
) -> sparse.csr_array:
    patches, least = (point, normal, area), math.pi * MIN_TRANSFER
    count = np.zeros(len(point), np.int64)
    _count_pairs(*patches, least, count)
    ends = np.cumsum(count)
    pairs = int(ends[-1]) if len(ends) else 0
    here, there = np.empty(pairs, np.int32), np.empty(pairs, np.int32)
    strength = np.empty(pairs, np.float32)
    _fill_pairs(*patches, least, ends - count, here, there, strength)
    raised = point + np.float32(RAY_OFFSET_MM) * normal
    start = raised[here]
    way = raised[there] - start
    length = np.sqrt(np.einsum("ij,ij->i", way, way))
    way /= length[:, None]
    # both directions between two patches share one visibility ray
    free = ~caster.is_blocked(start, way, np.float32(0.999) * length)
    here, there, strength = here[free], there[free], strength[free]
    # A distant patch of area A receives f = cos cos T T A / (pi d^2). A near patch is not a point:
    # f / (1 + f) keeps its fraction below 1.
    came, gone = strength * area[there], strength * area[here]
    values = np.concatenate([came / (math.pi + came), gone / (math.pi + gone)])
    places = np.concatenate([here, there]), np.concatenate([there, here])
    return sparse.csr_array((values, places), shape=(len(point), len(point)))


@njit(inline="always")
def _facing(point, normal, area, i, j, least):  # type: ignore[no-untyped-def]
    """Return both cosines and the squared distance of two patches; cosines of 0 omit the pair.

    Pairs that exchange less than ``least``, over pi, are omitted.
    """
    x = float(point[j, 0]) - point[i, 0]
    y = float(point[j, 1]) - point[i, 1]
    z = float(point[j, 2]) - point[i, 2]
    here = x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2]
    there = -(x * normal[j, 0] + y * normal[j, 1] + z * normal[j, 2])
    squared = x * x + y * y + z * z
    if here <= 0.0 or there <= 0.0:
        return 0.0, 0.0, squared
    # the boundary transmits less than all
    if max(area[i], area[j]) * here * there < least * squared * squared:
        return 0.0, 0.0, squared
    length = math.sqrt(squared)
    return min(here / length, 1.0), min(there / length, 1.0), squared


@njit(parallel=True, cache=True)
def _count_pairs(point, normal, area, least, out):  # type: ignore[no-untyped-def]
    """Count the later patches with which each patch exchanges light, as if none were hidden."""
    patches = point.shape[0]
    for task in prange(patches):
        i = task // 2 if task % 2 == 0 else patches - 1 - task // 2  # early ones have more pairs
        for j in range(i + 1, patches):
            out[i] += _facing(point, normal, area, i, j, least)[0] > 0.0


@njit(parallel=True, cache=True)
def _fill_pairs(point, normal, area, least, start, here, there, strength):  # type: ignore[no-untyped-def]
    """Write these pairs, and cos cos T T / d^2 of each."""
    patches = point.shape[0]
    for task in prange(patches):
        i = task // 2 if task % 2 == 0 else patches - 1 - task // 2
        at = start[i]
        for j in range(i + 1, patches):
            out, back, squared = _facing(point, normal, area, i, j, least)
            if out > 0.0:
                here[at], there[at] = i, j
                strength[at] = out * back * transmittance(out) * transmittance(back) / squared
                at += 1


WAVELENGTH_STEPS: Final = (5, 3, 2)
"""Steps through the table's wavelengths, largest first; both ends are always included."""

MIN_REFLECTANCE: Final = 1e-6
"""Reflectance and coverage below which a patch has no color."""


@dataclass(frozen=True, slots=True, eq=False)
class InterreflectionSettings:
    """Settings of the interreflection on one face."""

    exchange: Interreflection
    """Exchange between patches."""
    spectral: bool = True
    """Whether wavelengths are summed separately; without, each channel is treated as one band."""
    step: int = 1
    """Step through the table's wavelengths, 1 or one of `WAVELENGTH_STEPS`."""
    min_bounce_fraction: float = DEFAULT_MIN_BOUNCE_FRACTION
    """Fraction of the first bounce below which further bounces are omitted."""


class InterreflectionColor:
    """Interreflection on one face in one state, in one camera's channels.

    Parameters
    ----------
    bounces
        Settings of the interreflection.
    skin
        The face.
    r_d
        Factor of the diffuse term per channel, including the skin's covering, shape (N, N, 3).
    reflectance
        White-balanced reflectance of the skin per channel, shape (N, N, 3).
    """

    def __init__(
        self,
        bounces: InterreflectionSettings,
        skin: ObservedSkin,
        r_d: Float32Array,
        reflectance: Float32Array,
    ) -> None:
        self._bounce, self._min_bounce_fraction = bounces.exchange, bounces.min_bounce_fraction
        subject = skin.subject
        covered = subject.atlas.covered.astype(np.float32)
        factor = r_d / np.maximum(reflectance, np.float32(MIN_REFLECTANCE))
        fractions = subject.melanin, skin.blood_volume_fraction, subject.thickness_ratio
        layers = np.dstack([covered, *fractions, factor, r_d])
        coarse = self._bounce.coarsen(np.asarray(layers * covered[..., None], np.float32))
        coarse[:, 1:] /= np.maximum(coarse[:, :1], np.float32(MIN_REFLECTANCE))
        self.r_d = np.ascontiguousarray(coarse[:, 7:])
        """Factor of the diffuse term of each patch, shape (P, 3)."""
        self._weights: Float32Array | None = None
        if bounces.spectral:
            weights = skin.band_weights(bounces.step)
            # patches off the skin have a thickness of 0
            ratio = skin.subject.thickness_ratio
            thickness = np.clip(coarse[:, 3], ratio.min(), ratio.max())
            spectra = skin.spectra(coarse[:, 1], coarse[:, 2], thickness)[:, :: bounces.step]
            cover = coarse[:, 4:7].mean(axis=1, keepdims=True)
            self.spectrum = np.asarray(spectra * cover, np.float32)
            """Spectral factor of each patch by the settings' wavelengths, shape (P, W)."""
            self._channel = np.maximum(self.spectrum @ weights, MIN_REFLECTANCE).astype(np.float32)
            self._weights = np.asarray(weights, np.float32)

    def indirect_irradiance(self, direct: Float32Array) -> Float32Array:
        """Return the light that enters after interreflection.

        Parameters
        ----------
        direct
            Light that enters each patch directly, shape (P,).

        Returns
        -------
        ndarray of float32
            On the coarse texture, shape (n, n, 3), same unit: its product with the patch's
            reflectance in a channel is the light that leaves in that channel.
        """
        if self._weights is None:
            return self._bounce.indirect_irradiance(
                direct, self.r_d, min_bounce_fraction=self._min_bounce_fraction
            )
        each = self._bounce.indirect_irradiance(
            direct, self.spectrum, min_bounce_fraction=self._min_bounce_fraction
        )
        covered = self._bounce.atlas.covered
        out = np.zeros((*covered.shape, self._weights.shape[1]), np.float32)
        # The last reflection is included per wavelength and divided out per channel, so that the
        # caller's product with the channel's reflectance restores it.
        out[covered] = ((each[covered] * self.spectrum) @ self._weights) / self._channel
        return out

    def on_texture(self, direct: Float32Array, size: int) -> Float32Array:
        """Return `indirect_irradiance` on a texture, shape (size, size, 3)."""
        coarse = self.indirect_irradiance(direct)
        filled = dilate_texture(coarse, self._bounce.atlas.covered, steps=2)
        middle = (np.arange(size, dtype=np.float32) + np.float32(0.5)) / np.float32(size)
        u, v = np.meshgrid(middle, middle[::-1])
        uv = np.ascontiguousarray(np.stack([u, v], axis=-1))
        return sample(filled, uv, np.ones((size, size), np.bool_))
