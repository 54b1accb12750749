"""Kernels of `rigsim.light.olat`: rows that face a light, shadow rays, and shading."""

import math
from typing import Final

import numpy as np
from numba import njit, prange

from rigsim.light.surface_brdf import (
    MAX_R_D,
    coated_terms,
    ggx_brdf,
    surface_terms,
    transmittance,
    two_way_transmittance,
)
from rigsim.mitsuba.olat import RAY_OFFSET_MM

ROWS_PER_CHUNK: Final = 1 << 13
"""Rows per thread at a time."""

SKIN_ROWS, MATT_ROWS, METAL_ROWS = 0, 1, 2
"""Kinds of reflection: skin of `rigsim.light.surface_brdf`, Lambertian, GGX facets of a metal."""

UINT16_FULL_SCALE: Final = 65535.0

MAX_FUZZ: Final = 0.01
"""Largest optical depth of vellus hair that a row can store."""

BARE_COLUMNS: Final = 7
"""Columns of a surface without a coating."""

ETA_COLUMN: Final = 9
"""Column of the index of a coating's film."""


@njit(cache=True)  # a few ms at most: starting a second thread would take longer
def sum_rows(pixel, first, red, green, blue, weight, out):  # type: ignore[no-untyped-def]
    """Sum the light of rows into whole pixels, with a weight per channel."""
    for p in range(pixel.shape[0]):
        r = g = b = np.float32(0.0)
        for i in range(first[p], first[p + 1]):
            r += red[i]
            g += green[i]
            b += blue[i]
        out[pixel[p], 0] = weight[0] * r
        out[pixel[p], 1] = weight[1] * g
        out[pixel[p], 2] = weight[2] * b


@njit(cache=True, inline="always")
def _faces(i, position, normal, center):  # type: ignore[no-untyped-def]
    dot = (
        (center[0] - position[i, 0]) * normal[i, 0]
        + (center[1] - position[i, 1]) * normal[i, 1]
        + (center[2] - position[i, 2]) * normal[i, 2]
    )
    return dot > 0.0


@njit(parallel=True, cache=True)
def count_facing(position, normal, center, count):  # type: ignore[no-untyped-def]
    """Count the rows of each chunk that face a light."""
    for chunk in prange(count.shape[0] - 1):
        n = 0
        for i in range(
            chunk * ROWS_PER_CHUNK, min((chunk + 1) * ROWS_PER_CHUNK, position.shape[0])
        ):
            n += _faces(i, position, normal, center)
        count[chunk + 1] = n


@njit(parallel=True, cache=True)
def aim_shadow_rays(  # type: ignore[no-untyped-def]
    position, normal, prim, vertices, faces, center, targets, count, index, start, direction, length
):
    """Aim the shadow rays of rows that face a light, each at its own point of it."""
    for chunk in prange(count.shape[0] - 1):
        at = count[chunk]
        for i in range(
            chunk * ROWS_PER_CHUNK, min((chunk + 1) * ROWS_PER_CHUNK, position.shape[0])
        ):
            if not _faces(i, position, normal, center):
                continue
            k = i % targets.shape[0]
            x, y, z = targets[k, 0], targets[k, 1], targets[k, 2]
            p0, p1, p2 = float(position[i, 0]), float(position[i, 1]), float(position[i, 2])
            a, b, c = faces[prim[i], 0], faces[prim[i], 1], faces[prim[i], 2]
            e0 = float(vertices[b, 0]) - vertices[a, 0]
            e1 = float(vertices[b, 1]) - vertices[a, 1]
            e2 = float(vertices[b, 2]) - vertices[a, 2]
            f0 = float(vertices[c, 0]) - vertices[a, 0]
            f1 = float(vertices[c, 1]) - vertices[a, 1]
            f2 = float(vertices[c, 2]) - vertices[a, 2]
            n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
            norm = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            # Rays start above the triangle, on the light's side if the light is in front.
            lift = RAY_OFFSET_MM / norm if norm > 0.0 else 0.0
            p0, p1, p2 = p0 + lift * n0, p1 + lift * n1, p2 + lift * n2
            w0, w1, w2 = x - p0, y - p1, z - p2
            far = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
            index[at] = i
            start[at, 0], start[at, 1], start[at, 2] = p0, p1, p2
            direction[at, 0], direction[at, 1], direction[at, 2] = w0 / far, w1 / far, w2 / far
            length[at] = 0.999 * far
            at += 1


