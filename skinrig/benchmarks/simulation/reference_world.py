"""Benchmark of melanin and blood from images of voxel skin, which no inverted equation made.

The same people are also seen by the fast renderer's equations. The difference of both errors is
what simulations gain when the estimator's model and the simulator's are alike.
"""

from collections import defaultdict
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from capture.rig import load_rig
from model.color_table import ColorTable
from reconstruction import chromophores
from reconstruction.chromophores import model_error
from reconstruction.chromophores.face import estimate_face
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.pipeline.flash.stages import load_skin_colors
from rigsim.population.files import load_subject
from rigsim.scenes.reference.patch import (
    PatchImage,
    draw_patch,
    fast_shading,
    pixel_truth,
    predict_patch,
    render_patch,
)
from rigsim.tissue.skin_layers import melanin_per_mm
from skinrig.arrays import Float64Array
from skinrig.benchmarks.intervals.flash import FACTOR_95
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "renderer and estimator share the process"
MELANIN_PRESETS: Final = ("I", "III", "V")
FACE_SITE: Final = "cheek"
FIELD_MM: Final = 16.0
VOXEL_MM: Final = 0.25
INTERVAL_PROBABILITY: Final = 0.683
WIDE_PROBABILITY: Final = 0.95
ABSORPTION_NM: Final = 550.0

ShadingMode = Literal["known", "free"]
Chromophore = Literal["melanin", "hemoglobin"]


@dataclass(frozen=True, slots=True)
class PersonAccuracy:
    """Accuracy of one chromophore over the pixels of one person."""

    error: float
    """Median of the relative error's size, %."""
    bias: float
    """Median ratio of estimate to ground truth."""
    coverage: float
    """Fraction of 68 % intervals that contain the ground truth."""
    wide_coverage: float
    """The same of 95 % intervals."""
    valid: float
    """Fraction of valid pixels."""


def measure_reference_world(stage: BenchmarkStage) -> None:
    """Measure errors of chromophores against images of voxels and of the fast renderer.

    Both images have the same noise, that of the voxels' renderer. With the shading free, the light
    rises over the image by the central 68 % of the measured distribution of faces, smoothly, since
    the estimator takes steps between neighbors as fine structure of the skin.
    """
    width, samples, seeds = (8, 16, (3,)) if stage.toy else (16, 512, (3, 4))
    presets = MELANIN_PRESETS[:2] if stage.toy else MELANIN_PRESETS
    found: dict[tuple[str, ShadingMode, Chromophore], list[PersonAccuracy]] = defaultdict(list)
    seconds: dict[str, float] = defaultdict(float)
    colors, noises = [], []
    rig = load_rig("flash")
    view, illuminant = rig.views[0], rig.lights[0].illuminant
    skin_colors = load_skin_colors(view.spectral_sensitivity, illuminant, has_white=True)
    for preset in presets:
        for seed in seeds:
            person = load_subject(preset).skin(seed=seed)
            patch = draw_patch(person, FACE_SITE, field_mm=FIELD_MM, voxel_mm=VOXEL_MM)
            spent_s, voxels = measure_processor_time(
                lambda: render_patch(patch, rig, width_px=width, samples=samples, seed=seed)
            )
            seconds["voxels"] += spent_s
            spent_s, plain = measure_processor_time(
                lambda: predict_patch(patch, rig, width_px=width)
            )
            seconds["fast"] += spent_s
            colors.append(voxels.rgb.mean(axis=(0, 1)) / plain.mean(axis=(0, 1)))
            noises.append(np.sqrt(voxels.variance.mean()) / voxels.rgb.mean())
            rng = np.random.default_rng([seed, MELANIN_PRESETS.index(preset)])
            noise = rng.standard_normal(plain.shape) * np.sqrt(voxels.variance)
            images = {"voxels": voxels, "fast": PatchImage(plain + noise, voxels.variance)}
            tissue = person.tissue
            depth = tissue.melanin_reference_mm * melanin_per_mm(
                ABSORPTION_NM, tissue.eumelanin_fraction
            )
            melanin, blood = pixel_truth(patch, width)
            melanin *= float(depth) / skin_colors[0].constants.melanin_depth_factor
            light = ramp_shading(skin_colors[1], width)
            for name, image in images.items():
                for key, one in estimate_patch(
                    image, fast_shading(rig), light, skin_colors, melanin, blood
                ).items():
                    found[name, *key].append(one)
    _add_results(stage, found, seconds, 100.0 * float(np.mean(noises)))
    ratio = np.abs(np.array(colors).mean(axis=0) - 1.0)
    stage.limits["color"] = 100.0 * float(ratio.max())


