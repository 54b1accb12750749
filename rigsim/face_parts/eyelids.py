"""Open the lids of the simulated head, with an eyeball behind them.

At rest the lids of `rigsim.subject.head` are closed, and weight 0 leaves each vertex as it is. The
lids open along the rows of the head's regular grid: one row above the lid line becomes the margin
of the upper lid, the row below that of the lower lid, and the triangles between them are omitted.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigsim.arrays import BoolArray, Float64Array, Int64Array
from rigsim.geometry.mesh import Mesh

SCLERA_RADIUS_MM: Final = 11.5
"""Navarro et al. 1985 (doi 10.1364/JOSAA.2.001273): axial length 24 mm with the cornea's apex."""
CORNEA_RADIUS_MM: Final = 7.8
"""Radius of curvature of the cornea, Gullstrand and Navarro et al. 1985: 7.72 to 7.8 mm."""
LIMBUS_RADIUS_MM: Final = 5.85
"""Half of the visible iris' diameter, 11.7 mm (Caroline and Andre 2002)."""
LIMBUS_MM: Final = float(np.sqrt(SCLERA_RADIUS_MM**2 - LIMBUS_RADIUS_MM**2))
"""Distance of the limbus' plane from the eyeball's center."""
CORNEA_CENTER_MM: Final = LIMBUS_MM - float(np.sqrt(CORNEA_RADIUS_MM**2 - LIMBUS_RADIUS_MM**2))
"""Distance of the cornea's center from the eyeball's center along the gaze."""
APEX_MM: Final = CORNEA_CENTER_MM + CORNEA_RADIUS_MM
"""Distance of the cornea's apex from the eyeball's center, the eye's largest radius."""
CHAMBER_DEPTH_MM: Final = 3.05
"""Depth of the iris behind the cornea's apex, Navarro et al. 1985."""

EYE_X_MM: Final = 31.5
EYE_Y_MM: Final = 23.6
CLEARANCE_MM: Final = 0.5
"""Minimum distance between the eyeball and the closed lids."""
LID_MM: Final = 0.6
"""Distance of an open lid's surface from the sphere of the cornea's apex."""
FISSURE_MM: Final = (16.9, 46.1)
"""Inner and outer corner of the eye, x; the fissure is 29 mm wide (Farkas 1994: 28 to 32)."""
CANTHUS_Y_MM: Final = (21.2, 22.6)
"""Heights of the inner and the outer corner of an open eye."""
OPENING_MM: Final = (5.6, 4.0)
"""Heights of the open upper and lower margin from the corners' line (Farkas 1994: 10 to 11 mm)."""
UPPER_REACH_MM: Final = 17.0
"""Height above the upper margin at which the skin stays in place: the brow."""
LOWER_REACH_MM: Final = 13.0
CANTHUS_REACH_MM: Final = 6.0
CANTHUS_DEPTH_MM: Final = (4.5, 2.0)
"""Depth by which the inner and the outer corner sink when the eye opens."""
CANTHUS_BLEND_MM: Final = 5.0
_JOIN_MM: Final = 3.0
"""Difference in depth below which the lids' sphere and the corners' plane blend."""
REGION_MM: Final = ((4.0, 62.0), (0.0, 45.0), -45.0)
"""Range of x and y, and lowest z, of the vertices that open the eye."""


class EyelidError(ValueError):
    """A mesh whose lids cannot open."""


