"""Trials of time constants of blood after an event and under prompts, and of the prompts' delay.

The delay is the mean time from prompt to movement. Each subject has its own time constant; the
regions of the face are its ground truths.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from reconstruction.pipeline import recipes as pipeline
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95, IntervalTrial
from skinrig.benchmarks.intervals.flash import calibrate_flash
from skinrig.benchmarks.intervals.trials import resimulate, skin_color_band, truth_folder
from skinrig.capturing.sequences import SequenceOrder
from skinrig.simulating.sequence import COURSE_FILE

TIME_CONSTANTS_S: Final[Mapping[str, Sequence[float]]] = {
    "exercise": (15.0, 30.0, 60.0),
    "smile": (1.0, 2.0, 4.0),
}
"""Simulated time constants of an event and of prompts, s."""
REACTION_RANGE_S: Final = (0.1, 0.4)
"""Range of a subject's mean time from prompt to movement, s: from an anticipated rhythm to a slow
reaction."""


def run_trials(
    folder: Path, subjects: Mapping[int, str], *, width_px: int, state: str
) -> Iterator[IntervalTrial]:
    """Yield trials of the time constant in each region of a face, and of the delay after prompts.

    Parameters
    ----------
    folder
        For sessions and curves; those of a subject are deleted when the next begins.
    subjects
        Preset by seed.
    width_px
        Width of the camera's image, pixels.
    state
        One of `TIME_CONSTANTS_S`.
    """
    calibrate_flash(folder, {"white": "white"}, width_px)
    for seed, preset in subjects.items():
        constant_s = TIME_CONSTANTS_S[state][seed % len(TIME_CONSTANTS_S[state])]
        done = resimulate(
            "flash",
            folder,
            subject=preset,
            seed=seed,
            width_px=width_px,
            sequence=build_request(state, seed),
            relaxation_s=constant_s,
        )
        truth = truth_folder(done)
        pipeline.reconstruct(
            done.session,
            want=["perfusion_curves"],
            out=folder / "maps",
            calibration=folder / "calibration",
            landmarks=truth / "landmarks.csv",
        )
        document = json.loads((folder / "maps" / "perfusion_curves.json").read_text("utf-8"))
        name, band = f"{preset} {seed}", _band(truth)
        fits = list(document["fits"].values())
        yield fit_trial(f"time constant after {state}", fits, constant_s, name, band)
        course = json.loads((truth / COURSE_FILE).read_text("utf-8"))["constants_s"]
        if "reaction_s" in course:
            reaction_s = course["reaction_s"]
            yield fit_trial(f"delay of {state}", fits, reaction_s, name, band, delay=True)


def build_request(state: str, seed: int) -> SequenceOrder:
    """Build the capture sequence of a subject, for prompts with the subject's reaction time.

    Parameters
    ----------
    state
        One of `TIME_CONSTANTS_S`.
    seed
        Seed of the subject.
    """
    order = SequenceOrder(state=state)
    if not order.is_prompted:
        return order
    reaction_s = float(np.random.default_rng([seed, 16]).uniform(*REACTION_RANGE_S))
    return dataclasses.replace(order, reaction_s=reaction_s)


def fit_trial(
    quantity: str,
    fits: Iterable[Mapping[str, Any]],
    true_s: float,
    subject: str,
    band: str,
    *,
    delay: bool = False,
) -> IntervalTrial:
    """Compare fits with the true time constant or the true delay.

    Time constants have an asymmetric 68 % and 95 % interval; delays have a standard error and a
    95 % interval. Bounds of a time constant count as intervals with one open end: without them, the
    sample would lack the largest values. Fits without information are omitted. Delays with a bound
    only are omitted as well, as a delay is not defined without a change of blood.

    Parameters
    ----------
    quantity, subject, band
        Name of the quantity, subject and band of the trial.
    fits
        Entries of the document of curves.
    true_s
        True time, s.
    delay
        Whether to compare the delay.
    """
    off, widths = [], []
    for fit in fits:
        if fit["known"] == "unknown" or (delay and fit["known"] != "estimated"):
            continue
        if delay:
            half = float(fit["stderr_delay_s"])
            best = float(fit["delay_s"])
            inner, outer = (best - half, best + half), _interval_ends(fit["delay_interval_s"])
        else:
            best = float(fit["time_constant_s"])
            inner, outer = _interval_ends(fit["interval_68_s"]), _interval_ends(fit["interval_s"])
        off.append(asymmetric_deviation(best, true_s, inner, outer))
        if fit["known"] == "estimated":
            widths.append(100.0 * 0.5 * (inner[1] - inner[0]) / true_s)
    width = float(np.median(widths)) if widths else float("nan")
    return IntervalTrial(quantity, subject, band, np.array(off), width, "%", GAUSSIAN_95)


def asymmetric_deviation(
    best: float, true: float, inner: tuple[float, float], outer: tuple[float, float]
) -> float:
    """Return an error in half widths of the estimate's 68 % interval on the truth's side.

    The result is at most 1 exactly where the 68 % interval contains the truth, and at most
    `GAUSSIAN_95` exactly where the 95 % interval does.

    Parameters
    ----------
    best
        Estimate.
    true
        Ground truth.
    inner, outer
        The 68 % interval and the 95 % interval around it; an open end is infinite.
    """
    if inner[0] <= true <= inner[1]:
        end = inner[0] if true < best else inner[1]
        # a best beyond the tried constants may lie outside the interval
        deviation = abs(true - best) / max(abs(end - best), 1e-300) if math.isfinite(end) else 0.0
        return min(deviation, 1.0)
    if outer[0] <= true <= outer[1]:
        return GAUSSIAN_95
    return 2.0 * GAUSSIAN_95


def _interval_ends(interval: Sequence[float | None]) -> tuple[float, float]:
    """Return the ends of an interval from JSON; null is 0 below or an open end above."""
    low, high = interval
    return 0.0 if low is None else float(low), math.inf if high is None else float(high)


def _band(truth: Path) -> str:
    found = store.read(truth)
    name = "reflectance_blurred" if "reflectance_blurred" in found.maps else "reflectance"
    return skin_color_band(found, name, found.maps["mask"].values > 0.5)
