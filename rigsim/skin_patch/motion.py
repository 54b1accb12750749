"""Motion of a taped skin patch under the camera: placement, drift and jumps."""

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
    """Error for invalid parameters of a motion."""


@dataclass(frozen=True, slots=True)
class PatchPose:
    """Position of the skin's origin, and rotation of the skin."""

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
    """Standard deviation of the position after each taping, um, per axis."""
    angle_turn_deg: float = 0.3
    """Standard deviation of the rotation after each taping, degrees."""
    state_um: float = 12.0
    """Standard deviation of the shift at each caliper state, um, per axis."""
    state_turn_deg: float = 0.05
    """Standard deviation of the rotation at each caliper state, degrees."""
    drift_um: float = 1.0
    """Standard deviation of the slow drift with time, um, per axis."""
    jumps_um: Mapping[float, tuple[float, float]] = field(
        default_factory=lambda: MappingProxyType({})
    )
    """Permanent shifts in x and y by their start, world time, s."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("angle_um", "angle_turn_deg", "state_um", "state_turn_deg", "drift_um"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise PatchMotionError(f"{name}: got {value}, expected >= 0")
        if self.seed < 0:
            raise PatchMotionError(f"seed: got {self.seed}, expected >= 0")

    def pose(self, angle_deg: float, step: int) -> PatchPose:
        """Return the skin's pose at a state of the caliper, without drift and jumps."""
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
    """Return an image without its border after a shift of its content.

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
        Shape (H, W); interpolated by polynomials through six pixels along each axis, accurate to 1
        % for an image whose finest period is 3 pixels.
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
