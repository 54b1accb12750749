"""Model the motion of a subject's head: a slow drift, and a twitch at the mouth.

Both are functions of the world's time only, and both are zero at time zero, where the ground-truth
maps are taken.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array
from rigsim.geometry.mesh import Mesh
from rigsim.subject.expressions import displace_mesh
from rigsim.subject.face_regions import to_mean_head
from rigsim.subject.head import LANDMARKS_MM

TWITCH_WINDOW_S: Final = 25.0
"""Time within which the drift reaches its stated size: that of a capture."""

DRIFT_RANGE_MM: Final = (0.3, 3.0)
DRIFT_RANGE_DEG: Final = (0.1, 1.0)
"""Ranges of the largest translation and rotation."""

SWAY_WAVES: Final = 5
SWAY_BAND_HZ: Final = (0.02, 0.4)
"""Number of sway waves in the drift, and their frequencies; heads in rests sway below 0.5 Hz."""

PIVOT_MM: Final = (0.0, 0.0, -70.0)
"""Center of rotation of the head; the translation is that of this point."""

POSITION_DEVIATION_MM: Final = 2.0
"""Standard deviation of the head's position between sessions, per axis: a chin rest's, chosen."""

TWITCH_DURATION_S: Final = 0.5
TWITCH_RANGE_MM: Final = (0.8, 2.0)
TWITCH_RADIUS_MM: Final = 14.0
"""Duration of the twitch, range of its size, and its reach from the corner of the mouth."""


class HeadMotionError(ValueError):
    """A motion with an invalid description."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadMotion:
    """Drift and twitch of one capture; see `draw_head_motion`."""

    amplitude: Float64Array
    """Waves of translation x, y, z in mm and rotation about x, y, z in rad, shape (WAVES, 6)."""
    frequency_hz: Float64Array
    """Shape (WAVES, 6)."""
    phase_rad: Float64Array
    """Shape (WAVES, 6)."""
    twitch_start_s: float
    """Start of the twitch; inf for none."""
    twitch_mm: float
    """Displacement of the corner of the mouth."""
    twitch_side: str
    """"left" or "right", as in the image."""

    def __post_init__(self) -> None:
        """Check shapes and ranges."""
        for name in ("amplitude", "frequency_hz", "phase_rad"):
            array = getattr(self, name)
            if array.ndim != 2 or array.shape[1] != 6 or not np.isfinite(array).all():
                raise HeadMotionError(f"{name}: got shape {array.shape}, expected finite (n, 6)")
        if not self.twitch_mm >= 0.0:
            raise HeadMotionError(f"twitch_mm: got {self.twitch_mm}, expected >= 0")
        if self.twitch_side not in ("left", "right"):
            raise HeadMotionError(f"twitch_side: got {self.twitch_side!r}, expected left or right")

    def pose(self, t_s: float) -> tuple[Float64Array, Float64Array]:
        """Return the pose of the head.

        Parameters
        ----------
        t_s
            World time, s.

        Returns
        -------
        rotation, shift_mm : ndarray
            Shapes (3, 3) and (3,): a point p of the fixed head is at rotation @ p + shift_mm.
        """
        at = 2.0 * math.pi * self.frequency_hz * t_s + self.phase_rad
        state = np.sum(self.amplitude * (np.sin(at) - np.sin(self.phase_rad)), axis=0)
        rotation = _rotation_matrix(state[3:])
        pivot = np.array(PIVOT_MM)
        return rotation, pivot - rotation @ pivot + state[:3]

    def twitch_amount(self, t_s: float) -> float:
        """Return the amount of the twitch, 0 (rest) to 1."""
        phase = (t_s - self.twitch_start_s) / TWITCH_DURATION_S
        return math.sin(math.pi * phase) ** 2 if 0.0 < phase < 1.0 else 0.0

    def apply_twitch(self, mesh: Mesh, amount: float) -> Mesh:
        """Return a face whose corner of the mouth is drawn up and outwards.

        Parameters
        ----------
        mesh
            The fixed face.
        amount
            Result of `twitch_amount`.

        Returns
        -------
        Mesh
            The same triangles; normals rotate with the surface.
        """
        points = to_mean_head(mesh.vertices_mm, mesh)
        corner = np.array(LANDMARKS_MM[f"mouth corner {self.twitch_side}"])
        squared = np.sum((points - corner) ** 2, axis=-1) / TWITCH_RADIUS_MM**2
        outward = -1.0 if self.twitch_side == "left" else 1.0
        way = np.array([0.75 * outward, 0.6, -0.28])
        way /= np.linalg.norm(way)
        deltas = np.exp(-squared)[:, None] * (amount * self.twitch_mm * way)
        return displace_mesh(mesh, deltas.astype(np.float32))


