"""Cut the closed lids of a scan along the lid line, so that they can open.

The template's lid motion (`rigsim.face_parts.eyelids`) moves the skin around the fitted eye. The
cut adds vertices on the surface and moves none: with closed eyes the surface is that of the scan.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from rigsim.face_parts import eyelids
from rigsim.face_parts.eyelids import EyelidError, Eyelids
from rigsim.geometry.mesh import Mesh, build_mesh
from skinrig.arrays import BoolArray, Float64Array, Int64Array
from skinrig.unmeasured.head_fit import FittedHead
from skinrig.unmeasured.level_cuts import LevelCut, cut_at_zero, keep_from_zero
from skinrig.unmeasured.rim import weld_positions

OVERLAP_MM: Final = 0.004
"""Overlap of the cut's sides with closed eyes: the page joins normals of one position."""
MIN_MARGIN_POINTS: Final = 6
"""Least number of vertices along a lid's margin."""
MIN_MOVE_MM: Final = 1e-3
"""Displacement below which a vertex does not belong to the lids."""
OPENING_SKIN_MM: Final = 1.0
"""Displacement from which skin must be on the scan: with less, it is far from the lids."""
MIN_MEASURED_FRACTION: Final = 0.5
"""Least measured fraction of the surroundings of an eye, weighted as they locate it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Cut:
    """A mesh that is cut along one eye's lid line."""

    points: Float64Array
    uv: Float64Array
    faces: Int64Array
    upper: Int64Array
    lower: Int64Array
    is_lower: BoolArray
    """Whether a vertex is a copy on the lower side of the cut, shape (V,)."""


def cut_lids(
    mesh: Mesh, fitted: FittedHead, filled: BoolArray
) -> tuple[Mesh, tuple[Eyelids, Eyelids]]:
    """Cut the lids of both eyes, on the image's right (x > 0) and left.

    Parameters
    ----------
    mesh
        Scan with closed eyes, mm. Its vertices keep their numbers; new ones follow.
    fitted
        Mean head that was fitted to it.
    filled
        Whether a vertex is the fitted head's, not the scan's, shape (V,).

    Returns
    -------
    mesh
        The same surface with vertices along the lid lines, doubled between the corners.
    lids
        No triangle of it is omitted when the eyes open.

    Raises
    ------
    rigsim.face_parts.eyelids.EyelidError
        If the scan has no lids where the fitted head has them, or does not reach them.
    """
    lids, shifts = [], []
    for side in (1.0, -1.0):
        rotation, shift = fitted.locate_eye(side)
        mirror = np.array([side, 1.0, 1.0])
        at = ((mesh.vertices_mm.astype(np.float64) - shift) @ rotation) * mirror
        cut = _cut_one(at, mesh.uv.astype(np.float64), mesh.faces.astype(np.int64))
        vertices = (cut.points * mirror) @ rotation.T + shift
        vertices[: len(at)] = mesh.vertices_mm
        # both sides of the cut at one position, for the normals of the closed surface
        mesh = build_mesh(vertices, cut.faces, cut.uv)
        opened = _open_one(cut, rotation, shift, mirror)
        _require_measured(opened, filled, fitted.measured_near_eye(side))
        lids.append(opened)
        shifts.append((np.flatnonzero(cut.is_lower), OVERLAP_MM * rotation[:, 1]))
    moved = mesh.vertices_mm.copy()
    for rows, offset in shifts:
        moved[rows] += offset.astype(np.float32)
    return replace(mesh, vertices_mm=moved), (lids[0], lids[1])


def _require_measured(lids: Eyelids, filled: BoolArray, fraction: float) -> None:
    """Raise if lids are not on the scan: a drawn face is not measured skin that opens."""
    opens = np.linalg.norm(lids.opening_mm, axis=1) > OPENING_SKIN_MM
    known = lids.vertices[opens & (lids.vertices < len(filled))]
    if filled[known].any() or fraction < MIN_MEASURED_FRACTION:
        raise EyelidError(
            f"mesh: got a scan of {100 * fraction:.0f} % of the skin around an eye, and "
            f"{np.count_nonzero(filled[known])} vertices of the mean head among "
            f"{len(known)} of its lids, expected a scan of both; omit the eyes"
        )


def _near(points: Float64Array) -> BoolArray:
    (x0, x1), (y0, y1), deep = eyelids.REGION_MM
    x, y, z = points.T
    return np.asarray((z > deep) & (x > x0) & (x < x1) & (y > y0) & (y < y1))


