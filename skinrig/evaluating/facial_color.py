"""Evaluate a hemoglobin rig against the true blood of expressions and simpler methods."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from model import metrics
from model.facial_color import HemoglobinRig
from model.facial_color.state_maps import NEUTRAL
from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, FloatArray
from skinrig.evaluating.flash import BOUND_FACTOR

PREDICTION_METHODS: Final = ("measured map", "rig, eq. (6)", "one gain", "neutral map")
"""Predictions of an expression's blood volume fraction: as measured, by the rig, by one gain of the
neutral map, or the neutral map unchanged."""
MAX_LEVEL_ERROR: Final = 0.15
"""Limit of the median relative error of an expression's blood, the same as that of other maps."""


def level_limit(rig: HemoglobinRig) -> float:
    """Return the limit of the median relative error of an expression's blood.

    It is that of other maps, or 1.3 standard errors of the log of all blood by unknown optics.
    """
    return max(MAX_LEVEL_ERROR, BOUND_FACTOR * rig.common_log_sd)


@dataclass(frozen=True, slots=True)
class PredictionAccuracy:
    """Accuracy of one method for the blood volume fraction of one expression.

    Attributes
    ----------
    state, method
        Name of the expression; one of `PREDICTION_METHODS`.
    median_relative, interval
        Median of |found - true| / true and its 68 % bootstrap interval.
    rms
        Root mean square of found minus true, volume fraction.
    bias
        Median of (found - true) / true.
    coverage
        Fraction of true values within the 68 % interval; NaN for a method without standard error.
    pixels
        Number of compared pixels: those where all methods and the truth are valid.
    """

    state: str
    method: str
    median_relative: float
    interval: tuple[float, float]
    rms: float
    bias: float
    coverage: float
    pixels: int


@dataclass(frozen=True, slots=True)
class BloodChangeAccuracy:
    """Accuracy of the change of one expression's mean blood over the face.

    Attributes
    ----------
    state
        Name of the expression.
    true, found
        Mean change over the compared pixels, volume fraction.
    rms
        Root mean square of the change's map minus the true one, volume fraction.
    coverage
        Fraction of true changes within the 68 % interval.
    """

    state: str
    true: float
    found: float
    rms: float
    coverage: float


def true_blood(truth: SkinAppearance) -> SkinMap | None:
    """Return an expression's true blood on the face at rest, blurred by lateral scattering.

    Images show blood through skin, so that only the blurred map can be measured. If the truth has
    a blurred map of the moved face only, the result is None: the difference between a sharp map and
    a blurred one of another expression would show the skin's fine structure as a change.
    """
    at_rest = "" if truth.parameters.get("state") == NEUTRAL else "_at_rest"
    spread = "_blurred" if "hemoglobin_blurred" in truth.maps else ""
    return truth.maps.get(f"hemoglobin{spread}{at_rest}")


def compare(
    appearance: SkinAppearance,
    rig: HemoglobinRig,
    truths: Mapping[str, SkinAppearance],
    *,
    rng: np.random.Generator,
) -> tuple[list[PredictionAccuracy], list[BloodChangeAccuracy]]:
    """Compare each state's blood with its truth.

    Parameters
    ----------
    appearance
        With the maps of `skinrig.fitting.facial_color`.
    rig
        Its hemoglobin rig.
    truths
        Truth of each state, neutral among them.
    rng
        For the bootstrap intervals.

    Returns
    -------
    states
        A row for each state and way.
    changes
        A row for each state.
    """
    states: list[PredictionAccuracy] = []
    changes: list[BloodChangeAccuracy] = []
    rest = true_blood(truths[NEUTRAL]) if NEUTRAL in truths else None
    for state in rig.states:
        true = true_blood(truths[state]) if state in truths else None
        measured = appearance.maps.get(f"hemoglobin_{state}")
        if true is None or measured is None or true.values.shape != measured.values.shape:
            continue
        blend = rig.evaluate({state: 1.0})
        seen = intersect_valid(true, measured) & blend.valid & (true.values > 0)
        if not seen.any():
            continue
        neutral = rig.neutral.astype(np.float64)
        level = float(np.mean(measured.values[seen]) / np.mean(neutral[seen]))
        found: Mapping[str, tuple[FloatArray, FloatArray | None]] = {
            PREDICTION_METHODS[0]: (measured.values, measured.stderr),
            PREDICTION_METHODS[1]: (blend.hemoglobin, blend.stderr),
            PREDICTION_METHODS[2]: (level * neutral, None),
            PREDICTION_METHODS[3]: (neutral, None),
        }
        states += [
            _row(state, way, values, stderr, true.values, seen, rng)
            for way, (values, stderr) in found.items()
        ]
        change = appearance.maps.get(f"change_{state}")
        if change is None or rest is None or change.stderr is None:
            continue
        both = seen & intersect_valid(change, rest)
        moved = true.values.astype(np.float64) - rest.values
        got = change.values.astype(np.float64)
        moved, got = moved[both], got[both]
        rms = float(np.sqrt(np.mean((got - moved) ** 2)))
        held = metrics.coverage(got, change.stderr[both], moved).fraction
        changes.append(
            BloodChangeAccuracy(state, float(moved.mean()), float(got.mean()), rms, held)
        )
    return states, changes


def _row(
    state: str,
    method: str,
    values: FloatArray,
    stderr: FloatArray | None,
    true: FloatArray,
    visible: BoolArray,
    rng: np.random.Generator,
) -> PredictionAccuracy:
    found, real = values[visible].astype(np.float64), true[visible].astype(np.float64)
    relative = (found - real) / real
    median, interval = metrics.median_with_interval(np.abs(relative), rng=rng)
    held = float("nan")
    if stderr is not None:
        held = metrics.coverage(found, stderr[visible].astype(np.float64), real).fraction
    rms, bias = float(np.sqrt(np.mean((found - real) ** 2))), float(np.median(relative))
    return PredictionAccuracy(state, method, median, interval, rms, bias, held, int(visible.sum()))
