"""Generate a seeded, face-like head: blended solids, sampled by rays on a regular texture grid.

The head is the zero set of a signed distance bound of ellipsoids and capsules joined by
smooth minima, so that its shape and its normals are smooth and independent of a mesh. Eyes are
closed. Dimensions are near the means of adults in
Young 1993 (head and face anthropometry, DOT/FAA/AM-93/10).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit, prange

from rigsim.arrays import Float64Array, FloatArray
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.package_data import package_table

Point = tuple[float, float, float]

MAX_PHI_RAD: Final = 2.0
"""Half of the angle about the vertical axis that the texture covers."""
CENTER_LINEAR_FRACTION: Final = 0.6
"""Fraction of `MAX_PHI_RAD` per unit of u at the center; the rest grows with the third power."""
AXIS_Z_MM: Final = -70.0
"""Depth of the vertical axis that is the origin of the rays."""
Y_RANGE_MM: Final = (-125.0, 45.0)
"""Heights of horizontal rays; above, rays fan out over the crown."""
CROWN_ANGLE_RAD: Final = 1.4
GROOVE_DEPTH_MM: Final = -25.0
"""Grooves drawn from the front are omitted behind this z."""
LIP_HALF_WIDTH_MM: Final = 25.0
SHAPE_DEVIATION: Final = 0.045
"""Relative standard deviation of the solids' sizes between seeds."""

LANDMARKS_MM: Final[Mapping[str, Point]] = package_table("face")["landmarks_mm"]
"""Points of the mean head in mm, rig frame; left and right as in the image."""


@dataclass(frozen=True, slots=True)
class _Solid:
    """An ellipsoid (a, radii) or a capsule with two radii (a to b)."""

    a: Point
    radii: Point = (0.0, 0.0, 0.0)
    b: Point = (0.0, 0.0, 0.0)
    ends: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Part:
    """Solids with sharp unions among themselves and a smooth union with the preceding parts."""

    solids: tuple[_Solid, ...]
    blend_mm: float
    carve: bool = False


@dataclass(frozen=True, slots=True)
class _Groove:
    """A groove (or, with negative depth, a ridge) along a line in the front view."""

    line: tuple[tuple[float, float], ...]
    depth_mm: float
    width_mm: float


def build_head(rng: np.random.Generator | None, *, columns: int = 168, rows: int = 178) -> Mesh:
    """Return a head mesh with a regular texture grid.

    Parameters
    ----------
    rng
        Source of the shape's deviations from the mean; None: the mean head.
    columns, rows
        Quads along u and v; each yields two triangles.

    Returns
    -------
    Mesh
        About 2 columns rows triangles in mm; u increases along +x, v along +y.
    """
    model = _pack(*_anatomy(rng))
    u = np.linspace(0.0, 1.0, columns + 1)
    v = np.linspace(0.0, 1.0, rows + 1)
    start, way = _rays(u[None, :], v[:, None])
    points, normals = _march_rays(start.reshape(-1, 3), way.reshape(-1, 3), *model)
    uv = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)
    at = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate(
        [np.stack([a, b, d], axis=-1).reshape(-1, 3), np.stack([a, d, c], axis=-1).reshape(-1, 3)]
    )
    return build_mesh(points, faces, uv.reshape(-1, 2), normals)


def _rays(u: Float64Array, v: Float64Array) -> tuple[Float64Array, Float64Array]:
    s = 2.0 * u - 1.0
    phi = MAX_PHI_RAD * (CENTER_LINEAR_FRACTION * s + (1.0 - CENTER_LINEAR_FRACTION) * s**3)
    low, high = Y_RANGE_MM
    # The last part of v fans out over the crown; the speed along the surface stays uniform.
    bend = 0.77
    y = low + (high - low) * np.minimum(v / bend, 1.0)
    lift = CROWN_ANGLE_RAD * np.maximum(v - bend, 0.0) / (1.0 - bend)
    phi, y, lift = np.broadcast_arrays(phi, y, lift)
    start = np.stack([np.zeros_like(y), y, np.full_like(y, AXIS_Z_MM)], axis=-1)
    way = np.stack([np.sin(phi) * np.cos(lift), np.sin(lift), np.cos(phi) * np.cos(lift)], axis=-1)
    return start, way


