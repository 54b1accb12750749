"""Trials of the fibre probe's intervals: sigma_tr of homogeneous media."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from model import store
from reconstruction import pipeline
from skinrig.benchmarks.interval_coverage import GAUSSIAN_95, Trial
from skinrig.benchmarks.interval_trials import ANY_BAND, calibrated, forget, truth_of
from skinrig.simulating.simulation import simulate_session


def probe(folder: Path, media: Mapping[int, str]) -> Iterator[Trial]:
    """Yield trials of sigma_tr of homogeneous media under the fibre probe.

    Parameters
    ----------
    folder
        As of `interval_trials_flash.flash`.
    media
        Seed of each and "homogeneous:SIGMA_A,SIGMA_S_PRIME,G"; layers have a sigma_tr by
        definition only.
    """
    from skinrig.evaluating import subsurface as evaluation

    calibrated("probe", folder, {"fibre": "phantom"}, width_px=None)
    for seed, medium in media.items():
        done = simulate_session(
            "probe", folder / "session-subject", subject=medium, sites=("cheek",), seed=seed
        )
        pipeline.reconstruct(
            done.session, want=["subsurface"], out=folder / "maps",
            calibration=folder / "calibration",
        )  # fmt: skip
        fits = [
            fit
            for fit in evaluation.compare_fits(
                store.read(folder / "maps"), store.read(truth_of(done))
            )
            if fit.method == evaluation.RECOMMENDED and fit.valid
        ]
        # an interval of the logarithm, its two halves alike
        half = np.array([0.5 * np.log(fit.interval[1] / fit.interval[0]) for fit in fits])
        center = np.array([0.5 * np.log(fit.interval[1] * fit.interval[0]) for fit in fits])
        truth = np.log(np.array([fit.truth for fit in fits]))
        width = float(100.0 * np.median(half)) if fits else float("nan")
        yield Trial("sigma_tr", f"{medium} {seed}", ANY_BAND, np.abs(center - truth) / half, width,
                    "%", GAUSSIAN_95)  # fmt: skip
        forget(folder, done)
