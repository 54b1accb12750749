"""Sample the shadows of a face's relief before anything is rendered."""

import math
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.light.relief_shadow import HORIZON_SOFTNESS_RAD, ReliefShadow
from rigsim.needs.effects import PixelNoise
from rigsim.needs.sampled_light import SHADOW_SAMPLES, TEXEL_STEP, SampledLight
from rigsim.render import Caster, visibility
from rigsim.subject import SimulatedSubject

RELIEF_PIXELS: Final = 500
"""Number of pixels whose relief shadows are evaluated."""

HORIZON_MARGIN: Final = 0.5
GRAZING_MARGIN: Final = 2.6
"""Factors on shadows of high horizons and of grazing light, set on the same scenes as the margins
of `rigsim.needs.face`."""

MAX_PIXEL_TEXELS: Final = 6
"""Texels along each side of such a pixel."""


def relief_shadows_over_noise(
    subject: SimulatedSubject,
    caster: Caster,
    relief: ReliefShadow,
    light: SampledLight,
    reflectance: Float32Array,
    white: Float64Array,
    noise: PixelNoise,
    pixel_mm: float,
) -> float:
    """Return the largest change of a pixel by shadows of a face's relief, over its noise.

    Parameters
    ----------
    subject, caster
        The face in its pose, and its mesh.
    relief
        Its horizons.
    light
        The lamps.
    reflectance
        The face's reflectance, shape (N, N, 3).
    white
        Signal of a white plate under an irradiance of 1, full scales, shape (K, 3).
    noise
        Noise of the sensor.
    pixel_mm
        Side of a pixel on the subject, mm.

    Notes
    -----
    Pixels around the visible texels with the highest horizons are evaluated. Elsewhere the shadows
    are soft where light grazes: an elevation e below the half width s of a shadow's edge loses
    sin e (1/2 - e / (2 s)), at most s / 8.
    """
    atlas = subject.atlas
    step = light.part[0].step
    coarse = np.minimum(np.arange(atlas.size) // step, len(light.visible) - 1)
    is_visible = atlas.covered & light.visible[np.ix_(coarse, coarse)]
    row, column = relief.highest_horizons(is_visible, RELIEF_PIXELS)
    if not len(row):
        return 0.0
    side = max(1, min(round(pixel_mm / atlas.typical_texel_mm()), MAX_PIXEL_TEXELS))
    around = np.arange(side) - side // 2
    row = row[:, None, None] + around[:, None] + np.zeros_like(around)
    column = column[:, None, None] + np.zeros_like(around)[:, None] + around
    row, column = (np.clip(part, 0, atlas.size - 1).reshape(-1) for part in (row, column))
    position, normal = atlas.position_mm[row, column], atlas.normal[row, column]
    uv = np.stack([(column + 0.5) / atlas.size, 1.0 - (row + 0.5) / atlas.size], axis=-1)
    most = 0.0
    albedo = reflectance[row, column]
    largest = reflectance[is_visible][::TEXEL_STEP].max(axis=0)
    for lamps, one in zip(light.images, white, strict=True):
        full, left, grazing = (np.zeros(len(part)) for part in (row, row, lamps))
        for k, lamp in enumerate(lamps):
            radius = lamp.radius_mm
            way = np.asarray(lamp.position_mm) - position
            squared = np.einsum("ij,ij->i", way, way)
            cosine = np.einsum("ij,ij->i", way, normal) / np.sqrt(squared)
            seen = visibility(
                caster, position, normal, lamp.position_mm, radius_mm=radius, samples=SHADOW_SAMPLES
            )
            came = lamp.weight_mm2 / squared * np.maximum(cosine, 0.0) * seen
            full += came
            left += came * relief.visible_fraction(
                uv.astype(np.float32), position, lamp.position_mm, radius_mm=radius
            )
            nearest = float(squared.min())
            soft = max(lamp.radius_mm / math.sqrt(nearest), HORIZON_SOFTNESS_RAD)
            grazing[k] = lamp.weight_mm2 / nearest * soft / 8.0
        lost, rest = (
            one * (part[:, None] * albedo).reshape(-1, side**2, 3).mean(axis=1)
            for part in (full - left, left)
        )
        change = np.minimum(lost, 1.0) / noise.sigma(rest)
        faint = np.minimum(float(grazing.max()) * one * largest, 1.0)
        dim = float((faint / noise.sigma(faint)).max())
        most = max(most, HORIZON_MARGIN * float(change.max()), GRAZING_MARGIN * dim)
    return most
