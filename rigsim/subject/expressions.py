"""How a face moves in an expression: action units that pull the skin, and states made of them.

Each action is a smooth field on the mean head, so any mesh that
`rigsim.subject.face_regions.on_mean_head` places can wear it; a mesh that brings blend shapes of
the common names moves by its own. Eyes and mouth stay closed: a jaw that drops stretches the lips
in place of parting them.

References
----------
Actions and what emotions are made of: Ekman, Friesen and Hager 2002, "Facial action coding system:
the manual"; Ekman and Friesen 1983, "EMFACS-7". How far skin goes is chosen here: the corners of
the mouth by 6 to 10 mm in a smile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from rigsim.geometry.mesh import Mesh, build_mesh, vertex_normals
from rigsim.subject.face_regions import mean_head_scale, on_mean_head
from rigsim.subject.perfusion import STATE_NAMES

Vector = tuple[float, float, float]

AMOUNT_RANGE: Final = (0.0, 1.5)
"""How far an expression may go: 0 is rest, 1 the full expression, 1.5 an extreme one."""


class ExpressionError(ValueError):
    """An expression is asked for that a face cannot make."""


@dataclass(frozen=True, slots=True)
class _Pull:
    """A pull on the skin, strongest at a centre and falling as a Gaussian."""

    center: Vector
    """Where, mm on the mean head, on the image's right."""
    reach: Vector
    """Where the pull has fallen to 1 / e, mm along x, y, z."""
    way: Vector
    """How far the centre moves at strength 1, mm."""
    pair: bool = True
    """Whether the same happens mirrored on the image's left."""


_ACTION_PULLS: Final[Mapping[str, tuple[_Pull, ...]]] = {
    "inner brow raiser": (_Pull((14.0, 40.0, 3.0), (17.0, 21.0, 42.0), (0.4, 5.8, -0.8)),),
    "outer brow raiser": (_Pull((40.0, 41.0, -12.0), (20.0, 21.0, 42.0), (0.8, 5.8, -1.6)),),
    "brow lowerer": (_Pull((14.0, 42.0, 4.0), (14.0, 16.0, 40.0), (-3.4, -4.2, 0.8)),),
    "cheek raiser": (
        _Pull((40.0, 4.0, -12.0), (20.0, 18.0, 42.0), (0.4, 4.2, 1.0)),
        _Pull((50.0, 37.0, -22.0), (14.0, 13.0, 36.0), (-0.8, -2.6, 0.2)),
    ),
    "nose wrinkler": (
        _Pull((10.0, 2.0, 10.0), (10.0, 15.0, 30.0), (-0.3, 3.6, 0.5)),
        _Pull((15.0, -13.0, 9.0), (10.0, 11.0, 25.0), (0.8, 2.6, 0.3)),
    ),
    "upper lip raiser": (_Pull((13.0, -33.0, 12.0), (13.0, 10.0, 30.0), (0.8, 3.2, 0.6)),),
    "lip corner puller": (
        _Pull((26.0, -41.0, 0.0), (18.0, 17.0, 45.0), (5.3, 5.3, -2.8)),
        _Pull((38.0, -15.0, -6.0), (18.0, 16.0, 40.0), (0.6, 2.0, 1.8)),
    ),
    "lip corner depressor": (_Pull((25.0, -45.0, -2.0), (14.0, 13.0, 40.0), (0.8, -4.4, -1.0)),),
    "chin raiser": (_Pull((0.0, -61.0, 8.0), (18.0, 14.0, 30.0), (0.0, 3.8, 1.2), pair=False),),
    "lip stretcher": (_Pull((26.0, -43.0, 0.0), (18.0, 15.0, 40.0), (4.6, -1.0, -3.2)),),
    "lip tightener": (
        _Pull((0.0, -42.0, 12.0), (18.0, 8.0, 30.0), (0.0, 0.0, -1.2), pair=False),
        _Pull((25.0, -42.0, 0.0), (14.0, 12.0, 40.0), (-1.8, 0.0, 0.4)),
    ),
}

_JAW_ACTION: Final = "jaw drop"
_JAW_TURN_RAD: Final = 0.075
"""Turn of the lower jaw about its joints at strength 1: 7 mm at the chin."""
_JAW_JOINT_MM: Final = (0.0, 10.0, -90.0)

ACTION_NAMES: Final = (*_ACTION_PULLS, _JAW_ACTION)
"""Names of the actions."""

