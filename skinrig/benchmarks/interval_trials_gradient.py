"""Trials of the gradient sphere's intervals: normals, heights, stretch and kernels of skin.

Kernels are compared with those of the same patch's true relief, as it settled in the simulator at
each stretch: found by the same definition, eq. (7), from true heights and the true stretch. So the
trial tells errors of pictures, lens and strain; what another patch of the skin would change is
stated besides, and no truth of one patch can judge it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from model import metrics, store
from model.skin import SkinAppearance
from reconstruction import pipeline
from reconstruction.gradient_stages import KERNEL_FILE
from reconstruction.kernel_fit import ALPHAS, SIGMAS_UM, fit_kernel
from reconstruction.normal_histogram import measure
from reconstruction.strain_kernels import COARSER
from skinrig.benchmarks.interval_coverage import GAUSSIAN_95, Trial
from skinrig.benchmarks.interval_trials import (
    ANY_BAND,
    forget,
    of_normals,
    truth_of,
    valid_of,
)
from skinrig.calibrating.calibrate import calibrate
from skinrig.simulating.simulation import simulate_session

FACTORS_95: Final[Mapping[str, float]] = {
    "normals": 1.9,
    "height": 2.1,
    "stretch": GAUSSIAN_95,
    "kernels": GAUSSIAN_95,
}
"""Half width of a 95 % interval over that of the 68 % one, to 0.1, set on 6 patches of seeds 0 to
13 that are not judged: tails are heavier than a Gaussian's."""


STRETCH_STEP: Final = 2
"""Steps of the caliper to either side of neutral at which the skin's stretch is told."""


def gradient(folder: Path, subjects: Mapping[int, str], *, width_px: int) -> Iterator[Trial]:
    """Yield trials of normals and heights at rest, and of stretch and kernels to either side.

    Each seed has a sphere of its own, built off the drawing, with its own calibration. Parameters
    as of `interval_trials_flash.flash`; a subject is a site of the face.
    """
    from skinrig.evaluating.microrelief import compare_stretch, true_relief

    for seed, site in subjects.items():
        name = f"{site} {seed}"
        ball, calibration = folder / "session-ball", folder / "calibration"
        simulate_session("gradient", ball, target="ball", seed=seed)
        for kind in ("lights", "polarization"):
            calibrate(kind, [ball], calibration)
        done = simulate_session(
            "gradient", folder / "session-subject", site=site, seed=seed, width_px=width_px,
            angles=(0.0,), steps=(-STRETCH_STEP, STRETCH_STEP),
        )  # fmt: skip
        pipeline.reconstruct(
            done.session, want=["normals", "height", "strain", "kernels"], out=folder / "maps",
            calibration=calibration,
        )  # fmt: skip
        found, truth = store.read(folder / "maps"), store.read(truth_of(done))
        state = next(
            key.removeprefix("normals_")
            for key in found.maps
            if key.startswith("normals_a") and key.endswith("_n0")
        )
        normals, seen = found.maps[f"normals_{state}"], truth.maps[f"normals_seen_{state}"]
        good = valid_of(normals) & valid_of(seen)
        if normals.stderr is not None:
            angle = metrics.angular_error_rad(normals.values[good], seen.values[good])
            yield of_normals(
                "normals of the gradient sphere", angle,
                normals.stderr[good][:, 0].astype(np.float64), subject=name,
                factor_95=FACTORS_95["normals"],
            )  # fmt: skip
        height = found.maps[f"height_{state}"]
        relief = true_relief(found, truth, state)
        good = valid_of(height) & valid_of(truth.maps[f"height_{state}"])
        if height.stderr is not None:
            stderr = height.stderr[good].astype(np.float64)
            off = np.abs(height.values.astype(np.float64)[good] - relief[good]) / stderr
            yield Trial("height", name, ANY_BAND, off, float(np.median(stderr)), "um",
                        FACTORS_95["height"])  # fmt: skip
        # the neutral state is what stretch is told against: exact by definition
        rows = [row for row in compare_stretch(found, truth) if row.state != state]
        spread = np.array([row.stderr for row in rows])
        width = float(100.0 * np.median(spread)) if rows else float("nan")
        yield Trial("stretch ratio", name, ANY_BAND,
                    np.array([abs(row.error) for row in rows]) / spread, width, "%",
                    FACTORS_95["stretch"])  # fmt: skip
        yield from _kernels(found, truth, state, subject=name)
        forget(folder, done)
        for place in (ball, calibration):
            shutil.rmtree(place)


def _kernels(
    found: SkinAppearance, truth: SkinAppearance, neutral: str, *, subject: str
) -> Iterator[Trial]:
    """Compare the kernels of strained states with those of the patch's true relief."""
    from skinrig.evaluating.microrelief import document_of, true_relief

    document = document_of(found, KERNEL_FILE)
    fits = [fit for fit in document["fits"] if fit["valid"]] if document else []
    known = truth.parameters["states"]
    states = {str(s["name"]): s for s in known} if isinstance(known, list) else {}
    pixel_um = float(str(found.parameters["pixel_um"]))
    rest, skin = true_relief(found, truth, neutral), valid_of(truth.maps[f"height_{neutral}"])
    off: dict[str, list[float]] = {"alpha": [], "sigma_um": []}
    widths: dict[str, list[float]] = {"alpha": [], "sigma_um": []}
    for fit in fits:
        name = str(fit["name"])
        along, across = np.linalg.norm(np.asarray(states[name]["gradient"], np.float64), axis=0)
        strained = true_relief(found, truth, name)
        target = measure(strained, pixel=pixel_um, valid=valid_of(truth.maps[f"height_{name}"]))
        true = fit_kernel(
            rest, target.histogram, stretch=float(along), stretch_across=float(across), axis="x",
            pixel_um=pixel_um, valid=skin, alphas=ALPHAS[::COARSER], sigmas_um=SIGMAS_UM[::COARSER],
            target_samples=target.effective_samples,
        )  # fmt: skip
        if not true.valid:
            continue
        for key, value in (("alpha", true.alpha), ("sigma_um", true.sigma_um)):
            spread = float(fit["sigma_stderr_um" if key == "sigma_um" else "alpha_stderr"])
            off[key].append(abs(float(fit[key]) - value) / spread)
            widths[key].append(spread)
    for key, quantity, unit in (("alpha", "alpha of kernels", ""),
                                ("sigma_um", "sigma of kernels", "um")):  # fmt: skip
        width = float(np.median(widths[key])) if widths[key] else float("nan")
        yield Trial(quantity, subject, ANY_BAND, np.array(off[key]), width, unit,
                    FACTORS_95["kernels"])  # fmt: skip
