"""Fit how far the layered model is from what a simulated capture shows without noise.

    python tools/fit_model_error.py

Subjects of seeds 0 to 19 over all skin types stand before the flash rig. For each pixel the color
that the table predicts for the true chromophores is compared with the crossed image over a white
tile's, both seen through the color filter array but without noise. What the two differ by, in the
logarithm and without the brightness that is common to the channels, is the model's error; its
covariance about zero, without the outermost 5 % of pixels (outlines, nostrils, eyelids), goes to
``reconstruction/data/chromophore_model_error.json``. Coverage is judged on seeds from 100 on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from capture import raw
from capture.rig import load_rig
from model import color_table
from model.tissue_optics import ANISOTROPY_SKIN
from rigsim.scenes.flash import FlashScene
from rigsim.subject import make_subject
from rigsim.targets import make_target
from skinrig.simulation import to_superpixels

SEEDS = range(20)
PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")
WIDTH_PX = 768
OUTERMOST = 0.05
TARGET = Path(__file__).resolve().parents[1] / "reconstruction/data/chromophore_model_error.json"


def seen_by(scene: FlashScene, pattern: str) -> np.ndarray:
    """Crossed image through the color filter array, read as a measurement is, without noise."""
    radiance = scene.radiance("crossed").astype(np.float64)
    top = radiance.max()
    mosaic = np.zeros(radiance.shape[:2])
    for cell, letter in enumerate(pattern):
        part = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        mosaic[part] = radiance[..., "RGB".index(letter)][part]
    # 16 bits round to a few 1e-5 of skin, far below what is looked for
    cfa = np.round(mosaic / top * 65_000).astype(np.uint16)
    frame = raw.RawFrame(cfa=cfa, pattern=pattern, black=(0.0,) * 4, white=65_535)
    rgb = raw.linear_rgb(frame, demosaic="centered", gain=1e6, read_noise=0.0).rgb
    return rgb.astype(np.float64) * (65_535 / 65_000 * top)


def main() -> None:
    rig = load_rig("flash").resized(WIDTH_PX)
    view = rig.views[0]
    table = color_table.build(
        view.spectral_sensitivity, rig.lights[0].illuminant, anisotropy=ANISOTROPY_SKIN
    )
    white = seen_by(FlashScene(rig, make_target("white")), view.cfa) / 0.99
    errors = []
    by_preset: dict[str, list[float]] = {}
    for seed in SEEDS:
        preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
        scene = FlashScene(rig, make_subject(preset, seed=seed), state=state, seed=seed)
        truth = scene.truth()
        mask = np.asarray(truth["mask"], bool)
        whole = to_superpixels(mask.astype(float)) == 1.0
        melanin, hemoglobin = (
            to_superpixels(truth[f"{name}_blurred"], mask)[whole]
            for name in ("melanin", "hemoglobin")
        )
        seen = np.log(seen_by(scene, view.cfa)[whole] / white[whole])
        error = seen - np.log(table.lookup(melanin, hemoglobin))
        error -= error.mean(axis=1, keepdims=True)
        error = error[np.isfinite(error).all(axis=1)]
        size = np.linalg.norm(error, axis=1)
        errors.append(error[size <= np.quantile(size, 1 - OUTERMOST)])
        by_preset.setdefault(preset, []).append(float(np.sqrt((errors[-1] ** 2).mean())))
        print(f"seed {seed} {preset} {state}: {by_preset[preset][-1]:.4f}", file=sys.stderr)
    stacked = np.concatenate(errors)
    count = len(stacked)
    total = stacked.T @ stacked
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