EXPRESSION_STRENGTHS: Final[Mapping[str, Mapping[str, float]]] = {
    "anger": {"brow lowerer": 1.0, "lip tightener": 1.0, "nose wrinkler": 0.2, "chin raiser": 0.3},
    "disgust": {
        "nose wrinkler": 1.0,
        "upper lip raiser": 0.7,
        "brow lowerer": 0.35,
        "lip corner depressor": 0.3,
        "chin raiser": 0.5,
    },
    "fear": {
        "inner brow raiser": 0.9,
        "outer brow raiser": 0.4,
        "brow lowerer": 0.5,
        "lip stretcher": 0.9,
        _JAW_ACTION: 0.35,
    },
    "happiness": {"cheek raiser": 1.0, "lip corner puller": 0.85},
    "sadness": {
        "inner brow raiser": 0.9,
        "brow lowerer": 0.5,
        "lip corner depressor": 0.9,
        "chin raiser": 0.6,
    },
    "surprise": {"inner brow raiser": 1.0, "outer brow raiser": 1.0, _JAW_ACTION: 1.0},
    "smile": {"lip corner puller": 1.0, "cheek raiser": 0.5},
}
"""Strength of each action in each expression; states that are none do not move the face."""

# Weight of a mesh's own shapes at strength 1, so that they reach about as far as the pulls here.
_OWN_SHAPES: Final[Mapping[str, Mapping[str, float]]] = {
    "inner brow raiser": {"browInnerUp": 0.9},
    "outer brow raiser": {"browOuterUp": 0.65},
    "brow lowerer": {"browDown": 0.8},
    "cheek raiser": {"cheekSquint": 0.75},
    "nose wrinkler": {"noseSneer": 0.45},
    "upper lip raiser": {"noseSneer": 0.2, "mouthUpperUp": 0.4},
    "lip corner puller": {"mouthSmile": 0.52},
    "lip corner depressor": {"mouthFrown": 0.8},
    "chin raiser": {"mouthShrugLower": 0.5},
    "lip stretcher": {"mouthStretch": 0.55},
    "lip tightener": {"mouthPucker": 0.15},
    _JAW_ACTION: {"jawOpen": 0.2},
}

STRENGTH_RANGE: Final = (0.86, 1.12)
"""Range of a person's own strength in each action."""
MAX_ASYMMETRY: Final = 0.06
"""Largest relative difference of each side from a person's own strength."""


def moves(state: str) -> bool:
    """Tell whether a state moves the face.

    Raises
    ------
    ExpressionError
        The state is unknown.

    Examples
    --------
    >>> moves("smile"), moves("alcohol"), moves("neutral")
    (True, False, False)
    """
    if state not in STATE_NAMES:
        raise ExpressionError(f"state: got {state!r}, expected one of {', '.join(STATE_NAMES)}")
    return state in EXPRESSION_STRENGTHS


def displacement_mm(mesh: Mesh, state: str, *, amount: float = 1.0, seed: int = 0) -> Float32Array:
    """Return how the vertices of a face move.

    Parameters
    ----------
    mesh
        The face at rest, mm, rig frame; its own blend shapes are taken for the actions that they
        name, see `Mesh.shapes`.
    state
        One of `rigsim.subject.perfusion.STATE_NAMES`.
    amount
        0 (rest) to 1.5 (an extreme).
    seed
        Seed of the person, >= 0, who has an own strength and asymmetry in each action.

    Returns
    -------
    ndarray of float32
        Shape (V, 3), mm, rig frame; zero for states that do not move the face.

    Raises
    ------
    ExpressionError
        The state is unknown or the amount out of range.
    """
    if not AMOUNT_RANGE[0] <= amount <= AMOUNT_RANGE[1]:
        raise ExpressionError(f"amount: got {amount}, expected {AMOUNT_RANGE[0]} to 1.5")
    total = np.zeros(mesh.vertices_mm.shape, np.float64)
    if not moves(state) or amount == 0.0:
        return total.astype(np.float32)
    points = on_mean_head(mesh.vertices_mm, mesh).astype(np.float64)
    scale = mean_head_scale(mesh)
    sides = _sides(seed)
    for action, strength in EXPRESSION_STRENGTHS[state].items():
        left, right = (amount * strength * side for side in sides[action])
        own = _own_shapes(mesh.shapes, action, left, right)
        if own is not None:
            total += own
        else:
            total += _field(points, action, left, right) / scale
    return total.astype(np.float32)


def blend_shapes(mesh: Mesh, *, seed: int = 0) -> dict[str, Float32Array]:
    """Return the movement of every state that moves the face, {state: (V, 3) in mm}."""
    return {state: displacement_mm(mesh, state, seed=seed) for state in EXPRESSION_STRENGTHS}


def moved(mesh: Mesh, deltas_mm: Float32Array) -> Mesh:
    """Return a mesh whose vertices have moved; triangles and texture coordinates stay.

    Parameters
    ----------
    mesh
        The face at rest.
    deltas_mm
        Movement, shape (V, 3), mm.

    Returns
    -------
    Mesh
        Its shading normals are turned as its surface is.
    """
    vertices = mesh.vertices_mm + deltas_mm
    turned = vertex_normals(vertices, mesh.faces) - vertex_normals(mesh.vertices_mm, mesh.faces)
    normals = mesh.normals + turned
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return build_mesh(vertices, mesh.faces, mesh.uv, normals)


