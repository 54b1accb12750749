"""Read what simulated sessions of the dome estimated of the simulated population.

`tools/make_population_sessions.py` captures, calibrates and reconstructs the people and stores the
estimates of each in `skinrig/data/population_sessions.npz`, next to the ground truth.
"""

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np

from reconstruction.correspondence.common_parameterization import CommonFrame
from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from skinrig.traits.albedo_vectors import AlbedoSample

SESSIONS_FILE: Final = "data/population_sessions.npz"
"""Path below the package."""
R_D_RANGE: Final = (0.01, 1.2)
"""R_d at the steps 1 and 255 of a stored map, a step being 1.9 %; 0 marks invalid pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class PopulationSessions:
    """Estimates of people and conditions, each from its own simulated session."""

    captured: tuple[str, ...]
    """Names of the members whom the dome captured, n of them."""
    regions: Float64Array
    """Quantities of facial regions: estimate, stated standard error and ground truth, see
    `skinrig.benchmarks.dome.people`, shape (n, 3, regions, quantities)."""
    lobes: int
    """Basis BRDFs of each reconstruction."""
    people: Dataset
    """Material weights of the n members, without a condition but their own (dataset B)."""
    conditions: Dataset
    """Material weights of one member under each condition (dataset A)."""
    r_d: tuple[AlbedoSample, ...]
    """R_d of the n members in the common map."""
    frame: CommonFrame
    """The common map."""


@cache
def load_population_sessions() -> PopulationSessions:
    """Load the packaged sessions.

    Examples
    --------
    >>> sessions = load_population_sessions()
    >>> sessions.people.labels == sessions.captured
    True
    """
    with resources.files("skinrig").joinpath(SESSIONS_FILE).open("rb") as stream:
        stored: dict[str, Any] = dict(np.load(stream))
    captured = tuple(stored["captured"].tolist())
    return PopulationSessions(
        captured,
        stored["regions"].astype(np.float64),
        int(stored["lobes"]),
        _dataset("dataset B", captured, stored, "people"),
        _dataset("dataset A", tuple(stored["condition_names"].tolist()), stored, "conditions"),
        tuple(map(decode_r_d, stored["r_d"])),
        CommonFrame.from_document(json.loads(str(stored["frame"]))),
    )


def encode_r_d(r_d: Float32Array, valid: BoolArray) -> UInt8Array:
    """Return a map of R_d (N, N, 3) at half its size, (N/2, N/2, 3), in even steps of ln R_d.

    A pixel is the mean of the valid ones of four; without any it is 0.

    Examples
    --------
    >>> known = np.array([[True, True], [True, False]])
    >>> stored = encode_r_d(np.full((2, 2, 3), 0.3, np.float32), known)
    >>> abs(float(decode_r_d(stored).r_d[0, 0, 0]) / 0.3 - 1.0) < 0.01
    True
    >>> bool(decode_r_d(encode_r_d(np.ones((2, 2, 3), np.float32), ~known & known)).valid.any())
    False
    """
    half = len(r_d) // 2
    weight = np.where(valid, 1.0, 0.0)[..., None]
    values = np.where(valid[..., None], r_d, 0.0)
    total, count = (x.reshape(half, 2, half, 2, -1).sum(axis=(1, 3)) for x in (values, weight))
    low, high = np.log(R_D_RANGE)
    mean = np.maximum(total / np.maximum(count, 1.0), R_D_RANGE[0])
    steps = np.rint(1.0 + 254.0 * (np.log(mean) - low) / (high - low))
    return np.where(count > 0.0, np.minimum(steps, 255.0), 0.0).astype(np.uint8)


def decode_r_d(stored: UInt8Array) -> AlbedoSample:
    """Return the map that `encode_r_d` stored."""
    low, high = np.log(R_D_RANGE)
    valid = stored[..., 0] > 0
    r_d = np.exp(low + (high - low) * (stored.astype(np.float64) - 1.0) / 254.0)
    return AlbedoSample(np.where(valid[..., None], r_d, 0.0).astype(np.float32), valid)


def _dataset(name: str, labels: tuple[str, ...], stored: dict[str, Any], key: str) -> Dataset:
    weights = stored[f"{key}_weights"].astype(np.float64)
    label = np.repeat(np.arange(len(labels)), stored[f"{key}_points"])
    return Dataset(name, weights, label, labels, float("nan"), int(stored[f"{key}_lost"]))
