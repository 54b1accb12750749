"""Read what simulated sessions of the dome estimated of the simulated population.

`tools/make_population_sessions.py` captures, calibrates and reconstructs the people and stores the
estimates of each in `skinrig/data/population_sessions.npz`, next to the ground truth.
"""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np

from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.arrays import Float64Array

SESSIONS_FILE: Final = "data/population_sessions.npz"
"""Path below the package."""


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
    )


def _dataset(name: str, labels: tuple[str, ...], stored: dict[str, Any], key: str) -> Dataset:
    weights = stored[f"{key}_weights"].astype(np.float64)
    label = np.repeat(np.arange(len(labels)), stored[f"{key}_points"])
    return Dataset(name, weights, label, labels, float("nan"), int(stored[f"{key}_lost"]))