def principal_stretches(
    rest_mm: ArrayLike, posed_mm: ArrayLike, faces: Int32Array
) -> tuple[Float64Array, BoolArray]:
    """Return how the triangles of a surface are stretched.

    Parameters
    ----------
    rest_mm, posed_mm
        Vertices before and after, shape (V, 3).
    faces
        Vertex indices, shape (F, 3).

    Returns
    -------
    stretches : ndarray
        Least and greatest ratio of lengths after to before, shape (F, 2); 1 for triangles that had
        no area.
    folded : ndarray of bool
        Triangles whose normal has turned by more than a right angle, shape (F,).
    """
    before = _edges(np.asarray(rest_mm, np.float64), faces)
    after = _edges(np.asarray(posed_mm, np.float64), faces)
    a, b = np.cross(before[:, 0], before[:, 1]), np.cross(after[:, 0], after[:, 1])
    whole = np.sum(a * a, axis=-1) > 1e-12
    gram = before @ before.swapaxes(1, 2)
    gram[~whole] = np.eye(2)
    target = after @ after.swapaxes(1, 2)
    target[~whole] = np.eye(2)
    # squared stretches are the eigenvalues of G^-1 G'; both are 2 x 2
    product = np.linalg.solve(gram, target)
    half = 0.5 * np.trace(product, axis1=1, axis2=2)
    spread = np.sqrt(np.maximum(half**2 - np.linalg.det(product), 0.0))
    squares = np.maximum(np.stack([half - spread, half + spread], axis=-1), 0.0)
    return np.sqrt(squares), whole & (np.sum(a * b, axis=-1) <= 0.0)


def _edges(points: Float64Array, faces: Int32Array) -> Float64Array:
    corners = points[faces]
    return np.asarray(corners[:, 1:] - corners[:, :1])


def _sides(seed: int) -> dict[str, tuple[float, float]]:
    """Return a person's strength in each action, on the image's left and right."""
    rng = np.random.default_rng([seed, 21])
    own = rng.uniform(*STRENGTH_RANGE, len(ACTION_NAMES))
    tilt = rng.uniform(-MAX_ASYMMETRY, MAX_ASYMMETRY, len(ACTION_NAMES))
    return {
        name: (float(s * (1.0 - t)), float(s * (1.0 + t)))
        for name, s, t in zip(ACTION_NAMES, own, tilt, strict=True)
    }


def _own_shapes(
    shapes: Mapping[str, Float32Array], action: str, left: float, right: float
) -> Float64Array | None:
    """Return an action made of a mesh's own shapes, or None where it has none.

    The names' ``_L`` and ``_R`` are the person's left and right, the image's right and left.
    """
    found: list[Float64Array] = []
    for name, weight in _OWN_SHAPES[action].items():
        middle = 0.5 * (left + right)
        for full, side in (
            (name, middle),
            *((name + end, right) for end in ("_L", "Left")),
            *((name + end, left) for end in ("_R", "Right")),
        ):
            if full in shapes:
                found.append(weight * side * shapes[full].astype(np.float64))
    return np.sum(found, axis=0) if found else None


def _field(points: Float64Array, action: str, left: float, right: float) -> Float64Array:
    """Return an action's movement at points of the mean head, mm, shape (..., 3)."""
    if action == _JAW_ACTION:
        return 0.5 * (left + right) * _jaw(points)
    total = np.zeros_like(points)
    for pull in _ACTION_PULLS[action]:
        if not pull.pair:
            total += 0.5 * (left + right) * _bump(points, pull.center, pull.reach, pull.way)
            continue
        total += right * _bump(points, pull.center, pull.reach, pull.way)
        total += left * _bump(points, _mirrored(pull.center), pull.reach, _mirrored(pull.way))
    return total


def _bump(
    points: Float64Array, center: Vector, reach: Sequence[float], way: Vector
) -> Float64Array:
    q = (points - np.array(center)) / np.array(reach)
    return np.asarray(np.exp(-np.sum(q * q, axis=-1))[..., None] * np.array(way))


def _jaw(points: Float64Array) -> Float64Array:
    """Turn the chin and the lower lip about the joints of the jaw; the neck stays."""
    below = 0.5 * (1.0 + np.tanh((-44.0 - points[..., 1]) / 8.0))
    above_neck = 0.5 * (1.0 + np.tanh((points[..., 1] + 94.0) / 12.0))
    arm = points - np.array(_JAW_JOINT_MM)
    share = below * above_neck * np.clip((arm[..., 2] - 12.0) / 60.0, 0.0, 1.0)
    turn = _JAW_TURN_RAD * share
    out = np.zeros_like(points)
    out[..., 1] = -np.sin(turn) * arm[..., 2] + (np.cos(turn) - 1.0) * arm[..., 1]
    out[..., 2] = np.sin(turn) * arm[..., 1] + (np.cos(turn) - 1.0) * arm[..., 2]
    return out


def _mirrored(vector: Vector) -> Vector:
    return (-vector[0], vector[1], vector[2])
