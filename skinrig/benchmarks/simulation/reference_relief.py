"""Benchmark of the gradient rig's crossed light on grooves: voxel skin against the fast renderer.

Pigment is even, so that all contrast is that of the relief. Each moment of the voxels' light is
regressed on that of the fast renderer, pixel by pixel. Diffuse normals from the voxels' light are
compared with those of the smoothed surface.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter

from capture.rig import Rig, load_rig
from model.vectors import unit_vectors
from reconstruction.gradient_normals import SphereLights, from_patterns
from reconstruction.normal_integration.relief_errors import DIFFUSE_SCALE_MM, diffuse_normal_stderr
from rigsim.as_built.sphere import PATTERN_WEIGHTS, nominal_sphere
from rigsim.scenes.reference.gradient_relief import draw_grooves, predict_relief
from rigsim.scenes.reference.gradient_skin import render_moments, turn_skin
from rigsim.scenes.reference.patch import SkinPatch
from rigsim.subject.person_skin import PersonSkin
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.surface import RAYLEIGH_68

NO_MEMORY_REASON = "both renderers share the process"
RELIEF_SITE: Final = "forehead"
RELIEF_NM: Final = 540.0
PIXEL_UM: Final = 40.0
MOMENT_NAMES: Final = ("1", "x", "y", "z")
FIRST_SEED: Final = 1
"""Seed of the first person; seed 0 set the limits."""
SLOPED_MOMENTS: Final = (1, 2)
"""Moments whose contrast is that of the slopes."""

NO_NOISE: Final = 1e-12
"""Replaces a standard error of zero in a division."""
NORMAL_BLOCK_PX: Final = 2
"""Pixels along each side of the blocks whose mean light gives a diffuse normal."""
RAYLEIGH_95: Final = math.sqrt(-2.0 * math.log(0.05))
"""Half angle of a 95 % cone over the standard error in each of two directions."""


@dataclass(frozen=True, slots=True)
class MomentContrast:
    """Contrast of one moment of the voxels against the fast renderer's."""

    slope: float
    """Of the regression: contrast over that of the fast renderer."""
    slope_stderr: float
    """Its standard error by the residuals."""
    fast: float
    """RMS contrast of the fast renderer, of the mean light."""
    misfit: float
    """RMS of the residuals without the renderer's noise, of the mean light; 0 if none is found."""
    misfit_stderr: float
    """Standard error of `misfit`."""


def compare_contrast(voxels: Float64Array, fast: Float64Array) -> MomentContrast:
    """Regress images of one moment on the fast renderer's.

    Parameters
    ----------
    voxels
        Two renders with independent noise, of mean light 1, shape (2, H, W).
    fast
        Image of mean light 1, shape (H, W).

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> fast = rng.standard_normal((40, 40))
    >>> noisy = 0.5 * fast + 0.1 * rng.standard_normal((2, 40, 40))
    >>> found = compare_contrast(noisy, fast)
    >>> abs(found.slope - 0.5) < 4.0 * found.slope_stderr, found.misfit < 0.05
    (True, True)
    """
    known = fast.ravel() - fast.mean()
    halves = voxels.reshape(2, -1) - voxels.mean(axis=(1, 2))[:, None]
    mean = halves.mean(axis=0)
    power = float(known @ known)
    slope = float(known @ mean) / power
    rest = mean - slope * known
    product = np.prod(halves - slope * known, axis=0)
    misfit = math.sqrt(max(float(product.mean()), 0.0))
    spread = float(product.std(ddof=1)) / math.sqrt(product.size)
    return MomentContrast(
        slope,
        math.sqrt(float(rest @ rest) / (rest.size - 2) / power),
        math.sqrt(power / known.size),
        misfit,
        spread / max(2.0 * misfit, math.sqrt(spread), NO_NOISE),
    )


@dataclass(frozen=True, slots=True)
class DiffuseNormalAccuracy:
    """Accuracy of diffuse normals of grooves."""

    error_rad: float
    """RMS error in each direction, without the renderer's noise; 0 if none is found."""
    stated_rad: float
    """Stated standard error of the relief in each direction."""
    noise_rad: float
    """Standard error by the renderer's noise in each direction."""
    coverage: tuple[float, float]
    """Fractions of 68 and 95 % cones, with the renderer's noise, that contain the truth."""
    coverage_by_noise: tuple[float, float]
    """The same without the stated error of the relief."""


def judge_diffuse_normals(
    voxels: Float64Array, patch: SkinPatch, rig: Rig, *, block_px: int = NORMAL_BLOCK_PX
) -> DiffuseNormalAccuracy:
    """Compare diffuse normals of grooves with those of the smoothed surface.

    Parameters
    ----------
    voxels
        Two renders of the four moments with independent noise, over the mean light, shape
        (2, 4, H, W).
    patch
        The skin.
    rig
        The gradient rig, with the renders' field.
    block_px
        Side of the blocks of pixels with one normal.
    """
    side = voxels.shape[-1] // block_px
    means = voxels.reshape(2, 4, side, block_px, side, block_px).mean(axis=(3, 5))
    truth = smoothed_normals(patch, side)[..., :2]
    normals = np.stack([_estimate_normals(half, rig) for half in means])
    errors = normals[..., :2] - truth
    product = float(np.prod(errors, axis=0).mean())
    noise = float(np.sqrt(np.square(0.5 * (errors[0] - errors[1])).mean()))
    mean, known = normals.mean(axis=0), np.ones((side, side), bool)
    stated = diffuse_normal_stderr(mean, np.full((side, side), noise, np.float32), known)
    angle = np.linalg.norm(errors.mean(axis=0), axis=-1)
    with_relief, alone = (
        (float((angle <= RAYLEIGH_68 * sigma).mean()), float((angle <= RAYLEIGH_95 * sigma).mean()))
        for sigma in (float(stated[0, 0]), noise)
    )
    relief = math.sqrt(max(float(stated[0, 0]) ** 2 - noise**2, 0.0))
    return DiffuseNormalAccuracy(math.sqrt(max(product, 0.0)), relief, noise, with_relief, alone)


