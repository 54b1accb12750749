"""Trials of intervals in time: time constants of blood after an event, and of its prompted change.

Of prompts the delay, too: the mean time from prompt to movement.

A subject is a person with a time constant of their own; the places of the face are the truths.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from reconstruction import pipeline
from skinrig.benchmarks.interval_coverage import GAUSSIAN_95, Trial
from skinrig.benchmarks.interval_trials import band_of, calibrated, forget, truth_of
from skinrig.sequences import SequenceOrder
from skinrig.simulating.sequence import COURSE_FILE
from skinrig.simulating.simulation import simulate_session

CONSTANTS_S: Final[Mapping[str, Sequence[float]]] = {
    "exercise": (15.0, 30.0, 60.0),
    "smile": (1.0, 2.0, 4.0),
}
"""Time constants that are simulated, s, of an event and of prompts."""


def sequences(
    folder: Path, subjects: Mapping[int, str], *, width_px: int, state: str
) -> Iterator[Trial]:
    """Yield trials of the time constant at each place of a face, and of the delay after prompts.

    Parameters
    ----------
    folder
        For sessions and curves; those of a subject are gone when the next begins.
    subjects
        Seed of each and its preset.
    width_px
        Pixels across the camera.
    state
        One of `CONSTANTS_S`.
    """
    calibrated("flash", folder, {"white": "white"}, width_px=width_px)
    for seed, preset in subjects.items():
        constant_s = CONSTANTS_S[state][seed % len(CONSTANTS_S[state])]
        done = simulate_session(
            "flash", folder / "session-subject", subject=preset, seed=seed, width_px=width_px,
            sequence=SequenceOrder(state=state), relaxation_s=constant_s,
        )  # fmt: skip
        truth = truth_of(done)
        pipeline.reconstruct(
            done.session, want=["perfusion_curves"], out=folder / "maps",
            calibration=folder / "calibration", landmarks=truth / "landmarks.csv",
        )  # fmt: skip
        told = json.loads((folder / "maps" / "perfusion_curves.json").read_text("utf-8"))
        subject, band = f"{preset} {seed}", _band(truth)
        fits = list(told["fits"].values())
        yield of_fits(f"time constant after {state}", fits, constant_s, subject=subject, band=band)
        course = json.loads((truth / COURSE_FILE).read_text("utf-8"))["constants_s"]
        if "reaction_s" in course:
            yield of_fits(
                f"delay of {state}", fits, course["reaction_s"],
                subject=subject, band=band, delay=True,
            )  # fmt: skip
        forget(folder, done)


def of_fits(
    quantity: str,
    fits: Iterable[Mapping[str, Any]],
    true_s: float,
    *,
    subject: str,
    band: str,
    delay: bool = False,
) -> Trial:
    """Compare fits with the true time constant, or the true delay.

    Fits that tell a bound alone, or nothing, have no standard error and are left out; of delays as
    well, which mean nothing where blood does not change.

    Parameters
    ----------
    quantity, subject, band
        Of the trial.
    fits
        As in the document of curves.
    true_s
        The true time, s.
    delay
        Whether it is the delay.
    """
    name, ends = ("delay", "delay_interval_s") if delay else ("time_constant", "interval_s")
    off, widths = [], []
    for fit in fits:
        if fit["known"] != "estimated":
            continue
        stderr = float(fit[f"stderr_{name}_s"])
        low, high = (math.inf if end is None else float(end) for end in fit[ends])
        away = abs(float(fit[f"{name}_s"]) - true_s) / max(stderr, 1e-300)
        # the 95 % interval is no multiple of the standard error: it says itself what is inside
        inside = low <= true_s <= high
        off.append(min(away, GAUSSIAN_95) if inside else max(away, 1.001 * GAUSSIAN_95))
        widths.append(100.0 * stderr / true_s)
    width = float(np.median(widths)) if widths else float("nan")
    return Trial(quantity, subject, band, np.array(off), width, "%", GAUSSIAN_95)


def _band(truth: Path) -> str:
    found = store.read(truth)
    name = "reflectance_blurred" if "reflectance_blurred" in found.maps else "reflectance"
    return band_of(found, name, found.maps["mask"].values > 0.5)