def _anatomy(rng: np.random.Generator | None) -> tuple[list[_Part], list[_Groove]]:
    def s(scale: float = 1.0) -> float:
        """Draw a factor near 1, within two and a half standard deviations."""
        if rng is None:
            return 1.0
        return float(1.0 + scale * SHAPE_DEVIATION * np.clip(rng.standard_normal(), -2.5, 2.5))

    def ball(center: Point, radii: Point) -> _Solid:
        return _Solid(center, radii)

    def one(solid: _Solid, blend_mm: float) -> _Part:
        return _Part((solid,), blend_mm)

    def pair(solid: _Solid, blend_mm: float, *, carve: bool = False) -> _Part:
        return _Part((solid, _flipped(solid)), blend_mm, carve)

    width, jaw, nose, lips, brow, cheek, eye = s(0.6), s(), s(1.3), s(1.5), s(1.5), s(), s(0.6)
    tip, wing, chin, bridge = s(1.5), s(1.2), s(1.2), s(1.5)
    parts = [
        one(ball((0.0, 46.0, -92.0), (73.0 * width, 84.0, 99.0)), 1.0),
        one(ball((0.0, -1.0, -62.0), (61.0 * width, 72.0, 63.0)), 26.0),
        one(ball((0.0, -42.0, -50.0), (47.0 * jaw, 37.0, 48.0)), 20.0),
        one(_Solid((0.0, -50.0, -88.0), b=(0.0, -200.0, -100.0), ends=(49.0, 55.0)), 12.0),
        one(ball((0.0, -64.0, -12.0), (19.0 * chin, 15.0, 17.5 * chin)), 18.0),
        pair(ball((45.0 * width, 5.0, -32.0), (19.0, 15.0 * cheek, 22.0)), 24.0),
        pair(ball((36.0, -24.0, -30.0), (18.0, 24.0, 23.0 * cheek)), 22.0),
        one(ball((0.0, -38.0, -18.0), (27.0, 24.0, 23.0)), 18.0),
        pair(_Solid((8.0, 39.5, -6.0), b=(41.0, 43.0, -21.0), ends=(9.5 * brow, 8.5 * brow)), 14.0),
        pair(ball((31.0, 25.0, 11.0), (19.0 * eye, 13.0, 19.5)), 12.0, carve=True),
        pair(ball((31.5, 24.0, -20.5), (16.5 * eye, 12.5 * eye, 15.0)), 6.0),
        one(_Solid((0.0, 34.0, -7.0), b=(0.0, 2.0, 8.5 * nose), ends=(6.5 * bridge, 7.0)), 15.0),
        one(ball((0.0, -7.0, 12.5 * nose), (9.0 * tip, 8.8, 11.0 * tip)), 11.0),
        pair(ball((10.0 * wing, -12.5, 5.0), (5.8 * wing, 6.0, 9.0)), 7.0),
        one(_Solid((0.0, -15.5, 16.0), b=(0.0, -19.0, 8.0), ends=(3.5, 3.5)), 5.0),
        pair(ball((5.6 * wing, -18.5, 13.0), (2.9, 2.6, 5.0)), 3.0, carve=True),
    ]
    for line, thick in _lip_arcs(np.linspace(-1.0, 1.0, 15)):
        rods = tuple(
            _Solid(
                _point(line[k]),
                b=_point(line[k + 1]),
                ends=(float(lips * thick[k]), float(lips * thick[k + 1])),
            )
            for k in range(len(line) - 1)
        )
        parts.append(_Part(rods, 3.0))
    parts.append(pair(ball((71.0 * width, 12.0, -86.0), (8.0, 25.0, 11.0)), 24.0))

    lid = [(x, 17.2 + 0.011 * (x - 31.0) ** 2) for x in np.linspace(15.5, 47.0, 9)]
    fold = [(x, 32.5 - 0.014 * (x - 31.0) ** 2) for x in np.linspace(18.0, 45.0, 9)]
    bag = [(x, 11.5 + 0.008 * (x - 30.0) ** 2) for x in np.linspace(17.0, 42.0, 7)]
    smile = [(16.5, -10.0), (21.0, -20.0), (26.5, -30.0), (31.0, -40.0)]
    wing_line = [(17.0, -8.0), (17.5, -13.0), (14.0, -18.5)]
    mouth = [
        (float(x), -42.6 + 0.8 * float(np.cos(x / 4.5)) - 0.0016 * float(x * x))
        for x in np.linspace(-27.0, 27.0, 19)
    ]
    edge = [(x, 19.6 + 0.011 * (x - 31.0) ** 2) for x in np.linspace(16.5, 46.0, 9)]
    grooves = [
        _Groove(tuple(mouth), 2.4, 1.7),
        _Groove(((0.0, -22.0), (0.0, -33.0)), 0.8, 3.0),
        _Groove(((-12.0, -56.5), (0.0, -55.5), (12.0, -56.5)), 1.5, 5.0),
    ]
    for line_xy, depth_mm, width_mm in (
        (lid, 1.4, 1.5),
        (edge, -0.4, 1.6),
        (fold, 0.9, 1.8),
        (bag, 0.5, 3.0),
        (smile, 0.7, 3.6),
        (wing_line, 0.9, 2.0),
    ):
        grooves.append(_Groove(tuple(line_xy), depth_mm, width_mm))
        grooves.append(_Groove(tuple((-x, y) for x, y in line_xy), depth_mm, width_mm))
    return parts, grooves


