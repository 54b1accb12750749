"""Fit the chromophore model's error on noise-free simulated captures, and the prior of shading.

    python tools/fit_model_error.py

Subjects of seeds 0 to 19 over all skin types are rendered for the flash rig at two resolutions. Per
pixel, the color that the table predicts for the ground-truth chromophores is compared with the
ratio of the crossed image to that of a white reference, both sampled by the color filter array
without noise. The model's error is their difference in log color, without the brightness that is
common to the channels. Its terms (see ``reconstruction.chromophores.model_error``) are
maximum-likelihood estimates under Student's t with few degrees of freedom, so that outliers at
outlines, nostrils and eyelids do not widen every interval. Fine structure is estimated from the
noisy image, as in a reconstruction. A common factor then scales the covariances so that, with the
sensor's noise added, 68 % of pixels are inside the joint 68 % ellipse.

Where no image is available, one covariance of all pixels of the larger resolution is used: without
the outermost 5 %, scaled likewise. The brightness is the pixels' log shading. All results are
written to ``reconstruction/data/chromophore_model_error.json``. Coverage is evaluated on seeds from
400 on.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize

from capture import raw
from capture.rig import load_rig
from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error
from rigsim.scenes.flash.scene import FlashScene
from rigsim.subject import make_subject
from rigsim.targets import make_target
from skinrig.simulating.flash_truth import to_superpixels

SEEDS = range(20)
PRESETS = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
STATES = ("neutral", "smile", "anger", "fear", "exercise")
WIDTHS_PX = (384, 768)
PIXELS = 2500
"""Pixels of each subject and resolution that the terms are fitted to."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t."""
BEGIN = (-6.9, 0.0, -6.9, -1.5, 1.3, -1.5, -4.0)
"""Start of the search: logarithms of transport's and fine structure's Cholesky factors, on the
diagonal, and of the interreflected fraction; off-diagonal elements are relative."""
PLANE = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, -2.0]]) / np.sqrt([[2.0], [6.0]])
"""Colors without brightness."""
OUTERMOST = 0.05
WHITE_FRAMES, WHITE_REFLECTANCE = 2, 0.99
WITHIN = 0.682689492137086
SHADING_LOW, SHADING_STEP, SHADING_BINS = -6.0, 0.05, 140
TARGET = Path(__file__).resolve().parents[1] / "reconstruction/data/chromophore_model_error.json"