def draw_head_motion(
    seed: int, *, drift_mm: float | None = None, drift_deg: float | None = None, twitch: bool = True
) -> HeadMotion:
    """Draw the motion of a head during one capture.

    Parameters
    ----------
    seed
        Seed, >= 0; the same gives the same motion.
    drift_mm, drift_deg
        Largest translation of `PIVOT_MM` and largest rotation within 25 s, 0 to 10 mm and degrees;
        None draws 0.3 to 3 mm and 0.1 to 1 degree.
    twitch
        Whether the mouth twitches once, between 20 and 80 % of the 25 s.

    Returns
    -------
    HeadMotion
        The motion; at time 0 the head is at its mesh.

    Examples
    --------
    >>> rotation, shift_mm = draw_head_motion(1).pose(0.0)
    >>> bool(np.allclose(rotation, np.eye(3)) and np.allclose(shift_mm, 0.0))
    True
    """
    rng = np.random.default_rng([seed, 5])
    sizes = [float(rng.uniform(*DRIFT_RANGE_MM)), float(rng.uniform(*DRIFT_RANGE_DEG))]
    for k, (name, value) in enumerate((("drift_mm", drift_mm), ("drift_deg", drift_deg))):
        if value is not None:
            if not 0.0 <= value <= 10.0:
                raise HeadMotionError(f"{name}: got {value}, expected 0 to 10")
            sizes[k] = value
    low, high = np.log(SWAY_BAND_HZ)
    frequency = np.exp(rng.uniform(low, high, (SWAY_WAVES, 6)))
    amplitude = rng.standard_normal((SWAY_WAVES, 6)) / np.sqrt(frequency)
    phase = rng.uniform(0.0, 2.0 * math.pi, (SWAY_WAVES, 6))
    t = np.linspace(0.0, TWITCH_WINDOW_S, 501)[:, None, None]
    track = np.sum(
        amplitude * (np.sin(2.0 * math.pi * frequency * t + phase) - np.sin(phase)), axis=1
    )
    amplitude[:, :3] *= sizes[0] / np.linalg.norm(track[:, :3], axis=1).max()
    amplitude[:, 3:] *= math.radians(sizes[1]) / np.linalg.norm(track[:, 3:], axis=1).max()
    start = float(rng.uniform(0.2, 0.8)) * TWITCH_WINDOW_S if twitch else math.inf
    return HeadMotion(
        amplitude=amplitude,
        frequency_hz=frequency,
        phase_rad=phase,
        twitch_start_s=start,
        twitch_mm=float(rng.uniform(*TWITCH_RANGE_MM)) if twitch else 0.0,
        twitch_side=str(rng.choice(["left", "right"])),
    )


def draw_head_position(seed: int | None) -> tuple[float, float, float]:
    """Draw where a subject's head is in one session, relative to the center of the rig.

    Parameters
    ----------
    seed
        Seed of the session, >= 0; None: the center of the rig.

    Returns
    -------
    tuple of float
        Translation along x, y, z, mm, rig frame; at most 2.5 standard deviations per axis.

    Examples
    --------
    >>> draw_head_position(None), draw_head_position(1) == draw_head_position(1)
    ((0.0, 0.0, 0.0), True)
    """
    if seed is None:
        return 0.0, 0.0, 0.0
    normal = np.random.default_rng([seed, 6]).standard_normal(3)
    x, y, z = (POSITION_DEVIATION_MM * np.clip(normal, -2.5, 2.5)).tolist()
    return x, y, z


def _rotation_matrix(vector: Float64Array) -> Float64Array:
    """Return the rotation about a vector by its length in rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
