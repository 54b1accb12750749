"""How far the layered model is from transport, and how faces are lit, as data with its recipe."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

FILE = "data/chromophore_model_error.json"


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts in bins of equal width."""

    low: float
    """Lower edge of the first bin."""
    step: float
    """Width of a bin."""
    counts: tuple[int, ...]
    """How many fell in each."""


@lru_cache(maxsize=1)
def load() -> NDArray[np.float64]:
    """Return the covariance of log color that the model leaves unexplained, (3, 3).

    Of the logarithm of white-balanced camera RGB, between what the table predicts for the true
    chromophores and what a capture shows with its noise taken away; scaled so that with
    noise 68 % of errors lie inside the 68 % ellipse. Fitted on simulated subjects of seeds 0 to 19
    by ``tools/fit_model_error.py``; judge it on others.
    """
    return np.array(_document()["log_covariance"], np.float64)


def shading_histogram() -> Histogram:
    """Return how log shading is distributed over the skin of the same subjects."""
    found = _document()["log_shading"]
    return Histogram(float(found["low"]), float(found["step"]), tuple(map(int, found["counts"])))


def identity() -> dict[str, str]:
    """Return the hash of the data, for the parameters of a stage."""
    text = json.dumps(_document(), sort_keys=True)
    return {"model_error": hashlib.sha256(text.encode("utf-8")).hexdigest()}


def _document() -> dict[str, Any]:
    text = resources.files("reconstruction").joinpath(FILE).read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found