def _cut_one(points: Float64Array, uv: Float64Array, faces: Int64Array) -> _Cut:
    """Cut a mesh in the frame of the mean head's right eye between the corners of the eye."""
    place = weld_positions(points)
    level = keep_from_zero(points[:, 1] - eyelids.lid_line(points[:, 0]))[place]
    chosen = _near(points)[faces].all(axis=1) & _between_corners(points[:, 0], level, faces)
    mixed = (level[faces] >= 0.0).any(axis=1) & (level[faces] < 0.0).any(axis=1)
    others = faces[~(chosen & mixed)]
    cut = cut_at_zero(faces[chosen & mixed], level, place)
    others, edges, fraction = _split_ends(others, cut, place)
    new = len(points) + np.arange(len(edges))
    whole = LevelCut(edges, fraction, cut.above, cut.below)
    points, uv = whole.extend(points), whole.extend(uv)
    ends = np.isin(new, others)
    # the same position on other charts of the texture
    joined = weld_positions(points)
    ends = np.isin(joined[new], joined[new[ends]])
    order = np.argsort(points[new, 0], kind="stable")
    _, first = np.unique(joined[new][order], return_index=True)
    line = order[np.sort(first)]
    if (
        len(line) < MIN_MARGIN_POINTS
        or np.count_nonzero(ends[line]) != 2
        or not (ends[line[0]] and ends[line[-1]])
    ):
        raise EyelidError(
            f"mesh: got {len(line)} vertices along the lids, expected {MIN_MARGIN_POINTS} or more "
            "between two corners; omit the eyes"
        )
    copies = np.flatnonzero(~ends)
    number = np.arange(len(points))
    number[new[copies]] = len(points) + np.arange(len(copies))
    below = number[whole.below]
    is_lower = np.arange(len(points) + len(copies)) >= len(points)
    return _Cut(
        np.concatenate([points, points[new[copies]]]),
        np.concatenate([uv, uv[new[copies]]]),
        np.concatenate([others, whole.above, below]),
        new[line],
        number[new[line]],
        is_lower,
    )


def _between_corners(x: Float64Array, level: Float64Array, faces: Int64Array) -> BoolArray:
    """Return which triangles meet the lid line between the corners of the eye alone, shape (F,)."""
    inner, outer = eyelids.FISSURE_MM
    within = np.ones(len(faces), bool)
    for k in range(3):
        a, b = faces[:, k], faces[:, (k + 1) % 3]
        crossed = (level[a] >= 0.0) != (level[b] >= 0.0)
        share = level[a] / np.where(crossed, level[a] - level[b], 1.0)
        at = x[a] + share * (x[b] - x[a])
        within &= ~crossed | ((at > inner) & (at < outer))
    return within


def _split_ends(
    others: Int64Array, cut: LevelCut, place: Int64Array
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Split the uncut triangles that share a cut edge; return them and all cut edges.

    A seam of the texture between both has an edge, and a new vertex, of its own.
    """
    total = int(place.max()) + 1
    keys = (place[cut.edges] @ (total, 1)).tolist()
    known = dict(zip(keys, cut.fraction.tolist(), strict=True))
    numbers = {tuple(edge): k for k, edge in enumerate(np.sort(cut.edges, axis=1).tolist())}
    edges, fraction = cut.edges.tolist(), cut.fraction.tolist()
    whole, parts = np.ones(len(others), bool), []
    count = len(place)
    for k in range(3):
        a, b, c = (others[:, (k + s) % 3] for s in range(3))
        low, high = np.minimum(place[a], place[b]), np.maximum(place[a], place[b])
        for row in np.flatnonzero(np.isin(low * total + high, list(known))):
            if not whole[row]:
                raise EyelidError("mesh: got a triangle at two corners of the eye; omit the eyes")
            whole[row] = False
            pair = tuple(sorted((int(a[row]), int(b[row]))))
            if pair not in numbers:
                numbers[pair] = len(edges)
                ahead = (int(a[row]), int(b[row]))
                edges.append(ahead if place[ahead[0]] < place[ahead[1]] else ahead[::-1])
                fraction.append(known[int(low[row] * total + high[row])])
            middle = count + numbers[pair]
            parts += [[a[row], middle, c[row]], [middle, b[row], c[row]]]
    split = np.array(parts, np.int64).reshape(-1, 3)
    pairs = np.array(edges, np.int64).reshape(-1, 2)
    return np.concatenate([others[whole], split]), pairs, np.array(fraction, np.float64)


def _open_one(
    cut: _Cut, rotation: Float64Array, shift: Float64Array, mirror: Float64Array
) -> Eyelids:
    """Return the lids of a cut mesh, in the frame of the person."""
    near = _near(cut.points)
    at = cut.points[near]
    center = eyelids.place_eyeball(at, np.ones(len(at), bool))
    ends = cut.points[cut.upper[[0, -1]]].copy()
    ends[:, 2] -= eyelids.CANTHUS_DEPTH_MM
    line = np.zeros(len(cut.points), bool)
    line[cut.upper] = True
    upper = (at[:, 1] >= eyelids.lid_line(at[:, 0])) | line[near]
    upper &= ~cut.is_lower[near]
    linear = LinearNDInterpolator(at[:, :2], at[:, 2])
    nearest = NearestNDInterpolator(at[:, :2], at[:, 2])

    def rest_z(x: Float64Array, y: Float64Array) -> Float64Array:
        z = linear(x, y)
        return np.where(np.isnan(z), nearest(x, y), z)

    opened = eyelids.open_surface(at, upper, center, ends, rest_z)
    moves = opened - at
    arc = 4.0 * (eyelids.arc_middle(at, opened, center) - 0.5 * (at + opened))
    used = np.abs(moves).max(axis=1) > MIN_MOVE_MM

    def turn(vectors: Float64Array) -> Float64Array:
        return np.asarray((vectors * mirror) @ rotation.T)

    none = np.zeros(0, np.int64)
    return Eyelids(
        turn(center) + shift,
        np.flatnonzero(near)[used],
        turn(moves[used]),
        turn(arc[used]),
        cut.upper,
        cut.lower,
        none,
        none.reshape(0, 3),
    )
