"""Measure the strain of the skin in each state from its images, next to the caliper's reading."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.pipeline.gradient.images import GradientImages, SkinState
from reconstruction.registration.strain import Strain, measure_strain

SKIN_LEVEL = 0.4
"""Fraction of the bright part of a smoothed crossed image below which a pixel is not skin."""
SKIN_SIGMA_PX = 8.0


def skin_mask(picture: Float32Array) -> BoolArray:
    """Segment the skin in a crossed image; jaws and background are dark.

    Parameters
    ----------
    picture
        Subsurface-scattered light, (H, W).
    """
    even = ndimage.gaussian_filter(picture, SKIN_SIGMA_PX, mode="nearest")
    mask: BoolArray = even > SKIN_LEVEL * np.percentile(even, 90)
    return ndimage.binary_erosion(mask, iterations=round(SKIN_SIGMA_PX), border_value=1)


@dataclass(frozen=True, slots=True)
class StateStrain:
    """Measured strain of the skin in one state, with the caliper's reading."""

    state: SkinState
    ratio: float
    """Stretch by the caliper: distance of its jaws over that in the neutral state."""
    strain: Strain

    @property
    def usable(self) -> bool:
        """Whether the strain was measured."""
        return self.strain.valid

    @property
    def stretch_s(self) -> tuple[float, float]:
        """Stretch ratio along the jaws, and its standard error."""
        return self.strain.stretch_along(self.state.angle_rad)

    @property
    def stretch_t(self) -> tuple[float, float]:
        """Stretch ratio across the jaws, and its standard error."""
        return self.strain.stretch_along(self.state.angle_rad + math.pi / 2)

    def document(self, pixel_um: float) -> dict[str, Any]:
        """Return strain and setting as numbers, texts and arrays, lengths in um."""
        strain, angle = self.strain, self.state.angle_rad
        (r_s, r_s_error), (r_t, r_t_error) = self.stretch_s, self.stretch_t
        shear, shear_error = strain.shear(angle)
        turn, turn_error = strain.rotation
        shift_error = np.sqrt(np.maximum(np.diag(strain.covariance)[4:], 0.0))
        return asdict(self.state) | {
            "reading_ratio": self.ratio,
            "stretch_s": r_s,
            "stretch_s_stderr": r_s_error,
            "stretch_t": r_t,
            "stretch_t_stderr": r_t_error,
            "shear_rad": shear,
            "shear_stderr_rad": shear_error,
            "rotation_rad": turn,
            "rotation_stderr_rad": turn_error,
            "shift_um": strain.shift_px * pixel_um,
            "shift_stderr_um": shift_error * pixel_um,
            "slip": self.ratio - r_s,
            "gradient": strain.gradient,
            "covariance": strain.covariance,
            "residual_um": strain.residual_px * pixel_um,
            "windows": strain.windows,
            "valid": strain.valid,
        }


def measure_states(images: GradientImages) -> list[StateStrain]:
    """Measure the strain of every state against the first neutral one.

    The search starts at the strain of the previous state, scaled by the change of the caliper's
    reading. If it does not converge, it restarts from a grid of stretches.
    """
    neutral = images.neutral
    crossed = images.of(neutral).crossed()
    skin = skin_mask(crossed)
    itself = measure_strain(crossed, crossed, valid=skin, valid_second=skin)
    found = {neutral.name: StateStrain(neutral, 1.0, itself)}
    readings = {(s.angle_deg, 0): s.reading_mm for s in images.states if s.step == 0}
    for state in sorted(images.states[1:], key=lambda s: (s.angle_deg, abs(s.step))):
        rest_mm = readings.get((state.angle_deg, 0), neutral.reading_mm)
        ratio = state.reading_mm / rest_mm if rest_mm > 0 else math.nan
        picture = images.of(state).crossed()
        there = skin_mask(picture)
        strain = Strain(np.eye(2), np.zeros(2), np.full((6, 6), np.inf), math.inf, 0, False)
        for start in _starts(state, ratio, found):
            tried = measure_strain(crossed, picture, start=start, valid=skin, valid_second=there)
            strain = tried if tried.valid or not strain.valid else strain
            if strain.valid:
                break
        found[state.name] = StateStrain(state, ratio, strain)
    return [found[state.name] for state in images.states]


def _starts(
    state: SkinState, ratio: float, found: Mapping[str, StateStrain]
) -> list[Float64Array | None]:
    axis = np.array([math.cos(state.angle_rad), math.sin(state.angle_rad)])
    along = [one for one in found.values() if one.state.angle_deg == state.angle_deg]
    before = [one for one in along if one.usable and one.state.step * state.step >= 0]
    starts: list[Float64Array | None] = []
    if before:
        nearest = min(before, key=lambda other: abs(other.state.step - state.step))
        change = ratio / nearest.ratio if nearest.ratio > 0 else 1.0
        change = change if math.isfinite(change) else 1.0
        starts.append((np.eye(2) + (change - 1.0) * np.outer(axis, axis)) @ nearest.strain.gradient)
    if math.isfinite(ratio):
        starts.append(np.eye(2) + (ratio - 1.0) * np.outer(axis, axis))
    return [*starts, None]
