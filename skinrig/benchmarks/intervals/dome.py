"""Trials of the light dome's intervals: normals, diffuse albedo and surface lobes of faces."""

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.dome.stages import WEIGHT_NAMES
from reconstruction.surface.errors import interior_error
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float64Array
from skinrig.benchmarks.intervals.coverage import IntervalTrial
from skinrig.benchmarks.intervals.trials import (
    USUAL_CAPTURE,
    CaptureVariant,
    TrialSubject,
    reconstruct_maps,
    resimulate,
)
from skinrig.evaluating import reflection, skin_bands
from skinrig.evaluating import surface as surface_evaluation
from skinrig.planning.confirmation import calibrate_simulated

FACTORS_95: Final[Mapping[str, float]] = {"normals": 2.1, "R_d": 2.2, "surface": 2.8}
"""Half width of a 95 % interval over that of the 68 % one, to 0.1, set on faces of seeds 0 to 5 and
types I to V that are not evaluated (R_d: of seeds 1 to 3, types V, I and II; surface: of 21 even
seeds of docs/validation/study.md). Tails are heavier than a Gaussian's where one point in twenty is
an outlier."""
NORMAL_MAP_NAMES: Final[Mapping[str, str]] = {
    "normals": "normals of the dome",
    "normals_refined": "refined normals of the dome",
}
CHANNEL_NAMES: Final = ("red", "green", "blue")


def run_trials(
    folder: Path,
    subjects: Mapping[int, str],
    *,
    width_px: int,
    variant: CaptureVariant = USUAL_CAPTURE,
) -> Iterator[IntervalTrial]:
    """Yield trials of normals, diffuse albedo and lobes of faces.

    Each seed has its own dome with deviations from the nominal geometry and its own calibration, so
    that calibration errors are independent between subjects. Parameters as in `flash.run_trials`.
    """
    target = variant.target_options(width_px=width_px)
    shown = dict.fromkeys(("charuco", "mirror", "white"), target)
    kinds = (("geometry", ("charuco",)), ("lights", ("mirror", "white")))
    for seed, preset in subjects.items():
        with tempfile.TemporaryDirectory(dir=folder) as name:
            own = Path(name)
            calibrate_simulated("dome", own, shown, kinds, seed=seed)
            options = variant.subject_options(width_px=width_px)
            done = resimulate("dome", own, subject=preset, seed=seed, **options)
            found, truth = reconstruct_maps(own, done, [*NORMAL_MAP_NAMES, "r_d", *WEIGHT_NAMES])
        yield from face_trials(found, truth, f"{preset} {seed}")


def face_trials(found: SkinAppearance, truth: SkinAppearance, name: str) -> Iterator[IntervalTrial]:
    """Yield the trials of one face.

    Parameters
    ----------
    found
        Maps of the dome.
    truth
        Ground truth of the same face.
    name
        Preset and seed.
    """
    pairs = surface_evaluation.match_texels(found, truth)
    true_normals, true_albedo = (pairs.interpolate(truth.maps[key]) for key in ("normals", "r_d"))
    band = str(skin_bands.classify_typology(np.median(skin_bands.typology_angle_deg(true_albedo))))
    subject = TrialSubject(name, band)
    for name, quantity in NORMAL_MAP_NAMES.items():
        normals = found.maps[name]
        good = intersect_valid(normals)[pairs.rows, pairs.columns]
        if normals.stderr is not None:
            at = (pairs.rows[good], pairs.columns[good])
            angle = metrics.angular_error_rad(normals.values[at], true_normals[good])
            factor = FACTORS_95["normals"]
            yield subject.normal_trial(quantity, angle, normals.stderr[at], factor_95=factor)
    albedo = _without_interior_error(found.maps["r_d"])
    shape = albedo.values.shape[:2]
    true = np.zeros((*shape, 3))
    true[pairs.rows, pairs.columns] = true_albedo
    covered = np.zeros(shape, bool)
    covered[pairs.rows, pairs.columns] = True
    for channel, color in enumerate(CHANNEL_NAMES):
        options: dict[str, Any] = {"channel": channel, "factor_95": FACTORS_95["R_d"]}
        yield subject.map_trial(f"R_d, {color}", albedo, true, covered, **options)
    off, stderr = lobe_strength(found, truth)
    quantity, factor = "light from the surface, dome", FACTORS_95["surface"]
    yield subject.error_trial(quantity, np.abs(off), stderr, factor_95=factor)


def _without_interior_error(albedo: SkinMap) -> SkinMap:
    """Remove the error of a Lambertian interior, which images of simulated faces have.

    The stage `reference-dome` judges that error by voxel skin.
    """
    if albedo.stderr is None:
        return albedo
    rest = np.square(albedo.stderr) - np.square(interior_error(albedo.values))
    return dataclasses.replace(albedo, stderr=np.sqrt(np.maximum(rest, 0.0)).astype(np.float32))


def lobe_strength(
    found: SkinAppearance, truth: SkinAppearance
) -> tuple[Float64Array, Float64Array]:
    """Return the relative error of the surface term of fitted lobes, and its standard error.

    Weights of similar lobes are not determined one by one. Their standard errors refer to the
    light that all lobes reflect together.

    Parameters
    ----------
    found
        Maps of normals, albedo and weights, with their basis.
    truth
        Ground truth with the file of held-out directions.

    Returns
    -------
    off, stderr : ndarray of float64, shape (n,)
        For each test point with weights: (true - fitted) / fitted, where both are means over the
        point's directions of f_r cos(light), and its stated standard error.
    """
    test = reflection.surface_test(found, truth)
    if test is None:
        return np.zeros(0), np.zeros(0)
    weights = [found.maps[name] for name in WEIGHT_NAMES]
    valid = intersect_valid(weights[0]).reshape(-1)[test.texels]
    weight_values, errors = (
        np.stack([part.reshape(-1)[test.texels].astype(np.float64) for part in parts])
        for parts in (
            [w.values for w in weights],
            [np.zeros(w.values.shape) if w.stderr is None else w.stderr for w in weights],
        )
    )
    # errors of similar lobes are correlated: their sum is the largest error of the sum of weights
    level, level_error = weight_values.sum(axis=0), errors.sum(axis=0)
    fitted, true = test.fitted.mean(axis=1), test.true.mean(axis=1)
    good = valid & (level > 0) & (fitted > 0) & (level_error > 0)
    return true[good] / fitted[good] - 1.0, level_error[good] / level[good]
