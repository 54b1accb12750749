"""Actual polarizers of a simulated rig: finite extinction and a small misalignment."""

import hashlib
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from capture.rig import Light, Rig, View
from rigsim.arrays import Float64Array
from rigsim.shading import axis_in_plane

Polarizer = Literal["parallel", "crossed"]

POLARIZER_READING_DEG = {"parallel": 0.0, "crossed": 90.0}
"""Reading of the analyzer's rotator in each state."""


class PolarizerError(ValueError):
    """Error for invalid values of a polarizer or its state."""


@dataclass(frozen=True, slots=True)
class Polarizers:
    """Ground truth of the polarizers, which calibration estimates."""

    light_extinction: float
    """Extinction ratio of the polarizer in front of each light, > 1; real ones have 1e3 to 1e4."""
    analyzer_extinction: float
    """Extinction ratio of the analyzer in front of the camera, > 1."""
    analyzer_zero_deg: float
    """True angle less the rotator's reading, degrees, -10 to 10."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("light_extinction", "analyzer_extinction"):
            value = getattr(self, name)
            if not value > 1.0:
                raise PolarizerError(f"{name}: got {value}, expected > 1 (inf is ideal film)")
        if not -10.0 <= self.analyzer_zero_deg <= 10.0:
            raise PolarizerError(
                f"analyzer_zero_deg: got {self.analyzer_zero_deg}, expected -10 to 10"
            )

    def analyzer_axis_deg(self, view: View, polarizer: str, analyzer_deg: float | None) -> float:
        """Return the true transmission axis of the analyzer, degrees from the image's x axis.

        Parameters
        ----------
        view
            The camera; its nominal axis belongs to reading 0.
        polarizer
            "parallel" or "crossed".
        analyzer_deg
            Reading of the rotator; ``None`` takes that of the state.
        """
        if polarizer not in POLARIZER_READING_DEG:
            raise PolarizerError(f"polarizer: got {polarizer!r}, expected parallel or crossed")
        reading = POLARIZER_READING_DEG[polarizer] if analyzer_deg is None else analyzer_deg
        if not math.isfinite(reading):
            raise PolarizerError(f"analyzer_deg: got {reading}, expected a finite angle")
        if view.analyzer_axis_deg is None:
            raise PolarizerError(
                f"view {view.name!r}: has no analyzer; give it an analyzer_axis_deg"
            )
        return view.analyzer_axis_deg + reading + self.analyzer_zero_deg


IDEAL_POLARIZERS = Polarizers(math.inf, math.inf, 0.0)
"""Ideal polarizers: infinite extinction, perfectly aligned."""


def draw_polarizers(rig: Rig) -> Polarizers:
    """Draw the polarizers of a rig, seeded by its cameras' serial numbers.

    Parameters
    ----------
    rig
        The rig.

    Returns
    -------
    Polarizers
        Extinction ratios of 1500 to 6000 and a zero within about a degree.
    """
    serials = "|".join(view.serial for view in rig.views)
    digest = hashlib.sha256(f"films of {serials}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    light, analyzer = np.exp(rng.uniform(math.log(1500.0), math.log(6000.0), 2))
    zero = float(np.clip(rng.normal(0.0, 0.5), -1.2, 1.2))
    return Polarizers(float(light), float(analyzer), zero)


def absorbing_axis(light: Light) -> Float64Array:
    """Return the absorbing axis of a light's polarizer, facing the rig's origin; shape (3,)."""
    if light.polarizer_axis_deg is None:
        raise PolarizerError(
            f"light {light.name!r}: has no polarizer; give it a polarizer_axis_deg"
        )
    return axis_in_plane(light.polarizer_axis_deg + 90.0, light.position_mm, (0.0, 1.0, 0.0))
