"""Evaluate the flash rig on held-out subjects: seeds 100 to 119, all skin types and expressions.

    python tools/judge_flash_rig.py [FIRST LAST]

Targets and subjects are captured by the simulated rig at the demo's size and noise. Per melanin
band, unmasked pixels are compared with the ground truth blurred by lateral transport. Printed are:
median relative error and bias, the coverage of the 68 % intervals, the coverage of intervals of
noise alone (no model error), the intervals' median relative half-width, the median Cramer-Rao bound
at the ground truth, and the masked fraction. The next row of the band is restricted to pixels whose
bound is below 10 %; there the limit of the median error is 15 %. Elsewhere it is 1.3 times the
bound.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from model import store
from reconstruction.pipeline import recipes as pipeline
from reconstruction.pipeline.flash.stages import NOISE_STDERR_SUFFIX
from skinrig.calibrating.calibrate import calibrate
from skinrig.evaluating.bounds import chromophore_bounds
from skinrig.evaluating.flash import (
    BOUND_FACTOR,
    MAX_MEDIAN_MELANIN_ERROR,
    MELANIN_RANGES,
    MIN_BOUND_ERROR,
)
from skinrig.simulating.simulation import simulate_session

PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")
TARGETS = (("sensor", "flat"), ("white", "white"), ("polarization", "malus"))
COLUMNS = ("melanin", "true", "value", "stderr", "noise", "bound", "valid")
HEAD = " pixels masked%  error%   bias%  cover%  noise%  width%  bound%  verdict"


def main(first: int, last: int) -> None:
    pooled: dict[str, list[np.ndarray]] = {"melanin": [], "hemoglobin": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, target in TARGETS:
            simulate_session("flash", folder / f"session-{target}", target=target, seed=first)
            calibrate(kind, [folder / f"session-{target}"], folder / "calibration")
        for seed in range(first, last + 1):
            preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
            done = simulate_session(
                "flash", folder / f"session-{seed}", subject=preset, states=(state,), seed=seed
            )
            pipeline.reconstruct(
                done.session,
                want=[*pooled, "diffuse"],
                out=folder / f"maps-{seed}",
                state=state,
                calibration=folder / "calibration",
            )
            found, truth = store.read(folder / f"maps-{seed}"), store.read(done.truth or "")
            bounds = chromophore_bounds(found, truth)
            skin = truth.maps["mask"].values > 0.5
            for key, rows in pooled.items():
                estimate = found.maps[key]
                columns = (
                    truth.maps["melanin"].values,
                    truth.maps[f"{key}_blurred"].values,
                    estimate.values,
                    estimate.stderr,
                    found.maps[key + NOISE_STDERR_SUFFIX].values,
                    bounds[key],
                    estimate.valid,
                )
                rows.append(np.stack([np.asarray(column)[skin] for column in columns]))
            print(f"seed {seed} {preset} {state}", file=sys.stderr)
    print(f"map        C_m band   which      {HEAD}")
    for key, rows in pooled.items():
        table = dict(zip(COLUMNS, np.concatenate(rows, axis=1).astype(np.float64), strict=True))
        for low, high in MELANIN_RANGES:
            band = (table["melanin"] >= low) & (table["melanin"] < high) & (table["true"] > 0)
            for which, part in (
                ("all", band),
                ("bound<10%", band & (table["bound"] < MIN_BOUND_ERROR)),
            ):
                print(f"{key:10} {low:.2f}-{high:.2f}  {which:10}{_row(table, part)}")


def _row(table: dict[str, np.ndarray], part: np.ndarray) -> str:
    kept = part & (table["valid"] > 0)
    masked = 100 * (1 - kept.sum() / max(part.sum(), 1))
    start = f"{part.sum():8d} {masked:7.1f} "
    if kept.sum() < 20:
        return start
    true, value = table["true"][kept], table["value"][kept]
    away = np.abs(value - true)
    error = float(np.median(away / true))
    bound = float(np.nanmedian(table["bound"][kept]))
    limit = MAX_MEDIAN_MELANIN_ERROR if bound < MIN_BOUND_ERROR else BOUND_FACTOR * bound
    covered = float(np.mean(away <= table["stderr"][kept]))
    numbers = (
        error,
        float(np.median(value / true - 1)),
        covered,
        float(np.mean(away <= table["noise"][kept])),
        float(np.median(table["stderr"][kept] / value)),
        bound,
    )
    verdict = "kept" if error <= limit else "MISSED"
    verdict += ", covers" if 0.60 <= covered <= 0.76 else ", coverage off"
    return start + "".join(f"{100 * number:8.1f}" for number in numbers) + f"  {verdict}"


if __name__ == "__main__":
    limits = [int(text) for text in sys.argv[1:3]] or [100, 119]
    main(*limits)