@dataclass(frozen=True, slots=True, eq=False)
class Eyelids:
    """Lids of one eye.

    Attributes
    ----------
    center_mm
        Center of the eyeball, shape (3,), rig frame.
    vertices
        Indices of the vertices that move, shape (N,).
    opening_mm, arc_mm
        Displacement at weight w: ``w opening_mm + w (1 - w) arc_mm``, shape (N, 3). The arc leads
        the lids around the eyeball.
    upper, lower
        Indices of the margins' vertices from the inner to the outer corner, shape (M,); the first
        and the last ones are outside of the corners, where the lids stay closed.
    faces
        Indices of the triangles between the margins, omitted while the eye is open, shape (A,).
    edges
        Triangles that are added then, shape (B, 3): where the margin steps from row to row.
    """

    center_mm: Float64Array
    vertices: Int64Array
    opening_mm: Float64Array
    arc_mm: Float64Array
    upper: Int64Array
    lower: Int64Array
    faces: Int64Array
    edges: Int64Array

    def displacement_mm(self, weight: float) -> Float64Array:
        """Return the displacement of `vertices` at a weight from 0 (closed), shape (N, 3)."""
        return weight * self.opening_mm + weight * (1.0 - weight) * self.arc_mm


def grid_shape(mesh: Mesh) -> tuple[int, int] | None:
    """Return the numbers of rows and columns of a head's regular grid of vertices, else None.

    Parameters
    ----------
    mesh
        Any face mesh; only that of `rigsim.subject.head.build_head` is a grid.
    """
    columns = int(np.argmax(mesh.uv[:, 1] > mesh.uv[0, 1]))
    if columns < 2 or len(mesh.uv) % columns:
        return None
    grid = mesh.uv.reshape(-1, columns, 2)
    uneven = max(float(np.ptp(grid[..., 1 - k], axis=1 - k).max()) for k in (0, 1))
    return (len(grid), columns) if uneven == 0.0 else None


def build_eyelids(mesh: Mesh) -> tuple[Eyelids, Eyelids]:
    """Build the lids of both eyes, on the image's right (x > 0) and left.

    Parameters
    ----------
    mesh
        Head of `rigsim.subject.head.build_head` at rest, mm, rig frame.

    Raises
    ------
    EyelidError
        The mesh is another one.
    """
    shape = grid_shape(mesh)
    if shape is None:
        raise EyelidError(
            f"mesh: got {len(mesh.vertices_mm)} vertices that are not a regular grid, expected the "
            "simulated head; omit the mesh"
        )
    right, left = (_build_one(mesh, shape, side) for side in (1.0, -1.0))
    return right, left


def _build_one(mesh: Mesh, shape: tuple[int, int], side: float) -> Eyelids:
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    points = mesh.vertices_mm.astype(np.float64) * (side, 1.0, 1.0)
    if side < 0.0:
        index = index[:, ::-1]
    at = points[index]
    (x0, x1), (y0, y1), deep = REGION_MM
    near = (at[..., 2] > deep) & (at[..., 0] > x0) & (at[..., 0] < x1)
    near &= (at[..., 1] > y0) & (at[..., 1] < y1)
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    index, at, near = index[box], at[box], near[box]
    x, y = at[..., 0], at[..., 1]
    first = np.argmax(y > lid_line(x), axis=0)  # row of the upper margin, by column
    column = np.arange(at.shape[1])
    inner, outer = FISSURE_MM
    across = x[first, column]
    opened = np.flatnonzero((across > inner) & (across < outer))
    center = place_eyeball(at, near)
    ends = at[first, column][[opened[0], opened[-1]]]
    ends[:, 2] -= CANTHUS_DEPTH_MM
    moved = _open(at, first, center, ends)
    moved = np.where(near[..., None], moved, at)

    lin = moved - at
    middle = arc_middle(at, moved, center)
    arc = np.where(near[..., None], 4.0 * (middle - 0.5 * (at + moved)), 0.0)
    used = near & (np.abs(lin).max(axis=-1) > 1e-3)
    mirror = np.array([side, 1.0, 1.0])
    ends_too = np.arange(opened[0] - 1, opened[-1] + 2)
    above = np.arange(at.shape[0])[:, None] >= first[None, :]
    return Eyelids(
        center * mirror,
        index[used],
        lin[used] * mirror,
        arc[used] * mirror,
        index[first[ends_too], ends_too],
        index[first[ends_too] - 1, ends_too],
        *_between(mesh, shape, index, above, near, opened),
    )