def lip_outline(x_mm: FloatArray) -> tuple[Float64Array, Float64Array]:
    """Return the heights of the upper and lower border of the lips on the mean head.

    Parameters
    ----------
    x_mm
        Positions across the face in mm, any shape.

    Returns
    -------
    top, bottom : ndarray
        Heights y in mm; beyond the corners of the mouth top is below bottom.
    """
    across = np.asarray(x_mm, np.float64) / LIP_HALF_WIDTH_MM
    (upper, above), (lower, below) = _lip_arcs(np.clip(across, -1.0, 1.0))
    beyond = 40.0 * np.maximum(np.abs(across) - 1.0, 0.0)
    return upper[..., 1] + 0.8 * above - beyond, lower[..., 1] - 0.75 * below + beyond


def _lip_arcs(across: Float64Array) -> tuple[tuple[Float64Array, Float64Array], ...]:
    """Return center line and half thickness of both lips, across the mouth from -1 to 1."""
    bow = np.exp(-((np.abs(across) - 0.28) ** 2) / 0.045)
    full = np.maximum(1.0 - across**2, 0.0) ** 0.6
    depth = 13.5 * np.abs(across) ** 2.3
    corner = -1.0 * np.abs(across) ** 3
    x = LIP_HALF_WIDTH_MM * across
    upper = np.stack([x, -41.4 + 2.6 * full + 1.6 * bow + corner, 4.8 - depth], axis=-1)
    lower = np.stack([0.96 * x, -43.0 - 5.4 * full + corner, 3.6 - depth], axis=-1)
    return (upper, 1.0 + 3.4 * full), (lower, 1.0 + 4.6 * full)


def _point(row: Float64Array) -> Point:
    return (float(row[0]), float(row[1]), float(row[2]))


def _flipped(solid: _Solid) -> _Solid:
    def flip(p: Point) -> Point:
        return (-p[0], p[1], p[2])

    return _Solid(flip(solid.a), solid.radii, flip(solid.b), solid.ends)


