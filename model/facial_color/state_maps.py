"""Maps of one expression of the hemoglobin rig, and the names of expressions."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np

from model.arrays import BoolArray, Float64Array, FloatArray
from model.checks import Checks
from model.facial_color.coarse_maps import CoarseGrid

NEUTRAL: Final = "neutral"


GLOBAL_STATES: Final = ("exercise", "alcohol")
"""States of the whole body; the face does not move."""


_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,57}")


class FacialColorError(ValueError):
    """Error for maps that cannot make a rig, or weights that cannot make a blend."""


@dataclass(frozen=True, slots=True, eq=False)
class StateMaps:
    """Stored maps of one state: arrays (h, w), 0 outside ``valid``."""

    scale: Float64Array
    """sigma_i/sigma_n under the prior, eq. (5)."""
    bias: Float64Array
    """mu_i, volume fraction."""
    scale_stderr: Float64Array
    """Standard error of the scale."""
    bias_stderr: Float64Array
    """Standard error of the bias, volume fraction."""
    misfit: Float64Array
    """Deviation of the measured state from scale and bias of the neutral map, within a disc,
    volume fraction: the state's own pattern, misalignment and noise."""
    valid: BoolArray
    """Cells with a value."""
    prior: float
    """Prior of the scale: sigma_i/sigma_n of the whole map; of a transferred rig, that of its
    source."""
    storage_rms: float
    """Root mean square error of coarse storage in the state, volume fraction."""
    storage_largest: float
    """Largest error of coarse storage."""

    def __post_init__(self) -> None:
        """Raise for shapes that differ and numbers that are not finite."""
        shape = self.valid.shape
        for name in ("scale", "bias", "scale_stderr", "bias_stderr", "misfit"):
            Checks(FacialColorError).numbers(name, getattr(self, name), shape)


def check_name(name: str) -> None:
    """Raise for a name that cannot be part of a map's name."""
    if name == NEUTRAL:
        raise FacialColorError(f"states: {NEUTRAL!r} is the neutral map's own name")
    if not _NAME_PATTERN.fullmatch(name):
        raise FacialColorError(f"states: got name {name!r}, expected lower case, digits and _")


@dataclass(frozen=True, slots=True, eq=False)
class RigMaps:
    """Maps of a hemoglobin rig, as measured or transferred."""

    neutral: FloatArray
    """Volume fraction in the neutral state, (H, W), float32 or float64; 0 outside ``valid``."""
    valid: BoolArray
    """(H, W)."""
    neutral_stderr: FloatArray
    """Standard error of the neutral map, (H, W); 0 where none was stated."""
    neutral_mean: Float64Array
    """Stored mu_n, (h, w), volume fraction; bias of the neutral state."""
    states: Mapping[str, StateMaps]
    """Maps by name, all but the neutral."""
    radius_px: float
    """Radius of the disc, px of the neutral map."""
    global_states: tuple[str, ...] = ()
    """Names of the states of the whole body."""
    common_log_sd: float = 0.0
    """Standard error of log blood that all pixels and states have in common."""

    def __post_init__(self) -> None:
        """Raise for maps that do not fit together."""
        shape = self.neutral.shape
        check = Checks(FacialColorError)
        check.within("common_log_sd", self.common_log_sd, "[0, inf)")
        check.shape("neutral", self.neutral, ("H", "W"))
        check.shape("valid", self.valid, shape)
        check.shape("neutral_stderr", self.neutral_stderr, shape)
        for name, state in self.states.items():
            check_name(name)
            check.shape(name, state.valid, self.neutral_mean.shape)
        for name in self.global_states:
            check.choice("global_states", name, self.states)
        object.__setattr__(self, "states", MappingProxyType(dict(self.states)))

    @property
    def cells(self) -> CoarseGrid:
        """Return the relation of the stored maps to the neutral map."""
        rows, columns = self.neutral.shape
        return CoarseGrid((rows, columns), (self.neutral_mean.shape[0], self.neutral_mean.shape[1]))

    @property
    def neutral_mean_valid(self) -> BoolArray:
        """Return the cells of ``neutral_mean`` with a value, (h, w)."""
        return self.cells.coarsen(np.zeros(self.neutral.shape), self.valid)[1]
