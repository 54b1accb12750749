"""Draw brows, lashes and hair of the scalp as curves, seeded for each person.

Hair is not skin: no map of the skin has it, and it leaves the skin's mesh as it is. A curve has
`CURVE_POINTS` points from the root to the tip and follows the mesh's vertex at its root.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array, Int64Array
from rigsim.face_parts.eyelids import Eyelids, build_eyelids
from rigsim.geometry.mesh import Mesh

CURVE_POINTS: Final = 5
"""Points of each curve."""
HAIR_KINDS: Final = ("brow", "lash", "scalp")

EUMELANIN_PER_RADIUS: Final = (0.419, 0.697, 1.37)
"""Absorption of eumelanin in red, green and blue per unit of concentration, 1 over the fiber's
radius; d'Eon et al. 2011, as used by Chiang et al. 2016 (doi 10.1111/cgf.12830)."""
PHEOMELANIN_PER_RADIUS: Final = (0.187, 0.4, 1.05)
"""Absorption of pheomelanin, same source and unit."""
_EUMELANIN: Final = {
    "palest": (0.15, 0.4),
    "I": (0.25, 0.8),
    "II": (0.5, 1.4),
    "III": (1.1, 2.6),
    "IV": (2.5, 5.0),
    "V": (5.0, 8.0),
    "VI": (7.0, 9.0),
    "darkest": (8.0, 10.0),
}
"""Range of eumelanin by preset of the skin; Chiang et al. 2016: 0.3 blond, 1.3 brown, 8 black."""
_PHEOMELANIN: Final = {"palest": (0.1, 0.9), "I": (0.1, 0.9), "II": (0.1, 0.4)}
"""Range of pheomelanin; other presets have 0.05."""
_IRIS_EUMELANIN: Final = {
    "palest": (0.0, 0.1),
    "I": (0.0, 0.25),
    "II": (0.0, 0.5),
    "III": (0.25, 0.8),
}
"""Range of the iris' melanin from 0 (blue) to 1 (dark brown); others have 0.85 to 1."""

BROW_HAIRS: Final = 230
UPPER_LASHES: Final = 90
LOWER_LASHES: Final = 45
"""Number of hairs per brow and lashes per lid; people have 90 to 160 and 75 to 80."""
SCALP_LOCKS: Final = 4200
"""Number of locks on the scalp; a lock represents about 20 hairs."""
WIDTH_MM: Final = {"brow": 0.16, "lash": 0.13, "scalp": 1.0}
"""Width of a curve at its root: a brow hair, a lash, a lock."""


@dataclass(frozen=True, slots=True, eq=False)
class Hair:
    """Hair of one person.

    Attributes
    ----------
    points_mm
        Curves with closed eyes, shape (S, `CURVE_POINTS`, 3), rig frame: brows, lashes, scalp.
    opening_mm
        Displacement of the lashes relative to their roots when the eyes are open, shape
        (L, `CURVE_POINTS`, 3).
    roots
        Vertex of the mesh that each curve follows, shape (S,).
    counts
        Number of curves of each of `HAIR_KINDS`.
    coverage
        Fraction of the skin that the scalp's hair and brows cover at each vertex of the mesh,
        shape (V, 2).
    eumelanin, pheomelanin
        Concentrations, in units of `EUMELANIN_PER_RADIUS`.
    iris_melanin
        Melanin of the iris from 0 (blue) to 1 (dark brown).
    """

    points_mm: Float32Array
    opening_mm: Float32Array
    roots: Int64Array
    counts: tuple[int, int, int]
    coverage: Float32Array
    eumelanin: float
    pheomelanin: float
    iris_melanin: float

    def absorption_per_radius(self) -> Float64Array:
        """Return the absorption in red, green and blue, 1 over the fiber's radius, shape (3,)."""
        eumelanin = self.eumelanin * np.array(EUMELANIN_PER_RADIUS)
        return np.asarray(eumelanin + self.pheomelanin * np.array(PHEOMELANIN_PER_RADIUS))


def draw_hair(
    mesh: Mesh, preset: str, *, seed: int, lids: tuple[Eyelids, Eyelids] | None = None
) -> Hair:
    """Draw the hair of a person.

    Parameters
    ----------
    mesh
        Head at rest, mm, frame of the mean head.
    preset
        One of `rigsim.subject.PRESET_NAMES`; it sets the range of the melanins.
    seed
        Seed of the person, >= 0.
    lids
        Lids of both eyes on the mesh; None: those of the grid of
        `rigsim.subject.head.build_head`.

    Returns
    -------
    Hair
        Without a lock on the scalp if the mesh ends below the hairline.

    Raises
    ------
    rigsim.face_parts.eyelids.EyelidError
        Without lids, the mesh is another one.
    KeyError
        The preset is unknown.
    """
    rng = np.random.default_rng([seed, 40])
    lids = build_eyelids(mesh) if lids is None else lids
    eumelanin = rng.uniform(*_EUMELANIN[preset])
    pheomelanin = rng.uniform(*_PHEOMELANIN.get(preset, (0.05, 0.05)))
    iris = rng.uniform(*_IRIS_EUMELANIN.get(preset, (0.85, 1.0)))
    brows = [_brow(mesh, side, rng) for side in (1.0, -1.0)]
    lashes = [_lashes(mesh, one, rng) for one in lids]
    scalp, scalp_roots = _scalp(mesh, rng)
    points = [*(p for p, _ in brows), *(p for p, _, _ in lashes), scalp]
    roots = [*(r for _, r in brows), *(r for _, _, r in lashes), scalp_roots]
    counts = 2 * BROW_HAIRS, 2 * (UPPER_LASHES + LOWER_LASHES), len(scalp)
    return Hair(
        np.concatenate(points).astype(np.float32),
        np.concatenate([o for _, o, _ in lashes]).astype(np.float32),
        np.concatenate(roots),
        counts,
        _coverage(mesh),
        float(eumelanin),
        float(pheomelanin),
        float(iris),
    )


