"""Trials of the flash rig's intervals: chromophores, and how blood changes with a state.

Stated errors are of people who do not stand exactly where the white tile stood
(`reconstruction.chromophores.shading_prior.LOG_SHADING_SOFTNESS`), and so each subject is drawn a
place off it.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from capture.rig import load_rig
from model import store
from reconstruction.chromophores import shading_prior
from reconstruction.pipeline.flash.facial_color import UnknownBloodError
from skinrig.appearances.contents import intersect_valid
from skinrig.benchmarks.intervals.coverage import IntervalTrial
from skinrig.benchmarks.intervals.trials import (
    TrialSubject,
    reconstruct_maps,
    resimulate,
    skin_color_band,
)
from skinrig.evaluating import facial_color
from skinrig.fitting.facial_color import fit_facial_color
from skinrig.planning.confirmation import calibrate_simulated
from skinrig.simulating.orders import SimulationResult, truth_folder

BLOOD_STATES: Final = ("smile", "anger", "fear", "exercise")
FACTOR_95: Final = 2.4
"""Half width of a 95 % interval of a chromophore over that of the 68 % one, to 0.1, set on the
subjects of seeds 0 to 15 at 384 and 768 px: tails are heavier than a Gaussian's."""

LOG_STANCE_STD: Final = 0.5 * shading_prior.LOG_SHADING_SOFTNESS
"""Standard deviation of how far subjects stand off the tile's place, over the camera's distance:
what the stated errors take it for. Light goes with the square of the distance."""
CALIBRATION_SEED: Final = 900
_STANCE_STREAM: Final = 1
"""Beside a subject's seed: of the draw of its place."""


def draw_stance_offset_mm(seed: int) -> float:
    """Return how much nearer to the camera than the tile's place the subject of a seed stands.

    Examples
    --------
    >>> round(nearer_mm(520), 1) == round(nearer_mm(520), 1) != round(nearer_mm(521), 1)
    True
    """
    drawn = np.random.default_rng([seed, _STANCE_STREAM]).standard_normal()
    return float(LOG_STANCE_STD * load_rig("flash").views[0].distance_mm * drawn)


def run_trials(
    folder: Path,
    subjects: Mapping[int, str],
    *,
    width_px: int,
    moving: bool = True,
    resolution: str = "",
) -> Iterator[IntervalTrial]:
    """Yield trials of melanin and hemoglobin, and of the hemoglobin rig's blood and its change.

    Parameters
    ----------
    folder
        For sessions and maps; those of a subject are gone when the next begins.
    subjects
        Seed of each and its preset.
    width_px
        Pixels across the camera.
    moving
        Whether each is captured in a second state, for the blood of a hemoglobin rig.
    resolution
        Said behind the quantities' names.
    """
    targets = {"sensor": "flat", "white": "white", "polarization": "malus"}
    calibrate_flash(folder, targets, width_px)
    for seed, preset in subjects.items():
        state = BLOOD_STATES[seed % len(BLOOD_STATES)]
        done = resimulate(
            "flash",
            folder,
            subject=preset,
            seed=seed,
            width_px=width_px,
            states=("neutral", state) if moving else ("neutral",),
            nearer_mm=draw_stance_offset_mm(seed),
        )
        found, truth = reconstruct_maps(folder, done, ["melanin", "hemoglobin"])
        skin = truth.maps["mask"].values > 0.5
        subject = TrialSubject(
            f"{preset} {seed}", skin_color_band(truth, "reflectance_blurred", skin)
        )
        for name in ("melanin", "hemoglobin"):
            true = truth.maps[f"{name}_blurred"].values
            quantity, estimate = f"{name}{resolution}", found.maps[name]
            yield subject.map_trial(quantity, estimate, true, skin, factor_95=FACTOR_95)
        if moving:
            yield from _of_rig(done, folder, state, subject)


def calibrate_flash(folder: Path, targets: Mapping[str, str], width_px: int) -> None:
    """Calibrate a simulated flash rig by these targets, each of the kind it is for."""
    shown = {key: {"width_px": width_px} for key in targets.values()}
    kinds = ((kind, (target,)) for kind, target in targets.items())
    calibrate_simulated("flash", folder, shown, kinds, seed=CALIBRATION_SEED)


def _of_rig(
    done: SimulationResult, folder: Path, state: str, subject: TrialSubject
) -> Iterator[IntervalTrial]:
    try:
        fit_facial_color([done.session], out=folder / "moving", calibration=folder / "calibration")
    except UnknownBloodError:
        return  # of the darkest skin: it states no interval
    maps = store.read(folder / "moving").maps
    blood, found = maps.get(f"hemoglobin_{state}"), maps.get(f"change_{state}")
    neutral = truth_folder(done.session)
    truths = [neutral, neutral.with_name(f"{neutral.name}-{state}")]
    rest, moved = (
        facial_color.true_blood(store.read(place)) if place.is_dir() else None for place in truths
    )
    if blood is None or found is None or rest is None or moved is None:
        return
    both = intersect_valid(rest, moved) & (moved.values > 0)
    change = moved.values.astype(np.float64) - rest.values
    quantity = "hemoglobin of the rig"
    yield subject.map_trial(quantity, blood, moved.values, both, factor_95=FACTOR_95)
    yield subject.map_trial("change of hemoglobin", found, change, both, over=rest.values)
