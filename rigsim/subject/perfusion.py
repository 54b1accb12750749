"""Model the blood in the skin of a face: three vessel compartments, and states that dilate them.

The blood at each point is that of a capillary bed, of the loops that rise from it, and of the
vessels of the plexus. States change the radius of the vessels, region by region; a vessel's
volume is proportional to the square of its radius. Since the compartments have separate patterns
and responses, a state is not a scaled and shifted neutral map.

The change of a state has two parts. The vascular part is the tone of the vessels: a table by
region, for flush, pallor, exercise and alcohol. The mechanical part is the pressure of strained
skin on its vessels (`rigsim.subject.tissue_pressure`), for states that move the face.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array
from rigsim.geometry.surface_noise import smooth_noise, vessel_network
from rigsim.package_data import package_table
from rigsim.subject.tissue_pressure import COMPARTMENT_PRESSURE_RATIOS, blood_ratio

MAX_HEMOGLOBIN: Final = 0.32
"""Largest volume fraction of blood, Jimenez et al. 2010, table 1."""

_REGION_GAIN: Final[Mapping[str, float]] = package_table("face")["region_gain"]

_COMPARTMENT_FRACTIONS: Final = (0.56, 0.28, 0.16)
"""Fractions of the blood in bed, loops and plexus."""

_COMPARTMENT_RESPONSES: Final = (0.45, 1.0, 0.8)
"""Response of each compartment's vessels to a change of radius: loops are muscular and respond
most; the bed mostly fills passively."""

_VASCULAR_CHANGES: Final[Mapping[str, Mapping[str, float]]] = package_table("face")[
    "vascular_changes"
]

STATE_NAMES: Final = tuple(_VASCULAR_CHANGES)
"""Names of the states."""


class StateError(KeyError, ValueError):
    """Unknown name of a state."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True, slots=True)
class Perfusion:
    """The neutral blood of a face, by compartment."""

    compartments: Float32Array
    """Volume fraction of blood in bed, loops and plexus, shape (..., 3), >= 0."""
    points_mm: Float32Array
    """Points on the mean head, shape (..., 3)."""
    regions: Mapping[str, Float32Array]
    """Masks of `rigsim.subject.face_regions.region_masks`."""
    seed: int
    """Seed of the person's responses to the states."""

    def dilation(self, state: str) -> Float32Array:
        """Return the vascular change of the vessels' radius in a state, relative, shape (...).

        Raises
        ------
        StateError
            The state is unknown.
        """
        if state not in _VASCULAR_CHANGES:
            raise StateError(f"state: got {state!r}, expected one of {', '.join(STATE_NAMES)}")
        change = np.zeros(self.points_mm.shape[:-1], np.float32)
        if state == "neutral":
            return change
        for name, gain in _VASCULAR_CHANGES[state].items():
            change += np.float32(gain) * (1.0 if name == "all" else self.regions[name])
        # Each person has an own pattern of vessel response (observation 3).
        salt = self.seed + 60 + STATE_NAMES.index(state)
        own = 1.0 + 0.25 * smooth_noise(self.points_mm, (35.0, 15.0), seed=salt)
        return np.asarray(change * np.maximum(own, 0.0), np.float32)

    def blood(
        self, state: str = "neutral", pressure_mbar: Float32Array | None = None
    ) -> Float32Array:
        """Return the blood volume fraction in the dermis.

        Parameters
        ----------
        state
            One of `STATE_NAMES`.
        pressure_mbar
            Change of the pressure around the vessels, mbar, shape (...); None: no change.

        Returns
        -------
        ndarray of float32
            Shape (...), 0 to 0.32.

        Raises
        ------
        StateError
            The state is unknown.
        """
        change = self.dilation(state)
        total = np.zeros(change.shape, np.float32)
        for index, answer in enumerate(_COMPARTMENT_RESPONSES):
            radius = np.maximum(1.0 + answer * change, 0.0)
            part = self.compartments[..., index] * radius * radius
            if pressure_mbar is not None:
                ratio = COMPARTMENT_PRESSURE_RATIOS[index]
                part = part * blood_ratio(pressure_mbar, capillary_ratio=ratio)
            total += part
        # Vessels fill the dermis at most up to the limit; the fold is monotonic.
        return np.asarray(total / (1.0 + (total / MAX_HEMOGLOBIN) ** 4) ** 0.25, np.float32)

    def dilate(self, change: ArrayLike) -> Perfusion:
        """Return the perfusion after a lasting change of the vessels' radius, such as by heat.

        Parameters
        ----------
        change
            Relative change of the radius of vessels with full response, shape (...) or a number,
            above -1; the compartments respond differently.
        """
        by = np.asarray(change, np.float32)
        if not np.all(by > -1.0):
            raise ValueError(f"change: got {by.min()}, expected above -1")
        radius = 1.0 + np.asarray(_COMPARTMENT_RESPONSES, np.float32) * by[..., None]
        grown = self.compartments * radius * radius
        return replace(self, compartments=np.asarray(grown, np.float32))


def draw_perfusion(
    points_mm: Float32Array,
    regions: Mapping[str, Float32Array],
    base: float,
    *,
    seed: int,
    amount: float = 1.0,
) -> Perfusion:
    """Draw the vessels of a face and their response to each state.

    Parameters
    ----------
    points_mm
        Points on the mean head, shape (..., 3).
    regions
        Masks of `rigsim.subject.face_regions.region_masks`.
    base
        Volume fraction of blood between the regions, see `rigsim.subject.pigment.typical_blood`.
    seed
        Any integer.
    amount
        Factor of all blood, 0.1 to 4.

    Returns
    -------
    Perfusion
        Neutral compartments with their responses.
    """
    if not 0.1 <= amount <= 4.0:
        raise ValueError(f"amount: got {amount}, expected 0.1 to 4")
    rng = np.random.default_rng([seed, 2])
    mean = np.full(points_mm.shape[:-1], 1.0, np.float32)
    contrast = np.full(points_mm.shape[:-1], 1.0, np.float32)
    for name, gain in _REGION_GAIN.items():
        mean += np.float32(gain * rng.uniform(0.75, 1.25)) * regions[name]
    contrast += 0.5 * regions["cheeks"] + 0.35 * regions["nose"] - 0.3 * regions["lips"]
    mean *= np.float32(base * amount * rng.uniform(0.85, 1.15))

    bed = 1.0 + 0.16 * contrast * smooth_noise(points_mm, (14.0, 6.0, 3.0), seed=seed + 41)
    loops = 1.0 + 0.24 * contrast * smooth_noise(points_mm, (2.6, 1.5, 0.9), seed=seed + 42)
    # Means of the networks over space, so that the plexus is 1 on average.
    fine = vessel_network(points_mm, 3.4, 0.55, seed=seed + 43) / 0.15
    coarse = vessel_network(points_mm, 9.0, 0.8, seed=seed + 44) / 0.083
    plexus = 0.45 + 0.3 * np.minimum(fine, 4.0) + 0.25 * contrast * np.minimum(coarse, 4.0)
    layers = (np.maximum(bed, 0.1), np.maximum(loops, 0.05), plexus)
    compartments = np.stack(
        [share * mean * layer for share, layer in zip(_COMPARTMENT_FRACTIONS, layers, strict=True)],
        axis=-1,
    )
    return Perfusion(compartments.astype(np.float32), points_mm, regions, seed)
