"""Judge the probe's intervals on simulated flat layers: many people, a calibration for each.

    python tools/judge_flat_layers.py SEED ...

Seed K draws a person of type I to V in turn; type VI needs minutes of photons per person.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from pathlib import Path

import numpy as np

from capture.rig import load_rig
from reconstruction.pipeline.probe.profile_fits import fit_profiles
from reconstruction.pipeline.probe.stages import CHANNEL_NAMES
from rigsim.fiber.probe_profile import ProfileCache
from rigsim.fiber.probe_tissue import SkinTissue
from rigsim.subject.person_skin import PersonSkin, draw_tissue
from skinrig.benchmarks.intervals.coverage import GAUSSIAN_95
from skinrig.benchmarks.intervals.probe import calibrate_with_own_block
from skinrig.benchmarks.simulation.reference_probe import (
    PERSON_SEED_OFFSET,
    PROBED_SITE,
    READ_PRESETS,
    ProbeCamera,
    nearest_sigma_tr,
)

PHOTONS = 60_000
PRESETS = READ_PRESETS[:5]


def main(seeds: list[int]) -> None:
    """Print bias, spread and coverage per color."""
    rig = load_rig("probe")
    errors, stated = [], []
    with tempfile.TemporaryDirectory(prefix="skinrig-flat-") as name:
        for seed in seeds:
            person = dataclasses.replace(
                PersonSkin.of_preset(PRESETS[seed % len(PRESETS)], seed=seed),
                tissue=draw_tissue(PERSON_SEED_OFFSET + seed),
            )
            cache = ProfileCache(rig, SkinTissue(person), photons=PHOTONS, seed=seed, threads=1)
            known = cache.profile(PROBED_SITE, 0.0, rig.probe.suction_mbar).reflectance_per_mm2
            camera = ProbeCamera(rig, calibrate_with_own_block(Path(name), seed), seed=seed)
            fit = fit_profiles([camera.measure(known, 0.0, seed=0)], cache.probe)[0]
            error = np.log(fit.fit.sigma_tr_per_mm / nearest_sigma_tr(rig, known))
            errors.append(np.where(fit.fit.valid, error, np.nan))
            stated.append(fit.log_total)
            print(seed, np.round(100 * errors[-1], 2), np.round(100 * stated[-1], 2), flush=True)
    ratio = np.array(errors) / np.array(stated)
    for color, error, one in zip(CHANNEL_NAMES, np.array(errors).T, ratio.T, strict=True):
        found, one = error[np.isfinite(error)], one[np.isfinite(one)]
        print(
            f"{color}: n {len(found)}, bias {100 * found.mean():.2f} % "
            f"({100 * found.std(ddof=1) / np.sqrt(len(found)):.2f}), coverage "
            f"{100 * np.mean(np.abs(one) <= 1.0):.0f}; "
            f"{100 * np.mean(np.abs(one) <= GAUSSIAN_95):.0f} %, "
            f"deviation over stated error {one.std(ddof=1):.2f}"
        )


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]])
