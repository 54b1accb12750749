"""How a taped patch of skin lies under the camera: never twice alike, and never quite still."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import numpy as np

from rigsim.arrays import Float32Array

DRIFT_HZ: Final = (0.11, 0.23, 0.37)
"""Frequencies of slow drift: breath and muscle tone."""


class PatchMotionError(ValueError):
    """A motion is described wrongly."""


@dataclass(frozen=True, slots=True)
class PatchPose:
    """Where the skin's own origin is, and how the skin is turned."""

    x_mm: float
    y_mm: float
    rotation_rad: float
    """From +x towards +y."""


@dataclass(frozen=True, slots=True)
class PatchMotion:
    """Small rigid motion of the skin and of what is taped to it; a pure function of its seed."""

    seed: int
    """Any integer >= 0."""
    angle_um: float = 60.0
    """Standard deviation of the place after each taping, um, per axis."""
    angle_turn_deg: float = 0.3
    """Standard deviation of the turn after each taping, degrees."""
    state_um: float = 12.0
    """Standard deviation of the shift with each state, um, per axis."""
    state_turn_deg: float = 0.05
    """Standard deviation of the turn with each state, degrees."""
    drift_um: float = 1.0
    """Standard deviation of the slow drift with time, um, per axis."""
    jumps_um: Mapping[float, tuple[float, float]] = field(
        default_factory=lambda: MappingProxyType({})
    )
    """Sudden shifts in x and y by the world time, s, from which on they last."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("angle_um", "angle_turn_deg", "state_um", "state_turn_deg", "drift_um"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise PatchMotionError(f"{name}: got {value}, expected >= 0")
        if self.seed < 0:
            raise PatchMotionError(f"seed: got {self.seed}, expected >= 0")

    def pose(self, angle_deg: float, step: int) -> PatchPose:
        """Return where the skin lies in a state of the caliper, drift and jumps aside."""
        taping = np.random.default_rng([self.seed, 1, round(1e3 * angle_deg)]).standard_normal(3)
        state = np.random.default_rng([self.seed, 2, round(1e3 * angle_deg), step + 1000])
        moved = state.standard_normal(3)
        x, y = 1e-3 * (self.angle_um * taping[:2] + self.state_um * moved[:2])
        turn = self.angle_turn_deg * taping[2] + self.state_turn_deg * moved[2]
        return PatchPose(float(x), float(y), math.radians(float(turn)))

    def jump_mm(self, t_s: float) -> tuple[float, float]:
        """Return the sum of the jumps until a world time, mm."""
        past = [shift for since, shift in self.jumps_um.items() if since <= t_s]
        return 1e-3 * sum(s[0] for s in past), 1e-3 * sum(s[1] for s in past)

    def drift_mm(self, t_s: float) -> tuple[float, float]:
        """Return the slow drift at a world time, mm: three sines of random phase."""
        rng = np.random.default_rng([self.seed, 3])
        phase = rng.uniform(0.0, 2.0 * math.pi, (2, len(DRIFT_HZ)))
        size = 1e-3 * self.drift_um * math.sqrt(2.0 / len(DRIFT_HZ))
        waves = np.sin(2.0 * math.pi * np.array(DRIFT_HZ) * t_s + phase)
        x, y = size * waves.sum(axis=1)
        return float(x), float(y)


def shift_image(
    image: Float32Array, shift_mm: tuple[float, float], *, pixel_um: float, border_px: int
) -> Float32Array:
    """Return a picture without its border after what it shows has moved.

    Parameters
    ----------
    image
        Shape (H + 2 b, W + 2 b), row 0 is the top.
    shift_mm
        Shift in x and y, y up, mm.
    pixel_um
        Side of a pixel on the subject, um.
    border_px
        The b above; the shift must be 3 pixels smaller.

    Returns
    -------
    ndarray of float32
        Shape (H, W); interpolated by polynomials through six pixels along each axis, which a
        picture that a lens has blurred to 3 pixels a period bears to 1 %.
    """
    dx, dy = 1e3 * shift_mm[0] / pixel_um, -1e3 * shift_mm[1] / pixel_um
    reach = border_px - 3
    if max(abs(dx), abs(dy)) > reach:
        raise PatchMotionError(f"drift: got {dx:.1f}, {dy:.1f} px, expected at most {reach}")
    out = image
    for axis, shift in ((0, dy), (1, dx)):
        whole = math.floor(-shift)
        part = -shift - whole
        nodes = np.arange(-2, 4)
        taps = [math.prod((part - k) / (n - k) for k in nodes if k != n) for n in nodes]
        size = out.shape[axis] - 2 * border_px
        moved = np.zeros([size if a == axis else n for a, n in enumerate(out.shape)], np.float32)
        for tap, n in zip(taps, nodes, strict=True):
            at = np.arange(size) + border_px + whole + int(n)
            moved += np.float32(tap) * np.take(out, at, axis=axis)
        out = moved
    return out