def smoothed_normals(patch: SkinPatch, width_px: int) -> Float64Array:
    """Return the normals that diffuse normals estimate, shape (H, W, 3), row 0 at the top.

    Parameters
    ----------
    patch
        Skin with a relief.
    width_px
        Pixels along each side of the field.
    """
    if patch.height_mm is None:
        raise ValueError("patch: got skin without a relief, expected one of `draw_grooves`")
    height = gaussian_filter(patch.height_mm, DIFFUSE_SCALE_MM / patch.voxel_mm, mode="nearest")
    first, end = np.searchsorted(patch.x_mm, [-0.5 * patch.field_mm, 0.5 * patch.field_mm])
    block = (end - first) // width_px
    inner = slice(first, first + block * width_px)
    up, right = (
        slope[inner, inner].reshape(width_px, block, width_px, block).mean(axis=(1, 3))[::-1]
        for slope in np.gradient(height, patch.voxel_mm)
    )
    return unit_vectors(np.stack([-right, -up, np.ones_like(up)], axis=-1))


def _estimate_normals(moments: Float64Array, rig: Rig) -> Float64Array:
    """Return diffuse normals of images of four moments, shape (H, W, 3)."""
    sphere = nominal_sphere(rig)
    distance = np.linalg.norm(sphere.position_mm, axis=1)
    # the noise of moment z would turn normals that hardly depend on it
    light = np.concatenate(
        [moments[:3], np.broadcast_to(moments[3:].mean(), (1, *moments[3].shape))]
    )
    found = from_patterns(
        {
            (name, "crossed"): np.tensordot(weights, light, 1)
            for name, weights in PATTERN_WEIGHTS.items()
        },
        component="diffuse",
        variance=NO_NOISE,
        lights=SphereLights(
            sphere.position_mm / distance[:, None],
            sphere.intensity,
            programmed=sphere.weights[:, 1:],
            distance_mm=float(distance.mean()),
        ),
    )
    return np.asarray(found.normals, np.float64)


def crop_rig(width_px: int) -> Rig:
    """Return the gradient rig with a field of some pixels of `PIXEL_UM` around its axis."""
    rig = load_rig("gradient")
    view = rig.views[0]
    pixel_um = 1e3 * view.distance_mm / view.focal_px
    return rig.resized(round(view.width_px * pixel_um / PIXEL_UM)).cropped(width_px)


def measure_reference_relief(stage: BenchmarkStage) -> None:
    """Measure the contrast of grooves in crossed light of voxels over that of the fast renderer."""
    presets, width, samples = (("III",), 12, 32) if stage.toy else (("II", "V"), 24, 1024)
    rig = crop_rig(width)
    slopes, local, normals = [], [], []
    for number, preset in enumerate(presets):
        person = PersonSkin.of_preset(preset, seed=FIRST_SEED + number)
        patch = draw_grooves(person, RELIEF_SITE, max(rig.views[0].field_mm))
        spent_s, voxels = measure_processor_time(
            lambda: _render_halves(patch, rig, width_px=width, samples=samples, seed=2 * number)
        )
        fast = predict_relief(person, patch, rig, RELIEF_SITE)
        sharp = predict_relief(person, patch, rig, RELIEF_SITE, lateral=False)
        for m, name in enumerate(MOMENT_NAMES):
            found = compare_contrast(voxels[:, m], fast[m] / fast[0].mean())
            stage.add(
                {"preset": preset, "moment": name},
                Timing.single(spent_s, no_memory_reason=NO_MEMORY_REASON),
                ErrorEstimate.nonnegative(100.0 * found.misfit, 100.0 * found.misfit_stderr),
                {
                    "contrast of the fast renderer, %": round(100.0 * found.fast, 2),
                    "contrast of voxels over it": round(found.slope, 3),
                    "its standard error": round(found.slope_stderr, 3),
                },
            )
            if m in SLOPED_MOMENTS:
                slopes.append(found.slope)
                without = compare_contrast(voxels[:, m], sharp[m] / sharp[0].mean())
                local.append(without.slope)
        normals.append(judge_diffuse_normals(voxels, patch, rig))
    error, stated = (
        math.sqrt(sum(one**2 for one in some))
        for some in zip(*((one.error_rad, one.stated_rad) for one in normals), strict=True)
    )
    stage.limits["normals"] = error / max(stated, NO_NOISE)
    for k, name in enumerate(("coverage", "wide")):
        stage.limits[name] = float(np.mean([one.coverage[k] for one in normals]))
    stage.limits["contrast"] = float(np.abs(np.array(slopes) - 1.0).max())
    stage.limits["local"] = float(np.mean(local))


def _render_halves(
    patch: SkinPatch, rig: Rig, *, width_px: int, samples: int, seed: int
) -> Float64Array:
    """Return two renders of all moments over their mean light, shape (2, 4, H, W)."""
    halves = []
    for half in range(2):
        image = render_moments(
            patch,
            rig,
            nominal_sphere(rig),
            turn_skin(0.0, 0.0),
            RELIEF_NM,
            width_px=width_px,
            samples=samples,
            seed=seed + half,
        )
        halves.append(image.moments / image.mean[0])
    return np.stack(halves)