def _along() -> Float64Array:
    return np.linspace(0.0, 1.0, CURVE_POINTS)[:, None]


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _brow_line(x: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return height and half width of a brow at distances from the middle of the face, mm."""
    share = np.clip((x - 13.0) / 38.0, 0.0, 1.0)
    center = 38.6 + 6.6 * np.sin(0.5 * np.pi * np.minimum(share / 0.66, 1.0))
    center -= 5.2 * np.maximum((share - 0.66) / 0.34, 0.0) ** 1.3
    return center, 3.3 * (1.0 - 0.72 * share)


def _brow(mesh: Mesh, side: float, rng: np.random.Generator) -> tuple[Float64Array, Int64Array]:
    share = rng.uniform(0.0, 1.0, BROW_HAIRS) ** 0.9
    x = 13.0 + 38.0 * share
    center, half = _brow_line(x)
    offset = np.clip(0.55 * rng.standard_normal(BROW_HAIRS), -1.0, 1.0)
    y = center + half * offset
    vertices = mesh.vertices_mm.astype(np.float64) * (side, 1.0, 1.0)
    front = np.flatnonzero((vertices[:, 2] > -55.0) & (vertices[:, 0] > 0.0))
    off = vertices[front, None, :2] - np.stack([x, y], axis=-1)
    roots = front[np.argmin(np.sum(off**2, axis=-1), axis=0)]
    normal = mesh.normals[roots].astype(np.float64) * (side, 1.0, 1.0)
    # z on the tangent plane of the nearest vertex
    at = vertices[roots]
    z = at[:, 2] - ((x - at[:, 0]) * normal[:, 0] + (y - at[:, 1]) * normal[:, 1]) / normal[:, 2]
    root = np.stack([x, y, z], axis=-1)
    # upwards at the inner end, along the brow outside, the upper rows downwards
    angle = np.radians(78.0) * (1.0 - share) ** 1.6 - np.radians(22.0) * share
    angle += np.radians(-14.0) * offset + np.radians(9.0) * rng.standard_normal(BROW_HAIRS)
    way = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    way = _unit(way - np.sum(way * normal, axis=-1, keepdims=True) * normal)
    length = (8.5 - 2.5 * share) * rng.uniform(0.65, 1.1, BROW_HAIRS)
    t = _along()
    lift = 0.26 * t * (1.0 - 0.75 * t)
    curve = root[:, None] + length[:, None, None] * (
        t * way[:, None] + (lift + 0.01) * normal[:, None]
    )
    curve += 0.15 * normal[:, None]
    return curve * (side, 1.0, 1.0), roots


def _lashes(
    mesh: Mesh, lids: Eyelids, rng: np.random.Generator
) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Return curves at rest, their change when open, relative to the root, and roots."""
    side = 1.0 if lids.center_mm[0] > 0.0 else -1.0
    mirror = np.array([side, 1.0, 1.0])
    rest = mesh.vertices_mm.astype(np.float64)
    opened = rest.copy()
    opened[lids.vertices] += lids.displacement_mm(1.0)
    center = lids.center_mm * mirror
    parts: list[tuple[Float64Array, Float64Array, Int64Array]] = []
    for margin, count, long_mm, up in (
        (lids.upper, UPPER_LASHES, 9.0, 1.0),
        (lids.lower, LOWER_LASHES, 5.5, -1.0),
    ):
        share = np.sort(rng.uniform(0.06, 1.0, count))
        at = share * (len(margin) - 1)
        low = np.minimum(at.astype(np.int64), len(margin) - 2)
        part = (at - low)[:, None]
        roots = margin[low + (part[:, 0] > 0.5)]
        length = long_mm * (0.5 + 0.5 * np.sqrt(share)) * rng.uniform(0.75, 1.05, count)
        curves = []
        for points, tip in ((rest, -0.25), (opened, 0.75 * up)):
            root = ((1.0 - part) * points[margin[low]] + part * points[margin[low + 1]]) * mirror
            fan = 0.7 * (share - 0.42) + 0.08 * rng.standard_normal(count)
            out = _unit(np.array([0.25, 0.25, 1.0]) * (root - center) + [0.0, 0.0, 6.0])
            first = out + np.stack([fan, -0.3 * np.abs(up) + np.zeros(count), 0.0 * fan], axis=-1)
            t = _along()
            bend = np.array([0.0, tip + 0.3 * up, 0.0])
            curve = root[:, None] + length[:, None, None] * (
                t * _unit(first)[:, None] + t**2 * 0.55 * bend
            )
            curves.append(curve * mirror)
        change = (curves[1] - opened[roots][:, None]) - (curves[0] - rest[roots][:, None])
        parts.append((curves[0], change, roots))
    curve, change, roots = (np.concatenate(one) for one in zip(*parts, strict=True))
    return curve, change, roots


def _hairline(points: Float64Array) -> Float64Array:
    """Return the signed distance from the hairline, mm, positive on the scalp; shape (...)."""
    x, y, z = np.moveaxis(points, -1, 0)
    # forehead: lower towards the temples, which recede; in front of the ears, sideburns
    across = np.abs(x)
    front = y - (88.0 - 0.0035 * across**2 + 5.0 * np.exp(-(((across - 38.0) / 12.0) ** 2)))
    temple = np.minimum(-(z + 52.0), y - 22.0)
    burns = np.minimum(-(z + 66.0), y - 2.0)
    behind = np.minimum(-(z + 98.0), y + 28.0)
    scalp = np.maximum.reduce([np.minimum(front, -(z + 8.0)), temple, burns, behind])
    ear = np.sqrt(((y - 10.0) / 31.0) ** 2 + ((z + 84.0) / 19.0) ** 2) - 1.0
    return np.where(across > 50.0, np.minimum(scalp, 20.0 * ear), scalp)


def _scalp(mesh: Mesh, rng: np.random.Generator) -> tuple[Float64Array, Int64Array]:
    corners = mesh.vertices_mm[mesh.faces].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1
    )
    area = area * (_hairline(corners.mean(axis=1)) > -1.0)
    if not area.any():
        return np.zeros((0, CURVE_POINTS, 3)), np.zeros(0, np.int64)
    face = rng.choice(len(area), SCALP_LOCKS, p=area / area.sum())
    r, s = rng.uniform(size=(2, SCALP_LOCKS))
    swap = r + s > 1.0
    r, s = np.where(swap, 1.0 - r, r), np.where(swap, 1.0 - s, s)
    part = np.stack([1.0 - r - s, r, s], axis=-1)
    root = np.einsum("sk,skc->sc", part, corners[face])
    normal = _unit(np.einsum("sk,skc->sc", part, mesh.normals[mesh.faces[face]].astype(np.float64)))
    kept = _hairline(root) > 2.0 * np.abs(rng.standard_normal(SCALP_LOCKS)) - 1.0
    root, normal, face, part = root[kept], normal[kept], face[kept], part[kept]
    count = len(root)
    roots = mesh.faces[face, np.argmax(part, axis=1)].astype(np.int64)
    length = rng.uniform(14.0, 26.0)
    whorl = np.array([8.0 * rng.choice([-1.0, 1.0]), 122.0, -128.0])
    away = root - whorl
    away += 0.25 * np.linalg.norm(away, axis=-1, keepdims=True) * np.cross(_unit(away), normal)
    # short hair of the front lies to one side
    away += np.array([30.0 * np.sign(whorl[0]), 0.0, 0.0]) * np.clip(
        (root[:, 2:] + 70.0) / 50.0, 0.0, 1.0
    )
    way = away - np.sum(away * normal, axis=-1, keepdims=True) * normal
    way = _unit(_unit(way) + 0.22 * rng.standard_normal((count, 3)))
    way = _unit(way - np.sum(way * normal, axis=-1, keepdims=True) * normal)
    top = np.clip((root[:, 1] - 60.0) / 50.0, 0.0, 1.0)
    long = length * (0.35 + 0.65 * top) * rng.uniform(0.7, 1.15, count)
    lift = 0.35 + 0.35 * top + 0.08 * rng.standard_normal(count)
    t = _along()
    rise = lift[:, None, None] * t * (1.0 - 0.62 * t)
    curve = root[:, None] + long[:, None, None] * (t * way[:, None] + rise * normal[:, None])
    # follow the curvature of the head, a sphere of 85 mm
    curve -= ((long[:, None, None] * t) ** 2 / 170.0) * normal[:, None]
    return curve, roots


def _coverage(mesh: Mesh) -> Float32Array:
    points = mesh.vertices_mm.astype(np.float64)
    scalp = 0.95 / (1.0 + np.exp(-(_hairline(points) - 3.0) / 2.2))
    center, half = _brow_line(np.abs(points[:, 0]))
    inside = (np.abs(points[:, 0]) - 12.0) / 2.0, (52.0 - np.abs(points[:, 0])) / 4.0
    soft = np.prod([1.0 / (1.0 + np.exp(-2.0 * one)) for one in inside], axis=0)
    brow = 0.45 * soft * np.exp(-(((points[:, 1] - center) / (0.9 * half)) ** 2))
    brow *= points[:, 2] > -55.0
    covered = np.stack([scalp, brow], axis=-1)
    return np.where(covered < 0.01, 0.0, covered).astype(np.float32)
