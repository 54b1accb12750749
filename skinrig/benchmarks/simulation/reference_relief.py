"""Benchmark of the gradient rig's crossed light on grooves: voxel skin against the fast renderer.

Pigment is even, so that all contrast is that of the relief. Each moment of the voxels' light is
regressed on that of the fast renderer, pixel by pixel.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig, load_rig
from rigsim.as_built.sphere import nominal_sphere
from rigsim.scenes.reference.gradient_relief import draw_grooves, predict_relief
from rigsim.scenes.reference.gradient_skin import render_moments, turn_skin
from rigsim.scenes.reference.patch import SkinPatch
from rigsim.subject.person_skin import PersonSkin
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

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
    slopes, local = [], []
    for number, preset in enumerate(presets):
        person = PersonSkin.of_preset(preset, seed=FIRST_SEED + number)
        patch = draw_grooves(person, RELIEF_SITE, rig)
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
