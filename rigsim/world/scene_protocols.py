"""What is in front of a rig's cameras, as the world asks it for frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from rigsim.arrays import UInt16Array
from rigsim.world.suction import HeadState
from rigsim.world.taped_skin import GripState


class Scene(Protocol):
    """What is in front of the cameras."""

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Return the DN, shape (H, W), of one exposure lit by `pops`.

        They are what the rig's box gives: `FlashPop` of the flash, `LedPulse` of the dome, or
        `PatternLight` of the gradient sphere, clipped to the time in which the shutter was open.
        """


class CaliperScene(Protocol):
    """What is in front of the cameras of a rig with a caliper."""

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, grip: GripState
    ) -> UInt16Array:
        """Return the DN, shape (H, W), of one exposure, see `Scene`; of skin held by `grip`."""


class ProbeScene(Protocol):
    """What is in front of the fibres of a rig with a contact probe."""

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int, head: HeadState
    ) -> UInt16Array:
        """Return the DN, shape (H, W), of one exposure, see `Scene`; `head` is of its start."""