def seen_by(scene: FlashScene, pattern: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise-free crossed image as sampled by the color filter array and demosaicked.

    The second array is the relative variance that the sensor's noise would have had.
    """
    radiance = scene.radiance("crossed").astype(np.float64)
    top = radiance.max()
    mosaic = np.zeros(radiance.shape[:2])
    for cell, letter in enumerate(pattern):
        part = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        mosaic[part] = radiance[..., "RGB".index(letter)][part]
    # 16-bit rounding is a few 1e-5 of skin's signal, far below the model error
    cfa = np.round(mosaic / top * 65_000).astype(np.uint16)
    unit = 65_535 / 65_000 * top
    scale, offset = scene.sensor().noise_profile()
    frame = raw.RawFrame(
        cfa=cfa,
        pattern=pattern,
        black=(0.0,) * 4,
        white=65_535,
        noise_profile=(scale / unit, offset / unit**2),
    )
    seen = raw.linear_rgb(frame, demosaic="centered")
    rgb = seen.rgb.astype(np.float64)
    with np.errstate(divide="ignore"):  # pixels without light
        return rgb * unit, seen.variance / rgb**2


def _scale(model: np.ndarray, errors: np.ndarray, variances: np.ndarray) -> float:
    """Return the factor of the covariances at which 68 % ellipses contain 68 % of noisy errors.

    `model` is (3, 3), or (n, 2, 2) in the plane without brightness.
    """
    seen = errors @ PLANE.T
    noise = np.einsum("ic,nc,jc->nij", PLANE, variances, PLANE)
    planar = PLANE @ model @ PLANE.T if model.ndim == 2 else model
    reach = -2.0 * np.log(1.0 - WITHIN)  # quantile of chi-square with two degrees of freedom

    def share_missing(scale: float) -> float:
        inverse = np.linalg.inv(noise + scale * planar)
        return float(WITHIN - (np.einsum("ni,nij,nj->n", seen, inverse, seen) < reach).mean())

    return float(brentq(share_missing, 0.05, 20.0, xtol=1e-3))


@dataclass(frozen=True)
class Sample:
    """Some pixels of one image."""

    error: np.ndarray
    """(n, 3) without noise."""
    noisy: np.ndarray
    """(n, 3) with noise."""
    variance: np.ndarray
    """(n, 3) of the noise, relative."""
    structure: np.ndarray
    """(n,) fine structure of the noisy image."""
    color: np.ndarray
    """(n, 3) of the noisy image."""


def _sample(rgb, log_error, variance, good, rng) -> Sample:
    spread = np.where(good[..., None], variance, 0.0)
    relative = np.sqrt(spread) * rng.standard_normal(rgb.shape)
    noisy = np.where(good[..., None], rgb * (1.0 + relative), 1.0)
    seen = model_error.usable_pixels(noisy, good)
    structure = model_error.fine_structure(noisy, spread * noisy**2, seen)
    places = np.flatnonzero(seen)
    places = rng.choice(places, min(PIXELS, places.size), replace=False)
    error = log_error.reshape(-1, 3)[places]
    with_noise = error + relative.reshape(-1, 3)[places]
    return Sample(
        error,
        with_noise - with_noise.mean(axis=1, keepdims=True),
        spread.reshape(-1, 3)[places],
        structure.ravel()[places],
        noisy.reshape(-1, 3)[places],
    )


def _terms(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return planar covariances of transport and fine structure, and the interreflected
    fraction."""

    def covariance(log_first: float, off_diagonal: float, log_second: float) -> np.ndarray:
        first = np.exp(log_first)
        factor = np.array([[first, 0.0], [off_diagonal * first, np.exp(log_second)]])
        return factor @ factor.T

    return covariance(*numbers[:3]), covariance(*numbers[3:6]), float(np.exp(numbers[6]))


def _planar(numbers: np.ndarray, sample: Sample) -> np.ndarray:
    """Return each pixel's covariance, (n, 2, 2)."""
    transport, fine, bounced = _terms(numbers)
    light = bounced * sample.color @ PLANE.T
    return (
        transport + sample.structure[:, None, None] * fine + light[:, :, None] * light[:, None, :]
    )


def _fit_terms(samples: list[Sample]) -> tuple[np.ndarray, float]:
    """Return the maximum-likelihood terms, and the common factor for 68 % coverage."""

    def unlikely(numbers: np.ndarray) -> float:
        total = 0.0
        for sample in samples:
            spread = _planar(numbers, sample)
            off = sample.error @ PLANE.T
            square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
            tail = 0.5 * (FREEDOM + 2.0) * np.log1p(square / FREEDOM)
            total += float(np.mean(0.5 * np.log(np.linalg.det(spread)) + tail))
        return total / len(samples)

    found = minimize(
        unlikely,
        BEGIN,
        method="Nelder-Mead",
        options={"maxiter": 1500, "xatol": 1e-3, "fatol": 1e-6},
    )
    covariances = np.concatenate([_planar(found.x, sample) for sample in samples])
    noisy = np.concatenate([sample.noisy for sample in samples])
    variances = np.concatenate([sample.variance for sample in samples])
    return found.x, _scale(covariances, noisy, variances)


def main() -> None:
    rigs = [load_rig("flash").resized(width) for width in WIDTHS_PX]
    view = rigs[-1].views[0]
    table = color_table.build(
        view.spectral_sensitivity,
        rigs[-1].lights[0].illuminant,
        anisotropy=ANISOTROPY_SKIN,
        exact_optics=True,
    )
    whites = [seen_by(FlashScene(rig, make_target("white")), view.cfa) for rig in rigs]
    rng = np.random.default_rng(0)
    noisy, variances, kept = [], [], []
    samples: list[Sample] = []
    shadings = np.zeros(SHADING_BINS, np.int64)
    edges = SHADING_LOW + SHADING_STEP * np.arange(SHADING_BINS + 1)
    by_preset: dict[str, list[float]] = {}
    for seed in SEEDS:
        preset, state = PRESETS[seed % len(PRESETS)], STATES[seed % len(STATES)]
        # vary blood alone: the motion of a face in expressions is not an error of the color model
        person = make_subject(preset, seed=seed)
        scenes = [FlashScene(rig, person, state=state, movement=False, seed=seed) for rig in rigs]
        for scene, (white, white_variance) in zip(scenes, whites, strict=True):
            truth = scene.truth()
            mask = np.asarray(truth["mask"], bool)
            whole = to_superpixels(mask.astype(float)) == 1.0
            melanin, hemoglobin = (
                to_superpixels(truth[f"{name}_blurred"], mask) for name in ("melanin", "hemoglobin")
            )
            rgb, variance = seen_by(scene, view.cfa)
            rgb = np.where(whole[..., None], rgb / (white / WHITE_REFLECTANCE), 1.0)
            variance = variance + white_variance / WHITE_FRAMES
            predicted = np.where(whole[..., None], table.lookup(melanin, hemoglobin), 1.0)
            error = np.log(rgb) - np.log(predicted)
            good = whole & np.isfinite(error).all(axis=-1) & np.isfinite(variance).all(axis=-1)
            shading = error.mean(axis=-1)
            error = error - shading[..., None]
            samples.append(_sample(rgb, error, variance, good, rng))
            if scene.rig is not rigs[-1]:
                continue
            shadings += np.histogram(shading[good], edges)[0]
            error, variance = error[good], variance[good]
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
    numbers, scale_of_terms = _fit_terms(samples)
    transport, fine, bounced = _terms(numbers)
    document = {
        "log_covariance": covariance.round(15).tolist(),
        "by_picture": {
            "transport": (scale_of_terms * PLANE.T @ transport @ PLANE).round(17).tolist(),
            "fine": (scale_of_terms * PLANE.T @ fine @ PLANE).round(15).tolist(),
            "bounced": round(float(np.sqrt(scale_of_terms)) * bounced, 6),
            "scale_to_68_percent": round(scale_of_terms, 4),
            "pixels": sum(len(sample.error) for sample in samples),
            "widths_px": list(WIDTHS_PX),
        },
        "seeds": [SEEDS[0], SEEDS[-1]],
        "pixels": count,
        "scale_to_68_percent": round(scale, 4),
        "log_shading": {"low": SHADING_LOW, "step": SHADING_STEP, "counts": shadings.tolist()},
        "rms_by_preset": {name: round(float(np.mean(v)), 5) for name, v in by_preset.items()},
        "recipe": "tools/fit_model_error.py",
    }
    TARGET.parent.mkdir(exist_ok=True)
    part = TARGET.with_name(f".{TARGET.name}.part")
    part.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    part.replace(TARGET)


if __name__ == "__main__":
    main()