def ramp_shading(prior: ShadingPrior, width: int) -> Float64Array:
    """Return light that changes over the image by the central part of a face's, shape (H, W)."""
    below = np.cumsum(prior.density) * prior.step
    quantiles = np.linspace(
        0.5 - 0.5 * INTERVAL_PROBABILITY, 0.5 + 0.5 * INTERVAL_PROBABILITY, width
    )
    column = np.exp(np.interp(quantiles, below, prior.nodes))
    return np.repeat(column[:, None], width, axis=1)


def estimate_patch(
    image: PatchImage,
    shading: float,
    light: Float64Array,
    skin_colors: tuple[ColorTable, ShadingPrior],
    melanin: Float64Array,
    blood: Float64Array,
) -> dict[tuple[ShadingMode, Chromophore], PersonAccuracy]:
    """Estimate one person with the shading known, and as a session with a white reference does."""
    table, prior = skin_colors
    rgb, variance = image.rgb / shading, image.variance / shading**2
    known = chromophores.invert(rgb, table, shading="known", variance=variance)
    lit = (rgb * light[..., None]).astype(np.float32)
    noise = (variance * light[..., None] ** 2).astype(np.float32)
    usable = np.ones(light.shape, bool)
    free = estimate_face(
        lit,
        table,
        prior=prior,
        variance=noise,
        model_error=model_error.image_covariance(lit, noise, usable),
        has_white=True,
    ).found
    out: dict[tuple[ShadingMode, Chromophore], PersonAccuracy] = {}
    truths: tuple[tuple[Chromophore, Float64Array], ...] = (
        ("melanin", melanin),
        ("hemoglobin", blood),
    )
    for name, truth in truths:
        ends = [known.interval(name, p) for p in (INTERVAL_PROBABILITY, WIDE_PROBABILITY)]
        out["known", name] = _accuracy(getattr(known, name), ends, truth, known.valid)
        middle, half = (
            np.asarray(getattr(free, part), np.float64) for part in (name, f"stderr_{name}")
        )
        ends = [(middle - k * half, middle + k * half) for k in (1.0, FACTOR_95)]
        out["free", name] = _accuracy(middle, ends, truth, free.valid)
    return out


def _accuracy(
    value: Float64Array,
    ends: list[tuple[Float64Array, Float64Array]],
    truth: Float64Array,
    valid: np.ndarray,
) -> PersonAccuracy:
    """Return the accuracy with 68 and 95 % intervals between two ends each."""
    if not valid.any():
        unknown = float("nan")
        return PersonAccuracy(unknown, unknown, unknown, unknown, 0.0)
    ratio = value[valid] / truth[valid]
    inside, wide = ((low <= truth) & (truth <= high) for low, high in ends)
    return PersonAccuracy(
        100.0 * float(np.median(np.abs(ratio - 1.0))),
        float(np.median(ratio)),
        float(inside[valid].mean()),
        float(wide[valid].mean()),
        float(valid.mean()),
    )


def _add_results(
    stage: BenchmarkStage,
    found: dict[tuple[str, ShadingMode, Chromophore], list[PersonAccuracy]],
    seconds: dict[str, float],
    noise_percent: float,
) -> None:
    """Add one point per image, shading and chromophore, over people."""
    for (image, shading, name), people in found.items():
        timing = Timing.single(seconds[image] / len(people), no_memory_reason=NO_MEMORY_REASON)
        coverage = float(np.mean([one.coverage for one in people]))
        extra: dict[str, float] = {
            "noise, %": round(noise_percent, 2),
            "coverage of 68 % intervals": round(coverage, 3),
            "coverage of 95 % intervals": round(
                float(np.mean([one.wide_coverage for one in people])), 3
            ),
            "median ratio to the truth": round(float(np.mean([one.bias for one in people])), 3),
            "lowest ratio of a person": round(min(one.bias for one in people), 3),
            "highest ratio of a person": round(max(one.bias for one in people), 3),
        }
        gains = [
            one.error - other.error
            for one, other in zip(people, found["fast", shading, name], strict=True)
        ]
        if image == "voxels" and len(gains) > 1:
            extra["error minus that of the fast renderer, %"] = round(float(np.mean(gains)), 2)
            stderr = float(np.std(gains, ddof=1) / np.sqrt(len(gains)))
            extra["its standard error, %"] = round(stderr, 2)
        chromophore = "blood" if name == "hemoglobin" else name
        stage.add(
            {"image": image, "shading": shading, "chromophore": chromophore},
            timing,
            mean_error([one.error for one in people]),
            extra,
        )
        stage.limits["valid", chromophore, image, shading] = min(one.valid for one in people)
        stage.limits["coverage", chromophore, image, shading] = coverage
