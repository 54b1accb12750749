"""Trials of the light dome's intervals: normals and diffuse albedo of faces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from model import metrics, store
from reconstruction import pipeline
from skinrig import skin_bands
from skinrig.benchmarks.interval_coverage import Trial
from skinrig.benchmarks.interval_trials import forget, of_map, of_normals, truth_of, valid_of
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating.simulation import simulate_session

FACTORS_95: Final[Mapping[str, float]] = {"normals": 1.9, "R_d": 2.9}
"""Half width of a 95 % interval over that of the 68 % one, to 0.1, set on the one face of the
dome's demonstration: tails are heavier than a Gaussian's."""


def dome(folder: Path, subjects: Mapping[int, str], *, width_px: int) -> Iterator[Trial]:
    """Yield trials of normals and diffuse albedo of faces.

    Parameters as of `interval_trials_flash.flash`.
    """
    from skinrig.evaluating import surface as surface_evaluation

    for target in ("charuco", "mirror", "white"):
        simulate_session(
            "dome",
            folder / f"session-{target}",
            target=target,
            seed=900,
            width_px=width_px,
        )
    calibrate("geometry", [folder / "session-charuco"], folder / "calibration")
    calibrate(
        "lights", [folder / "session-mirror", folder / "session-white"], folder / "calibration"
    )
    for seed, preset in subjects.items():
        name = f"{preset} {seed}"
        done = simulate_session(
            "dome",
            folder / "session-subject",
            subject=preset,
            seed=seed,
            width_px=width_px,
        )
        pipeline.reconstruct(
            done.session, want=["normals", "r_d"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        found, truth = store.read(folder / "maps"), store.read(truth_of(done))
        pairs = surface_evaluation.match(found, truth)
        true_normals, true_albedo = (
            truth.maps[key].values.reshape(-1, 3).astype(np.float64)[pairs.truth]
            for key in ("normals", "r_d")
        )
        band = str(skin_bands.bands_of(np.median(skin_bands.typology_angle_deg(true_albedo))))
        normals, albedo = found.maps["normals"], found.maps["r_d"]
        good = valid_of(normals)[pairs.rows, pairs.columns]
        if normals.stderr is not None:
            at = (pairs.rows[good], pairs.columns[good])
            yield of_normals(
                "normals of the dome",
                metrics.angular_error_rad(normals.values[at], true_normals[good]),
                normals.stderr[at][:, 0].astype(np.float64), subject=name, band=band,
                factor_95=FACTORS_95["normals"],
            )  # fmt: skip
        shape = valid_of(albedo).shape
        true = np.zeros((*shape, 3))
        true[pairs.rows, pairs.columns] = true_albedo
        told = np.zeros(shape, bool)
        told[pairs.rows, pairs.columns] = True
        for channel, color in enumerate(("red", "green", "blue")):
            yield of_map(f"R_d, {color}", albedo, true, told, subject=name, band=band,
                          channel=channel, factor_95=FACTORS_95["R_d"])  # fmt: skip
        forget(folder, done)