@njit(parallel=True, cache=True)
def shade_rows(samples, light, visible, glow, diffuse, relief, out):  # type: ignore[no-untyped-def]
    """Add the light of rows toward a camera under one light.

    Parameters
    ----------
    samples
        Position in mm, normal, surface, position of the camera and kind of the rows.
    light
        Center of the light in mm, its axis, and the exponent of its lobe.
    visible, glow, diffuse, relief, out
        As in `rigsim.light.olat.shade_rows`; ``glow`` and ``relief`` without rows are ignored.
    """
    position, normal, surface, camera, kind = samples
    center, axis, exponent = light
    has_glow = glow.shape[0] > 0
    for i in prange(position.shape[0]):
        if not visible[i] and not has_glow:
            continue
        n0, n1, n2 = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        norm = 1.0 / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        n0, n1, n2 = n0 * norm, n1 * norm, n2 * norm
        p0, p1, p2 = float(position[i, 0]), float(position[i, 1]), float(position[i, 2])
        v0, v1, v2 = camera[0] - p0, camera[1] - p1, camera[2] - p2
        norm = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        v0, v1, v2 = v0 * norm, v1 * norm, v2 * norm
        nv = min(n0 * v0 + n1 * v1 + n2 * v2, 1.0)
        if nv <= 0.0:
            continue
        if has_glow:
            leaving = transmittance(nv)
            out[0, i] += leaving * glow[i, 0]
            out[1, i] += leaving * glow[i, 1]
            out[2, i] += leaving * glow[i, 2]
        if not visible[i]:
            continue
        l0, l1, l2 = center[0] - p0, center[1] - p1, center[2] - p2
        squared = l0 * l0 + l1 * l1 + l2 * l2
        norm = 1.0 / math.sqrt(squared)
        l0, l1, l2 = l0 * norm, l1 * norm, l2 * norm
        nl = min(n0 * l0 + n1 * l1 + n2 * l2, 1.0)
        if nl <= 0.0:
            continue
        strength = nl / squared
        off = -(axis[0] * l0 + axis[1] * l1 + axis[2] * l2)
        if off <= 0.0:
            continue
        strength *= off**exponent
        if relief.shape[0] > 0:
            strength *= relief[i]
        s0, s1, s2 = (
            surface[i, 0] / UINT16_FULL_SCALE,
            surface[i, 1] / UINT16_FULL_SCALE,
            surface[i, 2] / UINT16_FULL_SCALE,
        )
        r0, r1, r2 = MAX_R_D * s0 * s0, MAX_R_D * s1 * s1, MAX_R_D * s2 * s2
        if kind == MATT_ROWS:
            out[0, i] += strength * r0
            out[1, i] += strength * r1
            out[2, i] += strength * r2
            continue
        h0, h1, h2 = l0 + v0, l1 + v1, l2 + v2
        length = math.sqrt(h0 * h0 + h1 * h1 + h2 * h2)
        nh = min((nl + nv) / length, 1.0)
        rough = surface[i, 3] / UINT16_FULL_SCALE
        if kind == METAL_ROWS:
            lobe = math.pi * strength * ggx_brdf(nl, nv, nh, rough)
            out[0, i] += lobe * r0
            out[1, i] += lobe * r1
            out[2, i] += lobe * r2
            continue
        oil, fuzz, bare = (
            surface[i, 4] / UINT16_FULL_SCALE,
            surface[i, 5] / UINT16_FULL_SCALE,
            surface[i, 6] / UINT16_FULL_SCALE,
        )
        if surface.shape[1] > BARE_COLUMNS:
            lobe = coated_terms(
                nl,
                nv,
                nh,
                0.5 * length,
                rough,
                oil,
                MAX_FUZZ * fuzz,
                surface[i, 7] / UINT16_FULL_SCALE,
                surface[i, 8] / UINT16_FULL_SCALE,
                1.0 + surface[i, 9] / UINT16_FULL_SCALE,
                surface[i, 10] / UINT16_FULL_SCALE,
            )
        else:
            lobe = surface_terms(nl, nv, nh, 0.5 * length, rough, oil, MAX_FUZZ * fuzz)
        gloss = math.pi * strength * bare * lobe
        inside = strength * two_way_transmittance(nl, nv) if diffuse else 0.0
        out[0, i] += gloss + inside * r0
        out[1, i] += gloss + inside * r1
        out[2, i] += gloss + inside * r2
