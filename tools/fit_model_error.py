"""Fit how far the model is from a simulated capture without noise, and how much light skin gets.

    python tools/fit_model_error.py

Subjects of seeds 0 to 19 over all skin types stand before the flash rig. For each pixel the color
that the table predicts for the true chromophores is compared with the crossed image over a white
tile's, both seen through the color filter array but without noise. What the two differ by, in the
logarithm and without the brightness that is common to the channels, is the model's error. Its
covariance about zero, without the outermost 5 % of pixels (outlines, nostrils, eyelids), is scaled
so that with the sensor's noise 68 % of all pixels lie inside the 68 % ellipse of both, for a few
pixels with much larger errors must not widen everybody's intervals. The brightness itself is the
pixels' log shading. Both go to ``reconstruction/data/chromophore_model_error.json``. Coverage is
judged on seeds from 100 on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from capture import raw
from capture.rig import load_rig
from model import color_table
from model.tissue_optics import ANISOTROPY_SKIN
from rigsim.scenes.flash import FlashScene
from rigsim.subject import make_subject
from rigsim.targets import make_target
from skinrig.simulating.flash import to_superpixels

SEEDS = range(20)
PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")
WIDTH_PX = 768
OUTERMOST = 0.05
WHITE_FRAMES = 2
WITHIN = 0.682689492137086
SHADING_LOW, SHADING_STEP, SHADING_BINS = -6.0, 0.05, 140
TARGET = Path(__file__).resolve().parents[1] / "reconstruction/data/chromophore_model_error.json"


def seen_by(scene: FlashScene, pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Crossed image through the color filter array, read as a measurement is, without noise.

    The second array is the relative variance that the sensor's noise would have had.
    """
    radiance = scene.radiance("crossed").astype(np.float64)
    top = radiance.max()
    mosaic = np.zeros(radiance.shape[:2])
    for cell, letter in enumerate(pattern):
        part = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        mosaic[part] = radiance[..., "RGB".index(letter)][part]
    # 16 bits round to a few 1e-5 of skin, far below what is looked for
    cfa = np.round(mosaic / top * 65_000).astype(np.uint16)
    unit = 65_535 / 65_000 * top
    scale, offset = scene.sensor().noise_profile()
    frame = raw.RawFrame(
        cfa=cfa, pattern=pattern, black=(0.0,) * 4, white=65_535,
        noise_profile=(scale / unit, offset / unit**2),
    )  # fmt: skip
    seen = raw.linear_rgb(frame, demosaic="centered")
    rgb = seen.rgb.astype(np.float64)
    return rgb * unit, seen.variance / rgb**2


def _scale(covariance: np.ndarray, errors: np.ndarray, variances: np.ndarray) -> float:
    """Return the factor of the covariance with which 68 % of noisy errors are in 68 % ellipses."""
    plane = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
    seen = errors @ plane.T
    noise = np.einsum("ic,nc,jc->nij", plane, variances, plane)
    model = plane @ covariance @ plane.T
    reach = -2.0 * np.log(1.0 - WITHIN)  # of chi-square with two degrees of freedom

    def share_missing(scale: float) -> float:
        inverse = np.linalg.inv(noise + scale * model)
        return float(WITHIN - (np.einsum("ni,nij,nj->n", seen, inverse, seen) < reach).mean())

    return float(brentq(share_missing, 0.05, 20.0, xtol=1e-3))


def main() -> None:
    rig = load_rig("flash").resized(WIDTH_PX)
    view = rig.views[0]
    table = color_table.build(
        view.spectral_sensitivity, rig.lights[0].illuminant, anisotropy=ANISOTROPY_SKIN
    )
    white, white_variance = seen_by(FlashScene(rig, make_target("white")), view.cfa)
    white /= 0.99
    rng = np.random.default_rng(0)
    noisy, variances = [], []
    kept = []
    shadings = np.zeros(SHADING_BINS, np.int64)
    edges = SHADING_LOW + SHADING_STEP * np.arange(SHADING_BINS + 1)
    by_preset: dict[str, list[float]] = {}
    for seed in SEEDS:
        preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
        # the blood alone: what faces do in expressions is no error of the color model
        person = make_subject(preset, seed=seed)
        scene = FlashScene(rig, person, state=state, movement=False, seed=seed)
        truth = scene.truth()
        mask = np.asarray(truth["mask"], bool)
        whole = to_superpixels(mask.astype(float)) == 1.0
        melanin, hemoglobin = (
            to_superpixels(truth[f"{name}_blurred"], mask)[whole]
            for name in ("melanin", "hemoglobin")
        )
        rgb, variance = seen_by(scene, view.cfa)
        variance = (variance + white_variance / WHITE_FRAMES)[whole]
        error = np.log(rgb[whole] / white[whole]) - np.log(table.lookup(melanin, hemoglobin))
        fine = np.isfinite(error).all(axis=1) & np.isfinite(variance).all(axis=1)
        error, variance = error[fine], variance[fine]
        shadings += np.histogram(error.mean(axis=1), edges)[0]
        error -= error.mean(axis=1, keepdims=True)
        size = np.linalg.norm(error, axis=1)
        noise = np.sqrt(variance) * rng.standard_normal(error.shape)
        noisy.append(error + noise - noise.mean(axis=1, keepdims=True))
        variances.append(variance)
        kept.append(error[size <= np.quantile(size, 1 - OUTERMOST)])
        by_preset.setdefault(preset, []).append(float(np.sqrt((kept[-1] ** 2).mean())))
        print(f"seed {seed} {preset} {state}: {by_preset[preset][-1]:.4f}", file=sys.stderr)
    stacked = np.concatenate(kept)
    count = len(stacked)
    covariance = stacked.T @ stacked / count
    scale = _scale(covariance, np.concatenate(noisy), np.concatenate(variances))
    covariance *= scale
    document = {
        "log_covariance": covariance.round(15).tolist(),
        "seeds": [SEEDS[0], SEEDS[-1]],
        "pixels": count,
        "scale_to_68_percent": round(scale, 4),
        "log_shading": {
            "low": SHADING_LOW,
            "step": SHADING_STEP,
            "counts": shadings.tolist(),
        },
        "rms_by_preset": {name: round(float(np.mean(v)), 5) for name, v in by_preset.items()},
        "recipe": "tools/fit_model_error.py",
    }
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
