"""Trials of the flash rig's intervals: chromophores, and the change of blood with an expression.

Stated errors assume faces at a random distance from the position of the white reference
(`reconstruction.chromophores.shading_prior.LOG_SHADING_SOFTNESS`), and each subject's distance is
drawn accordingly.
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
    USUAL_CAPTURE,
    CaptureVariant,
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
"""Coverage factor from the 68 % to the 95 % half width of a chromophore, to 0.1, set on subjects of
seeds 0 to 15 at 384 and 768 px: tails are heavier than a Gaussian's."""

LOG_STANCE_STD: Final = 0.5 * shading_prior.LOG_SHADING_SOFTNESS
"""Standard deviation of the distance between face and white reference over the camera's distance,
as the stated errors assume. Irradiance falls with the square of the distance,
d(ln E) = -2 d(ln r), hence the factor 0.5."""
CALIBRATION_SEED: Final = 900
_STANCE_STREAM: Final = 1
"""Second seed, after the subject's, of the generator that draws the subject's position."""


def draw_stance_offset_mm(seed: int) -> float:
    """Draw the distance of a subject from the white reference's position, positive to the camera.

    Examples
    --------
    >>> draw_stance_offset_mm(520) == draw_stance_offset_mm(520) != draw_stance_offset_mm(521)
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
    calibration_seed: int = CALIBRATION_SEED,
    variant: CaptureVariant = USUAL_CAPTURE,
) -> Iterator[IntervalTrial]:
    """Yield trials of melanin and hemoglobin, and of blood and its change by the hemoglobin rig.

    Parameters
    ----------
    folder
        For sessions and maps; those of a subject are deleted when the next begins.
    subjects
        Preset by seed.
    width_px
        Width of the camera's image, pixels.
    moving
        Whether each subject is captured with a second expression, for the hemoglobin rig.
    resolution
        Suffix of the quantities' names.
    calibration_seed
        Seed of the calibration that serves all subjects.
    variant
        Age of the calibration, and further options of the captures.
    """
    targets = {"sensor": "flat", "white": "white", "polarization": "malus"}
    calibrate_flash(folder, targets, width_px, seed=calibration_seed, variant=variant)
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
            **variant.subject_options(),
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
            yield from _rig_trials(done, folder, state, subject)


def calibrate_flash(
    folder: Path,
    targets: Mapping[str, str],
    width_px: int,
    *,
    seed: int = CALIBRATION_SEED,
    variant: CaptureVariant = USUAL_CAPTURE,
) -> None:
    """Calibrate a simulated flash rig; `targets` maps kinds of calibration to their targets."""
    shown = {key: variant.target_options(width_px=width_px) for key in targets.values()}
    kinds = ((kind, (target,)) for kind, target in targets.items())
    calibrate_simulated("flash", folder, shown, kinds, seed=seed)


def _rig_trials(
    done: SimulationResult, folder: Path, state: str, subject: TrialSubject
) -> Iterator[IntervalTrial]:
    try:
        fit_facial_color([done.session], out=folder / "moving", calibration=folder / "calibration")
    except UnknownBloodError:
        return  # blood under the darkest skin is not determined, without an interval to test
    maps = store.read(folder / "moving").maps
    blood, found = maps.get(f"hemoglobin_{state}"), maps.get(f"change_{state}")
    neutral = truth_folder(done.session)
    truths = [neutral, neutral.with_name(f"{neutral.name}-{state}")]
    rest, moved = (
        facial_color.true_blood(store.read(path)) if path.is_dir() else None for path in truths
    )
    if blood is None or found is None or rest is None or moved is None:
        return
    both = intersect_valid(rest, moved) & (moved.values > 0)
    change = moved.values.astype(np.float64) - rest.values
    quantity = "hemoglobin of the rig"
    yield subject.map_trial(quantity, blood, moved.values, both, factor_95=FACTOR_95)
    yield subject.map_trial("change of hemoglobin", found, change, both, over=rest.values)