def _between(
    mesh: Mesh,
    shape: tuple[int, int],
    index: Int64Array,
    above: BoolArray,
    near: BoolArray,
    opened: Int64Array,
) -> tuple[Int64Array, Int64Array]:
    """Return the triangles with vertices of both lids and one in an opened column.

    Where both triangles of a quad are such and three of its corners are of one lid, these three
    are a triangle of that lid.
    """
    label = np.zeros(len(mesh.vertices_mm), np.int64)
    label[index[near]] = np.where(above[near], 1, 2)
    inside = np.zeros(len(mesh.vertices_mm), bool)
    inside[index[:, opened]] = True
    of = label[mesh.faces]
    mixed = (of == 1).any(axis=1) & (of == 2).any(axis=1) & inside[mesh.faces].any(axis=1)
    grid = np.arange(shape[0] * shape[1]).reshape(shape)
    quads = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1)
    quads = quads.reshape(-1, 4)
    odd = [
        (label[quads[:, k]] == one) & (label[np.delete(quads, k, axis=1)] == 3 - one).all(axis=1)
        for one in (1, 2)
        for k in (0, 2)  # the corners on the diagonal
    ]
    inner = inside[quads].any(axis=1)
    added = [
        np.delete(quads[found & inner], k, axis=1)
        for found, k in zip(odd, (0, 2, 0, 2), strict=True)
    ]
    return np.flatnonzero(mixed), np.concatenate(added)


def lid_line(x: Float64Array) -> Float64Array:
    """Return the height of the closed lids' line, as `rigsim.subject.head` draws it."""
    return np.asarray(17.2 + 0.011 * (x - 31.0) ** 2)


def place_eyeball(at: Float64Array, near: BoolArray) -> Float64Array:
    """Return the foremost center whose eye stays `CLEARANCE_MM` behind the closed lids."""
    center = np.array([EYE_X_MM, EYE_Y_MM, 0.0])
    off = at[near] - center
    radius = APEX_MM + CLEARANCE_MM
    flat = np.sum(off[:, :2] ** 2, axis=1)
    over = flat < radius**2
    center[2] = float((off[over, 2] - np.sqrt(radius**2 - flat[over])).min())
    return center


def _open(
    at: Float64Array, first: Int64Array, center: Float64Array, ends: Float64Array
) -> Float64Array:
    """Return the positions of the lids' grid with the eye open."""
    x, y = at[..., 0], at[..., 1]
    column = np.arange(at.shape[1])
    margins = at[first, column], at[first - 1, column]
    moved = at.copy()
    low = np.arange(at.shape[0])[:, None] < first[None, :]
    for part, margin, reach, opening in (
        (~low, margins[0], UPPER_REACH_MM, OPENING_MM[0]),
        (low, margins[1], LOWER_REACH_MM, -OPENING_MM[1]),
    ):
        height, hugging = _lift(y, margin, reach, opening)
        moved[..., 1] = np.where(part, height, moved[..., 1])
        for j in column:
            rest_z = np.interp(moved[:, j, 1], y[:, j], at[:, j, 2])
            front = _lid_front(x[:, j], moved[:, j, 1], center, ends)
            z = rest_z + hugging[:, j] * (front - rest_z)
            moved[:, j, 2] = np.where(part[:, j], z, moved[:, j, 2])
    return moved


