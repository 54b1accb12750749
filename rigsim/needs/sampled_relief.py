"""Sample the shadows of a face's relief before anything is rendered."""

import math
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.needs.effects import PixelNoise
from rigsim.needs.sampled_light import LitFace, TexelIndex, visible_fractions
from rigsim.render import Caster

RELIEF_EVALUATIONS: Final = 500_000
"""Texels times lamps whose relief shadows are evaluated without the shadows of the mesh."""

RELIEF_PIXELS: Final = 400
"""Pixels of an image that are evaluated with the shadows of the mesh."""

MAX_PIXEL_TEXELS: Final = 6
"""Texels along each side of such a pixel."""

RELIEF_MARGIN: Final = 3.3
"""Factor on the size, for pixels between the evaluated texels and for highlights; set on 16 scenes
of the flash rig and on an expression in the dome."""


def relief_shadows_over_noise(
    face: LitFace, caster: Caster, relief: ReliefShadow, noise: PixelNoise, pixel_mm: float
) -> float:
    """Return the largest change of a pixel by shadows of a face's relief, over its noise.

    Parameters
    ----------
    face, caster
        The face in its pose under the lamps, and its mesh.
    relief
        Its horizons.
    noise
        Noise of the sensor.
    pixel_mm
        Side of a pixel on the subject, mm.

    Notes
    -----
    Each image is evaluated on a grid of texels as if the mesh cast no shadow. The texels with the
    largest changes are evaluated again, as pixels and with the shadows of the mesh, until no
    other image can change more.
    """
    atlas, images = face.skin.subject.atlas, face.light.images
    lamps = sum(len(one) for one in images)
    step = math.ceil(math.sqrt(atlas.covered.sum() * lamps / RELIEF_EVALUATIONS))
    coarse = np.arange(0, atlas.size, step) * len(face.light.facing) // atlas.size
    facing = face.light.facing[np.ix_(coarse, coarse)] * atlas.covered[::step, ::step]
    row, column = (step * at for at in np.nonzero(facing))
    facing = facing[facing > 0.0]
    if not len(row):
        return 0.0
    # a texel is interpolated with its neighbors
    side = min(1 + round(pixel_mm / atlas.typical_texel_mm()), MAX_PIXEL_TEXELS)
    around = np.arange(side) - side // 2
    bounds, most = [], 0.0
    for k in range(len(images)):
        change = _changes(face, relief, (row, column), facing, k, noise)
        first = np.argpartition(change, -min(RELIEF_PIXELS, len(change)))[-RELIEF_PIXELS:]
        bounds.append((float(change.max(initial=0.0)), k, first))
    for bound, k, first in sorted(bounds, key=lambda one: -one[0]):
        if bound <= most:
            break
        pixels = (
            np.clip(part, 0, atlas.size - 1)
            for part in np.broadcast_arrays(
                row[first][:, None, None] + around[:, None], column[first][:, None, None] + around
            )
        )
        rows, columns = (part.reshape(len(first), -1) for part in pixels)
        change = _changes(face, relief, (rows, columns), facing[first], k, noise, caster)
        most = max(most, float(change.max(initial=0.0)))
    return RELIEF_MARGIN * most


def _changes(
    face: LitFace,
    relief: ReliefShadow,
    texels: TexelIndex,
    facing: Float32Array,
    image: int,
    noise: PixelNoise,
    caster: Caster | None = None,
) -> Float64Array:
    """Return the changes of pixels of an image over their noise, shape (n,).

    ``texels`` has rows and columns of shape (n,), or (n, m) for pixels of m texels. ``facing`` has
    the cosines to the camera, (n,): they cover that part of a pixel. ``caster`` has the mesh that
    casts shadows; None: it casts none.
    """
    subject, (row, column) = face.skin.subject, texels
    atlas, lamps, size = subject.atlas, face.light.images[image], subject.atlas.size
    position, mesh_normal, normal = (
        part[row, column].reshape(-1, 3)
        for part in (atlas.position_mm, atlas.normal, subject.normal)
    )
    places = np.stack([(column + 0.5) / size, 1.0 - (row + 0.5) / size], axis=-1)
    uv = places.reshape(-1, 2).astype(np.float32)
    seen = np.ones((len(lamps), 1), np.float32)
    if caster is not None:
        seen = visible_fractions(caster, position, mesh_normal, lamps)
    lost, left = np.zeros(len(position)), np.zeros(len(position))
    for lamp, part in zip(lamps, seen, strict=True):
        way, falloff = lamp.direction_and_falloff(position)
        cosine = np.maximum(np.einsum("ij,ij->i", way, normal), 0.0)
        light = np.float32(lamp.weight_mm2) * falloff * cosine * part
        shown = relief.visible_fraction(uv, position, lamp.position_mm, radius_mm=lamp.radius_mm)
        lost += light * (1.0 - shown)
        left += light * shown
    unit = face.white[image] * face.reflectance[row, column].reshape(-1, 3)
    lost, left = (
        (part[:, None] * unit).reshape(len(row), -1, 3).mean(axis=1) for part in (lost, left)
    )
    lost *= facing[:, None]
    return np.asarray((np.minimum(lost, 1.0) / noise.sigma(left)).max(axis=1))
