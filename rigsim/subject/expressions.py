"""Move a face in an expression: action units that pull the skin, and the states they form.

Each action is a smooth field on the mean head, so that it applies to every mesh that
`rigsim.subject.face_regions.to_mean_head` maps. A mesh with blend shapes of the common names moves
by its own. Eyes and mouth stay closed: a dropping jaw stretches the lips instead of parting them.

References
----------
Actions and the components of emotions: Ekman, Friesen and Hager 2002, "Facial action coding system:
the manual"; Ekman and Friesen 1983, "EMFACS-7". The displacements are chosen here: the corners of
the mouth by 6 to 10 mm in a smile.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.mesh import Mesh, build_mesh, vertex_normals
from rigsim.package_data import package_table
from rigsim.subject.face_regions import mean_head_scale, to_mean_head
from rigsim.subject.perfusion import STATE_NAMES

Vector = tuple[float, float, float]

AMOUNT_RANGE: Final = (0.0, 1.5)
"""Range of an expression's strength: 0 is rest, 1 the full expression, 1.5 an extreme one."""


class ExpressionError(ValueError):
    """An expression that a face cannot form."""


@dataclass(frozen=True, slots=True)
class _Pull:
    """A pull on the skin, strongest at a center and falling as a Gaussian."""

    center: Vector
    """Position, mm on the mean head, on the image's right."""
    reach: Vector
    """Distance at which the pull has fallen to 1 / e, mm along x, y, z."""
    way: Vector
    """Displacement of the center at strength 1, mm."""
    pair: bool = True
    """Whether the same pull acts mirrored on the image's left."""


_ACTION_PULLS: Final[Mapping[str, tuple[_Pull, ...]]] = {
    action: tuple(_Pull(**pull) for pull in pulls)
    for action, pulls in package_table("face")["action_pulls"].items()
}

_JAW_ACTION: Final = "jaw drop"
_JAW_TURN_RAD: Final = 0.075
"""Rotation of the lower jaw about its joints at strength 1: 7 mm at the chin."""
_JAW_JOINT_MM: Final = (0.0, 10.0, -90.0)

ACTION_NAMES: Final = (*_ACTION_PULLS, _JAW_ACTION)
"""Names of the actions."""

EXPRESSION_STRENGTHS: Final[Mapping[str, Mapping[str, float]]] = package_table("face")[
    "expression_strengths"
]
"""Strength of each action in each expression; other states do not move the face."""

_OWN_SHAPES: Final[Mapping[str, Mapping[str, float]]] = package_table("face")["own_shapes"]

STRENGTH_RANGE: Final = (0.86, 1.12)
"""Range of a person's own strength in each action."""
MAX_ASYMMETRY: Final = 0.06
"""Largest relative difference of each side from a person's own strength."""


def is_moving_state(state: str) -> bool:
    """Return whether a state moves the face.

    Raises
    ------
    ExpressionError
        The state is unknown.

    Examples
    --------
    >>> is_moving_state("smile"), is_moving_state("alcohol"), is_moving_state("neutral")
    (True, False, False)
    """
    if state not in STATE_NAMES:
        raise ExpressionError(f"state: got {state!r}, expected one of {', '.join(STATE_NAMES)}")
    return state in EXPRESSION_STRENGTHS


def displacement_mm(mesh: Mesh, state: str, *, amount: float = 1.0, seed: int = 0) -> Float32Array:
    """Return the displacement of a face's vertices in a state.

    Parameters
    ----------
    mesh
        The face at rest, mm, rig frame; its own blend shapes are used for the actions that they
        name, see `Mesh.shapes`.
    state
        One of `rigsim.subject.perfusion.STATE_NAMES`.
    amount
        0 (rest) to 1.5 (an extreme).
    seed
        Seed of the person, >= 0, which sets the strength and asymmetry of each action.

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
    if not is_moving_state(state) or amount == 0.0:
        return total.astype(np.float32)
    points = to_mean_head(mesh.vertices_mm, mesh).astype(np.float64)
    scale = mean_head_scale(mesh)
    sides = _side_strengths(seed)
    for action, strength in EXPRESSION_STRENGTHS[state].items():
        left, right = (amount * strength * side for side in sides[action])
        own = _own_shapes(mesh.shapes, action, left, right)
        if own is not None:
            total += own
        else:
            total += _field(points, action, left, right) / scale
    return total.astype(np.float32)


def blend_shapes(mesh: Mesh, *, seed: int = 0) -> dict[str, Float32Array]:
    """Return the displacement of every moving state, {state: (V, 3) in mm}."""
    return {state: displacement_mm(mesh, state, seed=seed) for state in EXPRESSION_STRENGTHS}


def displace_mesh(mesh: Mesh, deltas_mm: Float32Array) -> Mesh:
    """Return a mesh with displaced vertices; triangles and texture coordinates stay.

    Parameters
    ----------
    mesh
        The face at rest.
    deltas_mm
        Displacement, shape (V, 3), mm.

    Returns
    -------
    Mesh
        Its shading normals rotate with its surface.
    """
    vertices = mesh.vertices_mm + deltas_mm
    turned = vertex_normals(vertices, mesh.faces) - vertex_normals(mesh.vertices_mm, mesh.faces)
    normals = mesh.normals + turned
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-6)
    return build_mesh(vertices, mesh.faces, mesh.uv, normals)


def _side_strengths(seed: int) -> dict[str, tuple[float, float]]:
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
    """Return an action composed of a mesh's own shapes, or None where it has none.

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
    """Return an action's displacement at points of the mean head, mm, shape (..., 3)."""
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
    """Rotate the chin and the lower lip about the joints of the jaw; the neck stays."""
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
