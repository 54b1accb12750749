"""Judge the flash rig on subjects that set nothing: seeds 100 to 119, all skin types and states.

    python tools/judge_flash_rig.py [FIRST LAST]

Targets and subjects are captured through the simulated rig at the demo's size and noise. For each
melanin band: median relative error, coverage of the 68 % intervals, median standard error, and the
share masked, against the truth with lateral transport; over pixels whose relative standard error
(the Cramer-Rao bound of noise and model error) is below 10 %, and over all that are not masked.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from model import store
from reconstruction import pipeline
from skinrig.calibrating import calibrate
from skinrig.evaluation import BANDS
from skinrig.simulation import simulate_session

PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")


def main(first: int, last: int) -> None:
    pooled: dict[str, list[np.ndarray]] = {"melanin": [], "hemoglobin": []}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind, target in (("white", "white"), ("polarization", "malus")):
            simulate_session("flash", folder / f"session-{target}", target=target, seed=first)
            calibrate(kind, [folder / f"session-{target}"], folder / "calibration")
        for seed in range(first, last + 1):
            preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
            done = simulate_session(
                "flash", folder / f"session-{seed}", subject=preset, states=(state,), seed=seed
            )
            pipeline.reconstruct(
                done.session, want=list(pooled), out=folder / f"maps-{seed}", state=state,
                calibration=folder / "calibration",
            )  # fmt: skip
            maps, truth = store.read(folder / f"maps-{seed}"), store.read(done.truth or "")
            skin = truth.maps["mask"].values > 0.5
            for key, rows in pooled.items():
                estimate = maps.maps[key]
                valid = estimate.valid if estimate.valid is not None else np.ones_like(skin)
                stderr = estimate.stderr if estimate.stderr is not None else np.ones_like(skin)
                columns = (
                    truth.maps["melanin"].values,
                    truth.maps[f"{key}_blurred"].values,
                    estimate.values,
                    stderr,
                    valid,
                )
                rows.append(np.stack([column[skin] for column in columns]))
            print(f"seed {seed} {preset} {state}", file=sys.stderr)
    print("map         band          pixels masked%   all: error% cover% stderr%", end="")
    print("   bound<10%: share% error% cover% stderr%")
    for key, rows in pooled.items():
        melanin, true, value, stderr, valid = np.concatenate(rows, axis=1).astype(np.float64)
        for low, high in BANDS:
            band = (melanin >= low) & (melanin < high) & (true > 0)
            kept = band & (valid > 0)
            sharp = kept & (stderr < 0.1 * value)
            print(
                f"{key:11} {low:.2f}-{high:.2f} {band.sum():10d} "
                f"{100 * (1 - kept.sum() / max(band.sum(), 1)):7.1f} "
                f"{_row(true, value, stderr, kept)}"
                f"            {100 * sharp.sum() / max(band.sum(), 1):6.1f} "
                f"{_row(true, value, stderr, sharp)}"
            )


def _row(true: np.ndarray, value: np.ndarray, stderr: np.ndarray, kept: np.ndarray) -> str:
    if kept.sum() < 20:
        return "      –      –       –"
    relative = 100 * np.median(np.abs(value[kept] / true[kept] - 1))
    covered = 100 * np.mean(np.abs(value[kept] - true[kept]) <= stderr[kept])
    return f"{relative:8.1f} {covered:6.1f} {100 * np.median(stderr[kept] / value[kept]):7.1f}"


if __name__ == "__main__":
    limits = [int(text) for text in sys.argv[1:3]] or [100, 119]
    main(*limits)