def open_surface(
    points: Float64Array,
    upper: BoolArray,
    center: Float64Array,
    ends: Float64Array,
    rest_z: Callable[[Float64Array, Float64Array], Float64Array],
) -> Float64Array:
    """Return the positions of points of any closed lids with the eye open, (N, 3).

    Parameters
    ----------
    points
        Skin around the right eye (x > 0), shape (N, 3), mm, frame of the mean head.
    upper
        Whether a point is above `lid_line`, shape (N,).
    center, ends
        Eyeball, shape (3,), and the open eye's inner and outer corner, shape (2, 3).
    rest_z
        Height z of the closed skin at x and y.
    """
    moved = points.copy()
    for part, reach, opening in (
        (upper, UPPER_REACH_MM, OPENING_MM[0]),
        (~upper, LOWER_REACH_MM, -OPENING_MM[1]),
    ):
        x = points[part, 0]
        margin = np.stack([x, lid_line(x)], axis=-1)
        y, hugging = _lift(points[part, 1], margin, reach, opening)
        rest = rest_z(x, y)
        moved[part, 1] = y
        moved[part, 2] = rest + hugging * (_lid_front(x, y, center, ends) - rest)
    return moved


def _lift(
    y: Float64Array, margin: Float64Array, reach: float, opening: float
) -> tuple[Float64Array, Float64Array]:
    """Return the height of points with the eye open, and how closely they follow the eyeball.

    The margins have x and y on their last axis; other axes broadcast with those of y.
    """
    change = _margin_height(margin[..., 0], opening) - margin[..., 1]
    outside = np.maximum(FISSURE_MM[0] - margin[..., 0], margin[..., 0] - FISSURE_MM[1])
    change *= np.exp(-((np.maximum(outside, 0.0) / CANTHUS_REACH_MM) ** 2))
    away = np.abs(y - margin[..., 1]) / reach
    hugging = 1.0 - _smooth((away - 0.1) / 0.6)
    hugging = hugging * np.exp(-((np.maximum(outside, 0.0) / CANTHUS_BLEND_MM) ** 2))
    return y + change * _fade(away), hugging


def _margin_height(x: Float64Array, opening: float) -> Float64Array:
    inner, outer = FISSURE_MM
    share = np.clip((x - inner) / (outer - inner), 0.0, 1.0)
    line = CANTHUS_Y_MM[0] + share * (CANTHUS_Y_MM[1] - CANTHUS_Y_MM[0])
    # the upper margin is highest nasally of the pupil, the lower one lowest temporally
    skewed = share ** (0.92 if opening > 0.0 else 1.12)
    return np.asarray(line + opening * (4.0 * skewed * (1.0 - skewed)) ** 0.72)


def _fade(t: Float64Array) -> Float64Array:
    """Return 1 - t, rounded to 0 between .8 and 1.2."""
    rounded = 0.2 * (1.0 - np.clip((t - 0.8) / 0.4, 0.0, 1.0)) ** 2
    return np.where(t < 0.8, 1.0 - t, rounded)


def _smooth(t: Float64Array) -> Float64Array:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _lid_front(
    x: Float64Array, y: Float64Array, center: Float64Array, ends: Float64Array
) -> Float64Array:
    """Return z of the open lids: a sphere around the eyeball, joined smoothly to the corners."""
    flat = (x - center[0]) ** 2 + (y - center[1]) ** 2
    sphere = center[2] + np.sqrt(np.maximum((APEX_MM + LID_MM) ** 2 - flat, 0.0))
    share = (x - ends[0, 0]) / (ends[1, 0] - ends[0, 0])
    sheet = ends[0, 2] + share * (ends[1, 2] - ends[0, 2])
    h = np.maximum(_JOIN_MM - np.abs(sphere - sheet), 0.0) / _JOIN_MM
    return np.asarray(np.maximum(sphere, sheet) + 0.25 * _JOIN_MM * h * h)


def arc_middle(start: Float64Array, end: Float64Array, center: Float64Array) -> NDArray[np.float64]:
    """Return the middle of the arcs around the eyeball from start to end, (..., 3)."""
    a, b = start - center, end - center
    ra = np.linalg.norm(a, axis=-1, keepdims=True)
    rb = np.linalg.norm(b, axis=-1, keepdims=True)
    way = a / ra + b / rb
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    return np.asarray(center + 0.5 * (ra + rb) * way)
