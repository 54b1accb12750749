"""Fit how far the layered model is from what a simulated capture shows without noise.

    python tools/fit_model_error.py

Subjects of seeds 0 to 19 over all skin types stand before the flash rig. For each pixel the color
that the table predicts for the true chromophores is compared with the crossed image over a white
tile's, both without noise. What the two differ by, in the logarithm and without the brightness
that is common to the channels, is the model's error; its covariance about zero is written to
``reconstruction/data/chromophore_model_error.json``. Coverage is judged on seeds from 100 on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from capture.rig import load_rig
from model import color_table
from model.tissue_optics import ANISOTROPY_SKIN
from rigsim.scenes.flash import FlashScene
from rigsim.subject import make_subject
from rigsim.targets import make_target

SEEDS = range(20)
PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")
WIDTH_PX = 256
TARGET = Path(__file__).resolve().parents[1] / "reconstruction/data/chromophore_model_error.json"


def main() -> None:
    rig = load_rig("flash").resized(WIDTH_PX)
    view = rig.views[0]
    table = color_table.build(
        view.spectral_sensitivity, rig.lights[0].illuminant, anisotropy=ANISOTROPY_SKIN
    )
    white = FlashScene(rig, make_target("white")).radiance("crossed").astype(np.float64) / 0.99
    total = np.zeros((3, 3))
    count = 0
    by_preset: dict[str, list[float]] = {}
    for seed in SEEDS:
        preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
        scene = FlashScene(rig, make_subject(preset, seed=seed), state=state, seed=seed)
        truth = scene.truth()
        mask = np.asarray(truth["mask"], bool)
        seen = np.log(scene.radiance("crossed").astype(np.float64)[mask] / white[mask])
        known = np.log(
            table.lookup(truth["melanin_blurred"][mask], truth["hemoglobin_blurred"][mask])
        )
        error = seen - known
        error -= error.mean(axis=1, keepdims=True)
        good = np.isfinite(error).all(axis=1)
        total += error[good].T @ error[good]
        count += int(good.sum())
        by_preset.setdefault(preset, []).append(float(np.sqrt((error[good] ** 2).mean())))
        print(f"seed {seed} {preset} {state}: {by_preset[preset][-1]:.4f}", file=sys.stderr)
    covariance = total / count
    document = {
        "log_covariance": covariance.round(15).tolist(),
        "seeds": [SEEDS[0], SEEDS[-1]],
        "pixels": count,
        "rms_by_preset": {name: round(float(np.mean(v)), 5) for name, v in by_preset.items()},
        "recipe": "tools/fit_model_error.py",
    }
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