def _pack(
    parts: list[_Part], grooves: list[_Groove]
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Return the anatomy as arrays: solids, parts, segments of grooves, grooves.

    A part's row contains blend, carve, first and last solid, center and radius of its bounding
    ball; a groove's row contains depth, width, first and last segment, and the box outside which it
    is flat.
    """
    solids: list[tuple[float, ...]] = []
    segments: list[tuple[float, ...]] = []
    part_rows: list[tuple[float, ...]] = []
    groove_rows: list[tuple[float, ...]] = []
    for part in parts:
        first = len(solids)
        solids += [(*one.a, *one.b, *one.radii, *one.ends) for one in part.solids]
        ends = [(one.a, max(*one.radii, *one.ends)) for one in part.solids]
        ends += [(one.b, max(one.ends)) for one in part.solids if one.radii[0] == 0.0]
        points = np.array([point for point, _ in ends])
        center = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = max(
            float(np.linalg.norm(point - center)) + reach
            for point, (_, reach) in zip(points, ends, strict=True)
        )
        row = (part.blend_mm, float(part.carve), float(first), float(len(solids)))
        part_rows.append((*row, *center, radius))
    for groove in grooves:
        first = len(segments)
        line = np.array(groove.line)
        segments += [(*line[k], *line[k + 1]) for k in range(len(line) - 1)]
        # Beyond 3.5 widths a groove is shallower than a nanometer.
        low, high = (
            line.min(axis=0) - 3.5 * groove.width_mm,
            line.max(axis=0) + 3.5 * groove.width_mm,
        )
        row = (groove.depth_mm, groove.width_mm, float(first), float(len(segments)))
        groove_rows.append((*row, *low, *high))
    return np.array(solids), np.array(part_rows), np.array(segments), np.array(groove_rows)


@njit(cache=True)
def _solid_distance(x, y, z, s):  # type: ignore[no-untyped-def]
    px, py, pz = x - s[0], y - s[1], z - s[2]
    if s[6] > 0.0:
        # First-order distance to the level set k0 = 1: (k0 - 1) over its gradient's length k1 / k0.
        k0 = math.sqrt((px / s[6]) ** 2 + (py / s[7]) ** 2 + (pz / s[8]) ** 2)
        k1 = math.sqrt((px / s[6] ** 2) ** 2 + (py / s[7] ** 2) ** 2 + (pz / s[8] ** 2) ** 2)
        # At the center k1 = 0; the nearest surface is at the shortest radius.
        return k0 * (k0 - 1.0) / k1 if k1 > 1e-12 else -min(s[6], s[7], s[8])
    ax, ay, az = s[3] - s[0], s[4] - s[1], s[5] - s[2]
    t = (px * ax + py * ay + pz * az) / (ax * ax + ay * ay + az * az)
    t = min(max(t, 0.0), 1.0)
    d = math.sqrt((px - t * ax) ** 2 + (py - t * ay) ** 2 + (pz - t * az) ** 2)
    return d - (s[9] + t * (s[10] - s[9]))


@njit(cache=True)
def _distance(x, y, z, solids, parts, segments, grooves):  # type: ignore[no-untyped-def]
    """Return a bound of the signed distance in mm, negative inside."""
    total = 1e9
    for p in range(parts.shape[0]):
        k, carve = parts[p, 0], parts[p, 1] > 0.0
        away = math.sqrt((x - parts[p, 4]) ** 2 + (y - parts[p, 5]) ** 2 + (z - parts[p, 6]) ** 2)
        # Distant parts have no effect; 2 mm of margin, since bounds are not exact distances.
        beyond = 0.7 * (away - parts[p, 7]) - k - 2.0
        if p > 0 and (beyond > -total if carve else beyond > total):
            continue
        own = 1e9
        for i in range(int(parts[p, 2]), int(parts[p, 3])):
            own = min(own, _solid_distance(x, y, z, solids[i]))
        # Polynomial smooth minimum min(a, b) - k h^2 / 4 with h = max(k - |a - b|, 0) / k; carved
        # parts are a smooth maximum with their complement.
        if p == 0:
            total = own
        elif carve:
            h = max(k - abs(total + own), 0.0) / k
            total = max(total, -own) + 0.25 * k * h * h
        else:
            h = max(k - abs(total - own), 0.0) / k
            total = min(total, own) - 0.25 * k * h * h
    # Grooves apply where the face looks to the front.
    if z > GROOVE_DEPTH_MM:
        fade = min((z - GROOVE_DEPTH_MM) / 10.0, 1.0)
        for q in range(grooves.shape[0]):
            g = grooves[q]
            if x < g[4] or y < g[5] or x > g[6] or y > g[7]:
                continue
            nearest = 1e9
            for j in range(int(g[2]), int(g[3])):
                s = segments[j]
                ax, ay = s[2] - s[0], s[3] - s[1]
                t = ((x - s[0]) * ax + (y - s[1]) * ay) / (ax * ax + ay * ay)
                t = min(max(t, 0.0), 1.0)
                nearest = min(nearest, (x - s[0] - t * ax) ** 2 + (y - s[1] - t * ay) ** 2)
            total += fade * g[0] * math.exp(-nearest / (g[1] * g[1]))
    return total


@njit(parallel=True, cache=True)
def _march_rays(start, way, solids, parts, segments, grooves):  # type: ignore[no-untyped-def]
    """March each ray inwards to the outermost surface point; return points and normals."""
    points, normals = np.empty_like(start), np.empty_like(start)
    step = 0.1
    for i in prange(start.shape[0]):
        t = 220.0
        for _ in range(400):
            x, y = start[i, 0] + t * way[i, 0], start[i, 1] + t * way[i, 1]
            z = start[i, 2] + t * way[i, 2]
            d = _distance(x, y, z, solids, parts, segments, grooves)
            if abs(d) < 1e-4 or t < 5.0:
                break
            t -= 0.6 * d
        x, y = start[i, 0] + t * way[i, 0], start[i, 1] + t * way[i, 1]
        z = start[i, 2] + t * way[i, 2]
        gx = _distance(x + step, y, z, solids, parts, segments, grooves)
        gx -= _distance(x - step, y, z, solids, parts, segments, grooves)
        gy = _distance(x, y + step, z, solids, parts, segments, grooves)
        gy -= _distance(x, y - step, z, solids, parts, segments, grooves)
        gz = _distance(x, y, z + step, solids, parts, segments, grooves)
        gz -= _distance(x, y, z - step, solids, parts, segments, grooves)
        length = math.sqrt(gx * gx + gy * gy + gz * gz)
        points[i, 0], points[i, 1], points[i, 2] = x, y, z
        normals[i, 0], normals[i, 1], normals[i, 2] = gx / length, gy / length, gz / length
    return points, normals
